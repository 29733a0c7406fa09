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

from selective_depth.selectors.acquire.step_kernel import (
    SLOTS,
    Image,
    SampleIndex,
    StepRule,
    clear_tiles,
    score_tiles,
    tile_bounds,
)
from selective_depth.selectors.choice import best_pixels
from selective_depth.selectors.parallel import in_bands
from selective_depth.selectors.samples import Samples
from selective_depth.selectors.seeds import SeedGrid
from selective_depth.selectors.selection import Plan, Selection

_SAMPLED = 16
"""One tile in so many is scored first, to see where the line will be drawn."""

_MARGIN = 1.3
"""The line is drawn for so many times the pixels wanted: a second pass costs more."""

_BANDS = 8
"""Tiles are dealt out in so many hands: what is dear lies side by side in the image."""


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
        if not 2 <= self.voters <= SLOTS:  # the gap is told by two
            raise ValueError(f"voters is {self.voters}; give between 2 and {SLOTS}")

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
        index = SampleIndex(
            samples.image_mm, samples.bits, samples.tile_px, samples.vote_px, samples.reach_px
        )
        tables = _tables(self.falloff, samples.vote_px)
        rule = StepRule(*tables, self.voters, self.gap * samples.pitch_px, self.noise_mm**2)
        dealt = np.concatenate([tiles[hand::_BANDS] for hand in range(_BANDS)])
        in_bands(
            lambda first, end: score_tiles(first, end, dealt, index, rule, least, score, most),
            len(dealt),
            self.threads,
        )

    def _bounds(self, samples: Samples) -> Image:
        gap_px = self.gap * samples.pitch_px
        return tile_bounds(samples.low_mm, samples.high_mm, gap_px, self.noise_mm**2)


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
        clear_tiles(self._map, np.flatnonzero(outdated), samples.tile_px)
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
