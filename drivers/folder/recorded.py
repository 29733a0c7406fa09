"""Recorded folders: depth frames as image files, in the layouts of `layouts`, read.

What the values mean is said by, in this order: an option of the source, the sidecar
``frames.toml``, a file of intrinsics beside the frames, the layout. The sidecar names no files, so
it cannot lead outside the folder.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.colour import ON, Colouring
from selective_depth.drivers.errors import DamagedRecordingError, SourceEndedError, SourceError, SourceTimeoutError
from selective_depth.drivers.folder.cameras import CameraFile, find_camera_file
from selective_depth.drivers.folder.colours import Colours
from selective_depth.drivers.folder.images import damaged, read_raw, read_size, read_stack
from selective_depth.drivers.folder.layouts import ARRAYS, Found, doubtful_order, find_layout
from selective_depth.drivers.folder.sidecar import MILLIMETRES, SIDECAR, Sidecar, read_sidecar
from selective_depth.drivers.frame import Camera, DepthArray, DepthFrame, handed_over, millimetres
from selective_depth.drivers.source import DEFAULT_FPS, DepthSource

_LOOKS: Final = 5
"""Frames that are looked at before a scale that is merely usual is believed."""
_NEAREST_M, _NEAR_M = 0.4, 0.8
"""A twentieth of the pixels nearer than the first, or half nearer than the second: no room that a
Kinect sees, but millimetres read at 5000 a metre."""
_FAR_M: Final = 15.0
"""Beyond it lies no half of a room in millimetres; said, not refused."""
_FARTHEST_M: Final = 100.0
"""No sensor's frame has half of its pixels beyond it: floating-point millimetres."""


class RecordedFolder(DepthSource):
    """Depth frames of a folder, each exactly once, in the natural order of their names.

    Every file's header is checked at once, so that a wrong file is named before the first frame;
    the frames themselves are decoded one ahead of the reader.

    Parameters
    ----------
    path : str or Path
        A folder of depth images in one of the layouts of `layouts`, or one .npy or .npz file.
    values_per_metre : float, optional
        Scale of the images; default as the sidecar, a file beside or the layout says.
    intrinsics : (float, float, float, float), optional
        fx, fy, cx, cy in pixels; default likewise, and else a Kinect's.
    colouring : Colouring, optional
        What is known of its colour images; default what sidecar and layout say.

    Attributes
    ----------
    layout : str
        Name of the layout, as ``plain``, ``TUM`` or ``7-Scenes``.
    found : Found
        The layout's row, its root and the depth images.

    Raises
    ------
    SourceNotFoundError
        If there is no folder, or no depth frame in it.
    DamagedRecordingError
        If a file is not a depth image, the sizes differ, or the sidecar is wrong.
    SourceError
        If the scale cannot be known.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        values_per_metre: float | None = None,
        intrinsics: tuple[float, ...] | None = None,
        colouring: Colouring = ON,
    ) -> None:
        self.uri = str(path)
        path = Path(path)
        self._stack = read_stack(path) if path.is_file() else None
        if self._stack is None:
            self.found = find_layout(path)
            inside = self.found.files[0].parent
            side = next((f for f in (self.found.root, inside) if (f / SIDECAR).exists()), path)
            sidecar, beside = read_sidecar(side), find_camera_file(self.found.root)
        else:
            self.found = Found(ARRAYS, path.parent, [path] * len(self._stack))
            sidecar, beside = Sidecar(), CameraFile(path)
        self.layout = self.found.row.name
        self.notes = doubtful_order(self.found.files)
        self.frame_count = len(self.found.files)
        shape = _shape_of(self.found.files, sidecar.camera) if self._stack is None else self._stack.shape[1:]
        self.camera, camera_from = self._camera(shape, intrinsics, sidecar.camera, beside)
        self._timestamps_us = sidecar.timestamps_us or self.found.timestamps_us
        for name, times in (("", self._timestamps_us), ("colour_", sidecar.colour_timestamps_us)):
            if times is not None and len(times) != self.frame_count:
                what = f"holds {self.frame_count} frames, but {SIDECAR} lists {len(times)} {name}timestamps"
                raise damaged(path, what, "correct the list or remove it")
        self.fps = sidecar.fps or _fps_from(self._timestamps_us)
        marks = self.found.row.marks if sidecar.missing is None else sidecar.missing
        scales = (
            (values_per_metre, "as given"),
            (sidecar.values_per_metre, SIDECAR),
            (beside.values_per_metre, beside.path.name),
        )
        said, where = next((each for each in scales if each[0] is not None), (None, ""))
        self._convert, scale = self._conversion(said, where, marks)
        self._colours = Colours(self.found, sidecar, colouring, self._timestamps_us)
        self.notes += tuple(f"'{self.uri}': {note}" for note in self._colours.notes)
        self.about = self.read_as(self.layout, scale, camera_from, self._colours.about)
        self._colour_trouble = False
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
        except TimeoutError:
            self._ahead = ahead
            raise SourceTimeoutError(
                f"'{self.found.files[self._next]}' was not read within {timeout_s:g} s; is its disk or network"
                " share there?"
            ) from None
        self._next += 1
        more = self._next < len(self.found.files)
        self._ahead = self._reader.submit(self._load, self._next) if more else None
        return frame

    def skip(self, frames: int) -> None:
        """Leave out frames without looking at them."""
        if frames:
            self._ahead = None  # it is read, and nobody asks for it
        self._next = min(self._next + frames, len(self.found.files))

    def close(self) -> None:
        """Stop reading ahead."""
        self._closed = True
        self._reader.shutdown(wait=False, cancel_futures=True)

    def _load(self, index: int) -> DepthFrame:
        raw = self._raw(index)
        shape = self.camera.height, self.camera.width
        if raw.shape != shape:
            # The header was right when the folder was opened: the file has changed since.
            raise _size_error(self.found.files[index], raw.shape, shape)
        timestamp_us = self._timestamps_us[index] if self._timestamps_us else round(index * 1e6 / self.fps)
        depth_mm = handed_over(self._convert(raw))
        frame, trouble = self._colours.on(DepthFrame(depth_mm, index, timestamp_us, self.camera, self.uri))
        if trouble and not self._colour_trouble:  # said once
            self._colour_trouble = True
            self.notes += (trouble,)
        return frame

    def _raw(self, index: int) -> npt.NDArray[Any]:
        return read_raw(self.found.files[index]) if self._stack is None else self._stack[index]

    def _camera(
        self, shape: tuple[int, ...], given: tuple[float, ...] | None, sidecar: Camera | None, beside: CameraFile
    ) -> tuple[Camera, str]:
        """The camera, and where it comes from."""
        height, width = shape
        known = self.found.row.camera
        if given is not None:
            return Camera(width, height, *given), "as given"
        if sidecar is not None:
            return sidecar, SIDECAR
        if beside.intrinsics is not None:
            if camera := beside.camera(width, height):
                if beside.varies:
                    self.notes += (
                        f"'{beside.path}' has different intrinsics for different frames; the first are used for all.",
                    )
                return camera, beside.path.name
            self.notes += (
                f"the intrinsics in '{beside.path}' cannot be those of images of {width}x{height}"
                " pixels and are not used; give --camera fx,fy,cx,cy if you know them.",
            )
        if known is not None and (known.width, known.height) == (width, height):
            return known, f"the {self.layout} layout's"
        # A known layout at an unusual size: its camera was calibrated for another.
        return Camera.kinect(width, height), "assumed, a Kinect's"

    def _conversion(
        self, said: float | None, where: str, marks: tuple[int, ...]
    ) -> tuple[Callable[[npt.NDArray[Any]], DepthArray], str]:
        """How raw values become millimetres, and that in words.

        Raises
        ------
        SourceError
            If the scale is merely the usual one, and what it makes of the frames is impossible.
        """
        row = self.found.row
        png = self._stack is None and self.found.files[0].suffix.lower() == ".png"
        kind = np.dtype(np.uint16) if png else self._raw(0).dtype
        floating = kind.kind == "f"
        seen = self._look() if said is None and (row.assumed or floating) else np.empty(0)
        coding = None
        if said is not None:
            scale = said
        elif floating:
            scale = MILLIMETRES if seen.size and np.median(seen) > _FARTHEST_M else 1.0
            where = "told by their size"
        else:
            scale, coding = row.values_per_metre, row.convert
            where = "assumed" if row.assumed else f"the {row.name} layout's"
        if floating:
            names = {1.0: "metres", MILLIMETRES: "millimetres"}
            words = f"{names.get(scale, f'{scale:g} values a metre')} in floating point ({where})"
        elif coding is not None:
            words = f"its own coding of millimetres ({where})"
        else:
            words = f"{scale:g} values a metre ({where})"
            if seen.size:
                self._doubt(seen / scale, scale)
        if kind != np.uint16:
            return lambda raw: millimetres(raw, scale, marks), words
        values = np.arange(65536, dtype=np.float64)
        table = millimetres(coding(values) if coding else values, scale)
        table[list(marks)] = 0
        if np.array_equal(table, values):
            return lambda raw: raw, words  # millimetres as they stand
        return lambda raw: table[raw], words

    def _look(self) -> npt.NDArray[Any]:
        """What some frames measured; those that are damaged say so when they are read."""
        seen = [np.empty(0)]
        for index in range(0, len(self.found.files), len(self.found.files) // _LOOKS + 1):
            with suppress(DamagedRecordingError):
                raw = self._raw(index)
                seen.append(raw[np.isfinite(raw) & (raw > 0)])
        return np.concatenate(seen)

    def _doubt(self, seen_m: npt.NDArray[np.float64], scale: float) -> None:
        near_m, median_m = np.percentile(seen_m, (5, 50))
        if scale == MILLIMETRES:
            if median_m > _FAR_M:
                self.notes += (
                    f"half of what '{self.uri}' shows is beyond {median_m:.3g} m, if its values are"
                    " millimetres, as is assumed. If they are not, give --scale VALUES_PER_METRE.",
                )
        elif near_m < _NEAREST_M or median_m < _NEAR_M:
            raise SourceError(
                f"the scale of '{self.uri}' is not known: at {scale:g} values a metre, usual"
                f" for its layout, half of it would be nearer than {median_m:.2g} m. Give --scale"
                f" 1000 if its values are millimetres, or --scale {scale:g} if it really is that near."
            )


def _shape_of(files: list[Path], stated: Camera | None) -> tuple[int, int]:
    """Height and width, after checking the header of every file."""
    first = (stated.height, stated.width) if stated else read_size(files[0])
    for path in files:
        if path.suffix.lower() == ".png" or path is files[0]:
            shape = read_size(path)
            if shape != first:
                raise _size_error(path, shape, first)
    return first


def _size_error(path: Path, shape: tuple[int, ...], others: tuple[int, int]) -> DamagedRecordingError:
    what = f"is {shape[1]}x{shape[0]} pixels, but this recording is {others[1]}x{others[0]}"
    return damaged(path, what, f"keep frames of one size in a folder, and correct {SIDECAR} if it has one")


def _fps_from(timestamps_us: tuple[int, ...] | None) -> float:
    """Frame rate from the median distance of the timestamps, 30 where they say nothing."""
    if timestamps_us is None or len(timestamps_us) < 2:
        return DEFAULT_FPS
    step_us = float(np.median(np.diff(np.asarray(timestamps_us, dtype=np.float64))))
    return round(1e6 / step_us, 3) if 1e3 <= step_us <= 1e9 else DEFAULT_FPS
