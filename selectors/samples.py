"""What has been measured so far, kept so that the neighbourhood of a pixel is found quickly."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from selective_depth.selectors.seeds import SeedGrid

MISSED = np.float32(-1)
"""In an image of samples: measured, but nothing returned."""

TILE_PX = 10
"""Side of the square tiles in which changes and depth ranges are booked, pixels."""


@njit(cache=True, nogil=True)
def _record(
    uv: npt.NDArray[np.int32],
    depth_mm: npt.NDArray[np.float32],
    image_mm: npt.NDArray[np.float32],
    bits: npt.NDArray[np.uint64],
    low_mm: npt.NDArray[np.float32],
    high_mm: npt.NDArray[np.float32],
    stale: npt.NDArray[np.bool_],
) -> None:
    tile_rows, tile_columns = stale.shape
    for i in range(len(uv)):
        u, v, z = uv[i, 0], uv[i, 1], depth_mm[i]
        bits[v, (u >> 6) + 1] |= np.uint64(1) << np.uint64(u & 63)
        row, column = v // TILE_PX, u // TILE_PX
        if z > 0:
            image_mm[v, u] = z
            low_mm[row, column] = min(low_mm[row, column], z)
            high_mm[row, column] = max(high_mm[row, column], z)
        else:
            image_mm[v, u] = MISSED
        for r in range(max(row - 1, 0), min(row + 2, tile_rows)):
            for c in range(max(column - 1, 0), min(column + 2, tile_columns)):
                stale[r, c] = True


class Samples:
    """The measurements of one frame: an image of them, and an index over it.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the frame in pixels.

    Attributes
    ----------
    image_mm : float32 array of shape (H, W)
        Depth where a measurement returned, `MISSED` where one did not, 0 where none was made.
    bits : uint64 array of shape (H, words)
        One bit per measured pixel; a word of zeros on either side spares the borders.
    low_mm, high_mm : float32 arrays of shape (rows, columns)
        Least and greatest depth in each tile of `TILE_PX`; low > high where there is none.
    stale : bool array of shape (rows, columns)
        Tiles measured in, or beside one measured in, since the reader last cleared it.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        height, width = shape
        tiles = -(-height // TILE_PX), -(-width // TILE_PX)
        self.shape = shape
        self.image_mm = np.zeros(shape, np.float32)
        self.bits = np.zeros((height, (width + 63) // 64 + 2), np.uint64)
        self.low_mm = np.full(tiles, np.inf, np.float32)
        self.high_mm = np.zeros(tiles, np.float32)
        self.stale = np.ones(tiles, np.bool_)

    @classmethod
    def of(cls, seeds: SeedGrid) -> Samples:
        """The seeds of a frame as its first samples."""
        samples = cls(seeds.frame_shape)
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
        )
