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
from selective_depth.selectors.arrays import Bools, Floats, Ints
from selective_depth.selectors.parallel import in_bands
from selective_depth.selectors.triangulation.delaunay import GHOST, Mesh
from selective_depth.selectors.triangulation.nearest import FAR_SQ, nearest_sample

STEP_MM = 50.0
"""Depth span of a triangle's vertices above which it may bridge a hole or a step, millimetres."""

BRIDGE_PX = 10.0
"""Edge length above which such a triangle does, pixels."""

MANY_TRIANGLES = 20_000
"""From so many on, triangles are drawn by several threads."""

TILE_PX = 16
"""Side of the square tiles in which changes are booked."""

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


@njit(cache=True, nogil=True, inline="always")
def _touch(touched: Bools, top: Whole, left: Whole, bottom: Whole, right: Whole) -> None:
    """Book a change of pixels in these rows and columns, which their neighbours may heed."""
    rows, columns = touched.shape
    first_column, last_column = max(left - 1, 0) // TILE_PX, (right + 1) // TILE_PX
    for row in range(max(top - 1, 0) // TILE_PX, min((bottom + 1) // TILE_PX, rows - 1) + 1):
        for column in range(first_column, min(last_column, columns - 1) + 1):
            touched[row, column] = True


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
def _bridges(uv: Ints, z_mm: Floats, corners: Ints) -> bool:
    """Whether a triangle of three points spans a hole or a depth step."""
    a, b, c = corners[0], corners[1], corners[2]
    if max(z_mm[a], z_mm[b], z_mm[c]) - min(z_mm[a], z_mm[b], z_mm[c]) <= STEP_MM:
        return False
    longest = max(
        (uv[a, 0] - uv[b, 0]) ** 2 + (uv[a, 1] - uv[b, 1]) ** 2,
        (uv[b, 0] - uv[c, 0]) ** 2 + (uv[b, 1] - uv[c, 1]) ** 2,
        (uv[c, 0] - uv[a, 0]) ** 2 + (uv[c, 1] - uv[a, 1]) ** 2,
    )
    return bool(longest > BRIDGE_PX * BRIDGE_PX)


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _along_edge(uv: Ints, z_mm: Floats, corners: Ints, across: int, u: int, v: int) -> np.float32:
    """Depth at a pixel of the edge across from a corner: to the last bit, either triangle's."""
    a, b = corners[(across + 1) % 3], corners[(across + 2) % 3]
    if a > b:
        a, b = b, a
    du, dv = uv[b, 0] - uv[a, 0], uv[b, 1] - uv[a, 1]
    step, whole = (u - uv[a, 0], du) if abs(du) >= abs(dv) else (v - uv[a, 1], dv)
    return np.float32(z_mm[a] + (z_mm[b] - z_mm[a]) * np.float64(step) / np.float64(whole))


@njit(cache=True, nogil=True, error_model="numpy")
def _draw(first: int, end: int, changed: Ints, layers: Layers, uv: Ints, z_mm: Floats, tri: Ints, adj: Ints) -> None:
    """Draw triangles into the model: those that bridge nothing linearly, the others not at all.

    Pixels on the edge that a bridge shares with a plain triangle are the plain one's, and a sample
    counts as plain. So whichever triangle is drawn last, the model is the same.
    """
    width = layers.depth_mm.shape[1]
    plain, owned = np.empty(3, np.bool_), np.empty(3, np.bool_)
    for t in changed[first:end]:
        a, b, c = tri[t, 0], tri[t, 1], tri[t, 2]
        u0, v0 = np.int64(uv[a, 0]), np.int64(uv[a, 1])
        u1, v1 = np.int64(uv[b, 0]), np.int64(uv[b, 1])
        u2, v2 = np.int64(uv[c, 0]), np.int64(uv[c, 1])
        z0, z1, z2 = z_mm[a], z_mm[b], z_mm[c]
        mean = (z0 + z1 + z2) / np.float32(3)
        spread = ((z0 - mean) ** 2 + (z1 - mean) ** 2 + (z2 - mean) ** 2) / np.float32(3)
        bridge = _bridges(uv, z_mm, tri[t])
        for k in range(3):
            o = tri[adj[t, k]]
            hull = o[0] == GHOST or o[1] == GHOST or o[2] == GHOST
            plain[k] = bridge and not hull and not _bridges(uv, z_mm, o)
            # Of two triangles, the edge's pixels are that one's which it bounds from above.
            begin, end = tri[t, (k + 1) % 3], tri[t, (k + 2) % 3]
            du, dv = uv[end, 0] - uv[begin, 0], uv[end, 1] - uv[begin, 1]
            owned[k] = hull or dv > 0 or (dv == 0 and du > 0)
        area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)  # positive: they run anticlockwise
        inverse = 1 / area
        left, right, top, bottom = (min(u0, u1, u2), max(u0, u1, u2), min(v0, v1, v2), max(v0, v1, v2))
        _touch(layers.touched, top, left, bottom, right)
        for v in range(top, bottom + 1):
            # The three weights are linear along a row: one more pixel is one addition each.
            w1 = (left - u0) * (v2 - v0) - (u2 - u0) * (v - v0)
            w2 = (u1 - u0) * (v - v0) - (left - u0) * (v1 - v0)
            entered = False
            for u in range(left, right + 1):
                w0 = area - w1 - w2
                at1, at2 = w1, w2
                w1, w2 = w1 + (v2 - v0), w2 - (v1 - v0)
                if w0 < 0 or at1 < 0 or at2 < 0:
                    if entered:
                        break  # what is inside of a row is one run
                    continue
                entered = True
                sample_mm = layers.samples_mm[v, u]
                if sample_mm > 0:
                    layers.plain[v, u] = True
                    layers.depth_mm[v, u] = sample_mm
                    layers.spread_mm2[v, u] = 0
                    continue
                if (w0 > 0 or owned[0]) and (at1 > 0 or owned[1]) and (at2 > 0 or owned[2]):
                    layers.spread_mm2[v, u] = spread
                edge = 0 if w0 == 0 else (1 if at1 == 0 else (2 if at2 == 0 else -1))
                plainly = not bridge or (edge >= 0 and plain[edge])
                layers.plain[v, u] = plainly
                if not plainly:
                    near = layers.nearest[v, u]
                    layers.depth_mm[v, u] = layers.samples_mm[near // width, near % width]
                elif edge >= 0:
                    layers.depth_mm[v, u] = _along_edge(uv, z_mm, tri[t], edge, u, v)
                else:
                    layers.depth_mm[v, u] = (w0 * z0 + at1 * z1 + at2 * z2) * inverse


@njit(cache=True, nogil=True)
def _mark_stars(tri: Ints, adj: Ints, other: Bools, changed: Bools) -> None:
    """Mark the triangles of points whose depth is another now, and those that share an edge."""
    for t in range(len(tri)):
        for k in range(3):
            if tri[t, k] != GHOST and other[tri[t, k]]:
                changed[t] = True
                for side in range(3):  # whether it bridges is seen along its edges
                    changed[adj[t, side]] = True
                break


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
                _mark_stars(self._mesh.tri[:end], self._mesh.adj[:end], other, self._mesh.changed[:end])
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
        changed = np.flatnonzero(mesh.changed[: mesh.triangles])
        inside = (mesh.tri[changed] != GHOST).all(axis=1)
        mesh.changed[: mesh.triangles] = False
        drawn = changed[inside].astype(np.int32)
        threads = self._threads if len(drawn) > MANY_TRIANGLES else 1  # to begin some would take longer
        in_bands(_draw, len(drawn), threads, drawn, layers, mesh.uv, self._depth_mm, mesh.tri, mesh.adj)
