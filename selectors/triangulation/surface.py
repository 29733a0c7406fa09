"""The dense model of the samples so far, kept while more come.

A round of measurements touches a small part of a frame. So the triangulation, the nearest sample
of every pixel and the model drawn from them are kept, and a batch of new samples costs what it
changes: the triangles of the new points' stars are drawn again, and the pixels that lie nearest to
a new sample are told so. The result is that of `selectors.reconstruct`, whatever the batches were.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Bools, Bytes, Floats, Ints
from selective_depth.selectors.parallel import in_bands
from selective_depth.selectors.triangulation.delaunay import Mesh
from selective_depth.selectors.triangulation.flips import GHOST, NEXT
from selective_depth.selectors.triangulation.nearest import FAR_SQ, nearest_sample

STEP_MM = 50.0
"""Depth span of a triangle's vertices above which it may bridge a hole or a step, millimetres."""

BRIDGE_PX = 10.0
"""Edge length above which such a triangle does, pixels."""

MANY_TRIANGLES = 20_000
"""From so many on, triangles are drawn by several threads."""

_SHIFT = 4
TILE_PX = 1 << _SHIFT
"""Side of the square tiles in which changes are booked."""

_PLAIN, _BRIDGE, _OUTSIDE = 0, 1, 2
"""Kinds of triangles: linear, spanning a hole or a step, outside of the hull."""

_SURE = 1e-6

Whole = int | np.int32 | np.int64


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


class Points(NamedTuple):
    """The samples as the triangulation has them: pixels (n, 2), column first, and depths (n,) in mm."""

    uv: Ints
    z_mm: Floats


@njit(cache=True, nogil=True, inline="always")
def _touch(touched: Bools, top: Whole, left: Whole, bottom: Whole, right: Whole) -> None:
    """Book a change of pixels in these rows and columns, which their neighbours may heed."""
    rows, columns = touched.shape
    first_row, last_row = max(top - 1, 0) >> _SHIFT, min((bottom + 1) >> _SHIFT, rows - 1)
    first_column, last_column = max(left - 1, 0) >> _SHIFT, min((right + 1) >> _SHIFT, columns - 1)
    touched[first_row, first_column] = touched[first_row, last_column] = True
    touched[last_row, first_column] = touched[last_row, last_column] = True
    if last_row - first_row > 1 or last_column - first_column > 1:
        touched[first_row : last_row + 1, first_column : last_column + 1] = True


@njit(cache=True, nogil=True)
def _claim(layers: Layers, uv: Ints) -> None:
    """Give every new sample the pixels that lie nearer to it than to any other.

    They form a convex region about the sample: in each row one run, which touches that of the
    row before.
    """
    gap_sq = layers.gap_sq
    height, width = gap_sq.shape
    for i in range(len(uv)):
        u0, v0 = uv[i, 0], uv[i, 1]
        name = v0 * width + u0
        z = layers.samples_mm[v0, u0]
        for direction in (-1, 1):
            left, right = u0, u0
            v = v0 if direction < 0 else v0 + 1
            while 0 <= v < height:
                dv_sq = (v - v0) * (v - v0)
                first, last = width, -1
                u = max(left - 1, 0)
                while u < width and u <= right + 1:
                    if (u - u0) * (u - u0) + dv_sq < gap_sq[v, u]:
                        first = min(first, u)
                        last = u
                    u += 1
                if last < 0:
                    break
                while first > 0 and (first - 1 - u0) ** 2 + dv_sq < layers.gap_sq[v, first - 1]:
                    first -= 1
                while last < width - 1 and (last + 1 - u0) ** 2 + dv_sq < layers.gap_sq[v, last + 1]:
                    last += 1
                for u in range(first, last + 1):
                    gap_sq[v, u] = (u - u0) * (u - u0) + dv_sq
                    layers.nearest[v, u] = name
                    if not layers.plain[v, u]:
                        layers.depth_mm[v, u] = z
                _touch(layers.touched, v, first, v, last)
                left, right = first, last
                v += direction


@njit(cache=True, nogil=True, inline="always")
def _bridges(uv: Ints, z_mm: Floats, a: int, b: int, c: int) -> bool:
    """Whether a triangle of three points spans a hole or a depth step."""
    if max(z_mm[a], z_mm[b], z_mm[c]) - min(z_mm[a], z_mm[b], z_mm[c]) <= STEP_MM:
        return False
    longest = max(
        (uv[a, 0] - uv[b, 0]) ** 2 + (uv[a, 1] - uv[b, 1]) ** 2,
        (uv[b, 0] - uv[c, 0]) ** 2 + (uv[b, 1] - uv[c, 1]) ** 2,
        (uv[c, 0] - uv[a, 0]) ** 2 + (uv[c, 1] - uv[a, 1]) ** 2,
    )
    return bool(longest > BRIDGE_PX * BRIDGE_PX)


@njit(cache=True, nogil=True)
def _sort_out(changed: Bools, uv: Ints, z_mm: Floats, tri: Ints, kind: Bytes, drawn: Ints) -> int:
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


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_edge(layers: Layers, points: Points, a: int, b: int, plainly: bool, spread: np.float32) -> None:
    """Draw the pixels between two points: to the last bit the same from either side.

    `spread` is theirs too if it is not negative.
    """
    if a > b:
        a, b = b, a
    u, v = points.uv[a, 0], points.uv[a, 1]
    du, dv = points.uv[b, 0] - u, points.uv[b, 1] - v
    steps, rest = abs(du), abs(dv)
    while rest:
        steps, rest = rest, steps % rest
    width = layers.depth_mm.shape[1]
    z, rise = points.z_mm[a], points.z_mm[b] - points.z_mm[a]
    for step in range(1, steps):
        x, y = u + du // steps * step, v + dv // steps * step
        near = layers.nearest[y, x]
        layers.plain[y, x] = plainly
        layers.depth_mm[y, x] = (
            z + rise * np.float64(step) / np.float64(steps) if plainly else layers.samples_mm[near // width, near % width]
        )
        if spread >= 0:
            layers.spread_mm2[y, x] = spread


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _fill(layers: Layers, points: Points, a: int, b: int, c: int, bridge: bool, spread: np.float32) -> None:
    """Draw a triangle's inside, its right edges, and its upper one if that is level.

    So each pixel of an edge is drawn by one of its two triangles.
    """
    uv, z_mm = points.uv, points.z_mm
    if uv[b, 1] < uv[a, 1]:
        a, b = b, a
    if uv[c, 1] < uv[b, 1]:
        b, c = c, b
        if uv[b, 1] < uv[a, 1]:
            a, b = b, a
    # Now from top to bottom: a row crosses the edge ac and one of the others.
    u0, v0, u1, v1 = np.int64(uv[a, 0]), np.int64(uv[a, 1]), np.int64(uv[b, 0]), np.int64(uv[b, 1])
    u2, v2 = np.int64(uv[c, 0]), np.int64(uv[c, 1])
    area = np.float64((u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0))
    z0, z01, z02 = np.float64(z_mm[a]), np.float64(z_mm[b] - z_mm[a]), np.float64(z_mm[c] - z_mm[a])
    along, down = (z01 * (v2 - v0) - z02 * (v1 - v0)) / area, (z02 * (u1 - u0) - z01 * (u2 - u0)) / area
    # Crossings are whole or at least 1 / height from it: a little more, and none is cut off.
    ac, ab, bc = (u2 - u0) / (v2 - v0), (u1 - u0) / max(v1 - v0, 1), (u2 - u1) / max(v2 - v1, 1)
    width = layers.depth_mm.shape[1]
    for v in range(v0, v2):
        long = int(u0 + (v - v0) * ac + _SURE)
        short = int(u0 + (v - v0) * ab + _SURE) if v < v1 else int(u1 + (v - v1) * bc + _SURE)
        first, end = (short, long) if area < 0 else (long, short)
        depth, plain, spreads = layers.depth_mm[v], layers.plain[v], layers.spread_mm2[v]
        z = z0 + (v - v0) * down + (first + 1 - u0) * along
        for u in range(np.uint64(first + 1), np.uint64(end + 1)):  # unsigned: none is counted from the end
            spreads[u] = spread
            plain[u] = not bridge
            depth[u] = z
            z += along
        if bridge:
            for u in range(first + 1, end + 1):
                near = layers.nearest[v, u]
                depth[u] = layers.samples_mm[near // width, near % width]


@njit(cache=True, nogil=True, error_model="numpy")
def _draw(first: int, end: int, drawn: Ints, layers: Layers, points: Points, tri: Ints, adj: Ints, kind: Bytes) -> None:
    """Draw triangles into the model: those that bridge nothing linearly, the others not at all.

    Pixels on the edge that a bridge shares with a plain triangle are the plain one's, and a sample
    counts as plain. So whichever triangle is drawn last, the model is the same.
    """
    uv, z_mm = points.uv, points.z_mm
    for t in drawn[first:end]:
        a, b, c = tri[t, 0], tri[t, 1], tri[t, 2]
        z0, z1, z2 = z_mm[a], z_mm[b], z_mm[c]
        mean = (z0 + z1 + z2) / np.float32(3)
        spread = ((z0 - mean) ** 2 + (z1 - mean) ** 2 + (z2 - mean) ** 2) / np.float32(3)
        bridge = kind[t] == _BRIDGE
        _touch(
            layers.touched, min(uv[a, 1], uv[b, 1], uv[c, 1]), min(uv[a, 0], uv[b, 0], uv[c, 0]),
            max(uv[a, 1], uv[b, 1], uv[c, 1]), max(uv[a, 0], uv[b, 0], uv[c, 0]),
        )  # fmt: skip
        _fill(layers, points, a, b, c, bridge, spread)
        for k in range(3):
            other = kind[adj[t, k]]
            if other == _PLAIN and not bridge:
                continue
            begin, stop = tri[t, NEXT[k]], tri[t, NEXT[k + 1]]
            du, dv = uv[stop, 0] - uv[begin, 0], uv[stop, 1] - uv[begin, 1]
            filled = dv > 0 or (dv == 0 and du > 0)
            if other == _OUTSIDE and not filled:
                _draw_edge(layers, points, begin, stop, not bridge, spread)
            elif (other == _PLAIN and filled) or (other == _BRIDGE and not filled):
                _draw_edge(layers, points, begin, stop, not bridge or other == _PLAIN, np.float32(-1))
        for p in (a, b, c):
            u, v = uv[p, 0], uv[p, 1]
            layers.plain[v, u] = True
            layers.depth_mm[v, u] = z_mm[p]
            layers.spread_mm2[v, u] = 0


@njit(cache=True, nogil=True)
def _mark_stars(tri: Ints, other: Bools, changed: Bools) -> None:
    """Mark the triangles of points whose depth is another now."""
    for t in range(len(tri)):
        for k in range(3):
            changed[t] |= tri[t, k] != GHOST and other[tri[t, k]]


@njit(cache=True, nogil=True)
def _renew_far(layers: Layers) -> None:
    """Give pixels that no plain triangle holds the depth of their nearest sample again."""
    height, width = layers.depth_mm.shape
    for v in range(height):
        for u in range(width):
            if not layers.plain[v, u]:
                near = layers.nearest[v, u]
                z = layers.samples_mm[near // width, near % width]
                if z != layers.depth_mm[v, u]:
                    layers.depth_mm[v, u] = z
                    _touch(layers.touched, v, u, v, u)


class Surface:
    """A dense model that samples can be added to.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the image in pixels.
    threads : int, optional
        Kernel threads of the first `add`; default `default_threads()`. Later ones use one.

    Attributes
    ----------
    layers : Layers
        What is known at every pixel. They are the surface's own: read them, and copy what is to
        outlast the next `add`.
    """

    def __init__(self, shape: tuple[int, int], threads: int | None = None) -> None:
        self._threads = threads
        self.layers = Layers(
            samples_mm=np.zeros(shape, np.float32),
            nearest=np.full(shape, -1, np.int32),
            gap_sq=np.full(shape, FAR_SQ, np.int32),
            depth_mm=np.zeros(shape, np.float32),
            plain=np.zeros(shape, np.bool_),
            spread_mm2=np.zeros(shape, np.float32),
            touched=np.ones(tuple(-(-pixels // TILE_PX) for pixels in shape), np.bool_),
        )
        self._uv = np.empty((0, 2), np.int32)
        self._depth_mm = np.empty(0, np.float32)
        self._point = np.full(shape, -1, np.int32)
        self._mesh: Mesh | None = None
        self._kind = np.empty(0, np.uint8)  # of every triangle

    @property
    def points(self) -> int:
        """How many samples it holds."""
        return len(self._uv)

    def add(self, uv: Ints, depth_mm: npt.NDArray[np.generic]) -> None:
        """Take in samples: pixels (n, 2), column first, none given before, and depth (n,) in mm.

        Those without depth (0 or negative) are left out.
        """
        self._insert(uv, depth_mm)
        self._draw_changed()

    def put(self, uv: Ints, depth_mm: Floats) -> None:
        """As `add`, but some of the pixels may have been given before: they get another depth."""
        point = self._point[uv[:, 1], uv[:, 0]]
        again = (point >= 0) & (depth_mm > 0)
        u, v = uv[again, 0], uv[again, 1]
        differ = depth_mm[again] != self.layers.samples_mm[v, u]
        if differ.any():
            self._depth_mm[point[again]] = self.layers.samples_mm[v, u] = depth_mm[again]
            if self._mesh is not None:
                other = np.zeros(len(self._uv), np.bool_)
                other[point[again][differ]] = True
                end = self._mesh.triangles
                _mark_stars(self._mesh.tri[:end], other, self._mesh.changed[:end])
        self._insert(uv[point < 0], depth_mm[point < 0])
        self._draw_changed()
        if differ.any():
            _renew_far(self.layers)

    def _insert(self, uv: Ints, depth_mm: npt.NDArray[np.generic]) -> None:
        """Take in samples without drawing them."""
        mm = depth_mm.astype(np.float32)
        returned = mm > 0
        uv, mm = np.ascontiguousarray(uv[returned], np.int32), mm[returned]
        if not len(uv):
            return
        layers, first = self.layers, not len(self._uv)
        self._point[uv[:, 1], uv[:, 0]] = np.arange(len(self._uv), len(self._uv) + len(uv))
        self._uv = np.concatenate((self._uv, uv))
        self._depth_mm = np.concatenate((self._depth_mm, mm))
        layers.samples_mm[uv[:, 1], uv[:, 0]] = mm
        if first:  # one by one, the first of many samples would claim whole images
            layers.nearest[:], layers.gap_sq[:] = nearest_sample(layers.samples_mm > 0, self._threads)
            layers.depth_mm[:] = layers.samples_mm.ravel()[layers.nearest]
            layers.touched[:] = True
        else:
            _claim(layers, uv)
        if self._mesh is None:
            self._mesh = Mesh.of(self._uv, 2 * len(self._uv), layers.depth_mm.shape)
        else:
            self._mesh.add(uv)

    def _draw_changed(self) -> None:
        """Draw the triangles that were made or reshaped, or whose corners have another depth."""
        mesh, layers = self._mesh, self.layers
        if mesh is None:  # nothing, or all on one line
            return
        if len(self._kind) < len(mesh.tri):  # it has grown
            self._kind = np.pad(self._kind, (0, len(mesh.tri) - len(self._kind)))
        drawn = np.empty(mesh.triangles, np.int32)
        points = Points(mesh.uv, self._depth_mm)
        count = _sort_out(mesh.changed[: mesh.triangles], *points, mesh.tri, self._kind, drawn)
        threads = self._threads if count > MANY_TRIANGLES else 1  # to begin some would take longer
        in_bands(_draw, count, threads, drawn, layers, points, mesh.tri, mesh.adj, self._kind)
