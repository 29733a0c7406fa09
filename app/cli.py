"""The command `selective-depth`: its subcommands, its errors and its exit codes."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NoReturn

from tyro.conf import arg

from selective_depth.app.command import (
    PROGRAM,
    command,
    completion,
    invoke,
    overview,
    settings_arguments,
)
from selective_depth.app.errors import AppError, UsageError
from selective_depth.app.settings import Settings

OK, FAILED, MISUSED, INTERRUPTED = 0, 1, 2, 130

EXAMPLES = (
    (f"{PROGRAM} replay virtual:workstation", "a made scene, in the viewer"),
    (f"{PROGRAM} replay walk.oni --budget 0.05", "a recording; measure 5 % more where it counts"),
    (f"{PROGRAM} replay frames/ --headless --save out.rrd", "a PNG folder, to a file"),
    (f"{PROGRAM} live", "the sensor that is plugged in"),
    (f"{PROGRAM} devices", "what is plugged in, or what is missing"),
)

Source = Annotated[str, arg(metavar="SOURCE")]
Options = Annotated[Settings, arg(name="")]
DEFAULTS = Settings()


@command(
    "Watch",
    (f"{PROGRAM} replay", "the recording that comes with the program"),
    (f"{PROGRAM} replay walk.oni", "every frame of a recording, in the viewer"),
    (f"{PROGRAM} replay frames/ --headless --save out.rrd", "a folder of PNG frames, to a file"),
    (f"{PROGRAM} replay virtual:firehose --budget 0.05 --rounds 4", "and measure 5 % more"),
    (f"{PROGRAM} replay walk.oni --realtime --serve", "as live, for viewers elsewhere to join"),
)
def replay(source: Source = "", /, settings: Options = DEFAULTS) -> int:
    """Replay a recording through both selectors.

    Parameters
    ----------
    source : str
        A recording (.oni), a folder of 16-bit PNG frames, an object (.ply), or a made scene
        (virtual:workstation, virtual:ball, virtual:firehose); by default the recording that
        comes with the program.
    settings : Settings
        All options.
    """
    from selective_depth.app.samples import bundled_recording
    from selective_depth.app.session import watch

    return watch(source or bundled_recording(), settings)


@command(
    "Watch",
    (f"{PROGRAM} live", "the sensor that is plugged in, in the viewer"),
    (f"{PROGRAM} live --headless --save demo.rrd --frames 300", "ten seconds, to a file"),
    (f"{PROGRAM} live --serve --serve-address 0.0.0.0:9876", "for viewers on other machines"),
)
def live(
    device: Annotated[str, arg(metavar="DEVICE")] = "", /, settings: Options = DEFAULTS
) -> int:
    """Watch a sensor through both selectors; end with Ctrl-C.

    Parameters
    ----------
    device : str
        Its address as 'selective-depth devices' shows it; by default the only one there is.
    settings : Settings
        All options.
    """
    from selective_depth.app.session import watch

    return watch(f"openni:{device}" if device else "openni", settings)


@command(
    "Sensors",
    (f"{PROGRAM} record walk.oni", "until Ctrl-C"),
    (f"{PROGRAM} record walk.oni --seconds 10", "ten seconds"),
    (f"{PROGRAM} record walk.oni 1d27/0609@1/3 --frames 300", "from one of several sensors"),
)
def record(
    out: Annotated[Path, arg(metavar="OUT.oni")],
    device: Annotated[str, arg(metavar="DEVICE")] = "",
    /,
    frames: Annotated[int | None, arg(metavar="N")] = None,
    seconds: Annotated[float | None, arg(metavar="SECONDS")] = None,
    overwrite: bool = False,
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
    from selective_depth.app.sensors import record_sensor

    return record_sensor(out, device, frames=frames, seconds=seconds, overwrite=overwrite)


@command("Sensors", (f"{PROGRAM} devices", "what is plugged in, or what is missing"))
def devices() -> int:
    """List the sensors that OpenNI2 finds, or say what is missing and what to install."""
    from selective_depth.app.sensors import print_devices

    return print_devices()


@command(
    "Pictures",
    (f"{PROGRAM} screenshot out.rrd out.png", "the viewer on a recording that --save wrote"),
)
def screenshot(
    recording: Annotated[Path, arg(metavar="FILE.rrd")],
    picture: Annotated[Path, arg(metavar="FILE.png")],
    /,
    frame: Annotated[int | None, arg(metavar="N")] = None,
) -> int:
    """Take a picture of the viewer without a display; it needs a graphics driver.

    Parameters
    ----------
    recording : Path
        A Rerun recording, as --save writes it.
    picture : Path
        The picture to make, 1920x1080.
    frame : int
        The frame to show; by default the last.
    """
    from selective_depth.app import viewer
    from selective_depth.app.report import say

    viewer.screenshot(recording, picture, frame)
    say(f"wrote {picture}")
    return OK


def run(arguments: Sequence[str]) -> int:
    """Run a command line and return its exit code: 0, 1 failed, 2 misused, 130 interrupted."""
    words = list(arguments)
    debug = _take(words, "--debug")
    verbose = _take(words, "-v", "--verbose")
    try:
        return _dispatch(words, verbose)
    except KeyboardInterrupt:
        _say("interrupted.")
        return INTERRUPTED
    except Exception as error:  # the one place where any error becomes one line
        if debug:
            raise
        _say(_sentence(error))
        return MISUSED if isinstance(error, UsageError) else FAILED


def _dispatch(words: list[str], verbose: bool) -> int:
    # The viewer's SDK logs in its own way to the terminal; its warnings are told in ours.
    os.environ.setdefault("RUST_LOG", "info" if verbose else "off")
    if not words or words[0] in ("-h", "--help", "help"):
        print(overview(EXAMPLES))
        return OK
    if words[0] == "--version":
        print(_versions())
        return OK
    if words[0] == "--completion":
        print(completion(words[1] if len(words) > 1 else ""))
        return OK
    name, rest = words[0], words[1:]
    return invoke(name, _with_settings_file(rest))


def _with_settings_file(words: list[str]) -> list[str]:
    if "--settings" not in words:
        return words
    at = words.index("--settings")
    if at + 1 == len(words):
        raise UsageError("--settings needs a file: --settings FILE.toml")
    # Before what was typed, so that what was typed wins.
    return settings_arguments(Path(words[at + 1])) + words[:at] + words[at + 2 :]


def _take(words: list[str], *names: str) -> bool:
    found = [word for word in words if word in names]
    for word in found:
        words.remove(word)
    return bool(found)


def _versions() -> str:
    from importlib.metadata import version

    from selective_depth.drivers.openni import runtime_version
    from selective_depth.drivers.source import SourceError

    try:
        runtime = f"OpenNI2 runtime {runtime_version()}"
    except SourceError as error:
        runtime = f"no OpenNI2 runtime: {error}"
    return f"{PROGRAM} {version(PROGRAM)}\n{runtime}"


def _sentence(error: Exception) -> str:
    from selective_depth.drivers.source import SourceError

    words = " ".join(str(error).split())
    if isinstance(error, (AppError, SourceError, ValueError, OSError)) and words:
        return words
    return (
        f"unexpected {type(error).__name__}: {words or 'no message'}."
        " Run it again with --debug to see where, and please report it."
    )


def _say(words: str) -> None:
    print(f"{PROGRAM}: {words}", file=sys.stderr)


def _terminate(number: int, frame: object) -> NoReturn:
    raise KeyboardInterrupt


def main() -> NoReturn:
    """Entry point of the console script."""
    # Asked to end by the system, leave as after Ctrl-C: sensor closed, files whole.
    signal.signal(signal.SIGTERM, _terminate)
    sys.exit(run(sys.argv[1:]))
