"""What a run came to: the table at its end, and the settings file beside its results."""

from __future__ import annotations

import dataclasses
import json
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console

from selective_depth.app import __version__
from selective_depth.app.console.columns import print_table
from selective_depth.app.console.output import write_output
from selective_depth.app.console.settings_file import to_toml
from selective_depth.app.pipeline.result import FrameResult
from selective_depth.app.pipeline.timing import StageSummary
from selective_depth.app.settings import Settings

SCHEMA = 1
"""Version of the JSON's keys."""
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


def mean_of(values: Iterable[float]) -> float:
    """Mean of the finite ones of some values; NaN of none."""
    known = [value for value in values if math.isfinite(value)]
    return sum(known) / len(known) if known else math.nan


@dataclass
class RunReport:
    """Figures of a run, gathered frame by frame.

    Parameters
    ----------
    source : str
        What was run.
    live : bool
        Whether frames could be lost.
    processor_s : float
        Processor time of all threads while frames were made.
    dropped_starting : int
        Frames lost while everything was got ready with the first one.
    dropped : int
        Frames lost since then.
    state : str
        The sensor's at the end.
    by : str
        What drove the shots; empty without a budget.
    means : dict of str to Mean
        Of the results' figures, by name, since the options were changed last.
    changes : int
        How often they were changed on the way.
    recorded : dict of Path to (int, float)
        Files that were recorded on the way: frames, and for how many seconds.
    given_up : str
        What the governor left out at most; empty if it was nothing.
    given_up_frames : int
        In how many frames.
    """

    source: str
    live: bool
    frames: int = 0
    seconds: float = 0.0
    processor_s: float = 0.0
    dropped_starting: int = 0
    dropped: int = 0
    missed: dict[str, int] = field(default_factory=dict)
    stages: dict[str, StageSummary] = field(default_factory=dict)
    state: str = ""
    by: str = ""
    given_up: str = ""
    given_up_frames: int = 0
    means: dict[str, Mean] = field(default_factory=lambda: defaultdict(Mean))
    troubles: list[str] = field(default_factory=list)
    written: list[Path] = field(default_factory=list)
    recorded: dict[Path, tuple[int, float]] = field(default_factory=dict)
    changes: int = 0

    @property
    def fps(self) -> float:
        """Frames per second of the whole loop: waiting, reading and handing over included."""
        return self.frames / self.seconds if self.seconds else 0.0

    @property
    def gain(self) -> str:
        """What selecting was worth, in a line; empty where nothing was held against an even lattice."""
        return gain_of({name: mean.value for name, mean in self.means.items()})

    def take(self, result: FrameResult) -> None:
        """Add a frame's result, with its figures."""
        self.frames += 1
        for name, value in result.figures.items():
            self.means[name].add(value)
        if result.acquisition is not None:
            self.by = result.acquisition.by

    def begin_anew(self) -> None:
        """Options have changed: the figures are those of what comes from now on."""
        self.changes += 1
        self.means.clear()

    def to_json(self, settings: Settings) -> str:
        """The report and the settings as JSON; what is not known is null."""
        content = vars(self) | {
            "schema": SCHEMA,
            "gain": self.gain,
            "fps": self.fps,
            "means": {name: mean.value if mean.count else None for name, mean in self.means.items()},
            "stages": {name: dataclasses.asdict(times) for name, times in self.stages.items()},
            "recorded": {str(path): {"frames": n, "seconds": s} for path, (n, s) in self.recorded.items()},
            "settings": dataclasses.asdict(settings),
        }
        return json.dumps(content, indent=2, default=str) + "\n"


def gain_of(figures: Mapping[str, float]) -> str:
    """What selecting was worth, in a line, by the figures of `figures_of` or their means; empty if that is not known.

    With a memory it is the error to the truth, where that is known, as the even lattice's is then.
    """
    nan = math.nan
    remembers = math.isfinite(figures.get("known_percent", nan)) and math.isfinite(figures.get("truth_rmse_mm", nan))
    rmse_mm = figures.get("truth_rmse_mm" if remembers else "rmse_mm", nan)
    even_mm, measured = figures.get("even_rmse_mm", nan), figures.get("measured_percent", nan)
    if not math.isfinite(rmse_mm + even_mm + measured):
        return ""
    times = even_mm / max(rmse_mm, 1e-9)
    return (
        f"{measured:.1f}% of the pixels · {rmse_mm:.1f} mm · even lattice {even_mm:.1f} mm · {times:.1f} times as good"
    )


def say(sentence: str) -> None:
    """Print a sentence on standard output."""
    print(sentence, flush=True)


def write_if_asked(path: Path | None, write: Callable[[Path], None]) -> None:
    """Write a file, if one was asked for, and say so."""
    if path is not None:
        write(path)
        say(f"wrote {path}")


def print_report(report: RunReport) -> None:
    """Print the table of a run on standard output; without colours if that is no terminal."""
    console, means = Console(highlight=False, markup=False), report.means
    console.print(report.source, soft_wrap=True)  # a table would break a long path

    def mean(name: str, digits: int = 1) -> str:
        return f"{means[name].value:,.{digits}f}" if means[name].count else ""

    known = mean("known_percent")
    rows = [
        ("frames", f"{report.frames:,}", ""),
        ("whole loop", f"{report.fps:.1f}", "frames/s"),
        ("skipped while starting", f"{report.dropped_starting:,}" if report.live else "", "frames"),
        ("skipped to keep up", f"{report.dropped:,}" if report.live else "", "frames"),
        ("sensor at the end", report.state if report.live else "", ""),
        *((f"not shown in {name}", f"{missed:,}", "frames") for name, missed in report.missed.items()),
        ("samples with depth", mean("samples", 0), "per frame"),
        ("shots chosen by", report.by, ""),
        ("quantisation error", mean("quantisation_error_mm"), "mm"),
        ("model RMSE", mean("rmse_mm"), "mm to the frame"),
        ("", mean("truth_rmse_mm"), "mm to the truth"),
        ("whole frame", mean("sensor_rmse_mm"), "mm to the truth"),
        ("options changed", f"{report.changes:,}" if report.changes else "", "times; the figures are since the last"),
        ("left out to keep up", f"{report.given_up_frames:,}" if report.given_up else "", f"frames: {report.given_up}"),
        ("pixels known", f"{known}%" if known else "", "on average"),
    ]
    print_table([row for row in rows if row[1]], justify="lrl")  # what is not known is left out
    if report.gain:
        console.print(f"\n{report.gain}", style="bold")
    console.print()
    stages = [(name, *(f"{ms:.1f}" for ms in (t.p50_ms, t.p99_ms, t.max_ms))) for name, t in report.stages.items()]
    print_table(stages, ("milliseconds", "p50", "p99", "max"))
    if report.written:
        console.print()
    for path in report.written:
        console.print(f"wrote {path}{_size(path, report)}", soft_wrap=True)
    for trouble in report.troubles:
        console.print(f"note: {trouble}", soft_wrap=True)


def _size(path: Path, report: RunReport) -> str:
    """How large a recording is, and how fast it grew."""
    frames, seconds = report.recorded.get(path, (0, report.seconds if path.suffix == ".rrd" else 0.0))
    if not seconds or not path.is_file():
        return ""
    size = path.stat().st_size
    count = f"{frames:,} frames, " if frames else ""
    return f" ({count}{size / 1e6:,.1f} MB, {size / 1e6 * 60 / seconds:,.0f} MB a minute)"


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
