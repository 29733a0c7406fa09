"""One turn of the loop: a frame in; seeds, both selectors, the samples and the model out."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Self

import numpy as np

from selective_depth.app.precompile import compiling_beside
from selective_depth.app.settings import Settings
from selective_depth.app.step import Model, Step
from selective_depth.app.timing import StageTimes
from selective_depth.drivers.frame import DepthFrame
from selective_depth.selectors.acquire import Acquisition, acquire
from selective_depth.selectors.improvement import ImprovementSelector
from selective_depth.selectors.neural_gas import NeuralGasSelector
from selective_depth.selectors.regions import RegionSelection
from selective_depth.selectors.seeds import SeedGrid

MODEL_EVERY = 10
"""Of a sensor's frames, one in so many gets a dense model: at 30 frames/s, one of every frame
would take most of a core, which the frames themselves need."""


class Loop:
    """Both selectors and the acquisition, frame by frame, every stage timed.

    Parameters
    ----------
    settings : Settings
        Options of the seeds, the selectors and the acquisition.
    every_model : bool, default True
        Make the dense model of every frame. Otherwise that of every `MODEL_EVERY`-th is made
        beside the loop, and the other frames have none: a sensor does not wait.

    Raises
    ------
    ValueError
        If an option of a selector is out of its range.
    """

    def __init__(self, settings: Settings, *, every_model: bool = True) -> None:
        gas, improvement = settings.gas, settings.improvement
        # A sensor's frames come whether two cores are free or not. Three stages side by side
        # keep both busy with a thread each; with more, each would wait for parts of its work to
        # get through behind parts of the others'.
        crowded = settings.acquire.budget > 0 and not every_model
        threads = settings.run.threads or (1 if crowded else None)
        self._threads = threads
        self.times = StageTimes()
        self._settings = settings
        self._live_gas = gas.training == "live"
        self._gas = NeuralGasSelector(
            nodes=gas.nodes,
            epochs=gas.epochs,
            algorithm=gas.algorithm,
            seed=gas.seed,
            edge_metric=gas.edge_metric,
            factor=gas.factor,
            threads=threads,
        )
        self._improvement = ImprovementSelector(
            share=improvement.share, exponent=improvement.exponent, threads=threads
        )
        self._every_model = every_model
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
        self.times.clear()

    def turn(self, frame: DepthFrame, state: str = "replay") -> Step:
        """Make all of a frame that there is to make."""
        with self.times.stage("loop"):
            with self.times.stage("seeds"):
                options = self._settings.seeds
                seeds = SeedGrid.from_frame(frame, (options.rows, options.columns))
            acquiring = self._beside.submit(self._acquire, frame, seeds)
            regions = self._beside.submit(self._regions, seeds)
            with self.times.stage("improvement"):
                improvement = self._improvement.select(seeds)
            acquisition = acquiring.result()
            model = self._model(frame, acquisition)
            return Step(
                frame=frame,
                seeds=seeds,
                regions=regions.result(),
                improvement=improvement,
                acquisition=acquisition,
                model=model,
                state=state,
            )

    def _regions(self, seeds: SeedGrid) -> RegionSelection:
        with self.times.stage("neural_gas"):
            return self._gas.update(seeds) if self._live_gas else self._gas.select(seeds)

    def _acquire(self, frame: DepthFrame, seeds: SeedGrid) -> Acquisition | None:
        options = self._settings.acquire
        if options.budget == 0:
            return None
        with self.times.stage("acquire"):
            return acquire(
                frame.measure,
                seeds,
                options.budget,
                rounds=options.rounds,
                threads=self._threads,
            )

    def _model(self, frame: DepthFrame, acquisition: Acquisition | None) -> Model | None:
        if acquisition is None:
            return None
        if self._every_model:
            return self._made(frame, acquisition)
        self._since_model += 1
        done = self._pending if self._pending and self._pending.done() else None
        if done:
            self._pending = None
        if self._pending is None and self._since_model >= MODEL_EVERY:
            self._pending = self._modelling.submit(self._made, frame, acquisition)
            self._since_model = 0
        return done.result() if done else None

    def _made(self, frame: DepthFrame, acquisition: Acquisition) -> Model:
        with self.times.stage("model"):
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
