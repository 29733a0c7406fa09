"""The one result of a frame: what pipeline, viewer, stills and reports pass on."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from selective_depth.app.settings import ViewerOptions
from selective_depth.drivers.frame import DepthFrame
from selective_depth.selectors.acquire import Acquisition
from selective_depth.selectors.even import even_lattice
from selective_depth.selectors.improvement import ImprovementSelection
from selective_depth.selectors.memory import TemporalStep
from selective_depth.selectors.neural_gas import RegionSelection
from selective_depth.selectors.reconstruct import reconstruct
from selective_depth.selectors.seeds import SeedGrid


@dataclass(frozen=True, eq=False)
class Model:
    """The dense model made of all samples of a frame, and how far it is from that frame.

    Parameters
    ----------
    depth_mm : float32 array of shape (height, width)
        Depth at every pixel.
    error_mm : float32 array of shape (height, width)
        Absolute difference from the full frame; NaN where the frame has no depth.
    rmse_mm : float
        Root mean square of it; NaN for a frame without depth.
    truth_rmse_mm, sensor_rmse_mm : float
        The same of the model and of the full frame against exact truth, over pixels of the frame
        with depth; NaN where no truth is known.
    mae_mm : float
        Mean of `error_mm`; NaN for a frame without depth.
    even : Model or None
        The even lattice's, where one was made: of this frame, or of one shortly before it where
        frames do not wait.
    """

    depth_mm: npt.NDArray[np.float32]
    error_mm: npt.NDArray[np.float32]
    rmse_mm: float
    truth_rmse_mm: float = math.nan
    sensor_rmse_mm: float = math.nan
    mae_mm: float = math.nan
    even: Model | None = None

    @classmethod
    def of(cls, depth_mm: npt.NDArray[np.float32], frame: DepthFrame) -> Model:
        """A model and what it is off from its frame and from the truth."""
        known = frame.depth_mm > 0
        error_mm = np.abs(depth_mm - frame.depth_mm.astype(np.float32))
        error_mm[~known] = np.nan
        to_truth = (math.nan, math.nan)
        if frame.truth_mm is not None:
            seen = known & (frame.truth_mm > 0)
            truth_mm = frame.truth_mm[seen].astype(np.float32)
            to_truth = _rms(depth_mm[seen] - truth_mm), _rms(frame.depth_mm[seen] - truth_mm)
        off_mm = error_mm[known]
        mae_mm = float(off_mm.mean(dtype=np.float64)) if off_mm.size else math.nan
        return cls(depth_mm, error_mm, _rms(off_mm), *to_truth, mae_mm)

    @classmethod
    def of_even(cls, frame: DepthFrame, measurements: int, threads: int | None = None) -> Model:
        """The model of an even lattice of so many measurements of a frame."""
        uv = even_lattice(frame.shape, measurements)
        return cls.of(reconstruct(uv, frame.measure(uv), frame.shape, threads=threads), frame)


def _rms(off_mm: npt.NDArray[np.floating]) -> float:
    return float(np.sqrt(np.mean(np.square(off_mm)))) if off_mm.size else math.nan


@dataclass(frozen=True, eq=False)
class FrameResult:
    """One frame and all that was made of it.

    Parameters
    ----------
    frame : DepthFrame
        What the sensor delivered.
    seeds : SeedGrid
        The first measurements.
    regions : RegionSelection
        What the neural gas selected.
    improvement : ImprovementSelection
        What the improvement map selected.
    acquisition : Acquisition or None
        Seeds and what was measured besides; None without a budget.
    model : Model or None
        The dense model, where one was made.
    memory : TemporalStep or None
        What the memory came to, where there is one; then `seeds` are what it knows of them, and
        `acquisition` what was measured in this frame.
    state : str
        The sensor's: live, stalled, lost, reconnecting; or replay.
    stages_ms : dict of str to float
        Duration of each stage in milliseconds: this frame's own, but for `log`, which is the latest.
    figures : dict of str to float
        Running figures by name: a run adds those of `figures_of`, its rate and its drops before it
        hands the result on.
    gain : str
        What selecting was worth over the last second, in a line; empty where that is not known.
    given_up : str
        What the governor leaves out, in a few words; empty if it is nothing.
    look : ViewerOptions or None
        How it is to be shown, where that changes on the way.
    """

    frame: DepthFrame
    seeds: SeedGrid
    regions: RegionSelection
    improvement: ImprovementSelection
    acquisition: Acquisition | None = None
    model: Model | None = None
    memory: TemporalStep | None = None
    state: str = "replay"
    stages_ms: dict[str, float] = field(default_factory=dict)
    figures: dict[str, float] = field(default_factory=dict)
    gain: str = ""
    given_up: str = ""
    look: ViewerOptions | None = None


def figures_of(result: FrameResult) -> dict[str, float]:
    """What a frame came to, but for its times; NaN for what was not made of it.

    Their names end in their unit; those without one are counts of pixels. The columns of the
    tables of `archive` have the same names, and are described there.
    """
    acquisition, model, size = result.acquisition, result.model, result.frame.depth_mm.size
    returned = result.seeds.valid if acquisition is None else acquisition.returned
    nan, even = math.nan, None if model is None else model.even
    to_truth = result.memory is not None and result.frame.truth_mm is not None  # as the line takes the model's
    seeds = 0 if result.memory is not None else result.seeds.valid.size  # a memory's first frame begins it
    measured = result.seeds.valid.size if acquisition is None else len(acquisition.uv)
    return {
        "samples": int(np.count_nonzero(returned)),
        "shots": 0 if acquisition is None else measured - seeds,
        "depth_percent": 100 * int(np.count_nonzero(result.frame.depth_mm)) / size,
        "measured_percent": nan if acquisition is None else 100 * measured / size,
        "known_percent": nan if result.memory is None else 100 * int(np.count_nonzero(result.memory.known)) / size,
        "neural_gas_percent": 100 * int(np.count_nonzero(result.regions.mask)) / size,
        "improvement_percent": 100 * int(np.count_nonzero(result.improvement.mask)) / size,
        "quantisation_error_mm": result.regions.quantisation_error_mm,
        "rmse_mm": nan if model is None else model.rmse_mm,
        "mae_mm": nan if model is None else model.mae_mm,
        "truth_rmse_mm": nan if model is None else model.truth_rmse_mm,
        "sensor_rmse_mm": nan if model is None else model.sensor_rmse_mm,
        "even_rmse_mm": nan if even is None else even.truth_rmse_mm if to_truth else even.rmse_mm,
    }


@dataclass(frozen=True, slots=True)
class SensorNote:
    """The sensor's state, told while there is no frame to tell it with."""

    state: str
