"""What real drivers do wrong, each done by the virtual sensor behind the real runtime.

The table of them is in `app/docs/faults.md`.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from virtual_sensor import VirtualSensor

from selective_depth.app import cli
from selective_depth.drivers.errors import DeviceLostError, DeviceRefusedError, SourceNotFoundError, SourceTimeoutError
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.oni import write_oni
from selective_depth.drivers.open import open_source
from selective_depth.drivers.openni import OpenNIDevice, record
from selective_depth.drivers.openni.runtime import Runtime
from selective_depth.drivers.openni.usb import usb_advice

pytestmark = pytest.mark.openni


def right(frame: DepthFrame) -> bool:
    """One of the sensor's images, in every pixel."""
    value = int(frame.depth_mm[0, -1])
    half = frame.depth_mm.shape[1] // 2
    sides = frame.depth_mm[:, :half] == value + 1000, frame.depth_mm[:, half:] == value
    return 1 <= value <= 20 and all(side.all() for side in sides)


def steps_us(count: int) -> list[int]:
    with OpenNIDevice() as device:
        frames = [device.read() for _ in range(count)]
        assert all(map(right, frames))
        assert "clock" in device.notes[-1]
    per_frame = np.diff([f.timestamp_us for f in frames]) / np.diff([f.index for f in frames])
    return per_frame.tolist()


def test_a_first_frame_that_takes_four_seconds(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(first_ms=4000)
    with OpenNIDevice() as device:
        assert right(device.read(timeout_s=8.0))
        assert device.restarts == 0


@pytest.mark.parametrize("vice", [{"empty": 1}, {"stall": 1}])
def test_no_frame_at_all_ends_with_advice(
    virtual_sensor: VirtualSensor, vice: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    virtual_sensor.set(**vice)
    monkeypatch.setattr("selective_depth.drivers.openni.device._FIRST_FRAME_S", 3.0)
    with (
        OpenNIDevice() as device,
        pytest.raises(DeviceRefusedError, match=r"sent no frame for 3 s.*hub.*power.*virtual"),
    ):
        device.read(timeout_s=8.0)


def test_properties_that_cannot_be_read(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(unreadable=1)
    with OpenNIDevice() as device:
        # Mirroring cannot be switched off then: the image is as the driver has it.
        assert device.read().depth_mm.any()


@pytest.mark.parametrize("pad", [2, 64, 6])
def test_rows_that_are_padded(virtual_sensor: VirtualSensor, pad: int) -> None:
    virtual_sensor.set(pad=pad)
    with OpenNIDevice() as device:
        assert all(right(device.read()) for _ in range(5))
        assert device.misfits == 0


@pytest.mark.parametrize("clock", [1, 2])
def test_a_clock_that_stands_or_counts_milliseconds(virtual_sensor: VirtualSensor, clock: int) -> None:
    virtual_sensor.set(clock=clock)
    steps = steps_us(20)
    assert min(steps) > 0 and np.median(steps) == pytest.approx(33_333, rel=0.5)


def test_a_clock_of_32_bits_that_wraps_round(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(clock=3)  # after one second
    steps = steps_us(50)
    assert min(steps) > 0 and np.median(steps) == pytest.approx(33_333, abs=2)


def test_tenths_of_millimetres(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(tenths=1)
    with OpenNIDevice() as device:
        depth_mm = device.read().depth_mm
    value = int(depth_mm[0, -1])
    assert value <= 2 and abs(int(depth_mm[0, 0]) - value - 100) <= 1


def test_the_nearest_mode_is_taken_and_said(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(width=512, height=424)
    with open_source("openni") as device:
        assert (device.camera.width, device.camera.height) == (512, 424)
        assert "it does not offer 640x480@30; 512x424@30 is used" in device.notes[0]
        assert device.read().shape == (424, 512)


def test_a_mode_that_is_asked_for(virtual_sensor: VirtualSensor, tmp_path: Path) -> None:
    out = tmp_path / "out.oni"
    assert cli.run(["record", str(out), "--frames", "3", "--mode", "320x240@30"]) == 0
    with open_source(out) as recording:
        assert recording.read().shape == (240, 320)
    with open_source("openni:virtual://0?mode=320x240@30&camera=300,301,160,120") as device:
        assert device.camera == Camera(320, 240, 300, 301, 160, 120)
        assert device.read().shape == (240, 320)
    with pytest.raises(DeviceRefusedError, match=r"cannot give 640x400 .*offers: .*320x240 at 30"):
        open_source("openni?mode=640x400@30")
    with pytest.raises(SourceNotFoundError, match="mode=640 of"):
        open_source("openni?mode=640")


@pytest.mark.parametrize(
    ("vice", "note"), [({"degrees": 1}, "in degrees"), ({"no_fov": 1}, "states no"), ({"other_fov": 1}, "not suit")]
)
def test_a_doubtful_field_of_view_is_questioned(virtual_sensor: VirtualSensor, vice: dict[str, int], note: str) -> None:
    virtual_sensor.set(**vice)
    with OpenNIDevice() as device:
        assert note in device.notes[0] and "--camera" in device.notes[0]
        if "other_fov" not in vice:
            assert device.camera.fx == pytest.approx(585, abs=1.5)


def test_a_driver_that_aborts_when_it_is_pulled_out(virtual_sensor: VirtualSensor, tmp_path: Path) -> None:
    virtual_sensor.set(aborts=1)

    def pull_out(frames: int) -> None:
        if frames == 6:
            virtual_sensor.set(connected=0)

    report = record(tmp_path / "out.oni", progress=pull_out)
    # Whichever is heard of first: the driver says so before it aborts.
    assert ("SIGABRT" in report.ended or "unplugged" in report.ended) and report.problem == ""
    with open_source(report.path) as recording:
        frames = list(recording)
    assert len(frames) == report.frames >= 6 and all(map(right, frames))


def wait_for_state(device: OpenNIDevice, state: str, timeout_s: float = 10.0) -> None:
    deadline = time.monotonic() + timeout_s
    while device.state != state:
        assert time.monotonic() < deadline, device.state
        time.sleep(0.05)


def swap(sensor: VirtualSensor, device: OpenNIDevice) -> None:
    """Both are pulled out and plugged in again, in the other order: an index is no address."""
    device.read()
    sensor.set(connected=0)
    wait_for_state(device, "lost")
    sensor.set(connected=1, serial0="B", serial1="A")


def test_the_same_sensor_again_by_its_serial_number(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(devices=2, serial0="A", serial1="B")
    with OpenNIDevice("virtual://0") as device:
        assert device.device.serial == "A" and not device.notes
        swap(virtual_sensor, device)
        wait_for_state(device, "live")
        assert (device.device.uri, device.device.serial) == ("virtual://1", "A")


def test_never_silently_another_sensor(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(devices=1, serial0="A")
    with OpenNIDevice() as device:
        device.read()
        virtual_sensor.set(connected=0)
        wait_for_state(device, "lost")
        virtual_sensor.set(connected=1, serial0="C")
        with pytest.raises((DeviceLostError, SourceTimeoutError)):
            while True:
                device.read(timeout_s=2.0)
        assert "none has the serial number A" in device.state_reason


def test_without_serial_numbers_it_is_said_that_it_cannot_be_known(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(devices=2)
    with OpenNIDevice("virtual://0") as device:
        assert "gives no serial number" in device.notes[0]
        device.read()


def test_three_addresses_of_one_sensor_count_as_one(virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(devices=3, addresses=1)
    with OpenNIDevice() as device:
        assert device.device.uri == "virtual://0" and not device.notes
        assert right(device.read())
    with open_source("openni:virtual://0?depth-size=2") as device:
        assert right(device.read())


def test_drivers_of_a_name_that_is_not_loaded_are_named(
    virtual_sensor: VirtualSensor, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = virtual_sensor.runtime / "OpenNI2" / "Drivers"
    (folder / "libFreenectDriver.so").write_text("not loaded under this name")
    assert cli.run(["devices"]) == 0
    said = capsys.readouterr().out
    assert "FreenectDriver" not in next(x for x in said.splitlines() if x.startswith("drivers"))
    assert "libFreenectDriver.so; the runtime loads lib*.so.0" in said
    assert "FreenectDriver" not in Runtime(virtual_sensor.runtime / "libOpenNI2.so").drivers


def test_an_orbbec_sensor_is_known_on_the_bus(tmp_path: Path) -> None:
    device = tmp_path / "sys" / "1-2"
    device.mkdir(parents=True)
    for name, value in {"idVendor": "2bc5", "idProduct": "0614", "busnum": 1, "devnum": 7}.items():
        (device / name).write_text(f"{value}\n")
    said = usb_advice(("PS1080",), tmp_path / "sys", tmp_path / "dev")
    assert "Orbbec sensor is on the USB bus" in said and "liborbbec.so" in said


def test_a_recording_does_not_care_for_a_broken_driver(
    virtual_sensor: VirtualSensor, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = [
        DepthFrame(np.full((240, 320), 900 + n, np.uint16), n, 33_333 * n, Camera.kinect(320, 240)) for n in range(3)
    ]
    write_oni(tmp_path / "walk.oni", frames)
    virtual_sensor.set(hang_open=1, crash=1, aborts=1, connected=0)
    (virtual_sensor.runtime / "OpenNI2" / "Drivers" / "libBroken.so.0").write_text("no library")
    began_s = time.monotonic()
    assert cli.run(["check", str(tmp_path / "walk.oni")]) == 0
    assert cli.run(["export", str(tmp_path / "walk.oni"), str(tmp_path / "frames")]) == 0
    assert cli.run(["replay", str(tmp_path / "walk.oni"), "--headless", "--save", str(tmp_path / "a.rrd")]) == 0
    assert time.monotonic() - began_s < 60
    assert "nothing is wrong with it" in capsys.readouterr().out
