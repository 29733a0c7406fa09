"""Long runs: memory, files and threads stay. `pytest -m slow tests/app/test_soak.py -s`."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from conftest import ROOT
from rerun_listener import Listener
from virtual_sensor import VirtualSensor

from selective_depth.app.commands import session as session_module
from selective_depth.app.commands.session import Session
from selective_depth.app.settings import AcquireOptions, RunOptions, Settings, ViewerOptions
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.oni import write_oni
from selective_depth.drivers.open import open_source
from selective_depth.drivers.source import DepthSource

FRAMES = int(os.environ.get("SOAK_FRAMES", "10000"))
STOPPED_S = 30.0
STATM = Path("/proc/self/statm")
HELD = np.dtype([("megabytes", "f8"), ("files", "i8"), ("threads", "i8"), ("times_s", "f8")])
BLOCK, SETTLING = 20, 3
"""Frames of a turn, and those at its beginning that say nothing of the speed: the other run's last
are still being made meanwhile."""


class Turns:
    """Two processes that go on in turns, so that whatever else the machine does slows both alike.

    Parameters
    ----------
    other : Connection
        To the other process.
    first : int
        From this frame on they take turns.
    later : bool, default False
        Do not even begin before the other takes turns.
    """

    def __init__(self, other: Connection, first: int, *, later: bool = False) -> None:
        self._other, self._first, self._later = other, first, later

    def wait(self, index: int) -> None:
        """Hand over and wait, if a turn begins with this frame; go on alone if the other ended."""
        begins = index >= self._first and (index - self._first) % BLOCK == 0
        if begins:
            with suppress(ConnectionError):
                self._other.send(None)
        if begins or (self._later and index == 0):
            with suppress(EOFError):
                self._other.recv()


class Watched(DepthSource):
    """Another source, and what the process holds at each of its frames."""

    def __init__(self, source: DepthSource, turns: Turns | None = None) -> None:
        self.source, self._turns = source, turns
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
        if self._turns is not None:
            self._turns.wait(self._taken)
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
    with open_source(str(ROOT / "recordings" / "workstation.oni")) as source:
        return np.stack([frame.depth_mm for frame in source])


LENGTHS = [60, pytest.param(FRAMES, marks=pytest.mark.slow)]


@pytest.mark.openni
@pytest.mark.skipif(not STATM.exists(), reason="memory is read from /proc")
@pytest.mark.parametrize("count", LENGTHS)
def test_a_sensor_can_be_watched_for_long(
    count: int, desk_mm: npt.NDArray[np.uint16], virtual_driver: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sensor = VirtualSensor(tmp_path / "sensor", desk_mm, devices=2)
    for name, value in sensor.env.items():
        monkeypatch.setenv(name, value)
    check(count, ("openni:virtual://0", "openni:virtual://1"), tmp_path)


@pytest.mark.openni
@pytest.mark.skipif(not STATM.exists(), reason="memory is read from /proc")
@pytest.mark.parametrize("count", LENGTHS)
def test_a_long_recording_can_be_replayed(
    count: int, desk_mm: npt.NDArray[np.uint16], virtual_driver: Path, tmp_path: Path
) -> None:
    camera = Camera.kinect()
    frames = (DepthFrame(desk_mm[index % len(desk_mm)], index, index * 33_333, camera) for index in range(count))
    write_oni(tmp_path / "long.oni", frames)
    check(count, (str(tmp_path / "long.oni"),) * 2, tmp_path)


def check(count: int, uris: tuple[str, str], folder: Path) -> None:
    """Watch the first source in a process of its own, whose memory is then that of the app alone.

    Its last frames are made in turns with the first frames of the second source, in a second
    process: a machine that others use as well is not as fast in one minute as in another.
    """
    settled, span = count // 20, count // 10
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    long, fresh = folder / "long", folder / "fresh"
    runs = (
        (uris[0], long, count, Turns(here, count - span)),
        (uris[1], fresh, settled + span, Turns(there, settled, later=True)),
    )
    processes = [context.Process(target=soak, args=run) for run in runs]
    for process in processes:
        process.start()
    here.close()  # each process has its own end, and so learns when the other is gone
    there.close()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0, 0]
    held = np.load(long / "held.npy")
    megabytes = held["megabytes"]
    slope = np.polyfit(np.arange(settled, count), megabytes[settled:], 1)[0] * 1000
    last_s, first_s = turns_s(long, count - span), turns_s(fresh, settled)
    change = float(np.median(first_s / last_s)) - 1
    timed = BLOCK - SETTLING - 1
    print(
        f"\n{count} frames, {megabytes[settled]:.0f} to {megabytes[-1]:.0f} MB, {slope:+.2f} MB per"
        f" 1,000 frames; first {timed / first_s.mean():.2f} and last {timed / last_s.mean():.2f}"
        f" frames/s, median of {len(last_s)} turns {change:+.1%}"
    )
    assert held["files"][-1] <= held["files"][settled], "files are left open"
    assert held["threads"][-1] <= held["threads"][settled], "threads are left running"
    assert megabytes.max() < 600
    if count >= 10_000:  # a shorter run says nothing of these
        assert slope < 1.0, "memory grows"
        assert abs(change) < 0.03, "its speed changes"


def turns_s(folder: Path, first: int) -> npt.NDArray[np.float64]:
    """How long each turn of a run took, from this frame on."""
    times_s = np.load(folder / "held.npy")["times_s"]
    begins = np.arange(first, len(times_s) - BLOCK + 1, BLOCK)
    return times_s[begins + BLOCK - 1] - times_s[begins + SETTLING]


def soak(uri: str, folder: Path, count: int, turns: Turns) -> None:
    """Watch a source for so many frames, both selectors and a budget, everything saved.

    Writes what the process held at each frame beside it.
    """
    os.environ.setdefault("RUST_LOG", "off")
    folder.mkdir()
    watched = Watched(open_source(uri), turns)
    session_module.open_and_tell = lambda _: watched
    settings = Settings(
        acquire=AcquireOptions(budget=0.05),
        run=RunOptions(frames=count),
        viewer=ViewerOptions(headless=True, save=folder / "soak.rrd"),
    )
    session = Session(uri, settings)
    assert session.run() == 0
    assert session.report.frames == count
    print(f"{session.report.dropped} skipped")
    np.save(folder / "held.npy", watched.held)


@pytest.mark.slow
@pytest.mark.skipif(not STATM.exists(), reason="memory is read from /proc")
def test_a_viewer_stopped_for_half_a_minute_slows_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both selectors on a live source, saved and sent to a viewer that is stopped meanwhile."""
    source = Watched(open_source("virtual:workstation?size=320x240&live=1"))
    monkeypatch.setattr(session_module, "open_and_tell", lambda _: source)
    listener = Listener()
    viewer = listener.process
    stop = threading.Timer(15.0, viewer.send_signal, (signal.SIGSTOP,))
    resume = threading.Timer(15.0 + STOPPED_S, viewer.send_signal, (signal.SIGCONT,))
    settings = Settings(
        run=RunOptions(frames=30 * int(20 + STOPPED_S)),
        viewer=ViewerOptions(
            headless=True, save=tmp_path / "soak.rrd", connect=f"rerun+http://127.0.0.1:{listener.port}/proxy"
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
