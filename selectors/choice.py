"""Which pixels to measure, given what each is worth: the best, but not in clumps.

Any score will do, of any selector or of one's own: `choose` turns it into pixels.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import checked_map
from selective_depth.selectors.parallel import in_bands

CROWDED = 0.3
"""Factor on the worth of a pixel beside a better one, whose shot will mostly tell the same.

With 1 shots clump; with 0 (3x3 maxima first, whatever they are worth) they are wasted on maxima
of nothing as soon as the good ones are gone. Between .2 and .7 it hardly matters."""

_TILE_PX = 16
_SAMPLED = 31  # shares no factor with the usual widths of images


@njit(cache=True, nogil=True)
def _gather(
    score: npt.NDArray[np.float32],
    tiles: npt.NDArray[np.int64],
    tile_px: int,
    least: float,
    crowded: float,
    pixel: npt.NDArray[np.int64],
    worth: npt.NDArray[np.float32],
    first: int,
    end: int,
) -> int:
    """Pixels of the tiles first..end worth at least `least`, written from first's place on."""
    height, width = score.shape
    tile_columns = (width + tile_px - 1) // tile_px
    at = first * tile_px * tile_px
    for k in range(first, end):
        top, left = tiles[k] // tile_columns * tile_px, tiles[k] % tile_columns * tile_px
        for v in range(top, min(top + tile_px, height)):
            for u in range(left, min(left + tile_px, width)):
                s = score[v, u]
                if s <= 0 or s < least:
                    continue
                better = False
                for y in range(max(v - 1, 0), min(v + 2, height)):
                    for x in range(max(u - 1, 0), min(u + 2, width)):
                        better |= score[y, x] > s
                if better:
                    s *= np.float32(crowded)
                    if s < least:
                        continue
                pixel[at] = v * width + u
                worth[at] = s
                at += 1
    return at - first * tile_px * tile_px


def best_pixels(
    score: npt.NDArray[np.float32],
    tiles: npt.NDArray[np.int64],
    shots: int,
    least: float,
    tile_px: int,
    threads: int | None = None,
    crowded: float = CROWDED,
) -> tuple[npt.NDArray[np.int32], np.float32]:
    """The pixels of some tiles that are worth most, and what the last of them is worth.

    Parameters
    ----------
    score : float32 array of shape (H, W)
        Worth of a shot at each pixel; those with 0 are never chosen.
    tiles : int array
        Tiles to choose from, numbered row by row.
    shots : int
        How many pixels at most.
    least : float
        Pixels worth less are left out.
    tile_px : int
        Side of the tiles.
    threads : int, optional
        Kernel threads.
    crowded : float, default `CROWDED`
        Factor on pixels with a better one among their eight neighbours.

    Returns
    -------
    uv : int32 array of shape (n, 2)
        Column first, row by row of the image; n <= shots.
    worst : float32
        Worth of the last one chosen, 0 if there is none.
    """
    room = len(tiles) * tile_px * tile_px
    pixel, worth = np.empty(room, np.int64), np.empty(room, np.float32)
    parts: list[tuple[int, int]] = []

    def band(first: int, end: int) -> None:
        count = _gather(score, tiles, tile_px, least, crowded, pixel, worth, first, end)
        parts.append((first * tile_px * tile_px, count))

    if shots > 0 and len(tiles):
        in_bands(band, len(tiles), threads)
    runs = [slice(start, start + count) for start, count in sorted(parts)]
    pixel = np.concatenate([pixel[run] for run in runs]) if runs else pixel[:0]
    worth = np.concatenate([worth[run] for run in runs]) if runs else worth[:0]
    if len(pixel) > shots:
        worst = np.partition(worth, len(worth) - shots)[-shots]
        sure = worth > worst
        ties = np.flatnonzero(worth == worst)
        # Of equals, take some from everywhere rather than the topmost.
        scatter = (pixel[ties] * 2654435761) & 0xFFFFFFFF
        sure[ties[np.argsort(scatter)[: shots - np.count_nonzero(sure)]]] = True
        pixel, worth = pixel[sure], worth[sure]
    else:
        worst = worth.min() if len(worth) else np.float32(0)
    pixel.sort()
    width = score.shape[1]
    return np.stack((pixel % width, pixel // width), axis=-1).astype(np.int32), worst


def choose(
    score: npt.ArrayLike, shots: int, *, crowded: float = CROWDED, threads: int | None = None
) -> npt.NDArray[np.int32]:
    """The pixels of a map that are worth most.

    Parameters
    ----------
    score : array of shape (H, W)
        Worth of a shot at each pixel; where it is 0, negative, NaN or masked, none is made.
    shots : int
        How many pixels at most.
    crowded : float, default `CROWDED`
        Factor on pixels with a better one among their eight neighbours.
    threads : int, optional
        Kernel threads; default `default_threads()`.

    Returns
    -------
    int32 array of shape (n, 2)
        Column first, row by row of the image; n <= shots. Of equals, some from everywhere.

    Raises
    ------
    ValueError
        If the score is no image of numbers or `shots` is negative.

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
    worth = checked_map(score, np.shape(score), "score")
    count = -(-worth.shape[0] // _TILE_PX) * -(-worth.shape[1] // _TILE_PX)
    tiles = np.arange(count)
    # Most pixels are out of the question: a sample of them says where to draw a safe line.
    some = worth.ravel()[::_SAMPLED]
    rank = 4 * shots // _SAMPLED
    least = float(np.partition(some, len(some) - rank)[-rank]) if 0 < rank < len(some) else 0.0
    uv, _ = best_pixels(worth, tiles, shots, least, _TILE_PX, threads, crowded)
    if len(uv) < shots and least > 0:
        uv, _ = best_pixels(worth, tiles, shots, 0.0, _TILE_PX, threads, crowded)
    return uv
