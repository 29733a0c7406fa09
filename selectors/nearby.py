"""Points near to others in space or in the image, where no lattice tells them."""

from __future__ import annotations

import numpy as np

from selective_depth.selectors.arrays import Doubles, Longs


def nearest_points(points: np.ndarray, places: np.ndarray, count: int = 1) -> tuple[Doubles, Longs]:
    """The nearest of some points to each of some places.

    Parameters
    ----------
    points : array of shape (N, D)
    places : array of shape (n, D)
    count : int, default 1
        How many of each; no more than there are points.

    Returns
    -------
    distance : float64 array of shape (n, k)
        To the nearest first; k is `count` or N.
    index : int64 array of shape (n, k)
        Which points they are.
    """
    # Asked by few runs, and a third of a second to import.
    from scipy.spatial import cKDTree

    distance, index = cKDTree(points).query(places, k=[*range(1, min(count, len(points)) + 1)])
    return distance, index
