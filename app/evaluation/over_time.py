"""What a memory is worth: error over the frames of a source, with it and without."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import numpy as np
import numpy.typing as npt

from selective_depth.app.evaluation.evaluate import ENDLESS_FRAMES
from selective_depth.app.settings import ComparisonOptions, Settings
from selective_depth.drivers.errors import SourceNotFoundError
from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.open import open_source
from selective_depth.selectors.acquire import acquire
from selective_depth.selectors.memory import KEPT, TemporalAcquisition, TemporalStep
from selective_depth.selectors.quality import errors_of
from selective_depth.selectors.seeds import SeedGrid

FIRST_BUDGET = 0.05
"""Beyond the seeds: of a first frame with memory, and of every frame without."""

WAYS = ("memory", "memoryless", "whole_frame", "median")


@dataclass
class Course:
    """Errors of one way over the frames of a source, millimetres, one number a frame."""

    rmse_mm: list[float] = field(default_factory=list)
    mae_mm: list[float] = field(default_factory=list)

    def add(self, model_mm: npt.NDArray[Any], truth_mm: npt.NDArray[np.uint16], scored: npt.NDArray[np.bool_]) -> None:
        """Take in the model of a frame; where it has no depth it is not scored."""
        known_mm = np.where(scored & (model_mm > 0), truth_mm, 0)
        rmse_mm, mae_mm, _ = errors_of(model_mm, known_mm) if known_mm.any() else (math.nan,) * 3
        self.rmse_mm.append(rmse_mm)
        self.mae_mm.append(mae_mm)


def _frames(uri: str, limit: int | None) -> Iterator[DepthFrame]:
    with open_source(uri) as source:
        most = ENDLESS_FRAMES if source.frame_count is None else None
        yield from islice(source, limit or most)


def truth_of(frame: DepthFrame) -> npt.NDArray[np.uint16]:
    """Exact depth where it is known, else the frame's own."""
    return frame.depth_mm if frame.truth_mm is None else frame.truth_mm


def _often_returning(uri: str, frames: int | None) -> npt.NDArray[np.bool_] | None:
    """Pixels that return depth in more than half of the frames, if the scene is still; else None."""
    before: npt.NDArray[np.uint16] | None = None
    returned, count = np.zeros((), np.int64), 0
    for frame in _frames(uri, frames):
        if frame.truth_mm is None or not (before is None or np.array_equal(before, frame.truth_mm)):
            return None
        before, returned, count = frame.truth_mm, returned + (frame.depth_mm > 0), count + 1
    return None if before is None else returned > count / 2


def over_time(
    uri: str, options: ComparisonOptions, settings: Settings
) -> Iterator[tuple[DepthFrame, TemporalStep, dict[str, Course]]]:
    """Follow a source with memory and without it.

    Parameters
    ----------
    uri : str
        As `open_source` takes it. Errors are against exact truth where the source knows it, else
        against the frame itself.
    options : ComparisonOptions
        How many frames; the first budget is that of all measurements of a frame with memory, after
        the first; the rounds are those of the acquisition without memory, and of a first frame with it.
    settings : Settings
        Of the seeds.

    Yields
    ------
    DepthFrame
        Every frame, when it has been followed.
    TemporalStep
        What the memory came to.
    dict
        A `Course` so far for each of `WAYS`: memory; the closed loop of seeds and 5 % more in every frame;
        the frame as the sensor gives it; the median of the last frames, 31 at most. Scored are the
        pixels with exact depth that return depth in more than half of the frames; where anything
        moves, those that return it in the frame.

    Raises
    ------
    SourceNotFoundError
        If the source has no frame.
    """
    often = _often_returning(uri, options.frames)
    courses = {way: Course() for way in WAYS}
    seeds_shape = settings.seeds.rows, settings.seeds.columns
    memory: TemporalAcquisition | None = None
    last: deque[npt.NDArray[np.float32]] = deque(maxlen=KEPT)
    for frame in _frames(uri, options.frames):
        if memory is None:
            memory = TemporalAcquisition(
                frame.shape,
                budget=float(options.budget[0]),
                first_budget=FIRST_BUDGET,
                seeds=seeds_shape,
                rounds=options.rounds,
            )
        step = memory.step(frame.measure)
        seeds = SeedGrid.from_frame(frame, seeds_shape)
        loop = acquire(frame.measure, seeds, FIRST_BUDGET, options.rounds)
        last.append(np.where(frame.depth_mm > 0, frame.depth_mm, np.float32(np.nan)))
        truth = truth_of(frame)
        scored = (truth > 0) & ((frame.depth_mm > 0) if often is None else often)
        models: list[npt.NDArray[Any]] = [step.model_mm, loop.reconstruct(), frame.depth_mm, _median(last)]
        for way, model_mm in zip(WAYS, models, strict=True):
            courses[way].add(model_mm, truth, scored)
        yield frame, step, courses
    if memory is None:
        raise SourceNotFoundError(f"'{uri}' has no frame; give another source.")


def _median(frames: deque[npt.NDArray[np.float32]]) -> npt.NDArray[np.float32]:
    """Median of what each pixel returned, 0 where it never did."""
    stack = np.sort(np.stack(frames), axis=0)  # NaN last
    count = np.count_nonzero(~np.isnan(stack), axis=0)
    lower = np.take_along_axis(stack, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
    upper = np.take_along_axis(stack, count[None] // 2, axis=0)[0]
    middle: npt.NDArray[np.float32] = np.where(count > 0, (lower + upper) / 2, 0)
    return middle
