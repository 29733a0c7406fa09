"""Every stage of the loop timed, and the same work done elsewhere timed beside it."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from itertools import islice
from pathlib import Path

from selective_depth.app.benchmark.loads import Load, run_loads, run_once
from selective_depth.app.benchmark.peers import peer_seconds
from selective_depth.app.console.errors import UsageError
from selective_depth.app.pipeline import StageSummary, StageTimes, open_and_tell
from selective_depth.app.settings import PlayOptions, Settings
from selective_depth.selectors.improvement import ImprovementSelector
from selective_depth.selectors.neural_gas import BatchNeuralGas, delaunay_regions, node_pixels, train_exact
from selective_depth.selectors.parallel import default_threads
from selective_depth.selectors.seeds import SeedGrid

NODES, EPOCHS = 2800, 50
COLD_FRAMES = 12
EXACT_FRAMES = 3
WARM_UP = 10

Say = Callable[[str], None]
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
    """The machine that the figures were measured on."""
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
    times = StageTimes()
    _time_improvement(seeds, times, say)
    _time_neural_gas(seeds, times, say)
    say("the whole loop in real time, both selectors, saving for Rerun")
    report = run_once(source, Settings(play=PlayOptions(realtime=True)), frames)
    loads = run_loads(source, frames, say)
    say("peers" if peers else "done")
    return BenchReport(
        source=Path(source).name or source,
        frames=report.frames,
        dropped=report.dropped,
        fps=report.fps,
        threads=default_threads(),
        machine=machine(),
        stages=times.summary() | {name: report.stages[name] for name in ("log", "loop")},
        peers=peer_seconds(seeds[0], NODES, EPOCHS) if peers else {},
        loads=loads,
    )


def _seeds_of(source: str, frames: int | None) -> list[SeedGrid]:
    with open_and_tell(source) as opened:
        if opened.frame_count is None and frames is None:
            raise UsageError(f"'{source}' never ends; say how many frames to time, as in --frames 300.")
        return [SeedGrid.from_frame(frame) for frame in islice(opened, frames)]


def _time_improvement(seeds: list[SeedGrid], times: StageTimes, say: Say) -> None:
    for name, threads in (("improvement", None), ("improvement_one_thread", 1)):
        say(name.replace("_", " "))
        selector = ImprovementSelector(threads=threads)
        for grid in seeds[:WARM_UP]:  # compiles, builds the tables, starts the threads
            selector.select(grid)
        for grid in seeds:
            with times.stage(name):
                selector.select(grid)


def _time_neural_gas(seeds: list[SeedGrid], times: StageTimes, say: Say) -> None:
    say("neural gas, exact")
    for grid in seeds:
        _ = grid.points_mm, grid.uv  # cached: taking the seeds is a stage of its own
    train_exact(seeds[0].points_mm[:64], 16, 1, seed=0)  # compiles
    for grid in _spread_over(seeds, EXACT_FRAMES):
        with times.stage("neural_gas_exact"):
            train_exact(grid.points_mm, NODES, EPOCHS, seed=0)
    say("neural gas, fast and live")
    live = BatchNeuralGas(NODES, seed=0)
    live.train(seeds[0].points_mm, seeds[0].uv)
    for grid in _spread_over(seeds, COLD_FRAMES):
        with times.stage("neural_gas_fast"):
            BatchNeuralGas(NODES, seed=0).train(grid.points_mm, grid.uv)
    for grid in seeds:
        with times.stage("neural_gas_live"):
            live.update(grid.points_mm, grid.uv)
        with times.stage("regions"):
            delaunay_regions(live.nodes_mm_, node_pixels(live.nodes_mm_, grid), grid.frame_shape)


def _spread_over(seeds: list[SeedGrid], frames: int) -> list[SeedGrid]:
    """The seeds of so many frames, spread evenly over all of them."""
    return seeds[:: max(1, len(seeds) // frames)][:frames]
