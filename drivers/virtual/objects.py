"""An object from a PLY file, as a depth sensor in front of one of its sides would see it."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from selective_depth.drivers.errors import SourceEndedError, SourceNotFoundError
from selective_depth.drivers.frame import Camera, DepthArray, DepthFrame, millimetres
from selective_depth.drivers.kernels import njit
from selective_depth.drivers.options import Options, parted
from selective_depth.drivers.source import DepthSource
from selective_depth.drivers.virtual.ply import Mesh, read_ply

OBJECT_MM = 1500.0
"""Longest side of every object's bounding box, mm, whatever its own unit.

So that depth in whole millimetres is fine enough for any object (one part in 1,500), and the
object stands about 2 m away, as the scenes of the paper do.
"""

_SMALLEST = 1e-100  # extent of an object; below, it is one point
_MARGIN = 0.02  # share of the frame left free on each side
_NEAREST_MM = 100.0  # no part of the object comes closer to the camera than this

# Rows: where right, down and forward of the viewer point in the object's axes, with y up and
# its front towards +z, as the Stanford models stand.
SIDES = {
    "front": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "back": ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
    "left": ((0, 0, 1), (0, -1, 0), (1, 0, 0)),
    "right": ((0, 0, -1), (0, -1, 0), (-1, 0, 0)),
    "top": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "bottom": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}
"""The sides an object can be seen from; left is the one towards -x."""


class MeshSource(DepthSource):
    """One frame, or a few alike, of an object seen from a chosen side.

    Parameters
    ----------
    uri : str
        Path of a .ply file; options after ``?``, with ``&`` between:
        ``side=front`` (front, back, left, right, top, bottom; y is up, the front towards +z);
        ``size=640x480``, the largest frame;
        ``focal=585``, focal length in pixels of a 640 pixel wide frame: the longer, the farther
        the object stands and the more parallel it is seen;
        ``fit=object`` cuts the frame to the object's bounding box, so that a seed lattice lies
        over the object as in Fig. 1 of the paper; ``fit=frame`` keeps the whole frame;
        ``splat=0``, half width in pixels of the square that a point of a file without faces
        covers; 0 chooses it from the points' density;
        ``frames=1``, how often the frame is delivered.

    Raises
    ------
    SourceNotFoundError
        If there is no such file, it is not a PLY file, or an option is unknown.
    DamagedRecordingError
        If the file is damaged.
    """

    def __init__(self, uri: str) -> None:
        name, text = parted(uri)
        options = Options(text, f"'{name}'")
        side = options.choice("side", "front", tuple(SIDES))
        width, height = options.size("size", (640, 480))
        focal = options.number("focal", 585.0, 100.0, 10_000.0) * width / 640
        fit = options.choice("fit", "object", ("object", "frame"))
        splat = options.integer("splat", 0, 0, 64)
        self.frame_count: int = options.integer("frames", 1, 1, 1_000_000)
        options.done()
        self.uri = uri
        self.fps = 30.0
        camera = Camera(width, height, focal, focal, width / 2, height / 2)
        points_mm, triangles = place(read_ply(Path(name)), side, camera)
        depth_mm = render(points_mm, triangles, camera, splat)
        if not depth_mm.any():
            raise SourceNotFoundError(f"nothing of '{name}' is seen from its {side} side; try another side")
        if fit == "object":
            depth_mm, camera = cut_to_object(depth_mm, camera)
        self.camera = camera
        self._depth_mm = depth_mm
        self._next = 0

    def read(self, timeout_s: float = 5.0) -> DepthFrame:
        """Return the object's frame, again and again until `frames` are delivered."""
        if self._next >= self.frame_count:
            raise SourceEndedError(f"all {self.frame_count} frames of {self.uri} are delivered")
        index = self._next
        self._next += 1
        time_us = round(index * 1e6 / self.fps)
        return DepthFrame(self._depth_mm, index, time_us, self.camera, self.uri)

    def close(self) -> None:
        """Nothing is held open; no frame follows."""
        self._next = self.frame_count


def place(mesh: Mesh, side: str, camera: Camera) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]:
    """Put an object before the camera, as near as the frame allows.

    Parameters
    ----------
    mesh : Mesh
        The object, in any unit; it is scaled to `OBJECT_MM`.
    side : str
        One of `SIDES`.
    camera : Camera
        The camera that looks at the middle of the object's bounding box.

    Returns
    -------
    points_mm : float64 array of shape (n, 3)
        Vertices in the camera's axes (x right, y down, z forward).
    triangles : int32 array of shape (m, 3)
    """
    points = mesh.points @ np.array(SIDES[side], dtype=np.float64).T
    low, high = points.min(axis=0), points.max(axis=0)
    extent = float((high - low).max())
    # Centred before it is scaled: a file far from its own origin must not lose its digits.
    points = (points - (low + high) / 2) * (OBJECT_MM / extent if extent > _SMALLEST else 1.0)
    half = (1 - 2 * _MARGIN) / 2 * np.array((camera.width / camera.fx, camera.height / camera.fy))
    reach = (np.abs(points[:, :2]) / half).max(axis=1)
    distance = max(float((reach - points[:, 2]).max()), _NEAREST_MM - float(points[:, 2].min()))
    points[:, 2] += distance
    return points, mesh.triangles


def render(
    points_mm: npt.NDArray[np.float64], triangles: npt.NDArray[np.int32], camera: Camera, splat: int = 0
) -> DepthArray:
    """Depth image of triangles, or of bare points where there are none.

    Parameters
    ----------
    points_mm : float64 array of shape (n, 3)
        Vertices in the camera's axes, all before it (z > 0).
    triangles : int32 array of shape (m, 3)
        Both faces of a triangle are seen.
    camera : Camera
    splat : int, default 0
        Half width of a point's square in pixels; 0: from the density of the points.

    Returns
    -------
    uint16 array of shape (height, width)
        Millimetres, 0 where there is nothing.
    """
    nearness = np.zeros((camera.height, camera.width))
    inverse = 1.0 / points_mm[:, 2]
    u = points_mm[:, 0] * inverse * camera.fx + camera.cx
    v = points_mm[:, 1] * inverse * camera.fy + camera.cy
    if len(triangles):
        _fill_triangles(u, v, inverse, triangles, nearness)
    else:
        _fill_points(u, v, inverse, splat or _splat_for(u, v), nearness)
    with np.errstate(divide="ignore"):
        return millimetres(1.0 / nearness, 1000.0)


def cut_to_object(depth_mm: DepthArray, camera: Camera) -> tuple[DepthArray, Camera]:
    """Smallest part of a frame that holds all its depth, and the camera of that part."""
    left, top, width, height = cv2.boundingRect((depth_mm > 0).astype(np.uint8))
    part = np.ascontiguousarray(depth_mm[top : top + height, left : left + width])
    return part, Camera(width, height, camera.fx, camera.fy, camera.cx - left, camera.cy - top)


def _splat_for(u: npt.NDArray[np.float64], v: npt.NDArray[np.float64]) -> int:
    # A surface seen from outside shows about half its points, over about half its box: the
    # mean spacing is sqrt(area / n), and a square of that half width closes most gaps.
    area = float((np.ptp(u) + 1) * (np.ptp(v) + 1))
    return min(max(math.ceil(math.sqrt(area / len(u))), 1), 64)


@njit(cache=True, nogil=True)
def _fill_triangles(u, v, inverse, triangles, nearness):  # type: ignore[no-untyped-def]
    """Z-buffer over 1/z, which is linear across the image of a triangle."""
    height, width = nearness.shape
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        area = (u[b] - u[a]) * (v[c] - v[a]) - (u[c] - u[a]) * (v[b] - v[a])
        if area == 0.0:
            continue
        first_row = max(math.ceil(min(v[a], v[b], v[c])), 0)
        last_row = min(math.floor(max(v[a], v[b], v[c])), height - 1)
        first_column = max(math.ceil(min(u[a], u[b], u[c])), 0)
        last_column = min(math.floor(max(u[a], u[b], u[c])), width - 1)
        for row in range(first_row, last_row + 1):
            for column in range(first_column, last_column + 1):
                # Barycentric weights; a pixel on an edge belongs to both its triangles.
                wb = ((column - u[a]) * (v[c] - v[a]) - (u[c] - u[a]) * (row - v[a])) / area
                wc = ((u[b] - u[a]) * (row - v[a]) - (column - u[a]) * (v[b] - v[a])) / area
                if wb >= 0.0 and wc >= 0.0 and wb + wc <= 1.0:
                    near = inverse[a] + wb * (inverse[b] - inverse[a]) + wc * (inverse[c] - inverse[a])
                    if near > nearness[row, column]:
                        nearness[row, column] = near


@njit(cache=True, nogil=True)
def _fill_points(u, v, inverse, splat, nearness):  # type: ignore[no-untyped-def]
    """Z-buffer of one square of pixels per point."""
    height, width = nearness.shape
    for i in range(len(u)):
        middle_row, middle_column = round(v[i]), round(u[i])
        for row in range(max(middle_row - splat, 0), min(middle_row + splat + 1, height)):
            for column in range(max(middle_column - splat, 0), min(middle_column + splat + 1, width)):
                nearness[row, column] = max(nearness[row, column], inverse[i])
