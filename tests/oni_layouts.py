"""Recordings as other programs lay them out: other codecs."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.frame import Camera
from selective_depth.drivers.oni.nodes import OniNode
from selective_depth.drivers.oni.records import CODEC_NONE, NodeType
from selective_depth.drivers.oni.writer import RecordWriter, depth_properties


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
