"""What is known of an .oni file after looking at it: its streams, its frames, its problems."""

from __future__ import annotations

from bisect import insort
from dataclasses import dataclass, field
from pathlib import Path

from selective_depth.drivers.frame import Camera
from selective_depth.drivers.oni.nodes import OniFrame, OniNode


@dataclass(frozen=True, slots=True)
class OniProblem:
    """Something wrong in a file.

    Parameters
    ----------
    offset : int
        Where, in bytes from the beginning.
    sentence : str
        What.
    harmless : bool
        True if OpenNI2 replays the file all the same, as far as it goes.
    """

    offset: int
    sentence: str
    harmless: bool = False

    def __str__(self) -> str:
        return f"byte {self.offset}: {self.sentence}"


@dataclass
class OniReport:
    """What an .oni file holds and what is wrong with it, filled in by `inspect_oni`.

    Parameters
    ----------
    path : Path
        The file.
    size_bytes : int
        Its length.
    version : str
        Version of the format, as "1.0.1.0"; empty if the header is broken.
    old : bool
        True for versions before 1.0.1.0.
    nodes : tuple of OniNode
        Everything that was recorded, in the file's order.
    depth : OniNode or None
        The depth stream; its `frames` are the readable ones.
    camera : Camera or None
        Intrinsics of the depth frames from the recorded field of view (a Kinect's where there is
        none); its size is theirs, cropped as they are. None if the frame size is unknown.
    fps : float
        Recorded frame rate.
    tenths : bool
        True if the stored depth is in tenths of millimetres.
    unsupported : str
        Why a file that is in order cannot be read; empty if it can.
    notes : tuple of str
        What is done to the frames, or else worth knowing, though nothing is wrong.
    problems : list of OniProblem
        By offset; empty if nothing is wrong.
    end_offset : int or None
        Where its last record ends; None if its recorder never closed it.
    decoded_frames : int
        Number of depth frames that were also decoded, not only found.
    swapped_frames : int
        Number of these in which OpenNI2's recorder swapped the last pixels, so that its player
        shows up to 28 wrong ones (see `codec`). They are read rightly here.
    """

    path: Path
    size_bytes: int
    version: str = ""
    old: bool = False
    nodes: tuple[OniNode, ...] = ()
    depth: OniNode | None = None
    camera: Camera | None = None
    fps: float = 30.0
    tenths: bool = False
    unsupported: str = ""
    notes: tuple[str, ...] = ()
    problems: list[OniProblem] = field(default_factory=list)
    end_offset: int | None = None
    decoded_frames: int = 0
    swapped_frames: int = 0

    def problem(self, offset: int, sentence: str, *, harmless: bool = False) -> None:
        """Add something that is wrong."""
        insort(self.problems, OniProblem(offset, sentence, harmless), key=lambda each: each.offset)

    @property
    def frames(self) -> list[OniFrame]:
        """The readable depth frames."""
        return self.depth.frames if self.depth is not None else []

    @property
    def readable_frames(self) -> int:
        """Number of depth frames that are all there."""
        return len(self.frames)

    @property
    def damage(self) -> OniProblem | None:
        """The first problem that is not harmless, None if there is none."""
        return next((problem for problem in self.problems if not problem.harmless), None)

    @property
    def ended(self) -> bool:
        """True if the recorder closed the file."""
        return self.end_offset is not None

    @property
    def tail_bytes(self) -> int:
        """Bytes after the end, which OpenNI2's recorder leaves as zeros."""
        return 0 if self.end_offset is None else self.size_bytes - self.end_offset

    @property
    def complete(self) -> bool:
        """True if nothing is wrong with the file."""
        return self.ended and not self.problems and self.readable_frames > 0

    @property
    def as_stored(self) -> bool:
        """True if frames are delivered as they are stored: same side, unit and size."""
        crop = (self.depth.values_of("xnCropping", "<IHHHH") if self.depth else None) or (0,)
        return not (self.tenths or crop[0] or any(frame.mirrored for frame in self.frames))

    @property
    def openable(self) -> bool:
        """True if OpenNI2's player can be given the file: it delivers `readable_frames`."""
        return self.readable_frames > 0 and self.damage is None

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last readable depth frame."""
        times_us = [frame.timestamp_us for frame in self.frames]
        return (times_us[-1] - times_us[0]) / 1e6 if times_us else 0.0
