"""The sample recordings are what their README says."""

from __future__ import annotations

import pytest
from conftest import ROOT

from selective_depth.drivers.open import open_source

RECORDINGS = ROOT / "recordings"
ORIGINS = {
    "workstation.oni": "virtual:workstation?frames=30&speed=2&seed=7",
    "ball": "virtual:ball?frames=8&speed=2&seed=7",
    "firehose": "virtual:firehose?frames=8&speed=2&seed=7",
}


@pytest.mark.parametrize("name", ORIGINS)
def test_a_recording_holds_the_frames_of_its_scene(name):
    readme = (RECORDINGS / "README.md").read_text()
    assert ORIGINS[name] in readme
    with open_source(RECORDINGS / name) as recording, open_source(ORIGINS[name]) as scene:
        assert recording.frame_count == scene.frame_count
        for saved, made in zip(recording, scene, strict=True):
            # Another processor may round a pixel on the edge of two steps the other way.
            assert (saved.depth_mm != made.depth_mm).mean() < 1e-3
            assert abs(saved.timestamp_us - made.timestamp_us) <= 1
            assert saved.camera.fx == pytest.approx(made.camera.fx, rel=1e-3)


def test_they_are_small():
    size = sum(file.stat().st_size for file in RECORDINGS.rglob("*") if file.is_file())
    assert size < 12e6
