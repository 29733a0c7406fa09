"""The improvement map of a lattice of seeds, band by band: windows kriged, then blended."""

from __future__ import annotations

import math

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Bytes, Floats
from selective_depth.selectors.improvement.lattice import LANES, krige_lanes
from selective_depth.selectors.improvement.lattice_tables import SEEDS
from selective_depth.selectors.improvement.neighbourhoods import Windows
from selective_depth.selectors.improvement.systems import Box, krige_window
from selective_depth.selectors.improvement.variogram import fit_samples

LEVEL_SHIFT = np.uint32(17)
LEVELS = 1 << 14
BLOCK = 64
ONE = np.int32(1)


@njit(cache=True, inner=True, forceinline=True, nogil=True)
def gather_seeds(padded, rows, columns, i, j, samples):  # type: ignore[no-untyped-def]
    """Collect the seeds of the window about lattice point (i, j), the centre first.

    Parameters
    ----------
    padded : float32 array of shape (R + 2, C + 2)
        Depth of the seeds, 0 = missing, with a rim of zeros.
    rows, columns : int64 arrays
        Where the lattice rows and columns are in the frame.
    i, j : int
        The window's lattice point.
    samples : tuple
        `sample_buffers`, filled with the seeds that returned depth.

    Returns
    -------
    int
        How many there are, at most nine.
    """
    u, v, z, row_of = samples
    count = 0
    for n in range(SEEDS):
        k = (n + SEEDS // 2) % SEEDS  # the centre is number 4 of 9
        depth = padded[i + k // 3, j + k % 3]
        if depth > 0:
            u[count], v[count] = columns[j + k % 3 - 1], rows[i + k // 3 - 1]
            z[count], row_of[count] = depth, k
            count += 1
    return count


@njit(cache=True, nogil=True, inline="always")
def krige_row(i, padded, lattice, frame_shape, scratch, strip, held):  # type: ignore[no-untyped-def]
    """Krige all windows of one lattice row.

    Parameters
    ----------
    lattice : tuple
        `Windows.kernel_arguments`.
    scratch : tuple
        `sample_buffers`, `lattice_scratch` and `window_scratch`.
    strip : float32 array of shape (3, rows of a window, columns of a window, places or more)
        Filled with estimate, variance and improvement of each window's pixels.
    held : float32 array of shape (places,)
        Filled with the number of samples that each window holds, 0 if it has no system.
    """
    row_axis, column_axis, order, _, tables, _ = lattice
    samples, lattice_scratch, window_scratch = scratch
    estimate, variance, improvement = window_scratch[:3]
    rows, columns, lefts, rights = row_axis.centres, column_axis.centres, column_axis.before, column_axis.after
    lanes_columns, shape_of, place = order
    up, down = row_axis.before[i], row_axis.after[i]
    height = up + down - 1
    first_geometry = row_axis.shape_of[i] * len(column_axis.shapes)
    for j in range(len(columns)):
        count = 0
        for k in range(3):
            over, beside, under = (padded[i, j + k] > 0, padded[i + 1, j + k] > 0, padded[i + 2, j + k] > 0)
            count += over + beside + under
        # One sample alone says nothing of how depth varies around it.
        held[place[j]] = count if count > 1 else 0
    for batch in range(len(shape_of)):
        full = False
        for k in range(batch * LANES, (batch + 1) * LANES):
            full |= held[k] == SEEDS
        if full:
            j = lanes_columns[batch, 0]
            geometry = first_geometry + shape_of[batch]
            sides = up, down, lefts[j], rights[j]
            krige_lanes(padded, i, lanes_columns, batch, geometry, sides, tables, lattice_scratch, strip)
    for j in range(len(columns)):
        at = place[j]
        # What counts nothing need not be right: it is finite, by `krige_lanes` or from before.
        if held[at] == SEEDS or held[at] == 0:
            continue
        width = lefts[j] + rights[j] - 1
        gathered = gather_seeds(padded, rows, columns, i, j, samples)
        geometry = first_geometry + column_axis.shape_of[j]
        between, first = tables.between[geometry], tables.first_pixel[geometry]
        a, b = fit_samples(samples[2], samples[3], gathered, between)
        box = Box(columns[j] - lefts[j] + 1, rows[i] - up + 1, width, height)
        krige_window(samples, gathered, a, b, between, tables.distances, first, box, frame_shape, window_scratch)
        for row in range(height):
            for column in range(width):
                p = (row + 1) * (width + 2) + column + 1
                strip[0, row, column, at] = estimate[p]
                strip[1, row, column, at] = variance[p]
                strip[2, row, column, at] = improvement[p]


@njit(cache=True, inner=True, forceinline=True, nogil=True, fastmath={"contract"})
def blend_down(  # type: ignore[no-untyped-def]
    share_one, one, row_one, held_one, share_other, other, row_other, held_other, mixed, held
):
    """Blend the same pixel row of two lattice rows' windows, weighted; place by place.

    `held` has three rows: the weight in all, and that of either window.
    """
    total, weight_one, weight_other = held[0], held[1], held[2]
    for k in range(len(total)):
        weight_one[k] = share_one * held_one[k]
    for k in range(len(total)):
        weight_other[k] = share_other * held_other[k]
    for k in range(len(total)):
        total[k] = weight_one[k] + weight_other[k]
    for q in range(mixed.shape[0]):
        for column in range(mixed.shape[1]):
            into = mixed[q, column]
            here, there = one[q, row_one, column], other[q, row_other, column]
            for k in range(len(total)):
                into[k] = weight_one[k] * here[k] + weight_other[k] * there[k]


@njit(cache=True, inner=True, forceinline=True, nogil=True, fastmath={"contract"})
def blend_across(columns, places, mixed, held, estimate, variance, raw):  # type: ignore[no-untyped-def]
    """Blend one pixel row across from the windows left and right of each pixel."""
    first_weight, second_weight = columns.first_weight, columns.second_weight
    first_place, second_place, first_cell, second_cell = places
    flat_estimate, flat_variance, flat_raw = mixed[0].ravel(), mixed[1].ravel(), mixed[2].ravel()
    for x in range(len(estimate)):
        j, k = first_cell[x], second_cell[x]
        one, other = first_weight[x], second_weight[x]
        scale = np.float32(1.0) / (one * held[first_place[x]] + other * held[second_place[x]])
        one *= scale
        other *= scale
        estimate[x] = one * flat_estimate[j] + other * flat_estimate[k]
        variance[x] = one * flat_variance[j] + other * flat_variance[k]
        raw[x] = one * flat_raw[j] + other * flat_raw[k]


def doubtful_cells(padded: Floats, windows: Windows) -> Bytes:
    """Cells between lattice points that are not known as a whole: 1, or 2 where nothing is near.

    A seed that returned depth makes known what lies within reach of it; seeds two pitches
    away or farther are not asked. Shape (R + 1, C + 1), with the cells at the frame's edge.
    """
    measured = (padded > 0).view(np.uint8)
    pairs = measured[:-1] + measured[1:]
    corners = pairs[:, :-1] + pairs[:, 1:]
    beside = np.zeros((corners.shape[0] + 2, corners.shape[1] + 2), np.uint8)
    beside[1:-1, 1:-1] = corners
    beside = beside[:-2] | beside[1:-1] | beside[2:]
    near = (beside[:, :-2] | beside[:, 1:-1] | beside[:, 2:]) > 0
    # Every window that a pixel here lies in holds all corners; a system takes two samples.
    return np.where((corners >= 2) & windows.small, 0, np.where(near, 1, 2)).astype(np.uint8)


@njit(cache=True, inner=True, forceinline=True, nogil=True)
def mark_known(y, padded, doubtful, lattice, held, line):  # type: ignore[no-untyped-def]
    """Tell known pixels of row y from those too far from every seed, and clear the latter.

    `line` is the pixel row of the estimate, the variance, the improvement and what is known.
    """
    row_axis, column_axis, _, places, _, reach_squared = lattice
    rows, columns = row_axis.centres, column_axis.centres
    first_weight, second_weight = column_axis.first_weight, column_axis.second_weight
    first_place, second_place, _, _ = places
    estimate, variance, raw, known = line
    i = row_axis.first[y] if rows[0] <= y else -1
    for x in range(len(known)):
        known[x] = True
    for j in range(len(columns) + 1):
        doubt = doubtful[i + 1, j]
        if doubt == 0:
            continue
        start, stop = columns[j - 1] if j > 0 else 0, columns[j] if j < len(columns) else len(known)
        for x in range(start, stop):
            known[x] = False
        # Of the 4x4 seeds around the cell, each makes known what it reaches of this row.
        for ni in range(max(i - 1, 0), min(i + 3, len(rows)) if doubt == 1 else 0):
            left_over = reach_squared - (rows[ni] - y) * (rows[ni] - y)
            half = int(math.sqrt(max(left_over, 0.0)))
            for nj in range(max(j - 2, 0), min(j + 2, len(columns)) if left_over >= 0 else 0):
                if padded[ni + 1, nj + 1] > 0:
                    for x in range(max(columns[nj] - half, start), min(columns[nj] + half + 1, stop)):
                        total = first_weight[x] * held[first_place[x]] + second_weight[x] * held[second_place[x]]
                        known[x] = total > 0
        for x in range(start, stop):
            estimate[x] = estimate[x] if known[x] else np.float32(np.nan)
        for x in range(start, stop):
            variance[x] = variance[x] if known[x] else np.float32(np.nan)
        for x in range(start, stop):
            raw[x] = raw[x] if known[x] else np.float32(0)


@njit(cache=True, nogil=True, fastmath={"contract"})
def improvement_rows(  # type: ignore[no-untyped-def]
    first_row, end_row, padded, doubtful, half, lattice, scratch, histogram, maps, known
):
    """Map the pixel rows `first_row` to `end_row` - 1 of a frame.

    Parameters
    ----------
    padded : float32 array of shape (R + 2, C + 2)
        Depth of the seeds, 0 = missing, with a rim of zeros.
    doubtful : uint8 array of shape (R + 1, C + 1)
        `doubtful_cells`.
    half : float32
        The improvement that scores one half.
    lattice : tuple
        `Windows.kernel_arguments`.
    scratch : tuple
        Working memory of this band.
    histogram : int32 array of shape (2, LEVELS)
        Number of pixels by the upper bits of their improvement, in two parts.
    maps : float32 array of shape (4, H, W)
        Estimate, variance, improvement and score of the frame, filled in.
    known : bool array of shape (H, W)
        Likewise.
    """
    axis, columns, places = lattice[0], lattice[1], lattice[3]
    estimate, variance, raw, score = maps[0], maps[1], maps[2], maps[3]
    kriging, strips, helds, mixed, held = scratch
    frame_shape = known.shape
    ready = -1
    for y in range(first_row, end_row):
        i, k = axis.first[y], axis.second[y]
        # Lattice row n is kept in slot n % 2 as long as it is needed.
        for n in range(max(ready + 1, i), k + 1):
            krige_row(n, padded, lattice, frame_shape, kriging, strips[n % 2], helds[n % 2])
            ready = n
        blend_down(
            axis.first_weight[y], strips[i % 2], axis.first_at[y], helds[i % 2],
            axis.second_weight[y], strips[k % 2], axis.second_at[y], helds[k % 2], mixed, held,
        )  # fmt: skip
        blend_across(columns, places, mixed, held[0], estimate[y], variance[y], raw[y])
        mark_known(y, padded, doubtful, lattice, held[0], (estimate[y], variance[y], raw[y], known[y]))
        for x in range(frame_shape[1]):
            score[y, x] = raw[y, x] / (raw[y, x] + half)
        # Two counts in turn: neighbours are alike, and the same count twice is a wait.
        bits = raw[y].view(np.uint32)
        for x in range(0, frame_shape[1] - 1, 2):
            histogram[0, bits[x] >> LEVEL_SHIFT] += ONE
            histogram[1, bits[x + 1] >> LEVEL_SHIFT] += ONE
        if frame_shape[1] % 2:
            histogram[0, bits[frame_shape[1] - 1] >> LEVEL_SHIFT] += ONE


@njit(cache=True, nogil=True)
def best_threshold(raw, histogram, wanted):  # type: ignore[no-untyped-def]
    """Least improvement of the `wanted` best pixels, exactly.

    Pixels of equal worth are taken together or not at all, so that the choice does not depend
    on the order of pixels; pixels of no worth never are.

    Parameters
    ----------
    raw : float32 array of shape (n,)
        Improvements, >= 0.
    histogram : int array of shape (LEVELS,)
        How many share their upper bits: floats >= 0 are in the order of their bits.
    wanted : int
        How many pixels to take at most.

    Returns
    -------
    float32
        ``raw >= threshold`` selects them.
    """
    level = len(histogram) - 1
    above = 0
    while level > 0 and above + histogram[level] <= wanted:
        above += histogram[level]
        level -= 1
    edge = np.empty(1, np.int32)
    edge[0] = (level + 1) << LEVEL_SHIFT
    if level == 0 or above == wanted:
        return edge.view(np.float32)[0]
    # Within the level, bit by bit: to sort its members, as fast, takes seconds to compile.
    members = np.empty(histogram[level], np.uint32)
    count = 0
    bits = raw.view(np.uint32)
    level_bits = np.uint32(level)
    for start in range(0, len(bits), BLOCK):
        block = bits[start : start + BLOCK]
        # Most blocks hold none, and vector instructions find that out.
        inside = np.int32(0)
        for n in range(len(block)):
            inside += np.int32(block[n] >> LEVEL_SHIFT == level_bits)
        if inside == 0:
            continue
        for n in range(len(block)):
            if block[n] >> LEVEL_SHIFT == level_bits:
                members[count] = block[n]
                count += 1
    least = np.uint32(level << LEVEL_SHIFT)
    for bit in range(LEVEL_SHIFT - ONE, -1, -1):
        higher = least + (np.uint32(1) << np.uint32(bit))
        reached = np.int64(0)
        for n in range(count):
            reached += np.int64(members[n] >= higher)
        # More than is wanted: the threshold lies higher.
        if above + reached > wanted:
            least = higher
    edge[0] = least + ONE
    return edge.view(np.float32)[0]
