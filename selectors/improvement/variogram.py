"""The local semivariogram `gamma(h) = a h^w + b [h > 0]` (eq. 24), fitted by least squares.

The empirical semivariance of a pair of samples at the distance h is half the square of their
difference in depth. `a` and `b` minimise the sum of squared residuals over *every* pair of the
samples of one kriging system, all pairs with the same weight, subject to a >= 0 and b >= 0:

- a slope below zero (nearer pairs differ more: noise) gives a = 0 and b the mean semivariance;
- an intercept below zero (smooth surfaces) gives b = 0 and a the slope through the origin;
- pairs of one single distance cannot tell a from b: a takes all, b = 0;
- constant depth gives a = b = 0: nothing varies, nothing can improve.

Equal weights are a choice; the paper gives none. Weights that favour short distances (h^-2,
h^-4) moved the best tenth of the map off the depth discontinuities, see `app/docs/improvement.md`.
"""

from __future__ import annotations

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Doubles


def power_table(exponent: float, reach: int) -> Doubles:
    """Distances between pixels, raised to the exponent of the semivariogram.

    Parameters
    ----------
    exponent : float
        The w of eq. (24), in (0, 2).
    reach : int
        Greatest difference of columns or rows that is looked up.

    Returns
    -------
    float64 array of shape (2 * reach + 1, 2 * reach + 1)
        ``table[reach + dv, reach + du] = (du^2 + dv^2)^(w / 2)``; pixels are integers, so
        this is exact and no power is taken while a map is made.
    """
    steps = np.arange(-reach, reach + 1, dtype=np.float64)
    squared: Doubles = steps[:, None] ** 2 + steps[None, :] ** 2
    return squared ** (exponent / 2)


@njit(cache=True, forceinline=True, nogil=True)
def fit_moments(s0: float, s1: float, s2: float, t0: float, t1: float) -> tuple[float, float]:
    """Fit (a, b) to the moments of the pairs.

    Parameters
    ----------
    s0, s1, s2 : float
        Sums over the pairs of 1, h^w and h^2w.
    t0, t1 : float
        Sums over the pairs of g and g h^w, where g is a pair's semivariance in mm^2.

    Returns
    -------
    a, b : float
        Slope (mm^2 per pixel^w) and nugget (mm^2), both >= 0.
    """
    if s2 <= 0.0 or t0 <= 0.0:
        return 0.0, 0.0
    determinant = s0 * s2 - s1 * s1
    # Pairs of one distance: the determinant is 0 but for rounding.
    if determinant <= 1e-9 * s0 * s2:
        return t1 / s2, 0.0
    a = (s0 * t1 - s1 * t0) / determinant
    b = (s2 * t0 - s1 * t1) / determinant
    if a < 0.0:
        return 0.0, t0 / s0
    if b < 0.0:
        return t1 / s2, 0.0
    return a, b


@njit(cache=True, forceinline=True, nogil=True)
def fit_samples(z, row_of, count, between):  # type: ignore[no-untyped-def]
    """Fit (a, b) to all pairs of the first `count` samples.

    Parameters
    ----------
    z : array
        Depths in mm.
    row_of : int64 array
        Row and column of each sample in `between`.
    between : float64 array of shape (n, n)
        Distance^w of each pair.
    """
    s0 = s1 = s2 = t0 = t1 = 0.0
    for i in range(1, count):
        row = between[row_of[i]]
        for j in range(i):
            h = row[row_of[j]]
            difference = np.float64(z[i]) - np.float64(z[j])
            half_square = 0.5 * difference * difference
            s0 += 1.0
            s1 += h
            s2 += h * h
            t0 += half_square
            t1 += half_square * h
    return fit_moments(s0, s1, s2, t0, t1)
