"""Every layout of recorded folders: depth in every pixel, camera, times, and what is said of it.

Each folder is made here from a virtual scene in the form that its publisher uses.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import OpenEXR
import pytest
from scipy.io import savemat

from selective_depth.drivers.errors import DamagedRecordingError, SourceError
from selective_depth.drivers.folder import RecordedFolder
from selective_depth.drivers.frame import Camera
from selective_depth.drivers.open import open_source

Values = npt.NDArray[np.uint16]
Save = Callable[[Path, npt.NDArray[Any]], None]
STAMPS = ("1305031102.160407", "1305031102.193707", "1305031102.227007")
STAMPS_US = [round(float(stamp) * 1e6) for stamp in STAMPS]
INTRINSICS = (577.5, 578.25, 318.75, 242.5)
MATRIX = "577.5 0 318.75 0\n0 578.25 242.5 0\n0 0 1 0\n0 0 0 1\n"
OWN = Camera(640, 480, *INTRINSICS)


@pytest.fixture(scope="module")
def scene() -> list[Values]:
    with open_source("virtual:workstation") as source:
        return [source.read().depth_mm for _ in range(3)]


def png(path: Path, values: npt.NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), values)


def npy(path: Path, values: npt.NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, values)


def swapped_pgm(path: Path, values: Values) -> None:
    """As NYU's recorder wrote: little-endian, where the format is big-endian."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"P5 640 480 65535\n" + values.astype("<u2").tobytes())


def at_scale(scale: float) -> Callable[[Values], npt.NDArray[Any]]:
    return lambda mm: np.rint(mm * (scale / 1000)).clip(0, 65535).astype(np.uint16)


def rotated(mm: Values) -> Values:
    return mm << 3 | mm >> 13


def disparities(mm: Values) -> Values:
    near = np.maximum(mm, 1)
    return np.where(mm > 0, np.rint(1092.5 - 351_300 / near), 0).astype(np.uint16)


def listing(root: Path, name: str = "depth.txt") -> None:
    pairs = [f"{stamp} depth/{stamp}.png" for stamp in STAMPS]
    if name != "depth.txt":
        pairs = [f"{stamp} rgb/{stamp}.png {pair}" for stamp, pair in zip(STAMPS, pairs, strict=True)]
    (root / name).write_text("# a list\n" + "\n".join(pairs) + "\n")


def text(name: str, content: str) -> Callable[[Path], None]:
    def write(root: Path) -> None:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(content)

    return write


def files(*makers: Callable[[Path], None]) -> Callable[[Path], None]:
    def write(root: Path) -> None:
        for make in makers:
            make(root)

    return write


def open3d(name: str) -> Callable[[Path], None]:
    by_columns = [577.5, 0, 0, 0, 578.25, 0, 318.75, 242.5, 1]
    return text(name, json.dumps({"width": 640, "height": 480, "intrinsic_matrix": by_columns}))


def beside(pattern: str) -> Callable[[Path], None]:
    return lambda root: png(root / pattern, np.zeros((480, 640, 3), np.uint8))


def meta(root: Path) -> None:
    matrix = [[577.5, 0, 318.75], [0, 578.25, 242.5], [0, 0, 1]]
    savemat(root / "000001-meta.mat", {"intrinsic_matrix": matrix, "factor_depth": 10000})


BOP = json.dumps(
    {str(n): {"cam_K": [577.5, 0, 318.75, 0, 578.25, 242.5, 0, 0, 1], "depth_scale": 0.1} for n in range(3)}
)
INFO = (
    "m_versionNumber = 4\nm_depthWidth = 640\nm_depthHeight = 480\nm_depthShift = 1000\n"
    f"m_calibrationDepthIntrinsic = {MATRIX.replace(chr(10), ' ')}\n"
)
MILLIMETRES, NOTHING = at_scale(1000), files()
FREIBURG2 = Camera(640, 480, 520.9, 521.0, 325.1, 249.7)
XTION = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
BONN = Camera(640, 480, 542.822841, 542.57687, 315.59352, 237.756098)
ICL = Camera(640, 480, 481.2, 480.0, 319.5, 239.5)
EVEN_US = [0, 33333, 66667]
NAMED_US = [0, 33369, 66738]
BY_STAMP = "depth/{stamp}.png"
NUMBERED = "depth/{number:05d}.png"


@dataclass(frozen=True)
class Row:
    layout: str
    root: str
    image: str
    camera: Camera
    code: Callable[[Values], npt.NDArray[Any]] = MILLIMETRES
    beside: Callable[[Path], None] = NOTHING
    times_us: list[int] | None = None
    save: Save = png
    within_mm: float = 0.5
    scale: str = "1000"


ROWS = [
    Row("plain", "any", "{number}.png", Camera.kinect()),
    Row("plain", "by_time", "{stamp}.png", Camera.kinect(), times_us=STAMPS_US),
    Row("TUM", "rgbd_freiburg2_x", BY_STAMP, FREIBURG2, at_scale(5000), listing, STAMPS_US, scale="5000"),
    Row("TUM", "my_room", BY_STAMP, XTION, at_scale(5000), listing, STAMPS_US, scale="5000"),
    Row(
        "TUM",
        "freiburg2_associations",
        BY_STAMP,
        FREIBURG2,
        at_scale(5000),
        lambda root: listing(root, "associations.txt"),
        STAMPS_US,
        scale="5000",
    ),
    Row(
        "ICL-NUIM",
        "living_room_traj1_frei_png",
        "depth/{number}.png",
        ICL,
        at_scale(5000),
        text("associations.txt", "".join(f"{n} depth/{n}.png {n} rgb/{n}.png\n" for n in range(3))),
        EVEN_US,
        scale="5000",
    ),
    Row("Bonn", "rgbd_bonn_balloon", BY_STAMP, BONN, at_scale(5000), listing, STAMPS_US, scale="5000"),
    Row(
        "ETH3D",
        "plant_1",
        BY_STAMP,
        OWN,
        at_scale(5000),
        files(listing, text("calibration.txt", "577.5 578.25 318.75 242.5\n")),
        STAMPS_US,
        scale="5000",
    ),
    Row("OpenLORIS", "office1-2", BY_STAMP, Camera.kinect(), beside=listing, times_us=STAMPS_US),
    Row(
        "SUN3D",
        "hotel",
        "depth/{number:07d}-{us:012d}.png",
        OWN,
        rotated,
        files(text("intrinsics.txt", "577.5 0 318.75\n0 578.25 242.5\n0 0 1\n"), beside("image/1.jpg")),
        NAMED_US,
        scale="its own",
    ),
    Row("ScanNet", "scene0000_00", "depth/{number}.png", OWN, beside=text("intrinsic/intrinsic_depth.txt", MATRIX)),
    Row(
        "BOP", "000001", "depth/{number:06d}.png", OWN, at_scale(10_000), text("scene_camera.json", BOP), scale="10000"
    ),
    Row(
        "Replica",
        "room0",
        "results/depth{number:06d}.png",
        OWN,
        at_scale(6553.5),
        text(
            "cam_params.json",
            json.dumps(
                {"camera": {"w": 640, "h": 480, "fx": 577.5, "fy": 578.25, "cx": 318.75, "cy": 242.5, "scale": 6553.5}}
            ),
        ),
        scale="6553.5",
    ),
    Row(
        "KITTI",
        "kitti",
        "proj_depth/groundtruth/image_02/{number:010d}.png",
        Camera.kinect(),
        at_scale(256),
        within_mm=2.5,
        scale="256",
    ),
    Row(
        "Virtual KITTI 2",
        "fog",
        "frames/depth/Camera_0/depth_{number:05d}.png",
        Camera.kinect(),
        at_scale(100),
        within_mm=5.5,
        scale="100",
    ),
    Row(
        "ARKitScenes",
        "41069021",
        "lowres_depth/41069021_{stamp}.png",
        OWN,
        beside=text("lowres_wide_intrinsics/41069021_0.pincam", "640 480 577.5 578.25 318.75 242.5"),
        times_us=STAMPS_US,
    ),
    Row(
        "TartanAir",
        "P001",
        "depth_left/{number:06d}_left_depth.npy",
        Camera(640, 480, 320, 320, 320, 240),
        lambda mm: (mm / 1000).astype(np.float32),
        save=npy,
        scale="metres",
    ),
    Row(
        "NYU raw",
        "kitchen",
        "d-{stamp}-29967.pgm",
        Camera(640, 480, 582.6245, 582.691, 313.0448, 238.4439),
        disparities,
        times_us=STAMPS_US,
        save=swapped_pgm,
        within_mm=60,
        scale="its own",
    ),
    Row("Open3D / RealSense", "dataset", NUMBERED, OWN, beside=open3d("camera_intrinsic.json")),
    Row("Open3D / Azure Kinect", "azure", NUMBERED, OWN, beside=open3d("intrinsic.json")),
    Row("BundleFusion", "copyroom", "frame-{number:06d}.depth.png", OWN, beside=text("info.txt", INFO)),
    Row(
        "3DMatch",
        "seq-01",
        "frame-{number:06d}.depth.png",
        OWN,
        beside=text("camera-intrinsics.txt", "577.5 0 318.75\n0 578.25 242.5\n0 0 1\n"),
    ),
    Row("7-Scenes", "chess", "frame-{number:06d}.depth.png", Camera(640, 480, 585, 585, 320, 240)),
    Row("YCB-Video", "0000", "{number:06d}-depth.png", OWN, at_scale(10_000), meta, scale="10000"),
    Row(
        "RGB-D Scenes v2",
        "scene_01",
        "{number:05d}-depth.png",
        Camera(640, 480, 570.3, 570.3, 320, 240),
        beside=beside("00000-color.png"),
    ),
    Row("RealSense rs-convert", "converted", "walk_Depth_{number:04d}.png", Camera.kinect()),
    Row("Matterport3D", "matterport_depth_images", "ab_d1_{number}.png", Camera.kinect(), at_scale(4000), scale="4000"),
    Row("Redwood", "lobby", "depth/{number:07d}-{us:012d}.png", XTION, times_us=NAMED_US),
]


def make(row: Row, folder: Path, scene: list[Values]) -> Path:
    root = folder / row.root
    for number, mm in enumerate(scene):
        name = row.image.format(number=number, stamp=STAMPS[number], us=NAMED_US[number])
        row.save(root / name, row.code(mm))
    row.beside(root)
    return root


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.layout}-{row.root}")
def test_a_layout_is_read_as_its_publisher_means_it(tmp_path: Path, scene: list[Values], row: Row) -> None:
    root = make(row, tmp_path, scene)
    inside = root / Path(row.image).parent
    for path in {root, inside}:
        with open_source(path) as folder:
            assert isinstance(folder, RecordedFolder)
            assert folder.layout == row.layout
            assert folder.camera == row.camera
            frames = list(folder)
            assert f"is read as {row.layout}: {row.scale}" in folder.about
            assert f"fx {row.camera.fx:g}" in folder.about
        assert [frame.timestamp_us for frame in frames] == (row.times_us or EVEN_US)
        for frame, mm in zip(frames, scene, strict=True):
            known = mm > 0
            off_mm = np.abs(frame.depth_mm.astype(int) - mm)[known]
            assert off_mm.max() <= row.within_mm
            assert not frame.depth_mm[~known].any()


def test_every_layout_has_a_row_here() -> None:
    from selective_depth.drivers.folder.layouts import LAYOUTS

    assert {row.layout for row in ROWS} == {layout.name for layout in LAYOUTS}


@pytest.mark.parametrize("name", ["frame-000000.depth.png", "frames/depth/Camera_0/depth_00000.png"])
def test_a_layouts_mark_of_nothing_is_nothing(tmp_path: Path, name: str) -> None:
    raw = np.full((480, 640), 300, np.uint16)
    raw[0] = 65535
    png(tmp_path / name, raw)
    with open_source(tmp_path) as folder:
        depth_mm = folder.read().depth_mm
    assert not depth_mm[0].any() and depth_mm[1:].all()


def test_millimetres_under_a_list_are_refused_until_the_scale_is_given(tmp_path: Path, scene: list[Values]) -> None:
    root = make(Row("TUM", "lab", BY_STAMP, XTION, beside=listing), tmp_path, scene)
    with pytest.raises(SourceError, match=r"scale of .*lab' is not known.*--scale 1000"):
        open_source(root)
    with open_source(f"{root}?scale=1000") as folder:
        assert "1000 values a metre (as given)" in folder.about
        np.testing.assert_array_equal(folder.read().depth_mm, scene[0])


def test_a_camera_can_be_given(tmp_path: Path, scene: list[Values]) -> None:
    root = make(ROWS[0], tmp_path, scene)
    with open_source(f"{root}?camera=577.5,578.25,318.75,242.5") as folder:
        assert folder.camera == OWN
        assert "(as given)" in folder.about
    with pytest.raises(SourceError, match=r"camera=1,2 .*fx,fy,cx,cy, each a number"):
        open_source(f"{root}?camera=1,2")


def test_intrinsics_of_another_image_are_questioned(tmp_path: Path, scene: list[Values]) -> None:
    root = make(ROWS[0], tmp_path, scene)
    (root / "intrinsics.txt").write_text("1170 0 650\n0 1170 490\n0 0 1\n")
    with open_source(root) as folder:
        assert folder.camera == Camera.kinect()
        assert "cannot be those of images of 640x480" in folder.notes[0]


@pytest.mark.parametrize("content", ["", "fx fy", "{", '{"0": 1}'])
def test_intrinsics_of_an_unknown_form_are_named(tmp_path: Path, scene: list[Values], content: str) -> None:
    root = make(ROWS[0], tmp_path, scene)
    (root / "intrinsic.json").write_text(content)
    with pytest.raises(DamagedRecordingError, match=r"intrinsic\.json' holds no intrinsics"):
        open_source(root)


def test_values_that_are_hardly_millimetres_are_questioned(tmp_path: Path, scene: list[Values]) -> None:
    root = make(Row("plain", "deci", "{number}.png", OWN, at_scale(10_000)), tmp_path, scene)
    with open_source(root) as folder:
        assert "give --scale VALUES_PER_METRE" in folder.notes[0]


def test_a_listed_image_that_is_missing_is_named(tmp_path: Path, scene: list[Values]) -> None:
    root = make(ROWS[2], tmp_path, scene)
    (root / "depth" / f"{STAMPS[1]}.png").unlink()
    with pytest.raises(DamagedRecordingError, match=rf"{STAMPS[1]}\.png' is missing: line 3"):
        open_source(root)


def test_an_image_that_git_lfs_has_not_fetched_is_named(tmp_path: Path) -> None:
    (tmp_path / "0.png").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\n")
    with pytest.raises(DamagedRecordingError, match=r"0\.png' is a Git LFS pointer.*git lfs pull"):
        open_source(tmp_path)


# Other kinds of images, and arrays


@pytest.mark.parametrize("unit", ["m", "mm"])
@pytest.mark.parametrize("name", ["{}.npy", "{}.npz", "{}.tiff"])
def test_floating_point_is_metres_or_millimetres_by_its_size(
    tmp_path: Path, scene: list[Values], name: str, unit: str
) -> None:
    for number, mm in enumerate(scene):
        values = (mm / (1000 if unit == "m" else 1)).astype(np.float32)
        values[0, 0], values[0, 1], values[0, 2] = np.nan, np.inf, -1
        path = tmp_path / name.format(number)
        if name.endswith("npz"):
            np.savez(path, depth=values, other=np.zeros(3))
        else:
            (npy if name.endswith("npy") else png)(path, values)
    with open_source(tmp_path) as folder:
        assert f"{'metres' if unit == 'm' else 'millimetres'} in floating point" in folder.about
        for frame, mm in zip(folder, scene, strict=True):
            np.testing.assert_array_equal(frame.depth_mm[1:], mm[1:])
            assert not frame.depth_mm[0, :3].any()


def test_an_exr_image_is_read(tmp_path: Path, scene: list[Values]) -> None:
    channels = {"Z": (scene[0] / 1000).astype(np.float32)}
    kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(kind, channels).write(str(tmp_path / "0.exr"))
    with open_source(tmp_path) as folder:
        np.testing.assert_array_equal(folder.read().depth_mm, scene[0])


@pytest.mark.parametrize("dtype", [np.uint16, np.int32, np.float32, np.float64])
@pytest.mark.parametrize("ending", ["npy", "npz"])
def test_an_array_of_frames_is_a_source(tmp_path: Path, scene: list[Values], ending: str, dtype: type) -> None:
    path = tmp_path / f"walk.{ending}"
    whole = np.stack(scene).astype(dtype)
    np.save(path, whole) if ending == "npy" else np.savez_compressed(path, depth_mm=whole)
    with open_source(path) as source:
        assert source.frame_count == 3
        for frame, mm in zip(source, scene, strict=True):
            np.testing.assert_array_equal(frame.depth_mm, mm)
    with open_source(f"{path}?scale=2000") as source:
        assert abs(int(source.read().depth_mm.max()) - int(scene[0].max()) / 2) <= 0.5


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY", np.zeros(3), np.zeros((2, 3), np.uint8), np.array(["a"])])
def test_an_array_that_is_no_depth_is_named(tmp_path: Path, content: Any) -> None:
    path = tmp_path / "a.npy"
    path.write_bytes(content) if isinstance(content, bytes) else np.save(path, content)
    with pytest.raises(DamagedRecordingError, match=r"a\.npy' (cannot be read|holds)"):
        open_source(path)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "empty"),
        (b"P5 2 2 255\n1234", "an 8-bit grey PPM"),
        (b"P5 640 480 65535\nshort", "damaged or cut off"),
        (b"P5", "cut off"),
        (b"P7 2 2", "not a TIFF or PPM file"),
    ],
)
def test_a_damaged_pgm_is_named(tmp_path: Path, content: bytes, says: str) -> None:
    (tmp_path / "0.pgm").write_bytes(content)
    with pytest.raises(DamagedRecordingError, match=rf"0\.pgm' is {says}"), open_source(tmp_path) as folder:
        folder.read()


# The folders that went wrong


def _rotated_mm(raw: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    bits = raw.astype(np.uint32)
    return ((bits >> 3) | ((bits << 13) & 0xFFFF)).astype(np.float64)


def _per_metre(values: float) -> Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]]:
    return lambda raw: np.rint(raw * (1000 / values))


THIRDS_US = (0, 33333, 66667)
DECIMALS_US = (1305031102160000, 1305031102200000, 1305031102243000, 1305031102300000)


@pytest.mark.parametrize(
    ("folder", "layout", "camera", "times_us", "millimetres", "coloured"),
    [
        ("icl/living_room_traj0_frei_png", "ICL-NUIM", (481.2, 480.0, 319.5, 239.5), None, _per_metre(5000), 12),
        (
            "tum_assoc_only/rgbd_dataset_freiburg3_x",
            "TUM",
            (535.4, 539.2, 320.1, 247.6),
            STAMPS_US,
            _per_metre(5000),
            3,
        ),
        ("sun3d/hotel_umd", "SUN3D", (570.342205, 570.342205, 320, 240), (0, 33333, 66666), _rotated_mm, 3),
        ("bop/000001", "BOP", (1066.8, 1067.5, 312.99, 241.3), THIRDS_US, _per_metre(10_000), 3),
        ("replica/room0", "Replica", (600, 600, 599.5, 339.5), THIRDS_US, _per_metre(6553.5), 1),
        ("kitti_dc", "KITTI", (721.5377, 721.5377, 609.5593, 172.854), THIRDS_US, _per_metre(256), 0),
        ("openloris/cafe1-1", "OpenLORIS", (585, 585, 320, 240), STAMPS_US, _per_metre(1000), 3),
        ("open3d_rs/dataset", "Open3D / RealSense", (424.6, 424.6, 423.1, 239.6), THIRDS_US, _per_metre(1000), 3),
        ("open3d_l515/dataset", "Open3D / RealSense", (458.3, 458.3, 331.2, 251.6), THIRDS_US, _per_metre(1000), 3),
        (
            "scannet/scene0000_00",
            "ScanNet",
            (577.590698, 578.729797, 318.905426, 242.683609),
            None,
            _per_metre(1000),
            4,
        ),
        (
            "eth3d/plant_scene_1",
            "ETH3D",
            (726.28741455078, 726.28741455078, 354.6496887207, 186.46566772461),
            STAMPS_US,
            _per_metre(5000),
            3,
        ),
        ("floatnames", "plain", (585, 585, 320, 240), DECIMALS_US, _per_metre(1000), 0),
        ("rgbdscenes2/scene_01", "RGB-D Scenes v2", (570.3, 570.3, 320, 240), THIRDS_US[:2], _per_metre(1000), 2),
    ],
)
def test_a_case_is_right_in_every_pixel(
    shared_cases: Path,
    folder: str,
    layout: str,
    camera: tuple[float, ...],
    times_us: tuple[int, ...] | None,
    millimetres: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]],
    coloured: int,
) -> None:
    """The raw values are decoded by OpenCV and converted by the publisher's formula, written out here."""
    with open_source(shared_cases / "folders" / folder) as source:
        assert isinstance(source, RecordedFolder)
        assert source.layout == layout
        files = source.found.files
        seen = source.camera
        frames = list(source)
    assert (seen.fx, seen.fy, seen.cx, seen.cy) == pytest.approx(camera)
    assert len(frames) == len(files)
    if times_us is None:
        times_us = tuple(round(k * 1e6 / 30) for k in range(len(frames)))
    assert tuple(frame.timestamp_us for frame in frames) == tuple(times_us)
    for frame, file in zip(frames, files, strict=True):
        raw = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        assert raw is not None and raw.dtype == np.uint16
        wanted = millimetres(raw.astype(np.float64))
        wanted[wanted > 65535] = 0
        np.testing.assert_array_equal(frame.depth_mm, wanted)
    assert sum(frame.colour is not None for frame in frames) == coloured
    # All were made of the same three frames, some resized.
    for frame, median_mm in zip(frames, (1917, 1930, 1943), strict=False):
        assert abs(np.median(frame.depth_mm[frame.depth_mm > 0]) - median_mm) < 60


def test_the_case_with_a_missing_file_names_it(shared_cases: Path) -> None:
    with pytest.raises(DamagedRecordingError, match=r"193707\.png' is missing"):
        open_source(shared_cases / "folders/tum_partial/rgbd_dataset_freiburg1_desk")
