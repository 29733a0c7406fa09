"""Regions from neural gas nodes: Delaunay triangles whose edges are short (section III)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.arrays import Bools, Floats, Ints
from selective_depth.selectors.even import even_rank, spread
from selective_depth.selectors.selection import Selection
from selective_depth.selectors.triangulation import Mesh

EdgeMetric = Literal["3d", "image"]
"""Where the length of an edge is measured: in space (mm) or in the image (pixels)."""

_KEPT, _LONG = 1, 2  # 0 is outside of all triangles
_STEPS_PER_PX = 8.0
_STEPS = 2.0**14  # along the longer side at most: the largest the exact predicates are sure for


@dataclass(frozen=True, eq=False)
class RegionSelection(Selection):
    """Neural gas nodes, their triangulation, and the regions read from it.

    Besides `mask`, the triangles that survive (the published rule), and `score`, how dense the
    nodes are inside it: 1 - longest edge / threshold of the pixel's triangle, 0 elsewhere.

    Parameters
    ----------
    nodes_mm : float32 array of shape (N, 3)
        Nodes in space: x right, y down, z forward, mm.
    nodes_uv : float32 array of shape (N, 2)
        Nodes in the image (column, row).
    triangles : int32 array of shape (T, 3)
        Delaunay triangulation of `nodes_uv`: indices of nodes.
    edge_lengths : float32 array of shape (T, 3)
        Length of each triangle's edges (from corner k to corner k + 1), in `edge_metric`.
    kept : bool array of shape (T,)
        Triangles none of whose edges is longer than `threshold`.
    threshold : float
        Longest edge kept: `factor` times the mean over all triangles' edges; mm or pixels.
    edge_metric : str
        ``"3d"`` or ``"image"``.
    complement : bool array of shape (height, width)
        The long-edge complement: pixels of triangles that do not survive. The project's own
        read-out, not the paper's; with 3-D edges it holds the depth discontinuities.
    quantisation_error_mm : float
        Mean distance of the samples to the node that serves each; NaN without samples. After
        `exact` training that is the nearest node of all, after batch training the nearest of
        those in the image around the sample: the same on surfaces, but more where depth has no
        structure and the nearest in space lies elsewhere in the image.
    drawn_uv : float32 array of shape (N, 2)
        `nodes_uv` rounded as they were triangulated and drawn.
    """

    nodes_mm: Floats
    nodes_uv: Floats
    triangles: Ints
    edge_lengths: Floats
    kept: Bools
    threshold: float
    edge_metric: str
    complement: Bools
    quantisation_error_mm: float
    drawn_uv: Floats

    @property
    def worth(self) -> Floats:
        """What shots are chosen by: they fill the surviving triangles evenly, then the rest."""
        return spread(self.mask)

    def long_edges(self) -> Selection:
        """The second read-out: the complement, ranked by the longest edge of each triangle.

        Returns
        -------
        Selection
            Its mask is `complement`; its score the longest edge of a pixel's triangle over the
            longest of all, of which an even fill takes a tenth off, so that shots into one
            triangle do not clump.
        """
        long = np.flatnonzero(~self.kept)
        score = np.zeros(self.mask.shape, np.float32)
        if len(long):
            longest = self.edge_lengths[long].max(axis=1)
            longest /= longest.max()
            state = np.zeros(self.mask.shape, np.uint8)
            states = np.full(len(long), _LONG, np.uint8)
            uv = self.drawn_uv.astype(np.float64)
            _rasterise(uv, self.triangles[long], states, longest, state, score)
            score *= 1 - np.float32(0.1) * even_rank(score.shape)
        return Selection(self.complement, score, "neural gas, long edges")


def check_edges(edge_metric: str, factor: float) -> None:
    """Refuse a measure of edges, or a factor of their threshold, that there is not."""
    if edge_metric not in ("3d", "image"):
        raise ValueError(f"edge_metric is {edge_metric!r}; give '3d' or 'image'")
    if not factor > 0:
        raise ValueError(f"factor is {factor}; the threshold must be positive, 1 is the mean edge")


def delaunay_regions(
    nodes_mm: Floats,
    nodes_uv: Floats,
    frame_shape: tuple[int, int],
    *,
    edge_metric: EdgeMetric = "3d",
    factor: float = 1.0,
    quantisation_error_mm: float = float("nan"),
) -> RegionSelection:
    """Triangulate nodes in the image plane and keep the triangles without long edges.

    Parameters
    ----------
    nodes_mm : float32 array of shape (N, 3)
        Nodes in millimetres.
    nodes_uv : float32 array of shape (N, 2)
        The same nodes in the image (column, row).
    frame_shape : tuple of int
        Height and width of the frame in pixels.
    edge_metric : {"3d", "image"}, default "3d"
        Where edges are measured. The paper does not say; masks from image-plane edges are not
        reproducible (two trainings agree to an IoU of 0.35 against 0.93).
    factor : float, default 1.0
        The threshold as a multiple of the mean edge; 1 is the paper's.
    quantisation_error_mm : float, optional
        Handed on into the selection.

    Returns
    -------
    RegionSelection
        Empty (no triangle, no pixel) for fewer than three nodes or nodes on one line.

    Raises
    ------
    ValueError
        If `edge_metric` or `factor` is not allowed.
    """
    check_edges(edge_metric, factor)
    triangles, drawn_uv = triangulate(nodes_uv)
    edge_lengths = _edge_lengths(nodes_mm if edge_metric == "3d" else nodes_uv, triangles)
    threshold = factor * float(edge_lengths.mean(dtype=np.float64)) if len(triangles) else 0.0
    longest = np.maximum(np.maximum(*edge_lengths.T[:2]), edge_lengths[:, 2])
    kept = longest <= threshold
    score = np.zeros(frame_shape, dtype=np.float32)
    state = np.zeros(frame_shape, dtype=np.uint8)
    worth = np.where(kept, 1 - longest / max(threshold, 1e-30), 0).astype(np.float32)
    _rasterise(
        drawn_uv.astype(np.float64), triangles, np.where(kept, _KEPT, _LONG).astype(np.uint8), worth, state, score
    )
    return RegionSelection(
        mask=state == _KEPT,
        score=score,
        name="neural gas",
        nodes_mm=nodes_mm,
        nodes_uv=nodes_uv,
        triangles=triangles,
        edge_lengths=edge_lengths,
        kept=kept,
        threshold=threshold,
        edge_metric=edge_metric,
        complement=state == _LONG,
        quantisation_error_mm=quantisation_error_mm,
        drawn_uv=drawn_uv,
        crowded=1.0,
    )


def triangulate(uv: Floats) -> tuple[Ints, Floats]:
    """Delaunay triangulation of points of the image plane.

    The points are first rounded to a fraction of a pixel: in whole numbers the triangulation is
    exact, so that no rounding can make it inconsistent, and points in one place are seen to be.

    Parameters
    ----------
    uv : float32 array of shape (N, 2)
        Points in pixels.

    Returns
    -------
    triangles : int32 array of shape (T, 3)
        Indices of points; of points in one place only one is used. (0, 3) where all points lie
        on one line.
    rounded_uv : float32 array of shape (N, 2)
        The points as triangulated.
    """
    if len(uv) == 0:
        return np.zeros((0, 3), np.int32), uv
    low = np.array([axis.min() for axis in uv.T])  # along the other axis it takes 30 times as long
    extent = float((uv - low).max())
    per_px = min(_STEPS_PER_PX, _STEPS / max(extent, 1.0))
    steps = np.rint((uv - low) * np.float32(per_px)).astype(np.int32)
    rounded_uv = (steps / np.float32(per_px) + low).astype(np.float32)
    _, first = np.unique(steps[:, 1].astype(np.int64) << 32 | steps[:, 0], return_index=True)
    mesh = Mesh.of(steps[first])
    if mesh is None:
        return np.zeros((0, 3), np.int32), rounded_uv
    return first.astype(np.int32)[mesh.real_triangles()], rounded_uv


@njit(cache=True, nogil=True)
def _edge_lengths(nodes, triangles):  # type: ignore[no-untyped-def]
    """Length of the edges of each triangle, from corner k to corner k + 1."""
    lengths = np.empty(triangles.shape, np.float32)
    for t in range(len(triangles)):
        for k in range(3):
            a, b = triangles[t, k], triangles[t, (k + 1) % 3]
            square = np.float32(0)
            for axis in range(nodes.shape[1]):
                d = nodes[a, axis] - nodes[b, axis]
                square += d * d
            lengths[t, k] = math.sqrt(square)
    return lengths


@njit(cache=True, nogil=True, inline="always")
def _slope(a, b):  # type: ignore[no-untyped-def]
    """Columns per row along an edge from a down to b."""
    return (b[0] - a[0]) / (b[1] - a[1]) if b[1] > a[1] else 0.0


@njit(cache=True, nogil=True)
def _rasterise(uv, triangles, states, worths, state, score):  # type: ignore[no-untyped-def]
    """Paint each pixel whose centre lies in a triangle; a pixel on an edge is painted once.

    An edge's crossing with a row is computed from its upper end, by the same formula for both
    of its triangles: they share it to the last bit, and leave no gap.
    """
    height, width = state.shape
    for t in range(len(triangles)):
        a, b, c = uv[triangles[t, 0]], uv[triangles[t, 1]], uv[triangles[t, 2]]
        if b[1] < a[1]:
            a, b = b, a
        if c[1] < b[1]:
            b, c = c, b
            if b[1] < a[1]:
                a, b = b, a
        # Now from top to bottom: a row crosses the edge ac and one of the others.
        ac, ab, bc = _slope(a, c), _slope(a, b), _slope(b, c)
        painted, worth = states[t], worths[t]
        for row in range(max(math.ceil(a[1]), 0), min(math.ceil(c[1]), height)):
            one = a[0] + (row - a[1]) * ac
            other = a[0] + (row - a[1]) * ab if row < b[1] else b[0] + (row - b[1]) * bc
            left = max(math.ceil(min(one, other)), 0)
            right = min(math.ceil(max(one, other)), width)
            for column in range(np.uint64(left), np.uint64(right)):  # unsigned: none is counted from the end
                state[row, column] = painted
                score[row, column] = worth
