"""What the colours mean: one table for the viewer, its legend, the pictures and the clouds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
"""Picture, shape (height, width, 3), red-green-blue."""
Colourmap = Literal["viridis", "inferno", "plasma", "ice"]
"""The first three are called so in Rerun and OpenCV alike."""
_ICE = ((10, 14, 40), (26, 48, 122), (52, 122, 208), (150, 212, 242), (255, 255, 255))


@dataclass(frozen=True)
class Scale:
    """A quantity that is shown by colours, from dark to bright.

    Parameters
    ----------
    quantity : str
        What it is of.
    colormap : str
        Name of the colour map, which no other quantity has.
    limits : tuple of float
        Values at the dark and at the bright end; what lies beyond has the colour of that end.
    unit : str
        Of the limits; empty for a pure number.
    root : bool, default False
        Whether colours follow the square root of the value instead of the value.
    between : tuple of float, optional
        Values between the limits that a colour bar names too.
    steps : int, default 0
        How many colours there are, where they are few.
    """

    quantity: str
    colormap: Colourmap
    limits: tuple[float, float]
    unit: str = ""
    root: bool = False
    between: tuple[float, ...] = ()
    steps: int = 0

    @property
    def bar(self) -> Image:
        """Colours of a colour bar, shape (n, 3), dark end first."""
        return channels(round_colours(self.steps)[1:] if self.steps else palette(self.colormap))

    @property
    def ticks(self) -> list[tuple[float, str]]:
        """What a colour bar names: place from 0, the dark end, to 1, and text; the last has the unit."""
        values = (self.limits[0], *self.between, self.limits[1])
        texts = [f"{value:g}" for value in values]
        texts[-1] += f" {self.unit}" if self.unit else ""
        return list(zip(self.place(values).tolist(), texts, strict=True))

    def place(self, values: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Where values of any shape lie between the limits, 0..1 as colours go; NaN at 0."""
        low, high = self.limits
        share = np.asarray((np.asarray(values, np.float32) - np.float32(low)) * np.float32(1 / (high - low)))
        np.fmin(np.fmax(share, np.float32(0), out=share), np.float32(1), out=share)
        return np.asarray(np.sqrt(share, out=share) if self.root else share)

    def levels(self, values: npt.NDArray[np.generic]) -> npt.NDArray[np.uint8]:
        """`place` as whole numbers 1..255, in half the time; of NaN, any."""
        low, high = self.limits
        within = np.clip(np.asarray(values, np.float32), np.float32(min(low, high)), np.float32(max(low, high)))
        if self.root:
            np.sqrt(np.subtract(within, np.float32(low), out=within), out=within)
            low, high = 0.0, math.sqrt(high - low)
        scale = 254 / (high - low)
        return np.asarray(cv2.convertScaleAbs(within, alpha=scale, beta=1 - low * scale), np.uint8)

    def told(self, place: float) -> str:
        """The value at a place between the limits, 0..1 as colours go, with its unit."""
        low, high = self.limits
        return f"{low + (high - low) * (place**2 if self.root else place):.1f} {self.unit}"

    def colour(self, values: npt.ArrayLike) -> Image:
        """Colours of values of any shape, red-green-blue in one axis more; NaN is the dark end."""
        return np.asarray(channels(palette(self.colormap))[np.rint(255 * self.place(values)).astype(np.uint8)])


IMPROVEMENT = Scale("improvement", "inferno", (0.0, 1.0))
ERROR = Scale("error", "ice", (0.0, 100.0), "mm", root=True, between=(5.0, 25.0))
"""Of models as of the kriging deviation, in the viewer, in stills and in evaluations alike.

A good model is off by the sensor's noise, 1 to 5 mm, nearly everywhere and by hundreds at a
few discontinuities. On a linear scale it is black, and so is all that tells it from a better one; by the square
root the noise has the lowest fifth of the colours, and what is off by more is told apart up to 100.
"""
AGE = Scale("known, frames ago", "plasma", (25.0, 0.0))
DEPTH_COLOURMAP: Literal["viridis"] = "viridis"
ROUND_COLOURMAP: Colourmap = "plasma"
"""When something was measured: in which round, or how many frames ago; the latest is bright."""

HOLE = 0x6F7480FF
REGION = 0x26A69AA8
LONG_EDGE = 0xE6913C6E
MESH = 0x26A69AFF
NODE = 0xFFFFFFFF
FORGOTTEN = 0xD04A4AC0
"""Colours as 0xRRGGBBAA. They differ in lightness too, for colour-blind eyes."""
UNKNOWN = "no measurement near"
"""What `HOLE` means."""

BACKGROUND = (13, 13, 13)
_FACE = cv2.FontFace("sans")
_ROW, _COLUMN, _BAR = 66, 690, 280
"""Pixels of the viewer's legend: height of a row, width of a column and of a colour bar."""

STATE_COLOURS = {
    "live": 0x26A69AFF,
    "replay": 0x5C8DD6FF,
    "stalled": 0xE6B13CFF,
    "reconnecting": 0xE6913CFF,
    "lost": 0xD04A4AFF,
}
"""Each state that a sensor can be in."""

FIGURES = {
    "fps": ("frames/s", 0x009E73FF),
    "dropped_sensor": ("by the sensor", 0xE69F00FF),
    "dropped_viewer": ("by the viewer", 0xCC79A7FF),
    "quantisation_error_mm": ("nodes", 0x26A69AFF),
    "rmse_mm": ("selective", 0xE69F00FF),
    "truth_rmse_mm": ("selective/truth", 0x56B4E9FF),
    "sensor_rmse_mm": ("frame/truth", 0xCC79A7FF),
    "even_rmse_mm": ("even lattice", 0x999999FF),
    "measured_percent": ("this frame", 0x56B4E9FF),
    "known_percent": ("known in all", 0x26A69AFF),
}
"""Running figures of a frame: how a plot calls and colours them."""

STAGE_COLOURS = (0x999999FF, 0x56B4E9FF, 0x26A69AFF, 0xE69F00FF, 0xCC79A7FF, 0xB8A100FF, 0xD55E00FF, 0x8C6BD6FF)
"""Colours of `timing.STAGES`, after Okabe and Ito: safe for colour-blind eyes,
and to be seen on the viewer's dark background and on its light one."""


def depth_limits_mm(depth_mm: npt.NDArray[np.uint16]) -> tuple[int, int]:
    """Depth range that suits a frame, in whole half metres: near and far end, millimetres."""
    known = depth_mm[depth_mm > 0]
    if known.size == 0:
        return 500, 5000
    low, high = np.percentile(known, (1, 99))
    near = int(low // 500) * 500
    return near, max(int(-(-high // 500)) * 500, near + 500)


def round_scale(rounds: int) -> Scale:
    """The scale of the rounds in which something was measured, from 1."""
    return Scale("measured in round", ROUND_COLOURMAP, (1, rounds), steps=rounds)


def depth_scale(limits_mm: tuple[float, float]) -> Scale:
    """The scale of depth in metres: near is dark, far is bright."""
    near_mm, far_mm = limits_mm
    return Scale("depth", DEPTH_COLOURMAP, (near_mm / 1000, far_mm / 1000), "m")


def backdrop_limits_mm(limits_mm: tuple[float, float]) -> tuple[float, float]:
    """Black and white ends of the dim grey frame on which other things are drawn."""
    near, far = limits_mm
    return near - 0.3 * (far - near), far + 2.5 * (far - near)


@cache
def palette(colormap: Colourmap) -> npt.NDArray[np.uint32]:
    """The 256 colours of a colour map, packed as 0xRRGGBBAA."""
    levels = np.arange(256, dtype=np.uint8)
    if colormap == "ice":
        at = np.linspace(0, 255, len(_ICE))
        parts = [np.interp(levels, at, part).round() for part in zip(*_ICE, strict=True)]
        return packed(np.stack(parts, axis=1).astype(np.uint8))
    made = np.asarray(cv2.applyColorMap(levels, getattr(cv2, f"COLORMAP_{colormap.upper()}")), np.uint8)
    return packed(made[0, :, ::-1])


@cache
def round_colours(rounds: int) -> npt.NDArray[np.uint32]:
    """One colour per round, dark to bright; round 0, the seeds, is grey."""
    levels = np.linspace(70, 240, rounds) if rounds > 1 else np.array([170])
    ramp = palette(ROUND_COLOURMAP)[levels.astype(int)]
    return np.concatenate((np.array([HOLE], dtype=np.uint32), ramp))


def channels(packed: npt.NDArray[np.uint32] | int) -> Image:
    """Packed colours of shape (...) as red, green, blue of shape (..., 3)."""
    shift = np.array([24, 16, 8], dtype=np.uint32)
    return (np.asarray(packed, np.uint32)[..., None] >> shift).astype(np.uint8)


def packed(colours: Image) -> npt.NDArray[np.uint32]:
    """Red, green, blue of shape (..., 3) as packed colours of shape (...)."""
    red, green, blue = (colours[..., k].astype(np.uint32) for k in range(3))
    return np.asarray(red << 24 | green << 16 | blue << 8 | 255, np.uint32)


Swatch = tuple[str, int]
"""What a single colour means, and the colour."""


def picture(scales: Sequence[Scale], swatches: Sequence[Swatch], columns: int = 1) -> Image:
    """Draw a legend: every colour scale with its ticks, every single colour.

    OpenCV draws it: the first frame waits for it, and matplotlib alone takes half a second to
    import.

    Parameters
    ----------
    scales : sequence of Scale
        The scales.
    swatches : sequence of (str, int)
        The single colours.
    columns : int, default 1
        In how many columns.

    Returns
    -------
    uint8 array of shape (height, width, 3)
        Red-green-blue, on the viewer's own background.
    """
    rows = -(-(len(scales) + len(swatches)) // columns)
    image = np.full((_ROW * rows, _COLUMN * columns, 3), BACKGROUND, np.uint8)
    entries: list[Scale | Swatch] = [*scales, *swatches]
    for number, entry in enumerate(entries):
        left, base = _COLUMN * (number % columns) + 16, _ROW * (number // columns) + 36
        if not isinstance(entry, Scale):
            image[base - 22 : base + 4, left : left + 40] = channels(entry[1])
            _write(image, entry[0], left + 54, base)
            continue
        _write(image, entry.quantity, left, base)
        bar, start = entry.bar, left + 280
        image[base - 22 : base + 4, start : start + _BAR] = bar[np.arange(_BAR) * len(bar) // _BAR]
        for at, text in entry.ticks:
            _write(image, text, start + round(at * _BAR) - 6, base + 28, 22)
    return image


def key(unit: str, lines: Sequence[Swatch]) -> Image:
    """Draw the unit of a plot and what its lines are, to be shown beside the plot, where it covers no line."""
    texts = [unit, *(text for text, _ in lines)]
    width = max(180, *(cv2.getTextSize((0, 0), text, (0, 0), _FACE, 24, 400)[2] for text in texts)) + 40
    image = np.full((34 * len(texts), width, 3), BACKGROUND, np.uint8)
    _write(image, unit, 0, 25, 24)
    for row, (text, colour) in enumerate(lines, 1):
        image[34 * row + 14 : 34 * row + 20, :24] = channels(colour)
        _write(image, text, 32, 34 * row + 25, 24)
    return image


def headline(text: str) -> Image:
    """Draw a line large, to be read from afar; always of one size, as the viewer wants an entity's images to be."""
    image = np.full((72, 1720, 3), BACKGROUND, np.uint8)
    width = cv2.getTextSize((0, 0), text, (0, 0), _FACE, 44, 500)[2]
    _write(image, text, max((1720 - width) // 2, 0), 52, 44, 500)
    return image


def _write(image: Image, text: str, left: int, base: int, size: int = 28, weight: int = 400) -> None:
    cv2.putText(image, text, (left, base), (225, 225, 225), _FACE, size, weight)
