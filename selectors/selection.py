"""What every selector answers: where more measurements are worth taking."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from selective_depth.selectors.seeds import SeedGrid


@dataclass(frozen=True, eq=False)
class Selection:
    """Where more measurements are worth taking.

    Parameters
    ----------
    mask : bool array of shape (height, width)
        The selected regions.
    score : float32 array of shape (height, width)
        Worth of a measurement at each pixel, 0..1; 0 where nothing is known nearby.
    name : str
        The selector that made it.
    """

    mask: npt.NDArray[np.bool_]
    score: npt.NDArray[np.float32]
    name: str

    def __post_init__(self) -> None:
        if self.mask.dtype != np.bool_ or self.mask.ndim != 2:
            raise ValueError(
                f"mask must be bool of shape (height, width), got {self.mask.dtype}"
                f" {self.mask.shape}"
            )
        if self.score.dtype != np.float32 or self.score.shape != self.mask.shape:
            raise ValueError(
                f"score must be float32 of shape {self.mask.shape}, got {self.score.dtype}"
                f" {self.score.shape}"
            )


class Selector(Protocol):
    """Seeds in, selection out."""

    def select(self, seeds: SeedGrid) -> Selection:
        """Decide from the seeds alone where more measurements are worth taking."""
        ...
