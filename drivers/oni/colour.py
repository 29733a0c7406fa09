"""The colour stream of an .oni file: what its frames are, and the one that belongs to a moment."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from typing import BinaryIO, Final

from selective_depth.drivers.colour import Colouring, nearest, rgb_of
from selective_depth.drivers.frame import Camera, ColourArray, DepthFrame
from selective_depth.drivers.oni.files import read_payload
from selective_depth.drivers.oni.nodes import REGISTERED, OniFrame, OniNode
from selective_depth.drivers.oni.records import NodeType

_KINDS: Final = {200: "RGB888", 201: "YUV422", 202: "GRAY8", 205: "YUYV"}
"""OpenNI2's numbers of the pixel formats that colour comes in uncompressed."""


class OniColour:
    """Reads the colour frames of a recording.

    Parameters
    ----------
    nodes : collection of OniNode
        The recording's streams; the first colour stream that has frames is taken.

    Attributes
    ----------
    node : OniNode or None
        The stream; None if there is none whose form is known.
    camera : Camera or None
        Its intrinsics, where they are recorded.
    registered : bool
        Whether the recording says that colour lies on depth.
    unsupported : str
        Why there is a colour stream that is not read; empty if there is none.
    """

    def __init__(self, nodes: Collection[OniNode]) -> None:
        self.node: OniNode | None = None
        self.camera: Camera | None = None
        self.registered = any(node.number_of(REGISTERED) == 1 for node in nodes if node.node_type == NodeType.DEPTH)
        self.unsupported = ""
        self._kind, self._size = "", (0, 0)
        for node in nodes:
            if node.node_type != NodeType.IMAGE or not node.frames:
                continue
            mode = node.values_of("xnMapOutputMode", "<III") or (0, 0, 0)
            kind = "JPEG" if node.codec == b"JPEG" else _KINDS.get(node.number_of("oniPixelFormat") or 200, "")
            if node.codec not in (b"JPEG", b"NONE") or not kind or 0 in mode[:2]:
                codec = node.codec.decode("ascii", "replace")
                self.unsupported = f"the colour of {node.name} ({codec}) has a format that is not read"
                continue
            self.node, self._kind, self._size = node, kind, (int(mode[0]), int(mode[1]))
            with suppress(ValueError, ArithmeticError):
                self.camera = node.camera(*self._size)
            break
        self._times_us = [frame.timestamp_us for frame in self.node.frames] if self.node else []

    def image(self, payload: bytes, frame: OniFrame) -> ColourArray | None:
        """The image of a frame of the stream, the right way round; None if it is damaged."""
        colour = rgb_of(payload, self._kind, *self._size)
        return colour[:, ::-1] if colour is not None and frame.mirrored else colour

    def on(self, file: BinaryIO, frame: DepthFrame, colouring: Colouring) -> DepthFrame:
        """A depth frame with the colour nearest to it in time, where there is one near enough."""
        at = nearest(self._times_us, frame.timestamp_us) if colouring.wanted and self.node else None
        if at is None or self.node is None:
            return frame
        held = self.node.frames[at]
        payload = read_payload(file, held)
        colour = self.image(payload, held)
        if colour is None:
            return frame
        jpeg = payload if self._kind == "JPEG" and not held.mirrored else None
        colouring = colouring.told_by(self.camera.intrinsics if self.camera else None)
        return colouring.colour(frame, colour, self._times_us[at], self.registered, jpeg)
