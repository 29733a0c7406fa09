"""Stills of one frame of each source: the contact sheet and every panel alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from selective_depth.app.errors import UsageError
from selective_depth.app.settings import Settings
from selective_depth.app.stills import StillRow, contact_sheet, panels, save_png
from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.source import OutputError, SourceEndedError, open_source
from selective_depth.selectors.acquire import acquire
from selective_depth.selectors.improvement import ImprovementSelector
from selective_depth.selectors.neural_gas import NeuralGasSelector
from selective_depth.selectors.seeds import SeedGrid


def short_name(uri: str) -> str:
    """Name of a source for titles and file names: the last part of its path, or its scene."""
    plain = uri.partition("?")[0].rstrip("/\\")
    return Path(plain.replace(":", "/")).stem or "depth"


def nth_frame(uri: str, number: int) -> DepthFrame:
    """Return frame `number` of a source, counted from 0.

    Raises
    ------
    UsageError
        If the source has fewer frames.
    """
    with open_source(uri) as source:
        for reached in range(number + 1):
            try:
                frame = source.read()
            except SourceEndedError:
                raise UsageError(
                    f"--frame is {number}, but '{uri}' has {reached} frames; the last is"
                    f" --frame {reached - 1}."
                ) from None
    return frame


def still_row(frame: DepthFrame, title: str, settings: Settings) -> StillRow:
    """Run both selectors, and the acquisition where there is a budget, on one frame."""
    seeds = SeedGrid.from_frame(frame, (settings.seeds.rows, settings.seeds.columns))
    gas, spend = settings.gas, settings.acquire
    selector = NeuralGasSelector(
        nodes=gas.nodes,
        epochs=gas.epochs,
        algorithm=gas.algorithm,
        seed=gas.seed,
        edge_metric=gas.edge_metric,
        factor=gas.factor,
    )
    acquisition = None
    if spend.budget:
        acquisition = acquire(frame.measure, seeds, spend.budget, rounds=spend.rounds)
    return StillRow(
        title=title,
        frame=frame,
        regions=selector.select(seeds),
        improvement=ImprovementSelector(share=settings.improvement.share).select(seeds),
        acquisition=acquisition,
    )


def snapshot(sources: Sequence[str], number: int, folder: Path, settings: Settings) -> list[Path]:
    """Write a contact sheet with a row per source, and each panel alone.

    Parameters
    ----------
    sources : sequence of str
        As for `open_source`, at least one.
    number : int
        Which frame of each, from 0.
    folder : Path
        Where the pictures go; it is made if need be.
    settings : Settings
        Options of the seeds, the selectors and the acquisition.

    Returns
    -------
    list of Path
        What was written, the sheet first.

    Raises
    ------
    OutputError
        If the folder or a picture cannot be written.
    """
    rows = [still_row(nth_frame(uri, number), short_name(uri), settings) for uri in sources]
    written = [folder / "sheet.png"]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        save_png(written[0], contact_sheet(rows))
        for row in rows:
            for panel in panels(row):
                path = folder / f"{row.title}-{panel.name}.png"
                save_png(path, panel.image)
                written.append(path)
    except OSError as error:
        raise OutputError(
            f"'{folder}' cannot be written: {error.strerror or error}. Name another with --out."
        ) from error
    return written
