"""The seed lattice: the first, sparse and regular measurements of a frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.frame import Camera, DepthFrame


def cell_centres(pixels: int, cells: int, name: str = "seeds") -> npt.NDArray[np.int32]:
    """Pixel at the centre of each of `cells` equal cells along an axis of `pixels` pixels.

    ``floor((i + 0.5) * pixels / cells)``, in integers so that no rounding moves a seed. If they do
    not fit, the error calls them by `name`.
    """
    if not 1 <= cells <= pixels:
        raise ValueError(
            f"{cells} {name} do not fit on {pixels} pixels; give between 1 and {pixels}"
        )
    return ((2 * np.arange(cells, dtype=np.int64) + 1) * pixels // (2 * cells)).astype(np.int32)


@dataclass(frozen=True, eq=False)
class SeedGrid:
    """Depth measured on a lattice of pixels: row first, as images are.

    Parameters
    ----------
    columns : int32 array of shape (C,)
        Image column of each lattice column, increasing.
    rows : int32 array of shape (R,)
        Image row of each lattice row, increasing.
    depth_mm : float32 array of shape (R, C)
        Depth of the seeds; 0 = no measurement (the seed stays in the lattice as missing).
    frame_shape : tuple of int
        Height and width of the frame in pixels.
    camera : Camera or None
        Intrinsics; None for a sensor that is no pinhole, whose metric points are then given.
    given_points_mm : float32 array of shape (R, C, 3), optional
        Metric points of a sensor without pinhole camera (x right, y down, z forward).
    """

    columns: npt.NDArray[np.int32]
    rows: npt.NDArray[np.int32]
    depth_mm: npt.NDArray[np.float32]
    frame_shape: tuple[int, int]
    camera: Camera | None
    given_points_mm: npt.NDArray[np.float32] | None = None

    @classmethod
    def from_frame(cls, frame: DepthFrame, shape: tuple[int, int] = (128, 128)) -> SeedGrid:
        """Take the seeds of a frame.

        Parameters
        ----------
        frame : DepthFrame
            The frame to sample.
        shape : tuple of int, default (128, 128)
            Rows and columns of the lattice (the paper, section V: 128x128, 5.33 % of 640x480).
        """
        return cls.from_array(frame.depth_mm, shape, camera=frame.camera)

    @classmethod
    def from_array(
        cls,
        depth_mm: npt.NDArray[np.generic],
        shape: tuple[int, int] = (128, 128),
        *,
        camera: Camera | None = None,
        points_mm: npt.NDArray[np.floating] | None = None,
    ) -> SeedGrid:
        """Take the seeds of a plain depth or range image, of any sensor.

        Parameters
        ----------
        depth_mm : array of shape (height, width)
            Depth or range in millimetres; 0, negative or not finite = no measurement.
        shape : tuple of int, default (128, 128)
            Rows and columns of the lattice.
        camera : Camera, optional
            Intrinsics of a pinhole sensor.
        points_mm : array of shape (height, width, 3), optional
            Metric points of a sensor that is no pinhole (a LiDAR, a laser scanner). With
            neither, a pinhole with a Kinect's field of view is assumed.

        Raises
        ------
        ValueError
            If an array's shape is wrong or the lattice does not fit.
        """
        if depth_mm.ndim != 2:
            raise ValueError(f"depth_mm must have shape (height, width), got {depth_mm.shape}")
        height, width = depth_mm.shape
        rows = cell_centres(height, shape[0], "rows of seeds")
        columns = cell_centres(width, shape[1], "columns of seeds")
        seeds = depth_mm[np.ix_(rows, columns)].astype(np.float32)
        seeds[~(np.isfinite(seeds) & (seeds > 0))] = 0
        given = None
        if points_mm is not None:
            if points_mm.shape != (height, width, 3):
                raise ValueError(
                    f"points_mm must have shape {(height, width, 3)}, got {points_mm.shape}"
                )
            given = points_mm[np.ix_(rows, columns)].astype(np.float32)
            given[seeds == 0] = np.nan
        elif camera is None:
            camera = Camera.kinect(width, height)
        return cls(columns, rows, seeds, (height, width), camera, given)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the lattice."""
        return len(self.rows), len(self.columns)

    @cached_property
    def valid(self) -> npt.NDArray[np.bool_]:
        """Which seeds returned depth, shape (R, C)."""
        return self.depth_mm > 0

    @cached_property
    def lattice_uv(self) -> npt.NDArray[np.int32]:
        """Pixel (column, row) of every seed, shape (R, C, 2)."""
        u, v = np.meshgrid(self.columns, self.rows)
        return np.stack((u, v), axis=-1)

    @cached_property
    def lattice_points_mm(self) -> npt.NDArray[np.float32]:
        """Metric point of every seed, shape (R, C, 3), NaN where missing."""
        if self.given_points_mm is not None:
            return self.given_points_mm
        assert self.camera is not None
        return self.camera.points_mm(self.lattice_uv, self.depth_mm)

    @cached_property
    def uv(self) -> npt.NDArray[np.int32]:
        """Pixels (column, row) of the seeds that returned depth, shape (n, 2), row by row."""
        return self.lattice_uv[self.valid]

    @cached_property
    def points_mm(self) -> npt.NDArray[np.float32]:
        """Metric points of the seeds that returned depth, shape (n, 3), row by row."""
        return np.ascontiguousarray(self.lattice_points_mm[self.valid])
