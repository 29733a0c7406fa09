"""Neural gas in a few batch passes, cold or going on from the last frame."""

from __future__ import annotations

import math
from typing import Self

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Bools, Floats, Ints
from selective_depth.selectors.nearby import nearest_points
from selective_depth.selectors.neural_gas.exact import draw_nodes
from selective_depth.selectors.parallel import in_bands

COLD_PASSES = 8
"""Batch passes of a training from nothing, and of an update after the scene has changed."""
LIVE_PASSES = 2
"""Batch passes of an update from the last frame's nodes."""
SETTLING_PASSES = 2
"""How many of the last passes put no node elsewhere; at most half of them."""
REHEAT_AT = 2.0
"""The scene has changed where the quantisation error jumps by this factor between frames (the
hand-held camera of the test sequence: 1.6 at most)."""
GAIN = 0.3
"""Share of its error that a node is expected to lose when a second one is put beside it."""

_NODES_PER_BIN = 1.6
_ENOUGH = 9  # nodes among which the two nearest are looked for, at least


class BatchNeuralGas:
    """Neural gas trained by batch passes whose winners are searched in nearby image bins.

    A pass finds the nearest node of every seed among the nodes of the image bins around it,
    then moves each node to the mean of the seeds it won: eq. (2) at the end of the annealing,
    where only the winner moves, for all seeds at once. What the long annealing is for, nodes in
    the right numbers everywhere, is done directly instead: nodes whose seeds would be served
    almost as well by their neighbours are put beside nodes that serve theirs badly, as long as
    that pays (the utility of Fritzke's LBG-U, 1997). Nodes left behind by a moving camera have
    no utility at all, and nodes at newly seen surfaces large errors, so that the same rule keeps
    a live training alive.

    Parameters
    ----------
    nodes : int
        Number of nodes N.
    seed : int
        Seed of the first draw; equal seeds give equal nodes, whatever `threads` is.
    threads : int, optional
        Threads of the search; default one per processor.

    Attributes
    ----------
    nodes_mm_ : float32 array of shape (N, 3)
        Nodes in space; none before the first training.
    nodes_uv_ : float32 array of shape (N, 2)
        Mean pixel (column, row) of the seeds each node won.
    won_ : bool array of shape (N,)
        Nodes that mean something for the last frame: those that won a seed, or were adopted.
    quantisation_error_mm_ : float
        Mean distance of the seeds of the last frame to their winners.
    reheated_ : bool
        Whether the last update took the passes of a cold training because the scene had changed.
    """

    def __init__(self, nodes: int, seed: int, threads: int | None = None) -> None:
        self._nodes, self._seed, self._threads = nodes, seed, threads
        self.nodes_mm_: Floats = np.zeros((0, 3), np.float32)
        self.nodes_uv_: Floats = np.zeros((0, 2), np.float32)
        self.won_: Bools = np.zeros(0, np.bool_)
        self.quantisation_error_mm_ = math.nan
        self.reheated_ = False

    def train(self, points_mm: Floats, uv: Ints) -> Self:
        """Train from nothing.

        Parameters
        ----------
        points_mm : float32 array of shape (M, 3)
            Metric points of the seeds, all finite, at least one.
        uv : int32 array of shape (M, 2)
            Their pixels (column, row).
        """
        rng = np.random.default_rng(self._seed)
        # One draw for both: a node begins with the place and the pixel of a seed.
        both = np.concatenate((points_mm, uv), axis=1, dtype=np.float32)
        first = draw_nodes(both, self._nodes, rng)
        self.nodes_mm_ = np.ascontiguousarray(first[:, :3])
        self.nodes_uv_ = np.ascontiguousarray(first[:, 3:])
        self._pass(points_mm, uv, COLD_PASSES)
        self.reheated_ = False
        return self

    def update(self, points_mm: Floats, uv: Ints) -> Self:
        """Go on from the last frame's nodes; the first update trains. Arguments as for `train`."""
        if len(self.nodes_mm_) == 0:
            return self.train(points_mm, uv)
        self._pass(points_mm, uv, LIVE_PASSES, REHEAT_AT * self.quantisation_error_mm_)
        return self

    def adopt(self, nodes_mm: Floats, nodes_uv: Floats, points_mm: Floats) -> Self:
        """Take over nodes trained otherwise, to go on from them.

        Parameters
        ----------
        nodes_mm : float32 array of shape (N, 3)
            Nodes in space.
        nodes_uv : float32 array of shape (N, 2)
            Nodes in the image.
        points_mm : float32 array of shape (M, 3)
            The points they were trained on, for the quantisation error.
        """
        self.nodes_mm_, self.nodes_uv_ = nodes_mm, nodes_uv.copy()
        self.won_ = np.ones(len(nodes_mm), dtype=np.bool_)
        distance, _ = nearest_points(nodes_mm, points_mm)
        self.quantisation_error_mm_ = float(distance.mean())
        self.reheated_ = False
        return self

    def _pass(self, points: Floats, pixels: Ints, passes: int, most: float = math.inf) -> None:
        """Take batch passes; as many as from nothing if the error at first is above `most`."""
        uv = pixels.astype(np.float32)
        # Axis by axis: NumPy reduces an array this narrow along its length 20 times slower.
        low = np.array([axis.min() for axis in uv.T])
        size = np.array([axis.max() for axis in uv.T]) - low + 1
        bin_px = max(1.0, math.sqrt(float(size[0] * size[1]) * _NODES_PER_BIN / self._nodes))
        columns, rows = (int(n) for n in size // bin_px + 1)
        uv -= low
        self.nodes_uv_ -= low
        winner = np.empty(len(points), dtype=np.int32)
        d2 = np.empty((2, len(points)), dtype=np.float32)
        seeds = _sort_into_bins(points, uv, bin_px, rows, columns)
        done = 0
        while True:
            nodes = _sort_into_bins(self.nodes_mm_, self.nodes_uv_, bin_px, rows, columns)
            in_bands(_find_two, rows * columns, self._threads, rows, columns, seeds, nodes, winner, d2)
            if done == 0:
                self.reheated_ = _mean_distance(d2[0]) > most
                passes = COLD_PASSES if self.reheated_ else passes
            if done == passes:
                break
            # The last passes settle the nodes that were put elsewhere.
            relocate = done < passes - min(SETTLING_PASSES, passes // 2)
            _move(points, uv, winner, d2, self.nodes_mm_, self.nodes_uv_, relocate)
            done += 1
        self.nodes_uv_ += low
        self.won_ = np.zeros(self._nodes, dtype=np.bool_)
        self.won_[winner] = True
        self.quantisation_error_mm_ = _mean_distance(d2[0])


def _mean_distance(d2: Floats) -> float:
    return float(np.sqrt(d2).mean(dtype=np.float64))


# Kernels are given their arrays: to compile the making of one takes up to a quarter of a second.


def _sort_into_bins(
    nodes: Floats, nodes_uv: Floats, bin_px: float, rows: int, columns: int
) -> tuple[Ints, Ints, Floats]:
    """Nodes, or seeds, ordered by image bin: first index of each bin, their numbers and coordinates."""
    starts, cell = np.zeros(rows * columns + 2, np.int32), np.empty(len(nodes), np.int32)
    number, xyz = np.empty(len(nodes), np.int32), np.empty((3, len(nodes)), np.float32)
    _fill_bins(nodes, nodes_uv, bin_px, (rows, columns), cell, starts, number, xyz)
    return starts[:-1], number, xyz


@njit(cache=True, nogil=True)
def _fill_bins(nodes, nodes_uv, bin_px, shape, cell, starts, number, xyz):  # type: ignore[no-untyped-def]
    """Fill in what `_sort_into_bins` gives; `starts` has one more, all 0, that is of no use afterwards."""
    rows, columns = shape
    count = len(nodes)
    for i in range(count):
        c = min(max(int(nodes_uv[i, 0] / bin_px), 0), columns - 1)
        r = min(max(int(nodes_uv[i, 1] / bin_px), 0), rows - 1)
        cell[i] = r * columns + c
        starts[cell[i] + 2] += 1
    for b in range(rows * columns):
        starts[b + 1] += starts[b]
    # One place further than they belong; each moves to its own as its bin is filled.
    for i in range(count):
        j = starts[cell[i] + 1]
        starts[cell[i] + 1] += 1
        number[j] = i
        for k in range(3):
            xyz[k, j] = nodes[i, k]


@njit(cache=True, nogil=True, fastmath={"nnan", "ninf", "nsz", "contract"})
def _find_two(first, end, rows, columns, seeds, nodes, winner, d2):  # type: ignore[no-untyped-def]
    """Winners of the seeds in the bins first..end among the nodes around each; distances of the nearest two."""
    seed_starts, seed_number, seed_xyz = seeds
    starts, number, xyz = nodes
    far = np.float32(3e38)
    # The nodes around a bin, side by side.
    near, names = np.empty((3, len(number)), np.float32), np.empty(len(number), np.int32)
    sx, sy, sz = near[0], near[1], near[2]
    for b in range(first, end):
        if seed_starts[b] == seed_starts[b + 1]:
            continue
        r, c = b // columns, b % columns
        met = ring = 0
        while met < _ENOUGH and ring < max(rows, columns):
            ring += 1
            met = 0
            left, right = max(c - ring, 0), min(c + ring, columns - 1)
            for row in range(max(r - ring, 0), min(r + ring, rows - 1) + 1):
                for j in range(starts[row * columns + left], starts[row * columns + right + 1]):
                    sx[met], sy[met], sz[met], names[met] = xyz[0, j], xyz[1, j], xyz[2, j], number[j]
                    met += 1
        for i in range(seed_starts[b], seed_starts[b + 1]):
            x, y, z = seed_xyz[0, i], seed_xyz[1, i], seed_xyz[2, i]
            one, two, at = far, far, 0
            for j in range(met):
                dx = sx[j] - x
                dy = sy[j] - y
                dz = sz[j] - z
                d = dx * dx + dy * dy + dz * dz
                # Choices, not branches: which node is nearer is not predictable.
                nearer = d < one
                loser = one if nearer else d
                two = loser if loser < two else two
                at = j if nearer else at
                one = d if nearer else one
            p = seed_number[i]
            winner[p] = names[at]
            d2[0, p], d2[1, p] = one, two


def _move(
    points: Floats, uv: Floats, winner: Ints, d2: Floats, nodes: Floats, nodes_uv: Floats, relocate: bool
) -> None:
    """Move nodes to the means of the seeds they won; relocate those that are of little use."""
    count = len(nodes)
    tally = np.zeros((count, 6), np.float32), np.zeros((2, count), np.float32), np.full(count, -1, np.int32)
    _move_all(points, uv, winner, d2, nodes, nodes_uv, tally, relocate)


@njit(cache=True, nogil=True)
def _move_all(points, uv, winner, d2, nodes, nodes_uv, tally, relocate):  # type: ignore[no-untyped-def]
    """`_move`, with room for what is added up: sums over each node's seeds, its error and utility, its worst seed."""
    count = len(nodes)
    sums, worth, worst = tally
    error, utility = worth[0], worth[1]
    for p in range(len(points)):
        j = winner[p]
        for k in range(3):
            sums[j, k] += points[p, k]
        for k in range(2):
            sums[j, 3 + k] += uv[p, k]
        sums[j, 5] += np.float32(1)
        error[j] += d2[0, p]
        utility[j] += d2[1, p] - d2[0, p]
        if worst[j] < 0 or d2[0, p] > d2[0, worst[j]]:
            worst[j] = p
    for j in range(count):
        if sums[j, 5] > 0:
            share = np.float32(1) / sums[j, 5]
            for k in range(3):
                nodes[j, k] = sums[j, k] * share
            for k in range(2):
                nodes_uv[j, k] = sums[j, 3 + k] * share
    if not relocate:
        return
    # As many nodes of the lowest utility as there are errors that outweigh them: the level at
    # which the two counts meet, by bisection, needs no sorting.
    low = high = np.float32(0)
    for j in range(count):
        high = max(high, GAIN * error[j])
    for _ in range(24):
        level = np.float32(0.5) * (low + high)
        useless = 0
        needed = 0
        for j in range(count):
            useless += int(utility[j] < level)
            needed += int(GAIN * error[j] > level)
        if useless < needed:
            low = level
        else:
            high = level
    j = 0
    for target in range(count):
        if GAIN * error[target] > high:
            while j < count and utility[j] >= high:
                j += 1
            if j == count:
                return
            p = worst[target]
            for k in range(3):
                nodes[j, k] = points[p, k]
            for k in range(2):
                nodes_uv[j, k] = uv[p, k]
            j += 1
