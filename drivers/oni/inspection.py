"""What is in an .oni file, and what is wrong with it, without OpenNI2.

OpenNI2's own player trusts its input: a wrong size or count in a file overruns its buffers, and
the process is gone. Here the chain of records is walked and every number is checked that the
player would rely on, before it gets to see the file.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, Final

from selective_depth.drivers.errors import DamagedRecordingError, SourceNotFoundError
from selective_depth.drivers.frame import Camera
from selective_depth.drivers.oni.files import open_regular, read_payload, skip_hole, unreadable
from selective_depth.drivers.oni.form import Sides, mended_times, no_depth, read_form, turned_at, upright
from selective_depth.drivers.oni.nodes import CAMERA, OniFrame, OniNode
from selective_depth.drivers.oni.records import (
    BEGIN_FIELDS,
    CODEC_TABLE,
    CODECS,
    FILE_HEADER,
    FRAME_FIELDS,
    IDENTITY,
    MAGIC,
    NODE_ADDITIONS,
    OLD_SEEK_ENTRY,
    OLDEST_VERSION,
    PROPERTIES,
    SEEK_ENTRY,
    UNKNOWN_COUNT,
    VERSION,
    CutError,
    Kind,
    NodeType,
    Record,
    RecordError,
    parse_property,
    read_record,
    unpack_fields,
)
from selective_depth.drivers.oni.report import OniReport

_MAX_NODES: Final = 64
_SIZES: Final = {"xnMapOutputMode": 12, "xnCropping": 12, "xnFOV": 16, "xnRealWorldTranslationData": 24, CAMERA: 32}
_SHAPING: Final = ("xnMapOutputMode", "xnCropping", "oniPixelFormat")
"""Properties that tell what a frame's values are; one that changes ends what can be read."""
_SCAN_BYTES: Final = 1 << 20


def inspect_oni(path: str | Path, *, decode: bool = False, timeout_s: float = 10.0, stream: int = 1) -> OniReport:
    """Check an .oni file.

    Parameters
    ----------
    path : str or Path
        The file. Anything that is a regular file gets a report.
    decode : bool, default False
        Also decode every depth frame (about 1 ms each at 640x480), which finds most of the damage
        inside of frames. The format has no checksums: some of it cannot be found.
    timeout_s : float, default 10
        Stop decoding after so many seconds; `decoded_frames` says how far that came. The walk over
        the records has no limit: it takes as long as reading the file once, whatever is in there.
    stream : int, default 1
        Which depth stream, from 1.

    Raises
    ------
    SourceNotFoundError
        If there is no such file, it is not a regular file (a folder, a pipe, a device) or cannot be
        read.
    """
    path = Path(path)
    with open_regular(path) as file:
        try:
            return _Inspection(path, file).report_on(stream, decode, timeout_s)
        except OSError as error:
            raise unreadable(path, error) from error


def rescuable(path: str | Path, stream: int = 1) -> OniReport:
    """The report of a file of which something can be saved, every frame decoded, however long that takes.

    Raises
    ------
    SourceNotFoundError
        As for `inspect_oni`.
    DamagedRecordingError
        If no depth frame can be read.
    """
    report = inspect_oni(path, decode=True, timeout_s=math.inf, stream=stream)
    if report.readable_frames == 0:
        why = f" ({report.problems[0]})" if report.problems else ""
        raise DamagedRecordingError(f"nothing can be saved of '{path}': no depth frame in it is readable{why}.")
    return report


class _Inspection:
    """One walk over a file, which fills a report."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.file = file
        self.size = os.fstat(file.fileno()).st_size
        self.report = OniReport(path, self.size)
        self.problem = self.report.problem
        self.nodes: dict[int, OniNode] = {}
        self.latest_us = 0
        self.highest_node = 0
        self.begun = False
        self._block = (0, b"")  # where the search for the next record was last

    def report_on(self, stream: int = 1, decode: bool = False, timeout_s: float = 10.0) -> OniReport:
        """See `inspect_oni`."""
        report, deadline_s = self.report, time.monotonic() + timeout_s
        if self._read_header():
            self._walk()
            self._check_counts()
        nodes = report.nodes = tuple(self.nodes.values())
        depths = [node for node in nodes if node.node_type == NodeType.DEPTH]
        if stream > max(1, len(depths)):
            raise SourceNotFoundError(
                f"'{report.path}' has {len(depths)} depth streams; ?stream={stream} is not among them, the first is 1."
            )
        depth = report.depth = depths[stream - 1] if depths else None
        self._mend_times()
        if depth is not None:
            read_form(report, depth)
        if len(depths) > 1:
            report.notes += (f"it holds {len(depths)} depth streams; FILE.oni?stream=N is the N-th",)
        if report.version and not any(node.is_stream for node in nodes):
            self.problem(0, "the file holds no depth stream")
        elif self.begun and not report.frames and not report.problems:
            report.unsupported = no_depth(nodes)
        if depth is not None:
            if report.camera is None:
                depth.frames.clear()
            elif decode:
                self._decode_frames(depth, report.camera, deadline_s)
                self._decode_colour(deadline_s)
        return report

    def _mend_times(self) -> None:
        for node in self.nodes.values():
            times_us, first = mended_times([frame.timestamp_us for frame in node.frames])
            if first is not None:
                self.report.notes += (
                    f"the clock of {node.name} jumps at frame {node.frames[first].number}; its times are corrected"
                    " so that they never run backwards, and --repair writes them so",
                )
                pairs = zip(node.frames, times_us, strict=True)
                node.frames[:] = [replace(frame, timestamp_us=time_us) for frame, time_us in pairs]

    def _read_header(self) -> bool:
        start, problem = self.file.read(FILE_HEADER.size), self.problem
        if not start:
            problem(0, "the file is empty")
        elif start.startswith(b"version https://git-lfs"[: FILE_HEADER.size]):
            problem(0, "this is a Git LFS pointer and not the recording; `git lfs pull` fetches it")
        elif start[:4] != IDENTITY:
            problem(0, f"this is not an .oni file: it begins with {start[:4]!r} instead of {IDENTITY!r}")
        elif len(start) < FILE_HEADER.size:
            problem(len(start), "the file ends inside its header")
        else:
            _, *version, self.latest_us, self.highest_node = FILE_HEADER.unpack(start)
            number = ".".join(map(str, version))
            if OLDEST_VERSION <= tuple(version) <= VERSION:
                self.report.version, self.report.old = number, tuple(version) < VERSION
                if self.highest_node > _MAX_NODES:
                    problem(20, f"the header announces {self.highest_node} streams")
            else:
                problem(4, f"version {number} of the format is not known, only up to 1.0.1.0")
        return bool(self.report.version)

    def _walk(self) -> None:
        offset = FILE_HEADER.size
        while offset < self.size:
            try:
                record = read_record(self.file, offset, self.size, self.report.old)
            except RecordError as error:
                found = self._next_record(offset + 1)
                # A recorder that was stopped leaves half a record at the very end.
                self.problem(offset, f"{error}", harmless=found is None and isinstance(error, CutError))
                if found is None:
                    break
                offset = found
                continue
            try:
                self._handle(record)
            except RecordError as error:
                self.problem(offset, f"a {record.kind.name} record is wrong: {error}")
            offset = record.end
            if record.kind is Kind.END:
                self.report.end_offset = offset
                self._walk_beyond_end(offset)
                return
        self.problem(self.size, "the file ends without its END mark", harmless=True)

    def _walk_beyond_end(self, offset: int) -> None:
        """OpenNI 1's recorder writes END before it removes the nodes and adds their tables."""
        while offset < self.size:
            try:
                record = read_record(self.file, offset, self.size, self.report.old)
                if record.kind not in (Kind.NODE_REMOVED, Kind.SEEK_TABLE):
                    return
                self._handle(record)
            except RecordError:
                return  # zeros, as a rule; a table that is needed is missed later
            self.report.end_offset = offset = record.end

    def _next_record(self, offset: int) -> int | None:
        """Offset of the next sound record at or after an offset, None if there is none."""
        for found in self._find_magic(offset):
            try:
                record = read_record(self.file, found, self.size, self.report.old)
            except RecordError:
                continue
            if record.node in self.nodes or record.kind in (*NODE_ADDITIONS, Kind.END):
                return found
        return None

    def _find_magic(self, offset: int) -> Iterator[int]:
        while offset < self.size:
            start, block = self._block
            if not start <= offset <= start + len(block) - len(MAGIC):
                start = skip_hole(self.file, offset)
                self.file.seek(start)
                block = self.file.read(_SCAN_BYTES)
                # Kept: a file of nothing but broken records is still read only once.
                self._block = start, block
                offset = start
            at = block.find(MAGIC, offset - start)
            while at >= 0:
                yield start + at
                at = block.find(MAGIC, at + 1)
            if len(block) < len(MAGIC):
                return
            offset = start + len(block) - len(MAGIC) + 1

    def _handle(self, record: Record) -> None:
        if record.undone_offset >= record.offset:
            raise RecordError(f"it refers ahead, to byte {record.undone_offset}")
        if record.kind in NODE_ADDITIONS:
            self._add_node(record)
        elif record.kind is not Kind.END:
            node = self.nodes.get(record.node)
            if node is None:
                raise RecordError(f"there is no node {record.node}")
            if node.removed and record.kind is not Kind.SEEK_TABLE:
                raise RecordError(f"node {record.node} was removed before")
            if record.kind in PROPERTIES:
                self._set_property(node, record)
            elif record.kind is Kind.STATE_READY:
                node.ready = True
            elif record.kind is Kind.DATA_BEGIN:
                self._begin(node, record)
            elif record.kind is Kind.NEW_DATA:
                self._add_frame(node, record)
            elif record.kind is Kind.NODE_REMOVED:
                node.removed = True
            else:
                self._check_seek_table(node, record)
        if record.payload_size and record.kind not in (Kind.NEW_DATA, Kind.SEEK_TABLE):
            raise RecordError(f"it has {record.payload_size} bytes of payload but needs none")

    def _add_node(self, record: Record) -> None:
        node = OniNode.added(record, self.report.old)
        if node.number in self.nodes:
            raise RecordError(f"node {node.number} was added before")
        self.nodes[node.number] = node
        if node.number > self.highest_node:
            raise RecordError(f"node {node.number} is beyond the highest that the header states, {self.highest_node}")
        if node.is_stream and node.codec not in CODECS:
            raise RecordError(f"the compression {node.codec!r} is not known")

    def _set_property(self, node: OniNode, record: Record) -> None:
        name, value = parse_property(record)
        if len(value) != _SIZES.get(name, len(value)):
            raise RecordError(f"the property {name} has {len(value)} bytes, not {_SIZES[name]}")
        if node.frames and name in _SHAPING and node.properties.get(name, (0, value))[1] != value:
            node.changed = True
            raise RecordError(f"{name} changes after frame {node.frames[-1].number}")
        node.properties[name] = (record.kind, value)

    def _begin(self, node: OniNode, record: Record) -> None:
        frames, _ = unpack_fields(record, BEGIN_FIELDS)
        if not node.is_stream:
            raise RecordError(f"node {node.number} delivers no frames")
        self.begun = True
        if node.declared_frames is None and frames != UNKNOWN_COUNT:
            node.declared_frames = frames  # where versions before 1.0.0.5 keep it

    def _add_frame(self, node: OniNode, record: Record) -> None:
        timestamp_us, number = unpack_fields(record, FRAME_FIELDS)
        if not (node.is_stream and node.ready and self.begun):
            raise RecordError(f"node {node.number} was not ready for frames")
        if node.changed:
            return  # what comes now is of another size or unit
        previous = node.frames[-1].number if node.frames else 0
        if number != previous + 1:
            self.problem(record.offset, f"frame {number} follows frame {previous} of {node.name}")
            if node.frames and number <= previous:
                return
        if timestamp_us > self.latest_us:
            self.problem(record.offset, f"frame {number} is later than the recording's end")
        place = record.offset, record.payload_offset, record.payload_size
        node.frames.append(OniFrame(number, timestamp_us, *place, node.number_of("xnMirror") == 1))

    def _check_seek_table(self, node: OniNode, record: Record) -> None:
        form = OLD_SEEK_ENTRY if self.report.old else SEEK_ENTRY
        if record.offset != node.seek_table_offset:
            raise RecordError(f"node {node.number} expects it at byte {node.seek_table_offset}")
        if record.payload_size != (len(node.frames) + 1) * form.size:
            raise RecordError(f"it has {record.payload_size // form.size - 1} entries for {len(node.frames)} frames")
        node.has_seek_table = True
        self.file.seek(record.payload_offset)
        table = self.file.read(record.payload_size)
        if len(table) != record.payload_size:
            raise RecordError("the file became shorter while it was read")
        for frame, entry in zip(node.frames, list(form.iter_unpack(table))[1:], strict=True):
            if (entry[0], entry[2]) != (frame.timestamp_us, frame.record_offset):
                self.problem(record.offset, f"the seek table and frame {frame.number} disagree on its place or time")
                return

    def _check_counts(self) -> None:
        if not self.begun:
            self.problem(self.size, "the recording never began")
        for node in self.nodes.values():
            if not node.is_stream:
                continue
            there = len(node.frames)
            if node.declared_frames is None:
                self.problem(
                    node.offset,
                    f"the number of {node.name} frames was never written: the recorder was stopped",
                    harmless=node.seek_table_offset == 0,
                )
            elif node.declared_frames != there and not node.changed:
                self.problem(self.size, f"{node.declared_frames} {node.name} frames are announced, {there} are there")
            if node.seek_table_offset and node.declared_frames and not node.has_seek_table:
                self.problem(self.size, f"there is no valid seek table of {node.name} at byte {node.seek_table_offset}")

    def _decode_colour(self, deadline_s: float) -> None:
        """Drop the colour frames that cannot be decoded; note where none can be read."""
        from selective_depth.drivers.oni.colour import OniColour

        colour = OniColour(self.nodes.values())
        if colour.node is None:
            self.report.notes += (colour.unsupported,) if colour.unsupported else ()
            return
        sound = []
        for frame in colour.node.frames:
            if time.monotonic() < deadline_s and colour.image(read_payload(self.file, frame), frame) is None:
                self.problem(frame.record_offset, f"frame {frame.number} of {colour.node.name} cannot be decoded")
            else:
                sound.append(frame)
        colour.node.frames[:] = sound

    def _decode_frames(self, depth: OniNode, camera: Camera, deadline_s: float) -> None:
        """Drop the frames that cannot be decoded, as far as time allows; mark those turned round.

        Counts those that can, and of these those that the recorder swapped the last pixels of.
        """
        # Compiled code, whose import takes longer than a whole check without it.
        from selective_depth.drivers.oni.codec import decode_depth, is_swapped

        report, sides, sound = self.report, Sides(), []
        size = camera.height, camera.width
        for frame in depth.frames:
            if time.monotonic() < deadline_s:
                payload = read_payload(self.file, frame)
                raw = decode_depth(depth.codec, payload, *size)
                if raw is None:
                    self.problem(frame.record_offset, f"frame {frame.number} cannot be decoded")
                    continue
                report.decoded_frames += 1
                report.swapped_frames += depth.codec == CODEC_TABLE and is_swapped(payload, raw)
                turns = sides.turns
                sides.put_right(upright(raw, report.tenths, frame.mirrored))
                if sides.turns > turns == 0:
                    report.notes += (f"it {turned_at(frame.number)}",)
                if sides.turns % 2:
                    frame = replace(frame, mirrored=not frame.mirrored)
            sound.append(frame)
        depth.frames[:] = sound
