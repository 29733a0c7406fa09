"""Overlapping windows that tile a frame: one local kriging system about every lattice point.

A map from one system per cell is a mosaic: at a cell's border the semivariogram and the
samples change at once. Here every lattice point is the centre of a window that reaches to its
neighbours on all sides and holds the samples in that box, rim included: nine on a lattice
without holes. A pixel lies in the four windows of the lattice points around it; its value is
the mean of theirs, weighted bilinearly and by the number of samples that each window holds.
A window's weight has faded to nothing where it ends, so nothing jumps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from selective_depth.selectors.arrays import Bools, Doubles, Floats, Longs
from selective_depth.selectors.improvement.lattice import LANES
from selective_depth.selectors.improvement.lattice_tables import LatticeTables, build_tables
from selective_depth.selectors.improvement.systems import MAX_PIXELS, padded_pixels
from selective_depth.selectors.improvement.variogram import power_table
from selective_depth.selectors.seeds import SeedGrid

REACH = 1.3
"""Pixels farther than this many times the (wider) pitch from every sample are unknown.

6.5 pixels for 128x128 seeds on 640x480: beyond that, shots meet a hole more often than not.
"""
LONE_PITCH = 5.0
"""Pitch in pixels that a lattice of a single point is taken to have."""


class Axis(NamedTuple):
    """The windows along one axis of the frame.

    Parameters
    ----------
    centres : int64 array of shape (n,)
        Lattice points, increasing.
    before, after : int64 array of shape (n,)
        Distance from a centre to the one before and after it; at the ends to where a next
        centre would be, beyond the frame's edge if the known region gets that far.
    shapes : int64 array of shape (k, 2)
        The different (before, after).
    shape_of : int64 array of shape (n,)
        Which of them each window has.
    first, second : int64 array of shape (pixels,)
        The centres before (or at) and after each pixel; at the ends both are the outermost.
    first_at, second_at : int64 array of shape (pixels,)
        Where each pixel is in those two windows, counted from the window's first pixel.
    first_weight, second_weight : float32 array of shape (pixels,)
        What each of the two counts, 0..1; 0 outside the window.
    """

    centres: Longs
    before: Longs
    after: Longs
    shapes: Longs
    shape_of: Longs
    first: Longs
    second: Longs
    first_at: Longs
    second_at: Longs
    first_weight: Floats
    second_weight: Floats

    @property
    def longest(self) -> int:
        """Farthest that any window reaches from its centre, pixels."""
        return int(max(self.before.max(), self.after.max()))

    @classmethod
    def of(cls, pixels: int, centres: npt.NDArray[np.integer], reach_px: float) -> Axis:
        """The windows about `centres`, none wider than what `reach_px` makes known."""
        at = centres.astype(np.int64)
        gaps = np.diff(at)
        farthest = int(np.ceil(reach_px)) + 1
        # A missing neighbour stands as far away as the one opposite, so that windows at the
        # edge have the geometry of those inside, unless it takes more to cover the edge.
        start = max(int(gaps[0]) if len(gaps) else 1, min(int(at[0]) + 1, farthest))
        end = max(int(gaps[-1]) if len(gaps) else 1, min(pixels - int(at[-1]), farthest))
        before = np.concatenate(([start], gaps))
        after = np.concatenate((gaps, [end]))
        shapes, shape_of = np.unique(np.stack((before, after), axis=1), axis=0, return_inverse=True)

        x = np.arange(pixels)
        lower = np.searchsorted(at, x, side="right") - 1
        first, second = np.maximum(lower, 0), np.minimum(lower + 1, len(at) - 1)
        between = first < second
        way = np.where(between, (x - at[first]) / np.maximum(at[second] - at[first], 1), 0.0)
        # Beyond the outermost centre only its window is there, as far as that reaches.
        covered = (x > at[first] - before[first]) & (x < at[first] + after[first])
        return cls(
            centres=at,
            before=before,
            after=after,
            shapes=shapes,
            shape_of=shape_of.ravel().astype(np.int64),
            first=first,
            second=second,
            first_at=np.where(covered, x - at[first] + before[first] - 1, 0),
            second_at=np.where(way > 0, x - at[second] + before[second] - 1, 0),
            first_weight=np.where(covered, 1.0 - way, 0.0).astype(np.float32),
            second_weight=way.astype(np.float32),
        )


@dataclass(frozen=True, eq=False)
class Windows:
    """The windows of a lattice on a frame, and the powers of distances within them.

    Parameters
    ----------
    rows, columns : Axis
        The windows along either axis.
    reach_px : float
        Greatest distance in pixels from a sample to a known pixel.
    power : float64 array
        `power_table` that reaches across a window and its rim.
    exponent : float
        The w of eq. (24).
    """

    rows: Axis
    columns: Axis
    reach_px: float
    power: Doubles
    exponent: float

    @cached_property
    def tables(self) -> LatticeTables:
        """Tables of every geometry: row shape by row shape, column shapes within."""
        return build_tables(
            [(*rows, *columns) for rows in self.rows.shapes.tolist() for columns in self.columns.shapes.tolist()],
            self.exponent,
        )

    @cached_property
    def order(self) -> tuple[Longs, Longs, Longs]:
        """How the windows of a lattice row are laid side by side.

        Returns
        -------
        columns : int64 array of shape (batches, LANES)
            Lattice column in each lane; all windows of a batch have one shape, and the last
            column of a shape fills its batch up.
        shape_of : int64 array of shape (batches,)
            Which of the column shapes a batch has.
        place : int64 array of shape (C,)
            Where each lattice column went: batch * LANES + lane.
        """
        which = self.columns.shape_of
        batches: list[Longs] = []
        shape_of = []
        place = np.zeros(len(which), np.int64)
        for shape in range(len(self.columns.shapes)):
            members = np.flatnonzero(which == shape)
            place[members] = len(batches) * LANES + np.arange(len(members))
            for first in range(0, len(members), LANES):
                batch = members[first : first + LANES]
                batches.append(np.pad(batch, (0, LANES - len(batch)), mode="edge"))
                shape_of.append(shape)
        return np.array(batches, np.int64), np.array(shape_of, np.int64), place

    @cached_property
    def small(self) -> Bools:
        """Cells between lattice points that any of their seeds reaches as a whole, shape (R + 1, C + 1)."""
        # At the frame's edge a cell has no far side: its pixels are looked at one by one.
        down, across = (
            np.pad(np.diff(at.centres) ** 2.0, 1, constant_values=np.inf) for at in (self.rows, self.columns)
        )
        return np.asarray(down[:, None] + across <= self.reach_px**2)

    @cached_property
    def kernel_arguments(self) -> tuple[Any, ...]:
        """Everything about the lattice that `improvement_rows` takes."""
        columns, place, places = self.columns, self.order[2], self.order[0].size
        # Where each pixel's value is in a row of blended windows, flattened.
        first, second = place[columns.first], place[columns.second]
        cells = first + places * columns.first_at, second + places * columns.second_at
        at = tuple(index.astype(np.uint32) for index in (first, second, *cells))
        return self.rows, columns, self.order, at, self.tables, self.reach_px**2

    @property
    def most_pixels(self) -> int:
        """Room for the pixels of the largest window, `padded_pixels`."""
        height = int((self.rows.before + self.rows.after).max()) - 1
        width = int((self.columns.before + self.columns.after).max()) - 1
        return padded_pixels(width, height)


@lru_cache(maxsize=8)
def _windows(frame_shape: tuple[int, int], rows: bytes, columns: bytes, exponent: float) -> Windows:
    height, width = frame_shape
    at_rows, at_columns = np.frombuffer(rows, np.int32), np.frombuffer(columns, np.int32)
    axes = (height, at_rows), (width, at_columns)
    reach_px = REACH * max((pixels / len(at) for pixels, at in axes if len(at) > 1), default=LONE_PITCH)
    row_axis, column_axis = (Axis.of(pixels, at, reach_px) for pixels, at in axes)
    widest = max(row_axis.longest, column_axis.longest)
    windows = Windows(row_axis, column_axis, reach_px, power_table(exponent, 2 * widest + 2), exponent)
    if windows.most_pixels > MAX_PIXELS:
        raise ValueError(
            f"a lattice of {len(at_rows)}x{len(at_columns)} seeds on {height}x{width} pixels leaves"
            f" windows of {windows.most_pixels} pixels; at most {MAX_PIXELS} are possible. Take"
            f" more seeds, for example {min(64, height)}x{min(64, width)}."
        )
    return windows


def windows_of(seeds: SeedGrid, exponent: float) -> Windows:
    """The windows about the seeds of a lattice; made once for each lattice and frame shape."""
    rows = np.ascontiguousarray(seeds.rows, np.int32).tobytes()
    columns = np.ascontiguousarray(seeds.columns, np.int32).tobytes()
    return _windows(seeds.frame_shape, rows, columns, exponent)
