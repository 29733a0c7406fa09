"""What the colours mean: one place for viewer, legend and their agreement."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

ERROR_LIMIT_MM = 100.0
"""Errors and deviations from this on share the brightest colour."""

HOLE = 0x6F7480FF
REGION = 0x26A69A78
LONG_EDGE = 0xE6913C6E
MESH = 0x26A69AFF
NODE = 0xFFFFFFFF
"""Colours as 0xRRGGBBAA. They differ in lightness too, for colour-blind eyes."""

STATE_COLOURS = {
    "live": 0x26A69AFF,
    "replay": 0x5C8DD6FF,
    "stalled": 0xE6B13CFF,
    "reconnecting": 0xE6913CFF,
    "lost": 0xD04A4AFF,
}
"""Each state that a sensor can be in."""

HOW_TO_READ = """\
**From left to right: measured → wanted → acquired → known.**

| | |
|---|---|
| **1 Sensor** | Every pixel, near dark to far bright. Grey: no measurement. |
| **2 Seeds** | The lattice that is measured first: all that the selectors know. |
| **3a Neural gas** | White: nodes, drawn to the surfaces. Teal: triangles whose edges are \
short, the regions it selects. |
| **3b Improvement** | Where one more measurement helps most: black nothing, yellow most. \
Grey: too far from any sample to say. |
| **4 Acquired** | What was measured besides the seeds, dark purple (first round) to yellow \
(last). |
| **5 Model, error** | All samples made dense; its distance from the sensor's own frame, \
black 0 to yellow 100 mm. |
| **In space** | The cloud, the camera, the nodes with their triangles, the new samples. |
"""


FIGURES = {
    "fps": "frames per second",
    "dropped_sensor": "frames dropped by the sensor",
    "dropped_viewer": "frames dropped by the viewer",
    "samples": "samples with depth",
    "quantisation_error_mm": "quantisation error (mm)",
    "rmse_mm": "RMSE of the model (mm)",
}
"""Running figures of a step, and how a plot calls them."""


def palette(colormap: int, count: int = 256) -> npt.NDArray[np.uint32]:
    """Colours of an OpenCV colour map, packed as 0xRRGGBBAA."""
    levels = np.linspace(0, 255, count).astype(np.uint8).reshape(-1, 1)
    bgr = np.asarray(cv2.applyColorMap(levels, colormap))[:, 0].astype(np.uint32)
    packed = bgr @ np.array([1 << 8, 1 << 16, 1 << 24], dtype=np.uint32) + np.uint32(255)
    return np.asarray(packed, dtype=np.uint32)


def round_colours(rounds: int) -> npt.NDArray[np.uint32]:
    """One colour per round, dark to bright; round 0, the seeds, is grey."""
    ramp = palette(cv2.COLORMAP_PLASMA)[np.linspace(70, 240, max(rounds, 1)).astype(int)]
    return np.concatenate((np.array([HOLE], dtype=np.uint32), ramp))
