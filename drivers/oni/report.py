"""What is known of an .oni file after looking at it: its streams, its frames, its problems."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from selective_depth.drivers.frame import Camera
from selective_depth.drivers.oni.records import Kind, NodeType

STREAMS: Final = frozenset((NodeType.DEPTH, NodeType.IMAGE, NodeType.IR))
CAMERA: Final = "selectiveDepthCamera"
"""Our own property: fx, fy, cx, cy of a stream, since a field of view tells no principal point."""
REGISTERED: Final = "selectiveDepthRegistered"
"""Our own property of a depth stream: 1 if colour lies on it. OpenNI2's player steps over both."""


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


@dataclass(frozen=True, slots=True)
class OniFrame:
    """One frame of a node: its place in the file, its number (from 1) and its time."""

    number: int
    timestamp_us: int
    record_offset: int
    payload_offset: int
    payload_size: int
    mirrored: bool = False


@dataclass
class OniNode:
    """One stream (or the device) of a recording."""

    number: int
    name: str
    node_type: int
    codec: bytes
    declared_frames: int | None
    seek_table_offset: int
    offset: int
    properties: dict[str, tuple[Kind, bytes]] = field(default_factory=dict)
    frames: list[OniFrame] = field(default_factory=list)
    ready: bool = False
    removed: bool = False
    has_seek_table: bool = False
    changed: bool = False

    @property
    def is_stream(self) -> bool:
        """True if the node delivers frames."""
        return self.node_type in STREAMS

    def number_of(self, name: str) -> int | None:
        """Value of a whole-number property, None if it is not there."""
        kind, value = self.properties.get(name, (None, b""))
        return int.from_bytes(value, "little") if kind is Kind.INT_PROPERTY else None

    def values_of(self, name: str, form: str) -> tuple[float, ...] | None:
        """Values of a structured property, None if it is not there or has another size."""
        value = self.properties.get(name, (None, b""))[1]
        return struct.unpack(form, value) if len(value) == struct.calcsize(form) else None


@dataclass(frozen=True)
class OniReport:
    """What an .oni file holds and what is wrong with it.

    Parameters
    ----------
    path : Path
        The file.
    size_bytes : int
        Its length.
    version : str
        Version of the format, as "1.0.1.0"; empty if the header is broken.
    nodes : tuple of OniNode
        Everything that was recorded, in the file's order.
    depth : OniNode or None
        The depth stream; its `frames` are the readable ones.
    camera : Camera or None
        Intrinsics from the recorded field of view (a Kinect's where there is none); None if the
        frame size is unknown.
    fps : float
        Recorded frame rate.
    tenths : bool
        True if the stored depth is in tenths of millimetres.
    unsupported : str
        Why a file that is in order cannot be read; empty if it can.
    notes : tuple of str
        What is done to the frames, or else worth knowing, though nothing is wrong.
    problems : tuple of OniProblem
        By offset; empty if nothing is wrong.
    ended : bool
        True if the recorder closed the file.
    tail_bytes : int
        Bytes after the end, which OpenNI2's recorder leaves as zeros.
    old : bool
        True for versions before 1.0.1.0.
    decoded_frames : int
        Number of depth frames that were also decoded, not only found.
    swapped_frames : int
        Number of these in which OpenNI2's recorder swapped the last pixels, so that its player
        shows up to 28 wrong ones (see `oni_codec`). They are read rightly here.
    """

    path: Path
    size_bytes: int
    version: str
    nodes: tuple[OniNode, ...]
    depth: OniNode | None
    camera: Camera | None
    fps: float
    tenths: bool
    unsupported: str
    notes: tuple[str, ...]
    problems: tuple[OniProblem, ...]
    ended: bool
    tail_bytes: int
    old: bool
    decoded_frames: int
    swapped_frames: int

    @property
    def readable_frames(self) -> int:
        """Number of depth frames that are all there."""
        return len(self.depth.frames) if self.depth is not None else 0

    @property
    def complete(self) -> bool:
        """True if nothing is wrong with the file."""
        return self.ended and not self.problems and self.readable_frames > 0

    @property
    def as_stored(self) -> bool:
        """True if frames are delivered as they are stored: same side, unit and size."""
        frames = self.depth.frames if self.depth is not None else []
        crop = (self.depth.values_of("xnCropping", "<IHHHH") if self.depth else None) or (0,)
        return not (self.tenths or crop[0] or any(frame.mirrored for frame in frames))

    @property
    def openable(self) -> bool:
        """True if OpenNI2's player can be given the file: it delivers `readable_frames`."""
        return self.readable_frames > 0 and all(problem.harmless for problem in self.problems)

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last readable depth frame."""
        if self.depth is None or not self.depth.frames:
            return 0.0
        frames = self.depth.frames
        return (frames[-1].timestamp_us - frames[0].timestamp_us) / 1e6
