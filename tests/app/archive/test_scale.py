"""What the engine costs, what a second worker brings, and how time and memory grow with the archive."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from archives import QUICK, finish, start, wait_for, write

from selective_depth.app.archive import Batch, Job, engine
from selective_depth.app.archive.batch import recordings
from selective_depth.app.archive.unit import do_recording
from selective_depth.app.commands.batch import Keeping
from selective_depth.app.settings import AcquireOptions, RunOptions, Settings

pytestmark = pytest.mark.slow
SETTINGS = Settings(acquire=AcquireOptions(budget=0.05), run=RunOptions(threads=1))


def seconds_of(out: Path, words: list[str], workers: int) -> float:
    """How long the engine takes, from workers that have compiled their kernels."""
    with engine(workers=workers) as client:
        Batch(Job(out / "warm", SETTINGS, Keeping()), words[: 2 * workers]).run(client)
        began_s = time.monotonic()
        batch = Batch(Job(out / "timed", SETTINGS, Keeping()), words)
        batch.run(client)
        assert batch.done == len(words) and not batch.failures
        return time.monotonic() - began_s


def plain_seconds_of(out: Path, words: list[str]) -> float:
    """How long a loop in this process takes over the same."""
    job = Job(out, SETTINGS, Keeping())
    found = list(recordings(words))
    do_recording(Job(out / "warm", SETTINGS, Keeping()), found[0])
    began_s = time.monotonic()
    for each in found:
        do_recording(job, each)
    return time.monotonic() - began_s


@pytest.fixture
def frames(tmp_path: Path) -> Iterator[list[str]]:
    """Twelve recordings of 20 frames at 640x480, and two idle processors."""
    if len(os.sched_getaffinity(0)) < 2 or os.getloadavg()[0] > 0.6:
        pytest.skip("two idle processors are needed to tell what a second worker brings")
    for number in range(12):
        write(tmp_path / f"{number}.oni", "workstation", 20, number, size="640x480")
    yield [str(tmp_path / f"{number}.oni") for number in range(12)]


def test_engine_costs_little_and_a_second_worker_brings_much(
    frames: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SELECTIVE_DEPTH_THREADS", "1")
    plain_s = plain_seconds_of(tmp_path / "plain", frames)
    one_s = seconds_of(tmp_path / "one", frames, 1)
    two_s = seconds_of(tmp_path / "two", frames, 2)
    print(f"plain loop {plain_s:.2f} s, one worker {one_s:.2f} s, two {two_s:.2f} s")
    assert one_s <= 1.10 * plain_s
    assert one_s / two_s >= 1.8


def test_time_and_memory_grow_linearly(tmp_path: Path) -> None:
    """Folders of 5 frames of 64x48; the client's peak is that of its process, as the system counts it."""
    write(tmp_path / "one", "ball", 5, 1)
    sizes, took_s, peaks_mb = (1000, 3000, 6000), [], []
    for size in sizes:
        archive = tmp_path / f"archive{size}"
        for number in range(size):
            (archive / f"{number // 500:03}").mkdir(parents=True, exist_ok=True)
            (archive / f"{number // 500:03}" / f"{number:06}").symlink_to(tmp_path / "one")
        out = tmp_path / f"out{size}"
        process = start(archive, "--out", out, *QUICK)
        wait_for(lambda out=out: any(out.rglob("*.parquet")))
        began_s, peak_kb = time.monotonic(), 0
        while process.poll() is None:
            told = Path(f"/proc/{process.pid}/status").read_text()
            peak_kb = max([peak_kb, *(int(line.split()[1]) for line in told.splitlines() if line.startswith("VmHWM"))])
            time.sleep(0.05)
        took_s.append(time.monotonic() - began_s)
        peaks_mb.append(peak_kb / 1024)
        assert f"{size:,} recordings (0 not whole)" in finish(process).out
        print(f"{size:,} recordings: {took_s[-1]:.1f} s, client at most {peaks_mb[-1]:.0f} MB", flush=True)
    slope_s, _ = np.polyfit(sizes, took_s, 1)
    slope_mb, base_mb = np.polyfit(sizes, peaks_mb, 1)
    print(f"100,000: {slope_s * 1e5 / 60:.0f} min, {base_mb + slope_mb * 1e5:.0f} MB")
    assert base_mb + max(slope_mb, 0) * 1e5 <= 500
    straight = np.polyval(np.polyfit(sizes, took_s, 1), sizes)
    assert np.all(np.abs(straight - took_s) <= 0.2 * np.array(took_s))
