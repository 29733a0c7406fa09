"""Regions: the triangulation, the threshold, what is kept, and the painted pixels."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.selectors.neural_gas import NeuralGasSelector
from selective_depth.selectors.neural_gas.regions import delaunay_regions, triangulate
from selective_depth.selectors.reconstruct import reconstruct
from selective_depth.selectors.seeds import SeedGrid

SHAPE = (90, 120)


def random_nodes(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    uv = rng.uniform((-10, -10), (130, 100), (count, 2)).astype(np.float32)
    mm = np.column_stack((uv, rng.choice([0, 40], count))).astype(np.float32)
    return mm, uv


def sorted_triangles(triangles: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(sorted(int(corner) for corner in triangle)) for triangle in triangles}


def in_circle(corners: list[list[int]], point: list[int]) -> int:
    """The in-circle determinant of whole numbers, exactly; 0 on the circle."""
    rows = [(u - point[0], v - point[1]) for u, v in corners]
    (au, av), (bu, bv), (cu, cv) = rows
    a, b, c = (u * u + v * v for u, v in rows)
    return a * (bu * cv - cu * bv) - b * (au * cv - cu * av) + c * (au * bv - bu * av)


@settings(deadline=None, max_examples=30)
@given(count=st.integers(3, 200), seed=st.integers(0, 2**32 - 1))
def test_triangulation_is_that_of_qhull(count, seed):
    _, uv = random_nodes(count, seed)
    triangles, rounded = triangulate(uv)
    assert np.abs(rounded - uv).max() <= 0.0626
    # An empty circumcircle is what makes it Delaunay; four points on a circle have two answers.
    double = rounded.astype(float)
    for triangle in triangles:
        a, b, c = double[triangle]
        matrix = 2 * np.array([b - a, c - a])
        centre = np.linalg.solve(matrix, [b @ b - a @ a, c @ c - a @ a])
        radius = np.linalg.norm(a - centre)
        assert (np.linalg.norm(double - centre, axis=1) >= radius - 1e-6 * (1 + radius)).all()
    theirs = Delaunay(double).simplices
    # Where no fourth point lies on a triangle's circle, there is no other answer. On the grid of
    # sixteenths of a pixel, whether one does is a matter of whole numbers.
    ours, grid = sorted_triangles(triangles), np.rint(16 * double).astype(np.int64)
    for triangle in theirs:
        corners = [[int(value) for value in grid[corner]] for corner in triangle]
        alone = all(
            in_circle(corners, [int(value) for value in grid[other]]) != 0
            for other in set(range(len(grid))) - set(triangle.tolist())
        )
        assert not alone or tuple(sorted(triangle.tolist())) in ours
    area = [abs(np.linalg.det(double[t[:, 1:]] - double[t[:, :1]])).sum() for t in (triangles, theirs)]
    assert area[0] == pytest.approx(area[1], rel=1e-6)


def test_far_apart_points_are_rounded_more_coarsely_but_never_overflow():
    rng = np.random.default_rng(0)
    uv = rng.uniform(0, 1e6, (500, 2)).astype(np.float32)
    triangles, rounded = triangulate(uv)
    assert np.abs(rounded - uv).max() <= 1e6 / 2**14
    assert len(triangles) > 900


def slow_states(uv, triangles, kept, shape):
    """Each pixel's triangle by three half-planes; pixels nearly on an edge are left undecided."""
    rows, columns = np.indices(shape)
    state = np.zeros(shape, np.uint8)
    sure = np.ones(shape, bool)
    owner = np.full(shape, -1)
    for t, triangle in enumerate(triangles):
        a, b, c = uv[triangle].astype(float)
        if np.linalg.det([b - a, c - a]) < 0:
            b, c = c, b
        inside = np.ones(shape, bool)
        for p, q in ((a, b), (b, c), (c, a)):
            side = (q[0] - p[0]) * (rows - p[1]) - (q[1] - p[1]) * (columns - p[0])
            distance = side / np.linalg.norm(q - p)
            inside &= side >= 0
            sure[(abs(distance) < 1e-3)] = False
        state[inside] = 1 if kept[t] else 2
        owner[inside] = t
    return state, owner, sure


@settings(deadline=None, max_examples=25)
@given(
    count=st.integers(3, 60),
    seed=st.integers(0, 2**32 - 1),
    metric=st.sampled_from(["3d", "image"]),
    factor=st.sampled_from([0.5, 1.0, 1.7]),
)
def test_regions_meet_the_published_rule_pixel_by_pixel(count, seed, metric, factor):
    mm, uv = random_nodes(count, seed)
    regions = delaunay_regions(mm, uv, SHAPE, edge_metric=metric, factor=factor)
    nodes = mm if metric == "3d" else uv
    lengths = [
        [float(np.linalg.norm(nodes[t[k]].astype(float) - nodes[t[(k + 1) % 3]])) for k in range(3)]
        for t in regions.triangles
    ]
    threshold = factor * np.mean(lengths)
    assert regions.threshold == pytest.approx(threshold, rel=1e-5)
    clear = [all(abs(e / threshold - 1) > 1e-4 for e in edges) for edges in lengths]
    kept = [max(edges) <= threshold for edges in lengths]
    assert np.array_equal(regions.kept[clear], np.array(kept)[clear])
    _, rounded = triangulate(uv)
    state, owner, sure = slow_states(rounded, regions.triangles, regions.kept, SHAPE)
    assert np.array_equal(regions.mask[sure], state[sure] == 1)
    assert np.array_equal(regions.complement[sure], state[sure] == 2)
    worth = np.array([1 - max(edges) / threshold for edges in lengths] + [0.0])
    expected = np.where(state == 1, worth[owner], 0)
    assert np.allclose(regions.score[sure], expected[sure], atol=1e-4)


def test_triangles_tile_the_frame_without_gap_or_overlap():
    corners = [(-5, -5), (125, -5), (-5, 95), (125, 95)]
    rng = np.random.default_rng(2)
    uv = np.concatenate((corners, rng.uniform(0, 90, (400, 2)), rng.integers(0, 90, (200, 2))))
    mm = np.column_stack((uv, np.zeros(len(uv)))).astype(np.float32)
    regions = delaunay_regions(mm, uv.astype(np.float32), SHAPE)
    assert (regions.mask ^ regions.complement).all()


@pytest.mark.parametrize(
    "uv",
    [
        np.zeros((0, 2)),
        np.ones((1, 2)),
        np.array([[1, 1], [5, 9]]),
        np.ones((20, 2)),
        np.stack((np.arange(20), 2 * np.arange(20)), axis=1),
        np.array([[3, 3], [3, 3], [9, 9], [9, 9]]),
    ],
    ids=["none", "one", "two", "equal", "line", "pairs"],
)
@pytest.mark.parametrize("metric", ["3d", "image"])
def test_without_a_triangle_nothing_is_selected(uv, metric):
    uv = uv.astype(np.float32)
    mm = np.column_stack((uv, np.ones(len(uv)))).astype(np.float32)
    regions = delaunay_regions(mm, uv, SHAPE, edge_metric=metric)
    assert regions.triangles.shape == (0, 3)
    assert regions.kept.shape == (0,)
    assert not regions.mask.any() and not regions.complement.any() and not regions.score.any()


def test_nodes_in_one_place_are_one_corner():
    uv = np.array([[0, 0], [50, 0], [0, 50], [50, 50], [50, 50]], np.float32)
    mm = np.column_stack((uv, np.ones(5))).astype(np.float32)
    regions = delaunay_regions(mm, uv, SHAPE)
    assert len(regions.triangles) == 2
    assert regions.mask.sum() + regions.complement.sum() == 50 * 50


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"edge_metric": "2d"}, "edge_metric is '2d'; give '3d' or 'image'"),
        ({"factor": 0}, "factor is 0; the threshold must be positive"),
    ],
)
def test_options_out_of_range_are_refused(arguments, sentence):
    mm, uv = random_nodes(9, 0)
    with pytest.raises(ValueError, match=sentence):
        delaunay_regions(mm, uv, SHAPE, **arguments)


@pytest.mark.parametrize(("name", "focal", "index"), [("sequence", 585, 60), ("tabletop", 525, 3)])
def test_long_edges_hold_the_interpolation_error(shared_data, name, focal, index):
    centre = (320, 240) if name == "sequence" else (319.5, 239.5)
    depth = cv2.imread(str(shared_data / name / f"{index:06d}.png"), cv2.IMREAD_UNCHANGED)
    frame = DepthFrame(depth, 0, 0, Camera(640, 480, focal, focal, *centre))
    seeds = SeedGrid.from_frame(frame)
    regions = NeuralGasSelector().select(seeds)
    model = reconstruct(seeds.uv, seeds.depth_mm[seeds.valid], frame.shape)
    square = np.where(depth > 0, np.square(model - depth.astype(np.float32)), 0)
    held = square[regions.complement].sum() / square.sum()
    assert held >= 0.9
    assert regions.complement[depth > 0].mean() <= 0.35
