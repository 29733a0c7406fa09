"""The depth compression of .oni files against a slow reference, written down as the table says."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from selective_depth.drivers.oni.codec import decode_depth, encode_depth
from selective_depth.drivers.oni.records import CODEC_NONE, CODEC_PLAIN, CODEC_TABLE

Depth = npt.NDArray[np.uint16]


def _reference_decode(coded: bytes, table: list[int] | None) -> list[int] | None:
    """Values of a code, None if it is no code; without a table the values are depths."""
    if len(coded) < 2:
        return None
    values = [coded[0] + 256 * coded[1]]
    rest = list(coded[2:])

    def step(nibble: int) -> None:
        values.append((values[-1] - (nibble - 6)) % 65536)

    def full() -> bool:
        if not rest:
            return False
        byte = rest.pop(0)
        if byte >= 128:
            values.append((values[-1] - (byte - 192)) % 65536)
            return True
        if not rest:
            return False
        values.append(256 * byte + rest.pop(0))
        return True

    while rest:
        byte = rest.pop(0)
        first, second = byte >> 4, byte & 15
        if byte == 0xFF:
            if not full():
                return None
        elif first == 0xE and second > 0:
            values += [values[-1]] * (2 * second)
        elif first <= 12 and second != 14:
            if second == 13:
                if len(rest) > 1 or (rest and not 0xE1 <= rest[0] <= 0xEF):
                    return None
                values += [values[-1]] * (2 * (rest.pop() - 0xE0) if rest else 0)
            step(first)
            if second == 15:
                if not full():
                    return None
            elif second != 13:
                step(second)
        else:
            return None
    if table is None:
        return values
    return [table[value] for value in values] if max(values) < len(table) else None


def _walks(rows: int, columns: int) -> st.SearchStrategy[Depth]:
    """Frames as sensors see them: small steps, runs, holes, jumps."""
    steps = st.sampled_from([0] * 12 + [1, -1, 5, 6, -6, 7, -7, 63, -63, 64, -64, 3000, -9000])
    return st.lists(steps, min_size=rows * columns, max_size=rows * columns).map(
        lambda taken: (np.cumsum(taken) % 65536).astype(np.uint16).reshape(rows, columns)
    )


_SIZES = st.tuples(st.integers(1, 12), st.integers(1, 12))
_FRAMES = _SIZES.flatmap(
    lambda size: (
        _walks(*size)
        | hnp.arrays(np.uint16, size)
        | st.builds(lambda value: np.full(size, value, np.uint16), st.integers(0, 65535))
    )
)


@settings(max_examples=300, deadline=None)
@given(depth_mm=_FRAMES)
def test_what_is_encoded_is_decoded_bit_by_bit_here_and_by_the_reference(depth_mm: Depth) -> None:
    payload = encode_depth(depth_mm)
    decoded = decode_depth(CODEC_TABLE, payload, *depth_mm.shape)
    assert decoded is not None
    np.testing.assert_array_equal(decoded, depth_mm)
    entries = int.from_bytes(payload[:2], "little")
    table = np.frombuffer(payload, "<u2", entries, 2).tolist()
    assert table == sorted(set(depth_mm.reshape(-1).tolist()))
    assert _reference_decode(payload[2 + 2 * entries :], table) == depth_mm.reshape(-1).tolist()


@settings(max_examples=500, deadline=None)
@given(
    first=st.integers(0, 65535),
    body=st.lists(
        st.sampled_from([0x00, 0x66, 0x6D, 0x6F, 0xCC, 0xE1, 0xEF, 0xFF, 0x80, 0xC1, 0x12]) | st.integers(0, 255),
        max_size=20,
    ),
    short=st.integers(-1, 1),
)
def test_any_bytes_decode_as_the_reference_says_or_not_at_all(first: int, body: list[int], short: int) -> None:
    coded = first.to_bytes(2, "little") + bytes(body)
    expected = _reference_decode(coded, None)
    pixels = max(1, (len(expected) if expected else len(body)) + short)
    decoded = decode_depth(CODEC_PLAIN, coded, 1, pixels)
    if expected is None or len(expected) != pixels:
        assert decoded is None
    else:
        assert decoded is not None and decoded.tolist() == [expected]


@settings(max_examples=200, deadline=None)
@given(payload=st.binary(max_size=60), codec=st.sampled_from([CODEC_TABLE, CODEC_PLAIN]))
def test_any_payload_gives_a_frame_of_the_right_size_or_none(payload: bytes, codec: bytes) -> None:
    decoded = decode_depth(codec, payload, 3, 4)
    assert decoded is None or (decoded.shape == (3, 4) and decoded.dtype == np.uint16)


@pytest.mark.parametrize(
    ("payload", "expected"),
    [
        ("0a00 66", [10, 10, 10]),
        ("0a00 05", [10, 16, 17]),
        ("0a00 c6", [10, 4, 4]),
        ("0a00 6d", [10, 10]),
        ("0a00 5f d0", [10, 11, 65531]),
        ("0a00 ff 81", [10, 73]),
        ("0a00 ff 1234", [10, 0x1234]),
        ("0a00 e2", [10] * 5),
        ("ffff 56", [65535, 0, 0]),
    ],
)
def test_codes_mean_what_the_table_says(payload: str, expected: list[int]) -> None:
    decoded = decode_depth(CODEC_PLAIN, bytes.fromhex(payload), 1, len(expected))
    assert decoded is not None and decoded.tolist() == [expected]


@pytest.mark.parametrize(
    "payload",
    ["", "0a", "0a00 e0", "0a00 f1 00", "0a00 d6", "0a00 6e", "0a00 ff", "0a00 ff 12", "0a00 6f", "0a00 6d 66"],
)
def test_codes_that_no_encoder_makes_are_damage(payload: str) -> None:
    for pixels in range(1, 8):
        if payload or pixels > 1:
            assert decode_depth(CODEC_PLAIN, bytes.fromhex(payload), 1, pixels) is None


def test_uncompressed_frames_are_read() -> None:
    depth_mm = np.array([[1, 2, 65535], [0, 9, 256]], np.uint16)
    payload = depth_mm.astype("<u2").tobytes()
    decoded = decode_depth(CODEC_NONE, payload, 2, 3)
    assert decoded is not None
    np.testing.assert_array_equal(decoded, depth_mm)
    assert decode_depth(CODEC_NONE, payload[:-1], 2, 3) is None


def test_a_table_out_of_order_or_too_short_is_damage() -> None:
    good = bytes.fromhex("0200 0500 0900 0000 5d")
    decoded = decode_depth(CODEC_TABLE, good, 1, 2)
    assert decoded is not None and decoded.tolist() == [[5, 9]]
    assert decode_depth(CODEC_TABLE, bytes.fromhex("0200 0900 0500 0000 5d"), 1, 2) is None
    assert decode_depth(CODEC_TABLE, bytes.fromhex("0100 0500 0000 5d"), 1, 2) is None
    assert decode_depth(CODEC_TABLE, bytes.fromhex("ff00 0500"), 1, 2) is None
    assert decode_depth(CODEC_TABLE, bytes.fromhex("0000 0000"), 1, 1) is None


@pytest.mark.parametrize("swapped", [False, True])
def test_a_run_before_a_lone_last_pixel_is_restored(swapped: bool) -> None:
    """OpenNI2's own encoder writes the last pixel before the run that precedes it."""
    payload = encode_depth(np.array([[7, 7, 7, 8]], np.uint16))
    assert payload[-2:] == b"\xe1\x5d"
    if swapped:
        payload = payload[:-2] + payload[:-3:-1]
    decoded = decode_depth(CODEC_TABLE, payload, 1, 4)
    assert decoded is not None and decoded.tolist() == [[7, 7, 7, 8]]


def test_too_many_different_depths_are_refused_with_a_sentence() -> None:
    encode_depth(np.arange(32768, dtype=np.uint16).reshape(256, 128))
    with pytest.raises(ValueError, match=r"32769 different depths; .* at most 32768"):
        encode_depth(np.arange(32769, dtype=np.uint16).reshape(1, -1))
