"""Writing .oni files that OpenNI2 replays: from frames of any source, without a sensor."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, Final

from selective_depth.drivers.colour import jpeg_of
from selective_depth.drivers.errors import OutputError, unwritten
from selective_depth.drivers.frame import Camera, ColourArray, DepthArray, DepthFrame
from selective_depth.drivers.oni.codec import decode_depth, encode_depth
from selective_depth.drivers.oni.files import read_payload
from selective_depth.drivers.oni.nodes import (
    CAMERA,
    REGISTERED,
    OniFrame,
    OniNode,
    Property,
    in_file_order,
    integer,
    structure,
)
from selective_depth.drivers.oni.records import (
    BEGIN_FIELDS,
    CODEC_JPEG,
    CODEC_NONE,
    CODEC_TABLE,
    FILE_HEADER,
    FRAME_FIELDS,
    IDENTITY,
    LATEST_TIME,
    MAX_PAYLOAD,
    SEEK_ENTRY,
    UNKNOWN_COUNT,
    VERSION,
    Kind,
    NodeType,
    pack_property,
    pack_record,
)
from selective_depth.drivers.source import DEFAULT_FPS
from selective_depth.drivers.writer import FrameWriter, rate_of

_MAX_DEPTH_MM: Final = 65535
_DEPTH_1_MM: Final = 100  # OpenNI2's number of this pixel format
_GREY_16_BIT: Final = 4  # and OpenNI 1's
_RGB_888: Final = 200
_RGB_24_BIT: Final = 1
JPEG_QUALITY: Final = 92
"""Of recorded colour: it is off by less than its sensor's noise."""


class RecordWriter:
    """Writes the nodes and frames of an .oni file, and at the end all that points to them.

    Until `close`, the file looks like one whose recorder was killed: OpenNI2 and `inspect_oni`
    read what is there. If it cannot be written to its end, it is removed: what it was to hold is
    still where it came from, and the next attempt shall not find it in its way.

    Parameters
    ----------
    path : Path
        The file; must not exist.
    keep : bool, default False
        Leave what could be written, and `close` it properly, where it cannot be written further.

    Raises
    ------
    OutputError
        If it exists, or cannot be written.
    """

    def __init__(self, path: Path, *, keep: bool = False) -> None:
        self.path = path
        self._keep = keep
        self.nodes: dict[int, OniNode] = {}
        self._offset = self._latest_us = 0
        try:
            self._file: BinaryIO = path.open("xb", buffering=0)  # whole in the file at every record
        except FileExistsError:
            raise OutputError(f"'{path}' exists already; give another name, or remove it.") from None
        except OSError as error:
            raise unwritten(path, error) from error
        self._append(self._header(LATEST_TIME))

    def add_node(self, node: OniNode) -> None:
        """Add a stream and what is known of it; its frames are those that are written from here on."""
        self.nodes[node.number] = node
        node.offset = self._append(pack_record(Kind.NODE_ADDED, node.number, node.addition()))
        for name, (kind, value) in node.properties.items():
            self._append(pack_record(kind, node.number, pack_property(name, value)))
        self._append(pack_record(Kind.STATE_READY, node.number))

    def begin(self) -> None:
        """Announce the frames, once all nodes are there."""
        for node in self.nodes.values():
            if node.is_stream:
                fields = BEGIN_FIELDS.pack(UNKNOWN_COUNT, LATEST_TIME)
                self._append(pack_record(Kind.DATA_BEGIN, node.number, fields))

    def add_frame(self, number: int, timestamp_us: int, payload: bytes) -> None:
        """Add the next frame of the node of a number."""
        frames = self.nodes[number].frames
        previous = frames[-1].record_offset if frames else 0
        fields = FRAME_FIELDS.pack(timestamp_us, len(frames) + 1)
        offset = self._append(pack_record(Kind.NEW_DATA, number, fields, payload, previous))
        frames.append(OniFrame(len(frames) + 1, timestamp_us, offset, self._offset - len(payload), len(payload)))
        self._latest_us = max(self._latest_us, timestamp_us)

    def close(self) -> None:
        """Finish the file. Harmless when called twice."""
        if self._file.closed:
            return
        try:
            with self._saying():
                self._finish()
        finally:
            self._file.close()

    def discard(self) -> None:
        """Close and remove the file."""
        if not self._file.closed:
            with suppress(OSError):
                self._file.close()
            self.path.unlink(missing_ok=True)

    def _finish(self) -> None:
        for node in self.nodes.values():
            self._append(pack_record(Kind.NODE_REMOVED, node.number, undone_offset=node.offset))
            entries = [(0, 0, 0), *((frame.timestamp_us, 0, frame.record_offset) for frame in node.frames)]
            table = b"".join(SEEK_ENTRY.pack(*entry) for entry in entries)
            if node.frames and len(table) <= MAX_PAYLOAD:  # longer, OpenNI2 refuses; it may be missing
                node.seek_table_offset = self._append(pack_record(Kind.SEEK_TABLE, node.number, payload=table))
            node.declared_frames = len(node.frames)
        self._append(pack_record(Kind.END, 0))
        for node in self.nodes.values():
            self._file.seek(node.offset)
            self._file.write(pack_record(Kind.NODE_ADDED, node.number, node.addition()))
        self._file.seek(0)
        self._file.write(self._header(self._latest_us))

    def _header(self, latest_us: int) -> bytes:
        return FILE_HEADER.pack(IDENTITY, *VERSION, latest_us, max(self.nodes, default=1))

    def _append(self, data: bytes) -> int:
        offset, left = self._offset, memoryview(data)
        with self._saying():
            while left:
                left = left[self._file.write(left) :]
        self._offset += len(data)
        return offset

    @contextmanager
    def _saying(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if self._keep:
                with suppress(OSError):  # half a record
                    self._file.truncate(self._file.seek(self._offset))
            else:
                self.discard()
            raise unwritten(self.path, error) from error


class OniWriter(FrameWriter):
    """Writes frames to an .oni file that OpenNI2 replays, depth bit by bit, colour as JPEG.

    It holds colour if the first frame has any, and of a later one only an image of the same size.

    Parameters
    ----------
    path : str or Path
        The file; must not exist.
    fps : float, default 30
        Nominal frame rate; the format stores it as a whole number.
    keep : bool, default False
        As for `RecordWriter`.

    Raises
    ------
    OutputError
        If the file exists or cannot be written.

    Notes
    -----
    The format stores fields of view, not principal points: one that is not the middle is in a
    property of our own, which other programs step over. Depth is compressed, until a frame holds
    more different depths than that can say: then the file is written anew without.
    """

    def __init__(self, path: str | Path, *, fps: float = DEFAULT_FPS, keep: bool = False) -> None:
        self._fps = fps
        self._keep = keep
        self._first: DepthFrame | None = None
        self._first_us = 0
        self._codec = CODEC_TABLE
        self._writer = RecordWriter(Path(path), keep=keep)

    def write(self, frame: DepthFrame) -> None:
        """Add a frame. Timestamps are stored as the time since the first.

        Raises
        ------
        ValueError
            If the frame's camera differs from the first frame's, it is too large for OpenNI2, or
            its timestamp lies before the first.
        OutputError
            If it cannot be written, as on a full disk.
        """
        first = self._first or self._begin(frame)
        if frame.camera != first.camera:
            raise ValueError(
                f"frame {frame.index} has {frame.camera}, but '{self._writer.path}' is of"
                f" {first.camera}; write it to another file"
            )
        since_us = frame.timestamp_us - self._first_us
        if since_us < 0:
            raise ValueError(
                f"frame {frame.index} of '{frame.source}' is {-since_us} us older than the first: its clock wrapped"
                " round or jumped back. Give rising timestamps_us in the folder's frames.toml (2^32 more from there"
                " on, for a clock of 32 bits), or export to a folder"
            )
        try:
            payload = encode_depth(frame.depth_mm, self._codec)
        except ValueError:  # too many different depths for the compression
            self._start_plain(first)
            payload = encode_depth(frame.depth_mm, self._codec)
        if frame.colour is not None:
            self._write_colour(first, frame.colour, frame.colour_us or 0, frame.colour_jpeg)
        self._writer.add_frame(1, since_us, payload)

    def _write_colour(self, first: DepthFrame, colour: ColourArray, time_us: int, jpeg: bytes | None) -> None:
        if first.colour is None or first.colour.shape != colour.shape:
            return
        since_us, written = time_us - self._first_us, self._writer.nodes[2].frames
        if not written or since_us > written[-1].timestamp_us:  # else it stands in the file already
            self._writer.add_frame(2, since_us, jpeg or jpeg_of(colour, JPEG_QUALITY))

    def read_back(self) -> DepthArray | None:
        """The last frame as it stands in the file; None if it cannot be decoded."""
        assert self._first is not None
        with self._writer.path.open("rb") as file:
            payload = read_payload(file, self._writer.nodes[1].frames[-1])
        return decode_depth(self._codec, payload, *self._first.shape)

    def close(self) -> None:
        """Finish the file; without a frame there is none."""
        if self._first is None:
            self.discard()
        self._writer.close()

    def discard(self) -> None:
        """Remove the file."""
        self._writer.discard()

    def _begin(self, first: DepthFrame) -> DepthFrame:
        camera = first.camera
        if 2 * camera.width * camera.height > MAX_PAYLOAD:
            raise ValueError(
                f"frames of {camera.width}x{camera.height} pixels are too large for an .oni file;"
                " write a folder of PNG frames"
            )
        self._first = first
        self._first_us = first.timestamp_us if first.colour_us is None else min(first.timestamp_us, first.colour_us)
        self._add_nodes(first)
        return first

    def _add_nodes(self, first: DepthFrame) -> None:
        known = depth_properties(first.camera, self._fps)
        if first.colour is not None:
            known[REGISTERED] = integer(int(first.registered))
        self._writer.add_node(OniNode(1, "Depth", NodeType.DEPTH, self._codec, known))
        if first.colour is not None:
            image = OniNode(2, "Image", NodeType.IMAGE, CODEC_JPEG, colour_properties(first, self._fps))
            self._writer.add_node(image)
        self._writer.begin()

    def _start_plain(self, first: DepthFrame) -> None:
        """Write what is there again, uncompressed."""
        path, written = self._writer.path, self._writer.nodes
        self._codec = CODEC_NONE
        compressed = path.with_name(f"{path.name}.part")
        self._writer.close()
        path.replace(compressed)
        try:
            self._writer = RecordWriter(path, keep=self._keep)
            self._add_nodes(first)
            with compressed.open("rb") as file:
                for node, frame in in_file_order(written.values()):
                    payload = read_payload(file, frame)
                    if node.node_type == NodeType.DEPTH:
                        depth_mm = decode_depth(CODEC_TABLE, payload, *first.shape)
                        assert depth_mm is not None  # encoded here
                        payload = encode_depth(depth_mm, CODEC_NONE)
                    self._writer.add_frame(node.number, frame.timestamp_us, payload)
        finally:
            compressed.unlink(missing_ok=True)


def write_oni(path: str | Path, frames: Iterable[DepthFrame], *, fps: float | None = None) -> int:
    """Save frames as an .oni file.

    Parameters
    ----------
    path : str or Path
        The file; must not exist.
    frames : iterable of DepthFrame
        All of one camera; an open `DepthSource` is one.
    fps : float, optional
        Nominal frame rate; default that of the source, or 30.

    Returns
    -------
    int
        Number of frames written.

    Raises
    ------
    OutputError
        If the file exists or cannot be written.
    """
    return OniWriter(path, fps=rate_of(frames, fps)).write_all(frames)


def depth_properties(camera: Camera, fps: float) -> dict[str, Property]:
    """What OpenNI2 wants to know of a depth stream, under the names that its recorder uses."""
    width, height = camera.width, camera.height
    whole_fps = min(max(round(fps), 1), 1000)
    fov_x_rad = 2 * math.atan(width / (2 * camera.fx))
    fov_y_rad = 2 * math.atan(height / (2 * camera.fy))
    own = {CAMERA: structure("<dddd", *camera.intrinsics)}
    return {
        "oniRequiredFrameSize": integer(2 * width * height),
        "xnIsGenerating": integer(1),
        "xnDeviceMaxDepth": integer(_MAX_DEPTH_MM),
        "xnSupportedMapOutputModesCount": integer(1),
        "xnSupportedMapOutputModes": structure("<III", width, height, whole_fps),
        "xnMapOutputMode": structure("<III", width, height, whole_fps),
        "xnPixelFormat": integer(_GREY_16_BIT),
        "oniPixelFormat": integer(_DEPTH_1_MM),
        "xnFOV": structure("<dd", fov_x_rad, fov_y_rad),
        **(own if abs(camera.cx - width / 2) + abs(camera.cy - height / 2) > 0.01 else {}),
        "Cropping": integer(1),
        # Without this one OpenNI2 opens the file but delivers no frame.
        "xnCropping": structure("<IHHHH", 0, 0, 0, 0, 0),
        "Mirror": integer(1),
        "xnMirror": integer(0),
    }


def colour_properties(first: DepthFrame, fps: float) -> dict[str, Property]:
    """The same of the colour stream of a first frame; an unknown camera is not told."""
    assert first.colour is not None
    height, width = first.colour.shape[:2]
    known = first.colour_camera or replace(first.camera, width=width, height=height)
    said = depth_properties(known, fps)
    del said["xnDeviceMaxDepth"]
    if first.colour_camera is None:
        said = {name: value for name, value in said.items() if name not in (CAMERA, "xnFOV")}
    return said | {
        "oniRequiredFrameSize": integer(3 * width * height),
        "xnPixelFormat": integer(_RGB_24_BIT),
        "oniPixelFormat": integer(_RGB_888),
    }
