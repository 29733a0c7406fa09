"""The commands of `selective-depth`: a signature is a command line, its docstring the help.

Each imports what does its work when it is called, so that the help is there at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from selective_depth.app.console import dispatch
from selective_depth.app.console.command import PROGRAM, command
from selective_depth.app.settings import (
    AcquireOptions,
    BatchOptions,
    DemoOptions,
    Flag,
    Limit,
    LiveSettings,
    Natural,
    PanelOptions,
    PlayOptions,
    Positive,
    SelectorOptions,
    Settings,
    Source,
    SourceOrSample,
    TimeLimit,
    ViewerOptions,
    WindowSize,
    not_negative,
    optional,
    whole,
)

EXAMPLES = (
    (f"{PROGRAM} replay virtual:workstation", "a made scene, in the viewer"),
    (f"{PROGRAM} replay walk.oni --budget 0.05", "a recording; measure 5 % more where it counts"),
    (f"{PROGRAM} replay frames/ --headless --save out.rrd", "a PNG folder, to a file"),
    (f"{PROGRAM} live", "the sensor that is plugged in"),
    (f"{PROGRAM} devices", "what is plugged in, or what is missing"),
)

LiveOptions = Annotated[LiveSettings, arg(name="")]
Acquiring = Annotated[AcquireOptions, arg(name="")]
Selectors = Annotated[SelectorOptions, arg(name="")]
DEFAULTS, LIVE, SELECTORS, PAGE, BATCH = Settings(), LiveSettings(), SelectorOptions(), PanelOptions(), BatchOptions()
MODEL, SHOWN, DEMO = AcquireOptions(budget=0.05, rounds=8), AcquireOptions(budget=0.05, rounds=4), DemoOptions()


@command("Watch")
def replay(source: SourceOrSample = None, /, settings: Annotated[Settings, arg(name="")] = DEFAULTS) -> int:
    """Replay a recording through both selectors.

    Parameters
    ----------
    source : str
        An .oni file, a folder of PNG frames, a .ply object or virtual:SCENE; else the sample.
    settings : Settings
        All options.

    Examples
    --------
    selective-depth replay
        the recording that comes with the program
    selective-depth replay walk.oni
        every frame of a recording, in the viewer
    selective-depth replay frames/ --headless --save out.rrd
        a folder of PNG frames, to a file
    selective-depth replay virtual:firehose --budget 0.05 --rounds 4
        and measure 5 % more
    selective-depth replay walk.oni --realtime --serve
        as live, for viewers elsewhere to join
    """
    from selective_depth.app.commands.run import watch
    from selective_depth.app.commands.samples import bundled_recording

    return watch(bundled_recording() if source is None else source, settings)


@command("Watch")
def live(device: Annotated[str, optional("DEVICE")] = "", /, settings: LiveOptions = LIVE) -> int:
    """Watch a sensor through both selectors; end with Ctrl-C.

    Parameters
    ----------
    device : str
        Its address as 'selective-depth devices' shows it; by default the only one there is.
    settings : Settings
        All options.

    Examples
    --------
    selective-depth live
        the sensor that is plugged in, in the viewer
    selective-depth live --headless --save demo.rrd --frames 300
        ten seconds, to a file
    selective-depth live --serve --serve-address 0.0.0.0:9876
        for viewers on other machines
    """
    from selective_depth.app.commands.run import watch

    return watch(f"openni:{device}" if device else "openni", settings)


@command("Watch")
def demo(
    source: SourceOrSample = None,
    /,
    options: Annotated[DemoOptions, arg(name="")] = DEMO,
    selectors: Selectors = SELECTORS,
    acquire: Acquiring = SHOWN,
    play: Annotated[PlayOptions, arg(name="")] = DEFAULTS.play,
) -> int:
    """Show the viewer in a browser, with controls beside it, for people to watch and steer.

    The page is on this machine only, unless --share is given. It needs an extra: pip install
    'selective-depth[demo]'.

    Parameters
    ----------
    source : str
        As for replay or live; by default the sensor that is plugged in, else the sample in a loop.
    options
        Where the page is.
    selectors, acquire, play
        What it begins with.

    Examples
    --------
    selective-depth demo
        the sensor that is plugged in, else a bundled recording in a loop
    selective-depth demo walk.oni --budget 2%
        a recording, in a loop
    selective-depth demo --share
        for a tablet in the same room too
    """
    from selective_depth.app.demo import run_demo

    seen = ViewerOptions(layout="visitor")
    return run_demo(source, options, Settings(**vars(selectors), acquire=acquire, play=play, viewer=seen))


@command("Sensors")
def record(
    out: Annotated[Path, arg(metavar="OUT.oni")],
    device: Annotated[str, optional("DEVICE")] = "",
    /,
    frames: Limit = None,
    seconds: TimeLimit = None,
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

    Examples
    --------
    selective-depth record walk.oni
        until Ctrl-C
    selective-depth record walk.oni --seconds 10
        ten seconds
    selective-depth record walk.oni 1d27/0609@1/3 --frames 300
        from one of several sensors
    """
    from selective_depth.app.commands.sensors import record_sensor

    return record_sensor(out, device, frames=frames, seconds=seconds, overwrite=overwrite)


@command("Sensors")
def devices() -> int:
    """List the sensors that OpenNI2 finds, or say what is missing and what to install.

    Examples
    --------
    selective-depth devices
        what is plugged in, or what is missing
    """
    from selective_depth.app.commands.sensors import print_devices

    return print_devices()


@command("Files")
def check(
    sources: Annotated[tuple[str, ...], optional("SOURCE...")],
    /,
    repair: Annotated[Path | None, optional("OUT.oni")] = None,
    timeout: Annotated[Positive, arg(metavar="SECONDS")] = 10.0,
) -> int:
    """Say whether a recording is whole; needs no OpenNI2.

    Parameters
    ----------
    sources : tuple of str
        Recordings, or folders that hold some; of those that are no .oni file every frame is read.
    repair : Path
        Write what is readable of one .oni file to this new file, which OpenNI2 replays.
    timeout : float
        Look at an .oni file for at most this long.

    Examples
    --------
    selective-depth check walk.oni
        what is wrong with it and where, how much is readable
    selective-depth check walk.oni --repair whole.oni
        and save what is readable
    selective-depth check archive/ 'day2/*.oni'
        every recording in there, in a table
    """
    from selective_depth.app.commands.files import check as look

    return look(sources, repair=repair, timeout_s=timeout)


@command("Files")
def export(paths: Annotated[tuple[str, ...], optional("SOURCE... OUT")], /, frames: Limit = None) -> int:
    """Save a source's frames as PNG files, an .oni file or a ROS 2 bag; needs no OpenNI2.

    Parameters
    ----------
    paths : tuple of str
        Anything that 'replay' takes, and OUT: a new folder for PNG files and their sidecar, a new
        file that ends in .oni or .mcap, or a folder that ends in .ros2. Of several sources, or of
        a folder that holds some, OUT gets a folder of PNG files for each.
    frames : int
        Stop after this many frames of each.

    Examples
    --------
    selective-depth export walk.oni frames/
        as 16-bit PNG files; all that is readable
    selective-depth export frames/ walk.oni
        an .oni file out of PNG files
    selective-depth export virtual:ball ball.oni --frames 90
        of any source
    selective-depth export archive/ walk.oni out/
        of several: a folder of PNG files each
    """
    from selective_depth.app.commands.files import export_all

    return export_all(paths, frames)


@command("Files")
def batch(
    sources: Annotated[tuple[str, ...], optional("SOURCE...")],
    /,
    out: Annotated[Path, arg(metavar="DIR")],
    options: Annotated[BatchOptions, arg(name="")] = BATCH,
    selectors: Selectors = SELECTORS,
    acquire: Acquiring = DEFAULTS.acquire,
) -> int:
    """Run every recording of an archive through both selectors: a table each, and a summary.

    Started again, it continues where it stopped; what is done and unchanged is kept.

    Parameters
    ----------
    sources : tuple of str
        Recordings, folders that hold some, patterns, scenes; - reads a list from stdin.
    out : Path
        Folder for the tables, made if need be.
    options
        What is kept, and who does the work.
    selectors, acquire
        Options of the selectors.

    Examples
    --------
    selective-depth batch archive/ --out results
        every recording in it: a table each, and a summary
    selective-depth batch 'day1/*.oni' scans/ --out results --budget 5% --models
        and what a budget buys
    selective-depth batch - --out results
        a list of recordings on standard input
    selective-depth batch archive/ --out results --scheduler tcp://host:8786
        on a Dask cluster
    """
    from selective_depth.app.commands.batch import run_batch

    return run_batch(sources, out, options, Settings(**vars(selectors), acquire=acquire))


@command("Files")
def model(
    source: Source,
    out: Annotated[Path, arg(metavar="DIR")],
    /,
    frame: Natural = 0,
    selectors: Selectors = SELECTORS,
    acquire: Acquiring = MODEL,
) -> int:
    """Acquire one frame selectively and save the model: cloud.ply, depth.png, samples.npz.

    Parameters
    ----------
    source : str
        Anything that 'replay' takes.
    out : Path
        Folder for the three files.
    frame : int
        Which frame, from 0.
    selectors, acquire
        Options of the acquisition and of the selector that drives it.

    Examples
    --------
    selective-depth model frames/ model --frame 30 --budget 0.05
        a cloud, its depth, its samples
    """
    from selective_depth.app.commands.model import model_frame

    return model_frame(source, out, frame, Settings(**vars(selectors), acquire=acquire))


@command("Pictures")
def screenshot(
    recording: Annotated[Path, arg(metavar="FILE.rrd")],
    picture: Annotated[Path, arg(metavar="FILE.png")],
    /,
    frame: Annotated[int | None, whole(0), optional("N")] = None,
    time: Annotated[float | None, not_negative, optional("SECONDS")] = None,
    view: Annotated[str | None, optional("NAME")] = None,
    size: WindowSize = (1920, 1080),
) -> int:
    """Take a picture of the viewer without a display; it needs a graphics driver.

    Parameters
    ----------
    recording : Path
        A Rerun recording, as --save writes it.
    picture : Path
        The picture to make, .png or .webp.
    frame : int
        The frame to show; by default the last.
    time : float
        Show the time this many seconds after the first frame instead.
    view : str
        Show one view alone: its title, or a part of it.
    size : tuple of int
        Width and height of the viewer in pixels.

    Examples
    --------
    selective-depth screenshot out.rrd out.png
        the viewer on a recording that --save wrote
    selective-depth screenshot out.rrd out.png --time 12.5 --size 1280x720
        after so many seconds
    selective-depth screenshot out.rrd space.png --view space
        one view alone
    """
    from selective_depth.app.commands.snapshot import take_screenshot

    return take_screenshot(recording, picture, frame, time, view, size)


@command("Pictures")
def snapshot(
    sources: Annotated[tuple[str, ...], optional("SOURCE...")],
    /,
    out: Annotated[Path, arg(metavar="DIR")] = Path("snapshot"),
    frame: Natural = 0,
    selectors: Selectors = SELECTORS,
    acquire: Acquiring = DEFAULTS.acquire,
    page: Annotated[PanelOptions, arg(name="")] = PAGE,
) -> int:
    """Write a contact sheet of one frame of each source, and every panel alone.

    Parameters
    ----------
    sources : tuple of str
        Recordings, folders or scenes, as for replay; one row of the sheet each.
    out : Path
        Folder for the sheet and every panel; or a picture, for the sheet alone.
    frame : int
        Which frame of each source, from 0.
    selectors, acquire
        Options of the selectors.
    page
        The page.

    Examples
    --------
    selective-depth snapshot walk.oni --frame 30
        one frame, all panels, no viewer needed
    selective-depth snapshot virtual:workstation virtual:ball virtual:firehose
        the paper's Fig. 5
    selective-depth snapshot frames/ --budget 0.05 --out pictures
        with what was acquired
    selective-depth snapshot walk.oni --out panels --format pdf --panel-width 3.5
        for a paper's column
    """
    from selective_depth.app.commands.snapshot import draw_snapshot

    return draw_snapshot(sources, frame, out, Settings(**vars(selectors), acquire=acquire), page)


# Declared here, to be listed after those above.
from selective_depth.app import cli_compare as cli_compare  # noqa: E402


def run(arguments: Sequence[str]) -> int:
    """Run a command line and return its exit code: 0, 1 failed, 2 misused, 130 interrupted."""
    return dispatch.run(arguments, EXAMPLES)
