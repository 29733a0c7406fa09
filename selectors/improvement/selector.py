"""The improvement map (section IV): where a measurement would most improve what is known.

Seeds in, an `ImprovementSelection` out: for every pixel how much the variance-to-mean ratio of
its neighbourhood falls if it were measured (eq. 13, 23), and beside it the kriging estimate and
its variance. See `systems` for the system, `neighbourhoods` for how the systems are laid over a frame
and `app/docs/improvement.md` for every choice that the paper leaves open.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from selective_depth.selectors.arrays import Bools, Floats, Ints
from selective_depth.selectors.choice import choose
from selective_depth.selectors.improvement.lattice import lattice_scratch
from selective_depth.selectors.improvement.lattice_tables import SEEDS
from selective_depth.selectors.improvement.map import (
    LEVEL_SHIFT,
    LEVELS,
    best_threshold,
    doubtful_cells,
    improvement_rows,
)
from selective_depth.selectors.improvement.neighbourhoods import Windows, windows_of
from selective_depth.selectors.improvement.scattered import EXPONENT, MOST_EXPONENT, ImprovementMap, map_scattered
from selective_depth.selectors.improvement.systems import aligned_zeros, sample_buffers, window_scratch
from selective_depth.selectors.parallel import in_bands
from selective_depth.selectors.samples import Samples
from selective_depth.selectors.seeds import SeedGrid
from selective_depth.selectors.selection import Selection

HALF_SCORE = 5e-4
"""Improvement, as a share of the mean depth of the seeds, that scores one half."""

HOLED = 3.0
"""How much longer a window with holes takes than one without."""


@dataclass(frozen=True, eq=False)
class ImprovementSelection(Selection):
    """What the improvement map selected, and the dense estimate that it comes from.

    Parameters
    ----------
    estimate_mm : float32 array of shape (height, width)
        Depth by ordinary kriging in millimetres, NaN where unknown.
    variance_mm2 : float32 array of shape (height, width)
        Its kriging variance in mm^2, 0 at a seed, NaN where unknown.
    known : bool array of shape (height, width)
        False where a pixel is too far from every sample that returned depth.
    raw : float32 array of shape (height, width)
        The improvement itself (eq. 23) in millimetres (mm^2 of variance per mm of depth);
        0 at a seed and where unknown. `score` orders pixels exactly as `raw` does.
    """

    estimate_mm: Floats
    variance_mm2: Floats
    known: Bools
    raw: Floats

    @property
    def worth(self) -> Floats:
        """What shots are chosen by: `raw`."""
        return self.raw


@dataclass(eq=False)
class ImprovementSelector:
    """Selects where a measurement would most improve the model of the scene.

    Parameters
    ----------
    share : float, default 0.10
        Share of the known pixels that the mask selects, 0..1.
    exponent : float, default 1.2
        The w = 2 - epsilon of eq. (24), in (0, 2).
    threads : int, optional
        Kernel threads; default `default_threads()`. The result does not depend on it.
    by_sums : bool, default False
        Take eq. (27), from sums over each neighbourhood, instead of eq. (23): the paper's way for
        an exponent near 2.

    Raises
    ------
    ValueError
        If `share` or `exponent` is out of its range.
    """

    share: float = 0.10
    exponent: float = EXPONENT
    threads: int | None = None
    by_sums: bool = field(default=False, kw_only=True)
    name = "improvement"

    def __post_init__(self) -> None:
        if not 0 <= self.share <= 1:
            raise ValueError(f"share is {self.share}; it is a part of all pixels, 0..1")
        if not 0 < self.exponent <= MOST_EXPONENT:
            raise ValueError(
                f"exponent is {self.exponent}; give more than 0 and at most {MOST_EXPONENT} (w = 2 makes"
                " singular systems, and nearer to it single precision leaves only rounding)"
            )

    def select(self, samples: SeedGrid | Samples) -> ImprovementSelection:
        """Map the improvement over the whole frame and select its best pixels.

        Parameters
        ----------
        samples : SeedGrid or Samples
            The seeds alone, which take the quick way, or all samples so far
            (`improvement_scattered`, with windows about the seeds).
        """
        if isinstance(samples, Samples) or self.by_sums:
            return self._select_scattered(Samples.of(samples))
        windows = windows_of(samples, self.exponent)
        # One block: the allocator keeps it for the next frame instead of returning its pages.
        maps, known = np.empty((4, *samples.frame_shape), np.float32), np.empty(samples.frame_shape, np.bool_)
        rows, columns = samples.shape
        padded = np.zeros((rows + 2, columns + 2), np.float32)
        padded[1:-1, 1:-1] = samples.depth_mm
        doubtful = doubtful_cells(padded, windows)
        half = _half(samples.depth_mm)
        histograms: list[Ints] = []

        def band(first_row: int, end_row: int) -> None:
            histogram = np.zeros((2, LEVELS), np.int32)
            histograms.extend(histogram)
            lattice, scratch = windows.kernel_arguments, _scratch(windows)
            improvement_rows(first_row, end_row, padded, doubtful, half, lattice, scratch, histogram, maps, known)

        in_bands(band, len(known), self.threads, cost=_costs(padded)[windows.rows.first])
        estimate, variance, raw, score = maps
        return self._best_of(ImprovementMap(estimate, variance, known, raw), score, sum(histograms))

    def plan(self, samples: Samples) -> ImprovementPlan:
        """Begin an acquisition: after each round the map is made again where that changed it."""
        return ImprovementPlan(self, samples)

    def _map(self, samples: Samples, asked: Bools | None = None) -> ImprovementMap:
        windows = windows_of(samples.seeds, self.exponent)
        measured_mm = np.maximum(samples.image_mm, 0)
        return map_scattered(measured_mm, asked, windows, self.threads, by_sums=self.by_sums)

    def _select_scattered(self, samples: Samples) -> ImprovementSelection:
        found = self._map(samples)
        levels = np.bincount(found.raw.view(np.uint32).ravel() >> LEVEL_SHIFT, minlength=LEVELS)
        return self._best_of(found, found.raw / (found.raw + _half(samples.depth_mm)), levels)

    def _best_of(self, found: ImprovementMap, score: Floats, levels: object) -> ImprovementSelection:
        """The selection of a map, its mask the best `share` of what is known."""
        wanted = int(self.share * np.count_nonzero(found.known))
        mask = found.raw >= best_threshold(found.raw.ravel(), levels, wanted)
        return ImprovementSelection(mask, score, self.name, *found)


def _costs(padded: Floats) -> Floats:
    """How long each lattice row takes, in windows without holes; those with some are solved one by one."""
    rows, columns = (size - 2 for size in padded.shape)
    known = (padded > 0).view(np.uint8)
    beside = known[:, :columns] + known[:, 1:-1] + known[:, 2:]
    held = beside[:rows] + beside[1:-1] + beside[2:]
    costs: Floats = columns + np.float32(HOLED) * np.count_nonzero((held > 1) & (held < SEEDS), axis=1)
    return costs


def _half(depth_mm: Floats) -> np.float32:
    """The improvement that scores one half, of samples of these depths, 0 where there is none."""
    count = np.count_nonzero(depth_mm)
    return np.float32(HALF_SCORE * depth_mm.sum(dtype=np.float64) / count if count else 1.0)


class ImprovementPlan:
    """An acquisition under way, with the improvement map as it is at this stage.

    A measurement changes the windows that hold it, and so the map in their boxes alone.
    """

    def __init__(self, rule: ImprovementSelector, samples: Samples) -> None:
        self._rule = rule
        self._samples = samples
        self._seen = 0
        self._raw = np.zeros(samples.frame_shape, np.float32)

    def best(self, shots: int) -> Ints:
        """The `shots` pixels whose measurement improves most, near some return."""
        samples, rule = self._samples, self._rule
        added = [uv for uv, _ in samples.added_since(self._seen)]
        if added:
            windows = windows_of(samples.seeds, rule.exponent)
            new = np.concatenate(added)
            measured = np.zeros(samples.frame_shape, np.uint8)
            measured[new[:, 1], new[:, 0]] = 1
            # From one end of a window, rim included, to the pixel before the other.
            sides = [4 * axis.longest - 1 for axis in (windows.rows, windows.columns)]
            changed = cv2.dilate(measured, np.ones(sides, np.uint8)).view(np.bool_)
            self._raw[changed] = rule._map(samples, changed).raw[changed]
            self._seen = samples.additions
        return choose(np.where(samples.open(), self._raw, 0), shots)


_kept = threading.local()
"""The working memory that a thread used last: frame after frame has the same lattice."""


def _scratch(windows: Windows) -> Any:
    """Working memory of `improvement_rows` for the calling thread."""
    if getattr(_kept, "windows", None) is not windows:
        tallest, widest = (int((axis.before + axis.after).max()) - 1 for axis in (windows.rows, windows.columns))
        places, most = windows.order[0].size, windows.most_pixels
        _kept.windows = windows
        _kept.scratch = (
            (sample_buffers(), lattice_scratch(most), window_scratch(most)),
            # A cache line more than needed: at a power of two, one lane's pixels would all be kept
            # in the same few places of the cache.
            aligned_zeros(2, 3, tallest, widest, places + 16),
            aligned_zeros(2, places),
            aligned_zeros(3, widest, places),
            aligned_zeros(3, places),
        )
    return _kept.scratch
