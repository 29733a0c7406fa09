"""The figures of `bench` for people: tables on the terminal, and the benchmark page."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from rich.console import Console

from selective_depth.app.benchmark.bench import BenchReport, bench, ratios
from selective_depth.app.benchmark.loads import Spread
from selective_depth.app.console.columns import print_table
from selective_depth.app.console.output import check_output, write_output
from selective_depth.app.pipeline import say, write_if_asked

PAGE = "page.md"
"""The page's text beside this module, with places for the figures."""


def run_bench(source: str, frames: int | None, *, json: Path | None, page: Path | None, peers: bool) -> None:
    """Measure, print the tables, and write the files that were asked for.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    check_output(json, page)
    report = bench(source, frames, peers=peers, say=lambda text: say(f"timing: {text} …"))
    print_bench(report)
    write_if_asked(json, lambda path: write_output(path, report.to_json()))
    write_if_asked(page, lambda path: write_output(path, to_page(report)))


def print_bench(report: BenchReport) -> None:
    """Print ratios to the peers first, then whole runs, then stages, as tables."""
    if report.peers:
        others = [(f"{peer} / {stage}", f"{more} times", took) for peer, took, stage, more in _peer_rows(report)]
        print_table(others, ("the same work elsewhere", "", "seconds"))
    heads = ("median (range)", "frames/s", "dropped", "loop p99 ms", "log p99 ms", "processor ms")
    print_table(_load_rows(report), heads)
    Console(highlight=False).print(
        f"\n{report.source}: {report.frames} frames in real time at {report.fps:.1f} frames/s,"
        f" {report.dropped} dropped, {report.threads} threads",
        soft_wrap=True,
    )
    print_table(_stage_rows(report), ("milliseconds", "p50", "p99", "max", "runs"))


def _load_rows(report: BenchReport) -> list[tuple[str, ...]]:
    """A load's name and its figures, each with its spread, as text."""

    def told(each: Spread) -> str:
        return f"{each.median:.1f} ({each.least:.0f}-{each.most:.0f})"

    return [
        (name, *map(told, (load.fps, load.dropped, load.loop_p99_ms, load.log_p99_ms, load.cpu_ms)))
        for name, load in report.loads.items()
    ]


def _stage_rows(report: BenchReport) -> list[tuple[str, ...]]:
    """A stage's name, its milliseconds (median, 99th percentile, maximum) and runs, as text."""
    return [
        (name, *(f"{ms:,.2f}" for ms in (each.p50_ms, each.p99_ms, each.max_ms)), f"{each.count:,}")
        for name, each in report.stages.items()
    ]


def _peer_rows(report: BenchReport) -> list[tuple[str, str, str, str]]:
    """A peer's name, its seconds, our stage and how many times longer it takes, as text."""
    rows = []
    for pair, ratio in ratios(report).items():
        peer, _, stage = pair.partition(" / ")
        rows.append((peer, f"{report.peers[peer]:,.2f}", stage, f"{ratio:,.0f}"))
    return rows


def to_page(report: BenchReport) -> str:
    """The benchmark page of the documentation, in Markdown."""
    stages = "\n".join(f"| `{name}` | {' | '.join(figures)} |" for name, *figures in _stage_rows(report))
    peers = "\n".join(f"| `{peer}` | {took} s | `{stage}` | {more} |" for peer, took, stage, more in _peer_rows(report))
    loads = "\n".join(f"| `{name}` | {' | '.join(figures)} |" for name, *figures in _load_rows(report))
    host = ", ".join(f"{name} {value}" for name, value in report.machine.items())
    text = files(__package__).joinpath(PAGE).read_text(encoding="utf-8")
    return text.format(report=report, stages=stages, peers=peers, loads=loads, host=host)
