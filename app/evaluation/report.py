"""The results of an evaluation: on the terminal, as JSON, as tables, and in pictures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from selective_depth.app import __version__
from selective_depth.app.console import tables
from selective_depth.app.console.columns import print_table
from selective_depth.app.console.errors import UsageError
from selective_depth.app.console.output import check_output, check_picture, write_output
from selective_depth.app.console.progress import FrameProgress
from selective_depth.app.evaluation.evaluate import Outcome, Results, frames_of, outcomes, summarise
from selective_depth.app.evaluation.over_time import Course, over_time, truth_of
from selective_depth.app.evaluation.strategies import STRATEGIES, Case, strategy_of
from selective_depth.app.pictures import WIDTH_IN, Panel, depth_panel, error_panel, sheet, shots_panel, write_picture
from selective_depth.app.pipeline import say, write_if_asked
from selective_depth.app.settings import ComparisonOptions, EvaluationFiles, PictureOptions, Settings
from selective_depth.drivers.frame import DepthFrame
from selective_depth.selectors.acquire import acquire, shots_of
from selective_depth.selectors.memory import TemporalStep
from selective_depth.selectors.reconstruct import reconstruct

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCHEMA = 1
"""Version of the JSON document and of the table."""
TABLES = (".parquet", ".csv")
TITLES = {
    "uniform": "Even lattice",
    "improvement": "Published, one shot",
    "gradient": "Gradient, one shot",
    "step": "Step score, one shot",
    "loop": "Surface score, closed loop",
    "oracle": "Oracle",
}
"""The strategies of the picture, from left to right."""
COLUMNS = {
    "ratio": ("geo", "{:.3f}"),
    "worst": ("worst", "{:.3f}"),
    "share": ("share", "{:.1%}"),
    "least": ("share_min", "{:.1%}"),
    "RMSE": ("rmse_mm", "{:.1f}"),
    "MAE": ("mae_mm", "{:.2f}"),
    "wrong": ("wrong", "{:.2%}"),
    "missed": ("missed", "{:.0%}"),
}
"""Columns of the table: which figure, and how it is written."""


def run_evaluation(
    sources: Sequence[str],
    options: ComparisonOptions,
    settings: Settings,
    *,
    files: EvaluationFiles,
    page: PictureOptions,
) -> None:
    """Evaluate, show the table and write what was asked for.

    Raises
    ------
    UsageError, OutputError
        If there is no source, no budget or no such strategy, or a file cannot be written; refused before
        the work is done where possible.
    """
    if not sources:
        raise UsageError("no source was named; give recordings, folders or scenes.")
    if not options.budget:
        raise UsageError("--budget names no share; give one or more, such as 5% 10%.")
    for picture in (files.picture, files.curves):
        check_picture(picture)
    check_output(files.json, files.page)
    check_picture(files.table, TABLES, "table")
    if options.over_time:
        if files.table or files.page or files.curves:
            raise UsageError("--over-time writes --json and --picture alone; leave --table, --page and --curves out.")
        return _run_over_time(sources, options, settings, files, page)
    with FrameProgress("Evaluating", None) as bar:
        found = outcomes(sources, options, settings, lambda done, total: bar.update(done, f"of {total}"))
    print_results(summarise(found), len({outcome.frame for outcome in found}), options.rounds)

    def first_frame() -> Figure:
        frame = next(frames_of(sources, options.every, 1))
        return comparison(Case(frame, settings, shots_of(options.budget[0], frame.shape), options.rounds), page.width)

    write_if_asked(files.json, lambda path: write_output(path, to_json(found, options, settings)))
    write_if_asked(files.table, lambda path: write_table(path, found))
    write_if_asked(files.page, lambda path: write_output(path, to_markdown(found)))
    write_if_asked(files.picture, lambda path: write_picture(path, first_frame(), page.dpi))
    write_if_asked(files.curves, lambda path: write_picture(path, curves(found, page.width), page.dpi))


def _percent(budget: str) -> str:
    """A budget such as "0.025" as "2.5%"."""
    return f"{100 * float(budget):.6g}%"


def print_results(results: Results, frames: int, rounds: int) -> None:
    """Show the figures as one table per budget."""
    for budget, table in results.items():
        print_table(
            [(name, *_cells(figures)) for name, figures in table.items()],
            ("", *COLUMNS),
            bold="loop",
            title=f"+{_percent(budget)} of the pixels · {frames} frames · closed loops of {rounds} rounds",
            caption="ratio of the RMSE (mm) to uniform's, geometric mean and worst; share of the"
            " way from uniform to the oracle, mean and least; wrong: off by > 20 mm and > 2 %",
        )


def _cells(figures: dict[str, float]) -> list[str]:
    return [form.format(figures[name]) for name, form in COLUMNS.values()]


def to_markdown(found: Sequence[Outcome]) -> str:
    """The figures as a Markdown table, for the documentation."""
    lines = []
    for budget, table in summarise(found).items():
        lines.append(f"| +{_percent(budget)} | geo | worst | oracle share | least | RMSE mm | MAE mm |")
        lines.append("|---" * 7 + "|")
        for name, figures in table.items():
            lines.append(f"| {strategy_of(name).about} (`{name}`) | {' | '.join(_cells(figures)[:6])} |")
        lines.append("")
    return "\n".join(lines)


def to_json(found: Sequence[Outcome], options: ComparisonOptions, settings: Settings) -> str:
    """The whole evaluation: figures by budget and strategy, in all and per source, and how it was made.

    Parameters
    ----------
    found : sequence of Outcome
        What every strategy made of every frame.
    options, settings
        What it was made with.
    """
    document = {
        **summarise(found),
        "schema": SCHEMA,
        "version": __version__,
        "settings": {
            "comparison": asdict(options),
            **{name: asdict(getattr(settings, name)) for name in ("seeds", "gas", "improvement")},
        },
        "sources": {
            source: summarise([each for each in found if each.source == source])
            for source in dict.fromkeys(each.source for each in found)
        },
        "frames": [asdict(outcome) for outcome in found],
    }
    return json.dumps(document, indent=1) + "\n"


def write_table(path: Path, found: Sequence[Outcome]) -> None:
    """Write a row for each frame, budget, strategy and draw, by the file's ending.

    Columns: ``source``, ``index`` (of the frame), ``budget`` (share of the pixels beyond the
    seeds), ``measured`` (share of the pixels in all), ``strategy``, ``draw`` (random seed),
    ``rmse_mm``, ``mae_mm``, ``wrong`` and ``missed`` (shares), ``shots``.

    Raises
    ------
    OutputError
        If it cannot be written; an older file stays as it was.
    """
    rows = []
    for outcome in found:
        what = {name: getattr(outcome, name) for name in ("source", "index", "budget", "measured", "strategy")}
        rows += [what | {"draw": draw} | asdict(errors) for draw, errors in enumerate(outcome.errors)]
    tables.write_table(path, pa.Table.from_pylist(rows), SCHEMA)


def curves(found: Sequence[Outcome], width_in: float) -> Figure:
    """Error over the share of the pixels measured, a line for each strategy.

    Strategies that spend other numbers of measurements than the budget (`Strategy.reference`) are
    left out.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    results = summarise(found)
    measured = {f"{o.budget:g}": 100 * o.measured for o in found}
    with rc_context({"text.parse_math": False, "font.size": 11 * width_in / 16 + 2}):
        figure = Figure(figsize=(width_in, width_in * 0.56), facecolor="white", layout="constrained")
        axes = figure.add_subplot()
        names = list(next(iter(results.values())))
        for at, name in enumerate(n for n in names if not strategy_of(n).reference):
            points = [(measured[f"{float(budget):g}"], table[name]["rmse_mm"]) for budget, table in results.items()]
            style = ("-", "--", ":", "-.")[at // 10 % 4]
            bold = 3.0 if name == "loop" else 1.4
            axes.plot(*zip(*sorted(points), strict=True), style, marker="o", linewidth=bold,
                      markersize=4, label=name, color=f"C{at % 10}")  # fmt: skip
        axes.set(xlabel="pixels measured, %", ylabel="RMSE of the model, mm", xscale="log",
                 yscale="log")  # fmt: skip
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter("{x:g}")
        axes.grid(True, which="both", alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
        figure.legend(loc="outside right upper", frameon=False)
    return figure


def _shown(case: Case, name: str) -> tuple[Panel, Panel]:
    """Where a strategy measured, and how wrong the model of it is."""
    frame = case.frame
    if name == "loop":
        acquisition = acquire(frame.measure, case.seeds, rounds=case.rounds, shots=case.shots)
        uv, rounds = acquisition.uv, acquisition.round
    else:
        uv = STRATEGIES[name].pixels(case)
        seeds = 0 if name == "uniform" else len(case.seed_uv)
        rounds = np.where(np.arange(len(uv)) < seeds, 0, 1)
    shots = shots_panel(frame, uv, rounds, TITLES[name])
    error = error_panel(frame, reconstruct(uv, frame.measure(uv), frame.shape), "Model error")
    return shots, error


def comparison(case: Case, width_in: float = WIDTH_IN) -> Figure:
    """Where each strategy of `TITLES` measured, above the error of its model.

    Parameters
    ----------
    case : Case
        What is measured, and the budget.
    width_in : float, default 16
        Width of the page in inches.
    """
    shots, errors = zip(*(_shown(case, name) for name in TITLES), strict=True)
    total = (len(case.seed_uv) + case.shots) / case.frame.depth_mm.size
    title = f"The same {total:.1%} of the pixels: where they are measured, and the model's error"
    return sheet([(title, shots), ("", errors)], width_in, legend=False)


def _run_over_time(
    sources: Sequence[str], options: ComparisonOptions, settings: Settings, files: EvaluationFiles, page: PictureOptions
) -> None:
    """Follow each source, print its errors, and write them as JSON if asked.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    budget = float(options.budget[0])
    found: dict[str, dict[str, Course]] = {}
    for uri in sources:
        with FrameProgress(f"Following {uri}", options.frames) as bar:
            for followed in over_time(uri, options, settings):
                bar.update(followed[1].frame + 1)
        frame, step, found[uri] = followed
        _print_courses(uri, found[uri], budget)
        if files.picture is not None and len(found) == 1:
            write_picture(files.picture, _memory_picture(frame, step, page.width), page.dpi)
            say(f"wrote {files.picture}")
    document = {
        "over_time": {uri: {way: asdict(course) for way, course in ways.items()} for uri, ways in found.items()},
        "budget": budget,
    }
    write_if_asked(files.json, lambda path: write_output(path, json.dumps(document, indent=1) + "\n"))


def _memory_picture(frame: DepthFrame, step: TemporalStep, width_in: float) -> Figure:
    """The truth, the sensor's whole frame and the memory's model, and how wrong both are."""
    exact = replace(frame, depth_mm=truth_of(frame))
    remembered = replace(frame, depth_mm=np.clip(np.rint(step.model_mm), 0, 65535).astype(np.uint16))
    first = [depth_panel(exact, "Truth"), depth_panel(frame, "One whole frame"), depth_panel(remembered, "Memory")]
    seen = replace(exact, depth_mm=np.where(frame.depth_mm > 0, exact.depth_mm, 0).astype(np.uint16))
    errors = [error_panel(seen, shown.depth_mm.astype(np.float32), "Its error") for shown in (frame, remembered)]
    share = f"{100 * len(step.uv) / frame.depth_mm.size:.3g} % of the pixels a frame"
    title = f"Frame {step.frame}: memory from {share}"
    return sheet([(title, first), ("", [None, *errors])], width_in, legend=False)


def _print_courses(uri: str, ways: dict[str, Course], budget: float) -> None:
    count = len(ways["memory"].rmse_mm)
    at = sorted({0, count // 2, count - 1})
    rows = []
    for way, course in ways.items():
        figures = [(course.rmse_mm[i], course.mae_mm[i]) for i in at]
        figures.append((float(np.nanmean(course.rmse_mm)), float(np.nanmean(course.mae_mm))))
        rows.append((way.replace("_", " "), *(f"{rmse:.1f} / {mae:.1f}" for rmse, mae in figures)))
    heads = ("RMSE / MAE, mm", *(f"frame {index}" for index in at), "mean")
    title = f"{uri}: {count} frames, {100 * budget:g} % of the pixels a frame with memory"
    print_table(rows, heads, bold="memory", title=title)
