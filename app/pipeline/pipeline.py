"""One frame's way: seeds, both selectors, the samples and the model, side by side and timed."""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Self

from selective_depth.app.console.errors import UsageError
from selective_depth.app.pipeline.governor import ALL, Eased
from selective_depth.app.pipeline.result import FrameResult, Model
from selective_depth.app.pipeline.selecting import SELECTOR_NAMES, gas_of, improvement_of, selector_of
from selective_depth.app.pipeline.timing import StageTimes
from selective_depth.app.pipeline.warm_up import compiling_beside
from selective_depth.app.settings import AcquireOptions, Settings
from selective_depth.drivers.frame import DepthFrame
from selective_depth.selectors.acquire import Acquisition, acquire
from selective_depth.selectors.improvement import ImprovementSelection
from selective_depth.selectors.memory import TemporalAcquisition, TemporalStep
from selective_depth.selectors.neural_gas import RegionSelection
from selective_depth.selectors.seeds import SeedGrid
from selective_depth.selectors.selection import Selector, Worth

EVEN_EVERY, EVEN_EVERY_LIVE = 10, 3
"""One in so many frames of a recording, or of a sensor, is measured evenly as well, to tell what selecting
gains; a sensor's are for people who look on, a recording's for its report."""
WARM_FRAMES = 5
"""How often a sensor's first frame is made: the first few frames of a process are slow, for their memory has to be
got from the system."""


@dataclass(frozen=True)
class _Asked:
    """What holds for the frames that are begun from now on."""

    settings: Settings
    selector: Selector | Worth
    eased: Eased = ALL


class _AtOnce(Executor):
    """Does what it is given in the calling thread."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


def _give_way() -> None:
    """Let what this thread does wait for the others, where a thread has a priority of its own."""
    if sys.platform == "linux":
        with suppress(OSError):  # a sandbox may forbid it; then all are alike
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)


class Pipeline:
    """Both selectors and the acquisition, frame by frame, every stage timed.

    Frames are put in with `begin` and taken out, in their order, with `finished` and `rest`.
    While one is made the next is begun: two frames with a thread for each of their parts keep two
    processors busier than one frame whose every part waits for its slowest thread. Only a
    sensor's frames of which nothing is acquired are made one by one: they are ready long before
    the next one comes, and so are seen at once. With a memory the selectors see what it knows once
    it has spent the frame's budget: they follow while it spends the next frame's.

    Parameters
    ----------
    settings : Settings
        Options of the seeds, the selectors and the acquisition.
    realtime : bool, default False
        Frames come whether the pipeline is ready or not: none waits for the even lattice's model,
        which the first frame after it is made gets.
    one_thread : bool, default False
        Make every frame in the calling thread, one after the other: where each processor has a
        process of its own.

    Raises
    ------
    ValueError
        If an option of a selector is out of its range, which the command line refuses before.
    UsageError
        If there is no such selector, or nothing for a memory to spend.
    """

    def __init__(self, settings: Settings, *, realtime: bool = False, one_thread: bool = False) -> None:
        self._realtime = realtime
        self._one_thread = one_thread
        self.times = StageTimes()
        self._live_gas = settings.gas.training == "live"
        self._overlap = int(not one_thread and (settings.acquire.budget > 0 or not realtime))
        self._threads = settings.run.threads or (1 if self._overlap or one_thread else None)
        self._gas = gas_of(settings, self._threads)
        self._improvement = improvement_of(settings, self._threads)
        self._memory: TemporalAcquisition | None = None
        self._asked = self._ask(settings)
        self._regions: RegionSelection | None = None
        # The stages are compiled and free of the GIL: side by side they take as long as the
        # longest of them.
        self._beside: Executor = _AtOnce() if one_thread else ThreadPoolExecutor(2, thread_name_prefix="beside")
        self._evening: Executor = _AtOnce() if one_thread else ThreadPoolExecutor(1, "even", _give_way)
        self._remembering: Executor = _AtOnce() if one_thread else ThreadPoolExecutor(1, thread_name_prefix="memory")
        self._remembered: deque[Callable[[], None]] = deque()  # frames whose selectors wait for the memory
        self._under_way: deque[Callable[[], FrameResult]] = deque()
        self._even: Future[Model] | None = None
        self._counted: int | None = None
        self._begun = 0

    def _ask(self, settings: Settings) -> _Asked:
        if settings.acquire.memory == "still" and not settings.acquire.budget:
            raise UsageError("--memory still spends a --budget in every frame; give one, such as 2%.")
        return _Asked(settings, selector_of(settings, self._threads))

    def adopt(self, settings: Settings) -> None:
        """Take other options of the acquisition, for the frames that are begun from now on.

        What a memory knows is kept, unless it is switched off or spends another budget.

        Raises
        ------
        UsageError
            As when made; nothing has changed then.
        """
        before, asked = self._asked.settings.acquire, self._ask(settings)
        self._catch_up()
        self._asked = replace(asked, eased=self._asked.eased)
        self._overlap = int(not self._one_thread and (settings.acquire.budget > 0 or not self._realtime))
        if before != settings.acquire:
            self._memory = None

    def ease(self, eased: Eased) -> None:
        """Do less, or all again, of every frame that is begun from now on: see `Governor`."""
        self._asked = replace(self._asked, eased=eased)

    def forget(self) -> None:
        """Forget what a memory knows and where the nodes are: the next frame is the first."""
        self._catch_up()
        self._memory = None
        self._gas = gas_of(self._asked.settings, self._threads)

    def warm_up(self, frame: DepthFrame) -> FrameResult:
        """Compile the kernels, fill the tables and train the first nodes, untimed; the frame's result."""
        with compiling_beside():
            self._improvement.select(self._seeds(frame))
        for _ in range(WARM_FRAMES if self._realtime else 1):
            result = self.make(frame)
        self._start_afresh()
        return result

    def warm_up_all(self, frame: DepthFrame) -> None:
        """Compile what other options than the present ones run, so that changing them takes no time."""
        kept = self._asked
        for other in switched(kept.settings.acquire):
            self.adopt(replace(kept.settings, acquire=other))
            for _ in range(2):  # a memory's second frame is what goes on
                self.make(frame)
        self.adopt(kept.settings)
        self._start_afresh()

    def _start_afresh(self) -> None:
        if self._even is not None:
            self._even.result()
        self._memory, self._even, self._counted, self._begun = None, None, None, 0
        self.times.clear()

    def train(self, frame: DepthFrame) -> None:
        """Train the first nodes alone, as `warm_up` leaves them, where all is compiled already."""
        if self._live_gas:
            self._gas_of(self._seeds(frame), {})
            self.times.clear()

    def make(self, frame: DepthFrame) -> FrameResult:
        """Make all of one frame that there is to make; nothing else may be under way."""
        self.begin(frame)
        return next(self.rest())

    def begin(self, frame: DepthFrame, *, state: str = "replay", read_ms: float = math.nan) -> None:
        """Take a frame's seeds, set the rest going, and train the nodes meanwhile.

        Parameters
        ----------
        frame : DepthFrame
            What the source delivered.
        state : str, default "replay"
            The sensor's.
        read_ms : float, default NaN
            How long the frame was waited for.
        """
        asked, stages_ms = self._asked, {"read": read_ms}
        if math.isfinite(read_ms):
            self.times.add("read", read_ms)
        if asked.settings.acquire.memory == "still":
            remembering = self._remembering.submit(self._remember, asked, frame, stages_ms)
            self._remembered.append(lambda: self._go_on(asked, frame, state, stages_ms, remembering.result()))
            while len(self._remembered) > self._overlap:
                self._remembered.popleft()()
        else:
            self._catch_up()
            self._go_on(asked, frame, state, stages_ms)

    def _catch_up(self) -> None:
        """Let the selectors follow in all frames whose budget a memory has spent or is spending."""
        while self._remembered:
            self._remembered.popleft()()

    def _go_on(
        self,
        asked: _Asked,
        frame: DepthFrame,
        state: str,
        stages_ms: dict[str, float],
        memory: TemporalStep | None = None,
    ) -> None:
        """Set all of a frame going that follows its seeds: those of a memory, or the frame's own."""
        start_s = time.perf_counter()
        modelling: Future[tuple[Acquisition | None, Model | None]]
        if memory is not None:
            seeds = memory.seeds
            modelling = self._beside.submit(self._told_by, memory, frame, stages_ms)
        else:
            with self.times.stage("seeds", stages_ms):
                seeds = self._seeds(frame)
            draws = self._begun % asked.eased.model_every == 0
            modelling = self._beside.submit(self._acquire_and_model, asked, frame, seeds, draws, stages_ms)
        improving = self._beside.submit(self._improve, seeds, stages_ms)
        # In this thread, for the training of a frame begins where the last one's ended.
        if self._regions is None or self._begun % asked.eased.gas_every == 0:
            self._regions = self._gas_of(seeds, stages_ms)
        regions = self._regions
        self._begun += 1
        begun_ms = (time.perf_counter() - start_s) * 1000

        def finish() -> FrameResult:
            """Wait until all of it is made; stage "loop" is the time in `_go_on` and here."""
            start_s = time.perf_counter()
            improvement = improving.result()
            acquisition, model = modelling.result()
            if acquisition is not None and model is not None:
                model = self._beside_even(asked, frame, model, len(acquisition.uv))
            loop_ms = begun_ms + (time.perf_counter() - start_s) * 1000
            self.times.add("loop", loop_ms)
            stages_ms["loop"] = loop_ms
            return FrameResult(frame, seeds, regions, improvement, acquisition, model, memory, state, stages_ms)

        self._under_way.append(finish)

    def finished(self) -> Iterator[FrameResult]:
        """Results that need not wait for another frame to be begun."""
        while len(self._under_way) > (0 if self._remembered else self._overlap):
            yield self._under_way.popleft()()

    def rest(self) -> Iterator[FrameResult]:
        """Results of all frames under way: at the end, or when no other frame is in sight."""
        self._catch_up()
        while self._under_way:
            yield self._under_way.popleft()()

    def _seeds(self, frame: DepthFrame) -> SeedGrid:
        options = self._asked.settings.seeds
        return SeedGrid.from_frame(frame, (options.rows, options.columns))

    def _gas_of(self, seeds: SeedGrid, stages_ms: dict[str, float]) -> RegionSelection:
        with self.times.stage("neural_gas", stages_ms):
            return self._gas.update(seeds) if self._live_gas else self._gas.select(seeds)

    def _improve(self, seeds: SeedGrid, stages_ms: dict[str, float]) -> ImprovementSelection:
        with self.times.stage("improvement", stages_ms):
            return self._improvement.select(seeds)

    def _acquire_and_model(
        self, asked: _Asked, frame: DepthFrame, seeds: SeedGrid, draws: bool, stages_ms: dict[str, float]
    ) -> tuple[Acquisition | None, Model | None]:
        options = asked.settings.acquire
        if options.budget == 0:
            return None, None
        rounds = min(options.rounds, asked.eased.rounds)
        with self.times.stage("acquire", stages_ms):
            acquisition = acquire(frame.measure, seeds, options.budget, rounds, asked.selector, threads=self._threads)
        # With its plan, a result on its way to the viewer would hold all of the mesh and its images.
        measured = replace(acquisition, plan=None)
        if not draws:
            return measured, None
        with self.times.stage("model", stages_ms):
            return measured, Model.of(acquisition.reconstruct(self._threads), frame)

    def _remember(self, asked: _Asked, frame: DepthFrame, stages_ms: dict[str, float]) -> TemporalStep:
        options, seeds = asked.settings.acquire, asked.settings.seeds
        if self._memory is None:
            self._memory = TemporalAcquisition(
                frame.shape,
                budget=float(options.budget),
                seeds=(seeds.rows, seeds.columns),
                rounds=max(options.rounds, 2),
                selector=None if options.by == "auto" else asked.selector,
                camera=frame.camera,
                threads=self._threads,
            )
        with self.times.stage("acquire", stages_ms):
            return self._memory.step(frame.measure)

    def _told_by(self, step: TemporalStep, frame: DepthFrame, stages_ms: dict[str, float]) -> tuple[Acquisition, Model]:
        """What the memory measured in a frame, and its model held against it."""
        with self.times.stage("model", stages_ms):
            acquisition = Acquisition(step.uv, step.depth_mm, step.batch, frame.shape, (), f"{step.by}, with memory")
            return acquisition, Model.of(step.model_mm, frame)

    def _beside_even(self, asked: _Asked, frame: DepthFrame, model: Model, measurements: int) -> Model:
        """Now and then an even lattice's model is made as well; the model's frame gets it when it is there."""
        asked_every = asked.settings.acquire.even_every
        usual = EVEN_EVERY_LIVE if self._realtime else EVEN_EVERY
        every = usual if asked_every is None else asked_every
        if self._counted is None:  # of a recording by its own numbers, so that parts of it make what the whole makes
            self._counted = 0 if self._realtime else frame.index
        due = bool(every) and self._counted % (every * asked.eased.model_every) == 0
        self._counted += 1
        if due and self._even is None:
            self._even = self._evening.submit(Model.of_even, frame, measurements, self._threads)
        if self._even is None or (self._realtime and not self._even.done()):
            return model
        even, self._even = self._even.result(), None
        return replace(model, even=even)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        for executor in (self._remembering, self._beside, self._evening):
            executor.shutdown(cancel_futures=True)


def switched(options: AcquireOptions) -> Iterator[AcquireOptions]:
    """The same acquisition by each selector, and remembered: what is switched between while a run goes on."""
    spending = replace(options, budget=options.budget or 0.01, rounds=2, memory="off", even_every=0)
    for by in SELECTOR_NAMES[1:]:
        yield replace(spending, by=by)
    yield replace(spending, by="auto", rounds=1)
    yield replace(spending, by="auto", memory="still", even_every=1)
