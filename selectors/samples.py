"""What has been measured so far, kept so that the neighbourhood of a pixel is found quickly."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.frame import Camera
from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Bools, Floats, Ints, pixels_where, sample_pairs
from selective_depth.selectors.seeds import SeedGrid
from selective_depth.selectors.triangulation import FAR_SQ, nearest_sample

MISSED = np.float32(-1)
"""In an image of samples: measured, but nothing returned."""

REACH = 1.3
"""Farther than so many steps of the lattice from every sample that returned depth, a shot would
mostly hit a hole: 6.5 pixels for 128x128 seeds on 640x480."""

_WORD = 64


@njit(cache=True, nogil=True)
def _record(uv: Ints, depth_mm: Floats, image_mm: Floats, bits: npt.NDArray[np.uint64]) -> None:
    for i in range(len(uv)):
        u, v = uv[i, 0], uv[i, 1]
        bits[v, (u >> 6) + 1] |= np.uint64(1) << np.uint64(u & 63)
        image_mm[v, u] = depth_mm[i] if depth_mm[i] > 0 else MISSED


def seed_pitch_px(seeds: SeedGrid) -> float:
    """Pitch of a seed lattice in pixels: along rows or columns, the wider."""
    return max(n / cells for n, cells in zip(seeds.frame_shape, seeds.shape, strict=True))


class Samples:
    """The measurements of one frame so far: an image of them, and an index over it.

    Parameters
    ----------
    frame_shape : tuple of int
        Height and width of the frame in pixels.
    pitch_px : float, default 5
        Pitch of the seed lattice, the wider of the two and the scale of all distances: 5 for
        128x128 seeds on 640x480.
    seeds : SeedGrid, optional
        The lattice that all began with, for the selectors that think in its cells and for metric
        points; by default one of that pitch on which nothing was measured, of a Kinect.

    Attributes
    ----------
    reach_px : float
        1.3 pitches: no shot farther than this from a sample that returned depth, for it would
        mostly hit a hole (6.5 pixels for 128x128 seeds).
    vote_px : int
        1.8 pitches, at most 21: samples farther than this from a pixel have no say about it. (So
        much, on both sides, fits in one word of `bits`.)
    image_mm : float32 array of shape (H, W)
        Depth where a measurement returned, `MISSED` where one did not, 0 where none was made.
    bits : uint64 array of shape (H, words)
        One bit per measured pixel; a word of zeros on either side spares the borders.
    additions : int
        How often measurements were added.
    nearest_mm : float
        Least depth that returned; infinite before the first.
    """

    def __init__(self, frame_shape: tuple[int, int], pitch_px: float = 5.0, seeds: SeedGrid | None = None) -> None:
        height, width = self.frame_shape = frame_shape
        self.pitch_px = pitch_px
        self._seeds = seeds
        self.vote_px = min(math.ceil(1.8 * pitch_px), (_WORD - 1) // 3)
        self.reach_px = min(REACH * pitch_px, self.vote_px)
        self.image_mm = np.zeros(frame_shape, np.float32)
        self.bits = np.zeros((height, (width + _WORD - 1) // _WORD + 2), np.uint64)
        self.additions = 0
        self.nearest_mm = math.inf
        self._added: list[tuple[Ints, Floats]] = []

    @classmethod
    def of(cls, seeds: SeedGrid | Samples, pitch_px: float | None = None) -> Samples:
        """The seeds of a frame as its first samples, or samples as they are.

        The scale is the seeds' own pitch by default.
        """
        if isinstance(seeds, Samples):
            return seeds
        samples = cls(seeds.frame_shape, pitch_px or seed_pitch_px(seeds), seeds)
        samples.add(seeds.lattice_uv.reshape(-1, 2), seeds.depth_mm.ravel())
        return samples

    def add(self, uv: npt.ArrayLike, depth_mm: npt.ArrayLike) -> None:
        """Book measurements.

        Parameters
        ----------
        uv : int array of shape (n, 2)
            Pixels, column first. Of several at one pixel the last counts.
        depth_mm : array of shape (n,)
            Depth in millimetres; what is not a depth (see `measured_mm`) was a shot that returned
            nothing.

        Raises
        ------
        ValueError
            If the shapes do not fit or a pixel lies outside the frame.
        """
        self.book(*sample_pairs(uv, depth_mm, self.frame_shape))

    def book(self, pixels: Ints, mm: Floats) -> None:
        """As `add`, of what is known to be pixels of the frame and depths, 0 where none returned."""
        self.additions += 1
        self.nearest_mm = min(self.nearest_mm, float(mm[mm > 0].min(initial=np.inf)))
        self._added.append((pixels, mm))
        _record(pixels, mm, self.image_mm, self.bits)

    def added_since(self, addition: int) -> Iterator[tuple[Ints, Floats]]:
        """Pixels and depths (0 = no return) of every addition after one of that number."""
        return iter(self._added[addition:])

    @property
    def seeds(self) -> SeedGrid:
        """The lattice that all began with; its depths are in `image_mm` like all others."""
        if self._seeds is None:
            lattice = [max(round(pixels / self.pitch_px), 1) for pixels in self.frame_shape]
            nothing = np.zeros(self.frame_shape, np.uint16)
            self._seeds = SeedGrid.from_array(nothing, (lattice[0], lattice[1]))
        return self._seeds

    @property
    def camera(self) -> Camera | None:
        """Intrinsics; None for a sensor that is not a pinhole camera."""
        return self.seeds.camera

    @property
    def uv(self) -> Ints:
        """Pixels (column, row) of the samples that returned depth, shape (n, 2), row by row."""
        return pixels_where(self.image_mm > 0)

    @property
    def depth_mm(self) -> Floats:
        """Their depths, shape (n,)."""
        return self.image_mm[self.image_mm > 0]

    @property
    def points_mm(self) -> Floats:
        """Their metric points, shape (n, 3)."""
        return self.seeds.points_at(self.uv, self.depth_mm)

    def gap_px(self) -> Floats:
        """Distance of every pixel to the nearest return, (H, W); infinite if there is none."""
        _, gap_sq = nearest_sample(self.image_mm > 0)
        gap = np.sqrt(gap_sq, dtype=np.float32)
        gap[gap_sq == FAR_SQ] = np.inf
        return gap

    def open(self) -> Bools:
        """Pixels that may be shot, (H, W): not measured yet, and within reach of a return."""
        return np.asarray((self.image_mm == 0) & (self.gap_px() <= self.reach_px))
