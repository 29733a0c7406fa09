"""The command `selective-depth`: its subcommands, its errors and its exit codes."""

from __future__ import annotations

import logging
import os
import re
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from selective_depth.app.console import interrupt
from selective_depth.app.console.command import (
    PROGRAM,
    command,
    completion,
    invoke,
    overview,
    settings_arguments,
)
from selective_depth.app.console.errors import AppError, UsageError
from selective_depth.app.settings import (
    AcquireOptions,
    Flag,
    GasOptions,
    ImprovementOptions,
    PictureOptions,
    SeedOptions,
    Settings,
    optional,
)

OK, FAILED, MISUSED, INTERRUPTED = 0, 1, 2, interrupt.EXIT_CODE
OPTION = re.compile(r"--[\w.-]*\w")
NARROWEST = 40
"""Columns; in fewer, the parser's help can take for ever to find its line breaks."""

EXAMPLES = (
    (f"{PROGRAM} replay virtual:workstation", "a made scene, in the viewer"),
    (f"{PROGRAM} replay walk.oni --budget 0.05", "a recording; measure 5 % more where it counts"),
    (f"{PROGRAM} replay frames/ --headless --save out.rrd", "a PNG folder, to a file"),
    (f"{PROGRAM} live", "the sensor that is plugged in"),
    (f"{PROGRAM} devices", "what is plugged in, or what is missing"),
)

Source = Annotated[str, arg(metavar="SOURCE")]
SourceOrSample = Annotated[str | None, optional("SOURCE")]
Options = Annotated[Settings, arg(name="")]
Page = Annotated[PictureOptions, arg(name="")]
DEFAULTS, PAGE = Settings(), PictureOptions()


@command(
    "Watch",
    (f"{PROGRAM} replay", "the recording that comes with the program"),
    (f"{PROGRAM} replay walk.oni", "every frame of a recording, in the viewer"),
    (f"{PROGRAM} replay frames/ --headless --save out.rrd", "a folder of PNG frames, to a file"),
    (f"{PROGRAM} replay virtual:firehose --budget 0.05 --rounds 4", "and measure 5 % more"),
    (f"{PROGRAM} replay walk.oni --realtime --serve", "as live, for viewers elsewhere to join"),
)
def replay(source: SourceOrSample = None, /, settings: Options = DEFAULTS) -> int:
    """Replay a recording through both selectors.

    Parameters
    ----------
    source : str
        An .oni file, a folder of PNG frames, a .ply object or virtual:SCENE; else the sample.
    settings : Settings
        All options.
    """
    from selective_depth.app.commands.run import watch
    from selective_depth.app.commands.samples import bundled_recording

    return watch(bundled_recording() if source is None else source, settings)


@command(
    "Watch",
    (f"{PROGRAM} live", "the sensor that is plugged in, in the viewer"),
    (f"{PROGRAM} live --headless --save demo.rrd --frames 300", "ten seconds, to a file"),
    (f"{PROGRAM} live --serve --serve-address 0.0.0.0:9876", "for viewers on other machines"),
)
def live(device: Annotated[str, optional("DEVICE")] = "", /, settings: Options = DEFAULTS) -> int:
    """Watch a sensor through both selectors; end with Ctrl-C.

    Parameters
    ----------
    device : str
        Its address as 'selective-depth devices' shows it; by default the only one there is.
    settings : Settings
        All options.
    """
    from selective_depth.app.commands.run import watch

    return watch(f"openni:{device}" if device else "openni", settings)


@command(
    "Sensors",
    (f"{PROGRAM} record walk.oni", "until Ctrl-C"),
    (f"{PROGRAM} record walk.oni --seconds 10", "ten seconds"),
    (f"{PROGRAM} record walk.oni 1d27/0609@1/3 --frames 300", "from one of several sensors"),
)
def record(
    out: Annotated[Path, arg(metavar="OUT.oni")],
    device: Annotated[str, optional("DEVICE")] = "",
    /,
    frames: Annotated[int | None, optional("N")] = None,
    seconds: Annotated[float | None, optional("SECONDS")] = None,
    overwrite: Flag = False,
) -> int:
    """Record a sensor to an .oni file, and make sure that every frame is in it.

    Parameters
    ----------
    out : Path
        The file to make.
    device : str
        Its address as 'selective-depth devices' shows it; by default the only one there is.
    frames : int
        Stop after this many frames; by default with Ctrl-C.
    seconds : float
        Stop after this time; by default with Ctrl-C.
    overwrite : bool
        Replace a file of that name.
    """
    from selective_depth.app.commands.sensors import record_sensor

    return record_sensor(out, device, frames=frames, seconds=seconds, overwrite=overwrite)


@command("Sensors", (f"{PROGRAM} devices", "what is plugged in, or what is missing"))
def devices() -> int:
    """List the sensors that OpenNI2 finds, or say what is missing and what to install."""
    from selective_depth.app.commands.sensors import print_devices

    return print_devices()


@command(
    "Files",
    (f"{PROGRAM} check walk.oni", "what is wrong with it and where, how much is readable"),
    (f"{PROGRAM} check walk.oni --repair whole.oni", "and save what is readable"),
)
def check(
    file: Annotated[Path, arg(metavar="FILE.oni")],
    /,
    repair: Annotated[Path | None, optional("OUT.oni")] = None,
    timeout: Annotated[float, arg(metavar="SECONDS")] = 10.0,
) -> int:
    """Say whether a recording is whole; needs no OpenNI2.

    Parameters
    ----------
    file : Path
        The recording.
    repair : Path
        Write what is readable to this new file, which OpenNI2 replays.
    timeout : float
        Look at it for so long at most.
    """
    from selective_depth.app.commands.files import check_file

    return check_file(file, repair=repair, timeout_s=timeout)


@command(
    "Files",
    (f"{PROGRAM} export walk.oni frames/", "as 16-bit PNG files; all that is readable"),
    (f"{PROGRAM} export frames/ walk.oni", "an .oni file out of PNG files"),
    (f"{PROGRAM} export virtual:ball ball.oni --frames 90", "of any source"),
)
def export(
    source: Source,
    out: Annotated[Path, arg(metavar="OUT")],
    /,
    frames: Annotated[int | None, optional("N")] = None,
) -> int:
    """Save the frames of a source as PNG files, or as an .oni file; needs no OpenNI2.

    Parameters
    ----------
    source : str
        Anything that 'replay' takes.
    out : Path
        A new folder for PNG files and their sidecar, or a new file that ends in .oni.
    frames : int
        Stop after this many frames.
    """
    from selective_depth.app.commands.files import export as save

    return save(source, out, frames)


@command(
    "Files",
    (f"{PROGRAM} model frames/ model --frame 30 --budget 0.05", "a cloud, its depth, its samples"),
)
def model(
    source: Source,
    out: Annotated[Path, arg(metavar="DIR")],
    /,
    frame: Annotated[int, arg(metavar="N")] = 0,
    budget: Annotated[float, arg(metavar="SHARE")] = 0.05,
    rounds: Annotated[int, arg(metavar="N")] = 8,
    seeds: SeedOptions = DEFAULTS.seeds,
) -> None:
    """Acquire one frame selectively and save the model: cloud.ply, depth.png, samples.npz.

    Parameters
    ----------
    source : str
        Anything that 'replay' takes.
    out : Path
        Folder for the three files.
    frame : int
        Which frame, from 0.
    budget : float
        Measurements beyond the seeds, as a share of the frame's pixels.
    rounds : int
        Rounds in which they are taken.
    seeds
        The seed lattice.
    """
    from selective_depth.app.commands.model import save_model
    from selective_depth.app.commands.snapshot import nth_frame
    from selective_depth.selectors.acquire import acquire
    from selective_depth.selectors.seeds import SeedGrid

    if frame < 0:
        raise UsageError(f"--frame is {frame}; frames count from 0.")
    full = nth_frame(source, frame)
    grid = SeedGrid.from_frame(full, (seeds.rows, seeds.columns))
    for path in save_model(out, acquire(full.measure, grid, budget, rounds), full.camera):
        print(f"wrote {path}")


@command(
    "Pictures",
    (f"{PROGRAM} screenshot out.rrd out.png", "the viewer on a recording that --save wrote"),
)
def screenshot(
    recording: Annotated[Path, arg(metavar="FILE.rrd")],
    picture: Annotated[Path, arg(metavar="FILE.png")],
    /,
    frame: Annotated[int | None, optional("N")] = None,
) -> int:
    """Take a picture of the viewer without a display; it needs a graphics driver.

    Parameters
    ----------
    recording : Path
        A Rerun recording, as --save writes it.
    picture : Path
        The picture to make, .png or .webp, 1920x1080.
    frame : int
        The frame to show; by default the last.
    """
    from selective_depth.app.console.output import IMAGES, check_picture, write_image
    from selective_depth.app.console.progress import waiting
    from selective_depth.app.pipeline import say
    from selective_depth.app.viewer import recording as viewer

    check_picture(picture, IMAGES)
    with waiting("Loading it into the viewer"):
        taken = viewer.screenshot(recording, frame)
    write_image(picture, taken)
    say(f"wrote {picture}")
    return OK


@command(
    "Pictures",
    (f"{PROGRAM} snapshot walk.oni --frame 30", "one frame, all panels, no viewer needed"),
    (
        f"{PROGRAM} snapshot virtual:workstation virtual:ball virtual:firehose",
        "the paper's Fig. 5",
    ),
    (f"{PROGRAM} snapshot frames/ --budget 0.05 --out pictures", "with what was acquired"),
)
def snapshot(
    sources: Annotated[tuple[str, ...], optional("SOURCE...")],
    /,
    out: Annotated[Path, arg(metavar="DIR")] = Path("snapshot"),
    frame: Annotated[int, arg(metavar="N")] = 0,
    seeds: SeedOptions = DEFAULTS.seeds,
    gas: GasOptions = DEFAULTS.gas,
    improvement: ImprovementOptions = DEFAULTS.improvement,
    acquire: Annotated[AcquireOptions, arg(name="")] = DEFAULTS.acquire,
    page: Page = PAGE,
) -> None:
    """Write a contact sheet of one frame of each source, and every panel alone.

    Parameters
    ----------
    sources : tuple of str
        Recordings, folders or scenes, as for replay; one row of the sheet each.
    out : Path
        Folder for the sheet and every panel as .png; or a picture, for the sheet alone.
    frame : int
        Which frame of each source, from 0.
    seeds, gas, improvement, acquire
        Options of the selectors.
    page
        The page.
    """
    from selective_depth.app.commands.snapshot import snapshot as make_stills
    from selective_depth.app.console.progress import waiting

    if frame < 0:
        raise UsageError(f"--frame is {frame}; frames count from 0.")
    settings = Settings(seeds=seeds, gas=gas, improvement=improvement, acquire=acquire)
    with waiting("Running both selectors"):
        written = make_stills(sources, frame, out, settings, page)
    beside = f" and {len(written) - 1} single panels beside it" if written[1:] else ""
    print(f"wrote {written[0]}{beside}")


@command(
    "Pictures",
    (f"{PROGRAM} epochs bunny.ply", "the paper's Fig. 1, to epochs.png"),
    (f"{PROGRAM} epochs bunny.ply?side=left --save epochs.rrd", "and on an epoch timeline"),
)
def epochs(
    source: Source,
    /,
    out: Annotated[Path, arg(metavar="FILE")] = Path("epochs.png"),
    save: Annotated[Path | None, optional("FILE.rrd")] = None,
    frame: Annotated[int, arg(metavar="N")] = 0,
    seed: Annotated[int, arg(metavar="N")] = 0,
    page: Page = PAGE,
) -> int:
    """Show neural gas after 5, 10, 25, 40, 60 and 100 epochs of one frame.

    Parameters
    ----------
    source : str
        An object as .ply, or anything else that 'replay' takes.
    out : Path
        The picture to make, .png, .webp, .pdf or .svg.
    save : Path
        Write a Rerun recording as well, by epoch.
    frame : int
        Which frame of the source, from 0.
    seed : int
        Seed of the random draws.
    page
        The page.
    """
    from selective_depth.app.commands.figures import draw_epochs

    return draw_epochs(source, out, save=save, number=frame, seed=seed, page=page)


@command(
    "Pictures",
    (f"{PROGRAM} densities bunny.ply", "the paper's Fig. 2, to densities.png"),
)
def densities(
    source: Source,
    /,
    out: Annotated[Path, arg(metavar="FILE")] = Path("densities.png"),
    frame: Annotated[int, arg(metavar="N")] = 0,
    epochs: Annotated[int, arg(metavar="N")] = 50,
    seed: Annotated[int, arg(metavar="N")] = 0,
    page: Page = PAGE,
) -> int:
    """Show what neural gas finds from first scans of 32x32, 40x40, 64x64 and 75x75 points.

    Parameters
    ----------
    source : str
        An object as .ply, or anything else that 'replay' takes.
    out : Path
        The picture to make, .png, .webp, .pdf or .svg.
    frame : int
        Which frame of the source, from 0.
    epochs : int
        Training length.
    seed : int
        Seed of the random draws.
    page
        The page.
    """
    from selective_depth.app.commands.figures import draw_densities

    return draw_densities(source, out, number=frame, epochs=epochs, seed=seed, page=page)


@command(
    "Compare",
    (f"{PROGRAM} nodes frames/", "time, error and regions, on frame 0"),
    (f"{PROGRAM} nodes frames/ --every 60 --out nodes.md", "mean over every 60th frame"),
)
def nodes(
    source: Source,
    /,
    every: Annotated[int | None, optional("N")] = None,
    out: Annotated[Path | None, optional("FILE.md")] = None,
) -> int:
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
    frames: Annotated[int | None, optional("N")] = None,
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
    (f"{PROGRAM} evaluate frames/ --seeds.rows 64 --seeds.columns 64", "a coarser seed lattice"),
    (f"{PROGRAM} evaluate 'virtual:workstation?noise=off'", "where the truth is exact"),
)
def evaluate(
    sources: Annotated[tuple[str, ...], optional("SOURCE...")],
    /,
    every: Annotated[int, arg(metavar="N")] = 20,
    frames: Annotated[int | None, optional("N")] = None,
    budget: Annotated[tuple[float, ...], arg(metavar="SHARE...")] = (0.05, 0.10),
    rounds: Annotated[int, arg(metavar="N")] = 8,
    seeds: SeedOptions = DEFAULTS.seeds,
    random_seeds: Annotated[int, arg(metavar="N")] = 3,
    jobs: Annotated[int | None, optional("N")] = None,
    json: Annotated[Path | None, optional("FILE")] = None,
    picture: Annotated[Path | None, optional("FILE.png")] = None,
    page: Annotated[Path | None, optional("FILE.md")] = None,
    format_: Page = PAGE,
) -> None:
    """Compare ways of choosing measurements: how good a model does a budget buy?

    Parameters
    ----------
    sources : tuple of str
        Recordings, folders or scenes, as for replay.
    every : int
        Take every N-th frame.
    frames : int
        Take at most N frames of each source.
    budget : tuple of float
        Further measurements as shares of the frame's pixels.
    rounds : int
        Rounds of the closed loops.
    seeds
        The seed lattice.
    random_seeds : int
        How often strategies that draw at random are run.
    jobs : int
        Processes; by default one per processor.
    json : Path
        Write the figures to a file as well.
    page : Path
        Write the tables in Markdown.
    picture : Path
        Draw where each strategy measured and how wrong its model is, for the first frame.
    format_
        The picture's page.
    """
    from selective_depth.app.evaluation.report import run_evaluation

    run_evaluation(
        sources,
        every=every,
        frames=frames,
        budgets=budget,
        rounds=rounds,
        seeds_shape=(seeds.rows, seeds.columns),
        random_seeds=random_seeds,
        jobs=jobs,
        json_file=json,
        picture=picture,
        page=page,
        format_=format_,
    )


def run(arguments: Sequence[str]) -> int:
    """Run a command line and return its exit code: 0, 1 failed, 2 misused, 130 interrupted."""
    words = list(arguments)
    debug = _take(words, "--debug")
    verbose = _take(words, "-v", "--verbose")
    try:
        with interrupt.recognised():
            return _dispatch(words, verbose)
    except BrokenPipeError:  # whoever read the output has seen enough, as in `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except KeyboardInterrupt:
        _say("interrupted.")
        return INTERRUPTED
    except Exception as error:  # the one place where any error becomes one line
        if debug:
            raise
        _say(_sentence(error))
        return MISUSED if isinstance(error, UsageError) else FAILED


def _dispatch(words: list[str], verbose: bool) -> int:
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, format="%(message)s")
    # The viewer's SDK logs in its own way to the terminal; its warnings are told in ours.
    os.environ.setdefault("RUST_LOG", "warn" if verbose else "off")
    if shutil.get_terminal_size().columns < NARROWEST:
        os.environ["COLUMNS"] = str(NARROWEST)
    if not words or words[0] in ("-h", "--help", "help"):
        print(overview(EXAMPLES))
        return OK
    if words[0] == "--version":
        print(_versions())
        return OK
    if words[0] == "--completion":
        print(completion(words[1] if len(words) > 1 else ""))
        return OK
    name, typed = words[0], words[1:]
    if "--settings" not in typed:
        return invoke(name, typed)
    at = typed.index("--settings")
    if at + 1 == len(typed):
        raise UsageError("--settings needs a file: --settings FILE.toml")
    file, typed = Path(typed[at + 1]), typed[:at] + typed[at + 2 :]
    from_file = settings_arguments(file)
    try:
        # Before what was typed, so that what was typed wins.
        return invoke(name, from_file + typed)
    except UsageError as error:
        if any(word in from_file and word not in typed for word in OPTION.findall(str(error))):
            raise UsageError(f"{error} That option stands in '{file}'.") from None
        raise


def _take(words: list[str], *names: str) -> bool:
    found = [word for word in words if word in names]
    for word in found:
        words.remove(word)
    return bool(found)


def _versions() -> str:
    from importlib.metadata import version

    from selective_depth.drivers.errors import SourceError
    from selective_depth.drivers.openni import runtime_version

    try:
        runtime = f"OpenNI2 runtime {runtime_version()}"
    except SourceError as error:
        runtime = f"no OpenNI2 runtime: {error}"
    return f"{PROGRAM} {version(PROGRAM)}\n{runtime}"


def _sentence(error: Exception) -> str:
    from selective_depth.drivers.errors import SourceError

    words = " ".join(str(error).split())
    if isinstance(error, (AppError, SourceError, ValueError, OSError)) and words:
        return words
    return (
        f"unexpected {type(error).__name__}: {words or 'no message'}."
        " Run it again with --debug to see where, and please report it."
    )


def _say(words: str) -> None:
    print(f"{PROGRAM}: {words}", file=sys.stderr)
