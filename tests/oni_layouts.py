"""Recordings made in one call: of frames, and as other programs lay them out."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.oni.nodes import OniNode
from selective_depth.drivers.oni.records import CODEC_NONE, NodeType
from selective_depth.drivers.oni.writer import OniWriter, RecordWriter, depth_properties
from selective_depth.drivers.source import DepthSource


def write_oni(path: str | Path, frames: Iterable[DepthFrame], *, fps: float | None = None) -> int:
    """Save frames, all of one camera, at the rate of their source or 30 a second; returns how many."""
    if fps is None:
        fps = frames.fps if isinstance(frames, DepthSource) else 30.0
    count = 0
    with OniWriter(path, fps=fps) as recording:
        for frame in frames:
            recording.write(frame)
            count += 1
    return count


def write_uncompressed(path: Path, depth_mm: Iterable[npt.NDArray[np.uint16]]) -> None:
    """Depth without compression."""
    writer = RecordWriter(path)
    frames = list(depth_mm)
    height, width = frames[0].shape
    properties = depth_properties(Camera.kinect(width, height), 30)
    writer.add_node(OniNode(1, "Depth", NodeType.DEPTH, CODEC_NONE, properties))
    writer.begin()
    for number, image in enumerate(frames):
        writer.add_frame(1, 33_333 * number, image.astype("<u2").tobytes())
    writer.close()
