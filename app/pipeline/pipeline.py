"""One frame's way: seeds, both selectors, the samples and the model, side by side and timed."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any, Self

import numpy as np

from selective_depth.app.console.errors import UsageError
from selective_depth.app.pipeline.result import FrameResult, Model
from selective_depth.app.pipeline.selecting import gas_of, improvement_of, selector_of
from selective_depth.app.pipeline.timing import StageTimes
from selective_depth.app.pipeline.warm_up import compiling_beside
from selective_depth.app.settings import Settings
from selective_depth.drivers.frame import DepthFrame
from selective_depth.selectors.acquire import Acquisition, acquire
from selective_depth.selectors.even import even_lattice
from selective_depth.selectors.improvement import ImprovementSelection
from selective_depth.selectors.memory import TemporalAcquisition, TemporalStep
from selective_depth.selectors.neural_gas import RegionSelection
from selective_depth.selectors.quality import errors_of
from selective_depth.selectors.reconstruct import reconstruct
from selective_depth.selectors.seeds import SeedGrid

EVEN_EVERY = 10
"""Of a recording's frames, one in so many is measured evenly as well, to tell what selecting gains."""
MODEL_EVERY = 10
"""Of a sensor's frames, one in so many gets a dense model: at 30 frames/s, one of every frame
would take most of a core, which the frames themselves need."""


class _AtOnce(Executor):
    """Does what it is given in the calling thread."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


class Pipeline:
    """Both selectors and the acquisition, frame by frame, every stage timed.

    Frames are put in with `begin` and taken out, in their order, with `finished` and `rest`.
    While one is made the next is begun: two frames with a thread for each of their parts keep two
    processors busier than one frame whose every part waits for its slowest thread. Only a
    sensor's frames of which nothing is acquired are made one by one: they are ready long before
    the next one comes, and so are seen at once.

    Parameters
    ----------
    settings : Settings
        Options of the seeds, the selectors and the acquisition.
    realtime : bool, default False
        Frames come whether the pipeline is ready or not. Then the dense model of every
        `MODEL_EVERY`-th is made beside it, and the other frames have none.
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
        self._overlap = 0 if one_thread else int(settings.acquire.budget > 0 or not realtime)
        self._threads = settings.run.threads or (1 if self._overlap or one_thread else None)
        self.times = StageTimes()
        self._settings = settings
        self._live_gas = settings.gas.training == "live"
        self._gas = gas_of(settings, self._threads)
        self._improvement = improvement_of(settings, self._threads)
        self._selector = selector_of(settings, self._threads)
        self._remembers = settings.acquire.memory == "still"
        if self._remembers and not settings.acquire.budget:
            raise UsageError("--memory still spends a --budget in every frame; give one, such as 2%.")
        self._memory: TemporalAcquisition | None = None
        self._realtime = realtime
        # The stages are compiled and free of the GIL: side by side they take as long as the
        # longest of them.
        self._beside: Executor = _AtOnce() if one_thread else ThreadPoolExecutor(2, thread_name_prefix="beside")
        self._modelling = ThreadPoolExecutor(1, thread_name_prefix="model")
        self._under_way: deque[Callable[[], FrameResult]] = deque()
        self._pending: Future[Model] | None = None
        self._since_model = MODEL_EVERY

    def warm_up(self, frame: DepthFrame) -> None:
        """Compile the kernels, fill the tables and train the first nodes, untimed."""
        with compiling_beside():
            self._improvement.select(self._seeds(frame))
        self.make(frame)
        if self._pending is not None:
            self._pending.result()
        self._memory = None
        self.times.clear()

    def train(self, frame: DepthFrame) -> None:
        """Train the first nodes alone, as `warm_up` leaves them, where all is compiled already."""
        if self._live_gas:
            self._regions(self._seeds(frame), {})
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
        start_s = time.perf_counter()
        stages_ms = {"read": read_ms}
        if math.isfinite(read_ms):
            self.times.add("read", read_ms)
        step: TemporalStep | None = None
        modelling: Future[tuple[Acquisition | None, Model | None]]
        if self._remembers:
            step = self._remember(frame, stages_ms)
            seeds = step.seeds
            modelling = self._beside.submit(self._told_by, step, frame, stages_ms)
        else:
            with self.times.stage("seeds", stages_ms):
                seeds = self._seeds(frame)
            modelling = self._beside.submit(self._acquire_and_model, frame, seeds, stages_ms)
        improving = self._beside.submit(self._improve, seeds, stages_ms)
        # In this thread, for the training of a frame begins where the last one's ended.
        regions = self._regions(seeds, stages_ms)
        begun_ms = (time.perf_counter() - start_s) * 1000

        def finish() -> FrameResult:
            """Wait until all of it is made; stage "loop" is the time in `begin` and here."""
            start_s = time.perf_counter()
            improvement = improving.result()
            acquisition, model = modelling.result()
            if acquisition is not None and model is None:
                model = self._model_of_some(frame, acquisition)
            loop_ms = begun_ms + (time.perf_counter() - start_s) * 1000
            self.times.add("loop", loop_ms)
            return FrameResult(
                frame=frame,
                seeds=seeds,
                regions=regions,
                improvement=improvement,
                acquisition=acquisition,
                model=model,
                memory=step,
                state=state,
                stages_ms=stages_ms | {"loop": loop_ms},
            )

        self._under_way.append(finish)

    def finished(self) -> Iterator[FrameResult]:
        """Results that need not wait for another frame to be begun."""
        while len(self._under_way) > self._overlap:
            yield self._under_way.popleft()()

    def rest(self) -> Iterator[FrameResult]:
        """Results of all frames under way: at the end, or when no other frame is in sight."""
        while self._under_way:
            yield self._under_way.popleft()()

    def _seeds(self, frame: DepthFrame) -> SeedGrid:
        options = self._settings.seeds
        return SeedGrid.from_frame(frame, (options.rows, options.columns))

    def _regions(self, seeds: SeedGrid, stages_ms: dict[str, float]) -> RegionSelection:
        with self.times.stage("neural_gas", stages_ms):
            return self._gas.update(seeds) if self._live_gas else self._gas.select(seeds)

    def _improve(self, seeds: SeedGrid, stages_ms: dict[str, float]) -> ImprovementSelection:
        with self.times.stage("improvement", stages_ms):
            return self._improvement.select(seeds)

    def _acquire_and_model(
        self, frame: DepthFrame, seeds: SeedGrid, stages_ms: dict[str, float]
    ) -> tuple[Acquisition | None, Model | None]:
        options = self._settings.acquire
        if options.budget == 0:
            return None, None
        with self.times.stage("acquire", stages_ms):
            acquisition = acquire(
                frame.measure, seeds, options.budget, options.rounds, self._selector, threads=self._threads
            )
        model = None if self._realtime else self._model(frame, acquisition, stages_ms)
        return acquisition, model

    def _remember(self, frame: DepthFrame, stages_ms: dict[str, float]) -> TemporalStep:
        options, seeds = self._settings.acquire, self._settings.seeds
        if self._memory is None:
            self._memory = TemporalAcquisition(
                frame.shape,
                budget=float(options.budget),
                seeds=(seeds.rows, seeds.columns),
                rounds=max(options.rounds, 2),
                selector=None if options.by == "auto" else self._selector,
                camera=frame.camera,
                threads=self._threads,
            )
        with self.times.stage("acquire", stages_ms):
            return self._memory.step(frame.measure)

    def _told_by(self, step: TemporalStep, frame: DepthFrame, stages_ms: dict[str, float]) -> tuple[Acquisition, Model]:
        """What the memory measured in a frame, and its model held against it."""
        with self.times.stage("model", stages_ms):
            acquisition = Acquisition(step.uv, step.depth_mm, step.batch, frame.shape, (), f"{step.by}, with memory")
            return acquisition, Model.of(step.model_mm, frame, self._even_rmse_mm(frame, len(step.uv)))

    def _model_of_some(self, frame: DepthFrame, acquisition: Acquisition) -> Model | None:
        """Begin a model now and then, and return it when it is made."""
        self._since_model += 1
        done = self._pending if self._pending and self._pending.done() else None
        if done:
            self._pending = None
        if self._pending is None and self._since_model >= MODEL_EVERY:
            self._pending = self._modelling.submit(self._model, frame, acquisition)
            self._since_model = 0
        return done.result() if done else None

    def _model(self, frame: DepthFrame, acquisition: Acquisition, stages_ms: dict[str, float] | None = None) -> Model:
        with self.times.stage("model", stages_ms):
            depth_mm = acquisition.reconstruct(self._threads)
            return Model.of(depth_mm, frame, self._even_rmse_mm(frame, len(acquisition.uv)))

    def _even_rmse_mm(self, frame: DepthFrame, measurements: int) -> float:
        """What an even lattice of so many measurements would be off, for one in `EVEN_EVERY` frames."""
        if frame.index % EVEN_EVERY and (self._remembers or not self._realtime):
            return math.nan
        truth_mm = frame.truth_mm if self._remembers and frame.truth_mm is not None else frame.depth_mm
        seen_mm = np.where(frame.depth_mm > 0, truth_mm, 0)
        uv = even_lattice(frame.shape, measurements)
        even_mm = reconstruct(uv, frame.measure(uv), frame.shape, threads=self._threads)
        return errors_of(even_mm, seen_mm).rmse_mm if seen_mm.any() else math.nan

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self._beside.shutdown(cancel_futures=True)
        self._modelling.shutdown(cancel_futures=True)
