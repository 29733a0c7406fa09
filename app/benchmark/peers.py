"""What the same work takes elsewhere, timed in the same run: the yardsticks of `bench`.

Absolute times say more of the machine than of the program, so every speed is stated as a ratio
to one of these.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib.util import find_spec

import numpy as np
import numpy.typing as npt

from selective_depth.selectors.seeds import SeedGrid

NEIGHBOURS = 16
PYKRIGE_PIXELS = (500, 10_000)
"""Pixels of PyKrige's two timed samples: the whole frame would take minutes."""
NUMPY_STEPS = 3000

Points = npt.NDArray[np.float32]


def pixel_centres(shape: tuple[int, int]) -> npt.NDArray[np.float64]:
    """Every pixel as (column, row), shape (height * width, 2)."""
    v, u = np.indices(shape)
    return np.column_stack((u.ravel(), v.ravel())).astype(np.float64)


def krigekit_seconds(seeds: SeedGrid) -> float:
    """Time krigekit's ordinary kriging (compiled Fortran, all threads) for a whole frame.

    Estimate and variance only, from the 16 nearest seeds, a fixed variogram: less than the
    improvement map does.
    """
    from krigekit import ordinary_kriging

    known = seeds.uv.astype(np.float64)
    depth_mm = seeds.depth_mm[seeds.valid].astype(np.float64)
    structure = {"vtype": "sph", "nugget": 100.0, "sill": 1e5, "a_major": 200.0}
    start = time.perf_counter()
    ordinary_kriging(known, depth_mm, pixel_centres(seeds.frame_shape), vgm_spec=structure, nmax=NEIGHBOURS)
    return time.perf_counter() - start


def pykrige_seconds(seeds: SeedGrid) -> float:
    """Time PyKrige's ordinary kriging of two samples of a frame's pixels; extend to all.

    Its cost is a fixed part (it builds the matrix of all pairs of seeds, 2 GB) and one per
    pixel: both are taken from the two times.
    """
    from pykrige.ok import OrdinaryKriging

    u, v = seeds.uv.T.astype(np.float64)
    depth_mm = seeds.depth_mm[seeds.valid].astype(np.float64)
    structure = {"scale": 1.0, "exponent": 1.9, "nugget": 1.0}
    model = OrdinaryKriging(u, v, depth_mm, "power", structure)
    everywhere = pixel_centres(seeds.frame_shape)
    shuffled = np.random.default_rng(0).permutation(everywhere)

    def seconds(pixels: int) -> float:
        x, y = shuffled[:pixels].T
        start = time.perf_counter()
        model.execute("points", x, y, backend="C", n_closest_points=NEIGHBOURS)
        return time.perf_counter() - start

    few, many = PYKRIGE_PIXELS
    first, second = seconds(few), seconds(many)
    per_pixel = max(second - first, 0.0) / (many - few)
    return first + per_pixel * (len(everywhere) - few)


def numpy_neural_gas(points_mm: Points, nodes: int, rng: np.random.Generator) -> Points:
    """Train neural gas by a plain NumPy loop of eq. (1)-(4), `NUMPY_STEPS` steps."""
    weights = points_mm[rng.integers(len(points_mm), size=nodes)].copy()
    for step, draw in enumerate(rng.integers(len(points_mm), size=NUMPY_STEPS)):
        progress = step / NUMPY_STEPS
        rate = 0.5 * (0.005 / 0.5) ** progress
        reach = nodes / 2 * (0.01 / (nodes / 2)) ** progress
        away = points_mm[draw] - weights
        rank = np.empty(nodes, dtype=np.int64)
        rank[np.argsort(np.einsum("ij,ij->i", away, away))] = np.arange(nodes)
        weights += (rate * np.exp(-rank / reach))[:, None].astype(np.float32) * away
    return weights


def numpy_neural_gas_seconds(points_mm: Points, nodes: int, epochs: int) -> float:
    """Time `numpy_neural_gas` over 3,000 steps, scaled to a whole training."""
    start = time.perf_counter()
    numpy_neural_gas(points_mm, nodes, np.random.default_rng(0))
    spent = time.perf_counter() - start
    return spent / NUMPY_STEPS * epochs * len(points_mm)


def peer_seconds(seeds: SeedGrid, nodes: int, epochs: int) -> dict[str, float]:
    """Time every peer that is installed, on the seeds of one frame.

    Returns
    -------
    dict of str to float
        Seconds by name; `pip install 'selective-depth[bench]'` adds the kriging libraries.
    """
    timed: dict[str, Callable[[], float]] = {
        "numpy_neural_gas": lambda: numpy_neural_gas_seconds(seeds.points_mm, nodes, epochs)
    }
    if find_spec("krigekit"):
        timed["krigekit_ordinary_kriging"] = lambda: krigekit_seconds(seeds)
    if find_spec("pykrige"):
        timed["pykrige_ordinary_kriging"] = lambda: pykrige_seconds(seeds)
    return {name: measure() for name, measure in timed.items()}
