"""The depth compression of .oni files: ``16zT``, its older form ``16zP``, and none at all.

Both are lossless. Pixels are read row by row as one sequence; each is told by its difference from
the one before. In ``16zT`` the sequence is not of depths but of their ranks in a table of all
depths that occur, which comes first (its length, then its entries, 16 bits little-endian each).
Then follow the first value, 16 bits, and bytes:

=============== =======================================================================
byte            meaning
=============== =======================================================================
``0xAB``        A, B <= 12: two differences, A - 6 and B - 6, to subtract
``0xAD``        one difference, A - 6: the last pixel
``0xAF``        one difference, A - 6, then a full value as after ``0xFF``
``0xE0 + n``    n <= 15: the value 2 n times more
``0xFF``        next byte b >= 128: difference b - 192; b < 128: value 256 b + next byte
=============== =======================================================================

OpenNI2's encoder has a flaw: a lone last pixel after a run is written before the run, and its
player then shows up to 28 wrong pixels in the corner of the image. No other use of ``0xAD`` before
a run is possible, so the true order is restored here. All other frames are those of OpenNI2 bit by
bit. Unlike its player, every byte is checked: a damaged payload is an error where that can be
known, and never an access out of bounds.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.kernels import njit
from selective_depth.drivers.oni.records import CODEC_NONE, CODEC_TABLE

MAX_DISTINCT: Final = 32768
"""Ranks have 15 bits, so that many different depths fit into one frame."""

_Bytes = npt.NDArray[np.uint8]
_Depth = npt.NDArray[np.uint16]


def decode_depth(codec: bytes, payload: bytes, height: int, width: int) -> _Depth | None:
    """Decode one frame.

    Parameters
    ----------
    codec : bytes
        One of `records.DEPTH_CODECS`.
    payload : bytes
        The compressed frame.
    height, width : int
        Its size in pixels.

    Returns
    -------
    uint16 array of shape (height, width), or None
        Depth as recorded; None if the payload is damaged.
    """
    if codec == CODEC_NONE:
        if len(payload) != 2 * height * width:
            return None
        return np.frombuffer(payload, "<u2").astype(np.uint16).reshape(height, width)
    depth = np.empty(height * width, np.uint16)
    coded = np.frombuffer(payload, np.uint8)
    table = np.empty(0, np.uint16)
    if codec == CODEC_TABLE:
        entries = int.from_bytes(payload[:2], "little")
        if entries == 0 or len(payload) < 2 + 2 * entries:
            return None
        table = np.frombuffer(payload, "<u2", entries, 2).astype(np.uint16)
        # Every encoder writes the table in order; one out of order is damaged.
        if np.any(table[1:] <= table[:-1]):
            return None
        coded = coded[2 + 2 * entries :]
    return depth.reshape(height, width) if _decode(coded, table, depth) else None


def encode_depth(depth_mm: _Depth, codec: bytes = CODEC_TABLE) -> bytes:
    """Encode one frame.

    Parameters
    ----------
    depth_mm : uint16 array of shape (height, width)
        Depth in millimetres.
    codec : bytes, default ``16zT``
        That, or ``NONE``.

    Raises
    ------
    ValueError
        If more than `MAX_DISTINCT` different depths occur, which only ``NONE`` can store.
    """
    if codec == CODEC_NONE:
        return depth_mm.astype("<u2").tobytes()
    flat = np.ascontiguousarray(depth_mm).reshape(-1)
    occurs = np.zeros(65536, np.bool_)
    occurs[flat] = True
    table = np.flatnonzero(occurs)
    if len(table) > MAX_DISTINCT:
        raise ValueError(
            f"a frame holds {len(table)} different depths; an .oni file stores at most {MAX_DISTINCT} in one frame"
        )
    rank = np.zeros(65536, np.uint16)
    rank[table] = np.arange(len(table), dtype=np.uint16)
    coded = np.empty(2 + 3 * flat.size, np.uint8)
    used = _encode(rank[flat], coded)
    head = len(table).to_bytes(2, "little") + table.astype("<u2").tobytes()
    return head + coded[:used].tobytes()


def is_swapped(payload: bytes, depth: _Depth) -> bool:
    """Whether the flaw that is described above shows in the ``16zT`` payload of a frame.

    That is in a run before a last pixel of another depth.
    """
    last, run = payload[-2:] if len(payload) > 4 else b"\0\0"
    if last & 0x0F != 0x0D or last >> 4 == 6 or not 0xE1 <= run <= 0xEF:
        return False
    # The two bytes may be parts of other codes.
    return encode_depth(depth) == payload[:-2] + bytes((run, last))


@njit(cache=True, nogil=True)
def _signed(value: np.integer) -> int:
    # Numba turns unsigned minus signed into floating point.
    return int(np.int64(value))


@njit(cache=True, nogil=True)
def _decode(coded: _Bytes, table: _Depth, depth: _Depth) -> bool:
    """Fill `depth` from `coded`; False if it does not fit exactly. An empty `table` means that there is none."""
    end = coded.size
    pixels = depth.size
    entries = table.size if table.size > 0 else 65536
    if end < 2 or pixels < 1:
        return False
    value = _signed(coded[0]) | _signed(coded[1]) << 8
    if value >= entries:
        return False
    depth[0] = table[value] if table.size > 0 else value
    at, pixel = 2, 1
    while at < end:
        byte = _signed(coded[at])
        at += 1
        run = 0
        if 0xE0 < byte < 0xF0:
            run = 2 * (byte - 0xE0)
        elif byte < 0xD0 and byte & 0x0F == 0x0D and at == end - 1:
            # The last pixel, written before the run that precedes it.
            run = 2 * (_signed(coded[at]) - 0xE0)
            at += 1
            if not 2 <= run <= 30:
                return False
        if pixel + run > pixels:
            return False
        for _ in range(run):
            depth[pixel] = depth[pixel - 1]
            pixel += 1
        if 0xE0 < byte < 0xF0:
            continue
        second = 0x0F
        if byte < 0xD0:
            value = (value - ((byte >> 4) - 6)) & 0xFFFF
            if value >= entries or pixel >= pixels:
                return False
            depth[pixel] = table[value] if table.size > 0 else value
            pixel += 1
            second = byte & 0x0F
            if second == 0x0E:
                return False
            if second == 0x0D:
                break
        elif byte != 0xFF:
            return False
        if second != 0x0F:
            value = (value - (second - 6)) & 0xFFFF
        else:
            if at >= end:
                return False
            byte = _signed(coded[at])
            at += 1
            if byte >= 0x80:
                value = (value - (byte - 192)) & 0xFFFF
            else:
                if at >= end:
                    return False
                value = byte << 8 | _signed(coded[at])
                at += 1
        if value >= entries or pixel >= pixels:
            return False
        depth[pixel] = table[value] if table.size > 0 else value
        pixel += 1
    return at == end and pixel == pixels


@njit(cache=True, nogil=True)
def _encode(values: _Depth, coded: _Bytes) -> int:
    """Write the code of `values`, each below 32768; return the number of bytes used."""
    last = _signed(values[0])
    coded[0], coded[1] = last & 0xFF, last >> 8
    used, run, half = 2, 0, -1
    for value_ in values[1:]:
        value = _signed(value_)
        difference = last - value
        last = value
        if -6 <= difference <= 6:
            if half < 0:
                half = difference + 6
                continue
            pair = half << 4 | (difference + 6)
            half = -1
            if pair == 0x66:
                run += 1
                if run < 15:
                    continue
                pair = -1
        else:
            pair = 0xFF if half < 0 else half << 4 | 0x0F
            half = -1
        if run > 0:
            coded[used] = 0xE0 + run
            used += 1
            run = 0
        if pair < 0:
            continue
        coded[used] = pair
        used += 1
        if pair & 0x0F == 0x0F:
            if -63 <= difference <= 63:
                coded[used] = difference + 192
                used += 1
            else:
                coded[used], coded[used + 1] = value >> 8, value & 0xFF
                used += 2
    if run > 0:
        coded[used] = 0xE0 + run
        used += 1
    if half >= 0:
        coded[used] = half << 4 | 0x0D
        used += 1
    return used
