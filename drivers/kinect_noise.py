"""What a Kinect for Xbox 360 makes of an exact depth image.

The sensor compares an infrared speckle pattern with a stored one in small windows, in steps of
1/8 pixel of disparity ``d = focal * baseline / z``. Everything here happens in disparity, as it
does there:

* depth comes in steps of ``z^2 / (8 focal baseline)``: 11 mm at 2 m ("a spatial resolution of
  1 cm along the depth axis", paper, section V), 46 mm at 4 m [1]_;
* random error of `NOISE_PX`, part of it shared by neighbouring pixels because their windows
  overlap [1]_ [2]_ [3]_;
* edges are ragged: a pixel shows what lies up to a few pixels beside it [2]_ [3]_;
* no depth where the projector, 75 mm to the right, does not reach; where disparity changes too
  fast for a window (grazing surfaces, steps); where too little light returns (dark, far or
  turned away surfaces); nearer than 0.5 m; in the columns at the right that have no full window.

References
----------
.. [1] K. Khoshelham, S. O. Elberink, "Accuracy and resolution of Kinect depth data for indoor
   mapping applications", Sensors 12(2), 2012: quantisation and random error grow with z^2.
.. [2] J. T. Barron, J. Malik, "Intrinsic scene properties from a single RGB-D image", CVPR 2013,
   and A. Handa et al., "A benchmark for RGB-D visual odometry, 3D reconstruction and SLAM",
   ICRA 2014: shifted look-up, noise and rounding of disparity.
.. [3] C. V. Nguyen, S. Izadi, D. Lovell, "Modeling Kinect sensor noise for improved 3D
   reconstruction and tracking", 3DIMPVT 2012: axial and lateral error by distance and angle.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from selective_depth.drivers.frame import Camera, DepthArray

BASELINE_MM = 75.0
"""From the camera to the projector, along the image's rows."""

STEPS_PER_PX = 8
"""Disparity is told in steps of one eighth of a pixel of a 640x480 image."""

NOISE_PX = 0.05
"""Standard deviation of disparity before it is rounded, pixels of a 640x480 image."""

NEAREST_MM, FARTHEST_MM = 500, 9000
"""Depth outside is not reported; 9 m is where a perfectly white surface is lost."""

_SHARED = 0.8  # of the variance of the disparity error is common to neighbouring pixels
_CELL = 4  # pixels between the nodes of a shared field
_RAGGED_PX = 1.1  # standard deviation of the look-up's shift
_STEEPEST = 0.22  # disparity change per pixel beyond which windows do not match
_PATCHY = 0.3  # standard deviation of the light needed for a match, relative
_BORDER_PX = 8  # columns without a full window
_SHADOW_PX = 0.7  # slack of the shadow test

_DISPARITY, _SHIFT_U, _SHIFT_V, _LIGHT = range(4)  # the shared fields

# A sum of four uniform numbers has a standard deviation of sqrt(1 / 3); bilinear interpolation
# leaves (2/3)^2 of the nodes' variance on average.
_FROM_SUM = math.sqrt(3.0)
_FROM_FIELD = 1.5


def depth_steps(camera: Camera) -> npt.NDArray[np.uint16]:
    """Depth in mm of every disparity step the sensor knows; 0 = out of its range.

    Parameters
    ----------
    camera : Camera
        Its focal length is taken as that of a 640 pixel wide image, whatever its own width.

    Returns
    -------
    uint16 array of shape (n,)
        Item `k` is the depth of a disparity of ``k / STEPS_PER_PX`` pixels.
    """
    parallax = _parallax(camera)
    steps = np.arange(math.ceil(STEPS_PER_PX * parallax / NEAREST_MM) + 2)
    depth = np.rint(STEPS_PER_PX * parallax / np.maximum(steps, 1))
    return np.where((depth >= NEAREST_MM) & (depth <= FARTHEST_MM), depth, 0).astype(np.uint16)


def kinect_depth(
    nearness: npt.NDArray[np.float32],
    material: npt.NDArray[np.uint8],
    albedo: npt.NDArray[np.float32],
    camera: Camera,
    seed: int,
) -> DepthArray:
    """Depth image as a Kinect would report it.

    Parameters
    ----------
    nearness : float32 array of shape (height, width)
        Exact 1 / depth in 1/mm, 0 = nothing there.
    material : uint8 array of shape (height, width)
        Index into `albedo`.
    albedo : float32 array of shape (m,)
        Share of the projected light that a material returns, 0..1.
    camera : Camera
    seed : int
        The error is a pure function of it and of the scene.

    Returns
    -------
    uint16 array of shape (height, width)
        Millimetres, 0 = no measurement.
    """
    height, width = nearness.shape
    state = np.array([(seed * 0x9E3779B97F4A7C15 + 0x632BE59BD9B4E019) % 2**64], np.uint64)
    fields = np.empty((4, height // _CELL + 2, width // _CELL + 2), np.float32)
    strength = np.empty((height, width), np.float32)
    depth_mm = np.empty((height, width), np.uint16)
    parallax = _parallax(camera)
    light = (albedo * FARTHEST_MM**2).astype(np.float32)
    _fill_fields(fields, state)
    _match(nearness, material, light, parallax, width / 640, camera.fx, strength)
    _measure(nearness, strength, fields, parallax, depth_steps(camera), state, depth_mm)
    return depth_mm


def _parallax(camera: Camera) -> float:
    """Focal length times baseline: disparity in pixels of a 640 wide image is this over depth."""
    return camera.fx * 640 / camera.width * BASELINE_MM


@njit(cache=True, nogil=True)
def _normal(state):  # type: ignore[no-untyped-def]
    """A nearly normal number from one step of xorshift64* (Vigna 2016): four 16-bit parts."""
    x = state[0]
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    state[0] = x
    x *= np.uint64(0x2545F4914F6CDD1D)
    low = np.uint64(0xFFFF)
    total = (
        np.int64(x & low)
        + np.int64((x >> np.uint64(16)) & low)
        + np.int64((x >> np.uint64(32)) & low)
        + np.int64(x >> np.uint64(48))
    )
    return np.float32((total * (1.0 / 65536.0) - 2.0) * _FROM_SUM)


@njit(cache=True, nogil=True)
def _fill_fields(fields, state):  # type: ignore[no-untyped-def]
    for k in range(fields.shape[0]):
        for row in range(fields.shape[1]):
            for column in range(fields.shape[2]):
                fields[k, row, column] = np.float32(_FROM_FIELD) * _normal(state)


@njit(cache=True, nogil=True)
def _match(nearness, material, light, parallax, scale, focal, strength):  # type: ignore[no-untyped-def]
    """How well each pixel's window matches; 1 is the limit, 0 is hopeless."""
    height, width = nearness.shape
    border = width - math.ceil(_BORDER_PX * scale)
    for row in range(height):
        above, below = max(row - 1, 0), min(row + 1, height - 1)
        reached = np.float32(1e9)  # leftmost projector column lit so far, coming from the right
        for column in range(width - 1, -1, -1):
            q = nearness[row, column]
            disparity = np.float32(parallax) * q
            lit = np.float32(column) - disparity * np.float32(scale)
            if q == 0.0 or column >= border or lit > reached + np.float32(_SHADOW_PX):
                strength[row, column] = 0.0
                reached = min(reached, lit)
                continue
            reached = min(reached, lit)
            left, right = max(column - 1, 0), min(column + 1, width - 1)
            # The smaller of both differences: a step beside a pixel does not make it steep.
            du = min(abs(nearness[row, right] - q), abs(q - nearness[row, left]))
            dv = min(abs(nearness[below, column] - q), abs(q - nearness[above, column]))
            square = (du * du + dv * dv) / (q * q)  # of the relative slope per pixel
            steep = disparity * disparity * square / np.float32(scale * scale * _STEEPEST**2)
            facing = np.float32(1.0) / (np.float32(1.0) + square * np.float32(focal * focal))
            back = light[material[row, column]] * q * q * math.sqrt(facing)
            strength[row, column] = min(back, np.float32(1.0) / max(steep, np.float32(1e-6)))


@njit(cache=True, nogil=True)
def _measure(nearness, strength, fields, parallax, depths, state, depth_mm):  # type: ignore[no-untyped-def]
    height, width = nearness.shape
    nodes = np.empty((fields.shape[0], fields.shape[2]), np.float32)
    gain = np.float32(STEPS_PER_PX * parallax)
    shared = np.float32(STEPS_PER_PX * NOISE_PX * math.sqrt(_SHARED))
    own = np.float32(STEPS_PER_PX * NOISE_PX * math.sqrt(1.0 - _SHARED))
    half = np.float32(0.5)
    for row in range(height):
        part = np.float32(row % _CELL) / np.float32(_CELL)
        for k in range(nodes.shape[0]):
            for node in range(nodes.shape[1]):
                upper, lower = fields[k, row // _CELL, node], fields[k, row // _CELL + 1, node]
                nodes[k, node] = upper + part * (lower - upper)
        for column in range(width):
            node = column // _CELL
            share = np.float32(column % _CELL) / np.float32(_CELL)
            rest = np.float32(1.0) - share
            shift_u = rest * nodes[_SHIFT_U, node] + share * nodes[_SHIFT_U, node + 1]
            shift_v = rest * nodes[_SHIFT_V, node] + share * nodes[_SHIFT_V, node + 1]
            u = column + math.floor(np.float32(_RAGGED_PX) * shift_u + half)
            v = row + math.floor(np.float32(_RAGGED_PX) * shift_v + half)
            u, v = min(max(u, 0), width - 1), min(max(v, 0), height - 1)
            patch = rest * nodes[_LIGHT, node] + share * nodes[_LIGHT, node + 1]
            if strength[v, u] < np.float32(1.0) + np.float32(_PATCHY) * patch:
                depth_mm[row, column] = 0
                continue
            error = rest * nodes[_DISPARITY, node] + share * nodes[_DISPARITY, node + 1]
            step = math.floor(gain * nearness[v, u] + shared * error + own * _normal(state) + half)
            depth_mm[row, column] = depths[step] if 0 <= step < len(depths) else 0
