"""Neural gas in a few batch passes, cold or going on from the last frame."""

from __future__ import annotations

import math
from typing import Self

import numpy as np
import numpy.typing as npt
from numba import njit

from selective_depth.selectors.neural_gas_exact import draw_nodes
from selective_depth.selectors.parallel import in_bands

COLD_PASSES = 12
"""Batch passes of a training from nothing."""
LIVE_PASSES = 2
"""Batch passes of an update from the last frame's nodes."""
REHEAT_PASSES = 8
"""Batch passes of the update after the scene has changed."""
REHEAT_AT = 1.5
"""The scene has changed where the quantisation error jumps by this factor between frames."""

_NODES_PER_BIN = 2.3
_ENOUGH = 9  # candidates among which the nearest node is looked for, at least


class BatchNeuralGas:
    """Neural gas trained by batch passes whose winners are searched in nearby image bins.

    Each pass finds the nearest node of every seed among the nodes of the image bins around it
    (widened until there are enough), and moves each node to the mean of the seeds it won: the
    batch form of eq. 2 at the end of the annealing, where only the winner moves. Nodes that won
    nothing are put back at the seeds that are served worst.

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
        Nodes in space.
    nodes_uv_ : float32 array of shape (N, 2)
        Mean pixel (column, row) of the seeds each node won.
    quantisation_error_mm_ : float
        Mean distance of the seeds to their winners.
    """

    nodes_mm_: npt.NDArray[np.float32]
    nodes_uv_: npt.NDArray[np.float32]
    quantisation_error_mm_: float

    def __init__(self, nodes: int, seed: int, threads: int | None = None) -> None:
        self._nodes = nodes
        self._seed = seed
        self._threads = threads

    def train(self, points_mm: npt.NDArray[np.float32], uv: npt.NDArray[np.int32]) -> Self:
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
        both = np.concatenate((points_mm, uv), axis=1).astype(np.float32)
        first = draw_nodes(both, self._nodes, rng)
        self.nodes_mm_ = np.ascontiguousarray(first[:, :3])
        self.nodes_uv_ = np.ascontiguousarray(first[:, 3:])
        self._passes(points_mm, uv, COLD_PASSES)
        return self

    def update(self, points_mm: npt.NDArray[np.float32], uv: npt.NDArray[np.int32]) -> Self:
        """Go on from the last frame's nodes; arguments as for `train`."""
        if not hasattr(self, "nodes_mm_"):
            return self.train(points_mm, uv)
        before = self.quantisation_error_mm_
        first = self._passes(points_mm, uv, LIVE_PASSES)
        if first > REHEAT_AT * before:
            self._passes(points_mm, uv, REHEAT_PASSES)
        return self

    def _passes(
        self, points: npt.NDArray[np.float32], pixels: npt.NDArray[np.int32], passes: int
    ) -> float:
        """Take batch passes; returns the quantisation error met by the first."""
        uv = pixels.astype(np.float32)
        low, high = uv.min(axis=0), uv.max(axis=0) + 1
        area = float(np.prod(high - low))
        bin_px = max(1.0, math.sqrt(area * _NODES_PER_BIN / self._nodes))
        uv -= low
        self.nodes_uv_ -= low
        columns, rows = (int(n) for n in (high - low) // bin_px + 1)
        label = np.empty(len(points), dtype=np.int32)
        d2 = np.empty(len(points), dtype=np.float32)
        errors = []
        for number in range(passes + 1):
            bins = _sort_into_bins(self.nodes_mm_, self.nodes_uv_, bin_px, rows, columns)

            def search(start: int, end: int, bins: tuple[object, ...] = bins) -> None:
                _assign(points, uv, bin_px, rows, columns, *bins, label, d2, start, end)

            in_bands(search, len(points), self._threads)
            errors.append(float(np.sqrt(d2).mean()))
            if number == passes:
                break
            wins = _move_to_means(points, uv, label, self.nodes_mm_, self.nodes_uv_)
            idle = np.flatnonzero(wins == 0)[: len(points)]
            if len(idle):
                worst = np.argpartition(d2, -len(idle))[-len(idle) :]
                self.nodes_mm_[idle] = points[worst]
                self.nodes_uv_[idle] = uv[worst]
        self.nodes_uv_ += low
        self.quantisation_error_mm_ = errors[-1]
        return errors[0]


def train_fast(
    points_mm: npt.NDArray[np.float32],
    uv: npt.NDArray[np.int32],
    nodes: int,
    seed: int,
    threads: int | None = None,
) -> BatchNeuralGas:
    """Train neural gas from nothing by batch passes; see `BatchNeuralGas`."""
    return BatchNeuralGas(nodes, seed, threads).train(points_mm, uv)


@njit(cache=True, nogil=True)
def _sort_into_bins(nodes, nodes_uv, bin_px, rows, columns):  # type: ignore[no-untyped-def]
    """Nodes ordered by image bin, as first index of each bin, node numbers and coordinates."""
    count = len(nodes)
    starts = np.zeros(rows * columns + 1, np.int32)
    cell = np.empty(count, np.int32)
    for i in range(count):
        c = min(max(int(nodes_uv[i, 0] / bin_px), 0), columns - 1)
        r = min(max(int(nodes_uv[i, 1] / bin_px), 0), rows - 1)
        cell[i] = r * columns + c
        starts[cell[i] + 1] += 1
    for b in range(rows * columns):
        starts[b + 1] += starts[b]
    at = starts[:-1].copy()
    number = np.empty(count, np.int32)
    xyz = np.empty((3, count), np.float32)
    for i in range(count):
        j = at[cell[i]]
        at[cell[i]] += 1
        number[j] = i
        for k in range(3):
            xyz[k, j] = nodes[i, k]
    return starts, number, xyz


@njit(cache=True, nogil=True, fastmath={"nnan", "ninf", "nsz", "contract"})
def _assign(points, uv, bin_px, rows, columns, starts, number, xyz, label, d2, first, end):  # type: ignore[no-untyped-def]
    """Nearest node of the seeds first..end among the bins around each, and its distance."""
    sx, sy, sz = xyz[0], xyz[1], xyz[2]
    for p in range(first, end):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        c = min(int(uv[p, 0] / bin_px), columns - 1)
        r = min(int(uv[p, 1] / bin_px), rows - 1)
        best = np.float32(3e38)
        at = 0
        ring = 1
        while True:
            met = 0
            left, right = max(c - ring, 0), min(c + ring, columns - 1)
            for row in range(max(r - ring, 0), min(r + ring, rows - 1) + 1):
                a = starts[row * columns + left]
                b = starts[row * columns + right + 1]
                met += b - a
                for j in range(a, b):
                    dx = sx[j] - x
                    dy = sy[j] - y
                    dz = sz[j] - z
                    d = dx * dx + dy * dy + dz * dz
                    if d < best:
                        best = d
                        at = j
            if met >= _ENOUGH or ring >= max(rows, columns):
                break
            ring += 1
        label[p] = number[at]
        d2[p] = best


@njit(cache=True, nogil=True)
def _move_to_means(points, uv, label, nodes, nodes_uv):  # type: ignore[no-untyped-def]
    """Move every node to the mean of the seeds it won; returns how many each won."""
    sums = np.zeros((len(nodes), 5), np.float32)
    wins = np.zeros(len(nodes), np.int32)
    for p in range(len(points)):
        j = label[p]
        wins[j] += 1
        for k in range(3):
            sums[j, k] += points[p, k]
        for k in range(2):
            sums[j, 3 + k] += uv[p, k]
    for j in range(len(nodes)):
        if wins[j] > 0:
            for k in range(3):
                nodes[j, k] = sums[j, k] / wins[j]
            for k in range(2):
                nodes_uv[j, k] = sums[j, 3 + k] / wins[j]
    return wins
