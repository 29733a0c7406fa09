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
below half the least depth around (an overshoot beside a very deep discontinuity) is raised to that, so
that eq. (11) never divides by nothing.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Floats

MAX_SAMPLES = 32
"""Most samples in one window; of more, the nearest to its centre count."""


BLOCK = 4
"""Rows of U that one pass over the pixels takes in."""

MAX_PIXELS = 16384
"""Most pixels in one window, rim included."""

# The rows of U stand this far apart in one array: constant, so that the compiler can see that
# the rows a loop writes are not those it reads; and one cache line off a power of two.
STRIDE = MAX_PIXELS + 304


VECTOR = 16
"""Loops over pixels run to a multiple of this: vector instructions leave no rest to do singly."""


def padded_pixels(width: int, height: int) -> int:
    """Room for a window's pixels, their rim, and what loops run over behind them."""
    room = (width + 2) * (height + 3) + 2 * VECTOR
    return -(-room // VECTOR) * VECTOR


def aligned_empty(*shape: int) -> Floats:
    """Memory that begins on a cache line: vectors that lie across two are slower to load."""
    count = math.prod(shape)
    room = np.empty(count + VECTOR, np.float32)
    start = -room.ctypes.data % 64 // room.itemsize
    return room[start : start + count].reshape(shape)


def aligned_zeros(*shape: int) -> Floats:
    """`aligned_empty`, filled with zeros."""
    zeros = aligned_empty(*shape)
    zeros[...] = 0
    return zeros


def window_scratch(pixels: int) -> tuple[npt.NDArray[Any], ...]:
    """Working memory of `krige_window` for windows of up to so many `padded_pixels`.

    One per thread. The first three arrays hold the results.
    """
    return (
        # Estimate, variance, improvement; 1 / estimate, 0 where it does not count; the covariances
        # with the pixel to the right and the one below.
        *aligned_zeros(6, pixels),
        aligned_empty(MAX_SAMPLES * STRIDE),  # U
        np.zeros((MAX_SAMPLES, MAX_SAMPLES), np.float64),  # L, its diagonal inverted
        np.zeros(MAX_SAMPLES, np.float64),  # L^-1 (Z - z_ref)
    )


class Box(NamedTuple):
    """The pixels of a window: its first column and row, and its size."""

    u0: int
    v0: int
    width: int
    height: int


def sample_buffers() -> tuple[npt.NDArray[Any], ...]:
    """Columns, rows and depths of a window's samples, and their rows in a table of distances."""
    whole = np.zeros(MAX_SAMPLES, np.int64)
    return whole, whole.copy(), np.zeros(MAX_SAMPLES, np.float32), whole.copy()


@njit(cache=True, inner=True, forceinline=True, nogil=True, fastmath={"contract"})
def _factor(z, row_of, count, a, b, between, L, y):  # type: ignore[no-untyped-def]
    """Cholesky factor of the differences to sample 0, and the depths' differences solved by it.

    A pivot of nothing (no variation at all) drops its row: that sample adds no knowledge.
    """
    to_reference = between[row_of[0]]
    for i in range(count - 1):
        row = between[row_of[i + 1]]
        to_i = row[row_of[0]]
        residual = np.float64(z[i + 1]) - np.float64(z[0])
        for k in range(i):
            other = row_of[k + 1]
            entry = a * (to_i + to_reference[other] - row[other]) + b
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


@njit(cache=True, inner=True, forceinline=True, nogil=True, fastmath={"contract"})
def _subtract_block(block, earlier, rows, k, pixels):  # type: ignore[no-untyped-def]
    """Take the part of an earlier block of U out of a later one: U -= L U_earlier."""
    f00, f01, f02, f03 = rows[0, k], rows[0, k + 1], rows[0, k + 2], rows[0, k + 3]
    f10, f11, f12, f13 = rows[1, k], rows[1, k + 1], rows[1, k + 2], rows[1, k + 3]
    f20, f21, f22, f23 = rows[2, k], rows[2, k + 1], rows[2, k + 2], rows[2, k + 3]
    f30, f31, f32, f33 = rows[3, k], rows[3, k + 1], rows[3, k + 2], rows[3, k + 3]
    g00, g01, g02, g03 = np.float32(f00), np.float32(f01), np.float32(f02), np.float32(f03)
    g10, g11, g12, g13 = np.float32(f10), np.float32(f11), np.float32(f12), np.float32(f13)
    g20, g21, g22, g23 = np.float32(f20), np.float32(f21), np.float32(f22), np.float32(f23)
    g30, g31, g32, g33 = np.float32(f30), np.float32(f31), np.float32(f32), np.float32(f33)
    for p in range(pixels):
        e0, e1 = earlier[p], earlier[STRIDE + p]
        e2, e3 = earlier[2 * STRIDE + p], earlier[3 * STRIDE + p]
        block[p] -= g00 * e0 + g01 * e1 + g02 * e2 + g03 * e3
        block[STRIDE + p] -= g10 * e0 + g11 * e1 + g12 * e2 + g13 * e3
        block[2 * STRIDE + p] -= g20 * e0 + g21 * e1 + g22 * e2 + g23 * e3
        block[3 * STRIDE + p] -= g30 * e0 + g31 * e1 + g32 * e2 + g33 * e3


@njit(cache=True, inner=True, forceinline=True, nogil=True, fastmath={"contract"})
def _solve_block(block, corner, pixels):  # type: ignore[no-untyped-def]
    """Solve a block of U by its own corner of L, whose diagonal is inverted."""
    d0, d1, d2 = np.float32(corner[0, 0]), np.float32(corner[1, 1]), np.float32(corner[2, 2])
    d3, l10, l20 = np.float32(corner[3, 3]), np.float32(corner[1, 0]), np.float32(corner[2, 0])
    l21, l30 = np.float32(corner[2, 1]), np.float32(corner[3, 0])
    l31, l32 = np.float32(corner[3, 1]), np.float32(corner[3, 2])
    for p in range(pixels):
        r0 = d0 * block[p]
        r1 = d1 * (block[STRIDE + p] - l10 * r0)
        r2 = d2 * (block[2 * STRIDE + p] - l20 * r0 - l21 * r1)
        block[3 * STRIDE + p] = d3 * (block[3 * STRIDE + p] - l30 * r0 - l31 * r1 - l32 * r2)
        block[p] = r0
        block[STRIDE + p] = r1
        block[2 * STRIDE + p] = r2


@njit(cache=True, inner=True, forceinline=True, nogil=True, fastmath={"contract"})
def krige_window(  # type: ignore[no-untyped-def]
    samples, count, a, b, between, distances, first, box, frame_shape, scratch
):
    """Krige one window; results in the first three arrays of `scratch`.

    Parameters
    ----------
    samples : tuple
        Columns, rows and depths (mm) of the samples and their rows in the tables; the first
        `count` hold. Sample 0 is the reference and best stands near the middle.
    a, b : float
        The local semivariogram.
    between : float64 array of shape (rows, rows)
        Distance^w between samples.
    distances : float32 array of shape (rows, pixels)
        Distance^w to the window's pixels, from column `first` on, `padded_pixels` of them.
    box : Box
        The window's pixels; results and distances are laid out with a rim of one pixel on
        every side, row by row, `box.width` + 2 to a row.
    frame_shape : tuple of int
        Pixels outside the frame are not neighbours.
    scratch : tuple
        `window_scratch`.
    """
    u, v, z, row_of = samples
    estimate, variance, improvement, _, right, below, U, L, y = scratch
    stride = box.width + 2
    pixels = (stride * (box.height + 2) + VECTOR - 1) // VECTOR * VECTOR
    scale, nugget = np.float32(a), np.float32(b)
    _factor(z, row_of, count, a, b, between, L, y)

    m = count - 1
    blocks = (m + BLOCK - 1) // BLOCK
    L[m : blocks * BLOCK] = 0
    y[m : blocks * BLOCK] = 0
    ref = distances[row_of[0], first : first + pixels + stride]
    for p in range(pixels):
        toward = scale * ref[p] + nugget
        estimate[p] = z[0]
        variance[p] = toward + toward
    step = scale - nugget  # a * 1^w, less the nugget that two pixels do not share
    for p in range(pixels):
        right[p] = scale * (ref[p] + ref[p + 1]) - step
    for p in range(pixels):
        below[p] = scale * (ref[p] + ref[p + stride]) - step

    for k in range(0, blocks * BLOCK, BLOCK):
        block = U[k * STRIDE : (k + BLOCK) * STRIDE]
        # Rows that fill the last block up are the reference's own, and nothing.
        n0, n1 = row_of[k + 1], row_of[k + 2] if k + 1 < m else row_of[0]
        n2 = row_of[k + 3] if k + 2 < m else row_of[0]
        n3 = row_of[k + 4] if k + 3 < m else row_of[0]
        c0, c1 = (np.float32(a * between[row_of[0], n0] + b), np.float32(a * between[row_of[0], n1] + b))
        c2, c3 = (np.float32(a * between[row_of[0], n2] + b), np.float32(a * between[row_of[0], n3] + b))
        h0, h1 = distances[n0, first : first + pixels], distances[n1, first : first + pixels]
        h2, h3 = distances[n2, first : first + pixels], distances[n3, first : first + pixels]
        for p in range(pixels):
            block[p] = c0 + scale * (ref[p] - h0[p])
            block[STRIDE + p] = c1 + scale * (ref[p] - h1[p])
            block[2 * STRIDE + p] = c2 + scale * (ref[p] - h2[p])
            block[3 * STRIDE + p] = c3 + scale * (ref[p] - h3[p])
        for e in range(0, k, BLOCK):
            earlier = U[e * STRIDE : (e + BLOCK) * STRIDE]
            _subtract_block(block, earlier, L[k : k + BLOCK], e, pixels)
        _solve_block(block, L[k : k + BLOCK, k : k + BLOCK], pixels)
        f0, f1, f2, f3 = (np.float32(y[k]), np.float32(y[k + 1]), np.float32(y[k + 2]), np.float32(y[k + 3]))
        for p in range(pixels):
            r0, r1 = block[p], block[STRIDE + p]
            r2, r3 = block[2 * STRIDE + p], block[3 * STRIDE + p]
            estimate[p] += f0 * r0 + f1 * r1 + f2 * r2 + f3 * r3
            variance[p] -= r0 * r0 + r1 * r1 + r2 * r2 + r3 * r3
        for p in range(pixels):
            c = block[p] * block[p + 1] + block[STRIDE + p] * block[STRIDE + p + 1]
            c += block[2 * STRIDE + p] * block[2 * STRIDE + p + 1]
            right[p] -= c + block[3 * STRIDE + p] * block[3 * STRIDE + p + 1]
        under = block[stride:]
        for p in range(pixels):
            c = block[p] * under[p] + block[STRIDE + p] * under[STRIDE + p]
            c += block[2 * STRIDE + p] * under[2 * STRIDE + p]
            below[p] -= c + block[3 * STRIDE + p] * under[3 * STRIDE + p]

    _settle(samples, count, box, frame_shape, scratch)
    _improve(box, scratch)
    for i in range(count):
        row, column = v[i] - box.v0 + 1, u[i] - box.u0 + 1
        if 0 <= row < box.height + 2 and 0 <= column < stride:
            p = row * stride + column
            estimate[p] = z[i]
            variance[p] = np.float32(0.0)
            improvement[p] = np.float32(0.0)


@njit(cache=True, inner=True, forceinline=True, nogil=True, fastmath={"contract"})
def _settle(samples, count, box, frame_shape, scratch):  # type: ignore[no-untyped-def]
    """Raise estimates and variances to what they may be at least, and invert the former.

    Pixels outside the frame and samples count nothing: their inverse is 0.
    """
    u, v, z, _ = samples
    u0, v0, width, height = box
    estimate, variance, inverse = scratch[0], scratch[1], scratch[3]
    stride = width + 2
    pixels = (stride * (height + 2) + VECTOR - 1) // VECTOR * VECTOR
    least = z[0]
    for i in range(1, count):
        least = min(least, z[i])
    floor = np.float32(0.5) * least
    for p in range(pixels):
        raised = max(estimate[p], floor)
        estimate[p] = raised
        inverse[p] = np.float32(1.0) / raised
        variance[p] = max(variance[p], np.float32(0.0))
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


@njit(cache=True, inner=True, forceinline=True, nogil=True, fastmath={"contract"})
def _improve(box, scratch):  # type: ignore[no-untyped-def]
    """Eq. (23) from inverted estimates, variances and the covariances of neighbours."""
    variance, improvement, inverse, right, below = scratch[1:6]
    stride = box.width + 2
    tiny = np.float32(1e-30)
    # Views that start where the loops do, and two loops of few arrays: the compiler has to
    # prove that none overlaps another.
    size = (stride * box.height + VECTOR - 1) // VECTOR * VECTOR
    here, kept = inverse[stride:], variance[stride:]
    result = improvement[stride:]
    left_of, right_of = inverse[stride - 1 :], inverse[stride + 1 :]
    to_left, to_right = right[stride - 1 :], right[stride:]
    to_above, to_below = below, below[stride:]
    above, under = inverse, inverse[2 * stride :]
    for p in range(size):
        around = to_left[p] * to_left[p] * left_of[p] + to_right[p] * to_right[p] * right_of[p]
        result[p] = kept[p] * here[p] + around / max(kept[p], tiny)
    for p in range(size):
        around = to_above[p] * to_above[p] * above[p] + to_below[p] * to_below[p] * under[p]
        result[p] += around / max(kept[p], tiny)
