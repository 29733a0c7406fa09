"""Saving what is readable of damaged .oni files, without OpenNI2."""

from __future__ import annotations

import math
from contextlib import closing
from pathlib import Path

from selective_depth.drivers.oni.codec import encode_depth
from selective_depth.drivers.oni.files import open_regular, read_payload
from selective_depth.drivers.oni.inspection import inspect_oni, rescuable
from selective_depth.drivers.oni.nodes import OniNode, in_file_order
from selective_depth.drivers.oni.reader import read_depth
from selective_depth.drivers.oni.records import CODEC_NONE, CODEC_TABLE, CODECS
from selective_depth.drivers.oni.report import OniReport
from selective_depth.drivers.oni.writer import RecordWriter, depth_properties


def repair_oni(path: str | Path, out_path: str | Path) -> OniReport:
    """Write what is readable of an .oni file to a new one that OpenNI2 replays.

    Every stream is kept, compressed as it was; frames that are damaged are left out and the rest
    numbered anew; times go on rising; depth that is mirrored, cropped or in other units is written
    as it is delivered; last pixels that OpenNI2's recorder swapped are put right (see
    `codec`). A file whose recorder was killed comes back whole.

    Parameters
    ----------
    path : str or Path
        The damaged file; it is not changed.
    out_path : str or Path
        The new file; must not exist.

    Returns
    -------
    OniReport
        Of the new file, every frame decoded.

    Raises
    ------
    SourceNotFoundError
        If there is no such file.
    DamagedRecordingError
        If no depth frame can be read.
    OutputError
        If the new file exists or cannot be written.
    """
    report = rescuable(path)
    assert report.depth is not None and report.camera is not None
    defaults = depth_properties(report.camera, report.fps)
    kept = [node for node in report.nodes if not node.is_stream or (node.ready and node.codec in CODECS)]
    with open_regular(report.path) as file, closing(RecordWriter(Path(out_path))) as writer:
        for node in kept:
            properties, codec = node.properties, node.codec
            if node is report.depth:  # it is written as it is delivered
                properties = {**defaults, **(properties if report.as_stored else {})}
                codec = CODEC_NONE if codec == CODEC_NONE else CODEC_TABLE
            writer.add_node(OniNode(node.number, node.name, node.node_type, codec, properties))
        writer.begin()
        for node, frame in in_file_order(kept):
            payload = read_payload(file, frame)
            if node is report.depth:
                depth_mm = read_depth(report, file, frame)
                assert depth_mm is not None  # decoded a moment ago
                payload = encode_depth(depth_mm, writer.nodes[node.number].codec)
            writer.add_frame(node.number, frame.timestamp_us, payload)
    return inspect_oni(out_path, decode=True, timeout_s=math.inf)
