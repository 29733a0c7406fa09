"""The records that an .oni file is made of: reading and writing one of them.

A file is a header and a chain of records, each a record header, fields and a payload. All numbers
are little-endian. A recording of one depth stream reads: NODE_ADDED, properties, STATE_READY,
DATA_BEGIN, one NEW_DATA a frame, NODE_REMOVED, SEEK_TABLE, END. The frame count and the place of
the seek table are written into NODE_ADDED at the end, so a recorder that was killed leaves them
open.

The layout was learnt from OpenNI2's published sources and checked on files that it wrote.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import BinaryIO, Final

IDENTITY: Final = b"NI10"
VERSION: Final = (1, 0, 1, 0)
OLDEST_VERSION: Final = (1, 0, 0, 4)
MAGIC: Final = b"NIR\0"

CODEC_TABLE: Final = b"16zT"
CODEC_PLAIN: Final = b"16zP"
CODEC_NONE: Final = b"NONE"
CODEC_JPEG: Final = b"JPEG"
DEPTH_CODECS: Final = (CODEC_TABLE, CODEC_PLAIN, CODEC_NONE)
CODECS: Final = frozenset((*DEPTH_CODECS, CODEC_JPEG, b"Im8z"))
"""Every compression that OpenNI2's player knows."""

FILE_HEADER: Final = struct.Struct("<4sBBHIQI")
"""Identity, version (four numbers), latest timestamp in microseconds, highest node number."""
HEADER: Final = struct.Struct("<4sIIIIQ")
"""Magic, kind, node, size of header and fields, size of payload, offset of the record undone."""
OLD_HEADER: Final = struct.Struct("<4sIIIII")
"""The same before version 1.0.1.0, whose offsets have 32 bits."""
SEEK_ENTRY: Final = struct.Struct("<QIQ")
"""Timestamp, configuration, offset of the frame."""
OLD_SEEK_ENTRY: Final = struct.Struct("<QII")
FRAME_FIELDS: Final = struct.Struct("<QI")
"""Timestamp in microseconds, frame number from 1."""
BEGIN_FIELDS: Final = struct.Struct("<IQ")
"""Number of frames, latest timestamp."""

UNKNOWN_COUNT: Final = 0xFFFFFFFF
LATEST_TIME: Final = 0xFFFFFFFFFFFFFFFF

MAX_FIELDS: Final = 1 << 20
MAX_PAYLOAD: Final = 1600 * 1200 * 3
"""What OpenNI2's player has room for; a longer record overruns its buffer."""
MAX_NAME: Final = 80


class Kind(IntEnum):
    """What a record is."""

    NODE_ADDED_4 = 0x02
    INT_PROPERTY = 0x03
    REAL_PROPERTY = 0x04
    STRING_PROPERTY = 0x05
    GENERAL_PROPERTY = 0x06
    NODE_REMOVED = 0x07
    DATA_BEGIN = 0x08
    STATE_READY = 0x09
    NEW_DATA = 0x0A
    END = 0x0B
    NODE_ADDED_5 = 0x0C
    NODE_ADDED = 0x0D
    SEEK_TABLE = 0x0E


PROPERTIES: Final = frozenset((Kind.INT_PROPERTY, Kind.REAL_PROPERTY, Kind.STRING_PROPERTY, Kind.GENERAL_PROPERTY))
NODE_ADDITIONS: Final = frozenset((Kind.NODE_ADDED_4, Kind.NODE_ADDED_5, Kind.NODE_ADDED))


class NodeType(IntEnum):
    """What a node delivers."""

    DEVICE = 1
    DEPTH = 2
    IMAGE = 3
    IR = 5


class RecordError(ValueError):
    """A record breaks the format; the message is a clause saying how."""


class CutError(RecordError):
    """The file ends inside a record."""


@dataclass(frozen=True, slots=True)
class Record:
    """One record; its payload stays in the file."""

    offset: int
    kind: Kind
    node: int
    fields: bytes
    payload_offset: int
    payload_size: int
    undone_offset: int

    @property
    def end(self) -> int:
        """Offset of the next record."""
        return self.payload_offset + self.payload_size


def read_record(file: BinaryIO, offset: int, size: int, old: bool) -> Record:
    """Read the record at an offset of an unbuffered file of `size` bytes.

    Raises
    ------
    RecordError
        If there is none, or it does not fit into the file.
    """
    form = OLD_HEADER if old else HEADER
    file.seek(offset)
    start = file.read(256)  # holds nearly every record's fields as well
    if len(start) < form.size:
        raise CutError(f"the file ends inside a record header, at byte {offset + len(start)}")
    magic, number, node, fields_end, payload_size, undone_offset = form.unpack_from(start)
    if magic != MAGIC:
        raise RecordError(f"a record must begin with 'NIR', found {magic!r}")
    try:
        kind = Kind(number)
    except ValueError:
        raise RecordError(f"there is no record of kind {number}") from None
    if not form.size <= fields_end <= MAX_FIELDS:
        raise RecordError(f"a {kind.name} record cannot have {fields_end} bytes of header")
    if payload_size > MAX_PAYLOAD and kind is not Kind.SEEK_TABLE:
        raise RecordError(f"a {kind.name} record cannot have {payload_size} bytes of payload")
    if len(start) < fields_end:
        start += file.read(fields_end - len(start))
    payload_offset = offset + fields_end
    if len(start) < fields_end or payload_offset + payload_size > size:
        missing = payload_offset + payload_size - size
        raise CutError(f"the file ends inside a {kind.name} record, {missing} bytes too early")
    fields = start[form.size : fields_end]
    return Record(offset, kind, node, fields, payload_offset, payload_size, undone_offset)


def pack_record(kind: Kind, node: int, fields: bytes = b"", payload: bytes = b"", undone_offset: int = 0) -> bytes:
    """Bytes of a record in the current version."""
    fields_end = HEADER.size + len(fields)
    header = HEADER.pack(MAGIC, kind, node, fields_end, len(payload), undone_offset)
    return header + fields + payload


def unpack_fields(record: Record, form: struct.Struct) -> tuple[int, ...]:
    """The fields of a record that has only numbers.

    Raises
    ------
    RecordError
        If they have another size.
    """
    if len(record.fields) != form.size:
        raise RecordError(f"it has {len(record.fields)} bytes of fields")
    return form.unpack(record.fields)


def parse_property(record: Record) -> tuple[str, bytes]:
    """Name and value of a property.

    Raises
    ------
    RecordError
        If the record breaks the format.
    """
    name, rest = split_text(record.fields)
    size = int.from_bytes(rest[:4], "little")
    value = rest[4:]
    if len(rest) < 4 or len(value) != size:
        raise RecordError(f"the property {name} says {size} bytes but has {len(value)}")
    if record.kind in (Kind.INT_PROPERTY, Kind.REAL_PROPERTY) and size != 8:
        raise RecordError(f"the number {name} has {size} bytes instead of 8")
    if record.kind is Kind.STRING_PROPERTY and not value.endswith(b"\0"):
        raise RecordError(f"the text {name} has no end")
    return name, value


def pack_property(name: str, value: bytes) -> bytes:
    """Fields of a property record."""
    return pack_text(name) + len(value).to_bytes(4, "little") + value


def pack_text(text: str) -> bytes:
    """A text as it stands at the beginning of fields: its length, the text, a zero."""
    data = text.encode("ascii") + b"\0"
    return len(data).to_bytes(4, "little") + data


def split_text(fields: bytes) -> tuple[str, bytes]:
    """The text at the beginning of fields, and what follows it.

    Raises
    ------
    RecordError
        If it is not plain, has no end or is longer than `MAX_NAME`.
    """
    size = int.from_bytes(fields[:4], "little")
    text = fields[4 : 4 + size]
    if not 1 <= size <= MAX_NAME or len(text) != size or text.find(b"\0") != size - 1:
        raise RecordError("its name is broken")
    if not text[:-1].isascii() or not text[:-1].decode("ascii").isprintable():
        raise RecordError(f"its name {text[:-1]!r} is not plain text")
    return text[:-1].decode("ascii"), fields[4 + size :]
