"""Exact depth of quads, spheres, cylinders, discs and tori before a pinhole camera.

Everything is solved for the nearness ``q = 1 / z`` of a pixel's ray ``(x, y, 1) z``. In `q` a
plane is linear along an image row and so are the sides of a quad on it, so that a quad needs
no test per pixel at all; spheres, cylinders and discs need no division. Each shape visits only
the part of the image that its bounding box covers. A naive caster, every ray against every
shape, takes some twenty times as long on these scenes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.frame import Camera
from selective_depth.drivers.kernels import njit

QUAD, SPHERE, CYLINDER, DISC, TORUS = range(5)
"""Kinds of shape; what their vectors and sizes mean is told at `Shapes`."""

NEAREST_MM = 50.0
"""Nothing is seen closer to the camera than this."""

_TORUS_STEPS = 256
_TORUS_HIT_MM = 0.005
_TORUS_CLOSE = 0.005  # of the tube's radius: from there on one step of Newton's is exact enough


class Shapes(NamedTuple):
    """A scene, one shape per row.

    Parameters
    ----------
    kind : int64 array of shape (n,)
        QUAD: a parallelogram of perpendicular sides round `centre`, half its sides along the
        unit vectors `first` and `second`, `size` long; seen from the side to which
        ``first x second`` points.
        SPHERE: radius ``size[0]``.
        CYLINDER: the jacket round the axis `first`, radius ``size[0]``, half length
        ``size[1]``, seen from outside.
        DISC: facing along `first`, from inner radius ``size[1]`` to outer radius ``size[0]``,
        seen from both sides.
        TORUS: round the axis `first`; ``size[0]`` from the centre to the middle of the tube,
        whose radius is ``size[1]``.
    material : int64 array of shape (n,)
        Written to the image where the shape is seen.
    centre, first, second : float64 arrays of shape (n, 3)
        In mm; unit vectors.
    size : float64 array of shape (n, 2)
        In mm.
    """

    kind: npt.NDArray[np.int64]
    material: npt.NDArray[np.int64]
    centre: npt.NDArray[np.float64]
    first: npt.NDArray[np.float64]
    second: npt.NDArray[np.float64]
    size: npt.NDArray[np.float64]

    def beside(self, others: Shapes) -> Shapes:
        """These shapes and others, in the same axes."""
        return Shapes._make(np.concatenate(pair) for pair in zip(self, others, strict=True))

    def seen_from(self, rotation: npt.NDArray[np.float64], position_mm: npt.NDArray[np.float64]) -> Shapes:
        """The same shapes in a camera's axes (x right, y down, z forward).

        Parameters
        ----------
        rotation : float64 array of shape (3, 3)
            Rows: the camera's x, y and z axes in the scene's axes.
        position_mm : float64 array of shape (3,)
            The camera in the scene.
        """
        return self._replace(
            centre=(self.centre - position_mm) @ rotation.T,
            first=self.first @ rotation.T,
            second=self.second @ rotation.T,
        )


def cast(shapes: Shapes, camera: Camera) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8]]:
    """What each pixel of a camera sees of shapes in its own axes.

    Returns
    -------
    nearness : float32 array of shape (height, width)
        1 / depth in 1/mm; 0 where there is nothing. Exact to rounding, a torus' to 0.05 mm and,
        where a ray barely grazes it, 0.5 mm.
    material : uint8 array of shape (height, width)
        Of the shape that is seen; 0 where there is none.
    """
    nearness = np.zeros((camera.height, camera.width), np.float32)
    material = np.zeros((camera.height, camera.width), np.uint8)
    _cast(shapes, camera.intrinsics, nearness, material)
    return nearness, material


@njit(cache=True, nogil=True)
def _cast(shapes, lens, nearness, material):  # type: ignore[no-untyped-def]
    for i in range(len(shapes.kind)):
        kind, stuff = shapes.kind[i], np.uint8(shapes.material[i])
        centre, first, size = shapes.centre[i], shapes.first[i], shapes.size[i]
        if kind == QUAD:
            _quad(centre, first, shapes.second[i], size, stuff, lens, nearness, material)
            continue
        box = _box(kind, centre, first, size, lens, nearness.shape)
        if box[0] >= box[1] or box[2] >= box[3]:
            continue
        if kind == TORUS:
            _torus(centre, first, size, stuff, lens, box, nearness, material)
        else:
            _quadric(kind, centre, first, size, stuff, lens, box, nearness, material)


@njit(cache=True, nogil=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True)
def _box(kind, centre, axis, size, lens, shape):  # type: ignore[no-untyped-def]
    """Rows and columns (first, end, first, end) outside which the shape is not seen."""
    fx, fy, cx, cy = lens
    half = np.empty(3)
    for k in range(3):
        across = math.sqrt(max(1.0 - axis[k] * axis[k], 0.0))
        if kind == SPHERE:
            half[k] = size[0]
        elif kind == CYLINDER:
            half[k] = size[1] * abs(axis[k]) + size[0] * across
        elif kind == DISC:
            half[k] = size[0] * across
        else:
            half[k] = size[0] * across + size[1]
    near, far = centre[2] - half[2], centre[2] + half[2]
    if far <= NEAREST_MM:
        return 0, 0, 0, 0
    if near <= NEAREST_MM:
        return 0, shape[0], 0, shape[1]
    low_x, high_x = centre[0] - half[0], centre[0] + half[0]
    low_y, high_y = centre[1] - half[1], centre[1] + half[1]
    left = cx + fx * min(low_x / near, low_x / far)
    right = cx + fx * max(high_x / near, high_x / far)
    top = cy + fy * min(low_y / near, low_y / far)
    bottom = cy + fy * max(high_y / near, high_y / far)
    return (
        int(min(max(math.floor(top), 0), shape[0])),
        int(min(max(math.ceil(bottom) + 1, 0), shape[0])),
        int(min(max(math.floor(left), 0), shape[1])),
        int(min(max(math.ceil(right) + 1, 0), shape[1])),
    )


@njit(cache=True, nogil=True)
def _quad(centre, first, second, size, stuff, lens, nearness, material):  # type: ignore[no-untyped-def]
    fx, fy, cx, cy = lens
    height, width = nearness.shape
    normal = np.cross(first, second)
    offset = _dot(normal, centre)
    if offset > -1e-6:  # seen from behind, or edge on
        return
    # Six linear forms g.(x, y, 1) >= 0 of a ray bound the quad: q > 0, not too near, four sides.
    forms = np.empty((6, 3))
    for k in range(3):
        near = normal[k] / offset
        forms[0, k] = near
        forms[1, k] = -near
        forms[2, k] = near * (_dot(first, centre) + size[0]) - first[k]
        forms[3, k] = first[k] - near * (_dot(first, centre) - size[0])
        forms[4, k] = near * (_dot(second, centre) + size[1]) - second[k]
        forms[5, k] = second[k] - near * (_dot(second, centre) - size[1])
    forms[0, 2] -= 1e-9
    forms[1, 2] += 1.0 / NEAREST_MM
    for row in range(height):
        y = (row - cy) / fy
        low, high = -cx / fx, (width - 1 - cx) / fx
        for k in range(6):
            slope, rest = forms[k, 0], forms[k, 1] * y + forms[k, 2]
            if slope > 1e-15:
                low = max(low, -rest / slope)
            elif slope < -1e-15:
                high = min(high, -rest / slope)
            elif rest < 0.0:
                high = low - 1.0
        begin, end = math.ceil(low * fx + cx - 1e-9), math.floor(high * fx + cx + 1e-9) + 1
        step = normal[0] / offset / fx
        start = (normal[1] * y + normal[2]) / offset - step * cx
        near_row, material_row = nearness[row], material[row]
        for column in range(max(begin, 0), min(end, width)):
            q = np.float32(start + step * column)
            if q > near_row[column]:
                near_row[column] = q
                material_row[column] = stuff


@njit(cache=True, nogil=True)
def _quadric(kind, centre, axis, size, stuff, lens, box, nearness, material):  # type: ignore[no-untyped-def]
    """A sphere, a cylinder or a disc: in q their equations are quadratic, a disc's linear."""
    fx, fy, cx, cy = lens
    depth_of_axis = _dot(centre, axis)
    power = _dot(centre, centre) - size[0] * size[0]
    if kind == CYLINDER:
        power -= depth_of_axis * depth_of_axis
    if kind == DISC:
        if abs(depth_of_axis) < 1e-6:  # edge on
            return
    elif power <= 0.0:  # the camera is inside; of an endless cylinder, and sees an end first
        return
    for row in range(box[0], box[1]):
        y = (row - cy) / fy
        for column in range(box[2], box[3]):
            x = (column - cx) / fx
            on_axis = x * axis[0] + y * axis[1] + axis[2]
            if kind == DISC:
                q = on_axis / depth_of_axis
                dx, dy, dz = x - q * centre[0], y - q * centre[1], 1.0 - q * centre[2]
                seen = (size[1] * q) ** 2 <= dx * dx + dy * dy + dz * dz <= (size[0] * q) ** 2
            else:
                along, square = x * centre[0] + y * centre[1] + centre[2], x * x + y * y + 1.0
                if kind == CYLINDER:
                    along -= on_axis * depth_of_axis
                    square -= on_axis * on_axis
                square = along * along - power * square
                if square < 0.0:
                    continue
                q = (along + math.sqrt(square)) / power
                seen = kind == SPHERE or abs(on_axis - q * depth_of_axis) <= size[1] * q
            near = np.float32(q)
            if seen and near > nearness[row, column] and q * NEAREST_MM <= 1.0:
                nearness[row, column] = near
                material[row, column] = stuff


@njit(cache=True, nogil=True)
def _torus(centre, axis, size, stuff, lens, box, nearness, material):  # type: ignore[no-untyped-def]
    """Walk along the ray by the distance to the surface (sphere tracing, Hart 1996).

    The last, slow part of the walk is one step of Newton's where the ray meets the surface at
    more than 30 degrees.
    """
    fx, fy, cx, cy = lens
    middle, tube = size[0], size[1]
    outer, inner = middle + tube, middle - tube
    axial = _dot(centre, axis)
    from_camera = _dot(centre, centre)
    power = from_camera - outer * outer
    for row in range(box[0], box[1]):
        y = (row - cy) / fy
        for column in range(box[2], box[3]):
            x = (column - cx) / fx
            square_length = x * x + y * y + 1.0
            along = x * centre[0] + y * centre[1] + centre[2]
            if along * along <= power * square_length:
                continue
            length = math.sqrt(square_length)
            along /= length
            # The walk is confined to the bounding sphere and to the slab of the tube.
            half = math.sqrt(along * along - power)
            begin, end = along - half, along + half
            slope = (x * axis[0] + y * axis[1] + axis[2]) / length
            if abs(slope) > 1e-9:
                one, two = (axial - tube) / slope, (axial + tube) / slope
                begin, end = max(begin, min(one, two)), min(end, max(one, two))
            elif abs(axial) > tube:
                continue
            begin = max(begin, NEAREST_MM * length)
            if begin >= end or nearness[row, column] * begin >= length:
                continue
            # A ray that enters and leaves the slab inside the hole meets nothing.
            if (
                _square_from_axis(begin, along, slope, axial, from_camera) < inner * inner
                and _square_from_axis(end, along, slope, axial, from_camera) < inner * inner
            ):
                continue
            t = begin
            for _ in range(_TORUS_STEPS):
                high = t * slope - axial
                square = _square_from_axis(t, along, slope, axial, from_camera)
                rho = math.sqrt(max(square, 1e-12))
                out = rho - middle
                to_ring = math.sqrt(out * out + high * high)
                gap = to_ring - tube
                if gap < _TORUS_CLOSE * tube:
                    closing = -(out * (t - along - high * slope) / rho + high * slope) / to_ring
                    if closing > 0.5 or gap < _TORUS_HIT_MM:
                        q = np.float32(length / (t + gap / max(closing, 0.5)))
                        if q > nearness[row, column]:
                            nearness[row, column] = q
                            material[row, column] = stuff
                        break
                t += gap
                if t > end:
                    break


@njit(cache=True, nogil=True)
def _square_from_axis(t, along, slope, axial, from_camera):  # type: ignore[no-untyped-def]
    """Squared distance of a ray's point from a torus' axis."""
    high = t * slope - axial
    return t * t - 2.0 * t * along + from_camera - high * high
