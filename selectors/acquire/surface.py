"""Where the kept model is likely to be wrong: the default score of unmeasured pixels.

A model that is linear between samples errs where a discontinuity runs through a triangle, and how much
can be read off the model itself: its slope times the distance to the nearest sample is how far the
depth goes from there to the pixel, and the spread of the corners of the pixel's triangle is what
there is to go. A shot beside one that missed is likely to miss. Their product is the score. It
needs nothing but the model of the samples so far, which is kept while they come: a round costs what
it adds, and after the last one the model is there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Bools, Floats, Ints, Longs
from selective_depth.selectors.choice import best_pixels
from selective_depth.selectors.parallel import in_bands
from selective_depth.selectors.samples import Samples
from selective_depth.selectors.seeds import SeedGrid
from selective_depth.selectors.selection import Selection
from selective_depth.selectors.triangulation import FAR_SQ, TILE_PX, Layers, Surface

_FLAT_SQ = np.float32(1e-6)
"""Square of the slope where the model has none, mm per pixel: what is left of a budget spreads by it."""


@njit(cache=True, nogil=True)
def _note_misses(uv: Ints, depth_mm: Floats, radius: int, miss_sq: Ints, touched: Bools) -> None:
    """Lower the squared distance to the nearest miss within a radius of each, and book it."""
    height, width = miss_sq.shape
    for i in range(len(uv)):
        if depth_mm[i] > 0:
            continue
        u0, v0 = uv[i, 0], uv[i, 1]
        top, bottom = max(v0 - radius, 0), min(v0 + radius, height - 1)
        left, right = max(u0 - radius, 0), min(u0 + radius, width - 1)
        for v in range(top, bottom + 1):
            row, off_sq = miss_sq[v, left : right + 1], np.int32((v - v0) * (v - v0))
            for k in range(len(row)):
                du = np.int32(left + k - u0)
                row[k] = min(row[k], np.int32(du * du + off_sq))
        touched[top // TILE_PX : bottom // TILE_PX + 1, left // TILE_PX : right // TILE_PX + 1] = True


@njit(cache=True, nogil=True)
def _score_tiles(
    first: int, end: int, tiles: Longs, layers: Layers, images: tuple[Floats, Ints, Floats, Floats],
    limits: tuple[float, float],
) -> None:  # fmt: skip
    """Score the pixels of the tiles first..end, numbered row by row.

    `images`: the samples (mm), the squared distance to the nearest miss, the score, filled in, and
    for each column one over the distance of the two that tell its slope;
    `limits`: the squared reach of shots, pixels, and the variance where all agree, mm^2.
    """
    image_mm, miss_sq, score, inverse_du = images
    reach_sq, noise_mm2 = np.float32(limits[0]), np.float32(limits[1])
    height, width = score.shape
    columns = layers.touched.shape[1]
    depth = layers.depth_mm
    here = np.empty(width + 2, np.float32)  # a run of a row and a pixel on either side
    at = first
    while at < end:
        tile = tiles[at]
        top, left = tile // columns * TILE_PX, tile % columns * TILE_PX
        at += 1
        while at < end and tiles[at] == tiles[at - 1] + 1 and tiles[at] % columns:
            at += 1  # neighbours in a row are one run
        stop = min((tiles[at - 1] % columns + 1) * TILE_PX, width)
        run, per_px = stop - left, inverse_du[left:stop]
        for v in range(top, min(top + TILE_PX, height)):
            above, below = max(v - 1, 0), min(v + 1, height - 1)
            upper, lower = depth[above, left:stop], depth[below, left:stop]
            per_row = np.float32(1 / max(below - above, 1))
            here[0], here[run + 1] = depth[v, max(left - 1, 0)], depth[v, min(stop, width - 1)]
            for k in range(run):  # an assignment of slices takes two seconds more to compile
                here[k + 1] = depth[v, left + k]
            known, near_sq, missed_sq = image_mm[v, left:stop], layers.gap_sq[v, left:stop], miss_sq[v, left:stop]
            spread_mm2, scores = layers.spread_mm2[v, left:stop], score[v, left:stop]
            for k in range(run):  # without a branch, it is computed for many pixels at once
                along, down = (here[k + 2] - here[k]) * per_px[k], (lower[k] - upper[k]) * per_row
                gap_sq, miss = np.float32(near_sq[k]), np.float32(missed_sq[k])
                rise_sq = max(along * along + down * down, _FLAT_SQ) * gap_sq
                spread_mm = np.sqrt(spread_mm2[k] + noise_mm2)
                # P(return) with both distances' fourth powers, so that one division does.
                worth = np.sqrt(rise_sq * spread_mm) * (miss * miss) / (miss * miss + gap_sq * gap_sq)
                scores[k] = worth if known[k] == 0 and gap_sq <= reach_sq else np.float32(0)


@dataclass(frozen=True)
class SurfaceSelector:
    """Expected error of the kept model: ``rise * sqrt(spread) * P(return)``.

    `rise` is the slope of the model (central differences) times the distance to the nearest return;
    `spread` the standard deviation of the depths at the corners of the pixel's triangle, and noise;
    ``P(return) = 1 / (1 + (g / m)^4)``, where `g` and `m` are the distances to the nearest return
    and the nearest miss. The exponents were chosen on the `livingroom` and `tabletop` frames and
    the virtual scenes; figures in ``app/docs/evaluation.md``.

    Parameters
    ----------
    noise_mm : float, default 5
        Error expected even where all neighbours agree.
    threads : int, optional
        Kernel threads; default `default_threads()`. The result does not depend on it.
    """

    noise_mm: float = 5.0
    threads: int | None = None
    name = "surface score"

    def select(self, samples: SeedGrid | Samples) -> Selection:
        """Score every pixel; the mask is the best tenth of them."""
        plan = SurfacePlan(self, Samples.of(samples))
        plan.look()
        return Selection.of_score(plan.score, self.name)

    def plan(self, samples: Samples) -> SurfacePlan:
        """Begin an acquisition: the same choice as by the whole map, of which little is new."""
        return SurfacePlan(self, samples)


class SurfacePlan:
    """An acquisition under way, with the model that its samples make.

    Attributes
    ----------
    score : float32 array of shape (height, width)
        Worth of a shot at each pixel, as of the last `look`.
    surface : Surface
        The model, as of the last `look` or `model_mm`.
    """

    def __init__(self, rule: SurfaceSelector, samples: Samples) -> None:
        shape = samples.frame_shape
        self._rule = rule
        self._samples = samples
        self.surface = Surface(shape, rule.threads)
        self._miss_sq = np.full(shape, FAR_SQ, np.int32)
        self._seen = 0
        self.score = np.zeros(shape, np.float32)
        self._inverse_du = np.full(shape[1], 0.5, np.float32)  # of the columns that tell a slope
        self._inverse_du[[0, -1]] = 1

    def look(self) -> None:
        """Take in what was measured since, and score again what that changes."""
        samples, layers = self._samples, self.surface.layers
        radius = math.ceil(2 * samples.reach_px)
        for uv, depth_mm in samples.added_since(self._seen):
            self.surface.add(uv, depth_mm)
            _note_misses(uv, depth_mm, radius, self._miss_sq, layers.touched)
        self._seen = samples.additions
        tiles = np.flatnonzero(layers.touched)
        layers.touched[:] = False
        limits = float(samples.reach_px**2), float(self._rule.noise_mm**2)
        images = samples.image_mm, self._miss_sq, self.score, self._inverse_du
        in_bands(_score_tiles, len(tiles), self._rule.threads, tiles, layers, images, limits)

    def best(self, shots: int) -> Ints:
        """The `shots` pixels that are worth most, from the samples as they are now."""
        self.look()
        return best_pixels(self.score, shots)

    def model_mm(self) -> Floats:
        """Dense depth of the samples as they are now, float32 (height, width); a copy."""
        for uv, depth_mm in self._samples.added_since(self._seen):
            self.surface.add(uv, depth_mm)
        self._seen = self._samples.additions
        return self.surface.layers.depth_mm.copy()
