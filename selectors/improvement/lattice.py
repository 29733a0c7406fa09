"""Kriging of windows without holes, many at a time: see `lattice_tables` for the algebra.

Windows of one geometry differ in their depths alone, so every operation is done for `LANES`
windows side by side; each inner loop runs over lanes and becomes vector instructions.
"""

from __future__ import annotations

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Floats
from selective_depth.selectors.improvement.lattice_tables import CONTRASTS, SEEDS
from selective_depth.selectors.improvement.systems import aligned_zeros

LANES = 64
"""Windows that are kriged side by side."""

# Rows of the first scratch array, LANES wide. Constant places in one array: only so can the
# compiler see that what is written is not what is read, and make vector instructions.
_DEPTH = 0  # depth of the nine seeds, less that of the centre
_Y = _DEPTH + SEEDS * LANES  # y, later times a / (a mu + b)
_E = _Y + CONTRASTS * LANES  # a^2 / (a mu + b)
_MEAN = _E + CONTRASTS * LANES
_CENTRE = _MEAN + LANES
_A = _CENTRE + LANES
_B = _A + LANES
_FLOOR = _B + LANES
_AROUND = _FLOOR + LANES  # what a pixel's neighbours add to its improvement
_ROWS_END = _AROUND + LANES


def lattice_scratch(most_pixels: int) -> tuple[Floats, ...]:
    """Working memory of `krige_lanes` for windows of up to `most_pixels`; one per thread."""
    return (
        aligned_zeros(_ROWS_END),
        aligned_zeros(most_pixels, LANES),  # 1 / estimate of each pixel
        aligned_zeros(3 * most_pixels, LANES),  # covariance of each pair
    )


@njit(cache=True, inner=True, forceinline=True, nogil=True, fastmath={"contract"})
def krige_lanes(padded, i, order, batch, geometry, sides, tables, scratch, strip):  # type: ignore[no-untyped-def]
    """Krige the windows of lattice row `i` in batch number `batch`.

    Lanes whose window has a hole come out finite, but of no meaning.

    Parameters
    ----------
    padded : float32 array of shape (R + 2, C + 2)
        Depth of the seeds, 0 = missing, with a rim of zeros.
    i : int
        Lattice row.
    order : int64 array of shape (batches, LANES)
        Lattice column in each lane.
    geometry : int
        The windows' number in the tables.
    sides : tuple of int
        How far they reach up, down, left and right.
    tables : LatticeTables
        Of all geometries.
    scratch : tuple
        `lattice_scratch`.
    strip : float32 array of shape (3, rows, columns, places or more)
        Filled with estimate, variance and improvement, this batch from place batch * LANES on.
    """
    vectors, is_seed, products, bases = tables.vectors, tables.is_seed, tables.products, tables.bases
    s, inverse, covariance = scratch
    _fit_lanes(padded, i, order, batch, tables, geometry, s)

    up, down, left, right = sides
    height, width = up + down - 1, left + right - 1
    stride = width + 2
    first, end = batch * LANES, (batch + 1) * LANES
    pixel = tables.first_pixel[geometry]
    for p in range((height + 2) * stride):
        if is_seed[pixel + p]:
            for n in range(LANES):
                inverse[p, n] = np.float32(0.0)
            continue
        g = vectors[pixel + p]
        g0, g1, g2, g3, g4, g5, g6, g7 = g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7]
        for n in range(LANES):
            z = s[_MEAN + n] - s[_Y + n] * g0 - s[_Y + LANES + n] * g1
            z -= s[_Y + 2 * LANES + n] * g2 + s[_Y + 3 * LANES + n] * g3
            z -= s[_Y + 4 * LANES + n] * g4 + s[_Y + 5 * LANES + n] * g5
            z -= s[_Y + 6 * LANES + n] * g6 + s[_Y + 7 * LANES + n] * g7
            inverse[p, n] = np.float32(1.0) / max(z, s[_FLOOR + n])

    inside = height * width
    across, down_from = inside, inside + height * (width + 1)
    pairs = down_from + (height + 1) * width
    pair = tables.first_pair[geometry]
    for k in range(pairs):
        g = products[pair + k]
        base = bases[pair + k]
        g0, g1, g2, g3, g4, g5, g6, g7 = g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7]
        share = np.float32(10.0 / 9.0) if k < inside else np.float32(1.0 / 9.0)
        for n in range(LANES):
            c = base * s[_A + n] + share * s[_B + n]
            c -= s[_E + n] * g0 + s[_E + LANES + n] * g1
            c -= s[_E + 2 * LANES + n] * g2 + s[_E + 3 * LANES + n] * g3
            c -= s[_E + 4 * LANES + n] * g4 + s[_E + 5 * LANES + n] * g5
            c -= s[_E + 6 * LANES + n] * g6 + s[_E + 7 * LANES + n] * g7
            covariance[k, n] = c

    tiny = np.float32(1e-30)
    for row in range(height):
        for column in range(width):
            p = (row + 1) * stride + column + 1
            z_out = strip[0, row, column, first:end]
            variance_out = strip[1, row, column, first:end]
            improvement_out = strip[2, row, column, first:end]
            if is_seed[pixel + p]:
                for n in range(LANES):
                    z_out[n] = s[_CENTRE + n]
                    variance_out[n] = np.float32(0.0)
                    improvement_out[n] = np.float32(0.0)
                continue
            itself = row * width + column
            beside = across + row * (width + 1) + column
            over = down_from + row * width + column
            # Three short loops: with more arrays in one, the compiler gives up proving that
            # they do not overlap.
            for n in range(LANES):
                z_out[n] = np.float32(1.0) / inverse[p, n]
            for n in range(LANES):
                variance_out[n] = max(covariance[itself, n], np.float32(0.0))
            for n in range(LANES):
                to_left, to_right = covariance[beside, n], covariance[beside + 1, n]
                around = to_left * to_left * inverse[p - 1, n]
                s[_AROUND + n] = around + to_right * to_right * inverse[p + 1, n]
            for n in range(LANES):
                to_above, to_below = covariance[over, n], covariance[over + width, n]
                around = to_above * to_above * inverse[p - stride, n]
                around += to_below * to_below * inverse[p + stride, n]
                around += s[_AROUND + n]
                kept = max(covariance[itself, n], np.float32(0.0))
                improvement_out[n] = kept * inverse[p, n] + around / max(kept, tiny)


@njit(cache=True, inner=True, forceinline=True, nogil=True, fastmath={"contract"})
def _fit_lanes(padded, i, order, batch, tables, geometry, s):  # type: ignore[no-untyped-def]
    """Gather the depths, fit (a, b) and weigh the contrasts of each lane."""
    basis, eigenvalues = tables.basis[geometry], tables.eigenvalues[geometry]
    distance_sums, moments = tables.distance_sums[geometry], tables.moments[geometry]
    for n in range(LANES):
        j = order[batch, n]
        centre = padded[i + 1, j + 1]
        s[_CENTRE + n] = centre
        least = centre
        for k in range(SEEDS):
            z = padded[i + k // 3, j + k % 3]
            least = min(least, z)
            s[_DEPTH + k * LANES + n] = z - centre
        s[_FLOOR + n] = np.float32(0.5) * least
        if least == 0:  # nothing varies in a window with a hole, and nothing overflows
            s[_CENTRE + n] = s[_FLOOR + n] = np.float32(1.0)
            for k in range(SEEDS):
                s[_DEPTH + k * LANES + n] = np.float32(0.0)
    for n in range(LANES):
        s[_MEAN + n] = np.float32(0.0)
    for k in range(SEEDS):
        for n in range(LANES):
            s[_MEAN + n] += s[_DEPTH + k * LANES + n]
    for n in range(LANES):
        s[_MEAN + n] *= np.float32(1.0 / SEEDS)
    # _A and _B hold the moments t0 and t1 of `variogram.fit_moments` for a while, doubled.
    for n in range(LANES):
        s[_A + n] = np.float32(0.0)
        s[_B + n] = np.float32(0.0)
    for k in range(CONTRASTS):
        v = basis[k]
        v0, v1, v2, v3, v4 = v[0], v[1], v[2], v[3], v[4]
        v5, v6, v7, v8 = v[5], v[6], v[7], v[8]
        for n in range(LANES):
            y = s[_DEPTH + n] * v0 + s[_DEPTH + LANES + n] * v1
            y += s[_DEPTH + 2 * LANES + n] * v2 + s[_DEPTH + 3 * LANES + n] * v3
            y += s[_DEPTH + 4 * LANES + n] * v4 + s[_DEPTH + 5 * LANES + n] * v5
            y += s[_DEPTH + 6 * LANES + n] * v6 + s[_DEPTH + 7 * LANES + n] * v7
            s[_Y + k * LANES + n] = y + s[_DEPTH + 8 * LANES + n] * v8
        mu = eigenvalues[k]
        for n in range(LANES):
            square = s[_Y + k * LANES + n] * s[_Y + k * LANES + n]
            s[_A + n] += np.float32(SEEDS) * square
            s[_B + n] += mu * square
    for k in range(SEEDS):
        weight = distance_sums[k]
        for n in range(LANES):
            x = s[_DEPTH + k * LANES + n] - s[_MEAN + n]
            s[_B + n] += weight * x * x
    s0 = np.float32(SEEDS * (SEEDS - 1) // 2)
    s1, s2 = moments[0], moments[1]
    scale = np.float32(0.5) / (s0 * s2 - s1 * s1)
    flat_a, flat_b = np.float32(0.5) / s2, np.float32(0.5) / s0
    for n in range(LANES):
        t0, t1 = s[_A + n], s[_B + n]
        a = (s0 * t1 - s1 * t0) * scale
        b = (s2 * t0 - s1 * t1) * scale
        s[_A + n] = (t1 * flat_a if b < 0 else a) if a > 0 else np.float32(0.0)
        s[_B + n] = (b if b > 0 else np.float32(0.0)) if a > 0 else t0 * flat_b
    for n in range(LANES):
        s[_MEAN + n] += s[_CENTRE + n]
    tiny = np.float32(1e-30)
    for k in range(CONTRASTS):
        mu = eigenvalues[k]
        for n in range(LANES):
            weight = s[_A + n] / (s[_A + n] * mu + s[_B + n] + tiny)
            s[_E + k * LANES + n] = s[_A + n] * weight
            s[_Y + k * LANES + n] *= weight
