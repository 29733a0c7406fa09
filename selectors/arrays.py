"""What comes in: the one check of every array that is given to a selector.

A depth counts as measured if it is finite and 0 < depth <= `FARTHEST_MM`. Everything else that a
sensor, a renderer or a file may write for "nothing" is missing: 0, negative, NaN, infinite,
masked, or the huge number of a ray that met nothing. `app/docs/arrays.md` lists every function.
"""

from __future__ import annotations

import warnings

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]
Bytes = npt.NDArray[np.uint8]
"""Arrays by what they hold: depths and scores, exact sums, pixels, places, masks, counts."""

FARTHEST_MM = 1e7
"""10 km: no depth sensor sees farther, and its square and its variance are good in 32 bits."""

_METRES = 100.0
"""Depths in floats that are all below this many millimetres are likely to be metres."""


def measured_mm(depth: npt.ArrayLike, name: str = "depth_mm") -> Floats:
    """Depth in millimetres, whole in memory, 0 where there is no measurement; always a copy.

    Parameters
    ----------
    depth : array-like of any shape
        Numbers of any kind, byte order and layout; masked elements are missing.
    name : str
        What an error calls it.

    Returns
    -------
    float32 array of the same shape

    Raises
    ------
    ValueError
        If it holds no real numbers.
    """
    given = np.ma.getdata(depth)
    if given.dtype.kind not in "uif":
        raise ValueError(f"{name} is of type {given.dtype}; give numbers, depth in millimetres and 0 for none")
    with np.errstate(over="ignore"):  # of a double: infinite, and so missing
        mm = np.array(given, np.float32, order="C")
    mm[~((mm > 0) & (mm <= FARTHEST_MM)) | np.ma.getmask(depth)] = 0
    return mm


def warn_of_metres(given: npt.ArrayLike, mm: Floats, name: str) -> None:
    """Say it if depths look like metres: in floats, and none as far as 10 cm."""
    farthest = float(mm.max(initial=0))
    if np.ma.getdata(given).dtype.kind == "f" and 0 < farthest < _METRES:
        warnings.warn(
            f"the greatest depth in {name} is {farthest:g} mm; if these are metres, multiply by 1000", stacklevel=3
        )


def pixels_in(uv: npt.ArrayLike, shape: tuple[int, int], name: str = "uv") -> Ints:
    """Pixels of a frame, column first: int32 of shape (n, 2), whole in memory.

    Raises
    ------
    ValueError
        If they are not whole numbers of that shape, some are masked, or one lies outside the
        frame; it says so where rows seem to have been given first.
    """
    given = np.ma.getdata(uv)
    height, width = shape
    if given.ndim != 2 or given.shape[1] != 2 or (given.dtype.kind not in "ui" and given.size):
        raise ValueError(f"{name} must be whole numbers of shape (n, 2), column first, got {given.dtype} {given.shape}")
    if np.ma.getmask(uv).any():
        raise ValueError(f"{name} has masked elements; leave out the pixels that are not meant")
    if len(given):
        # Column by column: along the other axis it takes 30 times as long.
        low, high = ([end(given[:, axis]) for axis in (0, 1)] for end in (np.min, np.max))
        if min(low) < 0 or high[0] >= width or high[1] >= height:
            swapped = min(low) >= 0 and high[1] < width and high[0] < height
            raise ValueError(
                f"a pixel of {name} lies outside the frame of {width}x{height} pixels: columns"
                f" {low[0]} to {high[0]}, rows {low[1]} to {high[1]}"
                + ("; the row seems to come first, give (column, row)" if swapped else "")
            )
    return np.ascontiguousarray(given, np.int32)


def pixels_where(image: npt.NDArray[np.generic]) -> Ints:
    """Pixels, column first, at which an image is not 0: shape (n, 2), row by row."""
    rows, columns = np.nonzero(image)
    return np.stack((columns, rows), axis=-1).astype(np.int32)


def sample_pairs(uv: npt.ArrayLike, depth_mm: npt.ArrayLike, shape: tuple[int, int]) -> tuple[Ints, Floats]:
    """Pixels and their depths, checked and of one length; see `pixels_in` and `measured_mm`."""
    pixels, mm = pixels_in(uv, shape), measured_mm(depth_mm)
    if mm.shape != (len(pixels),):
        raise ValueError(
            "samples are uv of shape (n, 2), column first, and depth_mm of shape (n,); got"
            f" {pixels.shape} and {mm.shape}"
        )
    return pixels, mm


def checked_map(values: npt.ArrayLike, shape: tuple[int, int], name: str) -> Floats:
    """A worth for every pixel of a frame, float32, 0 where it is masked, negative or no number.

    Raises
    ------
    ValueError
        If it is not an array of real numbers of the frame's shape.
    """
    given = np.ma.getdata(values)
    if given.shape != shape or given.dtype.kind not in "buif":
        raise ValueError(f"{name} must be a number for every pixel, of shape {shape}, got {given.dtype} {given.shape}")
    greatest = np.finfo(np.float32).max
    with np.errstate(over="ignore"):
        worth = np.array(given, np.float32, order="C")
    worth[~(worth > 0) | np.ma.getmask(values)] = 0
    return np.minimum(worth, greatest, out=worth)
