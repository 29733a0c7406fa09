"""The one protocol of selecting: measurements in, what more of them are worth out.

A selector is anything with ``select(samples) -> Selection``, or a plain function from samples to
a worth for every pixel. It is given the seeds or, in later rounds, all samples so far, and never
sees what was not measured. `acquire` spends a budget by whatever selector it is given:

>>> import numpy as np
>>> from selective_depth.selectors.acquire import acquire
>>> from selective_depth.selectors.seeds import SeedGrid
>>> wall_mm = np.full((48, 64), 2000, np.uint16)
>>> def far_first(samples):
...     return samples.gap_px()
>>> seeds = SeedGrid.from_array(wall_mm, (12, 16))
>>> model = acquire(lambda uv: wall_mm[uv[:, 1], uv[:, 0]], seeds, shots=50, selector=far_first)
>>> len(model.uv)
242
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from selective_depth.selectors.arrays import Bools, Floats, Ints, checked_map
from selective_depth.selectors.choice import CROWDED, choose
from selective_depth.selectors.samples import Samples
from selective_depth.selectors.seeds import SeedGrid

BEST_SHARE = 0.10
"""Share of the pixels that the mask of a plain score selects."""


@dataclass(frozen=True, eq=False)
class Selection:
    """Where more measurements are worth taking.

    Parameters
    ----------
    mask : bool array of shape (height, width)
        The selected regions.
    score : float32 array of shape (height, width)
        Worth of a measurement at each pixel, on the selector's own scale (0..1 of the two
        published ones); 0 where nothing is known nearby.
    name : str
        The selector that made it.
    crowded : float, default `CROWDED`
        Factor on the worth of a pixel beside a better one when shots are chosen; 1 where the
        worth spreads them by itself.
    """

    mask: Bools
    score: Floats
    name: str
    crowded: float = field(default=CROWDED, kw_only=True)

    def __post_init__(self) -> None:
        if self.mask.dtype != np.bool_ or self.mask.ndim != 2:
            raise ValueError(f"mask must be bool of shape (height, width), got {self.mask.dtype} {self.mask.shape}")
        if self.score.dtype != np.float32 or self.score.shape != self.mask.shape:
            raise ValueError(
                f"score must be float32 of shape {self.mask.shape}, got {self.score.dtype} {self.score.shape}"
            )

    @property
    def worth(self) -> Floats:
        """What shots are chosen by, float32 (height, width): the score, where nothing else."""
        return self.score

    @classmethod
    def of_score(cls, score: Floats, name: str) -> Selection:
        """The selection of a plain score: its mask is the best `BEST_SHARE` of the pixels."""
        wanted = max(round(BEST_SHARE * score.size), 1)
        least = np.partition(score, score.size - wanted, axis=None)[score.size - wanted]
        return cls((score >= least) & (score > 0), score, name)


@runtime_checkable
class Selector(Protocol):
    """Measurements in, selection out."""

    def select(self, samples: SeedGrid | Samples) -> Selection:
        """Decide from the measurements alone where more are worth taking."""
        ...


class Plan(Protocol):
    """An acquisition under way: says, round after round, which pixels to measure next."""

    def best(self, shots: int) -> Ints:
        """At most so many pixels, shape (n, 2), column first, from the samples as they are."""
        ...


@runtime_checkable
class Planner(Selector, Protocol):
    """A selector with a quicker way through the rounds of an acquisition than map after map."""

    def plan(self, samples: Samples) -> Plan:
        """Begin an acquisition that adds its measurements to `samples`."""
        ...


Worth = Callable[[Samples], npt.ArrayLike]
"""A selector as a plain function: what a shot is worth at each pixel, (height, width); 0 or less,
masked or NaN where none should be made."""


@dataclass(frozen=True)
class FunctionSelector:
    """A function of one's own as a selector.

    Parameters
    ----------
    function : callable
        See `Worth`.
    """

    function: Worth

    @property
    def name(self) -> str:
        """The function's."""
        return getattr(self.function, "__name__", type(self.function).__name__)

    def select(self, samples: SeedGrid | Samples) -> Selection:
        """The function's answer as a selection.

        Raises
        ------
        ValueError
            If it does not answer with a number for every pixel.
        """
        worth = checked_map(self.function(Samples.of(samples)), samples.frame_shape, f"the answer of {self.name}")
        return Selection.of_score(worth, self.name)


@dataclass(frozen=True, eq=False)
class _Plainly:
    """The plain way through the rounds: everything anew from all samples, near some return."""

    selector: Selector
    samples: Samples

    def best(self, shots: int) -> Ints:
        selection = self.selector.select(self.samples)
        worth = checked_map(selection.worth, self.samples.frame_shape, "the worth of a selection")
        worth[~self.samples.open()] = 0
        return choose(worth, shots, crowded=selection.crowded)


def plan_of(selector: Selector | Worth, samples: Samples) -> Plan:
    """Begin an acquisition by any selector.

    Parameters
    ----------
    selector : Selector, Planner or callable
        A `Planner` goes its own way. Of any other selector, the pixels of most worth are taken
        (`choose`) that were not measured yet and are not deep in a hole (`Samples.open`).
    samples : Samples
        What was measured so far; what the plan leads to is to be added to it.

    Raises
    ------
    TypeError
        If it is neither a selector nor a function.
    """
    if not isinstance(selector, type):  # of a class, its instances are meant
        if isinstance(selector, Planner):
            return selector.plan(samples)
        if isinstance(selector, Selector):
            return _Plainly(selector, samples)
        if callable(selector):
            return _Plainly(FunctionSelector(selector), samples)
    raise TypeError(
        f"selector is {selector!r}; give an object with select(samples), such as"
        " ImprovementSelector(), or a function from samples to a worth for every pixel"
    )
