"""The seed lattice: the first, sparse and regular measurements of a frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.selectors.arrays import Bools, Floats, Ints, measured_mm, warn_of_metres
from selective_depth.selectors.nearby import nearest_points

Measure = Callable[[Ints], npt.ArrayLike]
"""A random-access depth sensor: pixels (n, 2), column first, to depth (n,) in mm, 0 = none."""


def cell_centres(pixels: int, cells: int, name: str = "seeds") -> Ints:
    """Pixel at the centre of each of `cells` equal cells along an axis of `pixels` pixels.

    ``floor((i + 0.5) * pixels / cells)``, in integers so that no rounding moves a seed. If they do
    not fit, the error calls them by `name`.
    """
    if not 1 <= cells <= pixels:
        raise ValueError(f"{cells} {name} do not fit on {pixels} pixels; give between 1 and {pixels}")
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
        Intrinsics; None for a sensor that is not a pinhole camera, whose metric points are then given.
    given_points_mm : float32 array of shape (R, C, 3), optional
        Metric points of a sensor without pinhole camera (x right, y down, z forward).
    """

    columns: Ints
    rows: Ints
    depth_mm: Floats
    frame_shape: tuple[int, int]
    camera: Camera | None
    given_points_mm: Floats | None = None

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
        depth_mm: npt.ArrayLike,
        shape: tuple[int, int] = (128, 128),
        *,
        camera: Camera | None = None,
        points_mm: npt.ArrayLike | None = None,
    ) -> SeedGrid:
        """Take the seeds of a plain depth or range image, of any sensor.

        Parameters
        ----------
        depth_mm : array of shape (height, width)
            Depth or range in millimetres; what is not a depth (see `measured_mm`) was not measured.
        shape : tuple of int, default (128, 128)
            Rows and columns of the lattice.
        camera : Camera, optional
            Intrinsics of a pinhole sensor.
        points_mm : array of shape (height, width, 3), optional
            Metric points of a sensor that is not a pinhole camera (a LiDAR, a laser scanner). With
            neither, a pinhole with a Kinect's field of view is assumed.

        Raises
        ------
        ValueError
            If an array's shape is wrong or the lattice does not fit.
        """
        if np.ndim(depth_mm) != 2:
            raise ValueError(f"depth_mm must have shape (height, width), got {np.shape(depth_mm)}")
        image = np.ma.asanyarray(depth_mm) if np.ma.isMA(depth_mm) else np.asarray(depth_mm)
        height, width = image.shape
        rows = cell_centres(height, shape[0], "rows of seeds")
        columns = cell_centres(width, shape[1], "columns of seeds")
        cells = np.ix_(rows, columns)
        seeds_mm = measured_mm(image[cells])
        given = None
        if points_mm is not None:
            if np.shape(points_mm) != (height, width, 3):
                raise ValueError(f"points_mm must have shape {(height, width, 3)}, got {np.shape(points_mm)}")
            points = np.ma.filled(np.ma.asarray(points_mm)[cells].astype(np.float32), np.nan)
            given = np.ascontiguousarray(points)
            given[seeds_mm == 0] = np.nan
        else:
            camera = camera or Camera.kinect(width, height)
            warn_of_metres(image, seeds_mm, "depth_mm")
        return cls(columns, rows, seeds_mm, (height, width), camera, given)

    @classmethod
    def measured(
        cls,
        measure: Measure,
        shape: tuple[int, int],
        seeds: tuple[int, int] = (128, 128),
        *,
        camera: Camera | None = None,
    ) -> SeedGrid:
        """Take the seeds from a sensor that is asked pixel by pixel; no frame is needed.

        Parameters
        ----------
        measure : callable
            The sensor: pixels (n, 2), column first, to depth (n,) in millimetres. Asked once.
        shape : tuple of int
            Height and width of what it can see, in pixels.
        seeds : tuple of int, default (128, 128)
            Rows and columns of the lattice.
        camera : Camera, optional
            Intrinsics; by default a pinhole with a Kinect's field of view is assumed.

        Raises
        ------
        ValueError
            If the lattice does not fit or the sensor does not answer with a depth per pixel.

        Examples
        --------
        >>> grid = SeedGrid.measured(lambda uv: 1000 + uv[:, 0], (48, 64), seeds=(12, 16))
        >>> grid.depth_mm[0, :3].tolist()
        [1002.0, 1006.0, 1010.0]
        """
        height, width = shape
        grid = cls(
            cell_centres(width, seeds[1], "columns of seeds"),
            cell_centres(height, seeds[0], "rows of seeds"),
            np.zeros(seeds, np.float32),
            (height, width),
            camera or Camera.kinect(width, height),
        )
        _, mm = answers(measure, grid.lattice_uv.reshape(-1, 2))
        return replace(grid, depth_mm=mm.reshape(seeds))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the lattice."""
        return len(self.rows), len(self.columns)

    @cached_property
    def valid(self) -> Bools:
        """Which seeds returned depth, shape (R, C)."""
        return self.depth_mm > 0

    @cached_property
    def lattice_uv(self) -> Ints:
        """Pixel (column, row) of every seed, shape (R, C, 2)."""
        u, v = np.meshgrid(self.columns, self.rows)
        return np.stack((u, v), axis=-1)

    @cached_property
    def lattice_points_mm(self) -> Floats:
        """Metric point of every seed, shape (R, C, 3), NaN where missing."""
        if self.given_points_mm is not None:
            return self.given_points_mm
        return self.points_at(self.lattice_uv, self.depth_mm)

    @cached_property
    def uv(self) -> Ints:
        """Pixels (column, row) of the seeds that returned depth, shape (n, 2), row by row."""
        return self.lattice_uv.reshape(-1, 2).take(self._returned, axis=0)

    @cached_property
    def points_mm(self) -> Floats:
        """Metric points of the seeds that returned depth, shape (n, 3), row by row."""
        return self.lattice_points_mm.reshape(-1, 3).take(self._returned, axis=0)

    @cached_property
    def _returned(self) -> npt.NDArray[np.intp]:
        """Numbers of the seeds that returned depth: to take by these is ten times as fast as by `valid`."""
        return np.flatnonzero(self.valid)

    def points_at(self, uv: Ints, depth_mm: Floats) -> Floats:
        """Metric points of pixels (..., 2) of the frame with these depths, shape (..., 3).

        Without a camera, the rays between the seeds' own are interpolated.

        Raises
        ------
        ValueError
            If there is neither a camera nor the seeds' metric points.
        """
        if self.camera is not None:
            return self.camera.points_mm(uv, depth_mm)
        if self.given_points_mm is None:
            raise ValueError(
                "the seeds have neither a camera nor metric points; give SeedGrid a camera, or"
                " use SeedGrid.from_array(..., points_mm=...)"
            )
        # Rays of the nearest seeds in the image, the nearer the heavier; at a seed its own.
        rays = self.points_mm / self.depth_mm[self.valid][:, None]
        distance, index = nearest_points(self.uv, uv, 4)
        weight = 1 / (distance**2 + 1e-9)
        weight /= weight.sum(axis=-1, keepdims=True)
        ray = (rays[index] * weight[..., None]).sum(axis=-2)
        return np.asarray(ray * depth_mm[..., None], np.float32)


def answers(measure: Measure, uv: Ints) -> tuple[npt.NDArray[np.generic], Floats]:
    """Ask a sensor for pixels (n, 2): its own answer, and depth (n,) in mm, 0 = no return.

    Raises
    ------
    ValueError
        If it does not answer with one number per pixel.
    IndexError
        The sensor's own, with a hint at the order of columns and rows.
    """
    try:
        answer = measure(uv)
    except IndexError as error:
        raise IndexError(
            f"the sensor was asked for {len(uv)} pixels, column first, and failed: {error}; of an"
            " image it is to return image[uv[:, 1], uv[:, 0]]"
        ) from error
    mm = measured_mm(answer, "the sensor's answer")
    if mm.shape != (len(uv),):
        raise ValueError(
            f"the sensor was asked for {len(uv)} pixels and answered with shape {mm.shape}; it must"
            " return one depth per pixel"
        )
    return np.ma.getdata(answer), mm
