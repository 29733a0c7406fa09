"""What becomes of a sensor, message by message, without the OpenNI2 runtime."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from selective_depth.drivers.frame import DepthArray
from selective_depth.drivers.openni import OpenNIDevice, worker
from selective_depth.drivers.openni import device as openni_device
from selective_depth.drivers.openni.process import Message

FOUND: Message = {"kind": "found"}
OPENED: Message = {
    "kind": "opened",
    "device": {
        "uri": "script",
        "vendor": "",
        "name": "a script",
        "usb_vendor_id": 0,
        "usb_product_id": 0,
        "serial": "1",
    },
    "twins": False,
    "form": "mm",
    "width": 8,
    "height": 6,
    "fps": 30,
    "fov_x_rad": 1.0,
    "fov_y_rad": 0.8,
    "colour": None,
    "colour_trouble": "",
    "registered": False,
}
OPENS = (FOUND, OPENED)
MISFIT: Message = {"kind": "misfit", "problem": "4x3 pixels"}
DIED: Message = {"kind": "died", "reason": "crashed"}
LOST: Message = {"kind": "lost"}


def frame(index: int) -> Message:
    return {"kind": "frame", "index": index, "timestamp_us": index * 33_333}


class ScriptedWorker:
    """A worker that says what it is told; each one that is started takes the next script."""

    scripts: Iterator[tuple[Message | Callable[[], None], ...]]
    started_s: list[float]

    def __init__(self, job: str, **arguments: object) -> None:
        self.started_s.append(time.monotonic())
        self.script = iter(next(self.scripts))

    def receive(self, timeout_s: float) -> Message | None:
        for said in self.script:
            if isinstance(said, dict):
                return said
            said()
        time.sleep(min(timeout_s, 0.01))
        # Silent, but not hung.
        return {"kind": "idle", "silent_s": 0.0}

    def take(self, message: Message, width: int, height: int) -> DepthArray:
        return np.full((height, width), 1000 + message["index"], np.uint16)

    def close(self, grace_s: float = 0.0) -> None:
        pass


@pytest.fixture
def play(monkeypatch: pytest.MonkeyPatch) -> Callable[..., OpenNIDevice]:
    def start(*scripts: tuple[Message | Callable[[], None], ...]) -> OpenNIDevice:
        monkeypatch.setattr(ScriptedWorker, "scripts", iter(scripts), raising=False)
        monkeypatch.setattr(ScriptedWorker, "started_s", [], raising=False)
        return OpenNIDevice()

    monkeypatch.setattr(openni_device, "Worker", ScriptedWorker)
    return start


def wait_until(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + 5
    while not condition():
        assert time.monotonic() < deadline_s, "it did not happen in time"
        time.sleep(0.005)


def test_only_wrong_frames_in_a_row_are_a_fault(play: Callable[..., OpenNIDevice]) -> None:
    nearly = (MISFIT,) * (openni_device._MISFITS - 1)
    with play((*OPENS, *nearly, frame(1), *nearly, frame(2))) as device:
        wait_until(lambda: device.misfits == 2 * len(nearly) and device._newest is not None)
        assert (device.restarts, device.state) == (0, "live")
    with play((*OPENS, *nearly, MISFIT), (*OPENS, frame(1))) as device:
        wait_until(lambda: device.restarts == 1)
        assert device.read().depth_mm[0, 0] == 1001
        assert device.misfits == openni_device._MISFITS


def test_attempts_are_counted_anew_once_frames_come(
    play: Callable[..., OpenNIDevice], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pauses grow within an outage, not from one to the next."""
    monkeypatch.setattr(openni_device, "_BACK_OFF_S", (0.0, 0.3, 30.0))
    crash = (*OPENS, frame(1), DIED)
    refused = (FOUND, DIED)
    with play(crash, crash, refused, crash, refused, (*OPENS, frame(7))) as device:
        wait_until(lambda: device.restarts == 3)
        pauses_s = np.diff(ScriptedWorker.started_s)
    assert np.all(pauses_s[[0, 1, 3]] < 0.2)
    assert np.all(pauses_s[[2, 4]] >= 0.3)
    assert np.all(pauses_s < 5)


def test_a_lost_sensor_that_is_there_again_is_reconnecting(play: Callable[..., OpenNIDevice]) -> None:
    seen: list[tuple[str, str]] = []

    def look() -> None:
        seen.append((device.state, device.state_reason))

    device = play((*OPENS, frame(1), LOST), (look, FOUND, look, OPENED, frame(1), look))
    with device:
        wait_until(lambda: len(seen) == 3)
    assert seen == [("lost", "it was unplugged or lost its power"), ("reconnecting", "it is there again"), ("live", "")]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({}, ""),
        ({"stride": 20, "dataSize": 116}, ""),
        ({"height": 3}, r"it is 8x3 (stride 16, 96 bytes), expected 8x6 (stride 16, 96 bytes)"),
        ({"dataSize": 95}, "95 bytes"),
        ({"pixelFormat": 101}, "it is 8x6 at 30 fps in 0.1 mm, expected mm"),
        ({"pixelFormat": 102}, "it is 8x6 at 30 fps in pixel format 102, expected mm"),
    ],
)
def test_what_is_wrong_with_a_frame_is_told(change: dict[str, int], says: str) -> None:
    mode = SimpleNamespace(resolutionX=8, resolutionY=6, fps=30, pixelFormat=change.pop("pixelFormat", 100))
    frame = SimpleNamespace(**{"width": 8, "height": 6, "stride": 16, "dataSize": 96} | change, videoMode=mode)
    problem = worker.misfit(frame, {"width": 8, "height": 6, "form": "mm", "pixel_bytes": 2})
    assert says in problem and bool(says) == bool(problem)
