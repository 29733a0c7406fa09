"""The nearest sample of every pixel."""

from __future__ import annotations

import math

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Bools, Ints
from selective_depth.selectors.parallel import in_bands

FAR_SQ = np.int32(1 << 30)
"""Squared distance to the nearest sample where there is none."""

_FAR = 1 << 20  # farther than any row of any image, and its square fits in 64 bits


@njit(cache=True, nogil=True)
def _nearest_row_in_column(first: int, end: int, valid: Bools, nearest_row: Ints) -> None:
    """Per pixel of the columns first..end, the nearest row of its column with a sample; `_FAR` without."""
    height = len(valid)
    # Row by row, so that many columns are looked at together; down and up again.
    for rows in (range(height), range(height - 1, -1, -1)):
        last = np.full(end - first, _FAR, np.int32)
        for v in rows:
            row, nearest = valid[v, first:end], nearest_row[v, first:end]
            for k in range(len(row)):
                last[k] = np.int32(v) if row[k] else last[k]
                nearest[k] = last[k] if abs(last[k] - v) < abs(nearest[k] - v) else nearest[k]


@njit(cache=True, nogil=True)
def _nearest_along_rows(first: int, end: int, nearest_row: Ints, nearest: Ints, gap_sq: Ints) -> None:
    """Lower envelope of the columns' parabolas, row by row: the exact nearest sample."""
    width = nearest_row.shape[1]
    column = np.empty(width, np.int64)  # of the parabolas on the envelope
    height_sq = np.empty(width, np.int64)
    start = np.empty(width, np.int64)  # first pixel on which each is the lowest
    for v in range(first, end):
        top = -1
        for u in range(width):
            if nearest_row[v, u] == _FAR:
                continue
            off = np.int64(nearest_row[v, u]) - v
            g = off * off
            begin = np.int64(0)
            while top >= 0:
                # First integer pixel at which column u beats the envelope's last column. The
                # quotient is whole or well off it, so that doubles floor it rightly.
                p = column[top]
                begin = np.int64(math.floor((u * u - p * p + g - height_sq[top]) / (2.0 * (u - p)))) + 1
                if begin > start[top]:
                    break
                top -= 1
            if top < 0:
                begin = np.int64(0)
            if begin < width:
                top += 1
                column[top] = u
                height_sq[top] = g
                start[top] = begin
        if top < 0:
            nearest[v] = -1
            gap_sq[v] = FAR_SQ
        stop = width
        while top >= 0:
            for u in range(start[top], stop):
                du = u - column[top]
                nearest[v, u] = nearest_row[v, column[top]] * width + column[top]
                gap_sq[v, u] = height_sq[top] + du * du
            stop = start[top]
            top -= 1


def nearest_sample(valid: Bools, threads: int | None = None) -> tuple[Ints, Ints]:
    """Nearest sample of every pixel, exactly, in time linear in the pixels.

    Parameters
    ----------
    valid : bool array of shape (H, W)
        Where there is a sample.
    threads : int, optional
        Kernel threads; default `default_threads()`.

    Returns
    -------
    nearest : int32 array of shape (H, W)
        Its pixel, as ``row * W + column``; -1 where there is no sample at all. Of equally near
        samples, the one farthest to the left; of those above each other, the upper one.
    gap_sq : int32 array of shape (H, W)
        Squared distance to it in pixels; `FAR_SQ` where there is none.

    Notes
    -----
    The two-phase distance transform of Meijster, Roerdink and Hesselink (2000), which keeps
    the sample as well: a k-d tree needs about 1 us a pixel.
    """
    height, width = valid.shape
    nearest_row = np.full((height, width), _FAR, np.int32)
    nearest, gap_sq = np.empty((height, width), np.int32), np.empty((height, width), np.int32)
    in_bands(_nearest_row_in_column, width, threads, valid, nearest_row)
    in_bands(_nearest_along_rows, height, threads, nearest_row, nearest, gap_sq)
    return nearest, gap_sq
