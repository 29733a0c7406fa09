"""Ways to damage an .oni file, for the fuzz tests."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator

_MAGIC = b"NIR\0"
_EXTREMES = (0, 1, 2, 27, 0x7F, 0xFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFE, 0xFFFFFFFF)


def mutations(data: bytes, count: int, seed: int) -> Iterator[tuple[str, bytes]]:
    """`count` damaged copies of a file, each with what was done to it."""
    ways: list[Callable[[bytearray, random.Random], str]] = [
        _flip_anywhere,
        _flip_in_front,
        _change_record,
        _change_record,
        _change_property,
        _change_block,
    ]
    for number in range(count):
        draw = random.Random(seed * 1_000_003 + number)
        damaged = bytearray(data)
        what = draw.choice(ways)(damaged, draw)
        yield f"mutation {seed}/{number}: {what}", bytes(damaged)


def cuts(data: bytes, count: int) -> Iterator[tuple[str, bytes]]:
    """The file cut at `count` places: evenly, and closely around its records."""
    records = [at + shift for at in _records(data) for shift in (0, 4, 20, 28, 40)]
    draw = random.Random(count)
    even = [len(data) * part // count for part in range(count // 2)]
    for place in sorted(even + draw.sample(records, count - len(even))):
        yield f"cut at {place}", data[:place]


def _records(data: bytes) -> list[int]:
    found, at = [], data.find(_MAGIC)
    while at >= 0:
        found.append(at)
        at = data.find(_MAGIC, at + 1)
    return found


def _flip(damaged: bytearray, draw: random.Random, end: int) -> str:
    places = [draw.randrange(end) for _ in range(draw.choice((1, 1, 1, 2, 8)))]
    for place in places:
        damaged[place] ^= draw.randrange(1, 256)
    return f"bytes {places} flipped"


def _flip_anywhere(damaged: bytearray, draw: random.Random) -> str:
    return _flip(damaged, draw, len(damaged))


def _flip_in_front(damaged: bytearray, draw: random.Random) -> str:
    return _flip(damaged, draw, min(1200, len(damaged)))


def _change_record(damaged: bytearray, draw: random.Random) -> str:
    """Put an extreme number into a record's header or its first fields."""
    place = draw.choice(_records(bytes(damaged))) + 4 * draw.randrange(11)
    value = draw.choice((*_EXTREMES, draw.getrandbits(32)))
    damaged[place : place + 4] = value.to_bytes(4, "little")
    return f"byte {place} set to {value}"


def _change_property(damaged: bytearray, draw: random.Random) -> str:
    """Put an extreme number somewhere before the first frame."""
    place = draw.randrange(min(1200, len(damaged) - 4))
    value = draw.choice((*_EXTREMES, draw.getrandbits(32)))
    damaged[place : place + 4] = value.to_bytes(4, "little")
    return f"byte {place} set to {value}"


def _change_block(damaged: bytearray, draw: random.Random) -> str:
    """Zero, remove or repeat a piece of the file, as broken disks and copies do."""
    length = draw.choice((1, 28, 512, 4096, 65536))
    start = draw.randrange(max(1, len(damaged) - length))
    block = bytes(damaged[start : start + length])
    what = draw.choice(("zeroed", "removed", "repeated"))
    replacement = {"zeroed": bytes(len(block)), "removed": b"", "repeated": block + block}[what]
    damaged[start : start + length] = replacement
    return f"{length} bytes from {start} {what}"
