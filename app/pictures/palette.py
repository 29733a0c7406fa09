"""What the colours mean: one table for the viewer, its legend, the pictures and the clouds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
"""Picture, shape (height, width, 3), red-green-blue."""
Colourmap = Literal["viridis", "inferno", "plasma"]
"""Called so in Rerun and OpenCV alike."""


@dataclass(frozen=True)
class Scale:
    """A quantity that is shown by colours, linearly from dark to bright.

    Parameters
    ----------
    quantity : str
        What it is of.
    colormap : str
        Name of the colour map.
    limits : tuple of float
        Values at the dark and at the bright end; what lies beyond has the colour of the end.
    unit : str
        Of the limits; empty for a pure number.
    """

    quantity: str
    colormap: Colourmap
    limits: tuple[float, float]
    unit: str = ""

    def colour(self, values: npt.NDArray[np.generic]) -> Image:
        """Colours of values of any shape, red-green-blue in one axis more; NaN is the dark end."""
        low, high = self.limits
        level = np.clip(np.rint((np.nan_to_num(values, nan=low) - low) * (255 / (high - low))), 0, 255)
        return np.asarray(channels(palette(self.colormap))[level.astype(np.uint8)])


IMPROVEMENT = Scale("improvement", "inferno", (0.0, 1.0))
ERROR = Scale("model error", "inferno", (0.0, 100.0), "mm")
"""Of the model as of the kriging deviation; larger errors share the brightest colour."""
DEPTH_COLOURMAP: Colourmap = "viridis"
ROUND_COLOURMAP: Colourmap = "plasma"
AGE_COLOURMAP: Colourmap = "inferno"

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
_ROW = 46

STATE_COLOURS = {
    "live": 0x26A69AFF,
    "replay": 0x5C8DD6FF,
    "stalled": 0xE6B13CFF,
    "reconnecting": 0xE6913CFF,
    "lost": 0xD04A4AFF,
}
"""Each state that a sensor can be in."""

HOW_TO_READ = """\
From left to right: measured → wanted → acquired → known.

- **Scene** – what a colour camera sees, where there is one.
- **1 Sensor** – every pixel of the frame.
- **2 Seeds** – the lattice that is measured first: all that the selectors know.
- **3a Neural gas** – nodes settle on surfaces; triangles whose edges are short are the regions \
it selects.
- **3b Improvement** – where one more measurement would help.
- **4 Acquired** – what was measured besides, round by round.
- **4 Known** – with a memory: all that is known, bright where just measured; red where forgotten.
- **5 Error** – the dense model made of all samples, against the sensor's frame.
- **In space** – cloud, camera, nodes with their triangles, new samples.
"""

FIGURES = {
    "fps": ("frames/s", 0x009E73FF),
    "dropped_sensor": ("dropped by sensor", 0xE69F00FF),
    "dropped_viewer": ("dropped by viewer", 0xCC79A7FF),
    "samples": ("samples", 0x56B4E9FF),
    "quantisation_error_mm": ("quantisation error", 0x26A69AFF),
    "rmse_mm": ("model to the frame", 0xE69F00FF),
    "truth_rmse_mm": ("model to the truth", 0x56B4E9FF),
    "sensor_rmse_mm": ("frame to the truth", 0xCC79A7FF),
    "even_rmse_mm": ("even lattice", 0x999999FF),
    "measured_percent": ("measured in this frame", 0x56B4E9FF),
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
    number = getattr(cv2, f"COLORMAP_{colormap.upper()}")
    levels = np.arange(256, dtype=np.uint8).reshape(-1, 1)
    bgr = np.asarray(cv2.applyColorMap(levels, number))[:, 0].astype(np.uint32)
    packed = bgr @ np.array([1 << 8, 1 << 16, 1 << 24], dtype=np.uint32) + np.uint32(255)
    return np.asarray(packed, dtype=np.uint32)


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


def picture(limits_mm: tuple[float, float], rounds: int) -> Image:
    """Draw the legend of the viewer: every colour scale with its ends, every single colour.

    OpenCV draws it: the first frame waits for it, and matplotlib alone takes half a second to
    import.

    Parameters
    ----------
    limits_mm : tuple of float
        Depth at the two ends of the depth scale.
    rounds : int
        Rounds of acquisition; 0 leaves samples and error out.

    Returns
    -------
    uint8 array of shape (height, width, 3)
        Red-green-blue, on the viewer's own background.
    """
    near, far = (f"{limit / 1000:.1f} m" for limit in limits_mm)
    ramps = [("depth", palette(DEPTH_COLOURMAP), near, far)]
    ramps.append((IMPROVEMENT.quantity, palette(IMPROVEMENT.colormap), "none", "most"))
    if rounds:
        last = f"round {rounds}" if rounds > 1 else ""
        ramps.append(("acquired in", round_colours(rounds)[1:], "round 1", last))
        limit = f"{ERROR.limits[1]:.0f} {ERROR.unit}"
        ramps.append((ERROR.quantity, palette(ERROR.colormap), "0", limit))
    swatches = [(UNKNOWN, HOLE), ("kept triangles: the regions selected", REGION | 0xFF), ("neural-gas nodes", NODE)]
    image = np.full((_ROW * (len(ramps) + len(swatches)) + 20, 760, 3), BACKGROUND, np.uint8)
    for row, (name, ramp, low, high) in enumerate(ramps):
        base = _ROW * row + 44
        _write(image, name, 20, base)
        end = _write(image, low, 220, base)
        colours = channels(ramp[np.arange(240) * len(ramp) // 240])
        image[base - 22 : base + 4, max(end, 320) + 16 : max(end, 320) + 256] = colours
        _write(image, high, max(end, 320) + 272, base)
    for row, (name, colour) in enumerate(swatches):
        base = _ROW * (len(ramps) + row) + 44
        image[base - 22 : base + 4, 20:64] = channels(colour)
        _write(image, name, 84, base)
    return image


def _write(image: Image, text: str, left: int, base: int) -> int:
    face = cv2.FontFace("sans")
    (end, _), _ = cv2.putText(image, text, (left, base), (225, 225, 225), face, 28, 400)
    return int(end)
