"""The figures of a frame: what reports, plots and tables say of it, each computed once, here."""

from __future__ import annotations

import math

import numpy as np

from selective_depth.app.pipeline.result import FrameResult


def figures_of(result: FrameResult) -> dict[str, float]:
    """What a frame came to, but for its times; NaN for what was not made of it.

    Their names end in their unit; those without one are counts of pixels. The columns of the
    tables of `archive` have the same names, and are described there.
    """
    acquisition, model, size = result.acquisition, result.model, result.frame.depth_mm.size
    nan, even = math.nan, None if model is None else model.even
    to_truth = result.memory is not None and result.frame.truth_mm is not None  # as the line takes the model's
    seeds = 0 if result.memory is not None else result.seeds.valid.size  # a memory's first frame begins it
    measured = result.seeds.valid.size if acquisition is None else len(acquisition.uv)
    return {
        "samples": result.samples,
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
