"""Every way of choosing measurements that is compared, under one name each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from selective_depth.drivers.frame import DepthFrame
from selective_depth.selectors.acquire import Score, acquire
from selective_depth.selectors.improvement import (
    ImprovementSelection,
    ImprovementSelector,
    improvement_scattered,
)
from selective_depth.selectors.neural_gas import NeuralGasSelector, RegionSelection
from selective_depth.selectors.reconstruct import reconstruct
from selective_depth.selectors.samples import Samples
from selective_depth.selectors.seeds import SeedGrid
from selective_depth.selectors.triangulation import nearest_sample

Pixels = npt.NDArray[np.int32]
ORACLE_BATCHES = 16


@dataclass(frozen=True, eq=False)
class Case:
    """One frame, its seeds and a budget: what a strategy is asked to spend.

    Parameters
    ----------
    frame : DepthFrame
        The sensor. Only the oracle looks at it; the others go through `measure`.
    seeds_shape : tuple of int
        Rows and columns of the seed lattice.
    shots : int
        Measurements allowed beyond the seeds.
    rounds : int
        Rounds of the closed loops.
    seed : int
        Of the random draws.
    """

    frame: DepthFrame
    seeds_shape: tuple[int, int]
    shots: int
    rounds: int
    seed: int

    @cached_property
    def seeds(self) -> SeedGrid:
        """The first measurements."""
        return SeedGrid.from_frame(self.frame, self.seeds_shape)

    @cached_property
    def seed_uv(self) -> Pixels:
        """Pixels of all seeds, with depth or without, shape (n, 2)."""
        return self.seeds.lattice_uv.reshape(-1, 2)

    @cached_property
    def estimate_mm(self) -> npt.NDArray[np.float32]:
        """Depth interpolated from the seeds."""
        return reconstruct(self.seed_uv, self.seeds.depth_mm.ravel(), self.frame.shape)

    @cached_property
    def gap_px(self) -> npt.NDArray[np.float32]:
        """Distance of every pixel to the nearest seed with depth; infinite if there is none."""
        valid = np.zeros(self.frame.shape, np.bool_)
        valid[self.seeds.uv[:, 1], self.seeds.uv[:, 0]] = True
        if not valid.any():
            return np.full(self.frame.shape, np.inf, np.float32)
        _, gap_sq = nearest_sample(valid)
        gap = np.sqrt(gap_sq)
        return np.asarray(gap, dtype=np.float32)

    @cached_property
    def open(self) -> npt.NDArray[np.bool_]:
        """Pixels that may be shot in one go: no seed, and not so far from all that it is a hole."""
        free = self.gap_px <= Samples.of(self.seeds).reach_px
        free[self.seed_uv[:, 1], self.seed_uv[:, 0]] = False
        return free

    @cached_property
    def improvement(self) -> ImprovementSelection:
        """The published improvement map of the seeds."""
        return ImprovementSelector().select(self.seeds)

    @cached_property
    def regions(self) -> RegionSelection:
        """The neural gas's regions of the seeds."""
        return NeuralGasSelector(seed=self.seed).select(self.seeds)

    def lattice(self, pixels: float) -> Pixels:
        """A fresh lattice of square pitch with about so many pixels."""
        height, width = self.frame.shape
        rows = min(max(round(height * (pixels / (height * width)) ** 0.5), 1), height)
        columns = min(max(round(pixels / rows), 1), width)
        return SeedGrid.from_frame(self.frame, (rows, columns)).lattice_uv.reshape(-1, 2)

    def best(self, worth: npt.NDArray[np.floating]) -> Pixels:
        """Seeds, and the open pixels that are worth most."""
        pixels = np.flatnonzero(self.open)
        if len(pixels) > self.shots:
            order = np.argpartition(-worth.ravel()[pixels], self.shots - 1)
            pixels = pixels[order[: self.shots]]
        width = self.frame.camera.width
        shots = np.stack((pixels % width, pixels // width), axis=-1).astype(np.int32)
        return np.concatenate((self.seed_uv, shots))

    def spread(self, mask: npt.NDArray[np.bool_]) -> Pixels:
        """Seeds, and the budget spread evenly over a mask; what does not fit goes elsewhere."""
        return self.best(np.where(mask, 2.0, 0.0) - _even_rank(mask.shape))


def _even_rank(shape: tuple[int, int]) -> npt.NDArray[np.float64]:
    """Rank 0..1 of pixels such that the first n of any region fill it evenly (ordered dither)."""
    rows, columns = np.indices(shape)
    rank = np.zeros(shape, np.int64)
    bits = 10
    for bit in range(bits):
        u, v = columns >> bit & 1, rows >> bit & 1
        rank |= ((u ^ v) << 1 | v) << 2 * (bits - 1 - bit)
    return rank / 4.0**bits


@dataclass(frozen=True)
class ImprovementScore(Score):
    """The published metric (eq. 23) as the score of a closed loop.

    Parameters
    ----------
    lattice : tuple of int
        Rows and columns of the seeds, which set the size of the kriging windows.
    """

    lattice: tuple[int, int]
    name = "improvement"

    def map(self, samples: Samples, threads: int | None = None) -> npt.NDArray[np.float32]:
        """Improvement at every pixel from the samples so far (see `Score.map`)."""
        rows, columns = np.nonzero(samples.image_mm)
        uv = np.stack((columns, rows), axis=-1)
        depth_mm = samples.image_mm[rows, columns]
        made = improvement_scattered(
            uv, depth_mm, samples.shape, lattice=self.lattice, threads=threads
        )
        raw = made.raw
        raw[samples.image_mm != 0] = 0
        return np.nan_to_num(raw)


def _loop(case: Case, rounds: int, score: Score | None = None) -> Pixels:
    return acquire(case.frame.measure, case.seeds, case.shots, rounds, score).uv


def _gradient(case: Case) -> Pixels:
    down, right = np.gradient(case.estimate_mm)
    return case.best(np.hypot(down, right))


def _random(case: Case) -> Pixels:
    return case.best(np.random.default_rng(case.seed).random(case.frame.shape))


def _oracle(case: Case) -> Pixels:
    """Largest true error of the model so far, in batches, maxima of 3x3 pixels first."""
    truth_mm = case.frame.depth_mm.astype(np.float32)
    uv = case.seed_uv
    for batch in range(ORACLE_BATCHES):
        due = case.shots * (batch + 1) // ORACLE_BATCHES - case.shots * batch // ORACLE_BATCHES
        model_mm = reconstruct(uv, case.frame.measure(uv), case.frame.shape)
        error_mm = np.abs(model_mm - truth_mm)
        error_mm[case.frame.depth_mm == 0] = 0
        error_mm[uv[:, 1], uv[:, 0]] = 0
        peak = error_mm >= cv2.dilate(error_mm, np.ones((3, 3), np.uint8))
        ordered = np.where(peak, error_mm + np.float32(1e6), error_mm).ravel()
        ordered[error_mm.ravel() == 0] = 0
        pixels = np.argpartition(-ordered, due - 1)[:due] if due else np.empty(0, np.int64)
        pixels = pixels[ordered[pixels] > 0]
        width = case.frame.camera.width
        new = np.stack((pixels % width, pixels // width), axis=-1).astype(np.int32)
        uv = np.concatenate((uv, new))
    return uv


@dataclass(frozen=True)
class Strategy:
    """A way of choosing pixels.

    Parameters
    ----------
    about : str
        What it does, in a line of a table.
    pixels : callable
        From a `Case` to all pixels measured, seeds included, shape (n, 2).
    chance : bool
        Whether it draws at random, and is to be run with several seeds.
    reference : bool
        Whether it uses other numbers of measurements than the rest.
    """

    about: str
    pixels: Callable[[Case], Pixels]
    chance: bool = False
    reference: bool = False


STRATEGIES: dict[str, Strategy] = {
    "uniform": Strategy("a fresh lattice", lambda c: c.lattice(len(c.seed_uv) + c.shots)),
    "random": Strategy("anywhere near a sample", _random, chance=True),
    "gap": Strategy("farthest from the samples first", lambda c: c.best(c.gap_px)),
    "variance": Strategy(
        "largest kriging variance, local fits",
        lambda c: c.best(np.nan_to_num(c.improvement.variance_mm2)),
    ),
    "neural_gas": Strategy(
        "neural gas, published rule, even spread", lambda c: c.spread(c.regions.mask), chance=True
    ),
    "neural_gas_complement": Strategy(
        "neural gas, long-edge complement, even spread",
        lambda c: c.spread(c.regions.complement),
        chance=True,
    ),
    "improvement": Strategy(
        "published improvement (eq. 23), one shot", lambda c: c.best(c.improvement.raw)
    ),
    "improvement_loop": Strategy(
        "published improvement, closed loop",
        lambda c: _loop(c, c.rounds, ImprovementScore(c.seeds_shape)),
    ),
    "gradient": Strategy("gradient of the interpolated depth, one shot", _gradient),
    "step": Strategy("step score, one shot", lambda c: _loop(c, 1)),
    "loop": Strategy("step score, closed loop", lambda c: _loop(c, c.rounds)),
    "oracle": Strategy("largest true error, 16 batches", _oracle),
    "uniform_x3": Strategy(
        "a fresh lattice, 3 times the samples",
        lambda c: c.lattice(3 * (len(c.seed_uv) + c.shots)),
        reference=True,
    ),
    "uniform_70": Strategy(
        "a lattice of 70 % of all pixels",
        lambda c: c.lattice(0.7 * c.frame.depth_mm.size),
        reference=True,
    ),
}
