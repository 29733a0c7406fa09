"""What has been measured so far, kept so that the neighbourhood of a pixel is found quickly."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.seeds import SeedGrid

MISSED = np.float32(-1)
"""In an image of samples: measured, but nothing returned."""

REACH = 1.3
"""Farther than so many steps of the lattice from every sample that returned depth, a shot would
mostly hit a hole: 6.5 pixels for 128x128 seeds on 640x480."""

_WORD = 64


@njit(cache=True, nogil=True)
def _record(
    uv: npt.NDArray[np.int32],
    depth_mm: npt.NDArray[np.float32],
    image_mm: npt.NDArray[np.float32],
    bits: npt.NDArray[np.uint64],
    low_mm: npt.NDArray[np.float32],
    high_mm: npt.NDArray[np.float32],
    stale: npt.NDArray[np.bool_],
    tile_px: int,
) -> None:
    tile_rows, tile_columns = stale.shape
    touched = np.zeros(stale.shape, np.bool_)
    for i in range(len(uv)):
        u, v, z = uv[i, 0], uv[i, 1], depth_mm[i]
        bits[v, (u >> 6) + 1] |= np.uint64(1) << np.uint64(u & 63)
        row, column = v // tile_px, u // tile_px
        if z > 0:
            image_mm[v, u] = z
            low_mm[row, column] = min(low_mm[row, column], z)
            high_mm[row, column] = max(high_mm[row, column], z)
        else:
            image_mm[v, u] = MISSED
        touched[row, column] = True
    for row in range(tile_rows):
        for column in range(tile_columns):
            if touched[row, column]:
                stale[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = True


def seed_pitch_px(seeds: SeedGrid) -> float:
    """Widest step of a seed lattice in pixels."""
    return max(n / cells for n, cells in zip(seeds.frame_shape, seeds.shape, strict=True))


class Samples:
    """The measurements of one frame: an image of them, and an index over it.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the frame in pixels.
    pitch_px : float, default 5
        Widest step of the seed lattice, the scale of all distances: 5 for 128x128 seeds on
        640x480.

    Attributes
    ----------
    reach_px : float
        1.3 steps: no shot farther than this from a sample that returned depth, for it would
        mostly hit a hole (6.5 pixels for 128x128 seeds).
    vote_px : int
        1.8 steps, at most 21: samples farther than this from a pixel have no say about it. (So
        much, on both sides of a tile, fits in one word of `bits`.)
    tile_px : int
        Side of the square tiles in which changes and depth ranges are booked: `vote_px`, rounded
        up to whole blocks of 3x3 pixels. So a measurement matters to its own and the eight tiles
        around it only.
    image_mm : float32 array of shape (H, W)
        Depth where a measurement returned, `MISSED` where one did not, 0 where none was made.
    bits : uint64 array of shape (H, words)
        One bit per measured pixel; a word of zeros on either side spares the borders.
    low_mm, high_mm : float32 arrays of shape (rows, columns)
        Least and greatest depth in each tile; low > high where there is none.
    stale : bool array of shape (rows, columns)
        Tiles measured in, or beside one measured in, since the reader last cleared it.
    """

    def __init__(self, shape: tuple[int, int], pitch_px: float = 5.0) -> None:
        height, width = shape
        self.shape = shape
        self.pitch_px = pitch_px
        self.vote_px = min(math.ceil(1.8 * pitch_px), (_WORD - 1) // 3)
        self.reach_px = min(REACH * pitch_px, self.vote_px)
        self.tile_px = 3 * math.ceil(self.vote_px / 3)
        tiles = -(-height // self.tile_px), -(-width // self.tile_px)
        self.image_mm = np.zeros(shape, np.float32)
        self.bits = np.zeros((height, (width + _WORD - 1) // _WORD + 2), np.uint64)
        self.low_mm = np.full(tiles, np.inf, np.float32)
        self.high_mm = np.zeros(tiles, np.float32)
        self.stale = np.ones(tiles, np.bool_)

    @classmethod
    def of(cls, seeds: SeedGrid, pitch_px: float | None = None) -> Samples:
        """The seeds of a frame as its first samples; the scale is their own step by default."""
        samples = cls(seeds.frame_shape, pitch_px or seed_pitch_px(seeds))
        samples.add(seeds.lattice_uv.reshape(-1, 2), seeds.depth_mm.ravel())
        return samples

    def add(self, uv: npt.NDArray[np.int32], depth_mm: npt.NDArray[np.generic]) -> None:
        """Book measurements: pixels (n, 2), column first, and depth (n,), 0 = no return."""
        _record(
            uv,
            np.ascontiguousarray(depth_mm, dtype=np.float32),
            self.image_mm,
            self.bits,
            self.low_mm,
            self.high_mm,
            self.stale,
            self.tile_px,
        )
