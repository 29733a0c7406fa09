"""Neural gas as published (section III, eq. 1-4): every step, one drawn seed at a time."""

from __future__ import annotations

import math

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Floats, Ints

ALPHA = (0.5, 0.005)
"""First and last learning rate. The first is the paper's; both are SOM Toolbox's defaults."""
LAMBDA_LAST = 0.01
"""Last neighbourhood range (SOM Toolbox); the first is half the number of nodes, as published."""
NEGLIGIBLE = 1e-8
"""Nodes whose rank k has exp(-k / lambda) below this are left where they are. Small enough that
the result is that of moving every node at every step; at 1e-3 it is another, equally good one."""

_MEMBERS = 16  # nodes per group; the nearest members of all groups are found in one sweep
_SLACK = 1.2  # how much farther than expected the nodes that move are looked for
_FAR = 1e18  # where the padding of the last groups lies: its square is still finite


def draw_nodes(points_mm: Floats, nodes: int, rng: np.random.Generator) -> Floats:
    """Draw the first nodes from the points, without replacement as long as they last.

    Returns
    -------
    float32 array of shape (nodes, 3)
    """
    count = len(points_mm)
    if nodes <= count:
        return points_mm[rng.choice(count, nodes, replace=False)]
    return points_mm[np.concatenate((np.arange(count), rng.integers(0, count, nodes - count)))]


def train_exact(points_mm: Floats, nodes: int, epochs: int, seed: int) -> Floats:
    """Train neural gas from nothing with the published steps.

    Samples are drawn with replacement, ``epochs * len(points_mm)`` of them, and each moves the
    nodes by ``alpha(t) exp(-k / lambda(t))`` of their distance to it, k the node's rank (eq. 2, 3),
    under the annealing of eq. 4. Ranks are exact; only nodes whose rank k has
    ``exp(-k / lambda) < NEGLIGIBLE`` are not moved. In float64, because the nodes first gather in
    one place, so close together that float32 could not tell them apart.

    Parameters
    ----------
    points_mm : float32 array of shape (M, 3)
        Metric points of the seeds, all finite, at least one.
    nodes : int
        Number of nodes N.
    epochs : int
        Training length in passes' worth of samples (T = epochs * M).
    seed : int
        Seed of the random draws; equal seeds give equal nodes.

    Returns
    -------
    float32 array of shape (N, 3)
        Nodes in millimetres.
    """
    rng = np.random.default_rng(seed)
    first = draw_nodes(points_mm, nodes, rng)
    draws = rng.integers(0, len(points_mm), epochs * len(points_mm), dtype=np.int32)
    return anneal(points_mm, first, draws)


def anneal(points_mm: Floats, nodes_mm: Floats, draws: Ints) -> Floats:
    """Take the published steps from given nodes, over given draws.

    Parameters
    ----------
    points_mm : float32 array of shape (M, 3)
        The input space.
    nodes_mm : float32 array of shape (N, 3)
        Nodes to begin with; not changed.
    draws : int32 array of shape (T,)
        Which point is presented at each step.

    Returns
    -------
    float32 array of shape (N, 3)
        Nodes after the last step, in the order given.
    """
    count = len(nodes_mm)
    groups = -(-count // _MEMBERS)
    padded = np.full((3, _MEMBERS * groups), _FAR)
    padded[:, :count] = nodes_mm.T
    settled: Floats = _anneal(
        points_mm.astype(np.float64), padded.reshape(3, _MEMBERS, groups), count, draws, max(count / 2, LAMBDA_LAST)
    )
    return settled


@njit(cache=True, nogil=True, fastmath={"nnan", "ninf", "nsz", "contract"})
def _distances(x, y, z, nodes, d2, nearest):  # type: ignore[no-untyped-def]
    """Squared distance of every node, and the smallest of every group."""
    groups = len(nearest)
    for g in range(groups):
        nearest[g] = 1e300
    for m in range(_MEMBERS):
        # One-dimensional views: with them LLVM proves what it needs to vectorise.
        wx, wy, wz, out = nodes[0, m], nodes[1, m], nodes[2, m], d2[m]
        for g in range(groups):
            dx = wx[g] - x
            dy = wy[g] - y
            dz = wz[g] - z
            d = dx * dx + dy * dy + dz * dz
            out[g] = d
            nearest[g] = d if d < nearest[g] else nearest[g]


@njit(cache=True, nogil=True)
def _winner(d2, nearest):  # type: ignore[no-untyped-def]
    """Flat index of the nearest node."""
    groups = len(nearest)
    best = 0
    for g in range(groups):
        if nearest[g] < nearest[best]:
            best = g
    for m in range(_MEMBERS):
        if d2[m, best] == nearest[best]:
            return m * groups + best
    return best


@njit(cache=True, nogil=True)
def _within(d2, nearest, reach, found, key):  # type: ignore[no-untyped-def]
    """Nodes not farther than `reach` (squared); returns how many."""
    groups = len(nearest)
    count = 0
    for g in range(groups):
        if nearest[g] <= reach:
            for m in range(_MEMBERS):
                # Always written, counted only if near: cheaper than a branch.
                found[count] = m * groups + g
                key[count] = d2[m, g]
                count += int(d2[m, g] <= reach)
    return count


@njit(cache=True, nogil=True, fastmath={"nnan", "ninf", "nsz", "contract"})
def _largest(key, count, lanes):  # type: ignore[no-untyped-def]
    """Largest of the keys, in as many lanes as `lanes` is long, so that it is vectorised."""
    width = len(lanes)
    for k in range(width):
        lanes[k] = key[0]
    for start in range(0, count - width + 1, width):
        part = key[start : start + width]
        for k in range(width):
            lanes[k] = part[k] if part[k] > lanes[k] else lanes[k]
    largest = key[0]
    for k in range(width):
        largest = max(largest, lanes[k])
    for i in range(count - count % width, count):
        largest = max(largest, key[i])
    return largest


@njit(cache=True, nogil=True)
def _order(key, count, largest, order, spare, starts):  # type: ignore[no-untyped-def]
    """Order by two passes of a radix sort, over distance and place packed into 32 bits."""
    one = np.uint32(1)
    place_bits = one
    while count > one << place_bits:
        place_bits += one
    # Few keys need fewer buckets: clearing and summing those would take longer than the keys.
    bits = min(np.uint32(32 - place_bits) >> one, np.uint32(10 if count > 600 else 7))
    buckets = one << bits
    mask = buckets - one
    to_high = place_bits + bits
    low, high = starts[0], starts[1]
    low[:buckets] = 0
    high[:buckets] = 0
    scale = (buckets * buckets - 1) * 0.9999 / max(largest, 1e-300)
    for i in range(count):
        order[i] = np.uint32(key[i] * scale) << place_bits | np.uint32(i)
    for i in range(count):
        step = order[i] >> place_bits
        low[step & mask] += one
        high[step >> bits] += one
    low_end, high_end = np.uint32(0), np.uint32(0)
    for b in range(buckets):
        low_size, high_size = low[b], high[b]
        low[b], high[b] = low_end, high_end
        low_end += low_size
        high_end += high_size
    for i in range(count):
        item = order[i]
        b = item >> place_bits & mask
        at = low[b]
        spare[at] = item
        low[b] = at + one
    for i in range(count):
        item = spare[i]
        b = item >> to_high
        at = high[b]
        order[at] = item
        high[b] = at + one
    place = (one << place_bits) - one
    for i in range(1, count):
        item = order[i]
        if order[i - 1] >> place_bits == item >> place_bits:
            # Distances that share a step are still by place: put these few right.
            j = i
            while j > 0 and order[j - 1] >> place_bits == item >> place_bits:
                if key[order[j - 1] & place] <= key[item & place]:
                    break
                order[j] = order[j - 1]
                j -= 1
            order[j] = item
    for i in range(count):
        order[i] &= place


@njit(cache=True, nogil=True)
def _weights(alpha, decay, weight, count):  # type: ignore[no-untyped-def]
    """alpha * decay^k for all k, by doubling: free of a chain of products."""
    weight[0] = alpha
    done = 1
    factor = decay
    while done < count:
        for k in range(done, min(2 * done, count)):
            weight[k] = weight[k - done] * factor
        done *= 2
        factor *= factor


@njit(cache=True, nogil=True)
def _attract(x, y, z, nodes, share):  # type: ignore[no-untyped-def]
    """Move every node by its share of the way."""
    for m in range(_MEMBERS):
        wx, wy, wz, h = nodes[0, m], nodes[1, m], nodes[2, m], share[m]
        for g in range(len(h)):
            wx[g] += h[g] * (x - wx[g])
            wy[g] += h[g] * (y - wy[g])
            wz[g] += h[g] * (z - wz[g])


@njit(cache=True, nogil=True)
def _regroup(nodes, name, count):  # type: ignore[no-untyped-def]
    """Reorder the nodes along a space-filling curve, so that the members of a group are near."""
    groups = nodes.shape[2]
    flat = nodes.reshape((3, -1))
    places = np.empty((3, count))
    names = np.empty(count, np.uint32)
    code = np.zeros(count, np.int64)
    low, high = np.empty(3), np.empty(3)
    at = np.empty(count, np.int64)
    held = 0
    for i in range(flat.shape[1]):
        if name[i] < count:
            at[held] = i
            held += 1
    for axis in range(3):
        for i in range(count):
            places[axis, i] = flat[axis, at[i]]
        low[axis], high[axis] = places[axis].min(), places[axis].max()
    extent = max((high - low).max(), 1e-300)
    for i in range(count):
        names[i] = name[at[i]]
        for axis in range(3):
            step = int((places[axis, i] - low[axis]) / extent * 1023)
            for bit in range(10):
                code[i] |= (step >> bit & 1) << (3 * bit + axis)
    order = np.argsort(code)
    flat[:] = _FAR
    name[:] = count
    for k in range(count):
        i = (k % _MEMBERS) * groups + k // _MEMBERS
        name[i] = names[order[k]]
        for axis in range(3):
            flat[axis, i] = places[axis, order[k]]


@njit(cache=True, nogil=True)
def _anneal(points, nodes, count, draws, lambda_first):  # type: ignore[no-untyped-def]
    groups = nodes.shape[2]
    size = _MEMBERS * groups
    wx, wy, wz = nodes[0].ravel(), nodes[1].ravel(), nodes[2].ravel()
    d2 = np.empty((_MEMBERS, groups))
    flat_d2 = d2.ravel()
    nearest = np.empty(groups)
    key = np.empty(size + 1)
    found = np.empty(size + 1, np.uint32)
    order = np.empty(size + 1, np.uint32)
    spare = np.empty(size + 1, np.uint32)
    starts = np.empty((2, 1024), np.uint32)
    weight = np.empty(size)
    share = np.zeros((_MEMBERS, groups))
    flat_share = share.ravel()
    # Squared distance of the farthest node moved, per node moved, when a point was last drawn.
    # At first everything is in reach but the padding.
    reaches = np.full(len(points), 1e30)
    name = np.arange(size).astype(np.uint32)
    regroup_at = count // 2  # from here on only the groups near a point are looked at
    lanes = np.empty(64)
    cut = -math.log(NEGLIGIBLE)
    log_alpha = math.log(ALPHA[1] / ALPHA[0])
    log_lambda = math.log(LAMBDA_LAST / lambda_first)
    steps = len(draws)
    for t in range(steps):
        p = draws[t]
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        alpha = ALPHA[0] * math.exp(log_alpha * t / steps)
        range_ = lambda_first * math.exp(log_lambda * t / steps)
        moving = min(count, int(cut * range_) + 1)
        if moving <= regroup_at:
            _regroup(nodes, name, count)
            regroup_at = moving // 4
        _distances(x, y, z, nodes, d2, nearest)
        if moving == 1:
            i = _winner(d2, nearest)
            wx[i] += alpha * (x - wx[i])
            wy[i] += alpha * (y - wy[i])
            wz[i] += alpha * (z - wz[i])
            continue
        _weights(alpha, math.exp(-1 / range_), weight, moving)
        if moving > count // 2:
            # Most nodes move: order them all, without looking for those in reach.
            _order(flat_d2, count, _largest(flat_d2, count, lanes), order, spare, starts)
            for k in range(moving):
                flat_share[order[k]] = weight[k]
            for k in range(moving, count):
                flat_share[order[k]] = 0
            _attract(x, y, z, nodes, share)
            reaches[p] = flat_d2[order[moving - 1]] / moving
            continue
        # On a surface the number of nodes met grows like the square of the distance.
        reach = reaches[p] * moving * _SLACK
        have = _within(d2, nearest, reach, found, key)
        while have < moving:
            reach = reach * 1.5 + 1e-6
            have = _within(d2, nearest, reach, found, key)
        _order(key, have, _largest(key, have, lanes), order, spare, starts)
        reaches[p] = key[order[moving - 1]] / moving
        for k in range(moving):
            i = found[order[k]]
            wx[i] += weight[k] * (x - wx[i])
            wy[i] += weight[k] * (y - wy[i])
            wz[i] += weight[k] * (z - wz[i])
    settled = np.empty((count, 3), np.float32)
    for i in range(size):
        if name[i] < count:
            settled[name[i], 0], settled[name[i], 1], settled[name[i], 2] = wx[i], wy[i], wz[i]
    return settled
