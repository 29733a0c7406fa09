"""The figures of the paper and its table, each under its own number, and the table behind the defaults."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from timeit import timeit
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from selective_depth.app.commands.snapshot import draw_snapshot, is_folder, nth_frame, short_name, stems_of, write_all
from selective_depth.app.console.columns import print_table
from selective_depth.app.console.errors import UsageError
from selective_depth.app.console.exit_codes import OK
from selective_depth.app.console.output import check_output, write_output
from selective_depth.app.console.progress import waiting
from selective_depth.app.pictures import Panel, Row, panels
from selective_depth.app.pipeline import open_and_tell, say
from selective_depth.app.settings import PanelOptions, Settings
from selective_depth.drivers.frame import DepthFrame
from selective_depth.selectors.improvement import ImprovementSelector
from selective_depth.selectors.neural_gas import EdgeMetric, NeuralGasSelector, RegionSelection, delaunay_regions
from selective_depth.selectors.reconstruct import reconstruct
from selective_depth.selectors.seeds import SeedGrid

EPOCHS = (5, 10, 25, 40, 60, 100)
"""Training lengths of Fig. 1."""
FIRST_POINTS, FIRST_NODES = 4200, 45 * 50
"""Size of the first scan and of the map of Fig. 1."""
DENSITIES = (32, 40, 64, 75)
"""Sides of the first scans of Fig. 2."""
TABLE_NODES = (700, 1400, 2800, 5600)
TABLE_EPOCHS = (5, 10, 20, 50, 100)
PAPERS_SECONDS = {"workstation": (153.0, 1.39), "ball": (153.9, 1.41), "firehose": (150.0, 1.41)}
"""Table 1: neural gas (Matlab) and improvement map (C++, i7-2630) on its scenes of these names."""

_METRICS: dict[EdgeMetric, str] = {"3d": "edges short in space", "image": "edges short in the image"}


def object_seeds(frame: DepthFrame, points: int) -> SeedGrid:
    """Take a lattice of which about `points` seeds hit the object.

    The paper's first scans are of the object alone: their 64x64 are 4,200 points on the bunny.
    A lattice over the frame has to be finer, by the share of the frame that the object fills.

    Parameters
    ----------
    frame : DepthFrame
        The object before nothing.
    points : int
        How many seeds shall hit it.
    """
    height, width = frame.shape
    spacing = np.sqrt(np.count_nonzero(frame.depth_mm) / points)
    rows, columns = (int(np.clip(round(side / max(spacing, 1)), 1, side)) for side in (height, width))
    return SeedGrid.from_frame(frame, (rows, columns))


def epoch_selections(
    seeds: SeedGrid, epochs: Sequence[int] = EPOCHS, nodes: int = FIRST_NODES, seed: int = 0
) -> Iterator[tuple[int, dict[EdgeMetric, RegionSelection]]]:
    """Train by the published steps for several lengths; yield the regions of each as it is done.

    Each length is a training of its own, as in Fig. 1: the annealing of eq. (4) ends with it.

    Parameters
    ----------
    seeds : SeedGrid
        The first scan.
    epochs : sequence of int, default 5, 10, 25, 40, 60, 100
        Training lengths.
    nodes : int, default 2250
        Number of nodes.
    seed : int, default 0
        Seed of the random draws.

    Yields
    ------
    int
        The training length.
    dict
        The regions by each edge metric, from the same nodes.
    """
    for length in epochs:
        yield length, by_metric(NeuralGasSelector(nodes, length, "exact", seed).select(seeds))


def by_metric(chosen: RegionSelection) -> dict[EdgeMetric, RegionSelection]:
    """Regions of one set of nodes by both edge metrics."""
    error_mm = chosen.quantisation_error_mm
    return {
        metric: delaunay_regions(
            chosen.nodes_mm, chosen.nodes_uv, chosen.mask.shape, edge_metric=metric, quantisation_error_mm=error_mm
        )
        for metric in _METRICS
    }


def epochs_figure(
    frame: DepthFrame, seeds: SeedGrid, trained: Sequence[tuple[int, dict[EdgeMetric, RegionSelection]]]
) -> list[Row]:
    """Fig. 1 of the paper: nodes and areas of interest after trainings of several lengths.

    Parameters
    ----------
    frame : DepthFrame
        The object.
    seeds : SeedGrid
        Its first scan.
    trained : sequence
        What `epoch_selections` yielded.

    Returns
    -------
    list of Row
        For `sheet`.
    """
    columns = [
        (f"{length} epochs", f"error {chosen['3d'].quantisation_error_mm:.1f} mm", chosen) for length, chosen in trained
    ]
    nodes = len(trained[0][1]["3d"].nodes_mm)
    return _figure(frame, f"{len(seeds.uv):,} points, {nodes:,} nodes", columns)


def densities_figure(frame: DepthFrame, sides: Sequence[int] = DENSITIES, epochs: int = 50, seed: int = 0) -> list[Row]:
    """Fig. 2 of the paper: areas of interest from first scans of several densities.

    Nodes are as many per point as in Fig. 1.

    Parameters
    ----------
    frame : DepthFrame
        The object.
    sides : sequence of int, default 32, 40, 64, 75
        About side * side seeds hit the object.
    epochs : int, default 50
        Training length, in the middle of the paper's best range.
    seed : int, default 0
        Seed of the random draws.

    Returns
    -------
    list of Row
        For `sheet`.
    """
    columns = []
    for side in sides:
        seeds = object_seeds(frame, side * side)
        nodes = max(1, round(len(seeds.uv) * FIRST_NODES / FIRST_POINTS))
        chosen = by_metric(NeuralGasSelector(nodes, epochs, "exact", seed).select(seeds))
        columns.append((f"{side} × {side}", f"{len(seeds.uv):,} points, {nodes:,} nodes", chosen))
    return _figure(frame, f"{epochs} epochs", columns)


def _figure(
    frame: DepthFrame, note: str, columns: Sequence[tuple[str, str, dict[EdgeMetric, RegionSelection]]]
) -> list[Row]:
    """The object, then a column per training: nodes above, kept triangles by each metric below."""
    ground = panels.backdrop(frame)
    nodes: list[Panel | None] = [panels.shaded_panel(frame, "Object", note)]
    kept: dict[EdgeMetric, list[Panel | None]] = {metric: [None] for metric in _METRICS}
    for title, words, by_metrics in columns:
        stem = re.sub(r"\W+", "-", title)
        drawn = partial(panels.draw_nodes, regions=by_metrics["3d"])
        nodes.append(Panel(f"nodes-{stem}", title, ground, note=words, overlay=drawn))
        for metric, regions in by_metrics.items():
            image, share = panels.tinted(ground.copy(), regions.mask), f"{regions.mask.mean():.0%} of the frame"
            drawn = partial(panels.draw_kept_triangles, regions=regions)
            kept[metric].append(Panel(f"kept-{metric}-{stem}", title, image, note=share, overlay=drawn))
    return [
        ("Nodes of the neural gas", nodes),
        *((f"Triangles kept: {_METRICS[metric]}", row) for metric, row in kept.items()),
    ]


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
    if save is not None and number != 1:
        raise UsageError(f"--save is for the trainings of figure 1; figure {number} has none. Leave it out.")
    if number == 5:
        return draw_snapshot(sources, frame, path, settings, page)
    gas, trained, stems = settings.gas, [], []
    frames = [nth_frame(uri, frame) for uri in (sources if number == 4 else sources[:1])]
    if number == 1:
        seeds = object_seeds(frames[0], FIRST_POINTS)
        with waiting(f"training {len(EPOCHS)} times"):
            trained = list(epoch_selections(seeds, EPOCHS, FIRST_NODES, gas.seed))
        rows = epochs_figure(frames[0], seeds, trained)
    elif number == 2:
        with waiting(f"training {len(DENSITIES)} times"):
            rows = densities_figure(frames[0], DENSITIES, gas.epochs, gas.seed)
    else:
        stems = stems_of(sources)
        rows = [
            (f"{stem[:-1]}, frame {frame}", (panels.shaded_panel(shown), panels.depth_panel(shown)))
            for stem, shown in zip(stems, frames, strict=True)
        ]
    write_all(path, f"figure-{number}", rows, stems or [""] * len(rows), page, legend=False)
    if save is not None:
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
        seconds = [timeit(partial(method.select, seeds), number=1) for method in methods]
        papers = PAPERS_SECONDS.get(short_name(uri), ())
        rows.append((short_name(uri), *(f"{s:.3g}" for s in (*seconds, *papers))))
    heads = ("", "NG exact", "NG fast", "ImpMap", "paper: NG", "ImpMap")
    print_table(rows, heads, title="Table 1: seconds per frame")
    return OK


class TableRow(NamedTuple):
    """One training of the table; shares are of the frame's pixels and squared error, 0..1.

    Time is that of the processor, all threads together: it does not depend on what else runs.
    """

    nodes: int
    training: str
    seconds: float
    quantisation_error_mm: float
    mask_share: float
    mask_error_share: float
    complement_share: float
    complement_error_share: float


def node_table(
    frames: Sequence[DepthFrame],
    nodes: Sequence[int] = TABLE_NODES,
    epochs: Sequence[int] = TABLE_EPOCHS,
    seed: int = 0,
) -> Iterator[TableRow]:
    """What nodes and epochs cost, and what the regions read from them are worth.

    Parameters
    ----------
    frames : sequence of DepthFrame
        Frames to average over.
    nodes, epochs : sequence of int
        What to try: exact training of each, and one fast training per number of nodes.
    seed : int, default 0
        Seed of the random draws.

    Yields
    ------
    TableRow
        As soon as it is known. The interpolation error is that of the protocol's reconstruction
        from the 128x128 seeds alone, at the pixels that have depth.
    """
    grids = [SeedGrid.from_frame(frame) for frame in frames]
    # Compiled, and the seeds' points made, before anything is timed.
    for grid in grids:
        NeuralGasSelector(10, 1, "exact").select(grid)
        NeuralGasSelector(10).select(grid)
    squares = [_squared_error(frame, grid) for frame, grid in zip(frames, grids, strict=True)]
    for count in nodes:
        for length in (*epochs, None):
            selector = NeuralGasSelector(count, length or 1, "exact" if length else "fast", seed)
            rows = []
            for grid, (square, known) in zip(grids, squares, strict=True):
                start = time.process_time()
                chosen = selector.select(grid)
                seconds = time.process_time() - start
                row = [seconds, chosen.quantisation_error_mm]
                for region in (chosen.mask, chosen.complement):
                    row.append(float(region[known].mean()) if known.any() else 0.0)
                    row.append(float(square[region].sum() / max(square.sum(), 1e-12)))
                rows.append(row)
            means = (float(value) for value in np.mean(rows, axis=0))
            yield TableRow(count, f"{length} epochs" if length else "fast", *means)


def _squared_error(frame: DepthFrame, seeds: SeedGrid) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Squared error of the frame interpolated from its seeds, and where it is known."""
    known = frame.depth_mm > 0
    model = reconstruct(seeds.uv, seeds.depth_mm[seeds.valid], frame.shape)
    return np.where(known, np.square(model - frame.depth_mm), 0).astype(np.float32), known


def table_markdown(rows: Sequence[TableRow]) -> str:
    """The table as Markdown."""
    lines = [
        "| nodes | training | CPU time, s | quantisation error, mm | mask: pixels | mask: error |"
        " complement: pixels | complement: error |",
        "|" + "---:|" * 8,
    ]
    for nodes, training, seconds, error_mm, *shares in rows:
        told = " | ".join(f"{share:.1%}" for share in shares)
        lines.append(f"| {nodes:,} | {training} | {seconds:.3g} | {error_mm:.2f} | {told} |")
    return "\n".join(lines) + "\n"


def tabulate_nodes(source: str, *, every: int | None, out: Path | None) -> int:
    """Print the table of nodes and epochs, and write it; returns the exit code.

    Raises
    ------
    OutputError
        If the file cannot be written.
    UsageError
        If the source has no frame, or never ends and `every` is given.
    """
    check_output(out)
    with open_and_tell(source) as opened:
        if every is not None and opened.frame_count is None:
            raise UsageError(
                f"'{source}' never ends; record some of it first, or leave out --every to take its first frame."
            )
        frames = list(islice(opened, 0, None if every else 1, every or 1))
    if not frames:
        raise UsageError(f"'{source}' has no frame to tabulate.")
    rows = []
    for row in node_table(frames, TABLE_NODES, TABLE_EPOCHS):
        rows.append(row)
        say(f"{row.nodes:,} nodes, {row.training}: {row.seconds:.3g} s")
    table = table_markdown(rows)
    say(table)
    if out is not None:
        write_output(out, table)
    return OK
