"""The published definitions in float64, one dense solve after the other: slow and obvious."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from kriging_systems import LocalSystem, local_systems

from selective_depth.selectors.seeds import SeedGrid

Array = npt.NDArray[np.float64]


def gamma(p: npt.NDArray[np.generic], q: npt.NDArray[np.generic], a, b, w) -> Array:
    """Semivariogram (eq. 24) between every p and every q, pixels of shape (n, 2) and (k, 2)."""
    h = np.sqrt(((p[:, None] - q[None]).astype(np.float64) ** 2).sum(axis=2))
    return a * h**w + b * (h > 0)


def krige(p, depth, targets, a, b, w) -> tuple[Array, Array, Array]:
    """Eq. (5)-(10): weights (n, k), estimates (k,) and variances (k,) at the targets."""
    n = len(p)
    K = np.ones((n + 1, n + 1))
    K[:n, :n] = gamma(p, p, a, b, w)
    K[n, n] = 0
    k = np.ones((n + 1, len(targets)))
    k[:n] = gamma(p, targets, a, b, w)
    weights = np.linalg.solve(K, k)
    return weights[:n], weights[:n].T @ depth, (weights * k).sum(axis=0)


def direct_improvement(p, depth, s, targets, a, b, w, floor=0.0) -> float:
    """Eq. (13): variance-to-mean ratios before and after s is measured, both systems solved.

    As eq. (12) assumes, the measurement returns the estimate. Estimates below `floor` are
    raised to it.
    """
    if (p == s).all(axis=1).any():
        return 0.0  # measured already: the enlarged system would hold s twice
    s = np.asarray(s)[None]
    _, before_z, before = krige(p, depth, targets, a, b, w)
    estimate = krige(p, depth, s, a, b, w)[1]
    enlarged, depths = np.concatenate((p, s)), np.concatenate((depth, estimate))
    _, after_z, after = krige(enlarged, depths, targets, a, b, w)
    return float((before / np.maximum(before_z, floor) - after / np.maximum(after_z, floor)).sum())


def reference_pixel(seeds: SeedGrid, u: int, v: int, w: float) -> tuple[float, float, float]:
    """Estimate, variance and improvement of a pixel, from its local systems."""
    z = variance = improvement = 0.0
    at = np.array((u, v))
    for system in local_systems(seeds, u, v, w):
        one = reference_system(system, at, w)
        z += system.weight * one[0]
        variance += system.weight * one[1]
        improvement += system.weight * one[2]
    return z, variance, improvement


def reference_system(system: LocalSystem, at, w: float) -> tuple[float, float, float]:
    """Estimate, variance and improvement of a pixel in one of its systems."""
    # Without any variation every semivariogram gives the same estimate, and nothing improves.
    constant = system.a == 0 and system.b == 0
    a, b = (1.0, 0.0) if constant else (system.a, system.b)
    floor = system.depth_mm.min() / 2
    _, z, variance = krige(system.uv, system.depth_mm, at[None], a, b, w)
    if constant:
        return max(float(z[0]), floor), 0.0, 0.0
    improvement = direct_improvement(system.uv, system.depth_mm, at, system.neighbours_uv, a, b, w, floor)
    return max(float(z[0]), floor), float(variance[0]), improvement
