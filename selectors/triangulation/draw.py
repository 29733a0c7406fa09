"""Drawing triangles into the model of a frame, pixel by pixel.

Each pixel of an edge is drawn by one of its two triangles, so that none is drawn twice and the
model does not depend on their order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Bools, Bytes, Floats, Ints
from selective_depth.selectors.triangulation.flips import GHOST, NEXT, Whole

STEP_MM = 50.0
"""Depth span of a triangle's vertices above which it may bridge a hole or a discontinuity, millimetres."""

BRIDGE_PX = 10.0
"""Edge length above which such a triangle does, pixels."""

_SHIFT = 4
TILE_PX = 1 << _SHIFT
"""Side of the square tiles in which changes are booked."""

_PLAIN, _BRIDGE, _OUTSIDE = 0, 1, 2
"""Kinds of triangles: linear, spanning a hole or a discontinuity, outside of the hull."""

_SURE = 1e-6


class Layers(NamedTuple):
    """What is known at every pixel, arrays of shape (height, width).

    `touched` alone has a value for every tile of `TILE_PX` pixels a side.

    Attributes
    ----------
    samples_mm : float32 array
        Depth of the sample on the pixel, 0 where none returned.
    nearest : int32 array
        Nearest sample, as ``row * width + column``; -1 where there is none at all.
    gap_sq : int32 array
        Squared distance to it in pixels.
    depth_mm : float32 array
        The model.
    plain : bool array
        Whether it is linear there, on a triangle that bridges nothing; elsewhere it is the depth of
        the nearest sample.
    spread_mm2 : float32 array
        Variance of the depths at the corners of the pixel's triangle; 0 outside the hull.
    touched : bool array of shape (rows, columns)
        Tiles in which, or beside which, a pixel may have changed since the reader cleared it.
    """

    samples_mm: Floats
    nearest: Ints
    gap_sq: Ints
    depth_mm: Floats
    plain: Bools
    spread_mm2: Floats
    touched: Bools


Points = tuple[Ints, Floats]
Triangles = tuple[Ints, Ints, Bytes]


@njit(cache=True, nogil=True, inline="always")
def touch(touched: Bools, top: Whole, left: Whole, bottom: Whole, right: Whole) -> None:
    """Book a change of pixels in these rows and columns, which their neighbours may heed."""
    rows, columns = touched.shape
    first_row, last_row = max(top - 1, 0) >> _SHIFT, min((bottom + 1) >> _SHIFT, rows - 1)
    first_column, last_column = max(left - 1, 0) >> _SHIFT, min((right + 1) >> _SHIFT, columns - 1)
    touched[first_row, first_column] = touched[first_row, last_column] = True
    touched[last_row, first_column] = touched[last_row, last_column] = True
    if last_row - first_row > 1 or last_column - first_column > 1:
        for row in range(first_row, last_row + 1):
            for column in range(first_column, last_column + 1):
                touched[row, column] = True


@njit(cache=True, nogil=True, inline="always")
def _after(uv: Ints, a: int, b: int) -> bool:
    """Whether b comes before a, row by row: what is drawn in that order is so to the last bit."""
    return bool((uv[a, 1] << 16) + uv[a, 0] > (uv[b, 1] << 16) + uv[b, 0])  # with `or`, twice as slow


@njit(cache=True, nogil=True)
def _length_sq(uv: Ints, a: int, b: int) -> int:
    """Squared length of an edge, pixels."""
    du, dv = uv[a, 0] - uv[b, 0], uv[a, 1] - uv[b, 1]
    return int(du * du + dv * dv)  # a power of whole numbers takes a quarter of a second to compile


@njit(cache=True, nogil=True)
def _bridges(uv: Ints, z_mm: Floats, a: int, b: int, c: int) -> bool:
    """Whether a triangle of three points spans a hole or a depth discontinuity."""
    if max(z_mm[a], z_mm[b], z_mm[c]) - min(z_mm[a], z_mm[b], z_mm[c]) <= STEP_MM:
        return False
    return bool(max(_length_sq(uv, a, b), _length_sq(uv, b, c), _length_sq(uv, c, a)) > BRIDGE_PX * BRIDGE_PX)


@njit(cache=True, nogil=True)
def change_within(box_px: Ints, uv: Ints, tri: Ints, changed: Bools) -> None:
    """Say that the triangles changed whose extent meets a box: columns and rows, first, last, top, bottom."""
    for t in range(len(tri)):
        a, b, c = tri[t, 0], tri[t, 1], tri[t, 2]
        if a != GHOST and b != GHOST and c != GHOST:
            changed[t] |= (
                min(uv[a, 0], uv[b, 0], uv[c, 0]) <= box_px[1]
                and max(uv[a, 0], uv[b, 0], uv[c, 0]) >= box_px[0]
                and min(uv[a, 1], uv[b, 1], uv[c, 1]) <= box_px[3]
                and max(uv[a, 1], uv[b, 1], uv[c, 1]) >= box_px[2]
            )


@njit(cache=True, nogil=True)
def change_about(other: Bools, tri: Ints, changed: Bools) -> None:
    """Say that the triangles changed of which a corner did; `other` has one more for the ghost."""
    for t in range(len(tri)):
        changed[t] |= other[tri[t, 0]] | other[tri[t, 1]] | other[tri[t, 2]]


@njit(cache=True, nogil=True)
def sort_out(changed: Bools, uv: Ints, z_mm: Floats, tri: Ints, kind: Bytes, drawn: Ints) -> int:
    """Say of what kind each changed triangle is, and list those to be drawn; their number is returned."""
    count = 0
    for t in range(len(changed)):
        if not changed[t]:
            continue
        changed[t] = False
        a, b, c = tri[t, 0], tri[t, 1], tri[t, 2]
        if a == GHOST or b == GHOST or c == GHOST:
            kind[t] = _OUTSIDE
            continue
        kind[t] = _BRIDGE if _bridges(uv, z_mm, a, b, c) else _PLAIN
        drawn[count] = t
        count += 1
    return count


@njit(cache=True, nogil=True)
def _draw_edge(
    flat: Layers, width: int, uv: Ints, z_mm: Floats, a: int, b: int, plainly: bool, spread: np.float32
) -> None:
    """Draw the pixels between two points: to the last bit the same from either side.

    `spread` is theirs too if it is not negative.
    """
    if _after(uv, a, b):
        a, b = b, a
    u, v = uv[a, 0], uv[a, 1]
    du, dv = uv[b, 0] - u, uv[b, 1] - v
    steps, rest = abs(du), abs(dv)
    while rest:
        steps, rest = rest, steps % rest
    for step in range(1, steps):
        p = (v + dv // steps * step) * width + u + du // steps * step
        linear = z_mm[a] + (z_mm[b] - z_mm[a]) * np.float64(step) / np.float64(steps)
        flat.plain[p] = plainly
        flat.depth_mm[p] = linear if plainly else flat.samples_mm[flat.nearest[p]]
        if spread >= 0:
            flat.spread_mm2[p] = spread


@njit(cache=True, nogil=True, inline="always")
def _fill(flat: Layers, width: int, uv: Ints, z_mm: Floats, a: int, b: int, c: int, bridge: bool) -> np.float32:
    """Draw a triangle's inside, its right edges, and its upper one if that is level.

    So each pixel of an edge is drawn by one of its two triangles. The variance of the corners'
    depths is returned.
    """
    if _after(uv, a, b):
        a, b = b, a
    if _after(uv, b, c):
        b, c = c, b
        if _after(uv, a, b):
            a, b = b, a
    # Now from top to bottom: a row crosses the edge ac and one of the others.
    u0, v0, u1, v1 = np.int64(uv[a, 0]), np.int64(uv[a, 1]), np.int64(uv[b, 0]), np.int64(uv[b, 1])
    u2, v2 = np.int64(uv[c, 0]), np.int64(uv[c, 1])
    area = np.float64((u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0))
    z0, z01, z02 = np.float64(z_mm[a]), np.float64(z_mm[b] - z_mm[a]), np.float64(z_mm[c] - z_mm[a])
    along, down = (z01 * (v2 - v0) - z02 * (v1 - v0)) / area, (z02 * (u1 - u0) - z01 * (u2 - u0)) / area
    mean = (z_mm[a] + z_mm[b] + z_mm[c]) / np.float32(3)
    off_a, off_b, off_c = z_mm[a] - mean, z_mm[b] - mean, z_mm[c] - mean
    spread = (off_a * off_a + off_b * off_b + off_c * off_c) / np.float32(3)
    # Crossings are whole or at least 1 / height from it: a little more, and none is cut off.
    ac, ab, bc = (u2 - u0) / (v2 - v0), (u1 - u0) / (v1 - v0), (u2 - u1) / (v2 - v1)
    samples_mm, nearest, _, depth_mm, plain, spread_mm2, _ = flat
    for v in range(v0, v2):
        long = int(u0 + (v - v0) * ac + _SURE)
        short = int(u0 + (v - v0) * ab + _SURE) if v < v1 else int(u1 + (v - v1) * bc + _SURE)
        first, end = (short, long) if area < 0 else (long, short)
        z = z0 + (v - v0) * down + (first + 1 - u0) * along
        # Unsigned, so that none is counted from the end.
        for p in range(np.uint64(v * width + first + 1), np.uint64(v * width + end + 1)):
            spread_mm2[p] = spread
            plain[p] = not bridge
            depth_mm[p] = samples_mm[nearest[p]] if bridge else z
            z += along
    return np.float32(spread)


@njit(cache=True, nogil=True)
def draw(first: int, end: int, drawn: Ints, flat: Layers, width: int, points: Points, mesh: Triangles) -> None:
    """Draw triangles into the model: those that bridge nothing linearly, the others not at all.

    `flat` are the layers, each but `touched` as one row of pixels; `points` their pixels and depths;
    `mesh` its triangles, their neighbours and kinds.

    Pixels on the edge that a bridge shares with a plain triangle are the plain one's, and a sample
    counts as plain. So whichever triangle is drawn last, the model is the same.
    """
    uv, z_mm = points
    tri, adj, kind = mesh
    for t in drawn[first:end]:
        a, b, c = tri[t, 0], tri[t, 1], tri[t, 2]
        bridge = kind[t] == _BRIDGE
        touch(
            flat.touched, min(uv[a, 1], uv[b, 1], uv[c, 1]), min(uv[a, 0], uv[b, 0], uv[c, 0]),
            max(uv[a, 1], uv[b, 1], uv[c, 1]), max(uv[a, 0], uv[b, 0], uv[c, 0]),
        )  # fmt: skip
        spread = _fill(flat, width, uv, z_mm, a, b, c, bridge)
        for k in range(3):
            other = kind[adj[t, k]]
            if other == _PLAIN and not bridge:
                continue
            begin, stop = tri[t, NEXT[k]], tri[t, NEXT[k + 1]]
            du, dv = uv[stop, 0] - uv[begin, 0], uv[stop, 1] - uv[begin, 1]
            filled = dv > 0 or (dv == 0 and du > 0)
            if other == _OUTSIDE and not filled:
                _draw_edge(flat, width, uv, z_mm, begin, stop, not bridge, spread)
            elif (other == _PLAIN and filled) or (other == _BRIDGE and not filled):
                _draw_edge(flat, width, uv, z_mm, begin, stop, not bridge or other == _PLAIN, np.float32(-1))
        for p in (a, b, c):
            at = uv[p, 1] * width + uv[p, 0]
            flat.plain[at], flat.depth_mm[at], flat.spread_mm2[at] = True, z_mm[p], 0
