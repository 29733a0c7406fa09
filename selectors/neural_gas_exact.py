"""Neural gas as published (section III, eq. 1-4): every step, one drawn seed at a time."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

ALPHA = (0.5, 0.005)
"""First and last learning rate. The first is the paper's; both are SOM Toolbox's defaults."""
LAMBDA_LAST = 0.01
"""Last neighbourhood range (SOM Toolbox); the first is half the number of nodes, as published."""
NEGLIGIBLE = 1e-3
"""Nodes whose rank k has exp(-k / lambda) below this are left where they are."""

_MEMBERS = 16  # nodes per group; the nearest members of all groups are found in one sweep
_FEW = 32  # up to here, ordering by comparing all with all is the faster way
_SLACK = 1.2  # how much farther than expected the nodes that move are looked for
_FAR = np.float32(1e18)  # where the padding of the last groups lies: its square is still finite


def draw_nodes(
    points_mm: npt.NDArray[np.float32], nodes: int, rng: np.random.Generator
) -> npt.NDArray[np.float32]:
    """Draw the first nodes from the points, without replacement as long as they last.

    Returns
    -------
    float32 array of shape (nodes, 3)
    """
    count = len(points_mm)
    chosen = rng.choice(count, nodes, replace=False) if nodes <= count else None
    if chosen is None:
        chosen = np.concatenate((np.arange(count), rng.integers(0, count, nodes - count)))
    return points_mm[chosen]


def train_exact(
    points_mm: npt.NDArray[np.float32],
    nodes: int,
    epochs: int,
    seed: int,
) -> npt.NDArray[np.float32]:
    """Train neural gas from nothing with the published steps.

    Samples are drawn with replacement, ``epochs * len(points_mm)`` of them, and each moves the
    nodes by ``alpha(t) exp(-k / lambda(t))`` of their distance to it, k the node's rank (eq. 2, 3),
    under the annealing of eq. 4. Ranks are exact; the one liberty is that a node of rank k with
    ``exp(-k / lambda) < NEGLIGIBLE`` does not move, so that no step moves a node less than a
    thousandth as far as its winner without being worth its time.

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


def anneal(
    points_mm: npt.NDArray[np.float32],
    nodes_mm: npt.NDArray[np.float32],
    draws: npt.NDArray[np.int32],
) -> npt.NDArray[np.float32]:
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
    padded = np.full((3, _MEMBERS * groups), _FAR, dtype=np.float32)
    padded[:, :count] = nodes_mm.T
    _anneal(
        np.ascontiguousarray(points_mm, dtype=np.float32),
        padded.reshape(3, _MEMBERS, groups),
        count,
        draws,
        max(count / 2, LAMBDA_LAST),
    )
    return np.ascontiguousarray(padded[:, :count].T)


@njit(cache=True, nogil=True, fastmath={"nnan", "ninf", "nsz", "contract"})
def _distances(x, y, z, nodes, d2, nearest):  # type: ignore[no-untyped-def]
    """Squared distance of every node, and the smallest of every group."""
    groups = len(nearest)
    for g in range(groups):
        nearest[g] = np.float32(3e38)
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


@njit(cache=True, nogil=True)
def _order_few(key, found, count, order):  # type: ignore[no-untyped-def]
    """Order by counting the smaller keys: quadratic, but free of branches."""
    for i in range(count):
        own = key[i]
        rank = 0
        for j in range(i):
            rank += int(key[j] <= own)
        for j in range(i + 1, count):
            rank += int(key[j] < own)
        order[rank] = found[i]


@njit(cache=True, nogil=True)
def _order_many(key, found, count, order, packed, spare, starts):  # type: ignore[no-untyped-def]
    """Order by two passes of a radix sort, over distance and place packed into 32 bits."""
    place_bits = np.uint32(1)
    while count > np.uint32(1) << place_bits:
        place_bits += np.uint32(1)
    # Few keys need fewer buckets: clearing and summing those would take longer than the keys.
    bits = min(np.uint32(32 - place_bits) >> np.uint32(1), np.uint32(10 if count > 600 else 7))
    buckets = np.uint32(1) << bits
    mask = buckets - np.uint32(1)
    to_high = place_bits + bits
    low, high = starts[0], starts[1]
    low[: buckets + 1] = 0
    high[: buckets + 1] = 0
    largest = np.float32(1e-30)
    for i in range(count):
        largest = max(largest, key[i])
    scale = np.float32((buckets * buckets - 1) * 0.9999 / largest)
    for i in range(count):
        step = np.uint32(key[i] * scale)
        packed[i] = step << place_bits | np.uint32(i)
        low[(step & mask) + np.uint32(1)] += np.uint32(1)
        high[(step >> bits) + np.uint32(1)] += np.uint32(1)
    for b in range(buckets):
        low[b + 1] += low[b]
        high[b + 1] += high[b]
    for i in range(count):
        item = packed[i]
        b = item >> place_bits & mask
        spare[low[b]] = item
        low[b] += np.uint32(1)
    for i in range(count):
        item = spare[i]
        b = item >> to_high
        packed[high[b]] = item
        high[b] += np.uint32(1)
    place = (np.uint32(1) << place_bits) - np.uint32(1)
    for i in range(count):
        item = packed[i]
        order[i] = found[item & place]
        # Distances that share a step are in the order found: put these few right.
        j = i
        while j > 0 and packed[j - 1] >> place_bits == item >> place_bits:
            if key[packed[j - 1] & place] <= key[item & place]:
                break
            packed[j] = packed[j - 1]
            order[j] = order[j - 1]
            j -= 1
        packed[j] = item
        order[j] = found[item & place]


@njit(cache=True, nogil=True)
def _anneal(points, nodes, count, draws, lambda_first):  # type: ignore[no-untyped-def]
    groups = nodes.shape[2]
    size = _MEMBERS * groups
    wx, wy, wz = nodes[0].ravel(), nodes[1].ravel(), nodes[2].ravel()
    d2 = np.empty((_MEMBERS, groups), np.float32)
    flat_d2 = d2.ravel()
    nearest = np.empty(groups, np.float32)
    key = np.empty(size + 1, np.float32)
    found = np.empty(size + 1, np.uint32)
    order = np.empty(size + 1, np.uint32)
    packed = np.empty(size + 1, np.uint32)
    spare = np.empty(size + 1, np.uint32)
    starts = np.empty((2, 1025), np.uint32)
    # Squared distance of the farthest node moved, per node moved, when a point was last drawn.
    reaches = np.full(len(points), np.float32(1e33), np.float32)
    cut = -math.log(NEGLIGIBLE)
    log_alpha = math.log(ALPHA[1] / ALPHA[0])
    log_lambda = math.log(LAMBDA_LAST / lambda_first)
    steps = len(draws)
    for t in range(steps):
        p = draws[t]
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        alpha = ALPHA[0] * math.exp(log_alpha * t / steps)
        reach_ranks = lambda_first * math.exp(log_lambda * t / steps)
        moving = min(count, int(cut * reach_ranks) + 1)
        _distances(x, y, z, nodes, d2, nearest)
        if moving == 1:
            i = _winner(d2, nearest)
            h = np.float32(alpha)
            wx[i] += h * (x - wx[i])
            wy[i] += h * (y - wy[i])
            wz[i] += h * (z - wz[i])
            continue
        if moving == count:
            for i in range(count):
                key[i] = flat_d2[i]
                found[i] = i
            have = count
        else:
            # On a surface the number of nodes met grows like the square of the distance.
            reach = reaches[p] * moving * np.float32(_SLACK)
            have = _within(d2, nearest, reach, found, key)
            while have < moving:
                reach = reach * np.float32(1.5) + np.float32(1e-6)
                have = _within(d2, nearest, reach, found, key)
        if have > _FEW:
            _order_many(key, found, have, order, packed, spare, starts)
        else:
            _order_few(key, found, have, order)
        reaches[p] = flat_d2[order[moving - 1]] / np.float32(moving)
        decay = math.exp(-1.0 / reach_ranks)
        weight = alpha
        for k in range(moving):
            i = order[k]
            h = np.float32(weight)
            wx[i] += h * (x - wx[i])
            wy[i] += h * (y - wy[i])
            wz[i] += h * (z - wz[i])
            weight *= decay
