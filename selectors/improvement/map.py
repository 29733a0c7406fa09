"""The improvement map of a lattice of seeds, band by band: windows kriged, then blended."""

from __future__ import annotations

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.improvement.lattice import LANES, krige_lanes
from selective_depth.selectors.improvement.lattice_tables import SEEDS
from selective_depth.selectors.improvement.systems import Box, krige_window
from selective_depth.selectors.improvement.variogram import fit_samples

LEVEL_SHIFT = np.uint32(17)
LEVELS = 1 << 14
BLOCK = 64
ONE = np.int32(1)


@njit(cache=True, forceinline=True, nogil=True)
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


@njit(cache=True, nogil=True)
def krige_row(  # type: ignore[no-untyped-def]
    i, padded, row_axis, column_axis, order, tables, frame_shape, samples, lattice_scratch,
    window_scratch, strip, held,
):  # fmt: skip
    """Krige all windows of one lattice row.

    Parameters
    ----------
    strip : float32 array of shape (3, rows of a window, columns of a window, places or more)
        Filled with estimate, variance and improvement of each window's pixels.
    held : float32 array of shape (places,)
        Filled with the number of samples that each window holds, 0 if it has no system.
    """
    rows, ups, downs, row_shapes = row_axis
    columns, lefts, rights, column_shapes = column_axis
    lanes_columns, shape_of, place = order
    first_pixel, distances, between = tables[0], tables[2], tables[3]
    column_shape_count = len(first_pixel) // (row_shapes.max() + 1)
    up, down = ups[i], downs[i]
    height = up + down - 1
    z, row_of = samples[2], samples[3]
    for j in range(len(columns)):
        count = 0
        for k in range(3):
            over, beside, under = (padded[i, j + k] > 0, padded[i + 1, j + k] > 0, padded[i + 2, j + k] > 0)
            count += over + beside + under
        # One sample alone says nothing of how depth varies around it.
        held[place[j]] = count if count > 1 else 0
    for batch in range(len(shape_of)):
        if held[batch * LANES : (batch + 1) * LANES].max() == SEEDS:
            j = lanes_columns[batch, 0]
            geometry = row_shapes[i] * column_shape_count + shape_of[batch]
            krige_lanes(
                padded, i, lanes_columns, batch, geometry, up, down, lefts[j], rights[j], tables,
                lattice_scratch, strip,
            )  # fmt: skip
    for j in range(len(columns)):
        at = place[j]
        # What counts nothing need not be right: it is finite, by `krige_lanes` or from before.
        if held[at] == SEEDS or held[at] == 0:
            continue
        width = lefts[j] + rights[j] - 1
        gathered = gather_seeds(padded, rows, columns, i, j, samples)
        geometry = row_shapes[i] * column_shape_count + column_shapes[j]
        a, b = fit_samples(z, row_of, gathered, between[geometry])
        box = Box(columns[j] - lefts[j] + 1, rows[i] - up + 1, width, height)
        krige_window(
            samples, gathered, a, b, between[geometry], distances, first_pixel[geometry], box,
            frame_shape, window_scratch, False,
        )  # fmt: skip
        for row in range(height):
            for column in range(width):
                p = (row + 1) * (width + 2) + column + 1
                strip[0, row, column, at] = window_scratch[0][p]
                strip[1, row, column, at] = window_scratch[1][p]
                strip[2, row, column, at] = window_scratch[2][p]


@njit(cache=True, forceinline=True, nogil=True, fastmath={"contract"}, error_model="numpy")
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


@njit(cache=True, forceinline=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def blend_across(column_blend, places, mixed, held, estimate, variance, raw):  # type: ignore[no-untyped-def]
    """Blend one pixel row across from the windows left and right of each pixel."""
    _, _, _, _, first_weight, second_weight = column_blend
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


FAR, MIXED = 0, 1


@njit(cache=True, forceinline=True, nogil=True)
def judge_cells(i, padded, rows, columns, reach_squared, doubtful):  # type: ignore[no-untyped-def]
    """List the cells between lattice rows i and i + 1 that are not known as a whole.

    Cell j lies between lattice columns j - 1 and j. A seed that returned depth makes known
    what lies within reach of it; seeds two lattice steps away or farther are not asked.
    `doubtful` is filled with the numbers of the cells, and with FAR where nothing in them is
    known or MIXED where each pixel is to be looked at; returned is how many they are.
    """
    found = 0
    height = rows[i + 1] - rows[i] if 0 <= i < len(rows) - 1 else -1
    for j in range(len(columns) + 1):
        width = columns[j] - columns[j - 1] if 0 < j < len(columns) else -1
        # At the frame's edge a cell has no far side: look at its pixels one by one.
        small = height >= 0 and width >= 0 and height**2 + width**2 <= reach_squared
        corners = 0
        for k in range(4):
            corners += padded[i + 1 + k // 2, j + k % 2] > 0
        # Every window that a pixel here lies in holds all corners; a system takes two samples.
        if corners >= 2 and small:
            continue
        state = MIXED
        if corners == 0:
            top, bottom = max(i, 0), min(i + 4, padded.shape[0])
            start, end = max(j - 1, 0), min(j + 3, padded.shape[1])
            if not (padded[top:bottom, start:end] > 0).any():
                state = FAR
        doubtful[0, found], doubtful[1, found] = j, state
        found += 1
    return found


@njit(cache=True, forceinline=True, nogil=True)
def near_seed(padded, rows, columns, i, j, y, x, reach_squared):  # type: ignore[no-untyped-def]
    """Whether any of the 4x4 seeds around cell j below lattice row i is near pixel (y, x)."""
    for ni in range(max(i - 1, 0), min(i + 3, len(rows))):
        dy = rows[ni] - y
        for nj in range(max(j - 2, 0), min(j + 2, len(columns))):
            dx = columns[nj] - x
            if padded[ni + 1, nj + 1] > 0 and dx * dx + dy * dy <= reach_squared:
                return True
    return False


@njit(cache=True, forceinline=True, nogil=True)
def mark_known(  # type: ignore[no-untyped-def]
    y, i, padded, rows, columns, column_blend, places, reach_squared, held, doubtful, line
):
    """Tell known pixels of a row from those too far from every seed, and clear the latter.

    `line` is the pixel row y of the estimate, the variance, the improvement and what is known.
    """
    estimate, variance, raw, known = line
    _, _, _, _, first_weight, second_weight = column_blend
    first_place, second_place = places[0], places[1]
    known[:] = True
    for n in range(doubtful.shape[1]):
        j, state = doubtful[0, n], doubtful[1, n]
        start = columns[j - 1] if j > 0 else 0
        end = columns[j] if j < len(columns) else len(known)
        for x in range(start, end):
            if state == MIXED:
                total = first_weight[x] * held[first_place[x]]
                total += second_weight[x] * held[second_place[x]]
                if total > 0 and near_seed(padded, rows, columns, i, j, y, x, reach_squared):
                    continue
            known[x] = False
            estimate[x] = np.nan
            variance[x] = np.nan
            raw[x] = 0


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def improvement_rows(  # type: ignore[no-untyped-def]
    first_row, end_row, padded, half, lattice, scratch, histogram, out
):
    """Map the pixel rows `first_row` to `end_row` - 1 of a frame.

    Parameters
    ----------
    padded : float32 array of shape (R + 2, C + 2)
        Depth of the seeds, 0 = missing, with a rim of zeros.
    half : float32
        The improvement that scores one half.
    lattice : tuple
        `Windows.kernel_arguments`.
    scratch : tuple
        Working memory of this band.
    histogram : int32 array of shape (2, LEVELS)
        Number of pixels by the upper bits of their improvement, in two parts.
    out : tuple
        Estimate, variance, improvement, score and known of the frame.
    """
    row_axis, column_axis, row_blend, column_blend, order, places, tables, reach_squared = lattice
    estimate, variance, raw, score, known = out
    samples, lattice_scratch, window_scratch, strips, helds, mixed, held, doubtful = scratch
    frame_shape = estimate.shape
    rows, columns = row_axis[0], column_axis[0]
    y_first, y_second, y_first_at, y_second_at, y_first_weight, y_second_weight = row_blend
    ready = -1
    judged = -2
    doubts = 0
    for y in range(first_row, end_row):
        i, k = y_first[y], y_second[y]
        # Lattice row n is kept in slot n % 2 as long as it is needed.
        for n in range(max(ready + 1, i), k + 1):
            krige_row(
                n, padded, row_axis, column_axis, order, tables, frame_shape, samples,
                lattice_scratch, window_scratch, strips[n % 2], helds[n % 2],
            )  # fmt: skip
            ready = n
        blend_down(
            y_first_weight[y], strips[i % 2], y_first_at[y], helds[i % 2],
            y_second_weight[y], strips[k % 2], y_second_at[y], helds[k % 2], mixed, held,
        )  # fmt: skip
        blend_across(column_blend, places, mixed, held[0], estimate[y], variance[y], raw[y])
        above = i if rows[i] <= y else -1
        if judged != above:
            doubts = judge_cells(above, padded, rows, columns, reach_squared, doubtful)
            judged = above
        mark_known(
            y, above, padded, rows, columns, column_blend, places, reach_squared, held[0],
            doubtful[:, :doubts], (estimate[y], variance[y], raw[y], known[y]),
        )  # fmt: skip
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
    bits = raw.view(np.uint32)
    level_bits = np.uint32(level)
    group = np.empty(histogram[level], np.int32)
    count = 0
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
                group[count] = block[n]
                count += 1
    group.sort()
    place = count - (wanted - above)
    edge[0] = group[place]
    if group[place - 1] == group[place]:
        edge[0] += 1
    return edge.view(np.float32)[0]
