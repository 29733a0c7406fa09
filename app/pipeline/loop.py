"""One turn of the loop: a frame in; seeds, both selectors, the samples and the model out."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np

from selective_depth.app.console.errors import UsageError
from selective_depth.app.pipeline.result import Arrival, Model, Step
from selective_depth.app.pipeline.timing import StageTimes
from selective_depth.app.pipeline.warm_up import compiling_beside
from selective_depth.app.settings import Settings
from selective_depth.drivers.frame import DepthFrame
from selective_depth.selectors.acquire import Acquisition, acquire
from selective_depth.selectors.improvement import ImprovementSelection, ImprovementSelector
from selective_depth.selectors.neural_gas import NeuralGasSelector, RegionSelection
from selective_depth.selectors.seeds import SeedGrid

MODEL_EVERY = 10
"""Of a sensor's frames, one in so many gets a dense model: at 30 frames/s, one of every frame
would take most of a core, which the frames themselves need."""


@contextmanager
def _as_options(section: str) -> Iterator[None]:
    """Name the option where a selector names its parameter: they are called the same."""
    try:
        yield
    except ValueError as error:
        raise UsageError(f"--{section}.{error}.") from None


@dataclass(frozen=True, eq=False)
class _Turn:
    """A frame under way: what is made of it, and what is being made.

    Parameters
    ----------
    frame : DepthFrame
        What the sensor delivered.
    state : str
        The sensor's.
    seeds : SeedGrid
        The first measurements.
    regions : RegionSelection
        What the neural gas selected.
    improving, modelling : Future
        The other parts, in threads beside the loop.
    begun_ms : float
        How long the loop was busy with it so far.
    stages_ms : dict of str to float
        Duration of each stage that is done.
    """

    frame: DepthFrame
    state: str
    seeds: SeedGrid
    regions: RegionSelection
    improving: Future[ImprovementSelection]
    modelling: Future[tuple[Acquisition | None, Model | None]]
    begun_ms: float
    stages_ms: dict[str, float]


class Loop:
    """Both selectors and the acquisition, frame by frame, every stage timed.

    Parameters
    ----------
    settings : Settings
        Options of the seeds, the selectors and the acquisition.
    realtime : bool, default False
        Frames come whether the loop is ready or not. Then the dense model of every
        `MODEL_EVERY`-th is made beside it, and the other frames have none.

    Raises
    ------
    UsageError
        If an option of a selector is out of its range.
    """

    def __init__(self, settings: Settings, *, realtime: bool = False) -> None:
        gas, improvement = settings.gas, settings.improvement
        self._overlap = int(settings.acquire.budget > 0 or not realtime)
        threads = settings.run.threads or (1 if self._overlap else None)
        self._threads = threads
        self.times = StageTimes()
        self._settings = settings
        self._live_gas = gas.training == "live"
        with _as_options("gas"):
            self._gas = NeuralGasSelector(
                nodes=gas.nodes,
                epochs=gas.epochs,
                algorithm=gas.algorithm,
                seed=gas.seed,
                edge_metric=gas.edge_metric,
                factor=gas.factor,
                threads=threads,
            )
        with _as_options("improvement"):
            self._improvement = ImprovementSelector(
                share=improvement.share, exponent=improvement.exponent, threads=threads
            )
        self._realtime = realtime
        # The stages are compiled and free of the GIL: side by side they take as long as the
        # longest of them.
        self._beside = ThreadPoolExecutor(2, thread_name_prefix="beside")
        self._modelling = ThreadPoolExecutor(1, thread_name_prefix="model")
        self._pending: Future[Model] | None = None
        self._since_model = MODEL_EVERY

    def warm_up(self, frame: DepthFrame) -> None:
        """Compile the kernels, fill the tables and train the first nodes, untimed."""
        options = self._settings.seeds
        with compiling_beside():
            self._improvement.select(SeedGrid.from_frame(frame, (options.rows, options.columns)))
        self.turn(frame)
        if self._pending is not None:
            self._pending.result()
        self.times.clear()

    def turn(self, frame: DepthFrame, state: str = "replay") -> Step:
        """Make all of a frame that there is to make."""
        return self._end(self._begin(Arrival(frame, state)))

    def steps(self, frames: Iterable[Arrival | None]) -> Iterator[Step]:
        """Turn all of these frames, each with its sensor's state; None where none came in time.

        While one is made, the next is begun: two frames with a thread for each of their parts keep
        two processors busier than one frame whose every part waits for its slowest thread. Only a
        sensor's frames of which nothing is acquired are made one by one: they are ready long
        before the next one comes, and so are seen at once.
        """
        under_way: deque[_Turn] = deque()
        for each in frames:
            if each is not None:
                under_way.append(self._begin(each))
            while len(under_way) > (0 if each is None else self._overlap):
                yield self._end(under_way.popleft())
        while under_way:
            yield self._end(under_way.popleft())

    def _begin(self, arrival: Arrival) -> _Turn:
        """Take a frame's seeds, set the rest going, and train the nodes meanwhile."""
        start_s = time.perf_counter()
        frame, stages_ms = arrival.frame, {"read": arrival.read_ms}
        with self.times.stage("seeds", stages_ms):
            options = self._settings.seeds
            seeds = SeedGrid.from_frame(frame, (options.rows, options.columns))
        modelling = self._beside.submit(self._acquire_and_model, frame, seeds, stages_ms)
        improving = self._beside.submit(self._improve, seeds, stages_ms)
        # In this thread, for the training of a frame begins where the last one's ended.
        regions = self._regions(seeds, stages_ms)
        begun_ms = (time.perf_counter() - start_s) * 1000
        return _Turn(
            frame, arrival.state, seeds, regions, improving, modelling, begun_ms, stages_ms
        )

    def _end(self, turn: _Turn) -> Step:
        """Wait until all of a frame is made; stage "loop" is the time in `_begin` and here."""
        start_s = time.perf_counter()
        improvement = turn.improving.result()
        acquisition, model = turn.modelling.result()
        if acquisition is not None and model is None:
            model = self._model_of_some(turn.frame, acquisition)
        loop_ms = turn.begun_ms + (time.perf_counter() - start_s) * 1000
        self.times.add("loop", loop_ms)
        return Step(
            frame=turn.frame,
            seeds=turn.seeds,
            regions=turn.regions,
            improvement=improvement,
            acquisition=acquisition,
            model=model,
            state=turn.state,
            stages_ms=turn.stages_ms | {"loop": loop_ms},
        )

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
                frame.measure,
                seeds,
                options.budget,
                rounds=options.rounds,
                threads=self._threads,
            )
        model = None if self._realtime else self._model(frame, acquisition, stages_ms)
        return acquisition, model

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

    def _model(
        self,
        frame: DepthFrame,
        acquisition: Acquisition,
        stages_ms: dict[str, float] | None = None,
    ) -> Model:
        with self.times.stage("model", stages_ms):
            depth_mm = acquisition.reconstruct(self._threads)
            error_mm = np.abs(depth_mm - frame.depth_mm.astype(np.float32))
            error_mm[frame.depth_mm == 0] = np.nan
            known = error_mm[frame.depth_mm > 0]
            rmse_mm = float(np.sqrt(np.mean(np.square(known)))) if known.size else float("nan")
            return Model(depth_mm, error_mm, rmse_mm)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._beside.shutdown(cancel_futures=True)
        self._modelling.shutdown(cancel_futures=True)
