"""Where the model is likely to be wrong: the project's own score of unmeasured pixels.

Almost all of the error of a sparse depth model sits at depth discontinuities, between a sample on one
surface and a sample on the other. A pixel there belongs to either, and nobody knows to which:
its expected squared error is the spread of the depths around it, weighted by how near they are.
A shot halves the stretch in which the discontinuity can lie, so the spread counts the more the farther
the nearest samples are. Shots that returned nothing mark holes: the chance of a return is the
share of the neighbours that did.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from selective_depth.selectors.acquire.step_kernel import StepRule, score_rows
from selective_depth.selectors.parallel import in_bands
from selective_depth.selectors.samples import Samples
from selective_depth.selectors.seeds import SeedGrid
from selective_depth.selectors.selection import Selection

MOST_VOTERS = 6


@dataclass(frozen=True)
class StepSelector:
    """The project's own score: expected squared error, times how far a shot reaches.

    ``sqrt(P(return)) * (sum_k w_k (z_k - mean)^2 / sum_k w_k + noise^2) * gap`` over the nearest
    samples that returned depth. ``w = 1 / (distance^falloff + 1)``; `mean` is their weighted
    mean; `gap` is the mean distance of the two nearest, at most so many pitches of the lattice; ``P(return)`` is the
    share of their weight in that of all shots as near, and its root because even a shot that
    misses tells where the hole ends. Chosen on the `livingroom` and `tabletop` frames; figures
    in ``app/docs/evaluation.md``.

    Parameters
    ----------
    voters : int, default 5
        How many samples vote, 2 to 6.
    falloff : float, default 4
        How fast a vote fades with distance: the slower, the wider the band about a deep
        discontinuity that is shot all over before a weaker one is looked at.
    gap : float, default 0.8
        Distance, in pitches of the seed lattice, beyond which being farther from the samples
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
        if not 2 <= self.voters <= MOST_VOTERS:  # the gap is told by two
            raise ValueError(f"voters is {self.voters}; give between 2 and {MOST_VOTERS}")

    def select(self, samples: SeedGrid | Samples) -> Selection:
        """Score every pixel, in mm^2 times pixels; the mask is the best tenth of them."""
        known = Samples.of(samples)
        distance_px = np.sqrt(np.arange(known.vote_px**2 + 1))
        rule = StepRule(
            weight_of=(1 / (distance_px**self.falloff + 1)).astype(np.float32),
            vote_px=known.vote_px,
            reach_px=known.reach_px,
            voters=self.voters,
            gap_px=self.gap * known.pitch_px,
            noise_mm2=self.noise_mm**2,
        )
        score = np.empty(known.frame_shape, np.float32)
        in_bands(score_rows, len(score), self.threads, known.image_mm, known.bits, rule, score)
        return Selection.of_score(score, self.name)
