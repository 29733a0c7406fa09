"""What an evaluation came to: the table, the files, and the picture that shows it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from selective_depth.app.console.columns import print_table
from selective_depth.app.console.output import check_output, check_picture, write_output
from selective_depth.app.console.progress import FrameProgress
from selective_depth.app.evaluation.evaluate import Outcome, Results, frames_of, outcomes, summarise
from selective_depth.app.evaluation.files import TABLES, curves, to_json, write_table
from selective_depth.app.evaluation.over_time import run_over_time
from selective_depth.app.evaluation.strategies import STRATEGIES, Case, strategy_of
from selective_depth.app.pictures import Panel, sheet, write_picture
from selective_depth.app.pictures.panels import error_panel, shots_panel
from selective_depth.app.pictures.sheets import WIDTH_IN
from selective_depth.app.pipeline import say
from selective_depth.app.settings import ComparisonOptions, EvaluationFiles, PictureOptions, Settings
from selective_depth.selectors.acquire import acquire, shots_of
from selective_depth.selectors.reconstruct import reconstruct

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
        If there is no such strategy or a file cannot be written; found out before the work is done
        where possible.
    """
    for picture in (files.picture, files.curves):
        check_picture(picture)
    check_output(files.json, files.page)
    check_picture(files.table, TABLES, "table")
    if options.over_time:
        return run_over_time(sources, options, settings, files)
    with FrameProgress("Evaluating", None) as bar:
        found = outcomes(sources, options, settings, lambda done, total: bar.update(done, f"of {total}"))
    print_results(summarise(found), len({outcome.frame for outcome in found}), options.rounds)

    def first_frame() -> Figure:
        frame = next(frames_of(sources, options.every, 1))
        return comparison(Case(frame, settings, shots_of(options.budget[0], frame.shape), options.rounds), page.width)

    outputs: list[tuple[Path | None, Callable[[Path], None]]] = [
        (files.json, lambda path: write_output(path, to_json(found, options, settings))),
        (files.table, lambda path: write_table(path, found)),
        (files.page, lambda path: write_output(path, to_markdown(found))),
        (files.picture, lambda path: write_picture(path, first_frame(), page.dpi)),
        (files.curves, lambda path: write_picture(path, curves(found, page.width), page.dpi)),
    ]
    for path, write in outputs:
        if path is not None:
            write(path)
            say(f"wrote {path}")


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
