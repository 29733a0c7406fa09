"""The layouts of recorded folders: one table of what each looks like and what its values mean.

A row names its depth images by a pattern below the folder's root and the signs that tell it from
others of that pattern; the first row that fits is taken. Scales, cameras and marks of a missing
measurement are those that the publishers state; `assumed` marks what is merely usual. The table
is in ``app/docs/recordings.md`` with the source of each.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from fnmatch import fnmatch
from pathlib import Path, PurePosixPath
from typing import Final

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.colour import nearest
from selective_depth.drivers.errors import DamagedRecordingError, SourceNotFoundError
from selective_depth.drivers.folder.images import SUFFIXES
from selective_depth.drivers.folder.sidecar import SIDECAR, read_text
from selective_depth.drivers.frame import MOST_TIME_US, Camera

_Values = npt.NDArray[np.float64]
_Colour = tuple[tuple[int, Path] | None, ...]
_DECIMAL: Final = r"[0-9]{1,30}\.[0-9]{1,30}"
"""A file name that is one number: a time, as a rule."""
_EPOCH: Final = r"^([0-9]{9,11}\.[0-9]{1,9})$"
"""One that is a time of this century, in seconds."""


def _rotated(values: _Values) -> _Values:
    """SUN3D's values, whose 16 bits are rotated left by 3."""
    bits = values.astype(np.uint32)
    return (bits >> 3 | bits << 13 & 0xFFFF).astype(np.float64)


def _kinect_raw(values: _Values) -> _Values:
    """Millimetres of NYU's raw disparities, bytes swapped; 0 beyond the 10 m of its toolbox."""
    raw = values.astype(np.uint16).byteswap().astype(np.float64)
    depth_mm = 351_300.0 / (1092.5 - np.minimum(raw, 1092.0))
    return np.where((raw > 0) & (depth_mm <= 10_000), depth_mm, 0.0)


@dataclass(frozen=True)
class Layout:
    """One kind of folder.

    Parameters
    ----------
    name : str
        What it is called.
    depth : str
        Its depth images, as a pattern from the root.
    values_per_metre : float, default 1000
        Scale of whole numbers; floating-point images are in metres.
    camera : Camera, optional
        Intrinsics at their own size; without, those of a Kinect are assumed.
    signs : tuple of str
        Patterns from the root, each of which must be there; alternatives with ``|`` between.
    named : str
        Regular expression that must be found in the root's full name.
    lists : tuple of str
        Files that list times and images; one must be there where any is named.
    marks : tuple of int
        Values that mean "no measurement", beside 0.
    assumed : bool
        The scale is the usual one, and stated nowhere.
    stamp : tuple of (str, float)
        Regular expression of the time in a file's name, and its unit in microseconds.
    convert : callable, optional
        Millimetres of values that have no scale; of such a row, `values_per_metre` is 1000.
    colour : str
        The colour images beside, as a pattern from the root; several with ``|`` between.
    registered : bool
        They lie on the depth images, pixel on pixel.
    """

    name: str
    depth: str
    values_per_metre: float = 1000.0
    camera: Camera | None = None
    signs: tuple[str, ...] = ()
    named: str = ""
    lists: tuple[str, ...] = ()
    marks: tuple[int, ...] = ()
    assumed: bool = False
    stamp: tuple[str, float] | None = None
    convert: Callable[[_Values], _Values] | None = None
    colour: str = ""
    registered: bool = False


_XTION: Final = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
_KINECT: Final = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
_KITTI: Final = Camera(1242, 375, 721.5377, 721.5377, 609.5593, 172.854)
_BESIDE: Final = "color/*|colour/*|rgb/*|image/*"
_LISTS: Final = ("depth.txt", "associations.txt", "associate.txt", "association.txt")
_STAMP: Final = (r"^[0-9]+-([0-9]{1,15})$", 1.0)
_VIRTUAL_KITTI: Final = Camera(1242, 375, 725.0087, 725.0087, 620.5, 187.0)


def _tum(name: str, camera: Camera | None = _XTION, **more: object) -> Layout:
    row = {"values_per_metre": 5000.0, "lists": _LISTS, "colour": "rgb/*", "registered": True} | more
    return Layout(name, "depth/*", camera=camera, **row)  # type: ignore[arg-type]


LAYOUTS: Final = (
    _tum("TUM", Camera(640, 480, 517.3, 516.5, 318.6, 255.3), named="freiburg1"),
    _tum("TUM", Camera(640, 480, 520.9, 521.0, 325.1, 249.7), named="freiburg2"),
    _tum("TUM", Camera(640, 480, 535.4, 539.2, 320.1, 247.6), named="freiburg3"),
    # Its paper gives fy = -480: y points up there, the rows of the image go down all the same.
    *(
        _tum("ICL-NUIM", Camera(640, 480, 481.2, 480.0, 319.5, 239.5), **sign)
        for sign in ({"signs": ("*.gt.freiburg",)}, {"named": r"(living_?room|office)_?traj"})
    ),
    _tum("Bonn", Camera(640, 480, 542.822841, 542.57687, 315.59352, 237.756098), named="rgbd_bonn"),
    _tum("ETH3D", None, signs=("calibration.txt",)),
    _tum("OpenLORIS", None, named=r"^(office|corridor|home|cafe|market)[0-9]+-[0-9]+$",
         values_per_metre=1000.0, registered=False),
    _tum("TUM", assumed=True),
    Layout("KITTI", "proj_depth/*/image_0[23]/*.png", 256.0, _KITTI),
    Layout("Virtual KITTI 2", "frames/depth/Camera_[01]/depth_*.png", 100.0, _VIRTUAL_KITTI,
           marks=(65535,), colour="frames/rgb/Camera_[01]/rgb_*.jpg", registered=True),
    Layout("Replica", "results/depth*.png", 6553.5, Camera(1200, 680, 600.0, 600.0, 599.5, 339.5),
           colour="results/frame*.jpg", registered=True),
    Layout("ARKitScenes", "lowres_depth/*.png", stamp=(rf"_({_DECIMAL})$", 1e6),
           colour="lowres_wide/*.png", registered=True),
    Layout("TartanAir", "depth_left/*.npy", camera=Camera(640, 480, 320.0, 320.0, 320.0, 240.0),
           colour="image_left/*", registered=True),
    Layout("NYU raw", "d-*-*.pgm", camera=Camera(640, 480, 582.6245, 582.691, 313.0448, 238.4439),
           stamp=(rf"^d-({_DECIMAL})-", 1e6), convert=_kinect_raw, colour="r-*.ppm"),
    Layout("BOP", "depth/*", signs=("scene_camera.json",), colour="rgb/*", registered=True),
    Layout("SUN3D", "depth/*.png", camera=_XTION, signs=("intrinsics.txt", "image"), stamp=_STAMP,
           convert=_rotated, colour="image/*.jpg", registered=True),
    Layout("ScanNet", "depth/*", signs=("intrinsic/intrinsic_depth.txt|intrinsic_depth.txt",), colour="color/*"),
    Layout("Open3D / RealSense", "depth/*.png", signs=("camera_intrinsic.json",), assumed=True,
           colour="color/*", registered=True),
    Layout("Open3D / Azure Kinect", "depth/*.png", signs=("intrinsic.json",), assumed=True,
           colour="color/*", registered=True),
    Layout("BundleFusion", "frame-*.depth.p[ng][gm]", signs=("info.txt|_info.txt",), marks=(65535,),
           colour="frame-*.color.*"),
    Layout("3DMatch", "frame-*.depth.png", signs=("camera-intrinsics.txt|../camera-intrinsics.txt",),
           marks=(65535,), colour="frame-*.color.png"),
    Layout("7-Scenes", "*.depth.png", camera=_KINECT, marks=(65535,), colour="*.color.png"),
    Layout("YCB-Video", "*-depth.png", 10_000.0,
           Camera(640, 480, 1066.778, 1067.487, 312.9869, 241.3109), signs=("*-meta.mat",),
           colour="*-color.*", registered=True),
    Layout("RGB-D Scenes v2", "*-depth.png", camera=Camera(640, 480, 570.3, 570.3, 320.0, 240.0),
           signs=("*-color.png",), assumed=True, colour="*-color.png", registered=True),
    Layout("RealSense rs-convert", "*_Depth_*.png", assumed=True, colour="*_Color_*.png"),
    Layout("Matterport3D", "*_d[0-2]_[0-5].png", 4000.0, colour="../*/*_i[0-2]_[0-5].jpg"),
    Layout("Redwood", "depth/*", camera=_XTION, signs=("rgb/*-*.jpg",), assumed=True, stamp=_STAMP,
           colour="rgb/*", registered=True),
    Layout("Redwood", "depth/*", camera=_XTION, assumed=True, stamp=_STAMP, colour=_BESIDE),
    Layout("plain", "*", assumed=True, colour=_BESIDE),
)  # fmt: skip
ARRAYS: Final = Layout("an array", "*.np[yz]", assumed=True)
"""One file that holds all frames."""


@dataclass(frozen=True)
class Found:
    """What a folder was recognised as.

    Parameters
    ----------
    row : Layout
        Its kind.
    root : Path
        Where the kind's patterns begin; the folder that was named lies on the way to the images.
    files : list of Path
        The depth images, in order.
    timestamps_us : tuple of int or None
        Their times, where a list or the names tell them.
    colour : tuple of (int, Path) or None
        Time and colour image of each, where a list tells them; None for one that has none.
    """

    row: Layout
    root: Path
    files: list[Path] = field(repr=False)
    timestamps_us: tuple[int, ...] | None = None
    colour: _Colour | None = None


def find_layout(folder: Path) -> Found:
    """Recognise a folder; any folder between a layout's root and its images means the same.

    Raises
    ------
    SourceNotFoundError
        If there is no such folder, or no depth image in it.
    DamagedRecordingError
        If a list of images cannot be understood.
    """
    if not folder.is_dir():
        raise SourceNotFoundError(f"the folder '{folder}' does not exist; check its name.")
    # With a sidecar of its own, it says what its files mean, whatever lies above.
    own = bool(image_names(folder)) and (folder / SIDECAR).exists()
    for row in LAYOUTS:
        for up in range(1 if own else row.depth.count("/") + 1):
            if found := _match(row, folder, up):
                return found
    raise SourceNotFoundError(_nothing_found(folder))


def _match(row: Layout, folder: Path, up: int) -> Found | None:
    full = folder.absolute()
    if up > len(full.parents):
        return None
    root = folder if up == 0 else full.parents[up - 1]
    way = zip(full.parts[len(full.parts) - up :], row.depth.split("/"), strict=False)
    if (
        not all(fnmatch(part, pattern) for part, pattern in way)
        or not all(any(any(root.glob(each)) for each in sign.split("|")) for sign in row.signs)
        or (row.named and not re.search(row.named, root.resolve().name))
        or (row.name == "Redwood" and image_names(root))
    ):
        return None
    if row.lists:
        listed = next((root / name for name in row.lists if (root / name).is_file()), None)
        if listed is None:
            return None
        files, stamps, colour = _read_list(root, listed)
        # ICL-NUIM numbers its frames where others have a time.
        return Found(row, root, files, None if row.name == "ICL-NUIM" else stamps, colour)
    files = _images(root, row.depth, full)
    return Found(row, root, files, stamps_of(row, files)) if files else None


def image_names(folder: Path) -> list[str]:
    """Images of a folder in natural order: 2 before 10."""
    if not folder.is_dir():
        return []
    try:
        return [path.name for path in _images(folder, "*", folder.absolute())]
    except OSError as error:
        raise SourceNotFoundError(
            f"the folder '{folder}' cannot be read ({error.strerror}); check its permissions."
        ) from error


def _images(root: Path, pattern: str, below: Path) -> list[Path]:
    """Images of the first folder that fits a pattern, on the way through another."""
    found = root.iterdir() if pattern == "*" else root.glob(pattern)
    files = [
        path
        for path in found
        if path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and below in path.absolute().parents
    ]
    first = min((path.parent for path in files), default=root)
    return sorted((path for path in files if path.parent == first), key=lambda path: _natural_key(path.name))


def _natural_key(name: str) -> list[tuple[int, Decimal, str]]:
    stem = name.rpartition(".")[0]
    if re.fullmatch(_DECIMAL, stem):
        return [(0, Decimal(stem), name)]
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return [(0, Decimal(part), part) if part.isdecimal() else (1, Decimal(0), part) for part in parts]


def stamps_of(row: Layout, files: list[Path]) -> tuple[int, ...] | None:
    """Times in the names of images: where the layout has them, or where each name is a time of day."""
    pattern, unit_us = row.stamp or (_EPOCH, 1e6)
    matches = [re.search(pattern, path.stem) for path in files]
    times = [round(Decimal(match[1]) * round(unit_us)) for match in matches if match]
    good = len(times) == len(files) and all(abs(time_us) <= MOST_TIME_US for time_us in times)
    return tuple(times) if good else None


def doubtful_order(files: list[Path]) -> tuple[str, ...]:
    """Say it where the names can be read as two kinds of numbers, which order them differently."""
    matches = [re.fullmatch(r"([0-9]+)\.([0-9]+)", path.stem) for path in files]
    pairs = [(int(each[1]), int(each[2])) for each in matches if each]
    if len(pairs) < len(files) or pairs == sorted(pairs):
        return ()
    return (
        f"the names of the frames ('{files[0].name}', …) are read as decimal numbers. If they are"
        f" seconds and nanoseconds without leading zeros, that is another order: rename them.",
    )


def _read_list(root: Path, index: Path) -> tuple[list[Path], tuple[int, ...], _Colour | None]:
    """Depth images with their times, and the colour image of each, as a list of files has them.

    Colour is the other pair of an association; of ``depth.txt``, what ``rgb.txt`` has nearest in
    time. Colour images that are not there are no damage.
    """
    lines = _pairs(index)
    for number, pairs in lines:
        # Of the two pairs of an association, depth is the one whose file lies in the depth folder.
        pairs.sort(key=lambda pair: not pair[1].startswith("depth"))
        if not (file := root / pairs[0][1]).exists():
            raise DamagedRecordingError(
                f"'{file}' is missing: line {number} of '{index}' names it. Copy it again, or remove that line."
            )
    if not lines:
        raise SourceNotFoundError(_nothing_found(root))
    files, times_us = [root / pairs[0][1] for _, pairs in lines], tuple(pairs[0][0] for _, pairs in lines)
    if any(len(pairs) > 1 for _, pairs in lines):
        return files, times_us, tuple(next(_there(root, pairs[1:2]), None) for _, pairs in lines)
    if not (root / "rgb.txt").is_file():
        return files, times_us, None
    images = [image for _, pairs in _pairs(root / "rgb.txt") for image in _there(root, pairs)]
    return files, times_us, nearest_images(images, times_us)


def nearest_images(images: list[tuple[int, Path]], times_us: Sequence[int]) -> _Colour:
    """For each time the image nearest to it; None where none is of the same moment."""
    images = sorted(images)
    rising = [time_us for time_us, _ in images]
    near = [nearest(rising, time_us) for time_us in times_us]
    return tuple(None if k is None else images[k] for k in near)


def _there(root: Path, pairs: list[tuple[int, str]]) -> Iterator[tuple[int, Path]]:
    """Those of a list's files that are there."""
    return ((time_us, root / name) for time_us, name in pairs if (root / name).is_file())


def _pairs(index: Path) -> list[tuple[int, list[tuple[int, str]]]]:
    """The lines of a list, by number: one pair or two of a time in seconds and a file; '#' begins a comment."""
    lines = []
    for number, line in enumerate(read_text(index).splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            pairs = [(round(float(words[at]) * 1e6), words[at + 1]) for at in range(0, len(words), 2)]
            if any(abs(time_us) > MOST_TIME_US for time_us, _ in pairs):
                raise ValueError
        except (ValueError, OverflowError, IndexError):
            raise DamagedRecordingError(
                f"line {number} of '{index}' is {line!r:.80}; each line is a time in seconds and"
                " the name of a PNG file."
            ) from None
        for _, name in pairs:
            inside = PurePosixPath(name)
            outside = inside.is_absolute() or ".." in inside.parts or "\\" in name or ":" in name
            if outside or "\0" in name or any(len(part) > 200 for part in inside.parts):
                raise DamagedRecordingError(
                    f"line {number} of '{index}' names '{name:.80}', which is not a file's name or may lie outside the"
                    " folder; name files inside it, as in depth/0001.png."
                )
        lines.append((number, pairs))
    return lines


def _nothing_found(path: Path) -> str:
    looked = f"no depth frames in '{path}': looked for 16-bit PNG files in it and in '{path / 'depth'}'"
    for inner in sorted(path.iterdir()):
        if inner.is_dir() and (count := len(image_names(inner))):
            return f"{looked}. '{inner}' holds PNG files ({count}): give that folder."
    return f"{looked}, and for depth.txt. Give a folder that holds them."
