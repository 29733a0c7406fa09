"""Spending a budget of measurements over rounds, where the model is likely to be wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from selective_depth.selectors.acquire.refinement import finer_lattice
from selective_depth.selectors.acquire.step import StepSelector
from selective_depth.selectors.acquire.surface import SurfacePlan, SurfaceSelector
from selective_depth.selectors.arrays import Bools, Bytes, Floats, Ints, pixels_in
from selective_depth.selectors.reconstruct import reconstruct
from selective_depth.selectors.samples import Samples
from selective_depth.selectors.seeds import Measure, SeedGrid, answers
from selective_depth.selectors.selection import Selector, Worth, plan_of

MOST_ROUNDS = 254
"""Rounds are counted in a byte, and an image of them needs one value for "never"."""


@dataclass(frozen=True)
class Round:
    """What one round of an acquisition did.

    Parameters
    ----------
    shots : int
        Measurements made.
    returned : int
        Those that returned depth.
    """

    shots: int
    returned: int


@dataclass(frozen=True, eq=False)
class Acquisition:
    """The multi-resolution model: the seeds and every shot added to them.

    Parameters
    ----------
    uv : int32 array of shape (n, 2)
        Pixels measured, column first, in the order of measuring; seeds first.
    depth_mm : uint16 array of shape (n,)
        Depth; 0 = no return (kept: it was paid for, and it marks a hole). float32 if the sensor
        answers in floats, or in numbers beyond 65,535.
    round : uint8 array of shape (n,)
        Round in which each was measured, 0 = seed.
    frame_shape : tuple of int
        Height and width of the frame in pixels.
    rounds : tuple of Round
        Summary of each round after the seeds.
    by : str
        Name of the selector that chose the shots.
    plan : SurfacePlan or None
        What chose the shots, where that has made the model on its way.
    """

    uv: Ints
    depth_mm: npt.NDArray[np.uint16] | Floats
    round: Bytes
    frame_shape: tuple[int, int]
    rounds: tuple[Round, ...]
    by: str = ""
    plan: SurfacePlan | None = None

    @property
    def returned(self) -> Bools:
        """Which measurements returned depth, shape (n,)."""
        return self.depth_mm > 0

    def mask(self, number: int | None = None) -> Bools:
        """Pixels shot in a round (0 = the seeds), or in all rounds after the seeds."""
        chosen = self.round > 0 if number is None else self.round == number
        mask = np.zeros(self.frame_shape, np.bool_)
        mask[self.uv[chosen, 1], self.uv[chosen, 0]] = True
        return mask

    def reconstruct(self, threads: int | None = None) -> Floats:
        """Dense depth of the model in millimetres, shape (H, W)."""
        if self.plan is not None:
            return self.plan.model_mm()
        return reconstruct(self.uv, self.depth_mm, self.frame_shape, threads=threads)


def shots_of(budget: float, shape: tuple[int, int]) -> int:
    """Number of measurements in a budget that is a share of the frame's pixels, 0.0 to 1.0.

    A whole number from 2 on is a number of measurements already. An int of 1 may mean one or
    all, and is refused.
    """
    pixels = shape[0] * shape[1]
    whole = isinstance(budget, int | np.integer)
    if whole and budget == 1:
        raise ValueError("a budget of 1 may be one measurement or every pixel; give shots=1 or budget=1.0")
    shots = budget if whole else budget * pixels
    if not 0 <= shots <= pixels:  # NaN is not either
        raise ValueError(
            f"a budget of {budget} is {shots:g} of {pixels} pixels; give a share from 0.0 to 1.0,"
            " or shots as a whole number of measurements"
        )
    return round(float(shots))


def _shares(shots: int, rounds: int, first: int) -> list[int]:
    """Shots made at the end of each round: all rounds alike, or all after a first that is given."""
    given = [first] if first else []
    count = rounds - len(given)
    return given + [first + (shots - first) * (n + 1) // count for n in range(count)]


def best_selector(rounds: int, threads: int | None = None) -> Selector:
    """The selector that `acquire` takes by default: the best there is for so many rounds.

    In one round there is no model yet that knows where the discontinuities are, only the seeds': there the
    step score is better, which weighs more samples than a triangle has.
    """
    return StepSelector(threads=threads) if rounds == 1 else SurfaceSelector(threads=threads)


def acquire(
    measure: Measure,
    seeds: SeedGrid,
    budget: float = 0.05,
    rounds: int = 8,
    selector: Selector | Worth | None = None,
    *,
    shots: int | None = None,
    threads: int | None = None,
) -> Acquisition:
    """Measure where a selector says it is worth most, round by round.

    Parameters
    ----------
    measure : callable
        The sensor: pixels (n, 2), column first, to depth (n,) in millimetres; what is not a depth
        (see `measured_mm`) or masked counts as no return. Asked for the chosen pixels only, each once.
    seeds : SeedGrid
        The first measurements; they are not part of the budget.
    budget : float, default 0.05
        Share of the frame's pixels, misses paid for; a whole number from 2 on is taken as `shots`.
    rounds : int, default 8
        1 decides everything from the seeds. Where these are few and far apart, the first of
        several rounds makes their lattice finer (`finer_lattice`).
    selector : Selector or callable, optional
        What a shot is worth, from the samples so far: any selector, or a function of one's own
        (see `plan_of`); default `best_selector`.
    shots : int, optional
        The budget as a number of measurements.
    threads : int, optional
        Kernel threads; default `default_threads()`.

    Returns
    -------
    Acquisition
        Seeds and shots. It may hold fewer shots than the budget, if there was nothing left
        near any sample.

    Raises
    ------
    ValueError
        If an argument is out of its range, the sensor does not answer with one depth per pixel, in
        millimetres as the seeds, or a selector's plan asks for a pixel twice or for too many.
    TypeError
        If `selector` is not one.
    """
    if not 1 <= rounds <= MOST_ROUNDS:
        raise ValueError(f"{rounds} rounds were asked for; give between 1 and {MOST_ROUNDS}")
    total = shots_of(budget, seeds.frame_shape) if shots is None else shots
    if not 0 <= total <= seeds.frame_shape[0] * seeds.frame_shape[1]:
        raise ValueError(f"shots is {shots}; give between 0 and the number of the frame's pixels")
    even_uv, pitch_px = finer_lattice(seeds, total if rounds > 1 else 0)
    samples = Samples.of(seeds, pitch_px)
    chosen_by = selector or best_selector(rounds, threads)
    plan = plan_of(chosen_by, samples)
    lattice_mm = seeds.depth_mm.ravel()
    whole = bool((lattice_mm == np.rint(lattice_mm)).all())
    for due in _shares(total, rounds, len(even_uv)):
        left = due - sum(len(uv) for uv, _ in samples.added_since(1))
        wanted = even_uv if len(even_uv) and samples.additions == 1 else plan.best(left)
        new_uv = _allowed(wanted, samples, left)
        answer, new_mm = answers(measure, new_uv)
        _refuse_metres(new_mm, samples)
        whole &= np.issubdtype(answer.dtype, np.integer)
        samples.book(new_uv, new_mm)
    uv, depth = zip(*samples.added_since(0), strict=True)
    depth_mm: Floats = np.concatenate(depth)
    return Acquisition(
        np.concatenate(uv),
        depth_mm.astype(np.uint16) if whole and depth_mm.max() <= np.iinfo(np.uint16).max else depth_mm,
        np.repeat(np.arange(len(uv), dtype=np.uint8), [len(part) for part in uv]),
        seeds.frame_shape,
        tuple(Round(len(mm), int(np.count_nonzero(mm))) for mm in depth[1:]),
        getattr(chosen_by, "name", getattr(chosen_by, "__name__", "")),
        plan if isinstance(plan, SurfacePlan) else None,
    )


def _allowed(uv: npt.ArrayLike, samples: Samples, left: int) -> Ints:
    """What a plan asks for, if it may: pixels of the frame, each for the first time, no more."""
    pixels = pixels_in(uv, samples.frame_shape, "the plan's pixels")
    image_mm, asked = samples.image_mm, np.zeros(samples.frame_shape, np.bool_)
    asked[pixels[:, 1], pixels[:, 0]] = True
    twice = np.count_nonzero(asked) < len(pixels)
    if len(pixels) > left or twice or image_mm[pixels[:, 1], pixels[:, 0]].any():
        raise ValueError(
            f"the selector's plan asks for {len(pixels)} pixels where {left} are left, or for a pixel twice, or for"
            " some that are measured already"
        )
    return pixels


def _refuse_metres(new_mm: Floats, samples: Samples) -> None:
    """A sensor that answers a hundredth of all that was measured so far means something else."""
    farthest, nearest = float(new_mm.max(initial=0)), samples.nearest_mm
    if 0 < farthest < nearest / 100 < np.inf:
        raise ValueError(
            f"the sensor answers {farthest:g} mm at most, but nothing nearer than {nearest:g} mm"
            " was measured so far; are these metres? Answer in millimetres, as the seeds are"
        )
