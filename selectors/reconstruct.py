"""The multi-resolution model as a dense depth image: samples in, every pixel out.

The reconstruction is the same for every strategy that is compared, so that only the choice of
the samples differs: linear on the Delaunay triangles of the samples that returned depth, but no
triangle may bridge a hole or a discontinuity. A triangle does so if its vertices span more than
`STEP_MM` and one of its edges is longer than `BRIDGE_PX`; its pixels, and those outside the
convex hull, take the depth of their nearest sample.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from selective_depth.selectors.arrays import Floats, pixels_where, sample_pairs
from selective_depth.selectors.triangulation import Surface


def reconstruct(
    uv: npt.ArrayLike, depth_mm: npt.ArrayLike, shape: tuple[int, int], *, threads: int | None = None
) -> Floats:
    """Dense depth from samples: linear on Delaunay triangles, without bridging discontinuities.

    Parameters
    ----------
    uv : int array of shape (n, 2)
        Pixels of the samples, column first. Where one is given twice, the last counts.
    depth_mm : array of shape (n,)
        Their depth in millimetres; what is not a depth (see `measured_mm`) is left out.
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
    pixels, mm = sample_pairs(uv, depth_mm, shape)
    samples_mm = np.zeros(shape, np.float32)
    samples_mm[pixels[:, 1], pixels[:, 0]] = mm
    surface = Surface(shape, threads)
    surface.add(pixels_where(samples_mm), samples_mm[samples_mm > 0])
    return surface.layers.depth_mm
