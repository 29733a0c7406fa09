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

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.parallel import in_bands
from selective_depth.selectors.triangulation import Mesh

STEP_MM = 50.0
"""Depth span of a triangle's vertices above which it may be a bridge, millimetres."""

BRIDGE_PX = 10.0
"""Edge length above which such a triangle is one, pixels."""

_FAR = 1 << 20  # farther than any row of any image, and its square fits in 64 bits


@njit(cache=True, nogil=True)
def _nearest_row_in_column(
    valid: npt.NDArray[np.bool_], nearest_row: npt.NDArray[np.int32], first: int, end: int
) -> None:
    """Per pixel of the columns first..end, the nearest row of its column with a sample."""
    height = valid.shape[0]
    for u in range(first, end):
        last = -_FAR
        for v in range(height):
            if valid[v, u]:
                last = v
            nearest_row[v, u] = last
        last = _FAR
        for v in range(height - 1, -1, -1):
            if valid[v, u]:
                last = v
            if last - v < v - nearest_row[v, u]:
                nearest_row[v, u] = last


@njit(cache=True, nogil=True)
def _nearest_along_rows(
    nearest_row: npt.NDArray[np.int32],
    nearest_uv: npt.NDArray[np.int32],
    first: int,
    end: int,
) -> None:
    """Lower envelope of the columns' parabolas, row by row: the exact nearest sample."""
    width = nearest_row.shape[1]
    column = np.empty(width, np.int64)  # of the parabolas on the envelope
    height_sq = np.empty(width, np.int64)
    start = np.empty(width, np.int64)  # first pixel on which each is the lowest
    for v in range(first, end):
        top = -1
        for u in range(width):
            gap = np.int64(nearest_row[v, u]) - v
            if gap >= _FAR // 2 or gap <= -(_FAR // 2):
                continue
            g = gap * gap
            begin = np.int64(0)
            while top >= 0:
                # First integer pixel at which column u beats the envelope's last column.
                p = column[top]
                begin = (u * u - p * p + g - height_sq[top]) // (2 * (u - p)) + 1
                if begin <= start[top]:
                    top -= 1
                else:
                    break
            if top < 0:
                begin = np.int64(0)
            if begin < width:
                top += 1
                column[top] = u
                height_sq[top] = g
                start[top] = begin
        for u in range(width - 1, -1, -1):
            if top < 0:
                nearest_uv[v, u, 0] = -1
                nearest_uv[v, u, 1] = -1
                continue
            while start[top] > u:
                top -= 1
            nearest_uv[v, u, 0] = column[top]
            nearest_uv[v, u, 1] = nearest_row[v, column[top]]


def nearest_sample(
    valid: npt.NDArray[np.bool_], threads: int | None = None
) -> npt.NDArray[np.int32]:
    """Nearest sample of every pixel, exactly, in time linear in the pixels.

    Parameters
    ----------
    valid : bool array of shape (H, W)
        Where there is a sample.
    threads : int, optional
        Kernel threads; default `default_threads()`.

    Returns
    -------
    int32 array of shape (H, W, 2)
        Its pixel (column, row); -1 where there is no sample at all. Of equally near samples,
        any one.

    Notes
    -----
    The two-phase distance transform of Meijster, Roerdink and Hesselink (2000), which keeps
    the sample instead of the distance: a k-d tree needs about 1 us a pixel.
    """
    height, width = valid.shape
    nearest_row = np.empty((height, width), np.int32)
    nearest_uv = np.empty((height, width, 2), np.int32)
    in_bands(
        lambda first, end: _nearest_row_in_column(valid, nearest_row, first, end), width, threads
    )
    in_bands(
        lambda first, end: _nearest_along_rows(nearest_row, nearest_uv, first, end),
        height,
        threads,
    )
    return nearest_uv


@njit(cache=True, nogil=True)
def _draw_triangles(
    uv: npt.NDArray[np.int32],
    depth_mm: npt.NDArray[np.float32],
    triangles: npt.NDArray[np.int32],
    step_mm: float,
    bridge_px: float,
    out_mm: npt.NDArray[np.float32],
    first: int,
    end: int,
) -> None:
    """Linear depth of the triangles that bridge nothing, on the rows first..end."""
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        v0, v1, v2 = uv[a, 1], uv[b, 1], uv[c, 1]
        top = max(min(v0, v1, v2), first)
        bottom = min(max(v0, v1, v2), end - 1)
        if top > bottom:
            continue
        u0, u1, u2 = uv[a, 0], uv[b, 0], uv[c, 0]
        z0, z1, z2 = depth_mm[a], depth_mm[b], depth_mm[c]
        if max(z0, z1, z2) - min(z0, z1, z2) > step_mm:
            longest = max(
                (u0 - u1) ** 2 + (v0 - v1) ** 2,
                (u1 - u2) ** 2 + (v1 - v2) ** 2,
                (u2 - u0) ** 2 + (v2 - v0) ** 2,
            )
            if longest > bridge_px * bridge_px:
                continue
        area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
        if area == 0:
            continue
        sign = 1 if area > 0 else -1
        left, right = min(u0, u1, u2), max(u0, u1, u2)
        for v in range(top, bottom + 1):
            for u in range(left, right + 1):
                w1 = ((u - u0) * (v2 - v0) - (u2 - u0) * (v - v0)) * sign
                w2 = ((u1 - u0) * (v - v0) - (u - u0) * (v1 - v0)) * sign
                w0 = area * sign - w1 - w2
                if w0 >= 0 and w1 >= 0 and w2 >= 0:
                    out_mm[v, u] = (w0 * z0 + w1 * z1 + w2 * z2) / (area * sign)


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
    valid = samples_mm > 0
    if not valid.any():
        return samples_mm
    rows, columns = np.nonzero(valid)
    kept_uv = np.stack((columns, rows), axis=-1).astype(np.int32)
    kept_mm = samples_mm[rows, columns]
    mesh = Mesh.of(kept_uv)
    triangles = np.empty((0, 3), np.int32) if mesh is None else mesh.real_triangles()
    nearest = nearest_sample(valid, threads)
    out_mm = samples_mm[nearest[..., 1], nearest[..., 0]]
    in_bands(
        lambda first, end: _draw_triangles(
            kept_uv, kept_mm, triangles, STEP_MM, BRIDGE_PX, out_mm, first, end
        ),
        shape[0],
        threads,
    )
    return out_mm


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
