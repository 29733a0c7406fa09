"""The kriging systems behind one pixel of the improvement map, spelled out.

The map is made by kernels that never build these systems. This module does, for one pixel, in
plain arrays: to inspect why a pixel scores as it does, and to check the map against eq. (13).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from selective_depth.selectors.arrays import Longs
from selective_depth.selectors.improvement.neighbourhoods import Axis, windows_of
from selective_depth.selectors.improvement.scattered import EXPONENT
from selective_depth.selectors.improvement.variogram import fit_samples
from selective_depth.selectors.seeds import SeedGrid

NEIGHBOURS = np.array([(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)])
"""Offsets (columns, rows) of the neighbourhood m of a pixel."""


@dataclass(frozen=True, eq=False)
class LocalSystem:
    """One of the (up to four) systems that a pixel's values are the weighted mean of.

    Parameters
    ----------
    weight : float
        Its share; the shares of a pixel's systems sum to 1.
    a, b : float
        Its semivariogram: slope (mm^2 per pixel^w) and nugget (mm^2).
    uv : int64 array of shape (n, 2)
        Its samples, column first.
    depth_mm : float64 array of shape (n,)
        Their depths.
    neighbours_uv : int64 array of shape (m, 2)
        The pixels whose variance-to-mean ratio counts, the pixel itself first.
    """

    weight: float
    a: float
    b: float
    uv: npt.NDArray[np.int64]
    depth_mm: npt.NDArray[np.float64]
    neighbours_uv: npt.NDArray[np.int64]


def local_systems(seeds: SeedGrid, u: int, v: int, exponent: float = EXPONENT) -> list[LocalSystem]:
    """Systems behind the pixel at column `u`, row `v`.

    Parameters
    ----------
    seeds : SeedGrid
        What the map was made from.
    u, v : int
        The pixel.
    exponent : float, default 1.2
        The w = 2 - epsilon of eq. (24).

    Returns
    -------
    list of LocalSystem
        Empty where no window around holds two samples.
    """
    windows = windows_of(seeds, exponent)
    height, width = seeds.frame_shape
    neighbours = np.array((u, v)) + NEIGHBOURS
    inside = (neighbours >= 0).all(axis=1) & (neighbours < (width, height)).all(axis=1)
    found: list[tuple[float, float, float, Longs, npt.NDArray[np.float64]]] = []
    for i, share_down in _centres(windows.rows, v):
        for j, share_across in _centres(windows.columns, u):
            box = np.s_[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2]
            valid = seeds.valid[box]
            count = int(valid.sum())
            if count < 2 or share_down * share_across == 0:
                continue
            uv = seeds.lattice_uv[box][valid].astype(np.int64)
            depth = seeds.depth_mm[box][valid].astype(np.float64)
            steps = uv[:, None] - uv
            between = (steps.astype(np.float64) ** 2).sum(axis=2) ** (exponent / 2)
            a, b = fit_samples(depth, np.arange(count), count, between)
            found.append((share_down * share_across * count, a, b, uv, depth))
    total = sum(weight for weight, *_ in found)
    return [LocalSystem(weight / total, a, b, uv, depth, neighbours[inside]) for weight, a, b, uv, depth in found]


def _centres(axis: Axis, pixel: int) -> list[tuple[int, float]]:
    """Lattice points whose windows hold a pixel, with the share of each."""
    return [
        (int(axis.first[pixel]), float(axis.first_weight[pixel])),
        (int(axis.second[pixel]), float(axis.second_weight[pixel])),
    ]
