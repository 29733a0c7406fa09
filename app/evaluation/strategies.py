"""Every way of choosing measurements that is compared, under one name each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import cv2
import numpy as np
import numpy.typing as npt

from selective_depth.app.console.errors import UsageError
from selective_depth.app.evaluation.quadtree import quadtree
from selective_depth.app.pipeline import gas_of, improvement_of, selector_of
from selective_depth.app.settings import AcquireOptions, Settings
from selective_depth.drivers.frame import DepthFrame
from selective_depth.selectors.acquire import acquire
from selective_depth.selectors.even import even_lattice, spread
from selective_depth.selectors.improvement import ImprovementSelection
from selective_depth.selectors.neural_gas import RegionSelection
from selective_depth.selectors.reconstruct import reconstruct
from selective_depth.selectors.samples import Samples
from selective_depth.selectors.seeds import SeedGrid
from selective_depth.selectors.selection import Selector, Worth

Pixels = npt.NDArray[np.int32]
ORACLE_BATCHES = 16


@dataclass(frozen=True, eq=False)
class Case:
    """One frame, its seeds and a budget: what a strategy is asked to spend.

    Parameters
    ----------
    frame : DepthFrame
        The sensor. Only the oracle looks at it; the others go through `measure`.
    settings : Settings
        Options of the seeds and of the two published selectors.
    shots : int
        Measurements allowed beyond the seeds.
    rounds : int
        Rounds of the closed loops.
    seed : int, default 0
        Of the random draws.
    """

    frame: DepthFrame
    settings: Settings
    shots: int
    rounds: int
    seed: int = 0

    @cached_property
    def seeds(self) -> SeedGrid:
        """The first measurements."""
        return SeedGrid.from_frame(self.frame, (self.settings.seeds.rows, self.settings.seeds.columns))

    @cached_property
    def seed_uv(self) -> Pixels:
        """Pixels of all seeds, with depth or without, shape (n, 2)."""
        return self.seeds.lattice_uv.reshape(-1, 2)

    @cached_property
    def samples(self) -> Samples:
        """The seeds as the first samples."""
        return Samples.of(self.seeds)

    @cached_property
    def open(self) -> npt.NDArray[np.bool_]:
        """Pixels that may be shot in one go: neither seeds nor too far from all of them to be anything but a hole."""
        return self.samples.open()

    @cached_property
    def improvement(self) -> ImprovementSelection:
        """The published improvement map of the seeds."""
        return improvement_of(self.settings, None).select(self.seeds)

    @cached_property
    def regions(self) -> RegionSelection:
        """The neural gas's regions of the seeds."""
        return gas_of(self.drawing, None).select(self.seeds)

    @property
    def drawing(self) -> Settings:
        """The settings, with the seed of this case's draws."""
        return replace(self.settings, gas=replace(self.settings.gas, seed=self.seed))

    def lattice(self, times: float = 1.0) -> Pixels:
        """A fresh lattice of square pitch, of about so many times the measurements that there are to spend."""
        return even_lattice(self.frame.shape, times * (len(self.seed_uv) + self.shots))

    def best(self, worth: npt.NDArray[np.floating]) -> Pixels:
        """Seeds, and the open pixels that are worth most."""
        pixels = np.flatnonzero(self.open)
        if len(pixels) > self.shots:
            order = np.argpartition(-worth.ravel()[pixels], self.shots - 1)
            pixels = pixels[order[: self.shots]]
        return np.concatenate((self.seed_uv, _pixels(pixels, self.frame.shape)))

    def spread(self, mask: npt.NDArray[np.bool_]) -> Pixels:
        """Seeds, and the budget spread evenly over a mask; what does not fit goes elsewhere."""
        return self.best(spread(mask))


def _pixels(places: npt.NDArray[np.intp], shape: tuple[int, int]) -> Pixels:
    """Pixels, column first, of places in a flattened frame."""
    rows, columns = np.unravel_index(places, shape)
    return np.stack((columns, rows), axis=-1).astype(np.int32)


def _loop(case: Case, rounds: int, selector: Selector | Worth | None = None) -> Pixels:
    return acquire(case.frame.measure, case.seeds, rounds=rounds, selector=selector, shots=case.shots).uv


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
        uv = np.concatenate((uv, _pixels(pixels, case.frame.shape)))
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


def _slope(samples: Samples) -> npt.NDArray[np.float32]:
    """Slope of the model of some samples."""
    down, right = np.gradient(reconstruct(samples.uv, samples.depth_mm, samples.frame_shape))
    return np.asarray(np.hypot(down, right))


def _slope_by_gap(samples: Samples) -> npt.NDArray[np.float32]:
    """The simple score that any other must beat: slope of the model times the gap."""
    return np.asarray(_slope(samples) * np.minimum(samples.gap_px(), 4), np.float32)


SELECTORS: dict[str, tuple[str, bool]] = {
    "surface": ("surface score", False),
    "step": ("step score", False),
    "gradient": ("slope of the model x gap", False),
    "improvement": ("published improvement", False),
    "neural-gas": ("neural gas, published rule", True),
    "neural-gas-edges": ("neural gas, long edges", True),
    "even": ("even fill", False),
}
"""Every selector that can drive an acquisition: what it is, and whether it draws at random.

Each is compared in one shot and in the closed loop, as NAME/one-shot and NAME/loop."""


def _selected(case: Case, name: str, *, loop: bool) -> Pixels:
    rounds = case.rounds if loop else 1
    if name == "gradient":
        return _loop(case, rounds, _slope_by_gap)
    settings = replace(case.drawing, acquire=AcquireOptions(rounds=rounds, by=name))
    return _loop(case, rounds, selector_of(settings, None))


def _driven(name: str, about: str, chance: bool) -> dict[str, Strategy]:
    """A selector in one shot and in the loop."""
    return {
        f"{name}/{kind}": Strategy(f"{about}, {words}", partial(_selected, name=name, loop=kind == "loop"), chance)
        for kind, words in (("one-shot", "one shot"), ("loop", "closed loop"))
    }


STRATEGIES: dict[str, Strategy] = {
    "uniform": Strategy("a fresh lattice", Case.lattice),
    "random": Strategy("anywhere near a sample", _random, chance=True),
    "gap": Strategy("farthest from the samples first", lambda c: c.best(c.samples.gap_px())),
    "variance": Strategy(
        "largest kriging variance, local fits", lambda c: c.best(np.nan_to_num(c.improvement.variance_mm2))
    ),
    "neural_gas": Strategy("neural gas, published rule, even spread", lambda c: c.spread(c.regions.mask), chance=True),
    "neural_gas_complement": Strategy(
        "neural gas, long-edge complement, even spread", lambda c: c.spread(c.regions.complement), chance=True
    ),
    "improvement": Strategy("published improvement (eq. 23), one shot", lambda c: c.best(c.improvement.raw)),
    "improvement_loop": Strategy(
        "published improvement, closed loop", lambda c: _selected(c, "improvement", loop=True)
    ),
    "gradient": Strategy("gradient of the interpolated depth, one shot", lambda c: c.best(_slope(c.samples))),
    "quadtree": Strategy("quad-tree, largest error split first", lambda c: quadtree(c.frame.measure, c.seeds, c.shots)),
    "step": Strategy("step score, one shot", lambda c: _loop(c, 1)),
    "loop": Strategy("surface score, closed loop: the default", lambda c: _loop(c, c.rounds)),
    "oracle": Strategy("largest true error, 16 batches", _oracle),
    "uniform_x3": Strategy("a fresh lattice, 3 times the samples", lambda c: c.lattice(3), reference=True),
    "uniform_70": Strategy(
        "a lattice of 70 % of all pixels",
        lambda c: even_lattice(c.frame.shape, 0.7 * c.frame.depth_mm.size),
        reference=True,
    ),
}
for _name, _words in SELECTORS.items():
    STRATEGIES |= _driven(_name, *_words)


def strategy_of(name: str) -> Strategy:
    """The strategy of a name, also of a selector of one's own, ``FILE.py:NAME/loop``."""
    if name in STRATEGIES:
        return STRATEGIES[name]
    by = name.rpartition("/")[0]
    return _driven(by, by.rpartition(":")[2], chance=False)[name]


def strategies_of(names: Sequence[str]) -> tuple[str, ...]:
    """The strategies that are given by name, as "main" (those without a "/"), "all" or as FILE.py:NAME.

    Raises
    ------
    UsageError
        If there is no such strategy, naming those there are, or no such selector.
    """
    meant: list[str] = []
    for name in names:
        if name in ("main", "all"):
            meant += [each for each in STRATEGIES if name == "all" or "/" not in each]
        elif name in STRATEGIES:
            meant.append(name)
        elif ".py:" in name:
            by = name.removesuffix("/loop").removesuffix("/one-shot")
            selector_of(Settings(acquire=AcquireOptions(by=by)), None)  # refused now, not later
            meant += [each for each in _driven(by, "", chance=False) if each.startswith(name)]
        else:
            raise UsageError(
                f"--strategies has '{name}'; it takes main, all, FILE.py:NAME, or names out of {', '.join(STRATEGIES)}."
            )
    return tuple(dict.fromkeys(meant))
