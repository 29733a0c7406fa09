"""The commands that compare and time; the others are in `cli`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from selective_depth.app.console.command import PROGRAM, command
from selective_depth.app.settings import (
    ComparisonOptions,
    EvaluationFiles,
    Flag,
    Limit,
    PictureOptions,
    SelectorOptions,
    Settings,
    Source,
    SourceOrSample,
    optional,
)

Page = Annotated[PictureOptions, arg(name="")]
Files = Annotated[EvaluationFiles, arg(name="")]
Compared = Annotated[ComparisonOptions, arg(name="")]
Selectors = Annotated[SelectorOptions, arg(name="")]
PAGE, FILES, COMPARED, SELECTORS = PictureOptions(), EvaluationFiles(), ComparisonOptions(), SelectorOptions()


@command(
    "Compare",
    (f"{PROGRAM} nodes frames/", "time, error and regions, on frame 0"),
    (f"{PROGRAM} nodes frames/ --every 60 --out nodes.md", "mean over every 60th frame"),
)
def nodes(source: Source, /, every: Limit = None, out: Annotated[Path | None, optional("FILE.md")] = None) -> int:
    """Tabulate neural gas over numbers of nodes and of epochs; takes minutes.

    Parameters
    ----------
    source : str
        Anything that 'replay' takes.
    every : int
        Take every so many frames; by default the first alone.
    out : Path
        Write the table as Markdown as well.
    """
    from selective_depth.app.commands.figures import tabulate_nodes

    return tabulate_nodes(source, every=every, out=out)


@command(
    "Compare",
    (f"{PROGRAM} bench", "every stage on the bundled recording"),
    (f"{PROGRAM} bench frames/ --json out.json", "on your own, to a file as well"),
)
def bench(
    source: SourceOrSample = None,
    /,
    frames: Limit = None,
    json: Annotated[Path | None, optional("FILE")] = None,
    page: Annotated[Path | None, optional("FILE.md")] = None,
    no_peers: Flag = False,
) -> None:
    """Time every stage of the loop, and the same work in other libraries, on this machine.

    Parameters
    ----------
    source : str
        As for replay; by default the bundled recording.
    frames : int
        Time at most this many frames.
    json : Path
        Write the figures to a file as well.
    page : Path
        Write the benchmark page of the documentation.
    no_peers : bool
        Leave out the peers that are installed (pip install 'selective-depth[bench]').
    """
    from selective_depth.app.benchmark.report import run_bench
    from selective_depth.app.commands.samples import bundled_recording

    uri = bundled_recording() if source is None else source
    run_bench(uri, frames, json=json, page=page, peers=not no_peers)


@command(
    "Compare",
    (f"{PROGRAM} evaluate frames/", "every strategy on every 20th frame"),
    (
        f"{PROGRAM} evaluate frames/ --budget 0.05 0.10 --json out.json --picture out.png",
        "with a file of all figures and a picture",
    ),
    (f"{PROGRAM} evaluate frames/ --strategies all", "every selector, in one shot and in the loop"),
    (f"{PROGRAM} evaluate frames/ --seeds.rows 64 --seeds.columns 64", "a coarser seed lattice"),
    (f"{PROGRAM} evaluate 'virtual:workstation?noise=off'", "where the truth is exact"),
)
def evaluate(
    sources: Annotated[tuple[str, ...], optional("SOURCE...")],
    /,
    comparison: Compared = COMPARED,
    selectors: Selectors = SELECTORS,
    files: Files = FILES,
    page: Page = PAGE,
) -> None:
    """Compare ways of choosing measurements: how good a model does a budget buy?

    Parameters
    ----------
    sources : tuple of str
        Recordings, folders or scenes, as for replay.
    comparison
        What is compared on what.
    selectors
        The seed lattice, and options of the two published selectors.
    files
        What is written.
    page
        The picture's page.
    """
    from selective_depth.app.evaluation.report import run_evaluation

    run_evaluation(sources, comparison, Settings(**vars(selectors)), files=files, page=page)
