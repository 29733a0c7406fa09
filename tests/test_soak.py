"""Long runs: memory, files and threads stay as they are. `pytest -m slow tests/test_soak.py -s`."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from conftest import ROOT
from test_viewer import Listener
from virtual_sensor import VirtualSensor

from selective_depth.app import session as session_module
from selective_depth.app.session import Session
from selective_depth.app.settings import (
    AcquireOptions,
    RunOptions,
    Settings,
    ViewerOptions,
)
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.oni_writer import write_oni
from selective_depth.drivers.source import DepthSource, open_source

FRAMES = int(os.environ.get("SOAK_FRAMES", "10000"))
STOPPED_S = 30.0
STATM = Path("/proc/self/statm")
HELD = np.dtype([("megabytes", "f8"), ("files", "i8"), ("threads", "i8"), ("times_s", "f8")])


class Watched(DepthSource):
    """Another source, and what the process holds at each of its frames."""

    def __init__(self, source: DepthSource) -> None:
        self.source = source
        self.uri, self.camera, self.fps = source.uri, source.camera, source.fps
        self.frame_count, self.live, self.dropped = source.frame_count, source.live, 0
        # As large as it gets, and touched, from the start: what grows must be the app.
        self._rows = np.ones(2 * max(FRAMES, 1500), HELD)
        self._taken = 0

    @property
    def held(self) -> npt.NDArray[np.void]:
        """What the process held at each frame, and when."""
        return self._rows[: self._taken]

    def read(self, timeout_s: float = 5.0) -> DepthFrame:
        pages = int(STATM.read_text().split()[1])
        self._rows[self._taken] = (
            pages * os.sysconf("SC_PAGE_SIZE") / 1e6,
            len(os.listdir("/proc/self/fd")),  # noqa: PTH208 - a count is enough
            threading.active_count(),
            time.monotonic(),
        )
        self._taken += 1
        frame = self.source.read(timeout_s)
        self.dropped, self.state = self.source.dropped, self.source.state
        return frame

    def close(self) -> None:
        self.source.close()


@pytest.fixture(scope="module")
def desk_mm() -> npt.NDArray[np.uint16]:
    """The frames of the bundled recording."""
    with open_source(str(ROOT / "recordings" / "workstation")) as source:
        return np.stack([frame.depth_mm for frame in source])


LENGTHS = [300, pytest.param(FRAMES, marks=pytest.mark.slow)]


@pytest.mark.openni
@pytest.mark.skipif(not STATM.exists(), reason="memory is read from /proc")
@pytest.mark.parametrize("count", LENGTHS)
def test_a_sensor_can_be_watched_for_long(
    count: int,
    desk_mm: npt.NDArray[np.uint16],
    virtual_driver: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sensor = VirtualSensor(tmp_path / "sensor", desk_mm)
    for name, value in sensor.env.items():
        monkeypatch.setenv(name, value)
    check(count, "openni", tmp_path)


@pytest.mark.openni
@pytest.mark.skipif(not STATM.exists(), reason="memory is read from /proc")
@pytest.mark.parametrize("count", LENGTHS)
def test_a_long_recording_can_be_replayed(
    count: int,
    desk_mm: npt.NDArray[np.uint16],
    virtual_driver: Path,
    tmp_path: Path,
) -> None:
    camera = Camera.kinect()
    frames = (
        DepthFrame(desk_mm[index % len(desk_mm)], index, index * 33_333, camera)
        for index in range(count)
    )
    write_oni(tmp_path / "long.oni", frames)
    check(count, str(tmp_path / "long.oni"), tmp_path)


def check(count: int, uri: str, folder: Path) -> None:
    """Watch a source in a process of its own, whose memory is then that of the app alone."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as fresh:
        held, skipped = fresh.submit(soak, uri, count, folder).result()
    settled = count // 20
    megabytes, times_s = held["megabytes"], held["times_s"]
    slope = np.polyfit(np.arange(settled, len(megabytes)), megabytes[settled:], 1)[0] * 1000
    span = count // 10
    first, last = (
        span / (times_s[a + span - 1] - times_s[a - 1]) for a in (settled, len(times_s) - span)
    )
    print(
        f"\n{count} frames, {megabytes[settled]:.0f} to {megabytes[-1]:.0f} MB, {slope:+.2f} MB per"
        f" 1,000 frames; {first:.2f} then {last:.2f} frames/s, {skipped} skipped"
    )
    assert held["files"][-1] <= held["files"][settled], "files are left open"
    assert held["threads"][-1] <= held["threads"][settled], "threads are left running"
    assert megabytes.max() < 600
    if count >= 10_000:  # a shorter run says nothing of these
        assert slope < 1.0, "memory grows"
        assert abs(last / first - 1) < 0.03, "its speed changes"


def soak(uri: str, count: int, folder: Path) -> tuple[npt.NDArray[np.void], int]:
    """Watch a source for so many frames, both selectors and a budget, everything saved.

    Returns what the process held, and how many frames were skipped.
    """
    os.environ.setdefault("RUST_LOG", "off")
    watched = Watched(open_source(uri))
    session_module.open_source = lambda _: watched
    settings = Settings(
        acquire=AcquireOptions(budget=0.05),
        run=RunOptions(frames=count),
        viewer=ViewerOptions(headless=True, save=folder / "soak.rrd"),
    )
    session = Session(uri, settings)
    assert session.run() == 0
    assert session.report.frames == count
    return watched.held, session.report.dropped


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
    gaps_s = np.diff(source.held["times_s"][100:])
    megabytes = source.held["megabytes"]
    grown = megabytes.max() - megabytes[300]
    print(
        f"\n{1 / gaps_s.mean():.1f} frames/s, longest gap {gaps_s.max() * 1000:.0f} ms,"
        f" {source.dropped} skipped, {session.report.missed}, {grown:+.0f} MB at most"
    )
    assert 1 / gaps_s.mean() > 29
    assert max(session.report.missed.values()) > 20 * STOPPED_S, "the viewer was not stopped"
    assert grown < 550, "memory grows with what the viewer does not take"
