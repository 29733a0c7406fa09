"""Where the model is likely to be wrong: the project's own score of unmeasured pixels.

Almost all of the error of a sparse depth model sits at depth steps, between a sample on one
surface and a sample on the other. A pixel there belongs to either, and nobody knows to which:
its expected squared error is the spread of the depths around it, weighted by how near they are.
A shot halves the stretch in which the step can lie, so the spread counts the more the farther
the nearest sample is. Shots that returned nothing mark holes: the chance of a return is the
share of the neighbours that did.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt
from numba import njit

from selective_depth.selectors.parallel import in_bands

MISSED = np.float32(-1)
"""In an image of samples: measured, nothing returned."""

REACH_PX = 6.5
"""Nothing is said of pixels farther than this from a sample that returned depth."""


class Score(Protocol):
    """Anything that says, from the samples so far, what a shot at each pixel is worth."""

    def map(
        self, samples_mm: npt.NDArray[np.float32], threads: int | None = None
    ) -> npt.NDArray[np.float32]:
        """Worth of a shot at every pixel, 0 where none should be made.

        Parameters
        ----------
        samples_mm : float32 array of shape (H, W)
            Depth of the samples, `MISSED` where a shot returned nothing, 0 where none was made.
        threads : int, optional
            Kernel threads; default `default_threads()`.
        """
        ...


def _disk() -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """Offsets (column, row) within `REACH_PX`, nearest first, and their lengths."""
    reach = int(REACH_PX)
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    length = np.hypot(u, v)
    inside = (length > 0) & (length <= REACH_PX)
    order = np.argsort(length[inside], kind="stable")
    offsets = np.stack((u[inside][order], v[inside][order]), axis=-1)
    return offsets.astype(np.int32), length[inside][order].astype(np.float32)


@njit(cache=True, nogil=True)
def _spread(
    samples_mm: npt.NDArray[np.float32],
    offsets: npt.NDArray[np.int32],
    weights: npt.NDArray[np.float32],
    lengths: npt.NDArray[np.float32],
    neighbours: int,
    gap_px: float,
    score: npt.NDArray[np.float32],
    first: int,
    end: int,
) -> None:
    height, width = samples_mm.shape
    depth = np.empty(neighbours, np.float32)
    weight = np.empty(neighbours, np.float32)
    for v in range(first, end):
        for u in range(width):
            score[v, u] = 0
            if samples_mm[v, u] != 0:
                continue
            found = 0
            returned = np.float32(0)
            missed = np.float32(0)
            total = np.float32(0)
            gap = np.float32(0)
            for k in range(len(offsets)):
                y, x = v + offsets[k, 1], u + offsets[k, 0]
                if y < 0 or y >= height or x < 0 or x >= width:
                    continue
                z = samples_mm[y, x]
                if z == 0:
                    continue
                if z < 0:
                    missed += weights[k]
                    continue
                if found == 0:
                    gap = lengths[k]
                depth[found] = z
                weight[found] = weights[k]
                returned += weights[k]
                total += weights[k] * z
                found += 1
                if found == neighbours:
                    break
            if found < 2:
                continue
            mean = total / returned
            spread = np.float32(0)
            for k in range(found):
                spread += weight[k] * (depth[k] - mean) ** 2
            score[v, u] = spread / (returned + missed) * min(gap, gap_px)


@dataclass(frozen=True)
class StepScore:
    """The project's own score: expected squared error, times how far a shot reaches.

    ``P(return) * sum_k w_k (z_k - mean)^2 / sum_k w_k * min(gap, gap_px)`` over the nearest
    samples that returned depth, with ``w = 1 / (distance^falloff + 1)``; ``P(return)`` is the
    weight of the samples that returned depth among all that were met on the way to them.

    Parameters
    ----------
    neighbours : int, default 6
        Samples that vote.
    falloff : float, default 3
        How fast a vote fades with distance.
    gap_px : float, default 4
        Distance to the nearest sample beyond which being farther counts no more.
    """

    neighbours: int = 6
    falloff: float = 3.0
    gap_px: float = 4.0
    _disk: tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]] = field(
        default_factory=_disk, repr=False, compare=False
    )

    def map(
        self, samples_mm: npt.NDArray[np.float32], threads: int | None = None
    ) -> npt.NDArray[np.float32]:
        """Worth of a shot at every pixel (see `Score.map`)."""
        offsets, lengths = self._disk
        weights = (1 / (lengths**self.falloff + 1)).astype(np.float32)
        score = np.empty(samples_mm.shape, np.float32)
        in_bands(
            lambda first, end: _spread(
                samples_mm,
                offsets,
                weights,
                lengths,
                self.neighbours,
                self.gap_px,
                score,
                first,
                end,
            ),
            len(samples_mm),
            threads,
        )
        return score
