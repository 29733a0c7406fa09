"""Every stage of the loop timed, and the same work done elsewhere timed beside it."""

from __future__ import annotations

import json
import os
import platform
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from itertools import islice
from pathlib import Path

import numpy as np

from selective_depth.app.benchmark.loads import Load, run_loads
from selective_depth.app.benchmark.peers import peer_seconds
from selective_depth.app.commands.session import Session
from selective_depth.app.console.errors import UsageError
from selective_depth.app.pipeline import RunReport, StageSummary, open_and_tell
from selective_depth.app.settings import PlayOptions, RunOptions, Settings, ViewerOptions
from selective_depth.selectors.improvement import ImprovementSelector
from selective_depth.selectors.neural_gas import BatchNeuralGas, delaunay_regions, node_pixels, train_exact
from selective_depth.selectors.parallel import default_threads
from selective_depth.selectors.seeds import SeedGrid

NODES, EPOCHS = 2800, 50
COLD_FRAMES = 12
EXACT_FRAMES = 3
WARM_UP = 10

Say = Callable[[str], None]
Durations = dict[str, list[float]]
"""Milliseconds of every run of a stage, by the stage's name."""
SCHEMA = 1
"""Version of the JSON's keys."""


@dataclass(frozen=True)
class BenchReport:
    """What `bench` measured; `to_json` has the shape that the documentation names."""

    source: str
    frames: int
    dropped: int
    fps: float
    threads: int
    machine: dict[str, str]
    stages: dict[str, StageSummary]
    peers: dict[str, float]
    loads: dict[str, Load]

    def to_json(self) -> str:
        """The report as JSON: milliseconds per stage, seconds per peer."""
        content = {"schema": SCHEMA} | asdict(self) | {"ratios": ratios(self)}
        for summary in content["stages"].values():
            del summary["count"]
        return json.dumps(content, indent=2) + "\n"


def ratios(report: BenchReport) -> dict[str, float]:
    """How many times longer a peer takes than the stage that does its work."""
    pairs = [
        ("improvement", "krigekit_ordinary_kriging"),
        ("improvement", "pykrige_ordinary_kriging"),
        ("neural_gas_exact", "numpy_neural_gas"),
        ("neural_gas_fast", "numpy_neural_gas"),
    ]
    return {
        f"{peer} / {stage}": report.peers[peer] * 1000 / report.stages[stage].p50_ms
        for stage, peer in pairs
        if peer in report.peers and stage in report.stages
    }


def machine() -> dict[str, str]:
    """What the figures were measured on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = names[0].partition(":")[2].strip() if names else model
    return {
        "processor": model,
        "cores": str(os.cpu_count()),
        "system": platform.system(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("numpy", "scipy", "numba", "rerun-sdk")},
    }


def summarise(durations_ms: list[float]) -> StageSummary:
    """Median, 99th percentile and maximum of a stage's runs."""
    p50, p99 = np.percentile(durations_ms, (50, 99))
    return StageSummary(float(p50), float(p99), max(durations_ms), len(durations_ms))


def bench(source: str, frames: int | None = None, *, peers: bool = True, say: Say = lambda text: None) -> BenchReport:
    """Time every stage over the frames of a source, one after the other.

    Parameters
    ----------
    source : str
        What `open_source` takes; it is read into memory first.
    frames : int, optional
        At most this many frames.
    peers : bool, default True
        Time the peers that are installed as well.
    say : callable
        Told what is being timed.
    """
    say("reading the frames")
    seeds = _seeds_of(source, frames)
    durations: Durations = {}
    _time_improvement(seeds, durations, say)
    _time_neural_gas(seeds, durations, say)
    say("the whole loop in real time, both selectors, saving for Rerun")
    report = _whole_loop(source, frames)
    loads = run_loads(source, frames, say)
    say("peers" if peers else "done")
    measured = {name: summarise(each) for name, each in durations.items()}
    measured |= {"log": report.stages["log"], "loop": report.stages["loop"]}
    return BenchReport(
        source=Path(source).name or source,
        frames=report.frames,
        dropped=report.dropped,
        fps=report.fps,
        threads=default_threads(),
        machine=machine(),
        stages=measured,
        peers=peer_seconds(seeds[0], NODES, EPOCHS) if peers else {},
        loads=loads,
    )


def _seeds_of(source: str, frames: int | None) -> list[SeedGrid]:
    with open_and_tell(source) as opened:
        if opened.frame_count is None and frames is None:
            raise UsageError(f"'{source}' never ends; say how many frames to time, as in --frames 300.")
        return [SeedGrid.from_frame(frame) for frame in islice(opened, frames)]


def _timed(durations: Durations, name: str, calls: Iterable[Callable[[], object]]) -> None:
    for call in calls:
        start = time.perf_counter()
        call()
        durations.setdefault(name, []).append((time.perf_counter() - start) * 1000)


def _time_improvement(seeds: list[SeedGrid], durations: Durations, say: Say) -> None:
    for name, threads in (("improvement", None), ("improvement_one_thread", 1)):
        say(name.replace("_", " "))
        selector = ImprovementSelector(threads=threads)
        for grid in seeds[:WARM_UP]:  # compiles, builds the tables, starts the threads
            selector.select(grid)
        _timed(durations, name, (partial(selector.select, grid) for grid in seeds))


def _time_neural_gas(seeds: list[SeedGrid], durations: Durations, say: Say) -> None:
    say("neural gas, exact")
    some = seeds[:: max(1, len(seeds) // EXACT_FRAMES)][:EXACT_FRAMES]
    train_exact(some[0].points_mm[:64], 16, 1, seed=0)  # compiles
    exact = (partial(train_exact, grid.points_mm, NODES, EPOCHS, seed=0) for grid in some)
    _timed(durations, "neural_gas_exact", exact)
    say("neural gas, fast and live")
    live = BatchNeuralGas(NODES, seed=0)
    live.train(seeds[0].points_mm, seeds[0].uv)
    cold = seeds[:: max(1, len(seeds) // COLD_FRAMES)][:COLD_FRAMES]
    fast = (partial(BatchNeuralGas(NODES, seed=0).train, grid.points_mm, grid.uv) for grid in cold)
    _timed(durations, "neural_gas_fast", fast)
    for grid in seeds:
        _ = grid.points_mm, grid.uv  # cached: taking the seeds is a stage of its own
        _timed(durations, "neural_gas_live", [partial(live.update, grid.points_mm, grid.uv)])
        _timed(durations, "regions", [partial(_regions, live, grid)])


def _regions(gas: BatchNeuralGas, seeds: SeedGrid) -> object:
    return delaunay_regions(gas.nodes_mm_, node_pixels(gas.nodes_mm_, seeds), seeds.frame_shape)


def _whole_loop(source: str, frames: int | None) -> RunReport:
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(
            run=RunOptions(frames=frames, no_governor=True),
            play=PlayOptions(realtime=True),
            viewer=ViewerOptions(headless=True, save=Path(folder) / "bench.rrd"),
        )
        session = Session(source, settings)
        session.run()
        return session.report
