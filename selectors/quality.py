"""How good a model is: its error against the whole frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from selective_depth.selectors.arrays import measured_mm

WRONG_MM = 20.0
"""A pixel off by more than this, and by more than `WRONG_SHARE` of its depth, is wrong."""
WRONG_SHARE = 0.02


class ModelErrors(NamedTuple):
    """How far a model is from the frame it is of.

    Parameters
    ----------
    rmse_mm, mae_mm : float
        Root mean square and mean absolute error, millimetres.
    wrong : float
        Share of the pixels off by more than `WRONG_MM` and `WRONG_SHARE` of their depth.
    """

    rmse_mm: float
    mae_mm: float
    wrong: float


def errors_of(model_mm: npt.NDArray[np.floating], truth_mm: npt.ArrayLike) -> ModelErrors:
    """Errors of a model over all pixels whose true depth is known.

    Parameters
    ----------
    model_mm : float array of shape (H, W)
        The model, a depth at every pixel; a pixel without one has an error of its whole depth.
    truth_mm : array of shape (H, W)
        The frame; 0, negative, masked or not finite = not known.

    Raises
    ------
    ValueError
        If the shapes differ or no true depth is known.

    Examples
    --------
    What selecting is worth, on a frame of your own:

    >>> import numpy as np
    >>> from selective_depth.selectors.acquire import acquire
    >>> from selective_depth.selectors.even import even_lattice
    >>> from selective_depth.selectors.reconstruct import reconstruct
    >>> from selective_depth.selectors.seeds import SeedGrid
    >>> truth_mm = np.full((120, 160), 2000, np.uint16)
    >>> truth_mm[30:90, 50:110] = 1200
    >>> model = acquire(lambda uv: truth_mm[uv[:, 1], uv[:, 0]],
    ...                 SeedGrid.from_array(truth_mm, (24, 32)), budget=0.05)
    >>> uv = even_lattice(truth_mm.shape, len(model.uv))
    >>> even_mm = reconstruct(uv, truth_mm[uv[:, 1], uv[:, 0]], truth_mm.shape)
    >>> even, selected = (errors_of(mm, truth_mm) for mm in (even_mm, model.reconstruct()))
    >>> selected.rmse_mm < 0.2 * even.rmse_mm
    True
    """
    truth = measured_mm(truth_mm, "truth_mm")
    model = measured_mm(model_mm, "model_mm")
    if model.shape != truth.shape:
        raise ValueError(f"the model has shape {model.shape}, the frame {truth.shape}")
    valid = truth > 0
    if not valid.any():
        raise ValueError("no pixel of the frame has a depth to hold the model against")
    known_mm = truth[valid].astype(np.float64)
    error_mm = np.abs(model[valid] - known_mm)
    wrong = error_mm > np.maximum(WRONG_MM, WRONG_SHARE * known_mm)
    return ModelErrors(float(np.sqrt(np.mean(error_mm**2))), float(np.mean(error_mm)), float(np.mean(wrong)))
