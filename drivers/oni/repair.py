"""Saving what is readable of damaged .oni files, without OpenNI2."""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice
from pathlib import Path

from selective_depth.drivers.errors import DamagedRecordingError, OutputError
from selective_depth.drivers.folder import FolderWriter
from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.oni.codec import encode_depth, mend_order
from selective_depth.drivers.oni.files import open_regular, read_payload
from selective_depth.drivers.oni.inspection import inspect_oni
from selective_depth.drivers.oni.reader import read_depth
from selective_depth.drivers.oni.records import CODEC_TABLE, CODECS, NodeAddition
from selective_depth.drivers.oni.report import OniFrame, OniReport
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
    report = _rescuable(path)
    assert report.depth is not None and report.camera is not None
    defaults = depth_properties(report.camera, report.fps)
    with open_regular(report.path) as file:
        writer = RecordWriter(Path(out_path))
        try:
            frames: list[tuple[int, OniFrame]] = []
            for node in report.nodes:
                if node.is_stream and not (node.ready and node.codec in CODECS):
                    continue
                known = defaults if node is report.depth else {}
                properties = {**known, **node.properties}
                if node is report.depth and not report.as_stored:
                    properties = known  # it is written as it is delivered
                addition = NodeAddition(node.name, node.node_type, node.codec, None, 0)
                writer.add_node(node.number, addition, properties)
                frames += [(node.number, frame) for frame in node.frames]
            writer.begin()
            for number, frame in sorted(frames, key=lambda item: item[1].record_offset):
                payload = read_payload(file, frame)
                if number == report.depth.number and not report.as_stored:
                    depth_mm = read_depth(report, file, frame)
                    assert depth_mm is not None  # decoded a moment ago
                    payload = encode_depth(depth_mm)
                elif number == report.depth.number:
                    payload = _mended_payload(report, payload) or payload
                writer.add_frame(number, frame.timestamp_us, payload)
        finally:
            writer.close()
    return inspect_oni(out_path, decode=True, timeout_s=float("inf"))


def mend_oni(path: str | Path) -> int:
    """Put right, in place, the frames whose last pixels OpenNI2's recorder swapped.

    To be called after recording: the file is whole, but OpenNI2's own player and viewers would
    show up to 28 wrong pixels in the corner of such a frame (see `oni_codec`). Two bytes of each
    such frame change places, nothing else is touched.

    Returns
    -------
    int
        Number of frames put right.

    Raises
    ------
    SourceNotFoundError
        If there is no such file.
    OutputError
        If it cannot be written.
    """
    report = inspect_oni(path)
    frames = report.depth.frames if report.depth is not None else []
    mended = 0
    try:
        with Path(path).open("r+b", buffering=0) as file:
            for frame in frames:
                payload = _mended_payload(report, read_payload(file, frame))
                if payload is not None:
                    file.seek(frame.payload_offset + frame.payload_size - 2)
                    file.write(payload[-2:])
                    mended += 1
    except OSError as error:
        raise OutputError(f"'{path}' cannot be written ({error.strerror}); check its permissions.") from error
    return mended


def export_oni(
    path: str | Path,
    folder: str | Path,
    progress: Callable[[int], None] | None = None,
    *,
    frames: int | None = None,
) -> OniReport:
    """Save every readable depth frame of an .oni file, damaged or not, as a folder of PNG files.

    Parameters
    ----------
    path : str or Path
        The file.
    folder : str or Path
        The folder; made if it is not there. It must not hold PNG files yet.
    progress : callable, optional
        Called with the number of frames saved so far.
    frames : int, optional
        Save only so many, the first ones.

    Returns
    -------
    OniReport
        Of the .oni file; its `readable_frames`, or the first of them, were saved.

    Raises
    ------
    SourceNotFoundError
        If there is no such file.
    DamagedRecordingError
        If no depth frame can be read.
    OutputError
        If the folder cannot be written.
    """
    report = _rescuable(path)
    depth, camera = report.depth, report.camera
    assert depth is not None and camera is not None
    with open_regular(report.path) as file, FolderWriter(folder, fps=report.fps) as out:
        for index, frame in enumerate(islice(depth.frames, frames)):
            depth_mm = read_depth(report, file, frame)
            if depth_mm is None:
                raise DamagedRecordingError(f"'{path}' has changed while it was read.")
            out.write(DepthFrame(depth_mm, index, frame.timestamp_us, camera, str(path)))
            if progress is not None:
                progress(index + 1)
    return report


def _mended_payload(report: OniReport, payload: bytes) -> bytes | None:
    if report.depth is None or report.camera is None or report.depth.codec != CODEC_TABLE:
        return None
    return mend_order(payload, report.camera.height, report.camera.width)


def _rescuable(path: str | Path) -> OniReport:
    report = inspect_oni(path, decode=True, timeout_s=float("inf"))
    if report.readable_frames == 0 or report.camera is None:
        why = f" ({report.problems[0]})" if report.problems else ""
        raise DamagedRecordingError(
            f"nothing can be saved of '{path}': no depth frame in it is readable{why}."
        )
    return report
