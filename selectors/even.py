"""Even sampling: lattices of any size, and regions filled evenly. What all else is held against."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from selective_depth.selectors.arrays import Bools, Floats, Ints
from selective_depth.selectors.samples import Samples
from selective_depth.selectors.seeds import SeedGrid, cell_centres
from selective_depth.selectors.selection import Selection

_BITS = 10
"""The order of filling repeats after 2**10 pixels."""


def even_lattice(shape: tuple[int, int], pixels: float) -> Ints:
    """A lattice of square pitch over a frame.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the frame.
    pixels : float
        About how many pixels it is to have.

    Returns
    -------
    int32 array of shape (n, 2)
        Pixels, column first, row by row.
    """
    height, width = shape
    rows = min(max(round(height * (pixels / (height * width)) ** 0.5), 1), height)
    columns = min(max(round(pixels / rows), 1), width)
    u, v = np.meshgrid(cell_centres(width, columns), cell_centres(height, rows))
    return np.stack((u, v), axis=-1).reshape(-1, 2)


@lru_cache(maxsize=4)
def even_rank(shape: tuple[int, int]) -> Floats:
    """Rank of every pixel, 0 <= rank < 1, such that the first n of any region fill it evenly.

    The ordered dither of halftone printing; read-only.
    """
    rows, columns = np.indices(shape)
    rank = np.zeros(shape, np.int64)
    for bit in range(_BITS):
        u, v = columns >> bit & 1, rows >> bit & 1
        rank |= ((u ^ v) << 1 | v) << 2 * (_BITS - 1 - bit)
    even = (rank / 4.0**_BITS).astype(np.float32)
    even.flags.writeable = False
    return even


def spread(mask: Bools) -> Floats:
    """Worth of pixels such that shots fill a mask evenly, and only then what is outside of it."""
    return np.where(mask, np.float32(2), np.float32(1)) - even_rank(mask.shape)


class EvenSelector:
    """The seeds, and an even fill of all between them: no measurement has a say."""

    name = "even"

    def select(self, samples: SeedGrid | Samples) -> Selection:
        """Every pixel is selected; the order is that of `even_rank`."""
        everything = np.ones(samples.frame_shape, np.bool_)
        return Selection(everything, spread(everything) - 1, self.name, crowded=1.0)
