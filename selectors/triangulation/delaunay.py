"""Delaunay triangulation of pixels that grows point by point, exactly.

Pixels have integer coordinates, so the two predicates (on which side of a line, inside which
circle) are computed in 64-bit integers and are never wrong: no tolerance, no degenerate input.
Adding the shots of a round to the triangulation of the samples so far costs about a microsecond
each, where a triangulation from scratch would cost the whole frame again.

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

GHOST = -1
"""The vertex at infinity."""

_BIN_PX = 8  # least side of the square bins that remember a triangle to start a search from
_NEXT = np.array([1, 2, 0, 1], np.int64)


@njit(cache=True, nogil=True, inline="always")
def _orient(uv: Ints, a: int, b: int, c: int) -> int:
    """Twice the signed area of the triangle a, b, c: positive if c is on the left of ab."""
    au, av = np.int64(uv[a, 0]), np.int64(uv[a, 1])
    return int((uv[b, 0] - au) * (uv[c, 1] - av) - (uv[c, 0] - au) * (uv[b, 1] - av))


@njit(cache=True, nogil=True)
def _in_disk(uv: Ints, a: int, b: int, c: int, p: int) -> bool:
    """Is p strictly inside the circle through a, b, c (one of which may be the ghost)?"""
    if a == GHOST or b == GHOST or c == GHOST:
        if a == GHOST:
            a, b = b, c
        elif b == GHOST:
            a, b = c, a
        # The circle through infinity is the half-plane left of ab, and the open segment ab.
        side = _orient(uv, a, b, p)
        if side != 0:
            return side > 0
        pu, pv = np.int64(uv[p, 0]), np.int64(uv[p, 1])
        return bool((uv[a, 0] - pu) * (uv[b, 0] - pu) + (uv[a, 1] - pv) * (uv[b, 1] - pv) < 0)
    pu, pv = np.int64(uv[p, 0]), np.int64(uv[p, 1])
    au, av = uv[a, 0] - pu, uv[a, 1] - pv
    bu, bv = uv[b, 0] - pu, uv[b, 1] - pv
    cu, cv = uv[c, 0] - pu, uv[c, 1] - pv
    return bool(
        (au * au + av * av) * (bu * cv - cu * bv)
        - (bu * bu + bv * bv) * (au * cv - cu * av)
        + (cu * cu + cv * cv) * (au * bv - bu * av)
        > 0
    )


@njit(cache=True, nogil=True)
def _locate(uv: Ints, tri: Ints, adj: Ints, p: int, t: int) -> int:
    """Triangle that holds p, or a ghost triangle whose hull edge p sees, walking from t."""
    came = -1
    while True:
        a, b, c = tri[t, 0], tri[t, 1], tri[t, 2]
        if a != GHOST and b != GHOST and c != GHOST:
            # The edge we came through need not be tried: p is on this side of it.
            if adj[t, 0] != came and _orient(uv, b, c, p) < 0:
                came, t = t, adj[t, 0]
            elif adj[t, 1] != came and _orient(uv, c, a, p) < 0:
                came, t = t, adj[t, 1]
            elif adj[t, 2] != came and _orient(uv, a, b, p) < 0:
                came, t = t, adj[t, 2]
            else:
                return t
        else:
            k = 0 if a == GHOST else (1 if b == GHOST else 2)
            if _orient(uv, tri[t, _NEXT[k]], tri[t, _NEXT[k + 1]], p) > 0:
                return t
            came, t = t, adj[t, k]


@njit(cache=True, nogil=True, inline="always")
def _relink(adj: Ints, t: int, old: int, new: int) -> None:
    """Tell triangle t that its neighbour `old` is now `new`."""
    if adj[t, 0] == old:
        adj[t, 0] = new
    elif adj[t, 1] == old:
        adj[t, 1] = new
    else:
        adj[t, 2] = new


@njit(cache=True, nogil=True)
def _insert(uv: Ints, tri: Ints, adj: Ints, count: int, p: int, t: int, stack: Ints, changed: Bools) -> None:
    """Insert p into its triangle t; the two new triangles are `count` and `count + 1`."""
    a, b, c = tri[t, 0], tri[t, 1], tri[t, 2]
    na, nb, nc = adj[t, 0], adj[t, 1], adj[t, 2]
    t1, t2 = count, count + 1
    # Vertex 0 of every triangle of p's star is p; neighbour i lies across from vertex i.
    tri[t, 0], tri[t, 1], tri[t, 2] = p, b, c
    tri[t1, 0], tri[t1, 1], tri[t1, 2] = p, c, a
    tri[t2, 0], tri[t2, 1], tri[t2, 2] = p, a, b
    adj[t, 0], adj[t, 1], adj[t, 2] = na, t1, t2
    adj[t1, 0], adj[t1, 1], adj[t1, 2] = nb, t2, t
    adj[t2, 0], adj[t2, 1], adj[t2, 2] = nc, t, t1
    _relink(adj, nb, t, t1)
    _relink(adj, nc, t, t2)
    stack[0], stack[1], stack[2] = t, t1, t2
    changed[t] = changed[t1] = changed[t2] = True
    top = 3
    while top > 0:
        top -= 1
        t = stack[top]
        o = adj[t, 0]
        if not _in_disk(uv, tri[o, 0], tri[o, 1], tri[o, 2], p):
            continue
        # Flip the edge bc between (p, b, c) and (d, c, b) into pd.
        b, c = tri[t, 1], tri[t, 2]
        j = 0
        while tri[o, j] == b or tri[o, j] == c:
            j += 1
        d = tri[o, j]
        n_bd, n_dc = adj[o, _NEXT[j]], adj[o, _NEXT[j + 1]]
        n_cp = adj[t, 1]
        tri[t, 2] = d
        tri[o, 0], tri[o, 1], tri[o, 2] = p, d, c
        adj[t, 0], adj[t, 1] = n_bd, o
        adj[o, 0], adj[o, 1], adj[o, 2] = n_dc, n_cp, t
        _relink(adj, n_bd, o, t)
        _relink(adj, n_cp, t, o)
        changed[o] = True
        stack[top], stack[top + 1] = t, o
        top += 2


@njit(cache=True, nogil=True)
def _first_triangle(uv: Ints, n: int, tri: Ints, adj: Ints) -> int:
    """Make a triangle of points 0, 1 and the first off their line, whose index is returned."""
    third = 2
    while third < n and _orient(uv, 0, 1, third) == 0:
        third += 1
    if third >= n:
        return -1
    a, b, c = 0, 1, third
    if _orient(uv, a, b, c) < 0:
        a, b = b, a
    tri[:4] = np.array(((a, b, c), (c, b, GHOST), (a, c, GHOST), (b, a, GHOST)))
    adj[:4] = np.array(((1, 2, 3), (3, 2, 0), (1, 3, 0), (2, 1, 0)))
    return third


@njit(cache=True, nogil=True)
def _insert_all(
    uv: Ints, first: int, end: int, skip: int, tri: Ints, adj: Ints, count: int, bins: Ints, bin_px: int, changed: Bools
) -> int:
    """Insert the points first..end but `skip`; returns the new number of triangles."""
    stack = np.empty(4096, np.int32)
    for p in range(first, end):
        if p == skip:
            continue
        row, column = uv[p, 1] // bin_px, uv[p, 0] // bin_px
        t = _locate(uv, tri, adj, p, bins[row, column])
        if len(stack) < count:  # one insertion flips at most every triangle
            stack = np.empty(2 * count, np.int32)
        _insert(uv, tri, adj, count, p, t, stack, changed)
        bins[row, column] = count
        count += 2
    return count


@njit(cache=True, nogil=True)
def _brio_keys(uv: Ints, keys: Longs) -> None:
    """Sort keys of an order that inserts fast: rounds of doubling size, each in snake tiles."""
    for i in range(len(uv)):
        u, v = np.int64(uv[i, 0]), np.int64(uv[i, 1])
        # A fixed hash: the same points give the same triangles.
        h = (u * 0x9E3779B1 + v * 0x85EBCA77) & 0xFFFFFFFF
        h = ((h ^ (h >> 15)) * 0x2C1B3C6D) & 0xFFFFFFFF
        level = 0
        while level < 12 and (h >> level) & 1:
            level += 1
        size = 2 + level // 2 + 2
        row, column = v >> size, u >> size
        if row & 1:
            column = 4095 - column
        keys[i] = ((12 - level) << 40) | (row << 28) | (column << 16) | (h >> 16)


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
    bin_px: int
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
        # Four points a bin, on average: sparse points leave bins of 8 pixels empty.
        bin_px = max(_BIN_PX, math.isqrt(4 * extent_u * extent_v // n))
        side_u, side_v = (extent_u - 1) // bin_px + 1, (extent_v - 1) // bin_px + 1
        bins = np.zeros((side_v, side_u), np.int32)
        keys = np.empty(n, np.int64)
        _brio_keys(points[:n], keys)
        order = np.argsort(keys)
        ordered = points[order]
        third = _first_triangle(ordered, n, tri, adj)
        if third < 0:
            return None
        changed = np.ones(size, np.bool_)
        count = _insert_all(ordered, 2, n, third, tri, adj, 4, bins, bin_px, changed)
        # Back to the caller's numbering of the points.
        names = np.append(order, GHOST).astype(np.int32)
        tri[:count] = names[tri[:count]]
        return cls(points, tri, adj, bins, bin_px, changed, n, count)

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
            self.uv, self.points, end, -1, self.tri, self.adj, self.triangles, self.bins, self.bin_px, self.changed
        )
        self.points = end

    def real_triangles(self) -> Ints:
        """Vertices of the triangles inside the hull, shape (t, 3)."""
        tri = self.tri[: self.triangles]
        real: Ints = tri[(tri != GHOST).all(axis=1)]
        return real
