"""What a Delaunay triangulation is made by of pixels: where a point lies, and turning an edge.

Pixels have integer coordinates, so the two predicates (on which side of a line, inside which
circle) are computed in 64-bit integers and are never wrong: no tolerance, no degenerate input.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Bools, Ints

GHOST = -1
"""The vertex at infinity."""

Whole = int | np.int32 | np.int64

NEXT = np.array([1, 2, 0, 1], np.int64)
"""The corner after each, and after that."""


@njit(cache=True, nogil=True, inline="always")
def orient(uv: Ints, a: int, b: int, c: Whole) -> int:
    """Twice the signed area of the triangle a, b, c: positive if c is on the left of ab."""
    au, av = np.int64(uv[a, 0]), np.int64(uv[a, 1])
    return int((uv[b, 0] - au) * (uv[c, 1] - av) - (uv[c, 0] - au) * (uv[b, 1] - av))


@njit(cache=True, nogil=True, inline="always")
def height(u: Any, v: Any) -> Any:
    """A fixed hash of a pixel: the higher it is, the more it counts as outside of a circle it lies on."""
    h = (u * 0x9E3779B1 + v * 0x85EBCA77) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 0x2C1B3C6D) & 0xFFFFFFFF
    return h >> 16


@njit(cache=True, nogil=True)
def in_disk(uv: Ints, a: int, b: int, c: int, p: Whole) -> bool:
    """Is p inside the circle through a, b, c (one of which may be the ghost)?

    Of four points on one circle, as the corners of every lattice cell, the `height` decides. So
    there is one triangulation of any points, in whatever order they come.
    """
    if a == GHOST or b == GHOST or c == GHOST:
        if a == GHOST:
            a, b = b, c
        elif b == GHOST:
            a, b = c, a
        # The circle through infinity is the half-plane left of ab, and the open segment ab.
        side: int = orient(uv, a, b, p)
        if side != 0:
            return side > 0
        pu, pv = np.int64(uv[p, 0]), np.int64(uv[p, 1])
        return bool((uv[a, 0] - pu) * (uv[b, 0] - pu) + (uv[a, 1] - pv) * (uv[b, 1] - pv) < 0)
    pu, pv = np.int64(uv[p, 0]), np.int64(uv[p, 1])
    au, av = uv[a, 0] - pu, uv[a, 1] - pv
    bu, bv = uv[b, 0] - pu, uv[b, 1] - pv
    cu, cv = uv[c, 0] - pu, uv[c, 1] - pv
    bc, ac, ab = bu * cv - cu * bv, au * cv - cu * av, au * bv - bu * av
    inside = (au * au + av * av) * bc - (bu * bu + bv * bv) * ac + (cu * cu + cv * cv) * ab
    if inside == 0:
        low = height(pu, pv)
        a_above, b_above, c_above = (
            height(au + pu, av + pv) - low,
            height(bu + pu, bv + pv) - low,
            height(cu + pu, cv + pv) - low,
        )
        inside = a_above * bc - b_above * ac + c_above * ab
    return bool(inside > 0)


@njit(cache=True, nogil=True)
def locate(uv: Ints, tri: Ints, adj: Ints, p: int, t: int) -> int:
    """Triangle that holds p, or a ghost triangle whose hull edge p sees, walking from t."""
    came = -1
    while True:
        a, b, c = tri[t, 0], tri[t, 1], tri[t, 2]
        if a != GHOST and b != GHOST and c != GHOST:
            # The edge we came through need not be tried: p is on this side of it.
            if adj[t, 0] != came and orient(uv, b, c, p) < 0:
                came, t = t, adj[t, 0]
            elif adj[t, 1] != came and orient(uv, c, a, p) < 0:
                came, t = t, adj[t, 1]
            elif adj[t, 2] != came and orient(uv, a, b, p) < 0:
                came, t = t, adj[t, 2]
            else:
                return t
        else:
            k = 0 if a == GHOST else (1 if b == GHOST else 2)
            if orient(uv, tri[t, NEXT[k]], tri[t, NEXT[k + 1]], p) > 0:
                return t
            came, t = t, adj[t, k]


@njit(cache=True, nogil=True, inline="always")
def _side(adj: Ints, t: int, o: int) -> int:
    """Which corner of t lies across from its neighbour o; without a branch, which would be a guess."""
    return int((adj[t, 1] == o) + 2 * (adj[t, 2] == o))


@njit(cache=True, nogil=True, inline="always")
def _flip(tri: Ints, adj: Ints, t: int, o: int) -> None:
    """Turn the edge bc between t = (p, b, c) and o = (d, c, b) into pd; p is corner 0 of both."""
    c = tri[t, 2]
    j = _side(adj, o, t)
    d = tri[o, j]
    n_bd, n_dc = adj[o, NEXT[j]], adj[o, NEXT[j + 1]]
    n_cp = adj[t, 1]
    tri[t, 2] = d
    tri[o, 0], tri[o, 1], tri[o, 2] = tri[t, 0], d, c
    adj[t, 0], adj[t, 1] = n_bd, o
    adj[o, 0], adj[o, 1], adj[o, 2] = n_dc, n_cp, t
    adj[n_bd, _side(adj, n_bd, o)] = t
    adj[n_cp, _side(adj, n_cp, t)] = o


@njit(cache=True, nogil=True)
def insert(uv: Ints, tri: Ints, adj: Ints, count: int, p: int, t: int, stack: Ints, changed: Bools) -> None:
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
    adj[nb, _side(adj, nb, t)] = t1
    adj[nc, _side(adj, nc, t)] = t2
    stack[0], stack[1], stack[2] = t, t1, t2
    changed[t] = changed[t1] = changed[t2] = True
    top = 3
    while top > 0:
        top -= 1
        t = stack[top]
        o = adj[t, 0]
        if in_disk(uv, tri[o, 0], tri[o, 1], tri[o, 2], p):
            _flip(tri, adj, t, o)
            changed[o] = True
            stack[top], stack[top + 1] = t, o
            top += 2


@njit(cache=True, nogil=True)
def settle(uv: Ints, tri: Ints, adj: Ints, count: int, sure: Bools) -> None:
    """Turn edges of a triangulation of any kind, with its ghosts, until every disk is empty.

    Between two triangles that are `sure`, the edge is known to be right.
    """
    stack, waits = np.empty(count + 1, np.int32), np.zeros(count, np.bool_)
    for newest in range(count):
        stack[0] = newest
        top = 1
        while top > 0:
            top -= 1
            t = stack[top]
            waits[t] = False
            k = 0
            while k < 3:
                o, p = adj[t, k], np.int64(tri[t, k])
                # An edge is looked at when the later of its triangles comes. Hull edges stay.
                if p == GHOST or o > newest or t > newest or (sure[o] and sure[t]):
                    k += 1
                    continue
                if not in_disk(uv, tri[o, 0], tri[o, 1], tri[o, 2], p):
                    k += 1
                    continue
                for rows in (tri, adj):  # so that p is corner 0
                    rows[t, 0], rows[t, 1], rows[t, 2] = rows[t, k], rows[t, NEXT[k]], rows[t, NEXT[k + 1]]
                _flip(tri, adj, t, o)
                sure[o] = sure[t] = False
                if not waits[o]:
                    stack[top], waits[o] = o, True
                    top += 1
                k = 0
