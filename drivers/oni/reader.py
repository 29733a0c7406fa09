"""Replay of .oni files without OpenNI2."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

from selective_depth.drivers.colour import ON, Colouring
from selective_depth.drivers.errors import DamagedRecordingError, SourceEndedError, SourceError
from selective_depth.drivers.frame import Camera, DepthArray, DepthFrame, handed_over
from selective_depth.drivers.oni.codec import decode_depth
from selective_depth.drivers.oni.colour import OniColour
from selective_depth.drivers.oni.files import open_regular, read_payload
from selective_depth.drivers.oni.form import Sides, turned_at, upright
from selective_depth.drivers.oni.inspection import inspect_oni, rescuable
from selective_depth.drivers.oni.nodes import OniFrame
from selective_depth.drivers.oni.report import OniReport
from selective_depth.drivers.source import DepthSource


class OniReader(DepthSource):
    """The depth frames of an .oni file, each exactly once, decoded here.

    Delivers what was recorded, bit by bit, needs no runtime and runs no native code on the file.
    A damaged file is read up to the damage; a recording whose recorder was killed is read to its
    last whole frame, and `notes` says so.

    Parameters
    ----------
    path : str or Path
        The recording.
    stream : int, default 1
        Which depth stream, from 1.
    intrinsics : (float, float, float, float), optional
        fx, fy, cx, cy in pixels; default as recorded, or from the recorded field of view.
    colouring : Colouring, optional
        What is known of its colour; default what is recorded.
    salvage : bool, default False
        Deliver what can be decoded beyond damage too. All of it is decoded first to find out.

    Attributes
    ----------
    report : OniReport
        What was found in the file.

    Raises
    ------
    SourceNotFoundError
        If there is no such file.
    DamagedRecordingError
        If it is not a recording, or no frame comes before the damage.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        stream: int = 1,
        intrinsics: tuple[float, ...] | None = None,
        colouring: Colouring = ON,
        salvage: bool = False,
    ) -> None:
        self.uri = str(path)
        self.report = rescuable(path, stream) if salvage else inspect_oni(path, stream=stream)
        if self.report.unsupported:
            raise SourceError(f"'{path}' cannot be read: {self.report.unsupported}.")
        if self.report.problems:
            self.notes = (
                f"'{path}' is not whole ({self.report.problems[0]}); `selective-depth check` says"
                " more, and saves what can be saved with --repair.",
            )
        if self.report.damage is not None:
            self.damage = self.notes[0]
        self.notes += tuple(f"'{path}': {note}." for note in self.report.notes)
        self._frames, self._damage = (self.report.frames, None) if salvage else _trusted_frames(self.report)
        if self._damage is not None and not self._frames:
            raise DamagedRecordingError(self._sentence(self._damage))
        if not self._frames or self.report.depth is None or self.report.camera is None:
            raise DamagedRecordingError(f"'{path}' holds no depth frames; was it ever recorded to?")
        self.camera = camera = self.report.camera
        if intrinsics is not None:
            self.camera = Camera(camera.width, camera.height, *intrinsics)
        self.fps = self.report.fps
        self.frame_count = len(self._frames)
        self._colour, self._colouring = OniColour(self.report.nodes), colouring
        if colouring.wanted and self._colour.unsupported:
            self.notes += (f"'{path}': {self._colour.unsupported}.",)
        self._sides = Sides()
        self._next = 0
        self._file: BinaryIO | None = open_regular(self.report.path)

    def read(self, timeout_s: float = 5.0) -> DepthFrame:
        """Return the next frame; `timeout_s` does not matter, a file does not keep one waiting.

        Raises
        ------
        SourceEndedError
            After the last frame.
        DamagedRecordingError
            Where the file is damaged; frames already delivered are good.
        """
        self.check_process()
        if self._file is None:
            raise SourceEndedError(f"'{self.uri}' has been closed.")
        if self._next == len(self._frames):
            if self._damage is not None:
                raise DamagedRecordingError(self._sentence(self._damage))
            raise SourceEndedError(f"'{self.uri}' has ended after {self._next} frames.")
        frame = self._frames[self._next]
        depth_mm = read_depth(self.report, self._file, frame)
        if depth_mm is None:
            self._frames = self._frames[: self._next]
            self._damage = f"byte {frame.record_offset}: frame {frame.number} cannot be decoded"
            raise DamagedRecordingError(self._sentence(self._damage))
        turns = self._sides.turns
        depth_mm = self._sides.put_right(depth_mm)
        if self._sides.turns > turns == 0:
            self.notes += (f"'{self.uri}' {turned_at(frame.number)}",)
        whole = DepthFrame(handed_over(depth_mm), self._next, frame.timestamp_us, self.camera, self.uri)
        self._next += 1
        return self._colour.on(self._file, whole, self._colouring)

    def close(self) -> None:
        """Close the file. Harmless when called twice."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _sentence(self, damage: str) -> str:
        count = len(self._frames)
        what = f"cannot be read beyond frame {count}" if count else "has no readable frame"
        return f"'{self.uri}' {what} ({damage}). `selective-depth check` says what can be saved."


def read_depth(report: OniReport, file: BinaryIO, frame: OniFrame) -> DepthArray | None:
    """A frame of a report's depth in millimetres and the right way round; None if damaged."""
    assert report.depth is not None and report.camera is not None
    payload = read_payload(file, frame)
    raw = decode_depth(report.depth.codec, payload, report.camera.height, report.camera.width)
    return None if raw is None else upright(raw, report.tenths, frame.mirrored)


def _trusted_frames(report: OniReport) -> tuple[list[OniFrame], str | None]:
    """Frames before the first damage, and what that is; None if nothing in them is damaged.

    A file that was cut, or whose recorder was killed, has no END mark and no frame beyond what is
    wrong with it: what is there is good.
    """
    damage = report.damage
    if damage is None:
        return report.frames, None
    before = [frame for frame in report.frames if frame.record_offset < damage.offset]
    cut = not report.ended and 0 < len(before) == report.readable_frames
    return before, None if cut else str(damage)
