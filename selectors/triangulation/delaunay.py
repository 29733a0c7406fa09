"""Delaunay triangulation of pixels that grows, and shrinks, point by point, exactly.

Adding the shots of a round to the triangulation of the samples so far costs a fifth of a
microsecond each, where a triangulation from scratch would cost the whole frame again. Of points on
one circle a hash decides, so that the triangulation is the same whatever their order.

Insertion follows Lawson (1977): split the triangle that holds the new point, then flip edges
until every circumcircle is empty. The outside of the convex hull is covered by *ghost* triangles
that share one vertex at infinity, `GHOST`, so that a point outside is inserted like any other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Bools, Ints, Longs
from selective_depth.selectors.triangulation.flips import GHOST, height, insert, locate
from selective_depth.selectors.triangulation.removal import remove_all
from selective_depth.selectors.triangulation.rows import row_starts, zip_rows

_LEAST_SHIFT = 3  # the square bins that remember a triangle to start a search from are 8 pixels wide


def _first_triangle(uv: Ints, tri: Ints, adj: Ints) -> int:
    """Make a triangle of points 0, 1 and the first off their line, whose index is returned; -1 without any."""
    along_u, along_v = (uv - uv[0]).astype(np.int64).T
    area = along_u[1:2] * along_v - along_u * along_v[1:2]
    if not area.any():
        return -1
    c = int(np.argmax(area != 0))
    a, b = (0, 1) if area[c] > 0 else (1, 0)
    tri[:4] = (a, b, c), (c, b, GHOST), (a, c, GHOST), (b, a, GHOST)
    adj[:4] = (1, 2, 3), (3, 2, 0), (1, 3, 0), (2, 1, 0)
    return c


@njit(cache=True, nogil=True)
def _insert_all(
    uv: Ints, first: int, end: int, skip: int, tri: Ints, adj: Ints, count: int, bins: Ints, shift: int, changed: Bools
) -> int:
    """Insert the points first..end but `skip`; returns the new number of triangles."""
    stack = np.empty(4096, np.int32)
    for p in range(first, end):
        if p == skip:
            continue
        row, column = uv[p, 1] >> shift, uv[p, 0] >> shift
        t = locate(uv, tri, adj, p, bins[row, column])
        if len(stack) < count:  # one insertion flips at most every triangle
            stack = np.empty(2 * count, np.int32)
        insert(uv, tri, adj, count, p, t, stack, changed)
        bins[row, column] = count
        count += 2
    return count


def _quick_order(uv: Ints) -> Longs:
    """An order that inserts fast: rounds of doubling size, each in snake tiles (BRIO)."""
    u, v = uv.T.astype(np.int64)
    h = np.asarray(height.py_func(v, u))
    level = np.log2(~h & (h + 1)).astype(np.int64)  # how many ones the hash ends in
    row, column = v >> (4 + level // 2), u >> (4 + level // 2)
    column = np.where(row & 1, 4095 - column, column)
    return np.argsort((16 - level) << 40 | row << 28 | column << 16 | h)


@dataclass(eq=False)
class Mesh:
    """A Delaunay triangulation that more points can be added to.

    Attributes
    ----------
    uv : int32 array of shape (capacity, 2)
        The points, pixels (column, row); `points` of them are used.
    tri, adj : int32 arrays of shape (capacity, 3)
        Vertices of the triangles, anticlockwise in (u, v) as in a plane, and the neighbour
        across from each vertex; `triangles` of them are used. A triangle with the vertex `GHOST`
        lies outside the hull.
    changed : bool array of shape (capacity,)
        Triangles made or reshaped since the caller last cleared it.
    """

    uv: Ints
    tri: Ints
    adj: Ints
    bins: Ints
    shift: int
    changed: Bools
    points: int
    triangles: int

    @classmethod
    def of(
        cls, uv: npt.NDArray[np.integer], capacity: int = 0, extent_px: tuple[int, int] | None = None
    ) -> Mesh | None:
        """Triangulate points, all different and not negative; None if they lie on one line.

        Parameters
        ----------
        uv : int array of shape (n, 2)
            Pixels, column first.
        capacity : int, optional
            Number of points to leave room for; at least n is taken.
        extent_px : tuple of int, optional
            Height and width within which all points lie, those to be added too; by default that
            of the points given.
        """
        n = len(uv)
        if n < 3:
            return None
        capacity = max(capacity, n)
        points = np.zeros((capacity, 2), np.int32)
        points[:n] = uv
        size = 2 * capacity
        tri, adj = np.empty((size, 3), np.int32), np.empty((size, 3), np.int32)
        extent_v, extent_u = extent_px or (int(points[:n, i].max()) + 1 for i in (1, 0))
        # Four to sixteen points a bin, on average: the last put in is the best start, if there is one.
        shift = max(_LEAST_SHIFT, math.isqrt(4 * extent_u * extent_v // n).bit_length())
        bins = np.zeros((((extent_v - 1) >> shift) + 1, ((extent_u - 1) >> shift) + 1), np.int32)
        changed = np.ones(size, np.bool_)
        starts = row_starts(points[:n])
        if starts is not None:
            count = zip_rows(points[:n], starts, tri, adj)
            some = np.arange(0, count, 3)
            at = points[tri[some, 0]] >> shift  # the ghost's is some place as well
            bins[at[:, 1], at[:, 0]] = some
        else:
            order = _quick_order(points[:n])
            ordered = points[order]
            third = _first_triangle(ordered, tri, adj)
            if third < 0:
                return None
            count = _insert_all(ordered, 2, n, third, tri, adj, 4, bins, shift, changed)
            # Back to the caller's numbering of the points.
            names = np.append(order, GHOST).astype(np.int32)
            tri[:count] = names[tri[:count]]
        return cls(points, tri, adj, bins, shift, changed, n, count)

    def add(self, uv: npt.NDArray[np.integer]) -> None:
        """Add points that are not in the mesh yet and lie within the extent it was made for.

        Parameters
        ----------
        uv : int array of shape (n, 2)
            Pixels, column first.
        """
        end = self.points + len(uv)
        if end > len(self.uv):  # more room, for as many again
            self.uv = np.pad(self.uv, ((0, end), (0, 0)))
            self.tri, self.adj = (np.pad(rows, ((0, 2 * end), (0, 0))) for rows in (self.tri, self.adj))
            self.changed = np.pad(self.changed, (0, 2 * end))
        self.uv[self.points : end] = uv
        self.triangles = _insert_all(
            self.uv, self.points, end, -1, self.tri, self.adj, self.triangles, self.bins, self.shift, self.changed
        )
        self.points = end

    def remove(self, gone: Ints) -> Ints | None:
        """Take points out; those that stay move up, and keep their order.

        Parameters
        ----------
        gone : int array of shape (n,)
            Numbers of the points, each once.

        Returns
        -------
        int32 array of shape (4,), or None
            Columns and rows (first, last, top, bottom) outside of which the hull is as it was; the
            first after the last if all of it is. None where the points that stay may lie on one
            line; then the mesh is spoilt.
        """
        box_px = np.array([1 << 30, -1, 1 << 30, -1], np.int32)
        self.triangles = remove_all(self.uv, gone, self.tri, self.adj, self.triangles, self.changed, box_px)
        if self.triangles < 0:
            return None
        self.bins[self.bins >= self.triangles] = 0
        stays = np.ones(self.points, np.bool_)
        stays[gone] = False
        names = np.append(np.cumsum(stays, dtype=np.int32) - 1, np.int32(GHOST))
        self.tri[: self.triangles] = names[self.tri[: self.triangles]]
        self.points -= len(gone)
        self.uv[: self.points] = self.uv[: len(stays)][stays]
        return box_px

    def real_triangles(self) -> Ints:
        """Vertices of the triangles inside the hull, shape (t, 3)."""
        tri = self.tri[: self.triangles]
        # One of three is the ghost, -1, if their bits in common are negative.
        real: Ints = tri[(tri[:, 0] | tri[:, 1] | tri[:, 2]) >= 0]
        return real
