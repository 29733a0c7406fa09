"""The improvement map of samples anywhere, and only where it is asked for.

After a round of acquisition the samples are no lattice any more. The windows stay as they are
(see `windows`): each now holds all the samples in its box, the nearest to its centre first. On
a lattice alone that is the same system as `ImprovementSelector` solves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Bools, Floats, Longs, checked_map, sample_pairs
from selective_depth.selectors.improvement.neighbourhoods import Windows, windows_over
from selective_depth.selectors.improvement.systems import MAX_SAMPLES, Box, krige_window, sample_buffers, window_scratch
from selective_depth.selectors.improvement.variogram import fit_samples
from selective_depth.selectors.parallel import in_bands

EXPONENT = 1.2
"""The exponent w = 2 - epsilon of the semivariogram (eq. 24); see `app/docs/improvement.md`."""

MOST_EXPONENT = 1.9999
"""Nearer to 2 the kriging variance vanishes beside the rounding of single precision."""


@dataclass(frozen=True, eq=False)
class ImprovementMap:
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
        Their depths in millimetres; what is no depth (see `measured_mm`) is no measurement.
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
    windows = windows_over(shape, over, exponent)
    return map_scattered(measured, asked, windows, threads, by_sums=by_sums)


class _Work(NamedTuple):
    """Working memory of a band of rows.

    Attributes
    ----------
    samples : tuple
        `sample_buffers`.
    distances : float32 array of shape (MAX_SAMPLES, most pixels of a window)
        Distance^w from each sample to the pixels of a window.
    scratch : tuple
        `window_scratch`.
    sums : float32 array of shape (3, rows, W)
        Estimate, variance and improvement, weighted and added up.
    held : float32 array of shape (rows, W)
        The weights.
    """

    samples: tuple[npt.NDArray[Any], ...]
    distances: Floats
    scratch: tuple[npt.NDArray[Any], ...]
    sums: Floats
    held: Floats


def map_scattered(
    measured: Floats, asked: Bools | None, windows: Windows, threads: int | None, *, by_sums: bool = False
) -> ImprovementMap:
    """Map the improvement of an image of samples (mm, 0 = none) at the pixels asked for, or all."""
    asked = np.ones(measured.shape, np.bool_) if asked is None else asked
    rows, columns = windows.rows, windows.columns
    result = ImprovementMap(
        estimate_mm=np.full(measured.shape, np.nan, np.float32),
        variance_mm2=np.full(measured.shape, np.nan, np.float32),
        known=np.zeros(measured.shape, np.bool_),
        raw=np.zeros(measured.shape, np.float32),
    )
    spiral = _spiral(windows.power.shape[0] // 2)

    def band(first_row: int, end_row: int) -> None:
        work = _Work(
            samples=sample_buffers(),
            distances=np.zeros((MAX_SAMPLES, windows.most_pixels), np.float32),
            scratch=window_scratch(windows.most_pixels),
            sums=np.zeros((3, end_row - first_row, measured.shape[1]), np.float32),
            held=np.zeros((end_row - first_row, measured.shape[1]), np.float32),
        )
        _map_rows(
            first_row, end_row, measured, asked,
            (rows.centres, rows.before, rows.after),
            (columns.centres, columns.before, columns.after),
            windows.power, spiral, windows.reach_px**2, by_sums, work,
            (result.estimate_mm, result.variance_mm2, result.raw, result.known),
        )  # fmt: skip

    in_bands(band, measured.shape[0], threads)
    return result


def _spiral(reach: int) -> Longs:
    """Offsets (dv, du) up to `reach`, the nearest first; equals in a fixed order."""
    steps = np.arange(-reach, reach + 1)
    dv, du = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
    order = np.lexsort((du, dv, dv * dv + du * du))
    return np.stack((dv[order], du[order]), axis=1).astype(np.int64)


@njit(cache=True, forceinline=True, nogil=True)
def _gather(  # type: ignore[no-untyped-def] # pragma: no cover - compiled
    measured, spiral, row, column, up, down, left, right, samples
):
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


@njit(cache=True, forceinline=True, nogil=True)
def _near_sample(measured, spiral, y, x, reach_squared):  # type: ignore[no-untyped-def] # pragma: no cover
    height, width = measured.shape
    for n in range(len(spiral)):
        dv, du = spiral[n]
        if dv * dv + du * du > reach_squared:
            return False
        if 0 <= y + dv < height and 0 <= x + du < width and measured[y + dv, x + du] > 0:
            return True
    return False


@njit(cache=True, nogil=True)
def _map_rows(  # type: ignore[no-untyped-def] # pragma: no cover - compiled
    first_row,
    end_row,
    measured,
    asked,
    row_axis,
    column_axis,
    power,
    spiral,
    reach_squared,
    by_sums,
    work,
    out,
):  # fmt: skip
    """Map the rows first_row..end_row where asked, each window kriged and blended into its cells.

    Parameters
    ----------
    measured : float32 array of shape (H, W)
        Depth of the samples in mm, 0 = none.
    asked : bool array of shape (H, W)
        Where the map is wanted.
    row_axis, column_axis : tuple of int arrays
        Centres of the windows, and how far each reaches before and after its centre, pixels.
    power : float64 array of shape (2 r + 1, 2 r + 1)
        Distance^w by difference of rows and columns.
    spiral : int64 array of shape (n, 2)
        Differences (row, column), the nearest first.
    reach_squared : float
        Pixels farther from every sample are not known, squared pixels.
    by_sums : bool
        Take eq. (27) instead of eq. (23).
    work : _Work
        Working memory of this band.
    out : tuple of arrays of shape (H, W)
        Estimate (mm), variance (mm^2), improvement and known.
    """
    rows, up, down = row_axis
    columns, left, right = column_axis
    samples, distances, scratch, sums, held = work
    estimate, variance, raw, known = out
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
            krige_window(samples, count, a, b, between, distances, 0, box, measured.shape, scratch, by_sums)
            for y in range(y0, y1):
                gap = up[i] if y < rows[i] else down[i]
                share_y = count * (1.0 - abs(y - rows[i]) / gap)
                for x in range(x0, x1):
                    gap = left[j] if x < columns[j] else right[j]
                    share = np.float32(share_y * (1.0 - abs(x - columns[j]) / gap))
                    p = (y - top + 1) * (end - start + 2) + x - start + 1
                    held[y - first_row, x] += share
                    sums[0, y - first_row, x] += share * scratch[0][p]
                    sums[1, y - first_row, x] += share * scratch[1][p]
                    sums[2, y - first_row, x] += share * scratch[2][p]
    for y in range(first_row, end_row):
        for x in range(frame_width):
            total = held[y - first_row, x]
            if asked[y, x] and total > 0 and _near_sample(measured, spiral, y, x, reach_squared):
                known[y, x] = True
                estimate[y, x] = sums[0, y - first_row, x] / total
                variance[y, x] = sums[1, y - first_row, x] / total
                raw[y, x] = sums[2, y - first_row, x] / total
