"""What the colours mean: one place for viewer, legend and their agreement."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import numpy.typing as npt

ERROR_LIMIT_MM = 100.0
"""Errors and deviations from this on share the brightest colour."""

HOLE = 0x6F7480FF
REGION = 0x26A69AA8
LONG_EDGE = 0xE6913C6E
MESH = 0x26A69AFF
NODE = 0xFFFFFFFF
"""Colours as 0xRRGGBBAA. They differ in lightness too, for colour-blind eyes."""

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

- **1 Sensor** – every pixel of the frame.
- **2 Seeds** – the lattice that is measured first: all that the selectors know.
- **3a Neural gas** – nodes settle on surfaces; triangles whose edges are short are the regions \
it selects.
- **3b Improvement** – where one more measurement would help.
- **4 Acquired** – what was measured besides, round by round.
- **5 Error** – the dense model made of all samples, against the sensor's frame.
- **In space** – cloud, camera, nodes with their triangles, new samples.
"""

FIGURES = {
    "fps": ("frames/s", 0x009E73FF),
    "dropped_sensor": ("dropped by sensor", 0xE69F00FF),
    "dropped_viewer": ("dropped by viewer", 0xCC79A7FF),
    "samples": ("samples", 0x56B4E9FF),
    "quantisation_error_mm": ("quantisation error", 0x26A69AFF),
    "rmse_mm": ("model RMSE", 0xE69F00FF),
}
"""Running figures of a step: how a plot calls and colours them."""

STAGE_COLOURS = (
    0x999999FF,
    0x56B4E9FF,
    0x26A69AFF,
    0xE69F00FF,
    0xCC79A7FF,
    0xB8A100FF,
    0xD55E00FF,
    0x8C6BD6FF,
)
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


@cache
def palette(colormap: int, count: int = 256) -> npt.NDArray[np.uint32]:
    """Colours of an OpenCV colour map, packed as 0xRRGGBBAA."""
    levels = np.linspace(0, 255, count).astype(np.uint8).reshape(-1, 1)
    bgr = np.asarray(cv2.applyColorMap(levels, colormap))[:, 0].astype(np.uint32)
    packed = bgr @ np.array([1 << 8, 1 << 16, 1 << 24], dtype=np.uint32) + np.uint32(255)
    return np.asarray(packed, dtype=np.uint32)


def picture(limits_mm: tuple[float, float], rounds: int) -> npt.NDArray[np.uint8]:
    """Draw the legend of the viewer: every colour scale with its ends, every single colour.

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
    scales = [("depth", cv2.COLORMAP_VIRIDIS, near, far)]
    scales.append(("improvement", cv2.COLORMAP_INFERNO, "none", "most"))
    if rounds:
        last = f"round {rounds}" if rounds > 1 else ""
        scales.append(("acquired in", cv2.COLORMAP_PLASMA, "round 1", last))
        limit = f"{ERROR_LIMIT_MM:.0f} mm"
        scales.append(("model error", cv2.COLORMAP_INFERNO, "0", limit))
    swatches = [
        ("no measurement, or too far from one", HOLE),
        ("kept triangles: the regions selected", REGION | 0xFF),
        ("neural-gas nodes", NODE),
    ]
    image = np.full((_ROW * (len(scales) + len(swatches)) + 20, 760, 3), BACKGROUND, np.uint8)
    for row, (name, colormap, low, high) in enumerate(scales):
        base = _ROW * row + 44
        ramp = round_colours(rounds)[1:] if name == "acquired in" else palette(colormap)
        _write(image, name, 20, base)
        end = _write(image, low, 220, base)
        colours = _channels(ramp[np.arange(240) * len(ramp) // 240])
        image[base - 22 : base + 4, max(end, 320) + 16 : max(end, 320) + 256] = colours
        _write(image, high, max(end, 320) + 272, base)
    for row, (name, colour) in enumerate(swatches):
        base = _ROW * (len(scales) + row) + 44
        image[base - 22 : base + 4, 20:64] = _channels(np.array([colour], dtype=np.uint32))
        _write(image, name, 84, base)
    return image


def _channels(packed: npt.NDArray[np.uint32]) -> npt.NDArray[np.uint8]:
    """Packed colours of shape (n,) as red, green, blue of shape (n, 3)."""
    return (packed[:, None] >> np.array([24, 16, 8], dtype=np.uint32)).astype(np.uint8)


def _write(image: npt.NDArray[np.uint8], text: str, left: int, base: int) -> int:
    face = cv2.FontFace("sans")
    (end, _), _ = cv2.putText(image, text, (left, base), (225, 225, 225), face, 28, 400)
    return int(end)


@cache
def round_colours(rounds: int) -> npt.NDArray[np.uint32]:
    """One colour per round, dark to bright; round 0, the seeds, is grey."""
    ramp = palette(cv2.COLORMAP_PLASMA)[np.linspace(70, 240, max(rounds, 1)).astype(int)]
    return np.concatenate((np.array([HOLE], dtype=np.uint32), ramp))
