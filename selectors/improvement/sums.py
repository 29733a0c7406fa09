"""Eq. (27): the improvement from sums over each pixel's neighbourhood, the paper's way near w = 2.

Erratum: eq. (27), the paper's expansion of eq. (23) for w = 2, ends in
``+ 2b / var(s) - b^2 / (var(s) z(s))``. The first term is a misprint for ``2b / z(s)``: it
undoes ``gamma(s, s) = b`` in the sums before it, whose term j = s is (var(s) - b)^2 / z(s)
over var(s) instead of var(s)^2. The tests compare both with eq. (13).

With w = 2 the covariances of a pixel are linear in where j is, so that eq. (27) needs but sums
over the p_j. Counted from s, with ``d = s - sum_i lambda_i p_i``, the distance from s to where the
samples' places are estimated by the same weights,

    cov(s,j) = var(s) - b + 2 a d . (j - s)      for j != s,

exact as w -> 2 where b > 0. Without a nugget the variance vanishes as fast
as that formula's error, and eq. (23) is taken.
"""

from __future__ import annotations

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.improvement.systems import MAX_SAMPLES, STRIDE

MOMENTS_NUGGET = 3.0
"""Least b / a, in square pixels, for which eq. (27) is taken.

At w = 1.999 it is then within .1 % of eq. (13), whose terms of h^w - h^2 it leaves out."""


@njit(cache=True, inner=True, nogil=True)
def _whiten(values, count, L, out):  # type: ignore[no-untyped-def]
    """L^-1 of the differences of `count` values to the first one before them."""
    for i in range(count):
        residual = np.float64(values[i + 1] - values[0])
        for k in range(i):
            residual -= L[i, k] * out[k]
        out[i] = residual * L[i, i]


@njit(cache=True, inner=True, nogil=True)
def improve_by_sums(samples, count, a, b, box, scratch):  # type: ignore[no-untyped-def]
    """Take eq. (27), its misprint mended, for the improvement of a window that is kriged already.

    Where the nugget does not allow it, that of eq. (23) stays.

    Parameters
    ----------
    samples, count, a, b, box, scratch
        As `krige_window` was given.
    """
    if not b >= MOMENTS_NUGGET * a > 0:
        return
    u, v = samples[0], samples[1]
    variance, improvement, inverse, U, L = scratch[1], scratch[2], scratch[3], scratch[6], scratch[7]
    stride = box.width + 2
    pixels = stride * (box.height + 2)
    places = np.zeros((2, pixels), np.float32)  # columns and rows by the weights, from the reference on
    along = np.zeros((2, MAX_SAMPLES))
    _whiten(u, count - 1, L, along[0])
    _whiten(v, count - 1, L, along[1])
    for k in range(count - 1):
        row = U[k * STRIDE : k * STRIDE + pixels]
        along_u, along_v = np.float32(along[0, k]), np.float32(along[1, k])
        for p in range(pixels):
            places[0, p] += along_u * row[p]
            places[1, p] += along_v * row[p]
    scale, nugget = np.float32(a), np.float32(b)
    for row_in_box in range(1, box.height + 1):
        down = np.float32(box.v0 - 1 + row_in_box - v[0])
        for column in range(1, box.width + 1):
            p = row_in_box * stride + column
            if variance[p] <= 0:  # a sample
                continue
            d_u = np.float32(box.u0 - 1 + column - u[0]) - places[0, p]
            d_v = down - places[1, p]
            left, right = inverse[p - 1], inverse[p + 1]
            above, under = inverse[p - stride], inverse[p + stride]
            beyond = variance[p] - nugget
            total = left + right + above + under + inverse[p]  # sum of 1 / z(j)
            first_moments = d_u * (right - left) + d_v * (under - above)
            second_moments = d_u * d_u * (right + left) + d_v * d_v * (under + above)
            bracket = beyond * beyond * total + np.float32(4) * scale * (
                beyond * first_moments + scale * second_moments
            )
            own = (np.float32(2) * nugget * variance[p] - nugget * nugget) * inverse[p]
            improvement[p] = (bracket + own) / variance[p]
