"""What is not as it was: contradictions of the memory, how far they reach, and a moved camera.

A look-out that lies outside the range of the model about its pixel contradicts the memory. A
single one may be the sensor's flicker; its neighbours must confirm it. How far a change reaches is
found by more shots along the border between what contradicted and what did not.
"""

from __future__ import annotations

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Bools, Floats, Ints
from selective_depth.selectors.memory.store import AGREE_MM, AGREE_SHARE
from selective_depth.selectors.triangulation import nearest_sample

NEAR_PX = 2
"""The range of the model is taken over so many pixels about one, and a contradiction is confirmed
so far from it: outlines wobble by two pixels."""

BESIDE = NEAR_PX * np.array([(-1, 0), (1, 0), (0, -1), (0, 1)], np.int32)
"""Offsets of the four pixels about a contradiction, column first."""

MARGIN_PX = 7
"""Forgotten about what has changed: without it slivers stay behind a thing that moves, and the
error doubles within 40 frames."""

BLOCKS = (6, 8)
"""Rows and columns of blocks in which a moved camera is looked for: fewer if look-outs are few."""
BLOCK_LOOKS = 8
"""Of a block with fewer look-outs that returned nothing is said."""
MOVED = 2.2
"""If half of the blocks are off by so many standard errors, it is the camera that moved, or another
scene. Of a still scene half are off by .9 to 1.4 (neighbours share a part of their error), with a
ball and a person crossing by 1.7 at most, of a hand-held camera by 2.6 to 8.6."""


def contradicts(uv: Ints, depth_mm: Floats, model_mm: Floats) -> Bools:
    """Which measurements lie outside the range of the model about them, shape (n,).

    A miss contradicts nothing: much of what does not return does so now and then.
    """
    against = np.zeros(len(uv), np.bool_)
    _contradict(uv, depth_mm, model_mm, against)
    return against


@njit(cache=True, nogil=True)
def _contradict(uv: Ints, depth_mm: Floats, model_mm: Floats, against: Bools) -> None:
    height, width = model_mm.shape
    for i in range(len(uv)):
        u, v, z = uv[i, 0], uv[i, 1], depth_mm[i]
        here = model_mm[v, u]
        if z <= 0 or here <= 0:
            continue
        tolerance = max(AGREE_MM, AGREE_SHARE * here)
        low = high = here
        for y in range(max(v - NEAR_PX, 0), min(v + NEAR_PX + 1, height)):
            for x in range(max(u - NEAR_PX, 0), min(u + NEAR_PX + 1, width)):
                low, high = min(low, model_mm[y, x]), max(high, model_mm[y, x])
        against[i] = z < low - tolerance or z > high + tolerance


def drift(uv: Ints, depth_mm: Floats, model_mm: Floats, noise_mm: Floats) -> float:
    """How many standard errors the mean of a block's look-outs is off, median over the blocks.

    Parameters
    ----------
    uv : int32 array of shape (n, 2)
        Look-outs, column first.
    depth_mm : float32 array of shape (n,)
        What they returned.
    model_mm : float32 array of shape (H, W)
        The model before them.
    noise_mm : float32 array of shape (n,)
        Standard deviation of each.
    """
    height, width = model_mm.shape
    each = (len(uv) / (2 * BLOCK_LOOKS * BLOCKS[0] * BLOCKS[1])) ** 0.5
    rows, columns = (max(min(int(each * count), count), 1) for count in BLOCKS)
    block = uv[:, 1] * rows // height * columns + uv[:, 0] * columns // width
    returned = depth_mm > 0
    off = np.clip((depth_mm - model_mm[uv[:, 1], uv[:, 0]]) / noise_mm, -3, 3)
    size = rows * columns
    looks = np.bincount(block[returned], minlength=size)
    total = np.bincount(block[returned], off[returned], minlength=size)
    judged = looks >= BLOCK_LOOKS
    return float(np.median(np.abs(total[judged]) / np.sqrt(looks[judged]))) if judged.any() else 0.0


def around(uv: Ints, shape: tuple[int, int]) -> Ints:
    """The four pixels `NEAR_PX` beside each, those that lie inside the frame, each once."""
    beside = (uv[:, None] + BESIDE).reshape(-1, 2)
    inside = ((beside >= 0) & (beside < (shape[1], shape[0]))).all(axis=1)
    found: Ints = np.unique(beside[inside], axis=0)
    return found


class Extent:
    """How far a change reaches: every pixel is as its nearest look of this frame was.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the frame.
    threads : int, optional
        Kernel threads; default `default_threads()`.
    """

    def __init__(self, shape: tuple[int, int], threads: int | None = None) -> None:
        self._threads = threads
        self._looked = np.zeros(shape, np.bool_)
        self._against = np.zeros(shape, np.bool_)

    def add(self, uv: Ints, against: Bools) -> None:
        """Take in looks, and which of them contradicted the memory."""
        self._looked[uv[:, 1], uv[:, 0]] = True
        self._against[uv[:, 1], uv[:, 0]] = against

    def changed(self) -> tuple[Bools, Floats]:
        """Where the nearest look contradicted, and how far a border of it is from any look."""
        nearest, gap_sq = nearest_sample(self._looked, self._threads)
        changed = self._against.ravel()[nearest]
        border_px = np.empty(changed.shape, np.float32)
        _border(changed, gap_sq, border_px)
        return changed, border_px


@njit(cache=True, nogil=True)
def _border(changed: Bools, gap_sq: Ints, border_px: Floats) -> None:
    """How far each pixel beside one that is otherwise lies from any look; 0 elsewhere, and beside a look."""
    height, width = changed.shape
    for v in range(height):
        above, here, below = changed[max(v - 1, 0)], changed[v], changed[min(v + 1, height - 1)]
        for u in range(width):
            beside = here[max(u - 1, 0)], here[min(u + 1, width - 1)], above[u], below[u]
            differs = beside[0] != here[u] or beside[1] != here[u] or beside[2] != here[u] or beside[3] != here[u]
            border_px[v, u] = np.sqrt(np.float32(gap_sq[v, u])) if differs and gap_sq[v, u] > 1 else np.float32(0)
