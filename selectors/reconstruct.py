"""The multi-resolution model as a dense depth image: samples in, every pixel out.

The reconstruction is the same for every strategy that is compared, so that only the choice of
the samples differs: linear on the Delaunay triangles of the samples that returned depth, but no
triangle may bridge a hole or a depth step. A triangle does so if its vertices span more than
`STEP_MM` and one of its edges is longer than `BRIDGE_PX`; its pixels, and those outside the
convex hull, take the depth of their nearest sample.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from selective_depth.selectors.triangulation import Surface


def reconstruct(
    uv: npt.NDArray[np.integer],
    depth_mm: npt.NDArray[np.generic],
    shape: tuple[int, int],
    *,
    threads: int | None = None,
) -> npt.NDArray[np.float32]:
    """Dense depth from samples: linear on Delaunay triangles, without bridging depth steps.

    Parameters
    ----------
    uv : int array of shape (n, 2)
        Pixels of the samples, column first. Where one is given twice, the last counts.
    depth_mm : array of shape (n,)
        Their depth in millimetres; 0 = no return, such samples are left out.
    shape : tuple of int
        Height and width of the image in pixels.
    threads : int, optional
        Kernel threads; default `default_threads()`.

    Returns
    -------
    float32 array of shape (H, W)
        Depth in millimetres at every pixel; 0 everywhere if no sample returned depth.

    Raises
    ------
    ValueError
        If the shapes do not fit together or a pixel lies outside the image.
    """
    samples_mm = samples_image(uv, depth_mm, shape)
    rows, columns = np.nonzero(samples_mm)
    surface = Surface(shape, threads)
    surface.add(np.stack((columns, rows), axis=-1).astype(np.int32), samples_mm[rows, columns])
    return surface.layers.depth_mm


def samples_image(
    uv: npt.NDArray[np.integer], depth_mm: npt.NDArray[np.generic], shape: tuple[int, int]
) -> npt.NDArray[np.float32]:
    """Samples that returned depth on their pixels, float32 (H, W), 0 elsewhere; checked."""
    uv = np.asarray(uv)
    depth_mm = np.asarray(depth_mm)
    height, width = shape
    if uv.ndim != 2 or uv.shape[1] != 2 or depth_mm.shape != (len(uv),):
        raise ValueError(
            "samples are uv of shape (n, 2), column first, and depth_mm of shape (n,); got"
            f" {uv.shape} and {depth_mm.shape}"
        )
    if len(uv) and (uv.min() < 0 or uv[:, 0].max() >= width or uv[:, 1].max() >= height):
        raise ValueError(
            f"a sample lies outside the image of {width}x{height} pixels: columns"
            f" {uv[:, 0].min()} to {uv[:, 0].max()}, rows {uv[:, 1].min()} to {uv[:, 1].max()}"
        )
    image = np.zeros(shape, np.float32)
    image[uv[:, 1], uv[:, 0]] = depth_mm
    image[~(np.isfinite(image) & (image > 0))] = 0
    return image
