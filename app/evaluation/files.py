"""An evaluation as files: JSON, a table with a row per frame and strategy, curves."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa

from selective_depth.app import __version__
from selective_depth.app.console import tables
from selective_depth.app.evaluation.evaluate import Outcome, summarise
from selective_depth.app.evaluation.strategies import strategy_of
from selective_depth.app.settings import ComparisonOptions, Settings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCHEMA = 1
"""Version of the JSON document and of the table."""
TABLES = (".parquet", ".csv")


def to_json(found: Sequence[Outcome], options: ComparisonOptions, settings: Settings) -> str:
    """The whole evaluation: figures by budget and strategy, in all and per source, and its making.

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
