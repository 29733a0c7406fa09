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


BLOCK = 4
"""Rows of U that one pass over the pixels takes in."""


def window_scratch(pixels: int):  # type: ignore[no-untyped-def]
    """Working memory of `krige_window` for windows of up to `pixels` pixels, rim included.

    One per thread. The first three arrays hold the results.
    """
    return (
        np.zeros(pixels, np.float32),  # estimate
        np.zeros(pixels, np.float32),  # variance
        np.zeros(pixels, np.float32),  # improvement
        np.zeros(pixels, np.float32),  # 1 / estimate, 0 where it does not count
        np.zeros(pixels, np.float32),  # covariance with the pixel to the right
        np.zeros(pixels, np.float32),  # covariance with the pixel below
        np.zeros((MAX_SAMPLES + BLOCK, pixels), np.float32),  # U
        np.zeros((MAX_SAMPLES, MAX_SAMPLES), np.float64),  # L, its diagonal inverted
        np.zeros(MAX_SAMPLES + BLOCK, np.float64),  # L^-1 (Z - z_ref)
    )


def sample_buffers():  # type: ignore[no-untyped-def]
    """Columns, rows and depths of a window's samples, and their rows in a table of distances."""
    whole = np.zeros(MAX_SAMPLES, np.int64)
    return whole, whole.copy(), np.zeros(MAX_SAMPLES, np.float32), whole.copy()


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _factor(u, v, z, count, a, b, power, L, y):  # type: ignore[no-untyped-def]
    """Cholesky factor of the differences to sample 0, and the depths' differences solved by it.

    A pivot of nothing (no variation at all) drops its row: that sample adds no knowledge.
    """
    reach = power.shape[0] // 2
    for i in range(count - 1):
        ui, vi = u[i + 1], v[i + 1]
        to_i = power[reach + vi - v[0], reach + ui - u[0]]
        residual = np.float64(z[i + 1]) - np.float64(z[0])
        for k in range(i):
            uk, vk = u[k + 1], v[k + 1]
            to_k = power[reach + vk - v[0], reach + uk - u[0]]
            entry = a * (to_i + to_k - power[reach + vi - vk, reach + ui - uk]) + b
            for q in range(k):
                entry -= L[i, q] * L[k, q]
            entry *= L[k, k]
            L[i, k] = entry
            residual -= entry * y[k]
        whole = 2.0 * (a * to_i + b)
        pivot = whole
        for q in range(i):
            pivot -= L[i, q] * L[i, q]
        L[i, i] = 1.0 / np.sqrt(pivot) if pivot > 1e-9 * whole else 0.0
        y[i] = residual * L[i, i]


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def krige_window(  # type: ignore[no-untyped-def]
    samples, count, a, b, power, distances, first, u0, v0, width, height, frame_shape, scratch
):
    """Krige one window; results in the first three arrays of `scratch`.

    Parameters
    ----------
    samples : tuple
        Columns, rows and depths (mm) of the samples and their rows in `distances`; the first
        `count` hold. Sample 0 is the reference and best stands near the middle.
    a, b : float
        The local semivariogram.
    power : float64 array
        `power_table` that reaches from any sample to any other.
    distances : float32 array of shape (rows, pixels)
        Distance^w to the window's pixels, from column `first` on.
    u0, v0, width, height : int
        The window's pixels; results and distances are laid out with a rim of one pixel on
        every side, row by row, `width` + 2 to a row.
    frame_shape : tuple of int
        Pixels outside the frame are no neighbours.
    scratch : tuple
        `window_scratch`.
    """
    u, v, z, row_of = samples
    estimate, variance, improvement, inverse, right, below, U, L, y = scratch
    stride = width + 2
    pixels = stride * (height + 2)
    inner = pixels - stride
    scale, nugget = np.float32(a), np.float32(b)
    _factor(u, v, z, count, a, b, power, L, y)

    m = count - 1
    to_reference = distances[row_of[0], first : first + pixels]
    for i in range(m):
        row = U[i]
        to_sample = distances[row_of[i + 1], first : first + pixels]
        reach = power.shape[0] // 2
        constant = np.float32(a * power[reach + v[i + 1] - v[0], reach + u[i + 1] - u[0]] + b)
        for p in range(pixels):
            row[p] = constant + scale * (to_reference[p] - to_sample[p])
        k = 0
        while k + BLOCK <= i:
            f0, f1 = np.float32(L[i, k]), np.float32(L[i, k + 1])
            f2, f3 = np.float32(L[i, k + 2]), np.float32(L[i, k + 3])
            r0, r1, r2, r3 = U[k], U[k + 1], U[k + 2], U[k + 3]
            for p in range(pixels):
                row[p] -= f0 * r0[p] + f1 * r1[p] + f2 * r2[p] + f3 * r3[p]
            k += BLOCK
        while k < i:
            f0, r0 = np.float32(L[i, k]), U[k]
            for p in range(pixels):
                row[p] -= f0 * r0[p]
            k += 1
        f0 = np.float32(L[i, i])
        for p in range(pixels):
            row[p] *= f0
    blocks = (m + BLOCK - 1) // BLOCK
    for i in range(m, blocks * BLOCK):
        y[i] = 0.0
        U[i, :pixels] = 0

    start = z[0]
    step = scale - nugget  # a * 1^w, less the nugget that two pixels do not share
    for p in range(pixels):
        estimate[p] = start
    for p in range(pixels):
        variance[p] = np.float32(2.0) * (scale * to_reference[p] + nugget)
    for p in range(inner):
        right[p] = scale * (to_reference[p] + to_reference[p + 1]) + np.float32(2.0) * nugget
        right[p] -= scale + nugget
    for p in range(inner):
        below[p] = scale * (to_reference[p] + to_reference[p + stride]) - step
    for block in range(blocks):
        k = block * BLOCK
        f0, f1, f2, f3 = (
            np.float32(y[k]),
            np.float32(y[k + 1]),
            np.float32(y[k + 2]),
            np.float32(y[k + 3]),
        )
        r0, r1, r2, r3 = U[k], U[k + 1], U[k + 2], U[k + 3]
        for p in range(pixels):
            estimate[p] += f0 * r0[p] + f1 * r1[p] + f2 * r2[p] + f3 * r3[p]
        for p in range(pixels):
            variance[p] -= r0[p] * r0[p] + r1[p] * r1[p] + r2[p] * r2[p] + r3[p] * r3[p]
        for p in range(inner):
            c = r0[p] * r0[p + 1] + r1[p] * r1[p + 1]
            right[p] -= c + r2[p] * r2[p + 1] + r3[p] * r3[p + 1]
        for p in range(inner):
            q = p + stride
            below[p] -= r0[p] * r0[q] + r1[p] * r1[q] + r2[p] * r2[q] + r3[p] * r3[q]

    _improve(samples, count, u0, v0, width, height, frame_shape, scratch)


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _improve(samples, count, u0, v0, width, height, frame_shape, scratch):  # type: ignore[no-untyped-def]
    """Eq. (23) from estimates, variances and the covariances of neighbours."""
    u, v, z, _ = samples
    estimate, variance, improvement, inverse, right, below = scratch[:6]
    stride = width + 2
    pixels = stride * (height + 2)
    least = z[0]
    for i in range(1, count):
        least = min(least, z[i])
    floor = np.float32(0.5) * least
    for p in range(pixels):
        estimate[p] = max(estimate[p], floor)
    for p in range(pixels):
        inverse[p] = np.float32(1.0) / estimate[p]
    frame_height, frame_width = frame_shape
    if u0 < 1 or v0 < 1 or u0 + width >= frame_width or v0 + height >= frame_height:
        for row in range(height + 2):
            inside = 0 <= v0 - 1 + row < frame_height
            for column in range(stride):
                if not (inside and 0 <= u0 - 1 + column < frame_width):
                    inverse[row * stride + column] = np.float32(0.0)
    for i in range(count):
        row, column = v[i] - v0 + 1, u[i] - u0 + 1
        if 0 <= row < height + 2 and 0 <= column < stride:
            inverse[row * stride + column] = np.float32(0.0)

    # Views that start where the loops do, and two loops of few arrays: the compiler has to
    # prove that none overlaps another.
    size = pixels - 2 * stride
    here, kept = inverse[stride:], variance[stride:]
    result = improvement[stride:]
    left_of, right_of = inverse[stride - 1 :], inverse[stride + 1 :]
    to_left, to_right = right[stride - 1 :], right[stride:]
    to_above, to_below = below, below[stride:]
    above, under = inverse, inverse[2 * stride :]
    tiny = np.float32(1e-30)
    for p in range(size):
        kept[p] = max(kept[p], tiny)
    for p in range(size):
        around = to_left[p] * to_left[p] * left_of[p] + to_right[p] * to_right[p] * right_of[p]
        result[p] = kept[p] * here[p] + around / kept[p]
    for p in range(size):
        around = to_above[p] * to_above[p] * above[p] + to_below[p] * to_below[p] * under[p]
        result[p] += around / kept[p]
    for i in range(count):
        row, column = v[i] - v0 + 1, u[i] - u0 + 1
        if 0 <= row < height + 2 and 0 <= column < stride:
            p = row * stride + column
            estimate[p] = z[i]
            variance[p] = np.float32(0.0)
            improvement[p] = np.float32(0.0)
