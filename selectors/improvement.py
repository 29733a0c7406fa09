"""The improvement map (section IV): where a measurement would most improve what is known.

Seeds in, an `ImprovementSelection` out: for every pixel how much the variance-to-mean ratio of
its neighbourhood falls if it were measured (eq. 13, 23), and beside it the kriging estimate and
its variance. See `kriging` for the system, `windows` for how the systems are laid over a frame
and `app/docs/improvement.md` for every choice that the paper leaves open.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from selective_depth.selectors.improvement_kernel import improvement_rows
from selective_depth.selectors.improvement_scattered import EXPONENT
from selective_depth.selectors.kriging import window_scratch
from selective_depth.selectors.parallel import in_bands
from selective_depth.selectors.seeds import SeedGrid
from selective_depth.selectors.selection import Selection
from selective_depth.selectors.windows import windows_of

HALF_SCORE = 2e-4
"""Improvement, as a share of the mean depth of the seeds, that scores one half."""

FloatMap = npt.NDArray[np.float32]
BoolMap = npt.NDArray[np.bool_]


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

    estimate_mm: FloatMap
    variance_mm2: FloatMap
    known: BoolMap
    raw: FloatMap


def best_share(raw: FloatMap, known: BoolMap, share: float) -> BoolMap:
    """Mark the best `share` of the known pixels.

    Pixels of equal worth are taken together or not at all, so the result does not depend on
    the order of pixels; pixels of no worth never are.
    """
    wanted = int(share * np.count_nonzero(known))
    values = raw[known]
    if wanted == 0:
        return np.zeros(raw.shape, np.bool_)
    place = len(values) - wanted
    threshold = np.partition(values, place)[place]
    mask: BoolMap = known & (raw >= threshold) & (raw > 0)
    if np.count_nonzero(mask) > wanted:
        mask = mask & (raw > threshold)
    return mask


class ImprovementSelector:
    """Selects where a measurement would most improve the model of the scene.

    Parameters
    ----------
    share : float, default 0.10
        Share of the known pixels that the mask selects, 0..1.
    exponent : float, default 1.4
        The w = 2 - epsilon of eq. (24), in (0, 2).
    threads : int, optional
        Kernel threads; default `default_threads()`. The result does not depend on it.

    Raises
    ------
    ValueError
        If `share` or `exponent` is out of its range.
    """

    def __init__(
        self, share: float = 0.10, exponent: float = EXPONENT, threads: int | None = None
    ) -> None:
        if not 0 <= share <= 1:
            raise ValueError(f"share is {share}; it is a part of all pixels, 0..1")
        if not 0 < exponent < 2:
            raise ValueError(
                f"exponent is {exponent}; a semivariogram a h^w needs 0 < w < 2 (the paper's"
                " w = 2 makes singular systems)"
            )
        self.share = share
        self.exponent = exponent
        self.threads = threads

    def select(self, seeds: SeedGrid) -> ImprovementSelection:
        """Map the improvement over the whole frame and select its best pixels."""
        windows = windows_of(seeds, self.exponent)
        shape = seeds.frame_shape
        estimate = np.empty(shape, np.float32)
        variance = np.empty(shape, np.float32)
        raw = np.empty(shape, np.float32)
        known = np.empty(shape, np.bool_)
        depth = np.ascontiguousarray(seeds.depth_mm, np.float32)
        rows, columns = windows.rows, windows.columns

        def band(first_row: int, end_row: int) -> None:
            scratch = window_scratch(windows.most_pixels)
            samples = np.zeros(9, np.int64), np.zeros(9, np.int64), np.zeros(9, np.float32)
            tallest = int((rows.before + rows.after).max()) - 1
            widest = int((columns.before + columns.after).max()) - 1
            across = len(columns.centres)
            strips = np.zeros((2, 3, tallest, widest, across), np.float32)
            held = np.zeros((2, across), np.float32)
            mixed = np.zeros((3, widest, across), np.float32)
            improvement_rows(
                first_row, end_row, depth, rows.centres, rows.before, rows.after,
                columns.centres, columns.before, columns.after, rows.blend, columns.blend,
                windows.power, windows.reach_px**2, samples, scratch, strips, held, mixed,
                np.zeros(across, np.float32), (estimate, variance, raw, known),
            )  # fmt: skip

        in_bands(band, shape[0], self.threads)
        valid = depth[depth > 0]
        half = HALF_SCORE * float(valid.mean()) if len(valid) else 1.0
        score = raw / (raw + np.float32(half))
        return ImprovementSelection(
            mask=best_share(raw, known, self.share),
            score=score,
            name="improvement",
            estimate_mm=estimate,
            variance_mm2=variance,
            known=known,
            raw=raw,
        )
