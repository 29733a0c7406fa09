"""Colour of the virtual scenes: what each material looks like in the light of one lamp."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.frame import Camera, ColourArray, handed_over
from selective_depth.drivers.kernels import njit
from selective_depth.drivers.virtual.scenes import Material

_TINT = np.array([stuff.tint for stuff in Material], np.float64)
_WALL, _FLOOR, _WOOD, _SCREEN = (int(each) for each in (Material.WALL, Material.FLOOR, Material.WOOD, Material.SCREEN))
_PATTERNED = np.array([stuff in (_WALL, _FLOOR, _WOOD, _SCREEN, Material.CLOTH) for stuff in Material])
_LAMP = np.array((-0.45, -0.75, -0.49))
"""Where the light comes from, in the scene's axes: from the left, above and behind the camera."""


def paint(
    nearness: npt.NDArray[np.float32],
    material: npt.NDArray[np.uint8],
    camera: Camera,
    rotation: npt.NDArray[np.float64],
    position_mm: npt.NDArray[np.float64],
) -> ColourArray:
    """Colour image of what `renderer.cast` saw, on the same pixels.

    Parameters
    ----------
    nearness : float32 array of shape (height, width)
        1 / depth in 1/mm, 0 where there is nothing.
    material : uint8 array of shape (height, width)
    camera : Camera
    rotation, position_mm
        The camera in the scene, as `source.camera_pose` tells it.

    Returns
    -------
    uint8 array of shape (height, width, 3)
        Red-green-blue, read-only.
    """
    colour = np.empty((*nearness.shape, 3), np.uint8)
    _paint(nearness, material, camera.intrinsics, rotation, position_mm, _TINT, _PATTERNED, rotation @ _LAMP, colour)
    return handed_over(colour)


@njit(cache=True, nogil=True)
def _paint(nearness, material, lens, rotation, position_mm, tint, patterned, lamp, colour):  # type: ignore[no-untyped-def]
    fx, fy, cx, cy = lens
    height, width = nearness.shape
    for row in range(height):
        y = (row - cy) / fy
        for column in range(width):
            stuff, q = material[row, column], nearness[row, column]
            light = 1.0
            if q > 0.0:
                x = (column - cx) / fx
                # A plane's nearness is linear in the ray (x, y, 1): its slopes tell the normal.
                slope_x = fx * _slope(nearness[row, max(column - 1, 0)], q, nearness[row, min(column + 1, width - 1)])
                slope_y = fy * _slope(nearness[max(row - 1, 0), column], q, nearness[min(row + 1, height - 1), column])
                slope_z = q - x * slope_x - y * slope_y
                length = math.sqrt(slope_x * slope_x + slope_y * slope_y + slope_z * slope_z)
                facing = (slope_x * lamp[0] + slope_y * lamp[1] + slope_z * lamp[2]) / -length
                light = 0.42 + 0.6 * max(facing, 0.0)
                if patterned[stuff]:
                    z = 1.0 / q
                    across = position_mm[0] + z * (rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0])
                    down = position_mm[1] + z * (rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1])
                    away = position_mm[2] + z * (rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2])
                    light *= _pattern(stuff, across, down, away)
            for k in range(3):
                colour[row, column, k] = min(int(tint[stuff, k] * light), 255)


@njit(cache=True, nogil=True)
def _slope(before, here, after):  # type: ignore[no-untyped-def]
    """Change to the neighbour that lies on the same surface: the one that differs less."""
    left, right = here - before, after - here
    return left if abs(left) < abs(right) and left != 0.0 else right


@njit(cache=True, nogil=True)
def _pattern(stuff, x, y, z):  # type: ignore[no-untyped-def]
    """How bright a material is at a point of the scene, around 1."""
    if stuff == _WALL:  # plaster: patches, a little lighter or darker
        return 1.0 + 0.03 * (_wave(0.0013 * x + 0.0007 * z) + _wave(0.0011 * y + 0.0005 * z))
    if stuff == _FLOOR:  # tiles of 40 cm with dark joints
        u, v = x / 400.0 - math.floor(x / 400.0), z / 400.0 - math.floor(z / 400.0)
        odd = (math.floor(x / 400.0) + math.floor(z / 400.0)) % 2
        return 0.6 if min(u, v) < 0.015 else 0.94 + 0.14 * odd
    if stuff == _WOOD:  # grain along x
        return 1.0 + 0.1 * _wave(0.016 * y + 0.02 * z + 0.25 * _wave(0.001 * x))
    if stuff == _SCREEN:  # lines of writing
        line = math.floor(y / 16.0)
        word = math.floor(x / 22.0 + 3.7 * line)
        return 2.2 if y / 16.0 - line < 0.45 and _wave(0.37 * word + 0.21 * line) > -0.3 else 1.0
    # Cloth: stripes, woven.
    return 1.0 + 0.3 * _wave(0.38 * math.floor(x / 38.0)) + 0.1 * _wave(0.1 * x) * _wave(0.1 * y)


@njit(cache=True, nogil=True)
def _wave(turns):  # type: ignore[no-untyped-def]
    """From -1 to 1 and back in each turn, along parabolas: a sine for the eye, and quick."""
    part = turns - math.floor(turns) - 0.5
    return 16.0 * part * (0.5 - abs(part))
