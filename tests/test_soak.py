"""Long runs: memory, files and threads stay as they are. `pytest -m slow tests/test_soak.py -s`."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from test_viewer import Listener

from selective_depth.app import session as session_module
from selective_depth.app.session import Session
from selective_depth.app.settings import (
    AcquireOptions,
    GasOptions,
    RunOptions,
    SeedOptions,
    Settings,
    ViewerOptions,
)
from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.source import DepthSource, open_source

FRAMES = int(os.environ.get("SOAK_FRAMES", "10000"))
SETTLED = 500
STOPPED_S = 30.0
STATM = Path("/proc/self/statm")


class Watched(DepthSource):
    """Another source, and what the process holds at each of its frames."""

    def __init__(self, source: DepthSource) -> None:
        self.source = source
        self.uri, self.camera, self.fps = source.uri, source.camera, source.fps
        self.frame_count, self.live, self.dropped = source.frame_count, source.live, 0
        self.megabytes: list[float] = []
        self.files: list[int] = []
        self.threads: list[int] = []
        self.times_s: list[float] = []

    def read(self, timeout_s: float = 5.0) -> DepthFrame:
        pages = int(STATM.read_text().split()[1])
        self.megabytes.append(pages * os.sysconf("SC_PAGE_SIZE") / 1e6)
        self.files.append(len(os.listdir("/proc/self/fd")))  # noqa: PTH208 - a count is enough
        self.threads.append(threading.active_count())
        self.times_s.append(time.monotonic())
        frame = self.source.read(timeout_s)
        self.dropped, self.state = self.source.dropped, self.source.state
        return frame

    def close(self) -> None:
        self.source.close()


@pytest.mark.slow
@pytest.mark.skipif(not STATM.exists(), reason="memory is read from /proc")
@pytest.mark.parametrize("live", [False, True], ids=["replay", "live"])
def test_memory_files_and_threads_stay_flat(
    live: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    uri = f"virtual:workstation?size=160x120&frames={FRAMES}&live={int(live)}"
    source = Watched(open_source(uri))
    monkeypatch.setattr(session_module, "open_source", lambda _: source)
    settings = Settings(
        seeds=SeedOptions(48, 64),
        gas=GasOptions(nodes=500),
        acquire=AcquireOptions(budget=0.05),
        run=RunOptions(frames=FRAMES - FRAMES // 10),
        viewer=ViewerOptions(headless=True, save=tmp_path / "soak.rrd"),
    )
    session = Session(uri, settings)
    assert session.run() == 0
    count = len(source.megabytes)
    slope = np.polyfit(np.arange(SETTLED, count), source.megabytes[SETTLED:], 1)[0] * 1000
    first, last = (np.diff(source.times_s[a:b]).mean() for a, b in ((SETTLED, 1500), (-1000, None)))
    print(
        f"\n{count} frames, {source.megabytes[SETTLED]:.0f} to {source.megabytes[-1]:.0f} MB,"
        f" {slope:+.2f} MB per 1,000 frames; {1 / first:.1f} then {1 / last:.1f} frames/s"
    )
    assert slope < 1.0, "memory grows"
    assert source.files[-1] <= source.files[SETTLED], "files are left open"
    assert source.threads[-1] <= source.threads[SETTLED], "threads are left running"
    assert source.megabytes[-1] < 600


@pytest.mark.slow
@pytest.mark.skipif(not STATM.exists(), reason="memory is read from /proc")
def test_a_viewer_stopped_for_half_a_minute_slows_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both selectors on a live source, saved and sent to a viewer that is stopped meanwhile."""
    source = Watched(open_source("virtual:workstation?size=320x240&live=1"))
    monkeypatch.setattr(session_module, "open_source", lambda _: source)
    listener = Listener()
    viewer = listener.process
    stop = threading.Timer(15.0, viewer.send_signal, (signal.SIGSTOP,))
    resume = threading.Timer(15.0 + STOPPED_S, viewer.send_signal, (signal.SIGCONT,))
    settings = Settings(
        run=RunOptions(frames=30 * int(20 + STOPPED_S)),
        viewer=ViewerOptions(
            headless=True,
            save=tmp_path / "soak.rrd",
            connect=f"rerun+http://127.0.0.1:{listener.port}/proxy",
        ),
    )
    try:
        stop.start()
        resume.start()
        session = Session(source.uri, settings)
        assert session.run() == 0
    finally:
        stop.cancel()
        resume.cancel()
        viewer.send_signal(signal.SIGCONT)
        listener.kill()
    gaps_s = np.diff(source.times_s[100:])
    grown = max(source.megabytes) - source.megabytes[300]
    print(
        f"\n{1 / gaps_s.mean():.1f} frames/s, longest gap {gaps_s.max() * 1000:.0f} ms,"
        f" {source.dropped} skipped, {session.report.missed}, {grown:+.0f} MB at most"
    )
    assert 1 / gaps_s.mean() > 29
    assert max(session.report.missed.values()) > 20 * STOPPED_S, "the viewer was not stopped"
    assert grown < 550, "memory grows with what the viewer does not take"
