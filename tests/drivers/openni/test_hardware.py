"""With a real sensor on the USB bus: `pytest -m hardware`, which plays no part in CI."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from selective_depth.drivers.oni import OniReader
from selective_depth.drivers.openni import OpenNIDevice, list_devices, record

pytestmark = pytest.mark.hardware


def test_the_sensor_is_listed() -> None:
    assert list_devices()


def test_three_hundred_frames() -> None:
    with OpenNIDevice() as device:
        frames = [device.read() for _ in range(300)]
        assert device.dropped == frames[-1].index + 1 - 300
        assert device.dropped <= 3
    seconds = (frames[-1].timestamp_us - frames[0].timestamp_us) / 1e6
    assert frames[-1].index / seconds == pytest.approx(30, rel=0.02)
    assert np.mean([np.mean(frame.depth_mm > 0) for frame in frames]) > 0.2


def test_a_recording_holds_what_was_seen(tmp_path: Path) -> None:
    report = record(tmp_path / "out.oni", frames=60)
    assert (report.ended, report.problem) == ("done", "")
    with OniReader(report.path) as recording:
        assert len(list(recording)) == report.frames >= 60
