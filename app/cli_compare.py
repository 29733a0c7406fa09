"""The commands that make the paper's figures and table, compare and time; the others are in `cli`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from selective_depth.app.console.command import command
from selective_depth.app.settings import (
    ComparisonOptions,
    EvaluationFiles,
    Flag,
    Limit,
    Natural,
    PanelOptions,
    PictureOptions,
    SelectorOptions,
    Settings,
    Source,
    SourceOrSample,
    optional,
)

Selectors = Annotated[SelectorOptions, arg(name="")]
PAGE, PANELS, SELECTORS = PictureOptions(), PanelOptions(), SelectorOptions()
FILES, COMPARED = EvaluationFiles(), ComparisonOptions()
SCENES = ("virtual:workstation", "virtual:ball", "virtual:firehose")


@command("Pictures")
def figure(
    number: Annotated[Literal[1, 2, 4, 5], arg(metavar="1|2|4|5")],
    sources: Annotated[tuple[str, ...], optional("SOURCE...")] = (),
    /,
    out: Annotated[Path | None, optional("FILE")] = None,
    save: Annotated[Path | None, optional("FILE.rrd")] = None,
    frame: Natural = 0,
    selectors: Selectors = SELECTORS,
    page: Annotated[PanelOptions, arg(name="")] = PANELS,
) -> int:
    """Make a figure of the paper, on the virtual scenes or on any source.

    1: neural gas by training length. 2: by density of the first scan. 4: the scenes. 5: what
    both selectors find in them.

    Parameters
    ----------
    number : int
        Its number in the paper.
    sources : tuple of str
        As for replay; by default the three virtual scenes, of which 1 and 2 take the first.
    out : Path
        The picture to make, .png, .webp, .pdf or .svg, or a folder for it and every panel; by
        default figure-N.png.
    save : Path
        Write the trainings of figure 1 to a Rerun recording as well, by epoch.
    frame : int
        Which frame of each source, from 0.
    selectors
        Options of the selectors.
    page
        The page.

    Examples
    --------
    selective-depth figure 5
        both selectors on the three scenes, to figure-5.png
    selective-depth figure 1 bunny.ply --out fig1.pdf
        neural gas by epochs, of your own object
    """
    from selective_depth.app.commands.figures import draw_figure

    return draw_figure(number, sources or SCENES, out, frame, Settings(**vars(selectors)), page, save)


@command("Pictures")
def table(
    number: Annotated[Literal[1], arg(metavar="1")] = 1,
    sources: Annotated[tuple[str, ...], optional("SOURCE...")] = (),
    /,
    frame: Natural = 0,
) -> int:
    """Time neural gas and the improvement map, with the paper's options; takes half a minute.

    Parameters
    ----------
    number : int
        Its number in the paper.
    sources : tuple of str
        As for replay; by default the three virtual scenes.
    frame : int
        Which frame of each source, from 0.

    Examples
    --------
    selective-depth table 1
        computing times on the three scenes, as in the paper
    """
    from selective_depth.app.commands.figures import print_times

    return print_times(sources or SCENES, frame)


@command("Compare")
def nodes(source: Source, /, every: Limit = None, out: Annotated[Path | None, optional("FILE.md")] = None) -> int:
    """Tabulate neural gas over numbers of nodes and of epochs; takes minutes.

    Parameters
    ----------
    source : str
        Anything that 'replay' takes.
    every : int
        Take every N-th frame; by default the first alone.
    out : Path
        Write the table as Markdown as well.

    Examples
    --------
    selective-depth nodes frames/
        time, error and regions, on frame 0
    selective-depth nodes frames/ --every 60 --out nodes.md
        mean over every 60th frame
    """
    from selective_depth.app.commands.figures import tabulate_nodes

    return tabulate_nodes(source, every=every, out=out)


@command("Compare")
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

    Examples
    --------
    selective-depth bench
        every stage on the bundled recording
    selective-depth bench frames/ --json out.json
        on your own, to a file as well
    """
    from selective_depth.app.benchmark.report import run_bench
    from selective_depth.app.commands.samples import bundled_recording

    uri = bundled_recording() if source is None else source
    run_bench(uri, frames, json=json, page=page, peers=not no_peers)


@command("Compare")
def evaluate(
    sources: Annotated[tuple[str, ...], optional("SOURCE...")],
    /,
    comparison: Annotated[ComparisonOptions, arg(name="")] = COMPARED,
    selectors: Selectors = SELECTORS,
    files: Annotated[EvaluationFiles, arg(name="")] = FILES,
    page: Annotated[PictureOptions, arg(name="")] = PAGE,
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

    Examples
    --------
    selective-depth evaluate frames/
        every strategy on every 20th frame
    selective-depth evaluate frames/ --budget 0.05 0.10 --json out.json --picture out.png
        with a file of all figures and a picture
    selective-depth evaluate frames/ --strategies all
        every selector, in one shot and in the loop
    selective-depth evaluate frames/ --seeds.rows 64 --seeds.columns 64
        a coarser seed lattice
    selective-depth evaluate 'virtual:workstation?noise=off'
        where the truth is exact
    """
    from selective_depth.app.evaluation.report import run_evaluation

    run_evaluation(sources, comparison, Settings(**vars(selectors)), files=files, page=page)
