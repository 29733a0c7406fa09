"""Pictures as files: panels in rows on a page, drawn by matplotlib, in the format of the ending.

Matplotlib is imported when something is drawn, since that takes half a second, and only its objects
are used, never `pyplot`: nothing is kept from one picture to the next and no display is touched.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Container, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from selective_depth.app.console.output import write_output
from selective_depth.app.pictures import palette
from selective_depth.app.pictures.panels import Panel, hexadecimal, panels_of
from selective_depth.app.pipeline import FrameResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN = 16.0
"""Width of a page; all sizes below, in inches, and those of the type, in points, are for it."""
DPI = 100
INK, PALE = "#1e2228", "#6a7078"
_GAP, _TITLE, _CAPTION, _FOOT, _LEGEND = 0.18, 0.46, 0.34, 0.46, 0.36
_BAR = 0.34
"""Width of a colour bar, as a share of its panel's."""
_WEBP_QUALITY = 80

Row = tuple[str, Sequence[Panel | None]]
"""A title, and panels from left to right; None leaves a place empty."""


def contact_rows(results: Sequence[tuple[str, FrameResult]]) -> list[Row]:
    """Frames with their titles, at least one, under each other, like Fig. 5 of the paper."""
    coloured = any(result.frame.colour is not None for _, result in results)
    # Where one row has a scene, one without keeps its place: columns stay what they are.
    return [
        (title, [*[None] * (coloured and result.frame.colour is None), *panels_of(result)]) for title, result in results
    ]


def contact_sheet(*results: tuple[str, FrameResult]) -> Figure:
    """A `sheet` of `contact_rows`."""
    return sheet(contact_rows(results))


def sheet(rows: Sequence[Row], width_in: float = WIDTH_IN, *, legend: bool = True) -> Figure:
    """Panels in rows, each with its caption, its colour bar and its note.

    Parameters
    ----------
    rows : sequence of (str, sequence of Panel or None)
        Titles, which may be empty, and panels; at least one.
    width_in : float, default 16
        Width of the page in inches. Type, lines and gaps grow with it.
    legend : bool, default True
        Explain the marks that have no scale.

    Returns
    -------
    Figure
        For `write_picture`.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    columns = max(len(shown) for _, shown in rows)
    page_in = WIDTH_IN * min(columns / 3, 1)  # what sizes are for: fewer panels are no larger, but the type is
    each = (page_in - _GAP * (columns + 1)) / columns
    heights = [max(each * p.image.shape[0] / p.image.shape[1] for p in shown if p) for _, shown in rows]
    extras = [(_TITLE if title else 0.0) + _CAPTION + _FOOT for title, _ in rows]
    height = sum(heights) + sum(extras) + _GAP + _LEGEND * legend
    zoom = width_in / page_in
    with rc_context({"text.parse_math": False}):  # a source may be called $x
        figure = Figure(figsize=(width_in, height * zoom), facecolor="white")
        top = height - _GAP / 2
        for (title, shown), tall, extra in zip(rows, heights, extras, strict=True):
            if title:
                place = (_GAP / page_in, (top - 0.32) / height)
                figure.text(*place, _told(title), size=17 * zoom, weight="bold", color=INK)
            bottom = top - extra - tall + _FOOT
            for column, panel in enumerate(shown):
                if panel is not None:
                    left = _GAP + column * (each + _GAP)
                    box = (left / page_in, bottom / height, each / page_in, tall / height)
                    axes = figure.add_axes(box)
                    _fill(axes, panel)
                    _caption(axes, panel, each, tall, zoom)
            top -= extra + tall
        if legend:
            marks = {mark for _, panels in rows for panel in panels if panel for mark in panel.marks}
            _explain(figure, marks, page_in, height, zoom)
    return figure


def alone(panel: Panel) -> Figure:
    """One panel without caption and scale, at `DPI` as large as the frame."""
    from matplotlib.figure import Figure

    height, width = panel.image.shape[:2]
    # A hundredth of a pixel more: a pixel that is a little less than whole would be cut off.
    figure = Figure(figsize=((width + 0.01) / DPI, (height + 0.01) / DPI))
    _fill(figure.add_axes((0, 0, 1, 1)), panel)
    return figure


def write_picture(path: Path, figure: Figure, dpi: int = DPI) -> None:
    """Write a picture whole or not at all, as PNG, WebP, PDF or SVG by the file's ending.

    Parameters
    ----------
    path : Path
        The file.
    figure : Figure
        What `sheet` or `alone` made.
    dpi : int, default 100
        Pixels per inch. PDF and SVG hold the pixels of the frame, however large they are shown.

    Raises
    ------
    OutputError
        If it cannot be written; an older file of that name stays as it was.
    """
    from matplotlib import rc_context
    from matplotlib.image import AxesImage

    kind = path.suffix.lower().removeprefix(".")
    drawn = io.BytesIO()
    more: dict[str, Any] = {"pil_kwargs": {"quality": _WEBP_QUALITY}} if kind == "webp" else {}
    if kind in ("pdf", "svg"):
        for image in figure.findobj(AxesImage):
            image.set_interpolation("none")
    # Journals refuse PDF's fonts of type 3, matplotlib's usual ones.
    with warnings.catch_warnings(), rc_context({"pdf.fonttype": 42}):
        warnings.simplefilter("ignore")  # a letter of some source's name that no font has
        figure.savefig(drawn, format=kind, dpi=dpi, **more)
    write_output(path, drawn.getvalue())


def _fill(axes: Axes, panel: Panel) -> None:
    """Draw a panel's image and what lies over it, without a frame."""
    height, width = panel.image.shape[:2]
    axes.imshow(panel.image, aspect="auto", interpolation="antialiased")
    if panel.overlay is not None:
        panel.overlay(axes)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.set_axis_off()


def _caption(axes: Axes, panel: Panel, each: float, tall: float, zoom: float) -> None:
    """Write a panel's caption above it; draw its colour bar, with ticks, and its note below."""
    large, small = (13, 10) if each >= 3.5 else (11.5, 9) if each >= 2.6 else (10, 8) if each >= 2.2 else (9, 7)
    axes.text(0, 1 + 0.09 / tall, _told(panel.caption), transform=axes.transAxes,
              size=large * zoom, weight="bold", color=INK)  # fmt: skip
    below: dict[str, Any] = {"transform": axes.transAxes, "size": small * zoom, "color": PALE}
    axes.text(1, -0.2 / tall, panel.note, ha="right", **below)
    if panel.scale is None:
        return
    bar = axes.inset_axes((0, -0.18 / tall, _BAR, 0.1 / tall))
    bar.imshow(panel.scale.bar[None], aspect="auto")
    bar.set_axis_off()
    for at, text in panel.scale.ticks:
        axes.text(at * _BAR, -0.34 / tall, text, ha="center" if at else "left", **below)


def _explain(figure: Figure, shown: Container[str], page_in: float, height: float, zoom: float) -> None:
    """Explain the marks that carry no scale of their own."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    node = Line2D([], [], marker="o", linestyle="", markersize=4 * zoom, color="white",
                  markeredgecolor=PALE, markeredgewidth=0.6 * zoom)  # fmt: skip
    marks = {
        "hole": (palette.UNKNOWN, Patch(color=hexadecimal(palette.HOLE))),
        "kept": ("kept triangles", Patch(color=hexadecimal(palette.REGION | 0xFF))),
        "node": ("neural-gas node", node),
    }
    told = dict(mark for name, mark in marks.items() if name in shown)
    figure.legend(
        list(told.values()), list(told), loc="lower left", ncols=3, frameon=False,
        bbox_to_anchor=(_GAP / page_in, 0.06 / height), borderpad=0, borderaxespad=0,
        fontsize=10 * zoom, labelcolor=PALE, handlelength=1.2, columnspacing=1.4,
    )  # fmt: skip


def _told(text: str) -> str:
    """A text that can be drawn: a file's name may hold line breaks, or bytes that are not UTF-8."""
    return "".join(letter if letter.isprintable() else "�" for letter in text)
