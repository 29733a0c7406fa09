"""Colour of a live sensor through the real OpenNI2: paired, registered, recorded, and its faults."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from virtual_sensor import VirtualSensor

from selective_depth.drivers import DepthFrame, open_source
from selective_depth.drivers.oni import inspect_oni
from selective_depth.drivers.openni import OpenNIDevice, record
from selective_depth.drivers.openni.runtime import find_runtime

pytestmark = pytest.mark.openni

PLAYER = Path(__file__).parents[2] / "raw_colour_player.py"


@cache
def images(count: int = 20, height: int = 480, width: int = 640) -> npt.NDArray[np.uint8]:
    """Colour images that tell their number: frame k (from 0) has k + 1 in the red of its corner."""
    rows, columns = np.mgrid[0:height, 0:width]
    one = np.stack((columns * 200 // width, rows * 200 // height, (rows + columns) % 200), axis=-1).astype(np.uint8)
    return np.stack(
        [
            np.where((rows < 32) & (columns < 32), 10 * k + 10, 0)[..., None] * [1, 0, 0]
            + one * ((rows >= 32) | (columns >= 32))[..., None]
            for k in range(count)
        ]
    ).astype(np.uint8)


@pytest.fixture
def colour_sensor(
    virtual_driver: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., VirtualSensor]:
    """Attaches a sensor whose depth and colour tell their number, with settings."""

    def attach(colour: npt.NDArray[np.uint8] | None = None, **keys: int) -> VirtualSensor:
        depth = np.zeros((20, 480, 640), np.uint16) + 100 * np.arange(10, 30, dtype=np.uint16)[:, None, None]
        sensor = VirtualSensor(tmp_path / "sensor", depth, images() if colour is None else colour, **keys)
        for name, value in sensor.env.items():
            monkeypatch.setenv(name, value)
        return sensor

    return attach


def depth_number(frame: DepthFrame) -> int:
    return int(frame.depth_mm[0, 0]) // 100 - 10


def colour_number(frame: DepthFrame) -> int:
    assert frame.colour is not None
    return round(float(frame.colour[8:24, 8:24, 0].mean()) / 10) - 1


def test_each_frame_has_the_colour_of_its_moment(colour_sensor: Callable[..., VirtualSensor]) -> None:
    colour_sensor()
    with OpenNIDevice() as device:
        frames = [device.read() for _ in range(40)]
        coloured = [frame for frame in frames if frame.colour is not None]
        assert len(coloured) >= 36  # on a busy machine one may come too late
        for frame in coloured:
            assert colour_number(frame) == depth_number(frame) and frame.colour_us == frame.timestamp_us
            np.testing.assert_array_equal(frame.colour, images()[colour_number(frame)])
        assert not frame.registered and frame.colour_camera is not None
        assert frame.colour_camera.fx == pytest.approx(585, abs=1)
        assert device.notes == ()


def test_depth_is_registered_where_the_device_can(colour_sensor: Callable[..., VirtualSensor]) -> None:
    colour_sensor(registers=1)
    with OpenNIDevice() as device:
        assert device.read().registered
    with open_source("openni?colour=unregistered") as device:
        assert not device.read().registered


def test_colour_can_be_left_out(colour_sensor: Callable[..., VirtualSensor]) -> None:
    colour_sensor()
    with open_source("openni?colour=off") as device:
        assert all(device.read().colour is None for _ in range(5))


@pytest.mark.parametrize("late_us", [12_000, -12_000])
def test_colour_that_lags_is_paired_with_what_is_nearest(
    colour_sensor: Callable[..., VirtualSensor], late_us: int
) -> None:
    colour_sensor(colour_late_us=late_us)
    with OpenNIDevice() as device:
        for _ in range(20):
            frame = device.read()
            assert frame.colour_us is not None and frame.colour_us - frame.timestamp_us == late_us
            assert colour_number(frame) == depth_number(frame)


def test_colour_with_another_clock_is_left_out_and_said(colour_sensor: Callable[..., VirtualSensor]) -> None:
    colour_sensor(colour_late_us=5_000_000)
    with OpenNIDevice() as device:
        frames = [device.read() for _ in range(75)]
        assert all(frame.colour is None for frame in frames)
        assert len(device.notes) == 1 and "ms away from depth by its own clock" in device.notes[0]


@pytest.mark.parametrize(
    ("number", "conversion"), [(201, cv2.COLOR_RGB2YUV_UYVY), (205, cv2.COLOR_RGB2YUV_YUY2), (202, cv2.COLOR_RGB2GRAY)]
)
def test_forms_other_than_rgb(colour_sensor: Callable[..., VirtualSensor], number: int, conversion: int) -> None:
    raw = np.stack([cv2.cvtColor(image, conversion) for image in images(2)])
    colour_sensor(raw, colour_format=number)
    with OpenNIDevice() as device:
        frame = device.read()
    assert frame.colour is not None
    wanted = images(2)[0]
    if number == 202:
        wanted = np.repeat(cv2.cvtColor(wanted, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
    assert np.median(np.abs(frame.colour[64:].astype(int) - wanted[64:])) <= 3


def test_colour_of_another_size(colour_sensor: Callable[..., VirtualSensor]) -> None:
    colour_sensor(images(2, 1024, 1280), colour_width=1280, colour_height=1024)
    with OpenNIDevice() as device:
        frame = device.read()
        # The nearest mode to that of depth is taken, and that is the half.
        assert frame.colour is not None and frame.colour.shape == (512, 640, 3) and not frame.registered


def test_colour_that_stops_leaves_depth_alone(colour_sensor: Callable[..., VirtualSensor]) -> None:
    sensor = colour_sensor()
    with OpenNIDevice() as device:
        assert device.read().colour is not None
        sensor.set(stall_colour=1)
        start_s, frames = time.monotonic(), []
        while time.monotonic() < start_s + 2.5:
            frames.append(device.read())
        assert frames[-1].colour is None and len(frames) > 60 and device.state == "live"
        assert any("no colour; depth goes on" in note for note in device.notes)
        sensor.set(stall_colour=0)
        while device.read().colour is None:
            assert time.monotonic() < start_s + 6


@pytest.mark.parametrize("fault", ["refuse_colour", "refuse_colour_start", "odd_colour"])
def test_colour_that_fails_is_said_and_depth_comes(colour_sensor: Callable[..., VirtualSensor], fault: str) -> None:
    colour_sensor(**{fault: 1})
    with OpenNIDevice() as device:
        assert device.read().colour is None
        assert "colour" in device.notes[0]


def test_the_sensor_that_was_unplugged_has_its_colour_again(colour_sensor: Callable[..., VirtualSensor]) -> None:
    sensor = colour_sensor()
    with OpenNIDevice() as device:
        device.read()
        sensor.set(connected=0)
        while device.state == "live":
            time.sleep(0.01)
        sensor.set(connected=1)
        deadline = time.monotonic() + 8
        while device.restarts == 0 or device._newest is None:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        frames = [device.read() for _ in range(10)]
        coloured = [frame for frame in frames if frame.colour is not None]
        assert coloured and all(colour_number(frame) == depth_number(frame) for frame in coloured)


def test_recorded_colour_is_what_openni2s_player_shows(
    colour_sensor: Callable[..., VirtualSensor], tmp_path: Path
) -> None:
    colour_sensor(registers=1, colour_late_us=4_000)
    out = tmp_path / "walk.oni"
    report = record(out, frames=30)
    assert (report.frames, report.problem) == (30, "")
    found = inspect_oni(out, decode=True)
    depths, colours = (len(node.frames) for node in found.nodes)
    assert found.complete and depths == 30 and 27 <= colours <= 30  # on a busy machine one may come too late
    with open_source(out) as source:
        frames = [frame for frame in source if frame.colour is not None]
    assert len(frames) == colours
    for frame in frames:
        assert frame.registered and frame.colour is not None and frame.colour_us is not None
        assert colour_number(frame) == depth_number(frame) and frame.colour_us - frame.timestamp_us == 4_000
        off = frame.colour.astype(float) - images()[depth_number(frame)]
        assert 10 * np.log10(255**2 / np.mean(off**2)) > 38
    played = subprocess.run(
        [sys.executable, PLAYER, find_runtime().path, out], capture_output=True, text=True, check=True, timeout=60
    )
    means = json.loads(played.stdout.splitlines()[-1])
    for frame, mean in zip(frames, means, strict=True):
        assert frame.colour is not None
        assert np.abs(np.array(mean) - frame.colour.mean(axis=(0, 1))).max() < 0.02
