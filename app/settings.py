"""Every option of a run, typed: the command line and the settings file in one."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from tyro.conf import Fixed, Suppress, arg
from tyro.constructors import PrimitiveConstructorSpec

Source = Annotated[str, arg(metavar="SOURCE")]
MOST_ROUNDS = 254
"""Rounds of an acquisition; those of the selectors, which are not imported for the help's sake."""

Flag = Annotated[bool, arg(help_behavior_hint="")]
"""An option without a value; that it is off by default goes without saying."""


def optional(metavar: str) -> Any:
    """Describe an option whose help tells what holds without it."""
    return arg(metavar=metavar, help_behavior_hint="")


def must_be(allowed: str, kind: Callable[[str], Any], good: Callable[[Any], object], *, several: bool = False) -> Any:
    """Describe what an option's value must be; anything else is refused in a sentence.

    Parameters
    ----------
    allowed : str
        What may be given, as it follows "it must be".
    kind : callable
        Makes the value of what was typed, or raises ValueError.
    good : callable
        Whether the value is allowed.
    several : bool, default False
        Whether any number of them may be given; they become a tuple.
    """

    def value_of(typed: str) -> Any:
        try:
            value = kind(typed)
        except ValueError:
            raise ValueError(f"is '{typed}'; it must be {allowed}") from None
        if not good(value):
            shown = repr(value) if kind is str else typed
            raise ValueError(f"is {shown}; it must be {allowed}")
        return value

    return PrimitiveConstructorSpec(
        nargs="*" if several else 1,
        metavar="N" if kind is int else kind.__name__.strip("_").upper(),
        instance_from_str=lambda words: tuple(map(value_of, words)) if several else value_of(words[0]),
        is_instance=lambda value: True,
        str_from_instance=lambda value: [*map(str, value)] if several else [str(value)],
    )


def whole(least: int, most: int | None = None) -> Any:
    """Describe a whole number within limits."""
    allowed = f"{least:,} or more" if most is None else f"from {least:,} to {most:,}"
    return must_be(allowed, int, lambda n: n >= least and (most is None or n <= most))


Natural = Annotated[int, whole(0)]
Count = Annotated[int, whole(1)]
Limit = Annotated[int | None, whole(1), optional("N")]
Rounds = Annotated[int, whole(1, MOST_ROUNDS)]


def _share(typed: str) -> float:
    return float(typed[:-1]) / 100 if typed.endswith("%") else float(typed)


_A_SHARE = ("a share between 0 and 1, or of 100%", _share, lambda x: 0 <= x <= 1)
Share = Annotated[float, must_be(*_A_SHARE)]
Shares = Annotated[tuple[float, ...], must_be(*_A_SHARE, several=True), arg(metavar="SHARE...")]
positive = must_be("more than 0", float, lambda x: 0 < x < float("inf"))
Positive = Annotated[float, positive]
TimeLimit = Annotated[float | None, positive, optional("SECONDS")]
not_negative = must_be("0 or more", float, lambda x: 0 <= x < float("inf"))


def _window(typed: str) -> tuple[int, int]:
    width, height = map(int, typed.split("x"))
    return width, height


WindowSize = Annotated[
    tuple[int, int],
    must_be("WIDTHxHEIGHT, each from 200 to 8,000 pixels", _window, lambda wh: all(200 <= n <= 8000 for n in wh)),
    arg(metavar="WxH", help_behavior_hint="(default: 1920x1080)"),
]
Inches = Annotated[float, must_be("from 2 to 60 inches", float, lambda x: 2 <= x <= 60), arg(metavar="INCHES")]
_SIZE = re.compile(r"\d+(\.\d+)?([kMGT]i?)?B|\d+(\.\d+)?%")
Memory = Annotated[str, must_be("a size, such as 256MiB or 25%", str, _SIZE.fullmatch), arg(metavar="SIZE")]
Scheduler = Annotated[str | None, optional("ADDRESS|FILE")]
Millimetres = Annotated[int | None, whole(0, 65535), optional("MM")]


SourceOrSample = Annotated[str | None, optional("SOURCE")]
Layout = Literal["engineer", "visitor"]
Layer = Literal["colour", "cloud", "nodes", "triangles", "samples"]
LAYOUTS: tuple[Layout, ...] = get_args(Layout)
LAYERS: tuple[Layer, ...] = get_args(Layer)


@dataclass(frozen=True)
class SeedOptions:
    """The first, sparse measurements."""

    rows: Count = 128
    """Rows of the seed lattice."""
    columns: Count = 128
    """Columns of the seed lattice."""


@dataclass(frozen=True)
class GasOptions:
    """Neural gas: where the surfaces are (section III of the paper)."""

    nodes: Annotated[int, whole(1, 100_000)] = 2800
    """Number of nodes."""
    epochs: Count = 50
    """Passes over the seeds of the exact training."""
    algorithm: Literal["exact", "fast"] = "fast"
    """Cold training: the published steps, or batch passes, as good on scenes, in a fraction of the time."""
    training: Literal["live", "cold"] = "live"
    """Go on from the last frame's nodes, or train every frame from nothing."""
    seed: Natural = 0
    """Seed of the random draws."""
    edge_metric: Literal["3d", "image"] = "3d"
    """Measure edges in millimetres in space, or in pixels in the image."""
    factor: Positive = 1.0
    """An edge is long if it exceeds this many mean edge lengths."""


@dataclass(frozen=True)
class ImprovementOptions:
    """Improvement map: where a measurement helps most (section IV of the paper)."""

    share: Share = 0.10
    """Share of the known pixels that the mask selects."""
    exponent: Annotated[float, must_be("more than 0, at most 1.9999", float, lambda w: 0 < w <= 1.9999)] = 1.2
    """Exponent w = 2 - epsilon of the semivariogram, eq. (24)."""
    formula: Literal["eq23", "eq27"] = "eq23"
    """Eq. (23), or eq. (27), which holds for exponents near 2: sums over each neighbourhood."""


@dataclass(frozen=True)
class SelectorOptions:
    """The seeds, and the two published selectors."""

    seeds: SeedOptions = field(default_factory=SeedOptions)
    gas: GasOptions = field(default_factory=GasOptions)
    improvement: ImprovementOptions = field(default_factory=ImprovementOptions)


@dataclass(frozen=True)
class AcquireOptions:
    """Spending a budget of further measurements."""

    budget: Annotated[Share, arg(metavar="SHARE")] = 0.0
    """Further measurements as a share of the frame's pixels, 0..1; 0 for none."""
    rounds: Rounds = 2
    """Rounds in which they are taken, each knowing what the last one found."""
    memory: Literal["off", "still"] = "off"
    """still, for a camera that does not move: remember what was measured. The first frame measures its
    seeds and 5 % more; after it, the budget is all that a frame measures."""
    by: Annotated[str, arg(metavar="NAME")] = "auto"
    """What drives the shots: auto (the best there is), surface, step, improvement, neural-gas,
    neural-gas-edges, even, or FILE.py:NAME, a selector of your own."""
    even_every: Annotated[int | None, whole(0), optional("N")] = None
    """In every N-th frame, measure as many pixels on an even lattice too, to show what selecting gains;
    0 for never. By default every 3rd frame of a sensor and every 10th of a recording."""


@dataclass(frozen=True)
class RunOptions:
    """How long and how fast."""

    frames: Limit = None
    """Stop after this many frames; by default at the source's end, or with Ctrl-C."""
    threads: Limit = None
    """Threads of each stage; by default one, or one per processor where frames do not overlap."""
    no_governor: Flag = False
    """Leave nothing out, even where the machine is too slow to keep up with a sensor."""


@dataclass(frozen=True)
class PlayOptions:
    """How a recording is played."""

    start: Natural = 0
    """The first frame to play, from 0."""
    every: Count = 1
    """Play every N-th frame."""
    loop: Flag = False
    """Begin again at the end, until Ctrl-C."""
    realtime: Flag = False
    """Play at the recorded rate as a sensor would: the newest frame wins, and others may be skipped."""
    speed: Annotated[float | None, positive, optional("FACTOR")] = None
    """The same at this multiple of the recorded rate; 0.5 is slow motion."""


@dataclass(frozen=True)
class ViewerOptions:
    """Where the results are seen: any of these, together."""

    headless: Flag = False
    """Open no viewer window."""
    save: Annotated[Path | None, optional("FILE.rrd")] = None
    """Write everything to a Rerun recording, with the settings and a picture beside it."""
    overwrite: Flag = False
    """Replace what an earlier run saved or recorded under that name."""
    record: Annotated[Path | None, optional("FILE.oni")] = None
    """Record what the source delivers as well: every frame, whole, skipped or not."""
    json: Annotated[Path | None, optional("FILE.json")] = None
    """Write the report at the end as JSON too."""
    table: Annotated[Path | None, optional("FILE.parquet")] = None
    """Write a row of figures for each frame, as .parquet."""
    save_model: Annotated[Path | None, optional("DIR")] = None
    """At the end, write the last model: cloud.ply, depth.png and samples.npz."""
    serve: Flag = False
    """Serve a stream that viewers can join; a replay is served until Ctrl-C."""
    serve_address: Annotated[str | None, optional("HOST:PORT")] = None
    """Where to serve it; by default on this machine only, at 9876 or the next free port."""
    serve_origin: Annotated[str | None, optional("PATTERN")] = None
    """Where web viewers that may join come from besides this machine, such as http://192.0.2.7:9090."""
    connect: Annotated[str | None, optional("URL")] = None
    """Send to a viewer that is already open, for example rerun+http://127.0.0.1:9876/proxy."""
    serve_memory: Memory = "256MiB"
    """Memory of the stream, served or the window's, for those who join late; the oldest goes."""
    viewer_memory: Memory = "2GiB"
    """Memory of a viewer window that is opened; then the oldest goes."""
    near_mm: Millimetres = None
    """Depth at the dark end of the colour scale; by default what suits the first frame."""
    far_mm: Millimetres = None
    """Depth at its bright end. Both hold for the whole run, so that colours never jump."""
    layout: Layout = "engineer"
    """visitor: large pictures and what selecting gains; engineer: every figure of the run too."""
    hide: Annotated[tuple[Layer, ...], arg(metavar=f"{'|'.join(LAYERS)}...")] = ()
    """Layers that are not shown."""
    detail: Flag = False
    """Show the kriging estimate, its variance and the long-edge triangles too."""


@dataclass(frozen=True)
class DemoOptions:
    """Where the page is."""

    share: Flag = False
    """Let others in this network use it too: whoever has the address that is printed."""
    port: Annotated[int, whole(1, 65526)] = 8080
    """The port it is on, or the next that is free."""
    no_browser: Flag = False
    """Open no browser."""


@dataclass(frozen=True)
class PictureOptions:
    """Pictures; their format is that of the file's ending: .png, .webp, .pdf or .svg."""

    dpi: Annotated[int, whole(10, 2400)] = 100
    """Pixels per inch."""
    width: Inches = 16.0
    """Width of the page in inches; type and lines grow with it."""


@dataclass(frozen=True)
class PanelOptions(PictureOptions):
    """Pictures: of one that is named, the format is that of its ending, .png, .webp, .pdf or .svg."""

    format: Literal["png", "webp", "pdf", "svg"] = "png"
    """Format of those in a folder."""
    panel_width: Inches = 5.3
    """Width of a single panel with its title, colour bar and notes, in inches."""
    bare: Flag = False
    """Single panels without these: the pixels of the frame alone."""


@dataclass(frozen=True)
class ComparisonOptions:
    """What is compared on what."""

    every: Count = 20
    """Take every N-th frame."""
    frames: Limit = None
    """Take at most this many frames of each source."""
    budget: Shares = (0.05, 0.10)
    """Further measurements as shares of the frame's pixels."""
    rounds: Rounds = 8
    """Rounds of the closed loops."""
    strategies: Annotated[tuple[str, ...], arg(metavar="NAME...")] = ("main",)
    """What is compared: main, all, names out of the table, or FILE.py:NAME, a selector of your
    own; uniform and oracle always are."""
    over_time: Flag = False
    """Follow every frame of each source with a memory instead, which spends the first budget."""
    random_seeds: Count = 3
    """How often strategies that draw at random are run."""
    jobs: Limit = None
    """Processes; by default one per processor."""
    scheduler: Scheduler = None
    """A Dask scheduler, whose workers do the work instead: its address or its file."""


@dataclass(frozen=True)
class BatchOptions:
    """What is kept of each recording besides its table, and who does the work."""

    models: Flag = False
    """The model of its last frame: cloud.ply, depth.png and samples.npz."""
    keep: Annotated[tuple[Literal["masks", "maps", "depth"], ...], arg(metavar="masks|maps|depth...")] = ()
    """Of every frame, as PNG: masks (1 neural gas + 2 improvement), maps (the improvement map,
    65535 = the best), depth (the model in mm)."""
    stills: Natural = 0
    """This many pictures of single frames, spread over the recording."""
    rrd: Flag = False
    """A Rerun recording."""
    frames: Limit = None
    """Take at most this many frames of each."""
    scheduler: Scheduler = None
    """A Dask scheduler: its address or its file; by default processes of this machine."""
    workers: Limit = None
    """Number of these processes; by default one per processor."""
    force: Flag = False
    """Redo what is already done and unchanged."""


@dataclass(frozen=True)
class EvaluationFiles:
    """Where an evaluation is written, besides the terminal."""

    json: Annotated[Path | None, optional("FILE")] = None
    """Write the figures to a file as well."""
    picture: Annotated[Path | None, optional("FILE.png")] = None
    """Draw where each strategy measured and how wrong its model is, for the first frame."""
    page: Annotated[Path | None, optional("FILE.md")] = None
    """Write the tables in Markdown."""
    table: Annotated[Path | None, optional("FILE.parquet")] = None
    """Write a row for each frame, budget, strategy and draw, as .parquet or .csv."""
    curves: Annotated[Path | None, optional("FILE.pdf")] = None
    """Draw the error over the share of pixels measured; more budgets make longer curves."""


@dataclass(frozen=True)
class Settings(SelectorOptions):
    """All options of a run."""

    acquire: Annotated[AcquireOptions, arg(name="")] = field(default_factory=AcquireOptions)
    run: Annotated[RunOptions, arg(name="")] = field(default_factory=RunOptions)
    play: Annotated[PlayOptions, arg(name="")] = field(default_factory=PlayOptions)
    viewer: Annotated[ViewerOptions, arg(name="")] = field(default_factory=ViewerOptions)


@dataclass(frozen=True)
class LiveSettings(Settings):
    """Those of a sensor, which is not played."""

    play: Annotated[PlayOptions, Fixed, Suppress] = field(default_factory=PlayOptions)


FLAT_SECTIONS = ("run", "acquire", "play", "viewer")
"""Sections whose options carry no prefix on the command line."""
