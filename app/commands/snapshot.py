"""Stills of one frame of each source: the contact sheet and every panel alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from selective_depth.app.console.errors import UsageError
from selective_depth.app.console.exit_codes import OK
from selective_depth.app.console.output import IMAGES, PICTURES, check_picture, make_folder, write_image
from selective_depth.app.console.progress import waiting
from selective_depth.app.pictures import StillRow, alone, contact_sheet, panels_of, write_picture
from selective_depth.app.pipeline import FrameResult, Pipeline, open_and_tell, say
from selective_depth.app.settings import PictureOptions, Settings
from selective_depth.drivers.errors import SourceEndedError
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
    with open_and_tell(uri) as source:
        for reached in range(number + 1):
            try:
                frame = source.read()
            except SourceEndedError:
                raise UsageError(
                    f"--frame is {number}, but '{uri}' has {reached} frames; the last is --frame {reached - 1}."
                ) from None
    return frame


def still_row(frame: DepthFrame, title: str, settings: Settings) -> StillRow:
    """Run both selectors, and the acquisition where there is a budget, on one frame."""
    # One frame has no frame before it to go on from.
    cold = replace(settings, gas=replace(settings.gas, training="cold"))
    with Pipeline(cold) as pipeline:
        return row_of(pipeline.make(frame), title)


def row_of(result: FrameResult, title: str) -> StillRow:
    """A frame's result as a row of a contact sheet."""
    return StillRow(title, result.frame, result.regions, result.improvement, result.acquisition)


def snapshot(sources: Sequence[str], number: int, out: Path, settings: Settings, page: PictureOptions) -> list[Path]:
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
    page : PictureOptions
        Size of the sheet, and resolution of both.

    Returns
    -------
    list of Path
        What was written, the sheet first.

    Raises
    ------
    UsageError
        If there is no source, or one has no such frame.
    OutputError
        If the folder or a picture cannot be written.
    """
    if not sources:
        raise UsageError("no source was named; give recordings, folders or scenes.")
    single = out.suffix.lower() in PICTURES
    if single:
        check_picture(out)
    else:
        make_folder(out)
    names = [short_name(uri) for uri in sources]
    rows = []
    for at, (uri, name) in enumerate(zip(sources, names, strict=True)):
        again = names[:at].count(name)
        title = f"{name}-{again + 1}" if again else name
        rows.append(still_row(nth_frame(uri, number), title, settings))
    written = [out if single else out / "sheet.png"]
    write_picture(written[0], contact_sheet(rows, page.width), page.dpi)
    for row in () if single else rows:
        for panel in panels_of(row):
            written.append(out / f"{row.title}-{panel.name}.png")
            write_picture(written[-1], alone(panel), page.dpi)
    return written


def draw_snapshot(sources: Sequence[str], number: int, out: Path, settings: Settings, page: PictureOptions) -> int:
    """Make a `snapshot` and say what was written; returns the exit code."""
    with waiting("Running both selectors"):
        written = snapshot(sources, number, out, settings, page)
    beside = f" and {len(written) - 1} single panels beside it" if written[1:] else ""
    say(f"wrote {written[0]}{beside}")
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
        If the file is no Rerun recording, or the viewer does not run here.
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
