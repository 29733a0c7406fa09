"""Recorded folders: depth frames as 16-bit PNG files, read.

Four layouts are known by their file names. Values per metre, cameras and the mark of a missing
measurement are those that the publishers state:

======== ============================ =============== =========================================
layout   files                        values a metre  camera at 640x480
======== ============================ =============== =========================================
plain    ``*.png``                    1000            a Kinect's (`Camera.kinect`)
TUM      ``depth.txt``, ``depth/``    5000            by sequence: freiburg1, 2, 3; else 525
7-Scenes ``frame-*.depth.png``        1000            585, 585, 320, 240; 65535 = missing
Redwood  ``depth/*.png``              1000            525, 525, 319.5, 239.5
======== ============================ =============== =========================================

A sidecar, ``frames.toml`` in the folder, overrides what the layout means. It names no files, so
it cannot lead outside the folder.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeoutError
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path, PurePosixPath
from typing import Final

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.errors import (
    DamagedRecordingError,
    SourceEndedError,
    SourceNotFoundError,
    SourceTimeoutError,
)
from selective_depth.drivers.folder.images import read_png, read_png_size
from selective_depth.drivers.folder.sidecar import SIDECAR, Sidecar, read_sidecar, read_text
from selective_depth.drivers.frame import Camera, DepthArray, DepthFrame
from selective_depth.drivers.source import DepthSource

_MILLIMETRES: Final = 1000.0
_TUM_SCALE: Final = 5000.0
_DEFAULT_FPS: Final = 30.0
_TUM_CAMERAS: Final = {
    "1": Camera(640, 480, 517.3, 516.5, 318.6, 255.3),
    "2": Camera(640, 480, 520.9, 521.0, 325.1, 249.7),
    "3": Camera(640, 480, 535.4, 539.2, 320.1, 247.6),
}
_PRIMESENSE: Final = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
_SEVEN_SCENES: Final = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)


_DECIMAL: Final = r"[0-9]{1,30}\.[0-9]{1,30}"
"""A file name that is one number: a time, as a rule."""


@dataclass(frozen=True)
class _Layout:
    """What was found in a folder, and what its kind of layout means."""

    name: str
    files: list[Path]
    means: Sidecar = field(default_factory=Sidecar)


class RecordedFolder(DepthSource):
    """Depth frames of a folder, each exactly once, in the natural order of their names.

    Every file's header is checked at once, so that a wrong file is named before the first frame;
    the frames themselves are decoded one ahead of the reader.

    Parameters
    ----------
    path : str or Path
        A folder of 16-bit grey PNG files in one of the layouts above.

    Attributes
    ----------
    layout : str
        ``plain``, ``TUM``, ``7-Scenes`` or ``Redwood``.

    Raises
    ------
    SourceNotFoundError
        If there is no folder, or no depth frame in it.
    DamagedRecordingError
        If a file is no 16-bit grey PNG, the sizes differ, or the sidecar is wrong.
    """

    live = False

    def __init__(self, path: str | Path) -> None:
        self.uri = str(path)
        folder = _root_of(Path(path))
        layout = _find_layout(folder)
        sidecar = read_sidecar(folder)
        settings = sidecar.over(layout.means)
        self.layout = layout.name
        self._files = layout.files
        self.notes = _doubtful_order(layout.files)
        self.frame_count = len(layout.files)
        self.dropped = 0
        self.camera = _camera_of(layout, sidecar.camera)
        self._timestamps_us = settings.timestamps_us
        if self._timestamps_us is not None and len(self._timestamps_us) != self.frame_count:
            raise DamagedRecordingError(
                f"'{path}' holds {self.frame_count} frames, but {SIDECAR} lists"
                f" {len(self._timestamps_us)} timestamps; correct the list or remove it."
            )
        self.fps = settings.fps or _fps_from(self._timestamps_us)
        self._to_mm = _millimetre_table(
            settings.values_per_metre or _MILLIMETRES, settings.missing or ()
        )
        self._next = 0
        self._ahead: Future[DepthFrame] | None = None
        self._reader = ThreadPoolExecutor(max_workers=1, thread_name_prefix="png-reader")
        self._closed = False

    def read(self, timeout_s: float = 5.0) -> DepthFrame:
        """Return the next frame; see `DepthSource.read`."""
        self.check_process()
        if self._closed:
            raise SourceEndedError(f"'{self.uri}' was closed; open it again to read it again.")
        if self._next == self.frame_count:
            raise SourceEndedError(f"'{self.uri}' has ended after frame {self._next}.")
        ahead = self._ahead or self._reader.submit(self._load, self._next)
        try:
            frame = ahead.result(timeout_s)
        except FutureTimeoutError:
            self._ahead = ahead
            raise SourceTimeoutError(
                f"'{self._files[self._next]}' was not read within {timeout_s:g} s; is its disk or"
                " network share there?"
            ) from None
        self._next += 1
        more = self._next < len(self._files)
        self._ahead = self._reader.submit(self._load, self._next) if more else None
        return frame

    def close(self) -> None:
        """Stop reading ahead."""
        self._closed = True
        self._reader.shutdown(wait=False, cancel_futures=True)

    def _load(self, index: int) -> DepthFrame:
        path = self._files[index]
        raw = read_png(path)
        if raw.shape != (self.camera.height, self.camera.width):
            # The header was right when the folder was opened: the file has changed since.
            raise _size_error(path, raw.shape, self.camera)
        if self._timestamps_us is None:
            timestamp_us = round(index * 1e6 / self.fps)
        else:
            timestamp_us = self._timestamps_us[index]
        depth_mm = raw if self._to_mm is None else self._to_mm[raw]
        depth_mm.flags.writeable = False  # handed over: the frame need not copy it
        return DepthFrame(depth_mm, index, timestamp_us, self.camera, self.uri)


def _root_of(path: Path) -> Path:
    if not path.is_dir():
        raise SourceNotFoundError(f"the folder '{path}' does not exist; check its name.")
    # The inner folder of a TUM sequence has another scale than its PNG files tell.
    if path.name == "depth" and (path.parent / "depth.txt").is_file():
        return path.parent
    return path


def _find_layout(folder: Path) -> _Layout:
    names = _png_names(folder)
    if (folder / "depth.txt").is_file():
        layout = _tum_layout(folder)
    elif scenes := [name for name in names if name.endswith(".depth.png")]:
        means = Sidecar(camera=_SEVEN_SCENES, missing=(65535,))
        layout = _Layout("7-Scenes", [folder / name for name in scenes], means)
    elif not names and (inner := _png_names(folder / "depth")):
        layout = _redwood_layout(folder / "depth", inner)
    else:
        layout = _Layout("plain", [folder / name for name in names])
    if not layout.files:
        raise SourceNotFoundError(_nothing_found(folder))
    return layout


def _png_names(folder: Path) -> list[str]:
    """PNG files of a folder in natural order: 2 before 10."""
    if not folder.is_dir():
        return []
    try:
        names = [entry.name for entry in folder.iterdir() if entry.suffix.lower() == ".png"]
    except OSError as error:
        raise SourceNotFoundError(
            f"the folder '{folder}' cannot be read ({error.strerror}); check its permissions."
        ) from error
    return sorted((name for name in names if not name.startswith(".")), key=_natural_key)


def _natural_key(name: str) -> list[tuple[int, Decimal, str]]:
    stem = name.rpartition(".")[0]
    if re.fullmatch(_DECIMAL, stem):
        return [(0, Decimal(stem), name)]
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return [
        (0, Decimal(part), part) if part.isdecimal() else (1, Decimal(0), part) for part in parts
    ]


def _doubtful_order(files: list[Path]) -> tuple[str, ...]:
    """Say it where the names can be read as two kinds of numbers, which order them differently."""
    matches = [re.fullmatch(r"([0-9]+)\.([0-9]+)", path.stem) for path in files]
    pairs = [(int(each[1]), int(each[2])) for each in matches if each]
    if len(pairs) < len(files) or pairs == sorted(pairs):
        return ()
    return (
        f"the names of the frames ('{files[0].name}', …) are read as decimal numbers. If they are"
        f" seconds and nanoseconds without leading zeros, that is another order: rename them.",
    )


def _tum_layout(path: Path) -> _Layout:
    """Read ``depth.txt``: lines of a timestamp in seconds and a file, '#' begins a comment."""
    index = path / "depth.txt"
    files, timestamps_us = [], []
    for number, line in enumerate(read_text(index).splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            seconds, name = words
            timestamp_us = round(float(seconds) * 1e6)
        except (ValueError, OverflowError):
            raise DamagedRecordingError(
                f"line {number} of '{index}' is {line!r:.80}; each line is a time in seconds and"
                " the name of a PNG file."
            ) from None
        inside = PurePosixPath(name)
        if inside.is_absolute() or ".." in inside.parts or "\\" in name or ":" in name:
            raise DamagedRecordingError(
                f"line {number} of '{index}' names '{name:.80}', which may lie outside of the"
                " folder; name files inside it, as in depth/0001.png."
            )
        files.append(path / inside)
        timestamps_us.append(timestamp_us)
    known = re.search(r"freiburg([123])", path.resolve().name)
    camera = _TUM_CAMERAS[known[1]] if known else _PRIMESENSE
    means = Sidecar(_TUM_SCALE, camera, timestamps_us=tuple(timestamps_us))
    return _Layout("TUM", files, means)


def _redwood_layout(folder: Path, names: list[str]) -> _Layout:
    """Redwood's names are ``<frame>-<microseconds>.png`` or plain numbers."""
    stamps = [re.fullmatch(r"[0-9]+-([0-9]{1,15})\.png", name) for name in names]
    timestamps_us = tuple(int(stamp[1]) for stamp in stamps if stamp)
    means = Sidecar(
        camera=_PRIMESENSE,
        timestamps_us=timestamps_us if len(timestamps_us) == len(names) else None,
    )
    return _Layout("Redwood", [folder / name for name in names], means)


def _nothing_found(path: Path) -> str:
    looked = (
        f"no depth frames in '{path}': looked for 16-bit PNG files in it and in '{path / 'depth'}'"
    )
    for inner in sorted(path.iterdir()):
        if inner.is_dir() and (count := len(_png_names(inner))):
            return f"{looked}. '{inner}' holds PNG files ({count}): give that folder."
    return f"{looked}, and for depth.txt. Give a folder that holds them."


def _camera_of(layout: _Layout, stated: Camera | None) -> Camera:
    """The camera of a folder, after checking the header of every file against it."""
    height, width = read_png_size(layout.files[0])
    camera = stated or layout.means.camera
    # A known layout at an unusual size: its camera was calibrated for 640x480.
    if camera is None or (stated is None and (camera.height, camera.width) != (height, width)):
        camera = Camera.kinect(width, height)
    for path in layout.files:
        shape = read_png_size(path)
        if shape != (camera.height, camera.width):
            raise _size_error(path, shape, camera)
    return camera


def _size_error(path: Path, shape: tuple[int, ...], camera: Camera) -> DamagedRecordingError:
    return DamagedRecordingError(
        f"'{path}' is {shape[1]}x{shape[0]} pixels, but this recording is {camera.width}x"
        f"{camera.height}; keep frames of one size in a folder, and correct {SIDECAR} if it has"
        " one."
    )


def _fps_from(timestamps_us: tuple[int, ...] | None) -> float:
    """Frame rate from the median distance of the timestamps, 30 where they say nothing."""
    if timestamps_us is None or len(timestamps_us) < 2:
        return _DEFAULT_FPS
    step_us = float(np.median(np.diff(np.asarray(timestamps_us, dtype=np.float64))))
    return round(1e6 / step_us, 3) if 1e3 <= step_us <= 1e9 else _DEFAULT_FPS


def _millimetre_table(
    values_per_metre: float, missing: Iterable[int]
) -> npt.NDArray[np.uint16] | None:
    """Millimetres of each PNG value; None where the values are millimetres as they stand.

    Values beyond 65,535 mm cannot be held and become 0, no measurement.
    """
    values = np.arange(65536, dtype=np.float64)
    depth_mm = np.rint(values * (_MILLIMETRES / values_per_metre))
    depth_mm[depth_mm > 65535] = 0
    depth_mm[list(missing)] = 0
    if np.array_equal(depth_mm, values):
        return None
    table: DepthArray = depth_mm.astype(np.uint16)
    return table
