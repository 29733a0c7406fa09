"""What an evaluation came to: the table, the files, and the picture that shows it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from selective_depth.app.console.command import colours
from selective_depth.app.console.output import (
    check_output,
    check_picture,
    write_output,
    write_picture,
)
from selective_depth.app.console.progress import FrameProgress
from selective_depth.app.evaluation.evaluate import (
    Outcome,
    Results,
    frames_of,
    outcomes,
    summarise,
)
from selective_depth.app.evaluation.strategies import STRATEGIES, Case
from selective_depth.app.pictures.stills import (
    ERROR_LIMIT_MM,
    GAP,
    PAPER,
    ROUND_COLOURS,
    Image,
    Panel,
    _backdrop,
    _coloured,
    _hatched,
    finished,
    write_text,
)
from selective_depth.app.pipeline import say
from selective_depth.drivers.frame import DepthFrame
from selective_depth.selectors.acquire import acquire, shots_of
from selective_depth.selectors.quality import errors_of
from selective_depth.selectors.reconstruct import reconstruct

SHOWN = ("uniform", "improvement", "gradient", "step", "loop", "oracle")
TITLES = {
    "uniform": "Even lattice",
    "improvement": "Published, one shot",
    "gradient": "Gradient, one shot",
    "step": "Step score, one shot",
    "loop": "Step score, closed loop",
    "oracle": "Oracle",
}


def run_evaluation(
    sources: Sequence[str],
    *,
    every: int,
    frames: int | None,
    budgets: Sequence[float],
    rounds: int,
    seeds_shape: tuple[int, int],
    random_seeds: int,
    jobs: int | None,
    json_file: Path | None,
    picture: Path | None,
    page: Path | None = None,
) -> Results:
    """Evaluate, show the table and write what was asked for.

    Raises
    ------
    UsageError, OutputError
        If a file cannot be written; found out before the work is done where possible.
    """
    check_picture(picture)
    check_output(json_file, page)
    with FrameProgress("Evaluating", None) as bar:
        found = outcomes(
            sources,
            every=every,
            frames=frames,
            budgets=budgets,
            rounds=rounds,
            seeds_shape=seeds_shape,
            random_seeds=random_seeds,
            jobs=jobs,
            progress=lambda done, total: bar.update(done, f"of {total}"),
        )
    results = summarise(found)
    count = len({outcome.frame for outcome in found})
    print_results(results, count, rounds)
    if json_file is not None:
        document = {**results, "frames": [asdict(outcome) for outcome in found]}
        write_output(json_file, json.dumps(document, indent=1) + "\n")
    if page is not None:
        write_output(page, to_markdown(found))
    if picture is not None:
        frame = next(frames_of(sources, every, 1))
        sheet = comparison(frame, budgets[0], rounds=rounds, seeds_shape=seeds_shape)
        write_picture(picture, sheet)
    for path in (json_file, page, picture):
        if path is not None:
            say(f"wrote {path}")
    return results


def print_results(results: Results, frames: int, rounds: int) -> None:
    """Show the figures as one table per budget."""
    console = Console(highlight=False, no_color=not colours())
    for budget, table in results.items():
        shown = Table(
            title=f"+{float(budget):.0%} of the pixels · {frames} frames"
            f" · closed loops of {rounds} rounds",
            title_justify="left",
            caption="ratio of the RMSE (mm) to uniform's, geometric mean and worst; share of the"
            " way from uniform to the oracle, mean and least; wrong: off by > 20 mm and > 2 %",
            caption_justify="left",
            padding=(0, 0, 0, 1),
            box=None,
        )
        shown.add_column("", no_wrap=True)
        for head in ("ratio", "worst", "share", "least", "RMSE", "MAE", "wrong", "missed"):
            shown.add_column(head, justify="right")
        for name, row in table.items():
            shown.add_row(
                name,
                f"{row['geo']:.3f}",
                f"{row['worst']:.3f}",
                f"{row['share']:.1%}",
                f"{row['share_min']:.1%}",
                f"{row['rmse_mm']:.1f}",
                f"{row['mae_mm']:.2f}",
                f"{row['wrong']:.2%}",
                f"{row['missed']:.0%}",
                style="bold" if name in ("step", "loop") else "",
            )
        console.print(shown)


def to_markdown(found: Sequence[Outcome]) -> str:
    """The figures as a Markdown table, for the documentation."""
    lines = []
    for budget, table in summarise(found).items():
        lines += [
            f"| +{float(budget):.0%} | geo | worst | oracle share | least | RMSE mm | MAE mm |",
            "|---|---|---|---|---|---|---|",
        ]
        for name, row in table.items():
            lines.append(
                f"| {STRATEGIES[name].about} (`{name}`) | {row['geo']:.3f} | {row['worst']:.3f} |"
                f" {row['share']:.1%} | {row['share_min']:.1%} | {row['rmse_mm']:.1f} |"
                f" {row['mae_mm']:.2f} |"
            )
        lines.append("")
    return "\n".join(lines)


def _shots_image(frame: DepthFrame, name: str, case: Case) -> tuple[Image, Image, float, float]:
    """Where a strategy shot, its error map, its RMSE and MAE."""
    image = _backdrop(frame)
    if name == "loop":
        acquisition = acquire(frame.measure, case.seeds, rounds=case.rounds, shots=case.shots)
        uv, order = acquisition.uv, acquisition.round.astype(int)
    else:
        uv = STRATEGIES[name].pixels(case)
        seeds = 0 if name == "uniform" else len(case.seed_uv)
        order = np.where(np.arange(len(uv)) < seeds, 0, 1)
    taken = order > 0
    steps = np.linspace(0, len(ROUND_COLOURS) - 1, max(int(order.max(initial=1)), 1)).astype(int)
    image[uv[taken, 1], uv[taken, 0]] = ROUND_COLOURS[steps[order[taken] - 1]]
    model_mm = reconstruct(uv, frame.measure(uv), frame.shape)
    rmse_mm, mae_mm, _ = errors_of(model_mm, frame.depth_mm)
    error_mm = np.abs(model_mm - frame.depth_mm.astype(np.float32))
    # Some errors are a metre, most a millimetre: brightness follows the root.
    shade = _coloured(np.sqrt(error_mm / ERROR_LIMIT_MM), cv2.COLORMAP_INFERNO)
    return image, _hatched(shade, frame.depth_mm == 0), rmse_mm, mae_mm


def comparison(
    frame: DepthFrame,
    budget: float,
    *,
    rounds: int = 8,
    seeds_shape: tuple[int, int] = (128, 128),
    strategies: Sequence[str] = SHOWN,
    width: int = 2000,
) -> Image:
    """Where each strategy shot, above the error of its model; blue-green-red picture."""
    case = Case(frame, seeds_shape, shots_of(float(budget), frame.shape), rounds, 0)
    each = (width - GAP * (len(strategies) + 1)) // len(strategies)
    columns = []
    for name in strategies:
        shots, error, rmse_mm, mae_mm = _shots_image(frame, name, case)
        top = finished(Panel(name, TITLES.get(name, name), shots), each)
        bottom = finished(
            Panel(
                "error",
                f"RMSE {rmse_mm:.1f} mm",
                error,
                cv2.COLORMAP_INFERNO,
                ("0", f"{ERROR_LIMIT_MM:.0f} mm"),
                f"MAE {mae_mm:.1f} mm",
            ),
            each,
        )
        columns.append(np.vstack((top, bottom)))
    sheet = np.full((columns[0].shape[0] + 56, width, 3), PAPER, dtype=np.uint8)
    total = (len(case.seed_uv) + case.shots) / frame.depth_mm.size
    write_text(
        sheet,
        f"The same {total:.1%} of the pixels: where they were measured, and how wrong the model is",
        GAP,
        36,
        25,
        weight=700,
    )
    for place, column in enumerate(columns):
        left = GAP + place * (each + GAP)
        sheet[56:, left : left + each] = column
    return sheet
