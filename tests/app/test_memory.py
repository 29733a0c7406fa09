"""A memory in a run: the report, the recording, the model as files."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rerun.experimental import RrdReader

from selective_depth.app.cli import run
from selective_depth.app.console.exit_codes import MISUSED, OK
from selective_depth.app.pipeline import Pipeline
from selective_depth.app.settings import AcquireOptions, GasOptions, SeedOptions, Settings
from selective_depth.drivers.open import open_source
from selective_depth.drivers.virtual.ply import read_ply

STILL = "virtual:ball?speed=0&frames=6&size=160x120"
QUICK = ["--seeds.rows", "32", "--seeds.columns", "32", "--gas.nodes", "100", "--headless"]


def test_a_run_with_memory_says_shows_and_saves_what_it_knows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved, model = tmp_path / "run.rrd", tmp_path / "model"
    words = ["replay", STILL, *QUICK, "--memory", "still", "--budget", "5%"]
    assert run([*words, "--save", str(saved), "--save-model", str(model)]) == OK
    told = capsys.readouterr().out
    for row in ("mm to the truth", "pixels known", "with memory", "even lattice", "times as good"):
        assert row in told
    assert tomllib.loads(saved.with_suffix(".toml").read_text())["memory"] == "still"
    entities = {str(part.entity_path) for part in RrdReader(str(saved)).stream()}
    assert {
        "/camera/memory/age",
        "/camera/memory/changed",
        "/figures/known_percent",
        "/figures/truth_rmse_mm",
    } <= entities
    samples = np.load(model / "samples.npz")
    assert len(samples["uv"]) == len(read_ply(model / "cloud.ply").points) > 32 * 32
    assert cv2.imread(str(model / "depth.png"), cv2.IMREAD_UNCHANGED).shape == (120, 160)


def test_the_selectors_see_no_seed_that_the_memory_has_not_measured() -> None:
    settings = Settings(
        seeds=SeedOptions(32, 32), gas=GasOptions(nodes=100), acquire=AcquireOptions(budget=0.03, memory="still")
    )
    with open_source(STILL) as source, Pipeline(settings) as pipeline:
        frames = list(source)
        pipeline.warm_up(frames[0])
        results = [pipeline.make(frame) for frame in frames]
    for result in results:
        assert result.memory is not None and result.acquisition is not None
        assert result.seeds is result.memory.seeds
        known = result.memory.known_mm[np.ix_(result.seeds.rows, result.seeds.columns)]
        np.testing.assert_array_equal(result.seeds.depth_mm, known)
    counts = [len(result.acquisition.uv) for result in results]
    assert counts[0] > 1024 and max(counts[1:]) <= round(0.03 * 160 * 120), "warming up is no frame of it"


@pytest.mark.parametrize("extra", [["--memory", "still"], ["--save-model", "there"]])
def test_what_needs_a_budget_says_so(extra: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["replay", STILL, *QUICK, *extra]) == MISUSED
    assert "--budget" in capsys.readouterr().err


def test_selectors_that_follow_a_memory_see_what_they_would_see_one_by_one() -> None:
    """While the memory spends the next frame's budget; with a change of options on the way, too."""
    settings = Settings(
        seeds=SeedOptions(32, 32), gas=GasOptions(nodes=100), acquire=AcquireOptions(budget=0.03, memory="still")
    )
    more = replace(settings, acquire=replace(settings.acquire, budget=0.05))
    with open_source(STILL) as source, Pipeline(settings) as side_by_side, Pipeline(settings, one_thread=True) as plain:
        frames = list(source)
        expected, found = [], []
        for number, frame in enumerate(frames):
            if number == 3:
                plain.adopt(more)
                side_by_side.adopt(more)
            expected.append(plain.make(frame))
            side_by_side.begin(frame)
            found += side_by_side.finished()
        found += side_by_side.rest()
    assert [result.frame.index for result in found] == [frame.index for frame in frames]
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.memory is not None and theirs.memory is not None and ours.model is not None
        np.testing.assert_array_equal(ours.memory.uv, theirs.memory.uv)
        np.testing.assert_array_equal(ours.model.depth_mm, theirs.model.depth_mm)
        np.testing.assert_array_equal(ours.improvement.raw, theirs.improvement.raw)
        np.testing.assert_array_equal(ours.regions.nodes_mm, theirs.regions.nodes_mm)


@pytest.mark.slow
def test_a_memory_of_many_frames_does_not_grow() -> None:
    import resource

    from selective_depth.selectors.memory import TemporalAcquisition

    with open_source("virtual:workstation?speed=0&frames=20") as source:
        frames = list(source)
    memory = TemporalAcquisition((480, 640))
    held = []
    for number in range(10_000):
        memory.step(frames[number % 20].measure)
        if number % 1000 == 999:
            held.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    print(json.dumps(held))
    assert held[-1] - held[1] < 20
