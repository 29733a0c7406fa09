"""Where the model is likely to be wrong: the project's own score of unmeasured pixels.

Almost all of the error of a sparse depth model sits at depth steps, between a sample on one
surface and a sample on the other. A pixel there belongs to either, and nobody knows to which:
its expected squared error is the spread of the depths around it, weighted by how near they are.
A shot halves the stretch in which the step can lie, so the spread counts the more the farther
the nearest samples are. Shots that returned nothing mark holes: the chance of a return is the
share of the neighbours that did.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from numba import njit

from selective_depth.selectors.choice import best_pixels, choose
from selective_depth.selectors.parallel import in_bands
from selective_depth.selectors.samples import Samples

Image = npt.NDArray[np.float32]

# Position of the lowest set bit of a word: multiplied by a de Bruijn sequence, each single bit
# leaves another number in the top six bits.
_DE_BRUIJN = np.uint64(0x03F79D71B4CB0A89)
_BIT_OF = np.zeros(64, np.int64)
for _bit in range(64):
    _BIT_OF[((1 << _bit) * int(_DE_BRUIJN) & (2**64 - 1)) >> 58] = _bit


class Plan(ABC):
    """An acquisition under way: says, round after round, which pixels to measure next."""

    @abstractmethod
    def best(self, shots: int) -> npt.NDArray[np.int32]:
        """At most so many pixels, shape (n, 2), column first, from the samples as they are."""


class Score(ABC):
    """What a measurement is worth at each pixel, from the samples alone."""

    name: str = "score"

    @abstractmethod
    def map(self, samples: Samples, threads: int | None = None) -> Image:
        """Worth of a shot at every pixel, float32 (H, W); 0 where none should be made."""

    def plan(self, samples: Samples, threads: int | None = None) -> Plan:
        """Begin an acquisition that adds its measurements to `samples`."""
        return _MapPlan(self, samples, threads)


@dataclass(frozen=True, eq=False)
class _MapPlan(Plan):
    """The plain way: the whole map anew in every round."""

    score: Score
    samples: Samples
    threads: int | None

    def best(self, shots: int) -> npt.NDArray[np.int32]:
        return choose(self.score.map(self.samples, self.threads), shots)


@njit(cache=True, nogil=True)
def _score_tiles(
    tiles: npt.NDArray[np.int64],
    image_mm: Image,
    bits: npt.NDArray[np.uint64],
    weight_of: Image,
    length_of: Image,
    half_of: npt.NDArray[np.int64],
    vote_px: int,
    reach_px: float,
    voters: int,
    gap_px: float,
    noise_mm2: float,
    score: Image,
    first: int,
    end: int,
) -> None:
    """Score the pixels of the tiles first..end of a list.

    `weight_of` and `length_of` are indexed by squared distance, and so is `half_of`: the
    greatest whole number whose square is not above it.
    """
    height, width = image_mm.shape
    tile_px = vote_px + 1
    tile_columns = (width + tile_px - 1) // tile_px
    near_sq = np.empty(voters + 1, np.int64)  # squared distances of the voters, nearest first
    near_mm = np.empty(voters + 1, np.float32)
    missed_sq = np.empty((2 * vote_px + 1) ** 2, np.int64)
    reach_sq = reach_px * reach_px
    vote_radius = np.float32(vote_px)
    one = np.uint64(1)
    # Of the rows in reach of a tile, and of a row of it: the shots from `left - vote_px` on.
    tile_word = np.empty(3 * vote_px + 1, np.uint64)
    row_word = np.empty(2 * vote_px + 1, np.uint64)
    row_dv = np.empty(2 * vote_px + 1, np.int64)
    for k in range(first, end):
        top = tiles[k] // tile_columns * tile_px
        left = tiles[k] % tile_columns * tile_px
        start = left - vote_px + 64  # the padding's width in bits
        word, shift = start >> 6, np.uint64(start & 63)
        for i in range(3 * vote_px + 1):
            y = top - vote_px + i
            tile_word[i] = 0
            if 0 <= y < height:
                tile_word[i] = bits[y, word] >> shift
                if shift > 0:
                    tile_word[i] |= bits[y, word + 1] << (np.uint64(64) - shift)
        # From one pixel to the next, the distance to its last voter grows by one at most.
        row_radius = vote_radius
        for v in range(top, min(top + tile_px, height)):
            radius = row_radius = min(row_radius + 1, vote_radius)
            rows = 0  # those with shots, the nearest first
            for step in range(2 * vote_px + 1):
                dv = (step + 1) // 2 if step & 1 else -(step // 2)
                found_word = tile_word[v + dv - top + vote_px]
                if found_word:
                    row_word[rows], row_dv[rows] = found_word, dv
                    rows += 1
            for u in range(left, min(left + tile_px, width)):
                radius = min(radius + 1, vote_radius)
                score[v, u] = 0
                if image_mm[v, u] != 0:
                    continue
                found = 0
                missed = 0
                farthest = int(radius * radius)
                # As voters are found, the window closes in on the pixel.
                for row in range(rows):
                    dv = row_dv[row]
                    if dv * dv > farthest:
                        break
                    half = half_of[farthest - dv * dv]
                    window = row_word[row] >> np.uint64(u - left + vote_px - half)
                    window &= (one << np.uint64(2 * half + 1)) - one
                    while window:
                        lowest = window & (~window + one)
                        window ^= lowest
                        du = _BIT_OF[(lowest * _DE_BRUIJN) >> np.uint64(58)] - half
                        d = du * du + dv * dv
                        if d > farthest:
                            continue
                        z = image_mm[v + dv, u + du]
                        if z < 0:
                            missed_sq[missed] = d
                            missed += 1
                        elif found < voters or d < farthest:
                            at = min(found, voters - 1)
                            while at > 0 and near_sq[at - 1] > d:
                                near_sq[at] = near_sq[at - 1]
                                near_mm[at] = near_mm[at - 1]
                                at -= 1
                            near_sq[at] = d
                            near_mm[at] = z
                            found = min(found + 1, voters)
                            if found == voters:
                                farthest = near_sq[voters - 1]
                if found == voters:
                    radius = length_of[farthest]
                    if u == left:
                        row_radius = radius
                if found == 0 or near_sq[0] > reach_sq:
                    continue
                returned = np.float32(0)
                total = np.float32(0)
                for i in range(found):
                    w = weight_of[near_sq[i]]
                    returned += w
                    total += w * near_mm[i]
                mean = total / returned
                spread = np.float32(0)
                for i in range(found):
                    spread += weight_of[near_sq[i]] * (near_mm[i] - mean) ** 2
                all_weight = returned
                for i in range(missed):
                    if missed_sq[i] <= farthest:
                        all_weight += weight_of[missed_sq[i]]
                gap = (length_of[near_sq[0]] + length_of[near_sq[min(1, found - 1)]]) / 2
                score[v, u] = (
                    (spread / returned + noise_mm2)
                    * np.sqrt(returned / all_weight)
                    * min(gap, gap_px)
                )


@njit(cache=True, nogil=True)
def _clear_tiles(score: Image, tiles: npt.NDArray[np.int64], tile_px: int) -> None:
    """Forget the scores of some tiles."""
    tile_columns = (score.shape[1] + tile_px - 1) // tile_px
    for k in range(len(tiles)):
        top, left = tiles[k] // tile_columns * tile_px, tiles[k] % tile_columns * tile_px
        score[top : top + tile_px, left : left + tile_px] = 0


@njit(cache=True, nogil=True)
def _tile_bounds(low_mm: Image, high_mm: Image, gap_px: float, noise_mm2: float) -> Image:
    """Upper bound of the score in each tile, -1 where nothing is near enough to score."""
    rows, columns = low_mm.shape
    bound = np.empty((rows, columns), np.float32)
    for r in range(rows):
        for c in range(columns):
            low, high = np.float32(np.inf), np.float32(0)
            for y in range(max(r - 1, 0), min(r + 2, rows)):
                for x in range(max(c - 1, 0), min(c + 2, columns)):
                    low = min(low, low_mm[y, x])
                    high = max(high, high_mm[y, x])
            # A variance is never more than a quarter of the squared range (Popoviciu).
            bound[r, c] = -1 if low > high else ((high - low) ** 2 / 4 + noise_mm2) * gap_px * 1.001
    return bound


@lru_cache(maxsize=8)
def _tables(falloff: float, vote_px: int) -> tuple[Image, Image, npt.NDArray[np.int64]]:
    """Weight, length and whole root of every squared distance up to `vote_px` squared."""
    length = np.sqrt(np.arange(vote_px * vote_px + 1))
    weight = 1 / (length**falloff + 1)
    return weight.astype(np.float32), length.astype(np.float32), length.astype(np.int64)


@dataclass(frozen=True)
class StepScore(Score):
    """The project's own score: expected squared error, times how far a shot reaches.

    ``sqrt(P(return)) * (sum_k w_k (z_k - mean)^2 / sum_k w_k + noise^2) * gap`` over the nearest
    samples that returned depth. ``w = 1 / (distance^falloff + 1)``; `mean` is their weighted
    mean; `gap` is the mean distance of the two nearest, at most so many steps; ``P(return)`` is the
    share of their weight in that of all shots as near, and its root because even a shot that
    misses tells where the hole ends. Chosen on the `livingroom` and `tabletop` frames; figures
    in ``app/docs/evaluation.md``.

    Parameters
    ----------
    voters : int, default 6
        How many samples vote. 4 see a step too late, 8 blur it.
    falloff : float, default 3
        How fast a vote fades with distance.
    gap : float, default 0.8
        Distance, in steps of the seed lattice, beyond which being farther from the samples
        counts no more (4 pixels for 128x128 seeds on 640x480).
    noise_mm : float, default 1
        Error expected even where all neighbours agree; it spends what is left of a budget on
        the widest gaps.
    """

    voters: int = 6
    falloff: float = 3.0
    gap: float = 0.8
    noise_mm: float = 1.0
    name = "step score"

    def map(self, samples: Samples, threads: int | None = None) -> Image:
        """Score of every pixel (see `Score.map`)."""
        score = np.empty(samples.shape, np.float32)
        self._score(samples, np.arange(samples.stale.size), score, threads)
        return score

    def plan(self, samples: Samples, threads: int | None = None) -> Plan:
        """Begin an acquisition; same choice as by the whole map, at a fraction of the work."""
        return _StepPlan(self, samples, threads)

    def _score(
        self,
        samples: Samples,
        tiles: npt.NDArray[np.int64],
        score: Image,
        threads: int | None,
    ) -> None:
        weight_of, length_of, half_of = _tables(self.falloff, samples.vote_px)
        in_bands(
            lambda first, end: _score_tiles(
                tiles,
                samples.image_mm,
                samples.bits,
                weight_of,
                length_of,
                half_of,
                samples.vote_px,
                samples.reach_px,
                self.voters,
                self.gap * samples.pitch_px,
                self.noise_mm**2,
                score,
                first,
                end,
            ),
            len(tiles),
            threads,
        )

    def _bounds(self, samples: Samples) -> Image:
        gap_px = self.gap * samples.pitch_px
        return _tile_bounds(samples.low_mm, samples.high_mm, gap_px, self.noise_mm**2)


class _StepPlan(Plan):
    """Scores only tiles that have changed and can hold one of the best pixels.

    The range of the depths around a tile bounds its scores. If enough pixels reach a threshold,
    tiles bounded below it cannot matter; if not, the threshold is lowered. The pixels chosen
    are those that the whole map would give.
    """

    def __init__(self, score: StepScore, samples: Samples, threads: int | None) -> None:
        self._rule = score
        self._samples = samples
        self._threads = threads
        self._map = np.zeros(samples.shape, np.float32)
        self._current = np.zeros(samples.stale.shape, np.bool_)  # tiles whose scores are true
        self._threshold = np.float32(np.inf)

    def best(self, shots: int) -> npt.NDArray[np.int32]:
        samples = self._samples
        outdated = samples.stale & self._current
        _clear_tiles(self._map, np.flatnonzero(outdated), samples.tile_px)
        self._current[outdated] = False
        samples.stale[:] = False
        bound = self._rule._bounds(samples)
        least = self._first_threshold(bound, shots)
        while True:
            wanted = bound >= least
            due = np.flatnonzero(wanted & ~self._current)
            self._rule._score(samples, due, self._map, self._threads)
            self._current |= wanted
            chosen, worst = best_pixels(
                self._map,
                np.flatnonzero(wanted),
                shots,
                float(least),
                samples.tile_px,
                self._threads,
            )
            if len(chosen) == shots or least <= 0:
                self._threshold = worst
                return chosen
            least = least / 4 if least > self._rule.noise_mm**2 else np.float32(0)

    def _first_threshold(self, bound: Image, shots: int) -> np.float32:
        """A guess: what the last round ended at, or the tiles that could hold the best."""
        if np.isfinite(self._threshold):
            return np.float32(self._threshold * 0.5)
        tiles = min(8 * shots // self._samples.tile_px**2 + 1, bound.size)
        return max(np.float32(0), np.partition(bound.ravel(), bound.size - tiles)[-tiles])
