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
  fast for a window (grazing surfaces); where too little light returns (dark, far or turned away
  surfaces), in patches; nearer than 0.5 m; in the columns at the right that have no full window.
  Holes narrower than three pixels do not occur.

The sizes of the errors and of their likeness between neighbours were set beside frames of a real
Kinect; a test compares them.

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

import cv2
import numpy as np
import numpy.typing as npt

from selective_depth.drivers.frame import Camera, DepthArray
from selective_depth.drivers.kernels import njit

BASELINE_MM = 75.0
"""From the camera to the projector, along the image's rows."""

STEPS_PER_PX = 8
"""Disparity is told in steps of one eighth of a pixel of a 640x480 image."""

NOISE_PX = 0.055
"""Standard deviation of disparity before it is rounded, pixels of a 640x480 image."""

NEAREST_MM, FARTHEST_MM = 500, 9000
"""Depth outside is not reported; 9 m is where a perfectly white surface is lost."""

_SHARED = 0.8  # of the variance of the disparity error is common to neighbouring pixels
_ERROR_CELL = 5  # pixels between the nodes of the shared error
_WOBBLE_CELL = 8  # the same of the outlines' wobble and of patches that return less light
_RAGGED_PX = 0.85  # standard deviation of the wobble
_PATCHY = 0.3  # standard deviation of the light needed for a match, relative
_STEEPEST = 0.22  # disparity change per pixel beyond which windows do not match
_BORDER_PX = 8  # columns without a full window
_SHADOW_PX = 0.7  # slack of the shadow test

_SHIFT_U, _SHIFT_V, _LIGHT = range(3)  # the fields of wobble

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
    fixed_seed: int | None = None,
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
    fixed_seed : int, optional
        Of a part of the error, half of its variance, that thus stays in place while `seed` changes:
        a real sensor's lens and pattern do not change from frame to frame.

    Returns
    -------
    uint16 array of shape (height, width)
        Millimetres, 0 = no measurement.
    """
    height, width = nearness.shape
    state = _state_of(seed)
    error = _field(1, _ERROR_CELL, height, width, state)
    wobble = _field(3, _WOBBLE_CELL, height, width, state)
    if fixed_seed is not None:
        fixed = _state_of(fixed_seed)
        half = np.float32(math.sqrt(0.5))
        error = half * (error + _field(1, _ERROR_CELL, height, width, fixed))
        wobble = half * (wobble + _field(3, _WOBBLE_CELL, height, width, fixed))
    strength = np.empty((height, width), np.float32)
    depth_mm = np.empty((height, width), np.uint16)
    parallax = _parallax(camera)
    light = (albedo * FARTHEST_MM**2).astype(np.float32)
    _match(nearness, material, light, parallax, width / 640, camera.fx, strength)
    # A window is wider than that: a gap of less than three pixels does not stop it from matching.
    matched = cv2.morphologyEx(strength, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    _measure(nearness, matched, error, wobble, parallax, depth_steps(camera), state, depth_mm)
    depth_mm[:, width - math.ceil(_BORDER_PX * width / 640) :] = 0
    return depth_mm


def _state_of(seed: int) -> npt.NDArray[np.uint64]:
    """First state of the random numbers, never 0."""
    return np.array([(seed * 0x9E3779B97F4A7C15 + 0x632BE59BD9B4E019) % 2**64 or 1], np.uint64)


def _parallax(camera: Camera) -> float:
    """Focal length times baseline: disparity in pixels of a 640 wide image is this over depth."""
    return camera.fx * 640 / camera.width * BASELINE_MM


@njit(cache=True, nogil=True)
def _next(x):  # type: ignore[no-untyped-def]
    """One step of xorshift64 (Marsaglia 2003)."""
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    return x ^ (x >> np.uint64(27))


@njit(cache=True, nogil=True)
def _normal(x):  # type: ignore[no-untyped-def]
    """A nearly normal number: the sum of the four 16-bit parts of a state of xorshift64*."""
    x *= np.uint64(0x2545F4914F6CDD1D)
    # Two by two, side by side in one word: 17 bits hold a sum of two.
    pairs = (x & np.uint64(0x0000FFFF0000FFFF)) + ((x >> np.uint64(16)) & np.uint64(0x0000FFFF0000FFFF))
    total = np.int32((pairs & np.uint64(0xFFFFFFFF)) + (pairs >> np.uint64(32)))
    return np.float32(total) * np.float32(_FROM_SUM / 65536.0) - np.float32(2.0 * _FROM_SUM)


@njit(cache=True, nogil=True)
def _field(count, cell, height, width, state):  # type: ignore[no-untyped-def]
    """Nodes of smooth random fields of unit variance, `cell` pixels apart."""
    x = state[0]
    nodes = np.empty((count, height // cell + 2, width // cell + 2), np.float32)
    for k in range(count):
        for row in range(nodes.shape[1]):
            for column in range(nodes.shape[2]):
                x = _next(x)
                nodes[k, row, column] = np.float32(_FROM_FIELD) * _normal(x)
    state[0] = x
    return nodes


@njit(cache=True, nogil=True)
def _line(nodes, cell, row, line):  # type: ignore[no-untyped-def]
    """One image row of a field."""
    part = np.float32(row % cell) / np.float32(cell)
    upper, lower = nodes[row // cell], nodes[row // cell + 1]
    for node in range(len(upper) - 1):
        here = upper[node] + part * (lower[node] - upper[node])
        there = upper[node + 1] + part * (lower[node + 1] - upper[node + 1])
        step = (there - here) / np.float32(cell)
        for k in range(min(cell, len(line) - node * cell)):
            line[node * cell + k] = here + step * np.float32(k)


@njit(cache=True, nogil=True)
def _match(nearness, material, light, parallax, scale, focal, strength):  # type: ignore[no-untyped-def]
    """How well each pixel's window matches; 1 is the limit, 0 is hopeless."""
    height, width = nearness.shape
    steepness = np.float32((parallax / (scale * _STEEPEST)) ** 2)
    lens = np.float32(focal * focal)
    per_q = np.float32(parallax * scale)
    one, tiny = np.float32(1.0), np.float32(1e-12)
    for row in range(height):
        line, out = nearness[row], strength[row]
        above, below = nearness[max(row - 1, 0)], nearness[min(row + 1, height - 1)]
        for column in range(1, width - 1):
            q = line[column]
            # The smaller of both differences: a step beside a pixel does not make it steep.
            du = min(abs(line[column + 1] - q), abs(q - line[column - 1]))
            dv = min(abs(below[column] - q), abs(q - above[column]))
            slope = du * du + dv * dv
            square = q * q
            # A surface turned away by an angle a returns cos(a) of the light.
            cosine = math.sqrt(square / (square + slope * lens + tiny))
            back = light[material[row, column]] * square * cosine
            out[column] = min(back, one / (slope * steepness + tiny))
        out[0], out[width - 1] = out[1], out[width - 2]
        # The projector stands to the right: what lies left of a nearer surface is in its shadow.
        lit = np.float32(width)
        for column in range(width - 1, -1, -1):
            place = np.float32(column) - per_q * line[column]
            if place > lit + np.float32(_SHADOW_PX):
                out[column] = 0.0
            lit = min(lit, place)


@njit(cache=True, nogil=True)
def _measure(nearness, strength, error, wobble, parallax, depths, state, depth_mm):  # type: ignore[no-untyped-def]
    height, width = nearness.shape
    gain = np.float32(STEPS_PER_PX * parallax)
    shared = np.float32(STEPS_PER_PX * NOISE_PX * math.sqrt(_SHARED))
    own = np.float32(STEPS_PER_PX * NOISE_PX * math.sqrt(1.0 - _SHARED))
    ragged, patchy = np.float32(_RAGGED_PX), np.float32(_PATCHY)
    one = np.float32(1.0)
    errors = np.empty(width, np.float32)
    wobbles = np.empty((3, width), np.float32)
    x = state[0]
    for row in range(height):
        _line(error[0], _ERROR_CELL, row, errors)
        for k in range(3):
            _line(wobble[k], _WOBBLE_CELL, row, wobbles[k])
        for column in range(width):
            x = _next(x)
            noise = _normal(x)
            # A quarter pixel of the pixel's own noise breaks the smooth outline up.
            shift_u = ragged * wobbles[_SHIFT_U, column] + np.float32(0.25) * noise
            shift_v = ragged * wobbles[_SHIFT_V, column] + np.float32(0.25) * noise
            u = min(max(column + _round(shift_u), 0), width - 1)
            v = min(max(row + _round(shift_v), 0), height - 1)
            step = _round(gain * nearness[v, u] + shared * errors[column] + own * noise)
            seen = strength[v, u] >= one + patchy * wobbles[_LIGHT, u] and 0 <= step < len(depths)
            depth_mm[row, column] = depths[step] if seen else 0


@njit(cache=True, nogil=True)
def _round(number):  # type: ignore[no-untyped-def]
    # Truncation of a positive number is one instruction, floor is a call.
    return np.int32(number + np.float32(1024.5)) - np.int32(1024)
