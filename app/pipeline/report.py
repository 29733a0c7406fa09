"""What a run came to: the table at its end, and the settings file beside its results."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console
from rich.table import Table

from selective_depth.app import __version__
from selective_depth.app.console.output import write_output
from selective_depth.app.console.settings_file import to_toml
from selective_depth.app.pipeline.figures import figures_of
from selective_depth.app.pipeline.result import FrameResult
from selective_depth.app.pipeline.timing import StageSummary
from selective_depth.app.settings import Settings

HEADING = "Settings of a run of selective-depth"


@dataclass
class Mean:
    """A running mean of the finite values it is given."""

    total: float = 0.0
    count: int = 0

    def add(self, value: float) -> None:
        """Take one value in."""
        if math.isfinite(value):
            self.total += value
            self.count += 1

    @property
    def value(self) -> float:
        """Their mean; NaN of none."""
        return self.total / self.count if self.count else math.nan


@dataclass
class RunReport:
    """Figures of a run, gathered frame by frame.

    Parameters
    ----------
    source : str
        What was run.
    live : bool
        Whether frames could be lost.
    dropped_starting : int
        Frames lost while everything was got ready with the first one.
    dropped : int
        Frames lost since then.
    state : str
        The sensor's at the end.
    by : str
        What drove the shots; empty without a budget.
    """

    source: str
    live: bool
    frames: int = 0
    seconds: float = 0.0
    dropped_starting: int = 0
    dropped: int = 0
    missed: dict[str, int] = field(default_factory=dict)
    stages: dict[str, StageSummary] = field(default_factory=dict)
    state: str = ""
    by: str = ""
    samples: Mean = field(default_factory=Mean)
    quantisation_error_mm: Mean = field(default_factory=Mean)
    rmse_mm: Mean = field(default_factory=Mean)
    truth_rmse_mm: Mean = field(default_factory=Mean)
    sensor_rmse_mm: Mean = field(default_factory=Mean)
    known_percent: Mean = field(default_factory=Mean)
    measured_percent: Mean = field(default_factory=Mean)
    even_rmse_mm: Mean = field(default_factory=Mean)
    troubles: list[str] = field(default_factory=list)
    written: list[Path] = field(default_factory=list)

    @property
    def fps(self) -> float:
        """Frames per second of the whole loop: waiting, reading and handing over included."""
        return self.frames / self.seconds if self.seconds else 0.0

    @property
    def gain(self) -> str:
        """What selecting was worth, in a line; empty where nothing was held against an even lattice."""
        if not self.even_rmse_mm.count:
            return ""
        remembered = self.known_percent.count and self.truth_rmse_mm.count
        rmse_mm, even_mm = (self.truth_rmse_mm if remembered else self.rmse_mm).value, self.even_rmse_mm.value
        times = f"{even_mm / max(rmse_mm, 1e-9):.1f} times as good"
        measured = f"{self.measured_percent.value:.1f}% of the pixels"
        return f"{measured} · {rmse_mm:.1f} mm · even lattice {even_mm:.1f} mm · {times}"

    def take(self, result: FrameResult) -> None:
        """Add a frame's result."""
        self.frames += 1
        if result.acquisition is not None:
            self.by = result.acquisition.by
        for name, value in figures_of(result).items():
            if isinstance(mean := getattr(self, name, None), Mean):
                mean.add(value)


def say(sentence: str) -> None:
    """Print a sentence on standard output."""
    print(sentence, flush=True)


def print_report(report: RunReport) -> None:
    """Print the table of a run on standard output; without colours if that is no terminal."""
    console = Console(highlight=False)
    console.print(report.source, soft_wrap=True)  # a table would break a long path
    table = Table(box=None, pad_edge=False, show_header=False)
    for side in ("left", "right", "left"):
        table.add_column(justify=side)
    table.add_row("frames", f"{report.frames:,}", "")
    table.add_row("whole loop", f"{report.fps:.1f}", "frames/s")
    if report.live:
        table.add_row("skipped while starting", f"{report.dropped_starting:,}", "frames")
        table.add_row("skipped to keep up", f"{report.dropped:,}", "frames")
        table.add_row("sensor at the end", report.state, "")
    for name, missed in report.missed.items():
        table.add_row(f"not shown in {name}", f"{missed:,}", "frames")
    table.add_row("samples with depth", f"{report.samples.value:,.0f}", "per frame")
    if report.quantisation_error_mm.count:
        table.add_row("quantisation error", f"{report.quantisation_error_mm.value:.1f}", "mm")
    if report.by:
        table.add_row("shots chosen by", report.by, "")
    if report.rmse_mm.count:
        table.add_row("model RMSE", f"{report.rmse_mm.value:.1f}", "mm to the frame")
    if report.truth_rmse_mm.count:
        table.add_row("", f"{report.truth_rmse_mm.value:.1f}", "mm to the truth")
        table.add_row("whole frame", f"{report.sensor_rmse_mm.value:.1f}", "mm to the truth")
    if report.known_percent.count:
        table.add_row("pixels known", f"{report.known_percent.value:.1f}%", "on average")
    console.print(table)
    if report.gain:
        console.print(f"\n{report.gain}", style="bold")
    stages = Table(box=None, pad_edge=False)
    stages.add_column("milliseconds")
    for heading in ("p50", "p99", "max"):
        stages.add_column(heading, justify="right")
    for name, times in report.stages.items():
        figures = (times.p50_ms, times.p99_ms, times.max_ms)
        stages.add_row(name, *(f"{figure:.1f}" for figure in figures))
    console.print()
    console.print(stages)
    if report.written:
        console.print()
    for path in report.written:
        console.print(f"wrote {path}", soft_wrap=True)
    for trouble in report.troubles:
        console.print(f"note: {trouble}", soft_wrap=True)


def is_settings(path: Path) -> bool:
    """Whether a file is one that `save_settings` wrote."""
    with path.open("rb") as file:
        return file.read(len(HEADING) + 2) == f"# {HEADING}".encode()


def save_settings(path: Path, settings: Settings, source: str) -> None:
    """Write the settings of a run so that ``--settings`` reads them back.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    heading = f"{HEADING} {__version__}, {made}."
    write_output(path, to_toml(settings, heading, f"source: {source}"))
