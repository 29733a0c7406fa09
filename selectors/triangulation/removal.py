"""Taking points out of a Delaunay triangulation: what a point's triangles leave open is filled anew.

The triangles about a point form a ring of corners. An ear of the ring, three corners in a row whose
disk holds no other of them, is a triangle of the points that stay: cut off one after the other,
they fill it (Devillers 1999, without his heap: a ring has six corners on average).
"""

from __future__ import annotations

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Bools, Ints
from selective_depth.selectors.triangulation.flips import GHOST, NEXT, in_disk, orient


@njit(cache=True, nogil=True)
def _join(tri: Ints, adj: Ints, t: int, k: int, o: int) -> None:
    """Make o the neighbour of t across from corner k, and t that of o."""
    begin = tri[t, NEXT[k]]
    adj[t, k] = o
    # Seen from o the edge ends where it begins.
    adj[o, 0 if tri[o, 2] == begin else (1 if tri[o, 0] == begin else 2)] = t


@njit(cache=True, nogil=True)
def _is_ear(uv: Ints, ring: Ints, size: int, i: int) -> bool:
    """Whether corner i of a ring and those beside it are a triangle whose disk holds no other corner."""
    before, after = (i - 1) % size, (i + 1) % size
    a, b, c = ring[before], ring[i], ring[after]
    if a != GHOST and b != GHOST and c != GHOST and orient(uv, a, b, c) <= 0:
        return False
    for j in range(size):
        if j != before and j != i and j != after and ring[j] != GHOST and in_disk(uv, a, b, c, np.int64(ring[j])):
            return False
    return True


@njit(cache=True, nogil=True)
def _walk_about(tri: Ints, adj: Ints, p: int, t: int, ring: Ints, beyond: Ints, free: Ints) -> int:
    """List the corners about p, the triangles beyond the edge after each, and those between; how many is returned."""
    first, size = t, 0
    while size < len(ring):
        k = 0 if tri[t, 0] == p else (1 if tri[t, 1] == p else 2)
        ring[size], beyond[size], free[size] = tri[t, NEXT[k]], adj[t, k], t
        size += 1
        t = adj[t, NEXT[k]]
        if t == first:
            return size
    return 0


@njit(cache=True, nogil=True)
def _fill(uv: Ints, tri: Ints, adj: Ints, ring: Ints, beyond: Ints, free: Ints, size: int) -> bool:
    """Fill a ring with triangles, the first of `free`; False where no ear is left, and the mesh is spoilt."""
    made = i = tried = 0
    while size > 3:
        if not _is_ear(uv, ring, size, i):
            tried, i = tried + 1, (i + 1) % size
            if tried == size:
                return False
            continue
        before = (i - 1) % size
        t, made, tried = free[made], made + 1, 0
        tri[t, 0], tri[t, 1], tri[t, 2] = ring[before], ring[i], ring[(i + 1) % size]
        _join(tri, adj, t, 2, beyond[before])
        _join(tri, adj, t, 0, beyond[i])
        beyond[before] = t
        size -= 1
        for j in range(i, size):
            ring[j], beyond[j] = ring[j + 1], beyond[j + 1]
        i = before if before < i else size - 1
    t = free[made]
    tri[t, 0], tri[t, 1], tri[t, 2] = ring[0], ring[1], ring[2]
    for k in range(3):
        _join(tri, adj, t, k, beyond[(k + 1) % 3])
    return size == 3


@njit(cache=True, nogil=True)
def _grow(box_px: Ints, uv: Ints, p: int, ring: Ints) -> None:
    """Grow a box about the triangles of a point on the hull."""
    on_hull = False
    for corner in ring:
        on_hull |= corner == GHOST
    if not on_hull:
        return
    for corner in ring:
        at = p if corner == GHOST else corner
        u, v = uv[at, 0], uv[at, 1]
        box_px[0], box_px[1] = min(box_px[0], u), max(box_px[1], u)
        box_px[2], box_px[3] = min(box_px[2], v), max(box_px[3], v)


@njit(cache=True, nogil=True)
def remove_all(uv: Ints, gone: Ints, tri: Ints, adj: Ints, count: int, changed: Bools, left_px: Ints) -> int:
    """Take points out of a triangulation of `count` triangles; the number of those left is returned.

    Triangles that come to stand elsewhere in the list are `changed` as well. Of the points, the
    numbers stay. `left_px`, a box of columns and rows (first, last, top, bottom), grows about all
    that a point on the hull leaves behind.

    Returns -1 where that cannot be done, as of points on one line; then the mesh is spoilt.
    """
    one_of = np.empty(len(uv), np.int32)  # of the triangles about each point
    for t in range(count):
        for k in range(3):
            if tri[t, k] != GHOST:
                one_of[tri[t, k]] = t
    most = 4096  # of a few thousand points about one
    ring, beyond, free = np.empty(most, np.int32), np.empty(most, np.int32), np.empty(most, np.int32)
    for g in range(len(gone)):
        size = _walk_about(tri, adj, gone[g], one_of[gone[g]], ring, beyond, free)
        _grow(left_px, uv, gone[g], ring[:size])
        if size < 3 or not _fill(uv, tri, adj, ring, beyond, free, size):
            return -1
        for i in range(size - 2):
            t = free[i]
            changed[t] = True
            for k in range(3):
                if tri[t, k] != GHOST:
                    one_of[tri[t, k]] = t
        # The last triangles take the two places left, the later place first: it may be a last one itself.
        one, other = free[size - 2], free[size - 1]
        for hole in (max(one, other), min(one, other)):
            count -= 1
            if hole < count:
                for k in range(3):
                    tri[hole, k] = tri[count, k]
                    if tri[count, k] != GHOST:
                        one_of[tri[count, k]] = hole
                for k in range(3):
                    _join(tri, adj, hole, k, adj[count, k])
                changed[hole] = True
    for t in range(count):
        if tri[t, 0] != GHOST and tri[t, 1] != GHOST and tri[t, 2] != GHOST:
            return count
    return -1
