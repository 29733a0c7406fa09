"""Live sensors through the real OpenNI2 runtime, with every fault that a sensor has."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from virtual_sensor import VirtualSensor

from selective_depth.drivers.errors import (
    DeviceLostError,
    DeviceRefusedError,
    RuntimeMissingError,
    SourceEndedError,
    SourceError,
    SourceNotFoundError,
    SourceTimeoutError,
)
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.open import open_source
from selective_depth.drivers.openni import DeviceInfo, DeviceSettings, OpenNIDevice, list_devices, runtime_version
from selective_depth.drivers.openni.clock import Count
from selective_depth.drivers.openni.process import Message

pytestmark = pytest.mark.openni

RECOVERY_S = 5.0  # from the sensor's return to the next frame


def sensor_frame(frame: DepthFrame) -> int:
    """Which of the sensor's images this is; it must be one, whole and not mirrored."""
    right = int(frame.depth_mm[0, -1])
    expected = np.full((480, 640), right, np.uint16)
    expected[:, :320] += 1000
    np.testing.assert_array_equal(frame.depth_mm, expected)
    assert 1 <= right <= 20
    return right - 1


def wait_for(condition: Callable[[], bool], timeout_s: float = 5.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.01)


def next_frame(device: OpenNIDevice, timeout_s: float = RECOVERY_S) -> DepthFrame:
    """The next frame after a fault has been taken away, reading on through the outage."""
    start_s = time.monotonic()
    while True:
        try:
            frame = device.read(timeout_s=0.1)
        except (SourceTimeoutError, DeviceLostError):
            if time.monotonic() > start_s + timeout_s:
                raise
        else:
            print(f"\nback after {time.monotonic() - start_s:.2f} s")
            return frame


def live_run(count: int) -> None:
    with open_source("openni") as device:
        assert device.live
        assert device.frame_count is None
        frames = [device.read() for _ in range(count)]
        indices = [frame.index for frame in frames]
        assert indices[0] == 0
        assert np.all(np.diff(indices) >= 1)
        # What was not read was counted, and nothing else.
        assert device.dropped == indices[-1] + 1 - count
        offset = sensor_frame(frames[0])
        for frame in frames:
            assert sensor_frame(frame) == (offset + frame.index) % 20
            passed_us = frame.timestamp_us - frames[0].timestamp_us
            assert passed_us == pytest.approx(frame.index * 1e6 / 30, abs=2)


def test_live_frames_are_the_sensors(virtual_sensor: VirtualSensor) -> None:
    live_run(40)


@pytest.mark.slow
def test_three_hundred_live_frames(virtual_sensor: VirtualSensor) -> None:
    live_run(300)


def test_the_newest_frame_wins_and_drops_are_counted(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(limit=20)
    with OpenNIDevice() as device:
        first = device.read()
        wait_for(lambda: device._newest is not None and device._newest.index == 19)
        last = device.read()
        assert sensor_frame(last) == 19
        assert last.index == 19 - sensor_frame(first)
        assert device.dropped == last.index - 1


def test_camera_comes_from_the_field_of_view(virtual_sensor: VirtualSensor) -> None:
    with OpenNIDevice() as device:
        camera = device.camera
        assert (camera.width, camera.height, device.fps) == (640, 480, 30)
        assert (camera.fx, camera.fy) == pytest.approx((585, 585), abs=1)


def test_a_sensor_that_does_not_know_its_field_of_view(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(no_fov=1)
    with OpenNIDevice() as device:
        assert device.camera == Camera.kinect()


def test_mirrored_where_asked(virtual_sensor: VirtualSensor) -> None:
    with OpenNIDevice(settings=DeviceSettings(mirror=True)) as device:
        depth_mm = device.read().depth_mm
        assert device.camera.cx == 319
    assert depth_mm[0, 0] + 1000 == depth_mm[0, -1]


# Faults while it runs: what the user sees, and how it ends.


def disturb(sensor: VirtualSensor, state: str, **fault: int) -> None:
    """Make a fault, wait for its state, take it away, and expect the sensor back as it was."""
    with OpenNIDevice() as device:
        before = device.read()
        sensor.set(**fault)
        wait_for(lambda: device.state == state)
        assert device.state_reason
        # Whatever arrived before the fault may still be read; then there is a named error.
        with pytest.raises((SourceTimeoutError, DeviceLostError), match=r"openni.*\."):
            for _ in range(10):
                before = device.read(timeout_s=0.05)
        sensor.set(**{key: int(key == "connected") for key in fault})
        after = next_frame(device)
        assert device.state == "live"
        assert device.state_reason == ""
        assert after.index > before.index
        assert after.timestamp_us > before.timestamp_us
        # The settings are those of before: size, and not mirrored.
        sensor_frame(after)


def test_a_stall_is_shown_and_passes(virtual_sensor: VirtualSensor) -> None:
    disturb(virtual_sensor, "stalled", stall=1)


def test_a_pulled_plug_is_noticed_and_the_sensor_taken_back(virtual_sensor: VirtualSensor) -> None:
    disturb(virtual_sensor, "lost", connected=0)


def test_a_crash_of_the_driver_is_survived(virtual_sensor: VirtualSensor) -> None:
    disturb(virtual_sensor, "reconnecting", crash=1)


def test_frames_of_the_wrong_size_are_never_delivered(virtual_sensor: VirtualSensor) -> None:
    disturb(virtual_sensor, "reconnecting", odd=1)


def test_a_few_wrong_frames_are_thrown_away_and_counted(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(limit=2)
    with OpenNIDevice() as device:
        first = device.read()
        virtual_sensor.set(limit=5, odd=1)
        wait_for(lambda: device.misfits == 3)
        virtual_sensor.set(limit=-1, odd=0)
        last = first
        while last.index < 6 - sensor_frame(first):
            last = next_frame(device)
            sensor_frame(last)
        assert device.dropped >= 3
        assert device.restarts == 0


def test_a_hang_of_the_runtime_is_survived(virtual_sensor: VirtualSensor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("selective_depth.drivers.openni.device._HANG_S", 0.7)
    with OpenNIDevice() as device:
        device.read()
        os.kill(device._worker._process.pid, signal.SIGSTOP)
        wait_for(lambda: device.restarts == 1)
        sensor_frame(next_frame(device))


def test_a_stall_that_lasts_is_ended_by_opening_it_afresh(
    virtual_sensor: VirtualSensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("selective_depth.drivers.openni.device._STALL_S", 0.1)
    monkeypatch.setattr("selective_depth.drivers.openni.device._RESTART_S", 0.3)
    with OpenNIDevice() as device:
        device.read()
        virtual_sensor.set(stall=1)
        wait_for(lambda: device.state == "stalled")
        assert device.restarts == 0
        wait_for(lambda: device.restarts == 1)
        virtual_sensor.set(stall=0)
        sensor_frame(next_frame(device))


def test_a_fault_of_our_own_reaches_the_reader(virtual_sensor: VirtualSensor, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: Count, message: Message) -> tuple[int, int]:
        raise ZeroDivisionError("on purpose")

    with OpenNIDevice() as device:
        device.read()
        monkeypatch.setattr(Count, "follow", fail)
        with pytest.raises(ZeroDivisionError, match="on purpose"):
            for _ in range(3):  # what came before may still be read
                device.read(timeout_s=1)
        wait_for(lambda: not is_running(device._worker._process.pid))


def test_numbers_and_times_go_on_rising(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now_s=100.0, monotonic=lambda: clock.now_s)
    monkeypatch.setattr("selective_depth.drivers.openni.clock.time", clock)
    count = Count()

    def follow(index: int, timestamp_us: int) -> tuple[int, int]:
        return count.follow({"index": index, "timestamp_us": timestamp_us})

    assert follow(7, 50_000) == (0, 50_000)
    assert follow(9, 120_000) == (2, 120_000), "gaps are kept: frames were lost"
    # The sensor counts from 1 again, but its clock goes on.
    assert follow(1, 150_000) == (3, 150_000)
    assert follow(2, 180_000) == (4, 180_000)
    # It is opened afresh after two and a half seconds: its clock starts again as well.
    count.restart()
    clock.now_s += 2.5
    assert follow(0, 33) == (5, 2_680_000)
    assert follow(3, 90_033) == (8, 2_770_000)
    # Both start again without its being opened: it was away for a second.
    clock.now_s += 1
    assert follow(1, 33) == (9, 3_770_000)
    # The same where its own numbers went on meanwhile: they tell nothing about the outage.
    count.restart()
    clock.now_s += 1
    assert follow(900, 5_000_000) == (10, 4_770_000)


def test_a_slow_sensor_is_no_fault(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(fps=4)
    with OpenNIDevice() as device:
        assert [device.read().index for _ in range(5)] == list(range(5))
        assert (device.state, device.restarts, device.dropped) == ("live", 0, 0)


def test_bursts_lose_nothing_unnoticed(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(burst=4)
    with OpenNIDevice() as device:
        indices = [device.read().index for _ in range(8)]
        assert np.all(np.diff(indices) >= 1)
        assert device.dropped == indices[-1] + 1 - 8
        assert device.state == "live"


def test_it_comes_back_although_opening_hangs_at_first(virtual_sensor: VirtualSensor) -> None:
    with OpenNIDevice() as device:
        device._reopen_s = 0.5
        device.read()
        virtual_sensor.set(hang_start=1, crash=1)
        wait_for(lambda: "hangs" in device.state_reason)
        assert device.state == "reconnecting"
        virtual_sensor.set(hang_start=0, crash=0)
        sensor_frame(next_frame(device))


def test_it_comes_back_under_another_address(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(devices=2)
    with OpenNIDevice("virtual://1") as device:
        device.read()
        virtual_sensor.set(devices=1)
        wait_for(lambda: device.restarts == 1)
        sensor_frame(next_frame(device))


# Faults at opening: each a named error, at once.


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ({"connected": 0}, SourceNotFoundError, r"finds no depth sensor.*power supply"),
        ({"devices": 2}, SourceNotFoundError, r"2 sensors .*0, virtual://1.* live virtual://0"),
        ({"refuse_open": 1}, DeviceRefusedError, "told to refuse"),
        ({"refuse_stream": 1}, DeviceRefusedError, "refuses a depth stream"),
        ({"refuse_start": 1}, DeviceRefusedError, "does not start"),
    ],
)
def test_a_sensor_that_does_not_open_says_why(
    virtual_sensor: VirtualSensor, fault: dict[str, int], error: type[SourceError], message: str
) -> None:
    virtual_sensor.set(**fault)
    with pytest.raises(error, match=message):
        OpenNIDevice()


def test_there_is_no_sensor_of_that_name(virtual_sensor: VirtualSensor) -> None:
    with pytest.raises(SourceNotFoundError, match=r"'virtual://7'.*virtual://0"):
        open_source("openni:virtual://7")


def test_what_it_cannot_do_is_refused(virtual_sensor: VirtualSensor) -> None:
    with pytest.raises(DeviceRefusedError, match="cannot register"):
        OpenNIDevice(settings=DeviceSettings(registration=True))


def test_another_program_holds_the_sensor(virtual_sensor: VirtualSensor) -> None:
    with OpenNIDevice(), pytest.raises(DeviceRefusedError, match=r"busy.*Close the program"):
        OpenNIDevice()
    with OpenNIDevice() as device:
        device.read()


def test_two_sensors_at_once(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(devices=2)
    with OpenNIDevice("virtual://0") as one, OpenNIDevice("virtual://1") as other:
        for _ in range(3):
            sensor_frame(one.read())
            sensor_frame(other.read())
        assert (one.device.uri, other.device.uri) == ("virtual://0", "virtual://1")


def test_a_sensor_that_hangs_when_opened(virtual_sensor: VirtualSensor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("selective_depth.drivers.openni.device._OPEN_S", 0.5)
    virtual_sensor.set(hang_open=1)
    with pytest.raises(DeviceRefusedError, match="hangs"):
        OpenNIDevice()


def test_no_runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENNI2_REDIST", str(tmp_path))
    with pytest.raises(RuntimeMissingError, match="OPENNI2_REDIST"):
        OpenNIDevice()


def test_a_broken_runtime(virtual_sensor: VirtualSensor) -> None:
    for driver in (virtual_sensor.runtime / "OpenNI2" / "Drivers").iterdir():
        driver.unlink()
    with pytest.raises(RuntimeMissingError, match=r"cannot be started: Found no files matching"):
        OpenNIDevice()
    library = virtual_sensor.runtime / "libOpenNI2.so"
    library.unlink()
    library.write_text("no library")
    with pytest.raises(RuntimeMissingError, match=r"cannot be started: .*too short"):
        list_devices()


def test_the_list_of_sensors(virtual_sensor: VirtualSensor) -> None:
    sensor = DeviceInfo("virtual://0", "selective-depth", "virtual depth sensor", 0, 0)
    assert list_devices() == [sensor]
    virtual_sensor.set(devices=2)
    assert [device.uri for device in list_devices()] == ["virtual://0", "virtual://1"]
    virtual_sensor.set(connected=0)
    assert list_devices() == []
    assert runtime_version().startswith("2.")


# Ending it.


def test_closing_ends_a_read_that_waits(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(limit=0)
    device = OpenNIDevice()
    threading.Timer(0.2, device.close).start()
    with pytest.raises(SourceEndedError):
        device.read(timeout_s=30)
    device.close()


def test_closing_is_quick_even_if_the_driver_hangs(virtual_sensor: VirtualSensor) -> None:
    device = OpenNIDevice()
    device.read()
    virtual_sensor.set(hang_stop=1)
    time.sleep(0.05)
    started = time.monotonic()
    device.close()
    assert time.monotonic() - started < 3


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def cycle(times: int) -> None:
    files, threads = open_files(), threading.active_count()
    for _ in range(times):
        with OpenNIDevice() as device:
            for _ in range(3):
                sensor_frame(device.read())
    assert (open_files(), threading.active_count()) == (files, threads)


def test_cycles_of_open_read_three_close_leave_nothing(virtual_sensor: VirtualSensor) -> None:
    cycle(4)


@pytest.mark.slow
def test_two_hundred_cycles_of_open_read_three_close(virtual_sensor: VirtualSensor) -> None:
    cycle(200)


READER = """
import os, signal, sys, time
from selective_depth.drivers.openni import OpenNIDevice
device = OpenNIDevice()
device.read()
print(device._worker._process.pid, flush=True)
while True:
    device.read()
    if sys.argv[1] == "exception":
        raise RuntimeError("on purpose")
    if sys.argv[1] == "exit":
        break
    if sys.argv[1] == "killed while its fork lives on":
        if os.fork() == 0:  # which holds every pipe open
            time.sleep(3)
            os._exit(0)
        os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize(
    "end", ["exit", "exception", "killed while its fork lives on", signal.SIGINT, signal.SIGTERM, signal.SIGKILL]
)
def test_nothing_is_left_whichever_way_the_program_ends(
    virtual_sensor: VirtualSensor, end: str | signal.Signals
) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", READER, str(end)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as program:
        assert program.stdout is not None
        worker = int(program.stdout.readline())
        assert Path(f"/proc/{worker}").exists()
        if isinstance(end, signal.Signals):
            program.send_signal(end)
        program.wait(5)
    wait_for(lambda: not is_running(worker))
    assert not list(Path("/dev/shm").glob("*selective*"))
    with OpenNIDevice() as device:
        device.read()


def is_running(pid: int) -> bool:
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_ctrl_c_ends_a_read_that_waits_at_once(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(limit=0)
    pressed: list[float] = []

    def press() -> None:
        pressed.append(time.monotonic())
        os.kill(os.getpid(), signal.SIGINT)

    with OpenNIDevice() as device:
        threading.Timer(0.3, press).start()
        with pytest.raises(KeyboardInterrupt):
            device.read(timeout_s=20)
        assert time.monotonic() - pressed[0] < 0.5
