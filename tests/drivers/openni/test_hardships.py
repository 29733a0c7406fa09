"""What befalls a sensor's process from outside: killed, stopped for a while, two at once, clocks that jump."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from virtual_sensor import VirtualSensor

from selective_depth.drivers.errors import DeviceLostError, SourceTimeoutError
from selective_depth.drivers.oni import inspect_oni
from selective_depth.drivers.openni import OpenNIDevice, record
from selective_depth.drivers.openni.device import OpenNIDevice as Watched

pytestmark = pytest.mark.openni

LIVE = ("live", "--headless", "--seeds.rows", "24", "--seeds.columns", "32", "--gas.nodes", "60")


def kill_and_read_on(times: int) -> float:
    """Kill the sensor's process at random moments; the longest time to the next frame."""
    draw, longest = random.Random(3), 0.0
    with OpenNIDevice() as device:
        for _ in range(times):
            last = device.read()
            time.sleep(draw.uniform(0, 0.2))
            os.kill(device._worker._process.pid, signal.SIGKILL)
            killed_s, restarts = time.monotonic(), device.restarts
            while device.restarts == restarts:
                assert time.monotonic() < killed_s + 10
                time.sleep(0.005)
            while True:
                try:
                    frame = device.read(timeout_s=0.2)
                    break
                except (DeviceLostError, SourceTimeoutError):
                    assert time.monotonic() < killed_s + 10
            assert frame.index > last.index and frame.timestamp_us > last.timestamp_us
            longest = max(longest, time.monotonic() - killed_s)
    return longest


def test_a_killed_process_is_started_again(virtual_sensor: VirtualSensor) -> None:
    kill_and_read_on(3)


@pytest.mark.slow
def test_at_a_hundred_moments(virtual_sensor: VirtualSensor) -> None:
    print(f"longest: {kill_and_read_on(100):.2f} s")


def kill_while_recording(folder: Path, times: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Kill the sensor's process while it is recorded: the file ends whole, with every frame that was told."""
    opened: list[OpenNIDevice] = []

    class Kept(Watched):
        def __init__(self, *given: object, **more: object) -> None:
            super().__init__(*given, **more)  # type: ignore[arg-type]
            opened.append(self)

    monkeypatch.setattr("selective_depth.drivers.openni.recorder.OpenNIDevice", Kept)
    draw = random.Random(4)
    for number in range(times):
        opened.clear()
        wait_s = draw.uniform(0.1, 0.5)

        def kill(wait_s: float = wait_s) -> None:
            while not opened:
                time.sleep(0.005)
            time.sleep(wait_s)
            os.kill(opened[0]._worker._process.pid, signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        out = folder / f"{number}.oni"
        report = record(out)
        killer.join()
        assert "OpenNI2 crashed (SIGKILL)" in report.ended
        if report.frames:
            assert report.problem == "" or "did not arrive" in report.problem  # on a busy machine
            found = inspect_oni(out, decode=True)
            assert found.complete and found.readable_frames == report.frames
            out.unlink()


def test_a_recording_whose_sensor_process_is_killed_is_whole(
    virtual_sensor: VirtualSensor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kill_while_recording(tmp_path, 2, monkeypatch)


@pytest.mark.slow
def test_a_hundred_recordings(virtual_sensor: VirtualSensor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kill_while_recording(tmp_path, 100, monkeypatch)


def test_two_sensors_at_once_and_one_of_them_killed(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(devices=2, serial0="A", serial1="B")
    with OpenNIDevice("virtual://0") as one, OpenNIDevice("virtual://1") as other:
        assert (one.device.serial, other.device.serial) == ("A", "B")
        for _ in range(10):
            assert one.read().depth_mm.any() and other.read().depth_mm.any()
        os.kill(one._worker._process.pid, signal.SIGKILL)
        seen = [other.read() for _ in range(20)]
        assert other.restarts == 0 and np.diff([frame.index for frame in seen]).min() >= 1
        deadline = time.monotonic() + 10
        while one.restarts == 0 or one._newest is None:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert one.device.serial == "A" and one.read().depth_mm.any()


def test_times_out_of_order_go_on_rising_and_that_is_said(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(clock=4)
    with OpenNIDevice() as device:
        times = [device.read().timestamp_us for _ in range(30)]
        assert np.diff(times).min() > 0 and times[-1] - times[0] < 3_000_000
        assert sum("jumps back" in note for note in device.notes) == 1


def process_tree(pid: int) -> list[int]:
    """A process and all that it started, as Linux tells it."""
    found = [pid]
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        found += process_tree(int(child))
    return found


def sleep_through(tmp_path: Path, seconds: float) -> None:
    """All processes of a live run stop, as on a laptop that is closed, and go on."""
    command = [sys.executable, "-m", "selective_depth.app", *LIVE, "--save", str(tmp_path / "x.rrd"), "--frames", "120"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as run:
        deadline = time.monotonic() + 60
        saved = tmp_path / "x.rrd"
        while len(tree := process_tree(run.pid)) < 2 or not saved.exists() or saved.stat().st_size < 300_000:
            assert time.monotonic() < deadline and run.poll() is None
            time.sleep(0.05)
        for pid in tree:
            os.kill(pid, signal.SIGSTOP)
        time.sleep(seconds)
        for pid in tree:
            os.kill(pid, signal.SIGCONT)
        printed, _ = run.communicate(timeout=60)
    assert run.returncode == 0, printed
    assert "frames" in printed and "120" in printed and "sensor at the end" in printed and "live" in printed


def test_a_run_that_was_stopped_goes_on(virtual_sensor: VirtualSensor, tmp_path: Path) -> None:
    sleep_through(tmp_path, 2)


@pytest.mark.slow
def test_a_laptop_that_was_closed_for_twenty_seconds(virtual_sensor: VirtualSensor, tmp_path: Path) -> None:
    sleep_through(tmp_path, 20)


@pytest.mark.slow
def test_a_wall_clock_that_jumps_a_day_changes_nothing(virtual_sensor: VirtualSensor, tmp_path: Path) -> None:
    libraries = sorted(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1"))
    if not libraries:
        pytest.skip("no libfaketime: apt install libfaketime")
    clock = tmp_path / "clock"
    clock.write_text("+0d\n")
    env = os.environ | {
        "LD_PRELOAD": str(libraries[0]),
        "FAKETIME_TIMESTAMP_FILE": str(clock),
        "FAKETIME_CACHE_DURATION": "1",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
    }
    command = [sys.executable, "-m", "selective_depth.app", *LIVE, "--save", str(tmp_path / "x.rrd"), "--frames", "90"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=env) as run:
        for way in ("+1d", "-1d", "+400d", "+0d"):
            time.sleep(1.2)
            clock.write_text(f"{way}\n")
        printed, _ = run.communicate(timeout=90)
    assert run.returncode == 0, printed
    assert "sensor at the end" in printed and "live" in printed and "reconnecting" not in printed
