"""How far depth lies from smooth surfaces, in a Kinect's disparity steps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def in_steps(depth_mm: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return 8 * 585 * 75 / depth_mm


def plane_residuals(depth: npt.NDArray[np.uint16]) -> npt.NDArray[np.float64]:
    """Disparity steps about a quadratic fit, of the 32 x 32 blocks that one describes."""
    v, u = np.mgrid[0:32, 0:32].reshape(2, -1) / 32.0
    terms = np.stack((np.ones(1024), u, v, u * u, u * v, v * v), axis=1)
    hat = terms @ np.linalg.pinv(terms)
    blocks = [depth[y : y + 32, x : x + 32].ravel() for y in range(0, 448, 32) for x in range(0, 600, 32)]
    steps = in_steps(np.array([block for block in blocks if (block > 0).all()], float))
    rest = steps - steps @ hat.T
    return rest[np.abs(rest).max(axis=1) < 2.2].reshape(-1, 32, 32)
