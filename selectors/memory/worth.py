"""What one more shot at a pixel is worth: the squared error that it is expected to remove.

A known pixel's error has two parts. It may be fused to the wrong one of two surfaces: with `k` of
`n` observations dissenting, the chance that the minority is right is the tail beyond one half of a
beta distribution, and the error then is their distance. And it has the sensor's noise, which falls
with the number of observations, and which its neighbourhood shares, for the model is drawn through
it. A new pixel's error is the range of the model about it, where a discontinuity may run.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Floats, Longs
from selective_depth.selectors.memory.store import KEPT, Memory
from selective_depth.selectors.triangulation import TILE_PX, Layers

PRIOR = 0.5
"""Of the beta distribution: as if half an observation had been made of either surface."""

NEW_STEP = 0.125
"""Chance that a new pixel in the range of a discontinuity shows what its neighbours do not."""
NEW_FLAT, SHARED = 0.25, 8.0
"""Weight of the noise of a new pixel, and of a known one, which some eight pixels share: on a
surface it is better to know few pixels well than many badly."""
AGED_FRAMES = 300.0
"""After so many frames without a look, the error expected has doubled."""


@dataclass(frozen=True)
class Noise:
    """Standard deviation of a measurement: ``floor_mm + per_mm * z^2``.

    Parameters
    ----------
    floor_mm : float, default 1
        What there is at any distance.
    per_mm : float, default 1.4e-6
        Growth with the square of the distance, 1/mm: half a disparity step of a Kinect for Xbox
        360, 5.6 mm at 2 m (``z^2 / (8 f b)`` is a step). 0 for a sensor whose noise does not grow.
    """

    floor_mm: float = 1.0
    per_mm: float = 1.4e-6


@cache
def wrong() -> Floats:
    """Chance that the minority of k of n observations is right, shape (KEPT + 1, KEPT + 1)."""
    from scipy.special import betainc  # a fifth of a second to import, for who remembers alone

    n, k = np.meshgrid(np.arange(KEPT + 1), np.arange(KEPT + 1), indexing="ij")
    k = np.minimum(k, n)
    return np.asarray(1 - betainc(k + PRIOR, n - k + PRIOR, 0.5), np.float32)


@njit(cache=True, nogil=True)
def shot_worth(
    first: int,
    end: int,
    tiles: Longs,
    memory: Memory,
    layers: Layers,
    reach_sq: float,
    noise: tuple[float, float],
    now: int,
    wrong: Floats,
    worth: Floats,
) -> None:
    """Score the pixels of some tiles: squared millimetres that a shot is expected to remove.

    Parameters
    ----------
    first, end : int
        Which of the tiles.
    tiles : int64 array
        Tiles of `TILE_PX` pixels a side, numbered row by row.
    memory : Memory
        What is known.
    layers : Layers
        The model drawn through it, float32 (H, W), and the squared distance to the nearest known
        pixel, int32 (H, W).
    reach_sq : float
        No shot farther than this from one.
    noise : tuple of float
        `floor_mm` and `per_mm` of `Noise`.
    now : int
        The frame; what was measured in it is not measured again.
    wrong : float32 array
        What the function of that name gives.
    worth : float32 array of shape (H, W)
        Filled in.
    """
    model_mm, gap_sq = layers.depth_mm, layers.gap_sq
    height, width = model_mm.shape
    floor_mm, per_mm = noise
    columns = layers.touched.shape[1]
    lows, highs = np.empty((2, TILE_PX + 2), np.float32)  # of three rows, in each column
    for tile in tiles[first:end]:
        top, left = tile // columns * TILE_PX, tile % columns * TILE_PX
        stop = min(left + TILE_PX, width)
        for v in range(top, min(top + TILE_PX, height)):
            upper, here, lower = model_mm[max(v - 1, 0)], model_mm[v], model_mm[min(v + 1, height - 1)]
            for k in range(stop - left + 2):
                u = min(max(left + k - 1, 0), width - 1)
                lows[k], highs[k] = min(upper[u], here[u], lower[u]), max(upper[u], here[u], lower[u])
            for u in range(left, stop):
                if memory.asked[v, u] == now or gap_sq[v, u] > reach_sq:
                    worth[v, u] = 0
                    continue
                z, k = here[u], u - left
                low, high = min(lows[k], lows[k + 1], lows[k + 2]), max(highs[k], highs[k + 1], highs[k + 2])
                sigma = floor_mm + per_mm * z * z
                noise_mm2 = sigma * sigma
                step_mm2 = np.float32(0.25) * (high - low) * (high - low)
                n, shots = memory.held[v, u], memory.held[v, u] + memory.missed[v, u]
                if n == 0:
                    expected = NEW_STEP * step_mm2 + NEW_FLAT * noise_mm2
                else:
                    dissent = memory.dissent[v, u]
                    apart_mm2 = memory.apart_mm2[v, u] if dissent > 0 else step_mm2
                    expected = apart_mm2 * wrong[n, dissent] + SHARED * noise_mm2 / n
                    age = np.float32(now - memory.asked[v, u])
                    expected *= np.float32(1) + age / np.float32(AGED_FRAMES)
                worth[v, u] = expected / np.float32(shots + 1)
