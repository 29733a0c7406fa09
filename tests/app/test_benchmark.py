"""The benchmark measures what it says, in the shape that is documented."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from selective_depth.app.benchmark import bench, loads, peers
from selective_depth.app.benchmark import report as bench_report
from selective_depth.app.console.errors import UsageError
from selective_depth.app.pipeline import StageSummary
from selective_depth.selectors.neural_gas import train_exact

SOURCE = "virtual:ball?size=320x240&frames=4"


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "NODES", 200)
    monkeypatch.setattr(bench, "EPOCHS", 1)
    monkeypatch.setattr(peers, "NUMPY_STEPS", 50)
    monkeypatch.setattr(loads, "RUNS", 1)
    # The kriging libraries take seconds each and are timed by the benchmark itself.
    monkeypatch.setattr(peers, "find_spec", lambda name: None)


def test_figures_have_the_documented_shape(small: None, tmp_path: Path) -> None:
    written, page = tmp_path / "out.json", tmp_path / "page.md"
    bench_report.run_bench(SOURCE, 3, json=written, page=page, peers=True)
    report = json.loads(written.read_text())
    assert report["schema"] == 1
    assert set(report["stages"]) >= {
        "improvement",
        "improvement_one_thread",
        "neural_gas_exact",
        "neural_gas_fast",
        "neural_gas_live",
        "regions",
        "log",
        "loop",
    }
    for stage in report["stages"].values():
        assert 0 < stage["p50_ms"] <= stage["p99_ms"] <= stage["max_ms"]
    assert 1 <= report["frames"] <= 3
    assert report["threads"] >= 1 and report["fps"] > 0
    assert set(report["peers"]) == {"numpy_neural_gas"}
    assert "numpy_neural_gas / neural_gas_exact" in report["ratios"]
    assert set(report["loads"]) == {"demo", "replay_saved", "replay"}
    for load in report["loads"].values():
        assert 0 < load["fps"]["least"] <= load["fps"]["median"] <= load["fps"]["most"]
        assert load["stages_ms"]["acquire"] > 0 and load["cpu_ms"]["median"] > 0
    assert report["loads"]["replay"]["log_p99_ms"]["most"] == 0
    text = page.read_text()
    assert "`improvement`" in text
    assert text.index("numpy_neural_gas") < text.index("`replay_saved`") < text.index("| stage |")  # ratios first


def test_a_source_without_end_is_not_read_into_memory_for_ever() -> None:
    with pytest.raises(UsageError, match="never ends; say how many frames to time"):
        bench.bench("virtual:ball?size=320x240&live=1")


def test_ratios_are_peer_over_stage() -> None:
    summary = StageSummary(4.0, 5.9, 6.0, 3)
    report = bench.BenchReport("x", 1, 0, 1.0, 1, {}, {"improvement": summary}, {"krigekit_ordinary_kriging": 2.0}, {})
    assert bench.ratios(report) == {"krigekit_ordinary_kriging / improvement": 500.0}


def test_the_numpy_peer_does_the_same_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its steps are those of eq. (1)-(4): as good a quantisation as the compiled training."""
    rng = np.random.default_rng(3)
    points = rng.normal(size=(400, 3)).astype(np.float32)
    monkeypatch.setattr(peers, "NUMPY_STEPS", 8000)
    weights = peers.numpy_neural_gas(points, 40, rng)
    compiled = train_exact(points, 40, 20, seed=1)

    def error(nodes: np.ndarray) -> float:
        return float(np.linalg.norm(points[:, None] - nodes[None], axis=2).min(axis=1).mean())

    assert error(weights) == pytest.approx(error(compiled), rel=0.05)
