"""An even, finer lattice before anything else, where the seeds are few beside the budget.

Between seeds far apart stands what none of them hints at: a chair's leg, a gap. No score of the
seeds finds it, but every other sample in the middle of four does, for a small part of a budget.
"""

from __future__ import annotations

import numpy as np

from selective_depth.selectors.arrays import Ints, Longs
from selective_depth.selectors.samples import seed_pitch_px
from selective_depth.selectors.seeds import SeedGrid
from selective_depth.selectors.triangulation import nearest_sample

COARSE_PX = 6.0
"""Only a lattice of a wider pitch is refined.

128x128 seeds on 640x480 stand 5 pixels apart, and refining them lowered the oracle share on the
tuning frames by 1 %, even where it took but a quarter of the budget; 64x64 seeds, 10 pixels apart,
gained 1 %."""

SHARE = 1 / 3
"""Most of the budget that it may take: at .33 it still gained, at .42 it lost 1 %."""


HOLE_PITCHES = 3.0
"""Farther than so many pitches from every seed that returned depth, the inside of a hole begins, and
the lattice ends. Nearer, things can stand that no seed met, and no score goes there (`REACH`).

Not from the tuning frames, which are indifferent (64x64 seeds, +5 %: oracle share 95.7 % at 1.3
pitches, 95.6 % at 2 and 3, 95.1 % without an end), but from a frame of `sequence`, where the lattice
missed a thing of 32x5 pixels at 1.3 pitches."""


def finer_lattice(seeds: SeedGrid, shots: int) -> tuple[Ints, float]:
    """Pixels between the seeds that make their lattice finer, if it is coarse and they are few.

    Each time the middles of the squares of neighbours are added, which shortens the pitch by sqrt(2):
    first the middles of the cells, then those of their sides.

    Parameters
    ----------
    seeds : SeedGrid
        The first measurements.
    shots : int
        The whole budget.

    Returns
    -------
    uv : int32 array of shape (n, 2)
        Pixels to measure, column first, none of them a seed and none more than `HOLE_PITCHES` from
        all seeds that returned depth; often empty.
    pitch_px : float
        Pitch of the lattice with them, the wider of the two.
    """
    rows, columns = seeds.rows.astype(np.int64), seeds.columns.astype(np.int64)
    pitch_px = seed_pitch_px(seeds)
    reach_px = HOLE_PITCHES * pitch_px
    added: list[Longs] = []
    centred = False  # whether the middles of the cells are in
    height, width = seeds.frame_shape
    while pitch_px > COARSE_PX and min(len(rows), len(columns)) > 1:
        row_middles, column_middles = _middles(rows, height), _middles(columns, width)
        centres = _grid(row_middles, column_middles)
        sides = np.concatenate((_grid(rows, column_middles), _grid(row_middles, columns)))
        # Where an axis is full or nearly so, cells have no middles: their sides come at once.
        halve = centred or len(centres) < (len(rows) - 1) * (len(columns) - 1)
        new = np.concatenate(([] if centred else [centres]) + ([sides] if halve else []))
        if sum(map(len, added)) + len(new) > SHARE * shots:
            break
        added.append(new)
        if halve:
            rows, columns = np.union1d(rows, row_middles), np.union1d(columns, column_middles)
            pitch_px = max(height / len(rows), width / len(columns))
        else:
            pitch_px /= 2**0.5
        centred = not halve
    if not added or not len(seeds.uv):
        return np.empty((0, 2), np.int32), seed_pitch_px(seeds)
    uv = np.concatenate(added)
    returned = np.zeros((height, width), np.bool_)
    returned[seeds.uv[:, 1], seeds.uv[:, 0]] = True
    _, gap_sq = nearest_sample(returned)
    return uv[gap_sq[uv[:, 1], uv[:, 0]] <= reach_px**2].astype(np.int32), pitch_px


def _middles(at: Longs, pixels: int) -> Longs:
    """Between each place and the next; after the last one as well; where there are pixels."""
    middles = (at[:-1] + at[1:]) // 2
    middles = middles[middles > at[:-1]]
    last = min(at[-1] + (at[-1] - at[-2]) // 2, pixels - 1)
    return np.append(middles, last) if last > at[-1] else middles


def _grid(rows: Longs, columns: Longs) -> Longs:
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
