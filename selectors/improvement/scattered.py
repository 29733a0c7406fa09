"""The improvement map of samples anywhere, and only where it is asked for.

After a round of acquisition the samples no longer form a lattice. The windows stay as they are
(see `neighbourhoods`): each now holds all the samples in its box, the nearest to its centre first. On
a lattice alone that is the same system as `ImprovementSelector` solves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Bools, Floats, Longs, checked_map, sample_pairs
from selective_depth.selectors.improvement.neighbourhoods import Windows, windows_of
from selective_depth.selectors.improvement.sums import improve_by_sums
from selective_depth.selectors.improvement.systems import MAX_SAMPLES, Box, krige_window, sample_buffers, window_scratch
from selective_depth.selectors.improvement.variogram import fit_samples
from selective_depth.selectors.parallel import in_bands
from selective_depth.selectors.seeds import SeedGrid

EXPONENT = 1.2
"""The exponent w = 2 - epsilon of the semivariogram (eq. 24); see `app/docs/improvement.md`."""

MOST_EXPONENT = 1.9999
"""Nearer to 2 the kriging variance vanishes beside the rounding of single precision."""


class ImprovementMap(NamedTuple):
    """Estimate, variance and improvement of a frame's pixels.

    Parameters
    ----------
    estimate_mm : float32 array of shape (height, width)
        Depth by ordinary kriging in millimetres, NaN where unknown or not asked for.
    variance_mm2 : float32 array of shape (height, width)
        Its kriging variance in mm^2, NaN where unknown or not asked for.
    known : bool array of shape (height, width)
        False where a pixel is too far from every sample, or was not asked for.
    raw : float32 array of shape (height, width)
        Improvement (eq. 23) in millimetres, 0 where unknown or not asked for.
    """

    estimate_mm: Floats
    variance_mm2: Floats
    known: Bools
    raw: Floats


def improvement_scattered(
    uv: npt.ArrayLike,
    depth_mm: npt.ArrayLike,
    shape: tuple[int, int],
    where: npt.ArrayLike | None = None,
    *,
    lattice: tuple[int, int] | None = None,
    exponent: float = EXPONENT,
    by_sums: bool = False,
    threads: int | None = None,
) -> ImprovementMap:
    """Map the improvement from samples at any pixels.

    Parameters
    ----------
    uv : int array of shape (n, 2)
        Pixels of the samples, column first. Of several at one pixel the last counts.
    depth_mm : array of shape (n,)
        Their depths in millimetres; what is not a depth (see `measured_mm`) was not measured.
    shape : tuple of int
        Height and width of the frame.
    where : bool array of shape `shape`, optional
        Pixels to map; default all. The cost follows the windows that these lie in.
    lattice : tuple of int, optional
        Rows and columns of the lattice of windows; default 128x128, or the frame's size where
        that is less. With the seeds' own lattice, seeds alone give the seeds' map.
    exponent : float, default 1.2
        The w = 2 - epsilon of eq. (24), in (0, 2).
    by_sums : bool, default False
        Take eq. (27) instead of eq. (23).
    threads : int, optional
        Kernel threads; default `default_threads()`. The result does not depend on it.

    Raises
    ------
    ValueError
        If a sample lies outside the frame or an array's shape is wrong.
    """
    pixels, mm = sample_pairs(uv, depth_mm, shape)
    measured = np.zeros(shape, np.float32)
    measured[pixels[:, 1], pixels[:, 0]] = mm
    over = lattice or (min(128, shape[0]), min(128, shape[1]))
    asked = None if where is None else checked_map(where, shape, "where") > 0
    windows = windows_of(SeedGrid.from_array(np.zeros(shape, np.uint8), over), exponent)
    return map_scattered(measured, asked, windows, threads, by_sums=by_sums)


def map_scattered(
    measured: Floats, asked: Bools | None, windows: Windows, threads: int | None, *, by_sums: bool = False
) -> ImprovementMap:
    """Map the improvement of an image of samples (mm, 0 = none) at the pixels asked for, or all."""
    asked = np.ones(measured.shape, np.bool_) if asked is None else asked
    maps = ImprovementMap(
        estimate_mm=np.full(measured.shape, np.nan, np.float32),
        variance_mm2=np.full(measured.shape, np.nan, np.float32),
        known=np.zeros(measured.shape, np.bool_),
        raw=np.zeros(measured.shape, np.float32),
    )
    spiral = _spiral(windows.power.shape[0] // 2)

    def band(first_row: int, end_row: int) -> None:
        distances = np.zeros((MAX_SAMPLES, windows.most_pixels), np.float32)
        sums = np.zeros((4, end_row - first_row, measured.shape[1]), np.float32)
        scratch = sample_buffers(), distances, window_scratch(windows.most_pixels), sums
        lattice = windows.rows, windows.columns, windows.power, spiral, windows.reach_px**2
        _map_rows(first_row, end_row, measured, asked, lattice, by_sums, scratch, maps)

    in_bands(band, len(measured), threads)
    return maps


def _spiral(reach: int) -> Longs:
    """Offsets (dv, du) up to `reach`, the nearest first; equals in a fixed order."""
    steps = np.arange(-reach, reach + 1)
    dv, du = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
    order = np.lexsort((du, dv, dv * dv + du * du))
    return np.stack((dv[order], du[order]), axis=1).astype(np.int64)


@njit(cache=True, forceinline=True, nogil=True)
def _gather(measured, spiral, row, column, up, down, left, right, samples):  # type: ignore[no-untyped-def]
    """Collect the samples of a window's box, the nearest to its centre first."""
    height, width = measured.shape
    u, v, z, row_of = samples
    count = 0
    in_box = (up + down + 1) * (left + right + 1)
    for n in range(len(spiral)):
        dv, du = spiral[n]
        if not (-up <= dv <= down and -left <= du <= right):
            continue
        in_box -= 1
        y, x = row + dv, column + du
        if 0 <= y < height and 0 <= x < width and measured[y, x] > 0:
            u[count], v[count], z[count], row_of[count] = x, y, measured[y, x], count
            count += 1
        if count == len(u) or in_box == 0:
            break
    return count


@njit(cache=True, inner=True, forceinline=True, nogil=True)
def _near_sample(measured, spiral, y, x, reach_squared):  # type: ignore[no-untyped-def]
    height, width = measured.shape
    for n in range(len(spiral)):
        dv, du = spiral[n]
        if dv * dv + du * du > reach_squared:
            return False
        if 0 <= y + dv < height and 0 <= x + du < width and measured[y + dv, x + du] > 0:
            return True
    return False


@njit(cache=True, nogil=True)
def _map_rows(first_row, end_row, measured, asked, lattice, by_sums, scratch, maps):  # type: ignore[no-untyped-def]
    """Map the rows first_row..end_row where asked, each window kriged and blended into its cells.

    Parameters
    ----------
    measured : float32 array of shape (H, W)
        Depth of the samples in mm, 0 = none.
    asked : bool array of shape (H, W)
        Where the map is wanted.
    lattice : tuple
        The windows along the rows and the columns (`Axis`); distance^w by difference of rows and
        columns; differences (row, column), the nearest first, int64 of shape (n, 2); how far from
        every sample pixels are known, squared.
    by_sums : bool
        Take eq. (27) instead of eq. (23).
    scratch : tuple
        `sample_buffers`; distance^w from each sample to the pixels of a window, float32 of shape
        (MAX_SAMPLES, most pixels of a window); `window_scratch`; zeros for the weighted sums and
        the weights, float32 of shape (4, rows, W).
    maps : ImprovementMap
        Filled in where asked.
    """
    row_axis, column_axis, power, spiral, reach_squared = lattice
    rows, up, down = row_axis.centres, row_axis.before, row_axis.after
    columns, left, right = column_axis.centres, column_axis.before, column_axis.after
    samples, distances, work, sums = scratch
    estimate, variance, improvement = work[:3]
    u, v, z, row_of = samples
    between = np.zeros((MAX_SAMPLES, MAX_SAMPLES))
    reach = power.shape[0] // 2
    frame_width = measured.shape[1]
    for i in range(len(rows)):
        top, bottom = rows[i] - up[i] + 1, rows[i] + down[i]
        y0, y1 = max(top, first_row), min(bottom, end_row)
        if y0 >= y1:
            continue
        for j in range(len(columns)):
            start, end = columns[j] - left[j] + 1, columns[j] + right[j]
            x0, x1 = max(start, 0), min(end, frame_width)
            if not asked[y0:y1, x0:x1].any():
                continue
            count = _gather(measured, spiral, rows[i], columns[j], up[i], down[i], left[j], right[j], samples)
            # One sample alone says nothing of how depth varies around it.
            if count < 2:
                continue
            for n in range(count):
                for k in range(count):
                    between[n, k] = power[reach + v[n] - v[k], reach + u[n] - u[k]]
            a, b = fit_samples(z, row_of, count, between)
            width, height = end - start, bottom - top
            for n in range(count):
                p = 0
                for y in range(top - 1, bottom + 1):
                    line = power[reach + y - v[n]]
                    for x in range(start - 1, end + 1):
                        distances[n, p] = line[reach + x - u[n]]
                        p += 1
            box = Box(start, top, width, height)
            krige_window(samples, count, a, b, between, distances, 0, box, measured.shape, work)
            if by_sums:
                improve_by_sums(samples, count, a, b, box, work)
            for y in range(y0, y1):
                gap = up[i] if y < rows[i] else down[i]
                share_y = count * (1.0 - abs(y - rows[i]) / gap)
                for x in range(x0, x1):
                    gap = left[j] if x < columns[j] else right[j]
                    share = np.float32(share_y * (1.0 - abs(x - columns[j]) / gap))
                    p = (y - top + 1) * (end - start + 2) + x - start + 1
                    sums[0, y - first_row, x] += share * estimate[p]
                    sums[1, y - first_row, x] += share * variance[p]
                    sums[2, y - first_row, x] += share * improvement[p]
                    sums[3, y - first_row, x] += share
    for y in range(first_row, end_row):
        for x in range(frame_width):
            total = sums[3, y - first_row, x]
            if asked[y, x] and total > 0 and _near_sample(measured, spiral, y, x, reach_squared):
                maps.known[y, x] = True
                maps.estimate_mm[y, x] = sums[0, y - first_row, x] / total
                maps.variance_mm2[y, x] = sums[1, y - first_row, x] / total
                maps.raw[y, x] = sums[2, y - first_row, x] / total
