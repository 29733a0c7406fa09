"""A short run of each fuzz target; the long one is ``make fuzz``."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from fuzzing import TARGETS, damaged, try_one

COUNT = 60


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_inputs_end_in_named_errors(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    target = TARGETS[name]
    inputs = target.make()
    for number, files in enumerate(inputs):
        assert try_one(target, files, tmp_path / f"sound {number}") == "read"
    outcomes = [try_one(target, damaged(inputs, seed), tmp_path / str(seed)) for seed in range(COUNT)]
    assert len(set(outcomes)) > 1  # some are still read, some are not
    printed = [line for line in capfd.readouterr().err.splitlines() if "TIFF" not in line and "tempfile" not in line]
    assert printed == []


def test_the_same_seed_damages_the_same_way() -> None:
    inputs = TARGETS["tum"].make()
    assert damaged(inputs, 7) == damaged(inputs, 7)
    assert len({tuple(damaged(inputs, seed).items()) for seed in range(30)}) > 25


# What a long run found, and what it was.
FOUND = [
    ("tum", {"depth.txt": b"1.5 " + b"a" * 5000 + b"/0.png\n"}),  # OSError: a name too long
    ("tum", {"depth.txt": b"1.5 depth/\0.png\n"}),  # ValueError: a null byte
    ("tum", {"depth.txt": b"1e300 depth/0.png\n1.6 depth/1.png\n"}),  # ValueError of the frame's timestamp
    ("settings", {"settings.toml": b"nodes = " + b"[" * 5000}),  # RecursionError
    ("folder", {"0.png": b"\x89PNG\r\n\x1a\n"}),
    ("folder", {"frames.toml": b"colour_timestamps_us = []\n"}),  # IndexError
]


@pytest.mark.parametrize(("name", "files"), FOUND)
def test_what_was_found_once_is_a_named_error(name: str, files: dict[str, bytes], tmp_path: Path) -> None:
    target = TARGETS[name]
    base = dict(target.make()[0]) if name == "tum" or "frames.toml" in files else {}
    assert try_one(target, base | files, tmp_path) not in ("read",)


def test_an_archive_whose_array_claims_gigabytes_allocates_nothing(tmp_path: Path) -> None:
    import io
    import zipfile

    import numpy as np

    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<u2", "fortran_order": False, "shape": (1 << 20, 480, 640)})
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("depth.npy", header.getvalue() + bytes(1000))
    for data in (packed.getvalue(), *itertools.islice(_flips(packed.getvalue()), 50)):
        assert try_one(TARGETS["arrays"], {"x.npz": data}, tmp_path) == "DamagedRecordingError"


def _flips(data: bytes) -> itertools.chain[bytes]:
    """The same with one byte after the other inverted."""
    return itertools.chain.from_iterable(
        [data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :]] for at in range(0, len(data), 23)
    )
