"""Damaged .oni files, by the thousand: what OpenNI2 does with them, and what users get to see.

Each file goes to OpenNI2 with no check at all (`raw_oni_player`), to `inspect_oni`, to `OniReader`
and to the source that the app opens. The short form runs in CI; the long one, 1,000 mutations and
50 cuts, by ``pytest -m slow tests/drivers/oni/test_fuzz.py -s``, which prints its figures.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import OniSample
from oni_mutations import cuts, mutations
from raw_oni_player import Outcome, digest_of, play_all

from selective_depth.drivers.errors import DamagedRecordingError, SourceError
from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.oni import OniReader, inspect_oni, repair_oni
from selective_depth.drivers.open import open_source
from selective_depth.drivers.openni.runtime import find_runtime
from selective_depth.drivers.source import DepthSource

TIME_LIMIT_S = 10.0

pytestmark = pytest.mark.openni


@pytest.fixture
def sound(oni_sample: OniSample) -> bytes:
    """A short recording of the real recorder, without the zeros that it leaves behind the end."""
    report = inspect_oni(oni_sample.path)
    return oni_sample.path.read_bytes()[: report.size_bytes - report.tail_bytes]


def test_short(sound: bytes, tmp_path: Path) -> None:
    _fuzz(sound, tmp_path, mutated=20, cut=6, seed=1)


def test_repaired_files_replay_through_openni2(sound: bytes, tmp_path: Path) -> None:
    _replay_repaired(sound, tmp_path, mutated=8, cut=4, seed=5)


@pytest.mark.slow
def test_repaired_files_replay_through_openni2_long(sound: bytes, tmp_path: Path) -> None:
    print(_replay_repaired(sound, tmp_path, mutated=300, cut=40, seed=6))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2])
def test_long(sound: bytes, tmp_path: Path, seed: int) -> None:
    print(_fuzz(sound, tmp_path, mutated=1000, cut=50, seed=seed))


def _fuzz(sound: bytes, folder: Path, *, mutated: int, cut: int, seed: int) -> Counter[str]:
    """Try all damaged files; return how many fared how."""
    names: list[str] = []

    def files() -> Iterator[Path]:
        for name, data in [*cuts(sound, cut), *mutations(sound, mutated, seed)]:
            names.append(name)
            path = folder / "damaged.oni"
            path.write_bytes(data)
            yield path

    original = folder / "sound.oni"
    original.write_bytes(sound)
    expected = _deliver(OniReader(original))[0]
    counts: Counter[str] = Counter()
    for outcome in play_all(files(), find_runtime().path):
        counts.update(_try(names[-1], folder / "damaged.oni", outcome, expected))
    assert len(names) == mutated + cut
    return counts


def _replay_repaired(sound: bytes, folder: Path, *, mutated: int, cut: int, seed: int) -> Counter[str]:
    """Repair damaged files and give what comes out to OpenNI2; return how many fared how."""
    damaged, repaired = folder / "damaged.oni", folder / "repaired.oni"
    names: list[str] = []
    counts: Counter[str] = Counter()

    def files() -> Iterator[Path]:
        for name, data in [*cuts(sound, cut), *mutations(sound, mutated, seed)]:
            damaged.write_bytes(data)
            repaired.unlink(missing_ok=True)
            try:
                repair_oni(damaged, repaired)
            except DamagedRecordingError:
                counts["no frame readable"] += 1
                continue
            names.append(name)
            yield repaired

    for outcome in play_all(files(), find_runtime().path, patience_s=3.0):
        with OniReader(repaired) as reader:
            frames = [(f.index + 1, *f.shape, f.depth_mm.tobytes()) for f in reader]
        assert (outcome.frames, outcome.digest) == digest_of(frames), f"{names[-1]}: {outcome}"
        counts["files repaired"] += 1
        counts["frames saved"] += outcome.frames
    assert counts["files repaired"] > 0
    return counts


def _try(name: str, path: Path, outcome: Outcome, expected: list[DepthFrame]) -> Iterator[str]:
    """Check what is made of one damaged file; yield what to count."""
    quick, thorough = _timed(name, path, decode=False), _timed(name, path, decode=True)
    yield f"OpenNI2 alone: {outcome.ended}; check: {'openable' if quick else 'refused'}"
    assert quick >= thorough, f"{name}: decoding made a file better"
    read, error = _deliver_timed(name, path, OniReader)
    _assert_valid(name, read, expected)
    yield f"read here: {error or 'all frames'}"

    right = digest_of((f.index + 1, *f.shape, f.depth_mm.tobytes()) for f in read)
    exact = thorough and not inspect_oni(path, decode=True).swapped_frames
    if quick and not _fits(outcome, right if exact else None):
        # OpenNI2 may be late, and it has a race of its own at closing; damage shows every time.
        yield "played again"
        outcome = next(play_all([path], find_runtime().path, patience_s=3.0))
        assert _fits(outcome, right if exact else None), f"{name}: openable, but {outcome}"

    shown, error = _deliver_timed(name, path, open_source)
    _assert_valid(name, shown, expected)
    yield f"app: {error or 'all frames'}"
    if _differing(read, expected):
        yield "read here: files with wrong pixels that nothing can tell"
    if _differing(shown, expected):
        yield "app: files with wrong pixels that nothing told"


def _fits(outcome: Outcome, right: tuple[int, str] | None) -> bool:
    """True if OpenNI2 lived, and delivered the right frames where these are known."""
    return outcome.unharmed and right in (None, (outcome.frames, outcome.digest))


def _timed(name: str, path: Path, *, decode: bool) -> bool:
    start = time.monotonic()
    openable = inspect_oni(path, decode=decode).openable
    assert time.monotonic() - start < TIME_LIMIT_S, f"{name}: checking took too long"
    return openable


def _deliver_timed(name: str, path: Path, opened: type[OniReader] | object) -> tuple[list[DepthFrame], str]:
    start = time.monotonic()
    try:
        result = _deliver(opened(path))  # type: ignore[operator]
    except SourceError as error:
        result = [], type(error).__name__
    assert time.monotonic() - start < TIME_LIMIT_S, f"{name}: reading took too long"
    return result


def _deliver(source: DepthSource) -> tuple[list[DepthFrame], str]:
    """Frames that a source delivers, and the name of the error that ends them."""
    frames = []
    with source:
        try:
            frames.extend(source)
        except SourceError as error:
            return frames, type(error).__name__
    return frames, ""


def _assert_valid(name: str, frames: list[DepthFrame], expected: list[DepthFrame]) -> None:
    for index, frame in enumerate(frames):
        assert frame.index == index, f"{name}: frame {index} is numbered {frame.index}"
        assert frame.shape == expected[0].shape, f"{name}: frame {index} is {frame.shape}"


def _differing(frames: list[DepthFrame], expected: list[DepthFrame]) -> int:
    return sum(
        not np.array_equal(frame.depth_mm, original.depth_mm) for frame, original in zip(frames, expected, strict=False)
    )
