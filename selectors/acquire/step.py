"""Where the model is likely to be wrong: the project's own score of unmeasured pixels.

Almost all of the error of a sparse depth model sits at depth steps, between a sample on one
surface and a sample on the other. A pixel there belongs to either, and nobody knows to which:
its expected squared error is the spread of the depths around it, weighted by how near they are.
A shot halves the stretch in which the step can lie, so the spread counts the more the farther
the nearest samples are. Shots that returned nothing mark holes: the chance of a return is the
share of the neighbours that did.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.choice import best_pixels
from selective_depth.selectors.parallel import in_bands
from selective_depth.selectors.samples import Samples
from selective_depth.selectors.seeds import SeedGrid
from selective_depth.selectors.selection import Plan, Selection

Image = npt.NDArray[np.float32]
Number = float | np.float32

_SAMPLED = 16
"""One tile in so many is scored first, to see where the line will be drawn."""

_MARGIN = 1.3
"""The line is drawn for so many times the pixels wanted: a second pass costs more."""

_BANDS = 8
"""Tiles are dealt out in so many hands: what is dear lies side by side in the image."""

_LANES = 16  # pixels of a block that are computed at once
_SLOTS = 6  # voters of a pixel, at most
_NONE = np.float32(1 << 23)  # greater than all that stand for a sample
_USED_LANES = 11  # 3x3 of the 4x4: 16 numbers are as quickly computed as 9
_0, _HALF, _1, _4096 = np.float32(0), np.float32(0.5), np.float32(1), np.float32(4096)

# Position of the lowest set bit of a word: multiplied by a de Bruijn sequence, each single bit
# leaves another number in the top six bits.
_DE_BRUIJN = np.uint64(0x03F79D71B4CB0A89)
_BIT_OF = np.zeros(64, np.int64)
for _bit in range(64):
    _BIT_OF[((1 << _bit) * int(_DE_BRUIJN) & (2**64 - 1)) >> 58] = _bit


@njit(cache=True, nogil=True, inline="always")
def _most_worth(low_mm: Number, high_mm: Number, gap_px: Number, noise_mm2: Number) -> float:
    """Upper bound of the score of a pixel whose voters' depths lie between two values."""
    # A variance is never more than a quarter of the squared range (Popoviciu).
    return float(((high_mm - low_mm) ** 2 / 4 + noise_mm2) * gap_px * 1.001)


@njit(cache=True, nogil=True, error_model="numpy")
def _hear(hit_du: Image, hit_dv: Image, hits: int, vote_sq: Number, near: Image) -> None:
    """Nearest samples of each pixel of a block of 4x4, in order: `_SLOTS` rows of `_LANES`.

    A sample is written as one number, squared distance before its place in the list: so
    sorting is nothing but minima and maxima, of all pixels at once.
    """
    near[:] = _NONE
    for i in range(hits):
        first_du, first_dv, place = hit_du[i] + _1, hit_dv[i] + _1, np.float32(i)
        for lane in range(_LANES):
            du, dv = first_du - np.float32(lane & 3), first_dv - np.float32(lane >> 2)
            squared = du * du + dv * dv
            key = squared * _4096 + place if squared <= vote_sq else _NONE
            for slot in range(_SLOTS):
                old = near[slot * _LANES + lane]
                near[slot * _LANES + lane] = old if old < key else key
                key = key if old < key else old


@njit(cache=True, nogil=True, error_model="numpy")
def _spreads(near: Image, hit_mm: Image, weight_of: Image, voters: int, heard: Image) -> None:
    """Weight of the voters of each pixel of a block, and weighted variance of their depths.

    `heard` receives `_LANES` weights and as many variances; behind them, it is scratch.
    """
    for slot in range(voters):
        for lane in range(_USED_LANES):
            at = slot * _LANES + lane
            key, z, w = np.int32(near[at]), _0, _0
            if key < _NONE:
                z, w = hit_mm[key & 4095], weight_of[key >> 12]
            heard[2 * _LANES + at] = z
            heard[(2 + _SLOTS) * _LANES + at] = w
    for lane in range(_LANES):
        weight, total, spread = _0, _0, _0
        for slot in range(_SLOTS):
            at = 2 * _LANES + slot * _LANES + lane
            w = heard[_SLOTS * _LANES + at]
            weight += w
            total += w * heard[at]
        mean = total / weight
        for slot in range(_SLOTS):
            at = 2 * _LANES + slot * _LANES + lane
            off = heard[at] - mean
            spread += heard[_SLOTS * _LANES + at] * (off * off)
        heard[lane] = weight
        heard[_LANES + lane] = spread / weight


@njit(cache=True, nogil=True, error_model="numpy")
def _score_tiles(
    tiles: npt.NDArray[np.int64],
    tile_px: int,
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
    least: float,
    score: Image,
    most: Image,
    first: int,
    end: int,
) -> None:
    """Score the pixels of the tiles first..end of a list that may be worth `least` or more.

    Blocks of 3x3 pixels share one search: around the middle, no pixel is farther than sqrt(2),
    so all its voters lie within the distance of the middle's last voter and twice that. If the
    depths found there are too alike for `least`, the block is done, and its scores are left 0.

    `weight_of` and `length_of` are indexed by squared distance, and so is `half_of`: the
    greatest whole number whose square is not above it. `most` receives each tile's best score.
    """
    height, width = image_mm.shape
    tile_columns = (width + tile_px - 1) // tile_px
    corner_px = np.sqrt(2.0)
    most_gap_px, noise_sq = np.float32(gap_px), np.float32(noise_mm2)
    vote_sq = vote_px * vote_px
    search_sq = len(half_of) - 1  # of the middle of a block: for the voters of all its pixels
    reach_sq = reach_px * reach_px
    one = np.uint64(1)
    # Of the rows in reach of a tile, and of a row of blocks: the shots from `left - vote_px` on.
    tile_word = np.empty(tile_px + 2 * vote_px, np.uint64)
    row_word = np.empty(2 * vote_px + 3, np.uint64)
    row_dv = np.empty(2 * vote_px + 3, np.int64)
    # What is near a block, from its middle.
    room = (2 * vote_px + 3) ** 2
    hit_du, hit_dv = np.empty(room, np.float32), np.empty(room, np.float32)
    hit_mm = np.empty(room, np.float32)
    miss_du, miss_dv = np.empty(room, np.int64), np.empty(room, np.int64)
    near_sq = np.empty(voters + 1, np.int64)  # squared distances of the middle's voters
    near = np.empty(_SLOTS * _LANES, np.float32)
    heard = np.zeros(2 * (1 + _SLOTS) * _LANES, np.float32)
    for k in range(first, end):
        top = tiles[k] // tile_columns * tile_px
        left = tiles[k] % tile_columns * tile_px
        start = left - vote_px + 64  # the padding's width in bits
        word, shift = start >> 6, np.uint64(start & 63)
        for i in range(tile_px + 2 * vote_px):
            y = top - vote_px + i
            tile_word[i] = 0
            if 0 <= y < height:
                tile_word[i] = bits[y, word] >> shift
                if shift > 0:
                    tile_word[i] |= bits[y, word + 1] << (np.uint64(64) - shift)
        best = np.float32(0)
        for middle_v in range(top + 1, min(top + tile_px, height + 1), 3):
            rows = 0  # those with shots, the nearest first
            for step in range(2 * vote_px + 3):
                dv = (step + 1) // 2 if step & 1 else -(step // 2)
                found_word = tile_word[middle_v + dv - top + vote_px]
                if found_word:
                    row_word[rows], row_dv[rows] = found_word, dv
                    rows += 1
            for middle_u in range(left + 1, min(left + tile_px, width + 1), 3):
                block_bottom, block_right = min(middle_v + 2, height), min(middle_u + 2, width)
                score[middle_v - 1 : block_bottom, middle_u - 1 : block_right] = 0
                hits = misses = found = 0
                farthest = search_sq
                # As voters are found, the window closes in on the block.
                for row in range(rows):
                    dv = row_dv[row]
                    if dv * dv > farthest:
                        break
                    half = half_of[farthest - dv * dv]
                    window = row_word[row] >> np.uint64(middle_u - left + vote_px - half)
                    window &= (one << np.uint64(2 * half + 1)) - one
                    while window:
                        lowest = window & (~window + one)
                        window ^= lowest
                        du = _BIT_OF[(lowest * _DE_BRUIJN) >> np.uint64(58)] - half
                        d = du * du + dv * dv
                        if d > farthest:
                            continue
                        z = image_mm[middle_v + dv, middle_u + du]
                        if z < 0:
                            miss_du[misses], miss_dv[misses] = du, dv
                            misses += 1
                            continue
                        hit_du[hits], hit_dv[hits], hit_mm[hits] = du, dv, z
                        hits += 1
                        if found < voters or d < near_sq[voters - 1]:
                            at = min(found, voters - 1)
                            while at > 0 and near_sq[at - 1] > d:
                                near_sq[at] = near_sq[at - 1]
                                at -= 1
                            near_sq[at] = d
                            found = min(found + 1, voters)
                            if found == voters:
                                span = length_of[near_sq[voters - 1]] + 2 * corner_px + 1e-6
                                farthest = min(search_sq, int(span * span))
                low, high = np.float32(np.inf), np.float32(0)
                kept = 0
                for i in range(hits):
                    du, dv, z = hit_du[i], hit_dv[i], hit_mm[i]
                    if du * du + dv * dv <= farthest:
                        hit_du[kept], hit_dv[kept], hit_mm[kept] = du, dv, z
                        kept += 1
                        low, high = min(low, z), max(high, z)
                if kept == 0 or _most_worth(low, high, gap_px, noise_mm2) < least:
                    continue
                _hear(hit_du, hit_dv, kept, np.float32(vote_sq), near)
                _spreads(near, hit_mm, weight_of, voters, heard)
                for v in range(middle_v - 1, block_bottom):
                    for u in range(middle_u - 1, block_right):
                        if image_mm[v, u] != 0:
                            continue
                        lane = (v - middle_v + 1) * 4 + u - middle_u + 1
                        nearest_sq = int(near[lane]) >> 12
                        if nearest_sq > reach_sq:
                            continue
                        second_sq = int(near[_LANES + lane]) >> 12
                        if second_sq > vote_sq:
                            second_sq = nearest_sq
                        gap = (length_of[nearest_sq] + length_of[second_sq]) * _HALF
                        s = (heard[_LANES + lane] + noise_sq) * min(gap, most_gap_px)
                        if misses:
                            farthest = min(vote_sq, int(near[(voters - 1) * _LANES + lane]) >> 12)
                            returned = all_weight = heard[lane]
                            for i in range(misses):
                                du, dv = miss_du[i] + middle_u - u, miss_dv[i] + middle_v - v
                                d = du * du + dv * dv
                                if d <= farthest:
                                    all_weight += weight_of[d]
                            s *= np.sqrt(returned / all_weight)
                        score[v, u] = s
                        best = max(best, np.float32(s))
        most[tiles[k] // tile_columns, tiles[k] % tile_columns] = best


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
            bound[r, c] = -1 if low > high else _most_worth(low, high, gap_px, noise_mm2)
    return bound


@lru_cache(maxsize=8)
def _tables(falloff: float, vote_px: int) -> tuple[Image, Image, npt.NDArray[np.int64]]:
    """Weight, length and whole root of every squared distance up to that of a block's voters."""
    length = np.sqrt(np.arange(int((vote_px + 2**0.5) ** 2) + 1))
    weight = 1 / (length**falloff + 1)
    return weight.astype(np.float32), length.astype(np.float32), length.astype(np.int64)


@dataclass(frozen=True)
class StepSelector:
    """The project's own score: expected squared error, times how far a shot reaches.

    ``sqrt(P(return)) * (sum_k w_k (z_k - mean)^2 / sum_k w_k + noise^2) * gap`` over the nearest
    samples that returned depth. ``w = 1 / (distance^falloff + 1)``; `mean` is their weighted
    mean; `gap` is the mean distance of the two nearest, at most so many steps; ``P(return)`` is the
    share of their weight in that of all shots as near, and its root because even a shot that
    misses tells where the hole ends. Chosen on the `livingroom` and `tabletop` frames; figures
    in ``app/docs/evaluation.md``.

    Parameters
    ----------
    voters : int, default 5
        How many samples vote, 2 to 6.
    falloff : float, default 4
        How fast a vote fades with distance: the slower, the wider the band about a strong step
        that is shot all over before a weaker one is looked at.
    gap : float, default 0.8
        Distance, in steps of the seed lattice, beyond which being farther from the samples
        counts no more (4 pixels for 128x128 seeds on 640x480).
    noise_mm : float, default 1
        Error expected even where all neighbours agree; it spends what is left of a budget on
        the widest gaps.
    threads : int, optional
        Kernel threads; default `default_threads()`. The result does not depend on it.

    Raises
    ------
    ValueError
        If `voters` is out of its range.
    """

    voters: int = 5
    falloff: float = 4.0
    gap: float = 0.8
    noise_mm: float = 1.0
    threads: int | None = None
    name = "step score"

    def __post_init__(self) -> None:
        if not 2 <= self.voters <= _SLOTS:  # the gap is told by two
            raise ValueError(f"voters is {self.voters}; give between 2 and {_SLOTS}")

    def select(self, samples: SeedGrid | Samples) -> Selection:
        """Score every pixel, in mm^2 times pixels; the mask is the best tenth of them."""
        known = Samples.of(samples)
        score = np.empty(known.frame_shape, np.float32)
        most = np.empty(known.changed.shape, np.float32)
        self._score(known, np.arange(known.changed.size), 0.0, score, most)
        return Selection.of_score(score, self.name)

    def plan(self, samples: Samples) -> Plan:
        """Begin an acquisition; same choice as by the whole map, at a fraction of the work."""
        return _StepPlan(self, samples)

    def _score(
        self,
        samples: Samples,
        tiles: npt.NDArray[np.int64],
        least: float,
        score: Image,
        most: Image,
    ) -> None:
        weight_of, length_of, half_of = _tables(self.falloff, samples.vote_px)
        dealt = np.concatenate([tiles[hand::_BANDS] for hand in range(_BANDS)])
        in_bands(
            lambda first, end: _score_tiles(
                dealt,
                samples.tile_px,
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
                least,
                score,
                most,
                first,
                end,
            ),
            len(dealt),
            self.threads,
        )

    def _bounds(self, samples: Samples) -> Image:
        gap_px = self.gap * samples.pitch_px
        return _tile_bounds(samples.low_mm, samples.high_mm, gap_px, self.noise_mm**2)


class _StepPlan(Plan):
    """Scores only what has changed and can be among the best pixels.

    The range of the depths around a tile bounds its scores, and so it does in a tile, block by
    block. A sample of the tiles tells about where the line will be drawn; what is bounded below
    it cannot matter if enough pixels reach it, and if not, it is lowered. The pixels chosen are
    those that the whole map would give.
    """

    def __init__(self, rule: StepSelector, samples: Samples) -> None:
        self._rule = rule
        self._samples = samples
        self._map = np.zeros(samples.frame_shape, np.float32)
        tiles = samples.changed.shape
        self._most = np.zeros(tiles, np.float32)  # best score in each tile
        # Scores of a tile are true from this one on; lower ones may be missing.
        self._floor = np.full(tiles, np.inf, np.float32)
        self._seen = samples.additions

    def best(self, shots: int) -> npt.NDArray[np.int32]:
        """The `shots` pixels that are worth most, from the samples as they are now."""
        samples = self._samples
        outdated = (samples.changed > self._seen) & (self._floor < np.inf)
        _clear_tiles(self._map, np.flatnonzero(outdated), samples.tile_px)
        self._floor[outdated] = np.inf
        self._most[outdated] = 0
        self._seen = samples.additions
        bound = self._rule._bounds(samples)
        least = self._first_line(bound, shots)
        while True:
            self._score(bound >= least, least)
            chosen = self._best(np.flatnonzero(self._most >= least), shots, least)[0]
            if len(chosen) == shots or least <= 0:
                return chosen
            least = least / 4 if least > self._rule.noise_mm**2 else 0.0

    def _first_line(self, bound: Image, shots: int) -> float:
        """About what the last of the best pixels will be worth, rather less."""
        sample = np.zeros(bound.shape, np.bool_)
        sample.ravel()[np.argsort(bound, axis=None)[_SAMPLED // 2 :: _SAMPLED]] = True
        self._score(sample, 0.0)
        wanted = int(_MARGIN * shots / _SAMPLED) + 1
        chosen, worst = self._best(np.flatnonzero(sample), wanted, 0.0)
        return float(worst) if len(chosen) == wanted else 0.0

    def _score(self, wanted: npt.NDArray[np.bool_], least: float) -> None:
        """Make the scores of some tiles true from `least` on."""
        due = wanted & (self._floor > least)
        tiles = np.flatnonzero(due)
        self._rule._score(self._samples, tiles, least, self._map, self._most)
        self._floor[due] = least

    def _best(
        self, tiles: npt.NDArray[np.int64], shots: int, least: float
    ) -> tuple[npt.NDArray[np.int32], np.float32]:
        tile_px = self._samples.tile_px
        return best_pixels(self._map, tiles, shots, least, tile_px, self._rule.threads)
