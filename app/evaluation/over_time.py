"""What a memory is worth: error over the frames of a source, with it and without."""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from selective_depth.app.console.columns import print_table
from selective_depth.app.console.output import write_output
from selective_depth.app.console.progress import FrameProgress
from selective_depth.app.evaluation.evaluate import ENDLESS_FRAMES, check_named
from selective_depth.app.pictures import sheet, write_picture
from selective_depth.app.pictures.panels import depth_panel, error_panel
from selective_depth.app.pipeline import say
from selective_depth.app.settings import ComparisonOptions, EvaluationFiles, Settings
from selective_depth.drivers.errors import SourceNotFoundError
from selective_depth.drivers.frame import DepthFrame
from selective_depth.drivers.open import open_source
from selective_depth.selectors.acquire import acquire
from selective_depth.selectors.memory import TemporalAcquisition, TemporalStep
from selective_depth.selectors.memory.store import KEPT
from selective_depth.selectors.seeds import SeedGrid

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIRST_BUDGET = 0.05
"""Beyond the seeds: of a first frame with memory, and of every frame without."""

WAYS = ("memory", "memoryless", "whole_frame", "median")


@dataclass
class Course:
    """Errors of one way over the frames of a source, millimetres, one number a frame."""

    rmse_mm: list[float] = field(default_factory=list)
    mae_mm: list[float] = field(default_factory=list)

    def add(self, model_mm: npt.NDArray[Any], truth_mm: npt.NDArray[Any],
            scored: npt.NDArray[np.bool_]) -> None:  # fmt: skip
        """Take in the model of a frame; where it has no depth it is not scored."""
        valid = scored & (model_mm > 0)
        off = model_mm[valid].astype(np.float64) - truth_mm[valid]
        self.rmse_mm.append(float(np.sqrt(np.mean(off**2))) if off.size else math.nan)
        self.mae_mm.append(float(np.mean(np.abs(off))) if off.size else math.nan)


def _frames(uri: str, limit: int | None) -> Iterator[DepthFrame]:
    with open_source(uri) as source:
        most = ENDLESS_FRAMES if source.frame_count is None else None
        yield from islice(source, limit or most)


def _truth(frame: DepthFrame) -> npt.NDArray[np.uint16]:
    return frame.depth_mm if frame.truth_mm is None else frame.truth_mm


def _often_returning(uri: str, frames: int | None) -> npt.NDArray[np.bool_] | None:
    """Pixels that return depth in more than half of the frames of a still scene, else None."""
    first: npt.NDArray[np.uint16] | None = None
    returned, count = np.zeros(1, np.int64), 0
    for frame in _frames(uri, frames):
        if frame.truth_mm is None:
            return None
        if first is None:
            first, returned = frame.truth_mm, np.zeros(frame.shape, np.int64)
        if not np.array_equal(first, frame.truth_mm):
            return None
        returned += frame.depth_mm > 0
        count += 1
    return None if first is None else returned > count / 2


def over_time(
    uri: str,
    budget: float,
    *,
    frames: int | None = None,
    seeds_shape: tuple[int, int] = (128, 128),
    rounds: int = 8,
    each: Callable[[DepthFrame, TemporalStep], None] = lambda frame, step: None,
) -> dict[str, Course]:
    """Follow a source with memory and without it.

    Parameters
    ----------
    uri : str
        As `open_source` takes it. Errors are against exact truth where the source knows it, else
        against the frame itself.
    budget : float
        All measurements of a frame with memory, after the first, as a share of its pixels.
    frames : int, optional
        At most so many.
    seeds_shape : tuple of int, default (128, 128)
        Rows and columns of the seed lattice.
    rounds : int, default 8
        Rounds of the acquisition without memory, and of a first frame with it.
    each : callable, optional
        Called with every frame and what the memory came to.

    Returns
    -------
    dict
        A `Course` for each of `WAYS`: memory; the closed loop of seeds and 5 % more in every frame;
        the frame as the sensor gives it; the median of the last frames, 31 at most. Scored are the
        pixels with exact depth that return depth in more than half of the frames; where anything
        moves, those that return it in the frame.

    Raises
    ------
    SourceNotFoundError
        If the source has no frame.
    """
    often = _often_returning(uri, frames)
    courses = {way: Course() for way in WAYS}
    memory: TemporalAcquisition | None = None
    last: deque[npt.NDArray[np.float32]] = deque(maxlen=KEPT)
    for frame in _frames(uri, frames):
        truth = _truth(frame)
        scored = truth > 0
        scored &= (frame.depth_mm > 0) if often is None else often
        if memory is None:
            memory = TemporalAcquisition(
                frame.shape, budget=budget, first_budget=FIRST_BUDGET, seeds=seeds_shape, rounds=rounds
            )
        step = memory.step(frame.measure)
        courses["memory"].add(step.model_mm, truth, scored)
        seeds = SeedGrid.from_frame(frame, seeds_shape)
        loop = acquire(frame.measure, seeds, FIRST_BUDGET, rounds)
        courses["memoryless"].add(loop.reconstruct(), truth, scored)
        courses["whole_frame"].add(frame.depth_mm, truth, scored)
        last.append(np.where(frame.depth_mm > 0, frame.depth_mm, np.float32(np.nan)))
        courses["median"].add(_median(last), truth, scored)
        each(frame, step)
    if memory is None:
        raise SourceNotFoundError(f"'{uri}' has no frame; give another source.")
    return courses


def _median(frames: deque[npt.NDArray[np.float32]]) -> npt.NDArray[np.float32]:
    """Median of what each pixel returned, 0 where it never did."""
    stack = np.sort(np.stack(frames), axis=0)  # NaN last
    count = np.count_nonzero(~np.isnan(stack), axis=0)
    lower = np.take_along_axis(stack, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
    upper = np.take_along_axis(stack, np.maximum(count // 2, 0)[None], axis=0)[0]
    middle: npt.NDArray[np.float32] = np.where(count > 0, (lower + upper) / 2, 0)
    return middle


def run_over_time(
    sources: Sequence[str], options: ComparisonOptions, settings: Settings, files: EvaluationFiles
) -> None:
    """Follow each source, show what came of it, and write it as JSON if asked.

    Raises
    ------
    UsageError
        If there is no source or no budget.
    OutputError
        If a file cannot be written.
    """
    check_named(sources, options.budget)
    budget, seeds_shape = float(options.budget[0]), (settings.seeds.rows, settings.seeds.columns)
    found: dict[str, dict[str, Course]] = {}
    last: list[tuple[DepthFrame, TemporalStep]] = []
    for uri in sources:
        with FrameProgress(f"Following {uri}", options.frames) as bar:

            def each(frame: DepthFrame, step: TemporalStep, bar: FrameProgress = bar) -> None:
                bar.update(step.frame + 1)
                last[:] = [(frame, step)]

            found[uri] = over_time(
                uri, budget, frames=options.frames, seeds_shape=seeds_shape, rounds=options.rounds, each=each
            )
        _print(uri, found[uri], budget)
        if files.picture is not None and len(found) == 1:
            write_picture(files.picture, _picture(*last[0]))
            say(f"wrote {files.picture}")
    if files.json is not None:
        document = {
            "over_time": {uri: {way: asdict(course) for way, course in ways.items()} for uri, ways in found.items()},
            "budget": budget,
        }
        write_output(files.json, json.dumps(document, indent=1) + "\n")
        say(f"wrote {files.json}")


def _picture(frame: DepthFrame, step: TemporalStep) -> Figure:
    """The truth, the sensor's whole frame and the memory's model, and how wrong both are."""
    exact = replace(frame, depth_mm=_truth(frame))
    remembered = replace(frame, depth_mm=np.clip(np.rint(step.model_mm), 0, 65535).astype(np.uint16))
    first = [depth_panel(exact, "Truth"), depth_panel(frame, "One whole frame"), depth_panel(remembered, "Memory")]
    seen = replace(exact, depth_mm=np.where(frame.depth_mm > 0, exact.depth_mm, 0).astype(np.uint16))
    errors = [error_panel(seen, shown.depth_mm.astype(np.float32), "Its error") for shown in (frame, remembered)]
    share = f"{100 * len(step.uv) / frame.depth_mm.size:.3g} % of the pixels a frame"
    return sheet([(f"Frame {step.frame}: memory from {share}", first), ("", [None, *errors])], legend=False)


def _print(uri: str, ways: dict[str, Course], budget: float) -> None:
    count = len(ways["memory"].rmse_mm)
    at = sorted({0, count // 2, count - 1})
    rows = []
    for way, course in ways.items():
        figures = [(course.rmse_mm[i], course.mae_mm[i]) for i in at]
        figures.append((float(np.nanmean(course.rmse_mm)), float(np.nanmean(course.mae_mm))))
        rows.append((way.replace("_", " "), *(f"{rmse:.1f} / {mae:.1f}" for rmse, mae in figures)))
    heads = ("RMSE / MAE, mm", *(f"frame {index}" for index in at), "mean")
    title = f"{uri}: {count} frames, {100 * budget:g} % of the pixels a frame with memory"
    print_table(rows, heads, bold="memory", title=title)
