"""What is not as it was: contradictions of the memory, how far they reach, and a moved camera.

A look-out that lies outside the range of the model about its pixel contradicts the memory. A single
one may be the sensor's flicker; its neighbours must confirm it. How far a change reaches is found by
more shots along the border between what contradicted and what did not.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.ndimage import grey_dilation, grey_erosion

from selective_depth.selectors.memory.store import AGREE_MM, AGREE_SHARE
from selective_depth.selectors.triangulation import nearest_sample

NEAR_PX = 2
"""The range of the model is taken over so many pixels about one, and a contradiction is confirmed
so far from it: outlines wobble by two pixels."""

MARGIN_PX = 7
"""Forgotten about what has changed: without it slivers stay behind a thing that moves, and the error
doubles within 40 frames."""

BLOCKS = (6, 8)
"""Rows and columns of blocks in which a moved camera is looked for."""
BLOCK_LOOKS = 8
BLOCK_SHARE = 0.10
DRIFTED = 5.0
"""A block has changed if a tenth of its look-outs contradict, or if their mean is off by so many
standard errors; of fewer than eight nothing is said."""
MOVED_SHARE = 0.5
"""If half of the blocks have changed, it is the camera that moved, or another scene."""

Float32Array = npt.NDArray[np.float32]
BoolArray = npt.NDArray[np.bool_]


def contradicts(
    uv: npt.NDArray[np.int32], depth_mm: Float32Array, model_mm: Float32Array
) -> BoolArray:
    """Which measurements lie outside the range of the model about them, shape (n,).

    A miss contradicts nothing: much of what does not return does so now and then.
    """
    side = 2 * NEAR_PX + 1
    u, v = uv[:, 0], uv[:, 1]
    low = grey_erosion(model_mm, (side, side), mode="nearest")[v, u]
    high = grey_dilation(model_mm, (side, side), mode="nearest")[v, u]
    tolerance = np.maximum(AGREE_MM, AGREE_SHARE * model_mm[v, u])
    known = (depth_mm > 0) & (model_mm[v, u] > 0)
    return known & ((depth_mm < low - tolerance) | (depth_mm > high + tolerance))


def moved(
    uv: npt.NDArray[np.int32],
    depth_mm: Float32Array,
    model_mm: Float32Array,
    against: BoolArray,
    noise_mm: Float32Array,
) -> float:
    """Share of the blocks of the frame that have changed.

    Parameters
    ----------
    uv : int32 array of shape (n, 2)
        Look-outs, column first.
    depth_mm : float32 array of shape (n,)
        What they returned.
    model_mm : float32 array of shape (H, W)
        The model before them.
    against : bool array of shape (n,)
        Which contradicted it.
    noise_mm : float32 array of shape (n,)
        Standard deviation of each.
    """
    height, width = model_mm.shape
    block = uv[:, 1] * BLOCKS[0] // height * BLOCKS[1] + uv[:, 0] * BLOCKS[1] // width
    returned = depth_mm > 0
    off = np.clip((depth_mm - model_mm[uv[:, 1], uv[:, 0]]) / noise_mm, -3, 3)
    size = BLOCKS[0] * BLOCKS[1]
    looks = np.bincount(block[returned], minlength=size)
    share = np.bincount(block[against], minlength=size) / np.maximum(looks, 1)
    mean = np.bincount(block[returned], off[returned], minlength=size) / np.maximum(looks, 1)
    judged = looks >= BLOCK_LOOKS
    changed = (share > BLOCK_SHARE) | (np.abs(mean) * np.sqrt(looks) > DRIFTED)
    return float((changed & judged).sum() / max(judged.sum(), 1))


def around(uv: npt.NDArray[np.int32], shape: tuple[int, int]) -> npt.NDArray[np.int32]:
    """The four pixels `NEAR_PX` beside each, those that lie inside the frame, each once."""
    offsets = NEAR_PX * np.array([(-1, 0), (1, 0), (0, -1), (0, 1)], np.int32)
    beside = (uv[:, None] + offsets).reshape(-1, 2)
    inside = ((beside >= 0) & (beside < (shape[1], shape[0]))).all(axis=1)
    found: npt.NDArray[np.int32] = np.unique(beside[inside], axis=0)
    return found


class Extent:
    """How far a change reaches: every pixel is as its nearest look of this frame was.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the frame.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._looked = np.zeros(shape, np.bool_)
        self._against = np.zeros(shape, np.bool_)

    def add(self, uv: npt.NDArray[np.int32], against: BoolArray) -> None:
        """Take in looks, and which of them contradicted the memory."""
        self._looked[uv[:, 1], uv[:, 0]] = True
        self._against[uv[:, 1], uv[:, 0]] = against

    def changed(self) -> tuple[BoolArray, Float32Array]:
        """Where the nearest look contradicted, and how far a border of it is from any look."""
        nearest, gap_sq = nearest_sample(self._looked)
        changed = self._against.ravel()[nearest]
        side = (3, 3)
        label = changed.view(np.uint8)
        border = grey_dilation(label, side) != grey_erosion(label, side)
        return changed, np.where(border & (gap_sq > 1), np.sqrt(gap_sq), 0).astype(np.float32)
