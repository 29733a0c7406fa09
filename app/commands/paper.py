"""The figures of the paper and its table, each under its own number."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from selective_depth.app.commands import figures
from selective_depth.app.commands.snapshot import draw_snapshot, is_folder, nth_frame, short_name, tell_of, write_all
from selective_depth.app.console.columns import print_table
from selective_depth.app.console.exit_codes import OK
from selective_depth.app.console.output import check_output
from selective_depth.app.console.progress import waiting
from selective_depth.app.pictures.panels import depth_panel, shaded_panel
from selective_depth.app.pipeline import say
from selective_depth.app.settings import PanelOptions, Settings
from selective_depth.selectors.improvement import ImprovementSelector
from selective_depth.selectors.neural_gas import NeuralGasSelector
from selective_depth.selectors.seeds import SeedGrid

PAPERS_SECONDS = {"workstation": (153.0, 1.39), "ball": (153.9, 1.41), "firehose": (150.0, 1.41)}
"""Table 1: neural gas (Matlab) and improvement map (C++, i7-2630) on its scenes of these names."""


def draw_figure(
    number: int,
    sources: Sequence[str],
    out: Path | None,
    frame: int,
    settings: Settings,
    page: PanelOptions,
    save: Path | None = None,
) -> int:
    """Make a figure of the paper of some sources; returns the exit code.

    Raises
    ------
    OutputError
        If a file cannot be written.
    UsageError
        If it is of a format that cannot be made, or a source has no such frame.
    """
    path = out or Path(f"figure-{number}.png")
    is_folder(path)  # refused before the work is done
    check_output(save)
    if number == 5:
        return draw_snapshot(sources, frame, path, settings, page)
    gas, trained, stems = settings.gas, [], []
    frames = [nth_frame(uri, frame) for uri in (sources if number == 4 else sources[:1])]
    if number == 1:
        seeds = figures.object_seeds(frames[0], figures.FIRST_POINTS)
        with waiting(f"training {len(figures.EPOCHS)} times"):
            trained = list(figures.epoch_selections(seeds, figures.EPOCHS, figures.FIRST_NODES, gas.seed))
        rows = figures.epochs_figure(frames[0], seeds, trained)
    elif number == 2:
        with waiting(f"training {len(figures.DENSITIES)} times"):
            rows = figures.densities_figure(frames[0], figures.DENSITIES, gas.epochs, gas.seed)
    else:
        stems = [f"{short_name(uri)}-" for uri in sources]
        rows = [
            (f"{stem[:-1]}, frame {frame}", (shaded_panel(shown), depth_panel(shown)))
            for stem, shown in zip(stems, frames, strict=True)
        ]
    tell_of(write_all(path, f"figure-{number}", rows, stems or [""] * len(rows), page, legend=False))
    if save is not None and trained:
        from selective_depth.app.viewer import save_trainings

        save_trainings(save, frames[0], ((length, chosen["3d"]) for length, chosen in trained))
        say(f"wrote {save}; open it with 'rerun {save}'")
    return OK


def print_times(sources: Sequence[str], frame: int) -> int:
    """Print what both methods take on each source, the paper's times beside them."""
    rows = []
    improvement = ImprovementSelector(exponent=1.9999, by_sums=True)
    methods = (NeuralGasSelector(algorithm="exact"), NeuralGasSelector(), improvement)
    warm = SeedGrid.from_frame(nth_frame(sources[0], frame))
    for method in (NeuralGasSelector(10, 1, "exact"), *methods[1:]):
        method.select(warm)  # compiled before anything is timed
    for uri in sources:
        seeds = SeedGrid.from_frame(nth_frame(uri, frame))
        seconds = []
        for method in methods:
            start = time.perf_counter()
            method.select(seeds)
            seconds.append(time.perf_counter() - start)
        papers = PAPERS_SECONDS.get(short_name(uri), ())
        rows.append((short_name(uri), *(f"{s:.3g}" for s in (*seconds, *papers))))
    heads = ("", "NG exact", "NG fast", "ImpMap", "paper: NG", "ImpMap")
    print_table(rows, heads, title="Table 1: seconds per frame")
    return OK
