"""Whole runs as people start them, each several times: what the machine keeps up with."""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from selective_depth.app.commands.session import Session
from selective_depth.app.pipeline import RunReport
from selective_depth.app.settings import AcquireOptions, PlayOptions, RunOptions, Settings, ViewerOptions

RUNS = 3
DEMO_FRAMES = 300
_SPENT = AcquireOptions(budget=0.05, rounds=4, even_every=0)
LOADS = {
    "demo": Settings(acquire=replace(_SPENT, even_every=3), play=PlayOptions(loop=True, realtime=True)),
    "replay_saved": Settings(acquire=_SPENT),
    "replay": Settings(acquire=_SPENT),
}
"""Both selectors and 5 % more in 4 rounds, a model of every frame: `demo` at a sensor's rate with the even
lattice's model in every third frame, saved; a recording as fast as it goes, saved and not saved."""


@dataclass(frozen=True)
class Spread:
    """The median of several runs, and how far they lie apart."""

    median: float
    least: float
    most: float


@dataclass(frozen=True)
class Load:
    """What several runs of a load came to.

    Attributes
    ----------
    fps : Spread
        Frames per second.
    dropped : Spread
        Frames of a sensor that nobody had time for, since the start.
    loop_p99_ms, log_p99_ms : Spread
        Of the whole turn; of what is logged, in its own thread.
    cpu_ms : Spread
        Processor time a frame, of all threads.
    stages_ms : dict of str to float
        Median of each stage in the last run.
    """

    fps: Spread
    dropped: Spread
    loop_p99_ms: Spread
    log_p99_ms: Spread
    cpu_ms: Spread
    stages_ms: dict[str, float]


def run_once(source: str, settings: Settings, frames: int | None, *, saved: bool = True) -> RunReport:
    """Run a source without a window, leaving nothing out, and saved for Rerun or not at all; its report."""
    with tempfile.TemporaryDirectory() as folder:
        run = RunOptions(frames=frames, no_governor=True)
        seen = ViewerOptions(headless=True, save=Path(folder) / "bench.rrd" if saved else None)
        session = Session(source, replace(settings, run=run, viewer=seen))
        session.run()
        return session.report


def run_loads(source: str, frames: int | None, say: Callable[[str], None]) -> dict[str, Load]:
    """Run every load `RUNS` times.

    Parameters
    ----------
    source : str
        A recording, as `open_source` takes it.
    frames : int, optional
        At most so many frames a run; by default `DEMO_FRAMES` of the demo, and all of the recording.
    say : callable
        Told what is being timed.
    """
    return {name: _run(source, name, frames, say) for name in LOADS}


def _run(source: str, name: str, frames: int | None, say: Callable[[str], None]) -> Load:
    say(f"load '{name}', {RUNS} runs")
    settings = LOADS[name]
    limit = frames or (DEMO_FRAMES if settings.play.loop else None)
    reports = [run_once(source, settings, limit, saved=name != "replay") for _ in range(RUNS)]

    def spread(of: Callable[[RunReport], float]) -> Spread:
        values = [of(report) for report in reports]
        return Spread(statistics.median(values), min(values), max(values))

    return Load(
        fps=spread(lambda report: report.fps),
        dropped=spread(lambda report: report.dropped),
        loop_p99_ms=spread(lambda report: report.stages["loop"].p99_ms),
        log_p99_ms=spread(lambda report: report.stages["log"].p99_ms if "log" in report.stages else 0.0),
        cpu_ms=spread(lambda report: 1000 * report.processor_s / max(report.frames, 1)),
        stages_ms={stage: times.p50_ms for stage, times in reports[-1].stages.items()},
    )
