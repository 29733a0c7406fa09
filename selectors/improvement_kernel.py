"""The improvement map of a lattice of seeds, band by band: windows kriged, then blended."""

from __future__ import annotations

import numpy as np
from numba import njit

from selective_depth.selectors.kriging import krige_window
from selective_depth.selectors.semivariogram import fit_samples


@njit(cache=True, nogil=True)
def gather_samples(depth, rows, columns, i, j, u, v, z):  # type: ignore[no-untyped-def]
    """Collect the seeds of the window about lattice point (i, j), the centre first.

    Parameters
    ----------
    depth : float32 array of shape (R, C)
        Depth of the seeds, 0 = missing.
    rows, columns : int64 arrays
        Where the lattice rows and columns are in the frame.
    i, j : int
        The window's lattice point.
    u, v, z : arrays
        Filled with columns, rows and depths of the seeds that returned depth.

    Returns
    -------
    int
        How many there are, at most nine.
    """
    count = 0
    if depth[i, j] > 0:
        u[0], v[0], z[0] = columns[j], rows[i], depth[i, j]
        count = 1
    for ni in range(max(i - 1, 0), min(i + 2, len(rows))):
        for nj in range(max(j - 1, 0), min(j + 2, len(columns))):
            if depth[ni, nj] > 0 and not (ni == i and nj == j):
                u[count], v[count], z[count] = columns[nj], rows[ni], depth[ni, nj]
                count += 1
    return count


@njit(cache=True, nogil=True)
def krige_row(  # type: ignore[no-untyped-def]
    i,
    depth,
    rows,
    up,
    down,
    columns,
    left,
    right,
    power,
    frame_shape,
    samples,
    scratch,
    strip,
    held,
):
    """Krige all windows of one lattice row.

    Parameters
    ----------
    strip : float32 array of shape (3, rows of a window, columns of a window, C)
        Filled with estimate, variance and improvement of each window's pixels.
    held : float32 array of shape (C,)
        Filled with the number of samples that each window holds, 0 if it has no system.
    """
    u, v, z = samples
    height, width = frame_shape
    for j in range(len(columns)):
        held[j] = 0
        count = gather_samples(depth, rows, columns, i, j, u, v, z)
        window_height = up[i] + down[i] - 1
        window_width = left[j] + right[j] - 1
        # One sample alone says nothing of how depth varies around it.
        if count < 2:
            strip[:, :window_height, :window_width, j] = 0
            continue
        held[j] = count
        a, b = fit_samples(u, v, z, count, power)
        u0, v0 = columns[j] - left[j] + 1, rows[i] - up[i] + 1
        krige_window(
            u, v, z, count, 0, a, b, power, u0, v0, window_width, window_height, height, width,
            scratch,
        )  # fmt: skip
        for row in range(window_height):
            for column in range(window_width):
                p = (row + 1) * (window_width + 2) + column + 1
                strip[0, row, column, j] = scratch[0][p]
                strip[1, row, column, j] = scratch[1][p]
                strip[2, row, column, j] = scratch[2][p]


@njit(cache=True, nogil=True)
def near_sample(depth, rows, columns, i, j, y, x, reach_squared):  # type: ignore[no-untyped-def]
    """Whether any of the 4x4 seeds around cell (i, j) returned depth near pixel (y, x)."""
    for ni in range(max(i - 1, 0), min(i + 3, len(rows))):
        dy = rows[ni] - y
        for nj in range(max(j - 1, 0), min(j + 3, len(columns))):
            dx = columns[nj] - x
            if depth[ni, nj] > 0 and dx * dx + dy * dy <= reach_squared:
                return True
    return False


@njit(cache=True, nogil=True)
def blend_row(  # type: ignore[no-untyped-def]
    y, i, depth, rows, columns, x_first, x_second, x_first_at, x_second_at, x_first_weight,
    x_second_weight, reach_squared, mixed, held, out,
):  # fmt: skip
    """Blend one pixel row across; `mixed` and `held` are its windows' values and weights."""
    estimate, variance, raw, known = out
    for x in range(len(x_first)):
        j, k = x_first[x], x_second[x]
        at_j, at_k = x_first_at[x], x_second_at[x]
        share_j, share_k = x_first_weight[x], x_second_weight[x]
        total = share_j * held[j] + share_k * held[k]
        near = total > 0 and near_sample(depth, rows, columns, i, j, y, x, reach_squared)
        known[y, x] = near
        if near:
            scale = np.float32(1.0) / total
            estimate[y, x] = scale * (share_j * mixed[0, at_j, j] + share_k * mixed[0, at_k, k])
            variance[y, x] = scale * (share_j * mixed[1, at_j, j] + share_k * mixed[1, at_k, k])
            raw[y, x] = scale * (share_j * mixed[2, at_j, j] + share_k * mixed[2, at_k, k])
        else:
            estimate[y, x] = np.nan
            variance[y, x] = np.nan
            raw[y, x] = 0


@njit(cache=True, nogil=True)
def improvement_rows(  # type: ignore[no-untyped-def]
    first_row, end_row, depth, rows, up, down, columns, left, right, row_blend, column_blend,
    power, reach_squared, samples, scratch, strips, held, mixed, mixed_held, out,
):  # fmt: skip
    """Map the pixel rows `first_row` to `end_row` - 1 of a frame."""
    y_first, y_second, y_first_at, y_second_at, y_first_weight, y_second_weight = row_blend
    x_first, x_second, x_first_at, x_second_at, x_first_weight, x_second_weight = column_blend
    frame_shape = (len(y_first), len(x_first))
    ready = -1
    for y in range(first_row, end_row):
        i, k = y_first[y], y_second[y]
        # Lattice row n is kept in slot n % 2 as long as it is needed.
        for n in range(max(ready + 1, i), k + 1):
            krige_row(
                n, depth, rows, up, down, columns, left, right, power, frame_shape, samples,
                scratch, strips[n % 2], held[n % 2],
            )  # fmt: skip
            ready = n
        share_i, share_k = y_first_weight[y], y_second_weight[y]
        mixed_held[:] = share_i * held[i % 2] + share_k * held[k % 2]
        for q in range(3):
            mixed[q] = share_i * held[i % 2] * strips[i % 2, q, y_first_at[y]]
            if share_k > 0:
                mixed[q] += share_k * held[k % 2] * strips[k % 2, q, y_second_at[y]]
        blend_row(
            y, i, depth, rows, columns, x_first, x_second, x_first_at, x_second_at,
            x_first_weight, x_second_weight, reach_squared, mixed, mixed_held, out,
        )  # fmt: skip
