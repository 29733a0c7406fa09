"""Pictures without a viewer: each panel of a frame, and the contact sheet of Fig. 5.

OpenCV 5 draws the text: it carries a scalable typeface of its own, so the sheets look alike
on every machine and need no fonts and no display.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from selective_depth.drivers.frame import DepthFrame
from selective_depth.selectors.acquire import Acquisition
from selective_depth.selectors.improvement import ImprovementSelection
from selective_depth.selectors.neural_gas import RegionSelection

Image = npt.NDArray[np.uint8]
"""Picture, shape (height, width, 3), blue-green-red."""

INK = (40, 34, 30)
PALE = (120, 112, 106)
PAPER = (255, 255, 255)
HOLE = np.array((236, 232, 230), dtype=np.uint8)
HATCH = np.array((205, 198, 194), dtype=np.uint8)
REGION = (142, 106, 16)
NODE = (30, 60, 214)
ROUND_COLOURS = cv2.applyColorMap(
    np.linspace(60, 255, 8).astype(np.uint8).reshape(-1, 1), cv2.COLORMAP_PLASMA
)[:, 0]
SHEET_WIDTH = 1600
GAP = 18
ERROR_LIMIT_MM = 100.0


@dataclass(frozen=True)
class StillRow:
    """One source of a contact sheet: what was seen and what each method made of it."""

    title: str
    frame: DepthFrame
    regions: RegionSelection
    improvement: ImprovementSelection
    acquisition: Acquisition | None = None


@dataclass(frozen=True)
class Panel:
    """A picture with its caption and, where colours carry numbers, their scale."""

    name: str
    caption: str
    image: Image
    colormap: int | None = None
    limits: tuple[str, str] = ("", "")
    note: str = ""


def depth_limits_mm(depth_mm: npt.NDArray[np.uint16]) -> tuple[int, int]:
    """Depth range that shows a frame, in whole half metres so that it is the same for a scene."""
    valid = depth_mm[depth_mm > 0]
    if valid.size == 0:
        return 500, 5000
    low, high = np.percentile(valid, (1, 99))
    near = int(low // 500) * 500
    return near, max(int(-(-high // 500)) * 500, near + 500)


def _hatched(image: Image, hole: npt.NDArray[np.bool_]) -> Image:
    """Make holes visibly holes: light diagonal hatching that no colour map contains."""
    row, column = np.indices(hole.shape)
    stripe = (row + column) % 12 < 2
    image[hole] = HOLE
    image[hole & stripe] = HATCH
    return image


def _coloured(value: npt.NDArray[np.floating], colormap: int) -> Image:
    """Colour values of 0..1."""
    grey = (np.clip(np.nan_to_num(value), 0, 1) * 255).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(grey, colormap), dtype=np.uint8)


def _backdrop(frame: DepthFrame) -> Image:
    """The frame in pale grey, to draw on."""
    near, far = depth_limits_mm(frame.depth_mm)
    grey = 250 - 90 * np.clip((frame.depth_mm.astype(np.float32) - near) / (far - near), 0, 1)
    image = np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2)
    return _hatched(image, frame.depth_mm == 0)


def _scale_note(frame: DepthFrame) -> str:
    """How much scene the panel's scale bar, a quarter of its width, covers at median depth."""
    valid = frame.depth_mm[frame.depth_mm > 0]
    if valid.size == 0:
        return ""
    median_mm = float(np.median(valid))
    bar_mm = frame.camera.width / 4 * median_mm / frame.camera.fx
    return f"{bar_mm / 1000:.2f} m at {median_mm / 1000:.2f} m"


def depth_panel(frame: DepthFrame) -> Panel:
    """What the sensor sees."""
    near, far = depth_limits_mm(frame.depth_mm)
    value = 1 - (frame.depth_mm.astype(np.float32) - near) / (far - near)
    image = _hatched(_coloured(value, cv2.COLORMAP_VIRIDIS), frame.depth_mm == 0)
    return Panel(
        "depth",
        "Depth",
        image,
        cv2.COLORMAP_VIRIDIS,
        (f"{far / 1000:.1f} m", f"{near / 1000:.1f} m"),
        _scale_note(frame),
    )


def regions_panel(frame: DepthFrame, regions: RegionSelection) -> Panel:
    """The neural gas's nodes and the triangles that the published rule keeps."""
    image = _backdrop(frame)
    tint = image.copy()
    tint[regions.mask] = REGION
    image = np.asarray(cv2.addWeighted(tint, 0.55, image, 0.45, 0), dtype=np.uint8)
    shift = 4  # OpenCV draws at 1/16 pixel
    corners = np.round(regions.nodes_uv[regions.triangles[regions.kept]] * 2**shift)
    cv2.polylines(image, list(corners.astype(np.int32)), True, REGION, 1, cv2.LINE_AA, shift)
    for u, v in np.round(regions.nodes_uv * 2**shift).astype(int):
        cv2.circle(image, (int(u), int(v)), 20, NODE, -1, cv2.LINE_AA, shift)
    share = float(regions.mask.mean())
    return Panel(
        "neural-gas",
        "Neural gas regions",
        image,
        note=f"{len(regions.nodes_uv):,} nodes, {share:.0%} kept",
    )


def improvement_panel(improvement: ImprovementSelection) -> Panel:
    """The improvement map; hatched where no sample is near enough to say anything."""
    image = _coloured(improvement.score, cv2.COLORMAP_INFERNO)
    image = _hatched(image, ~improvement.known)
    return Panel(
        "improvement",
        "Improvement map",
        image,
        cv2.COLORMAP_INFERNO,
        ("0", "1"),
        "eq. (23)",
    )


def samples_panel(frame: DepthFrame, acquisition: Acquisition) -> Panel:
    """Where the budget went, by round."""
    image = _backdrop(frame)
    taken = acquisition.round > 0
    rounds = int(acquisition.round.max(initial=0))
    u, v = acquisition.uv[taken].T
    steps = np.linspace(0, len(ROUND_COLOURS) - 1, max(rounds, 1)).astype(int)
    image[v, u] = ROUND_COLOURS[steps[acquisition.round[taken].astype(int) - 1]]
    share = float(taken.sum()) / frame.depth_mm.size
    return Panel(
        "acquired",
        f"Acquired: {share:.1%} more pixels",
        image,
        cv2.COLORMAP_PLASMA,
        ("round 1", f"round {rounds}"),
    )


def error_panel(frame: DepthFrame, acquisition: Acquisition) -> Panel:
    """How far the model made of all samples is from the full frame."""
    model = acquisition.reconstruct()
    hole = frame.depth_mm == 0
    error = np.abs(model - frame.depth_mm.astype(np.float32))
    image = _hatched(_coloured(error / ERROR_LIMIT_MM, cv2.COLORMAP_INFERNO), hole)
    rmse = float(np.sqrt(np.mean(np.square(error[~hole])))) if (~hole).any() else 0.0
    return Panel(
        "error",
        "Model error",
        image,
        cv2.COLORMAP_INFERNO,
        ("0 mm", f"{ERROR_LIMIT_MM:.0f} mm"),
        f"RMSE {rmse:.1f} mm",
    )


def panels(row: StillRow) -> list[Panel]:
    """Every panel of one source, left to right."""
    shown = [
        depth_panel(row.frame),
        regions_panel(row.frame, row.regions),
        improvement_panel(row.improvement),
    ]
    if row.acquisition is not None:
        shown.append(samples_panel(row.frame, row.acquisition))
        shown.append(error_panel(row.frame, row.acquisition))
    return shown


def write_text(
    image: Image,
    text: str,
    left: int,
    baseline: int,
    size: int,
    *,
    weight: int = 400,
    colour: tuple[int, int, int] = INK,
) -> int:
    """Draw text in place and return the column where it ends."""
    # A name of bytes that are no UTF-8 would crash OpenCV.
    text = text.encode("utf-8", "replace").decode()
    (end, _), _ = cv2.putText(
        image, text, (left, baseline), colour, cv2.FontFace("sans"), size, weight
    )
    return int(end)


def text_width(text: str, size: int, weight: int = 400) -> int:
    """Width that `write_text` takes, in pixels."""
    scratch = np.zeros((size * 2, 8 + size * len(text), 3), dtype=np.uint8)
    return write_text(scratch, text, 0, size, size, weight=weight)


def finished(panel: Panel, width: int) -> Image:
    """A panel with caption above and scale below, `width` pixels wide."""
    height = round(panel.image.shape[0] * width / panel.image.shape[1])
    shrink = width < panel.image.shape[1]
    picture = cv2.resize(
        panel.image,
        (width, height),
        interpolation=cv2.INTER_AREA if shrink else cv2.INTER_NEAREST,
    )
    head, foot = 34, 34
    out = np.full((head + height + foot, width, 3), PAPER, dtype=np.uint8)
    out[head : head + height] = picture
    wide = width >= 420
    small = 15 if wide else 13
    write_text(out, panel.caption, 0, 23, 19 if wide else 16, weight=600)
    base = head + height + 23
    left = 0
    if panel.colormap is not None:
        length = min(110, width // 5)
        left = write_text(out, panel.limits[0], 0, base, small, colour=PALE) + 7
        ramp = np.linspace(0, 255, length).astype(np.uint8)[None, :].repeat(10, axis=0)
        out[base - 10 : base, left : left + length] = cv2.applyColorMap(ramp, panel.colormap)
        left = write_text(out, panel.limits[1], left + length + 7, base, small, colour=PALE) + 8
    if panel.note:
        right = width - text_width(panel.note, small) - 2
        if right > left:
            write_text(out, panel.note, right, base, small, colour=PALE)
            if panel.name == "depth":
                cv2.line(out, (width - width // 4, base + 7), (width - 1, base + 7), INK, 2)
    return out


def contact_sheet(rows: Sequence[StillRow], width: int = SHEET_WIDTH) -> Image:
    """All sources under each other, like Fig. 5 of the paper.

    Parameters
    ----------
    rows : sequence of StillRow
        At least one.
    width : int, default 1600
        Width of the sheet in pixels.

    Returns
    -------
    uint8 array of shape (height, width, 3)
        Blue-green-red, ready for `write_picture`.
    """
    strips = []
    for row in rows:
        shown = panels(row)
        each = (width - GAP * (len(shown) + 1)) // len(shown)
        title = np.full((46, width, 3), PAPER, dtype=np.uint8)
        write_text(title, row.title, GAP, 33, 25, weight=700)
        images = [finished(panel, each) for panel in shown]
        strip = np.full((images[0].shape[0], width, 3), PAPER, dtype=np.uint8)
        for place, image in enumerate(images):
            left = GAP + place * (each + GAP)
            strip[: image.shape[0], left : left + each] = image
        strips += [title, strip]
    legend = np.full((40, width, 3), PAPER, dtype=np.uint8)
    _legend(legend)
    return np.vstack([*strips, legend])


def _legend(strip: Image) -> None:
    """Explain the marks that carry no scale of their own."""
    swatch = np.zeros((16, 26), dtype=bool)
    strip[12:28, GAP : GAP + 26] = _hatched(np.zeros((16, 26, 3), np.uint8), ~swatch)
    left = write_text(strip, "no measurement, or too far from one", GAP + 34, 26, 15, colour=PALE)
    cv2.rectangle(strip, (left + 28, 12), (left + 54, 27), REGION, -1)
    left = write_text(strip, "kept triangles (edges ≤ mean)", left + 62, 26, 15, colour=PALE)
    cv2.circle(strip, (left + 36, 20), 4, NODE, -1, cv2.LINE_AA)
    write_text(strip, "neural-gas node", left + 48, 26, 15, colour=PALE)
