"""The streams of an .oni file, and the device: what is recorded of each, read and written."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, Self

from selective_depth.drivers.frame import Camera
from selective_depth.drivers.oni.records import (
    LATEST_TIME,
    UNKNOWN_COUNT,
    Kind,
    NodeType,
    Record,
    RecordError,
    pack_text,
    split_text,
)

STREAMS: Final = frozenset((NodeType.DEPTH, NodeType.IMAGE, NodeType.IR))
CAMERA: Final = "selectiveDepthCamera"
"""Our own property: fx, fy, cx, cy of a stream, since a field of view tells no principal point."""
REGISTERED: Final = "selectiveDepthRegistered"
"""Our own property of a depth stream: 1 if colour lies on it. OpenNI2's player steps over both."""

Property = tuple[Kind, bytes]
"""What a property record holds beside its name."""


def integer(value: int) -> Property:
    """A whole-number property."""
    return Kind.INT_PROPERTY, value.to_bytes(8, "little")


def structure(form: str, *values: float) -> Property:
    """A structured property."""
    return Kind.GENERAL_PROPERTY, struct.pack(form, *values)


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
    """One stream (or the device) of a recording, as far as it has been read or written.

    `declared_frames` is None, and `seek_table_offset` 0, until its recorder has ended it.
    """

    number: int
    name: str
    node_type: int
    codec: bytes
    properties: dict[str, Property] = field(default_factory=dict)
    declared_frames: int | None = None
    seek_table_offset: int = 0
    offset: int = 0
    frames: list[OniFrame] = field(default_factory=list)
    ready: bool = False
    removed: bool = False
    has_seek_table: bool = False
    changed: bool = False

    @classmethod
    def added(cls, record: Record, old: bool) -> Self:
        """The node that any of the NODE_ADDED records adds; `old` is the layout before version 1.0.1.0.

        Raises
        ------
        RecordError
            If its fields break the format.
        """
        name, rest = split_text(record.fields)
        newest = "<I4sIQQI" if old else "<I4sIQQQ"
        form = {Kind.NODE_ADDED_4: "<I4s", Kind.NODE_ADDED_5: "<I4sIQQ"}.get(record.kind, newest)
        if len(rest) != struct.calcsize(form):
            raise RecordError(f"its fields after the name have {len(rest)} bytes instead of {struct.calcsize(form)}")
        node_type, codec, *more = struct.unpack(form, rest)
        node = cls(record.node, name, node_type, codec, offset=record.offset)
        if more and more[0] != UNKNOWN_COUNT:
            node.declared_frames = more[0]
        if len(more) > 3:
            node.seek_table_offset = more[3]
        return node

    def addition(self) -> bytes:
        """Fields of its NODE_ADDED record in the current version."""
        count, latest_us = UNKNOWN_COUNT, LATEST_TIME
        if self.declared_frames is not None:
            count, latest_us = self.declared_frames, self.frames[-1].timestamp_us if self.frames else 0
        return pack_text(self.name) + struct.pack(
            "<I4sIQQQ", self.node_type, self.codec, count, 0, latest_us, self.seek_table_offset
        )

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

    def camera(self, width: int, height: int) -> Camera | None:
        """Intrinsics of its images of a size; None where nothing is recorded of them.

        Raises
        ------
        ValueError, ArithmeticError
            If what is recorded cannot be.
        """
        own, fov_rad = self.values_of(CAMERA, "<dddd"), self.values_of("xnFOV", "<dd")
        optics = self.values_of("xnRealWorldTranslationData", "<ddd")
        if own is not None:
            return Camera(width, height, *own)
        if fov_rad is not None:
            return Camera.from_fov(width, height, *fov_rad)
        if optics is not None:
            # OpenNI 1 at first recorded the size of a pixel at a distance instead.
            distance, pixel_size, pixels_to_depth = optics
            focal = distance / (pixel_size * pixels_to_depth)
            return Camera(width, height, focal, focal, width / 2, height / 2)
        return None


def in_file_order(nodes: Iterable[OniNode]) -> list[tuple[OniNode, OniFrame]]:
    """All frames of some streams, each with its stream, as they lie in the file."""
    frames = [(node, frame) for node in nodes for frame in node.frames]
    return sorted(frames, key=lambda item: item[1].record_offset)
