"""Which pixels to measure, given what each is worth: the best, but not in clumps.

Any score will do, of any selector or of one's own: `choose` turns it into pixels.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Floats, Ints, checked_map

CROWDED = 0.3
"""Factor on the worth of a pixel beside a better one, whose shot will mostly tell the same.

With 1 shots clump; with 0 (3x3 maxima first, whatever they are worth) they are wasted on maxima
of nothing as soon as the good ones are gone. Between .2 and .7 it hardly matters."""

_BLOCK = 32  # pixels of a row that are passed over together if none of them is worth enough
_SAMPLED = 31  # shares no factor with the usual widths of images


@njit(cache=True, nogil=True)
def _gather(score: Floats, least: float, crowded: float, uv: Ints, worth: Floats) -> int:
    """List the pixels worth at least `least`, row by row; how many is returned."""
    height, width = score.shape
    limit = np.float32(least)
    count = 0
    for v in range(height):
        for left in range(0, width, _BLOCK):
            block = score[v, left : left + _BLOCK]
            some = np.int32(0)
            for k in range(len(block)):  # without a branch, it is asked of many pixels at once
                some |= np.int32((block[k] >= limit) & (block[k] > 0))
            if not some:
                continue
            for u in range(left, left + len(block)):
                s = score[v, u]
                if s <= 0 or s < limit:
                    continue
                left_of, right_of = max(u - 1, 0), min(u + 1, width - 1)
                better = (score[v, left_of] > s) | (score[v, right_of] > s)
                for y in (max(v - 1, 0), min(v + 1, height - 1)):
                    better |= (score[y, left_of] > s) | (score[y, u] > s) | (score[y, right_of] > s)
                if better:
                    s *= np.float32(crowded)
                    if s < limit:
                        continue
                uv[count, 0], uv[count, 1], worth[count] = u, v, s
                count += 1
    return count


def _best(score: Floats, shots: int, least: float, crowded: float) -> Ints:
    """The pixels worth most, and `least` at the least, row by row of the image."""
    uv, worth = np.empty((score.size, 2), np.int32), np.empty(score.size, np.float32)
    count = _gather(score, least, crowded, uv, worth) if shots > 0 else 0
    uv, worth = uv[:count].copy(), worth[:count]
    if count > shots:
        last = np.partition(worth, count - shots)[-shots]
        sure = worth > last
        ties = np.flatnonzero(worth == last)
        # Of equals, take some from everywhere rather than the topmost.
        scatter = (uv[ties] @ np.array((1, score.shape[1])) * 2654435761) & 0xFFFFFFFF
        sure[ties[np.argsort(scatter)[: shots - np.count_nonzero(sure)]]] = True
        uv = uv[sure]
    return uv


def choose(score: npt.ArrayLike, shots: int, *, crowded: float = CROWDED) -> Ints:
    """The pixels of a map that are worth most.

    Parameters
    ----------
    score : array of shape (H, W)
        Worth of a shot at each pixel; where it is 0, negative, NaN or masked, none is made.
    shots : int
        How many pixels at most.
    crowded : float, default `CROWDED`
        Factor on pixels with a better one among their eight neighbours.

    Returns
    -------
    int32 array of shape (n, 2)
        Column first, row by row of the image; n <= shots. Of equals, some from everywhere.

    Raises
    ------
    ValueError
        If the score is not an image of numbers or `shots` is negative.

    Examples
    --------
    >>> choose([[0, 5, 0], [0, 0, 0], [2, 0, 1]], 2)
    array([[1, 0],
           [0, 2]], dtype=int32)
    """
    if np.ndim(score) != 2:
        raise ValueError(f"score must have shape (height, width), got {np.shape(score)}")
    if shots < 0:
        raise ValueError(f"shots is {shots}; give 0 or more")
    return best_pixels(checked_map(score, np.shape(score), "score"), shots, crowded=crowded)


def best_pixels(worth: Floats, shots: int, *, crowded: float = CROWDED) -> Ints:
    """As `choose`, of a map known to be float32, whole in memory and nowhere negative or NaN."""
    # Most pixels are out of the question: a sample of them says where to draw a safe line.
    some = worth.ravel()[::_SAMPLED]
    rank = 3 * shots // _SAMPLED
    while True:
        least = float(np.partition(some, len(some) - rank)[-rank]) if 0 < rank < len(some) else 0.0
        uv = _best(worth, shots, least, crowded)
        if len(uv) == shots or least <= 0:
            return uv
        rank *= 2
