"""Stills of one frame of each source: the contact sheet and every panel alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from selective_depth.app.console.errors import UsageError
from selective_depth.app.console.exit_codes import OK
from selective_depth.app.console.output import IMAGES, check_picture, make_folder, write_image
from selective_depth.app.console.progress import waiting
from selective_depth.app.pictures import Row, alone, contact_rows, sheet, write_picture
from selective_depth.app.pipeline import FrameResult, Pipeline, open_and_tell, say
from selective_depth.app.settings import PanelOptions, Settings
from selective_depth.drivers.frame import DepthFrame


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
    count = 0
    with open_and_tell(uri) as source:
        for count, frame in enumerate(source, start=1):
            if count > number:
                return frame
    raise UsageError(f"--frame is {number}, but '{uri}' has {count} frames; the last is --frame {count - 1}.")


def still_of(frame: DepthFrame, settings: Settings) -> FrameResult:
    """Run both selectors, and the acquisition where there is a budget, on one frame."""
    # One frame has no frame before it to go on from.
    cold = replace(settings, gas=replace(settings.gas, training="cold"))
    with Pipeline(cold) as pipeline:
        return pipeline.make(frame)


def is_folder(out: Path) -> bool:
    """Whether pictures go into a folder of that name, which is made if need be, or are one file.

    Raises
    ------
    UsageError
        If it names a picture of a format that cannot be made.
    OutputError
        If the folder cannot be made, or that of the picture does not exist.
    """
    folder = out.is_dir() or not out.suffix
    if folder:
        make_folder(out)
    else:
        check_picture(out)
    return folder


def write_all(
    out: Path, name: str, rows: Sequence[Row], stems: Sequence[str], page: PanelOptions, *, legend: bool = True
) -> list[Path]:
    """Write a sheet; into a folder, with every panel of it alone beside it. Says what was written.

    Parameters
    ----------
    out : Path
        A picture, or a folder, as `is_folder` says.
    name : str
        Name of the sheet in a folder, without its ending.
    rows : sequence of Row
        As for `sheet`.
    stems : sequence of str
        What the names of each row's panels begin with.
    page : PanelOptions
        Size, resolution, and in a folder format.
    legend : bool, default True
        As for `sheet`.

    Returns
    -------
    list of Path
        What was written, the sheet first.
    """
    folder = is_folder(out)
    written = [out / f"{name}.{page.format}" if folder else out]
    write_picture(written[0], sheet(rows, page.width, legend=legend), page.dpi)
    for stem, (title, panels) in zip(stems, rows if folder else (), strict=folder):
        for panel in filter(None, panels):
            written.append(out / f"{stem}{panel.name}.{page.format}")
            figure = alone(panel) if page.bare else sheet([(title, [panel])], page.panel_width, legend=legend)
            write_picture(written[-1], figure, page.dpi)
    beside = f" and {len(written) - 1} single panels beside it" if written[1:] else ""
    say(f"wrote {written[0]}{beside}")
    return written


def snapshot(sources: Sequence[str], number: int, out: Path, settings: Settings, page: PanelOptions) -> list[Path]:
    """Write a contact sheet with a row per source, and each panel alone.

    Parameters
    ----------
    sources : sequence of str
        As for `open_source`, at least one.
    number : int
        Which frame of each, from 0.
    out : Path
        A picture, for the sheet alone; or a folder for the sheet and the panels, made if need be.
    settings : Settings
        Options of the seeds, the selectors and the acquisition.
    page : PanelOptions
        Size, resolution and format.

    Returns
    -------
    list of Path
        What was written, the sheet first.

    Raises
    ------
    UsageError
        If there is no source, one has no such frame, or a picture's format is not known.
    OutputError
        If the folder or a picture cannot be written.
    """
    if not sources:
        raise UsageError("no source was named; give recordings, folders or scenes.")
    is_folder(out)  # refused before the work is done
    stems = stems_of(sources)
    rows = [
        (f"{stem[:-1]}, frame {number}", still_of(nth_frame(uri, number), settings))
        for uri, stem in zip(sources, stems, strict=True)
    ]
    return write_all(out, "sheet", contact_rows(rows), stems, page)


def stems_of(sources: Sequence[str]) -> list[str]:
    """What the panels of each source are called before their own names; no two alike."""
    names = [short_name(uri) for uri in sources]
    again = [names[:at].count(name) for at, name in enumerate(names)]
    return [f"{name}-{count + 1}-" if count else f"{name}-" for name, count in zip(names, again, strict=True)]


def draw_snapshot(sources: Sequence[str], number: int, out: Path, settings: Settings, page: PanelOptions) -> int:
    """Make a `snapshot`; returns the exit code."""
    with waiting("Running both selectors"):
        snapshot(sources, number, out, settings, page)
    return OK


def take_screenshot(
    recording: Path, picture: Path, frame: int | None, time_s: float | None, view: str | None, size: tuple[int, int]
) -> int:
    """Take a picture of the viewer, by default showing the last frame; returns the exit code.

    Raises
    ------
    UsageError
        If the picture is of a format that cannot be made, or there is no such frame, time or view.
    ViewerError
        If the file is not a Rerun recording, or the viewer does not run here.
    OutputError
        If the picture cannot be written.
    """
    from selective_depth.app import viewer

    check_picture(picture, IMAGES)
    if frame is not None and time_s is not None:
        raise UsageError("--frame and --time both say what to show; give one of them.")
    with waiting("Loading it into the viewer"):
        taken = viewer.screenshot(recording, frame, time_s=time_s, view=view, size=size)
    write_image(picture, taken)
    say(f"wrote {picture}")
    return OK
