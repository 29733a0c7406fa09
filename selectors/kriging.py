"""Ordinary kriging in one small window, and what measuring each of its pixels would improve.

The paper (section IV) solves ``K lambda = k`` (eq. 5-10). The same numbers come out of a
smaller, positive definite system: a pixel's residual after kriging depends on differences to
one reference sample only, and ``-gamma`` is a covariance for such differences. With the
Cholesky factor L of the samples' differences and ``U = L^-1 g`` for a pixel,

    estimate        z(s) = z_ref + U_s . L^-1 (Z - z_ref)                       (eq. 9)
    variance      var(s) = 2 gamma(s, ref) - U_s . U_s                          (eq. 10)
    covariance  cov(s,j) = gamma(s,ref) + gamma(j,ref) - gamma(s,j) - U_s . U_j

and ``cov(s, j)`` is minus the bracket of eq. (21)-(23): the covariance that s and j are left
with once the samples are known. So eq. (23) reads

    imp(s) = 1 / var(s) * sum_j cov(s, j)^2 / z(j),

zero at every sample and for every j that is one, free of inverses, and good in 32 bits.

The neighbourhood m of a pixel is itself and its four neighbours inside the image. An estimate
below half the least depth around (an overshoot beside a very deep step) is raised to that, so
that eq. (11) never divides by nothing.

Erratum: eq. (27), the paper's expansion of eq. (23) for w = 2, ends in
``+ 2b / var(s) - b^2 / (var(s) z(s))``. The first term is a misprint for ``2b / z(s)``: it
undoes ``gamma(s, s) = b`` in the sums before it, whose term j = s is (var(s) - b)^2 / z(s)
over var(s) instead of var(s)^2. The tests compare both with eq. (13). Nothing here uses
eq. (27): summing over five pixels costs less than its moments.
"""

from __future__ import annotations

import numpy as np
from numba import njit

MAX_SAMPLES = 32
"""Most samples in one window; of more, the nearest to its centre count."""


def window_scratch(pixels: int):  # type: ignore[no-untyped-def]
    """Working memory of `krige_window` for windows of up to `pixels` pixels, rim included.

    One per thread. The first three arrays hold the results.
    """
    return (
        np.zeros(pixels, np.float32),  # estimate
        np.zeros(pixels, np.float32),  # variance
        np.zeros(pixels, np.float32),  # improvement
        np.zeros(pixels, np.float32),  # 1 / estimate, 0 where it does not count
        np.zeros(pixels, np.float32),  # a * h^w to the reference sample
        np.zeros(pixels, np.float32),  # covariance with the pixel to the right, squared
        np.zeros(pixels, np.float32),  # covariance with the pixel below, squared
        np.zeros((MAX_SAMPLES, pixels), np.float32),  # U
        np.zeros((MAX_SAMPLES, MAX_SAMPLES), np.float64),  # L
        np.zeros(MAX_SAMPLES, np.float64),  # L^-1 (Z - z_ref)
        np.zeros(MAX_SAMPLES, np.int64),  # the samples but for the reference
    )


@njit(cache=True, nogil=True, fastmath={"contract"})
def krige_window(  # type: ignore[no-untyped-def] # pragma: no cover - compiled
    u,
    v,
    z,
    count,
    reference,
    a,
    b,
    power,
    u0,
    v0,
    width,
    height,
    frame_height,
    frame_width,
    scratch,
):
    """Krige one window; results in the first three arrays of `scratch`.

    Parameters
    ----------
    u, v, z : arrays
        Columns, rows and depths (mm) of the samples; the first `count` hold.
    reference : int
        Which of them is the reference: one near the middle.
    a, b : float
        The local semivariogram.
    power : float64 array
        `power_table`, reaching from any sample to any pixel of the window.
    u0, v0, width, height : int
        The window's pixels; results are laid out with a rim of one pixel on every side, row
        by row, `width` + 2 to a row.
    frame_height, frame_width : int
        Pixels outside the frame are no neighbours.
    scratch : tuple
        `window_scratch`.
    """
    estimate, variance, improvement, inverse, gamma, right, below, U, L, y, others = scratch
    reach = power.shape[0] // 2
    stride = width + 2
    pixels = stride * (height + 2)
    least = z[0]
    for i in range(1, count):
        least = min(least, z[i])
    floor = np.float32(0.5) * np.float32(least)

    m = 0
    for i in range(count):
        if i != reference:
            others[m] = i
            m += 1
    scale = np.float32(a)
    nugget = np.float32(b)
    for row in range(height + 2):
        line = power[reach + v0 - 1 + row - v[reference]]
        first = reach + u0 - 1 - u[reference]
        for column in range(stride):
            gamma[row * stride + column] = scale * np.float32(line[first + column])

    # L of the differences to the reference. A pivot of nothing (no variation at all) drops
    # its row: that sample then adds no knowledge.
    for i in range(m):
        si = others[i]
        to_i = power[reach + v[si] - v[reference], reach + u[si] - u[reference]]
        residual = np.float64(z[si]) - np.float64(z[reference])
        for k in range(i + 1):
            sk = others[k]
            to_k = power[reach + v[sk] - v[reference], reach + u[sk] - u[reference]]
            between = power[reach + v[si] - v[sk], reach + u[si] - u[sk]]
            entry = a * (to_i + to_k - between) + (2.0 * b if i == k else b)
            whole = entry
            for q in range(k):
                entry -= L[i, q] * L[k, q]
            if k < i:
                L[i, k] = entry * L[k, k]
            else:
                L[i, i] = 1.0 / np.sqrt(entry) if entry > 1e-9 * whole else 0.0
        for k in range(i):
            residual -= L[i, k] * y[k]
        y[i] = residual * L[i, i]

        constant = np.float32(a * to_i + b)
        for row in range(height + 2):
            line = power[reach + v0 - 1 + row - v[si]]
            first = reach + u0 - 1 - u[si]
            for column in range(stride):
                p = row * stride + column
                U[i, p] = constant + gamma[p] - scale * np.float32(line[first + column])
        for k in range(i):
            factor = np.float32(L[i, k])
            for p in range(pixels):
                U[i, p] -= factor * U[k, p]
        factor = np.float32(L[i, i])
        for p in range(pixels):
            U[i, p] *= factor

    start = np.float32(z[reference])
    for p in range(pixels):
        estimate[p] = start
        variance[p] = np.float32(2.0) * (gamma[p] + nugget)
    step = np.float32(a) + -nugget  # a * 1^w, less the nugget that two pixels do not share
    for p in range(pixels - stride):
        right[p] = gamma[p] + gamma[p + 1] - step
        below[p] = gamma[p] + gamma[p + stride] - step
    for i in range(m):
        weight = np.float32(y[i])
        for p in range(pixels):
            estimate[p] += weight * U[i, p]
        for p in range(pixels):
            variance[p] -= U[i, p] * U[i, p]
        for p in range(pixels - stride):
            right[p] -= U[i, p] * U[i, p + 1]
        for p in range(pixels - stride):
            below[p] -= U[i, p] * U[i, p + stride]

    for p in range(pixels):
        estimate[p] = max(estimate[p], floor)
        inverse[p] = np.float32(1.0) / estimate[p]
    for row in range(height + 2):
        inside = 0 <= v0 - 1 + row < frame_height
        for column in range(stride):
            if not (inside and 0 <= u0 - 1 + column < frame_width):
                inverse[row * stride + column] = np.float32(0.0)
    for i in range(count):
        row = v[i] - v0 + 1
        column = u[i] - u0 + 1
        if 0 <= row < height + 2 and 0 <= column < stride:
            inverse[row * stride + column] = np.float32(0.0)

    for p in range(pixels - stride):
        right[p] *= right[p]
        below[p] *= below[p]
    tiny = np.float32(1e-30)
    for p in range(stride, pixels - stride):
        around = right[p] * inverse[p + 1] + right[p - 1] * inverse[p - 1]
        around += below[p] * inverse[p + stride] + below[p - stride] * inverse[p - stride]
        kept = max(variance[p], tiny)
        variance[p] = kept
        improvement[p] = kept * inverse[p] + around / kept
    for i in range(count):
        row = v[i] - v0 + 1
        column = u[i] - u0 + 1
        if 0 <= row < height + 2 and 0 <= column < stride:
            p = row * stride + column
            estimate[p] = z[i]
            variance[p] = np.float32(0.0)
            improvement[p] = np.float32(0.0)
