"""The triangulation of points that lie in rows, as the seeds of a frame do, without a search.

Between a row and the next one lies a strip of triangles, zipped along both; where the seeds are a
full lattice that is Delaunay's triangulation already, and elsewhere some edges are turned.
"""

from __future__ import annotations

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Ints, Longs
from selective_depth.selectors.triangulation.flips import GHOST, NEXT, height, settle


def row_starts(uv: Ints) -> Longs | None:
    """Where the rows of points begin, and the end of the last; None if to zip them would not pay.

    It pays where they come row by row, at least two to a row, and rows stand no closer than points
    along a row do, by and large.
    """
    n, v = len(uv), uv[:, 1]
    step_v = np.diff(v)
    if (step_v < 0).any() or (np.diff(uv[:, 0])[step_v == 0] <= 0).any():
        return None
    starts = np.concatenate(([0], np.flatnonzero(step_v) + 1, [n]))
    rows = len(starts) - 1
    if rows < 2 or np.diff(starts).min() < 2 or int(v[-1] - v[0]) * 4 * n < int(np.ptp(uv[:, 0])) * rows**2:
        return None
    return starts


@njit(cache=True, nogil=True, inline="always")
def _haunt(tri: Ints, adj: Ints, t: int, k: int, ghost: int) -> None:
    """Put a ghost triangle across the edge of t that lies across from its corner k."""
    tri[ghost, 0], tri[ghost, 1], tri[ghost, 2] = tri[t, NEXT[k + 1]], tri[t, NEXT[k]], GHOST
    adj[t, k], adj[ghost, 2] = ghost, t


@njit(cache=True, nogil=True)
def zip_rows(uv: Ints, starts: Longs, tri: Ints, adj: Ints) -> int:
    """Triangulate points in rows that begin at `starts`; the number of triangles is returned."""
    n, strips = len(uv), len(starts) - 2
    top_edges, bottom_edges = starts[1] - 1, n - starts[strips] - 1
    outline = top_edges + bottom_edges + 2 * strips
    real = 2 * n - 2 - outline
    # Ghosts follow the outline: first row, right ends, last row backwards, left ends upwards.
    right = real + top_edges
    bottom = right + strips
    left = bottom + bottom_edges
    above = np.empty(n, np.int32)  # triangle above the edge from each point to its row's next
    sure = np.zeros(real + outline + 1, np.bool_)  # halves of a lattice's cells
    t = 0
    for strip in range(strips):
        a, b = starts[strip], starts[strip + 1]
        last_a, last_b = b - 1, starts[strip + 2] - 1
        before, out = -1, 1  # the triangle to the left, and its corner across from the edge ab
        while a < last_a or b < last_b:
            u_a = uv[a + 1, 0] if a < last_a else 1 << 30
            u_b = uv[b + 1, 0] if b < last_b else 1 << 30
            along_a = u_a < u_b
            if u_a == u_b:  # the corners of a cell: the diagonal that `in_disk` will keep
                u, upper, lower = uv[b, 0], uv[a, 1], uv[b, 1]
                along_a = height(u_a, upper) + height(u, lower) < height(u, upper) + height(u_b, lower)
                sure[t] = sure[t + 1] = uv[a, 0] == u
            tri[t, 0], tri[t, 1], tri[t, 2] = a, (a if along_a else b) + 1, b
            if before < 0:
                _haunt(tri, adj, t, 1, left + strips - 1 - strip)
            else:
                adj[t, 1], adj[before, out] = before, t
            if not along_a:
                above[b] = t
                b += 1
                if strip == strips - 1:
                    _haunt(tri, adj, t, 0, bottom + last_b - b)
            else:
                if strip == 0:
                    _haunt(tri, adj, t, 2, real + a)
                else:
                    adj[t, 2], adj[above[a], 0] = above[a], t
                a += 1
            before, out = t, 0 if along_a else 2
            t += 1
        _haunt(tri, adj, before, out, right + strip)
    for i in range(outline):
        adj[real + i, 0] = real + (i - 1) % outline
        adj[real + i, 1] = real + (i + 1) % outline
    settle(uv, tri, adj, real + outline, sure)
    return int(real + outline)
