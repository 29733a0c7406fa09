"""Every option of a run, typed: the command line and the settings file in one."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

Flag = Annotated[bool, arg(help_behavior_hint="")]
"""An option without a value; that it is off by default goes without saying."""


def optional(metavar: str) -> Any:
    """Describe an option whose help tells what holds without it."""
    return arg(metavar=metavar, help_behavior_hint="")


@dataclass(frozen=True)
class SeedOptions:
    """The first, sparse measurements."""

    rows: int = 128
    """Rows of the seed lattice."""
    columns: int = 128
    """Columns of the seed lattice."""


@dataclass(frozen=True)
class GasOptions:
    """Neural gas: where the surfaces are (section III of the paper)."""

    nodes: int = 2800
    """Number of nodes."""
    epochs: int = 50
    """Passes over the seeds of the exact training."""
    algorithm: Literal["exact", "fast"] = "fast"
    """Cold training: the published steps, or one with no larger error in a fraction of the time."""
    training: Literal["live", "cold"] = "live"
    """Go on from the last frame's nodes, or train every frame from nothing."""
    seed: int = 0
    """Seed of the random draws."""
    edge_metric: Literal["3d", "image"] = "3d"
    """Measure edges in millimetres in space, or in pixels in the image."""
    factor: float = 1.0
    """An edge is long beyond this many mean edge lengths."""


@dataclass(frozen=True)
class ImprovementOptions:
    """Improvement map: where a measurement helps most (section IV of the paper)."""

    share: float = 0.10
    """Share of the known pixels that the mask selects, 0..1."""
    exponent: float = 1.2
    """Exponent w = 2 - epsilon of the semivariogram, eq. (24); between 0 and 2."""


@dataclass(frozen=True)
class AcquireOptions:
    """Spending a budget of further measurements."""

    budget: Annotated[float, arg(metavar="SHARE")] = 0.0
    """Further measurements as a share of the frame's pixels, 0..1; 0 takes none."""
    rounds: int = 2
    """Rounds in which they are taken, each knowing what the last one found."""


@dataclass(frozen=True)
class RunOptions:
    """How long and how fast."""

    frames: Annotated[int | None, optional("N")] = None
    """Stop after this many frames; by default at the end of the recording, or with Ctrl-C."""
    threads: Annotated[int | None, optional("N")] = None
    """Threads of each stage; by default one, or one per processor where frames do not overlap."""
    realtime: Flag = False
    """Replay at the recorded rate, the newest frame first, as a sensor would deliver."""


@dataclass(frozen=True)
class ViewerOptions:
    """Where the results are seen: any of these, together."""

    headless: Flag = False
    """Open no viewer window."""
    save: Annotated[Path | None, optional("FILE.rrd")] = None
    """Write everything to a Rerun recording, with the settings and a picture beside it."""
    serve: Flag = False
    """Serve a stream that viewers can join; a replay is served until Ctrl-C."""
    serve_address: Annotated[str, arg(metavar="HOST:PORT")] = "127.0.0.1:9876"
    """Where to serve it; the default lets only this machine in."""
    connect: Annotated[str | None, optional("URL")] = None
    """Send to a viewer that is already open, for example rerun+http://127.0.0.1:9876/proxy."""
    serve_memory: Annotated[str, arg(metavar="SIZE")] = "256MiB"
    """Memory of the served stream, for viewers that join late; then the oldest goes."""
    viewer_memory: Annotated[str, arg(metavar="SIZE")] = "2GiB"
    """Memory of the viewer window; then the oldest goes."""
    near_mm: Annotated[int | None, optional("MM")] = None
    """Depth at the dark end of the colour scale; by default what suits the first frame."""
    far_mm: Annotated[int | None, optional("MM")] = None
    """Depth at its bright end. Both hold for the whole run, so that colours never jump."""
    detail: Flag = False
    """Show the kriging estimate, its variance and the long-edge triangles too."""


@dataclass(frozen=True)
class PictureOptions:
    """Pictures; their format is that of the file's ending: .png, .webp, .pdf or .svg."""

    dpi: int = 100
    """Pixels per inch."""
    width: float = 16.0
    """Width of the page in inches; type and lines grow with it."""


@dataclass(frozen=True)
class Settings:
    """All options of a run."""

    seeds: SeedOptions = field(default_factory=SeedOptions)
    gas: GasOptions = field(default_factory=GasOptions)
    improvement: ImprovementOptions = field(default_factory=ImprovementOptions)
    acquire: Annotated[AcquireOptions, arg(name="")] = field(default_factory=AcquireOptions)
    run: Annotated[RunOptions, arg(name="")] = field(default_factory=RunOptions)
    viewer: Annotated[ViewerOptions, arg(name="")] = field(default_factory=ViewerOptions)


FLAT_SECTIONS = ("run", "acquire", "viewer")
"""Sections whose options carry no prefix on the command line."""


def to_toml(settings: Settings, heading: str) -> str:
    """Settings as TOML that `--settings` reads back, under a commented heading."""
    tables: dict[str, dict[str, Any]] = dataclasses.asdict(settings)
    flat = {k: v for name in FLAT_SECTIONS for k, v in tables.pop(name).items()}
    lines = [f"# {line}".rstrip() for line in heading.split("\n")] + _toml_lines(flat)
    for name, table in tables.items():
        lines += ["", f"[{name}]", *_toml_lines(table)]
    return "\n".join(lines) + "\n"


def _toml_lines(table: dict[str, Any]) -> list[str]:
    return [f"{key} = {_toml_value(value)}" for key, value in table.items() if value is not None]


def _toml_value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (int, float)):
        return repr(value)
    quoted = str(value).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{quoted}"'
