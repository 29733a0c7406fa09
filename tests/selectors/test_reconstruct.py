"""The reconstruction and its triangulation, each beside a slow and obvious reference."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from selective_depth.selectors.reconstruct import reconstruct
from selective_depth.selectors.seeds import SeedGrid
from selective_depth.selectors.triangulation import BRIDGE_PX, STEP_MM, nearest_sample
from selective_depth.selectors.triangulation.delaunay import Mesh
from selective_depth.selectors.triangulation.flips import GHOST
from selective_depth.selectors.triangulation.nearest import FAR_SQ
from selective_depth.selectors.triangulation.rows import row_starts

Pixels = npt.NDArray[np.int32]


@st.composite
def scattered(draw: st.DrawFn, most: int = 40) -> tuple[tuple[int, int], Pixels]:
    """A small image and different pixels of it, often on lines and circles."""
    height, width = draw(st.integers(1, 24)), draw(st.integers(1, 24))
    count = draw(st.integers(1, min(most, height * width)))
    seed = draw(st.integers(0, 2**32 - 1))
    index = np.random.default_rng(seed).permutation(height * width)[:count]
    return (height, width), np.stack((index % width, index // width), axis=-1).astype(np.int32)


def doubled_areas(uv: Pixels, triangles: Pixels) -> npt.NDArray[np.int64]:
    a, b, c = (uv[triangles[:, i]].astype(np.int64) for i in range(3))
    return (b - a)[:, 0] * (c - a)[:, 1] - (c - a)[:, 0] * (b - a)[:, 1]


def assert_delaunay(uv: Pixels, mesh: Mesh) -> None:
    """Every triangle is anticlockwise, they fill the hull, and no circle holds a point."""
    triangles = mesh.real_triangles()
    areas = doubled_areas(uv, triangles)
    assert (areas > 0).all()
    assert areas.sum() == round(2 * ConvexHull(uv).volume)
    for a, b, c in uv[triangles].astype(np.int64):
        p = uv.astype(np.int64)
        rows = [np.column_stack((q - p, ((q - p) ** 2).sum(axis=1))) for q in (a, b, c)]
        inside = np.linalg.det(np.stack(rows, axis=1).astype(float))
        assert inside.max() < 0.5  # a whole number, in floating point
    tri, adj = mesh.tri[: mesh.triangles], mesh.adj[: mesh.triangles]
    for corner in range(3):
        across = adj[:, corner]
        edge = np.sort(np.delete(tri, corner, axis=1), axis=1)
        shared = [sorted(set(tri[t]) & set(tri[o])) for t, o in enumerate(across)]
        assert shared == edge.tolist()


@settings(max_examples=60, deadline=None)
@given(scattered())
def test_triangulation_is_delaunay_whatever_the_points(case: tuple[tuple[int, int], Pixels]) -> None:
    _, uv = case
    mesh = Mesh.of(uv)
    centred = (uv - uv[0]).astype(float)
    if mesh is None:
        assert len(uv) < 3 or np.linalg.matrix_rank(centred) < 2
    else:
        assert_delaunay(uv, mesh)


@settings(max_examples=40, deadline=None)
@given(scattered())
def test_adding_points_gives_what_all_at_once_gives(case: tuple[tuple[int, int], Pixels]) -> None:
    (height, width), uv = case
    corners = np.array([(0, 0), (width, 0), (0, height), (width, height)], np.int32) + 1
    inner = uv + 1
    known = {tuple(corner) for corner in corners}
    inner = np.array([p for p in inner.tolist() if tuple(p) not in known], np.int32).reshape(-1, 2)
    mesh = Mesh.of(corners)
    assert mesh is not None
    half = len(inner) // 2
    mesh.add(inner[:half])
    mesh.add(inner[half:])
    assert_delaunay(np.concatenate((corners, inner)), mesh)


def test_a_lattice_is_triangulated_without_slivers_or_gaps() -> None:
    seeds = SeedGrid.from_array(np.full((480, 640), 1000), (128, 128))
    uv = seeds.lattice_uv.reshape(-1, 2)
    mesh = Mesh.of(uv)
    assert mesh is not None
    triangles = mesh.real_triangles()
    assert len(triangles) == 2 * 127 * 127
    assert set(np.unique(doubled_areas(uv, triangles))) == {15, 20}  # half a 5x3 or 5x4 cell
    assert (mesh.tri[: mesh.triangles] == GHOST).any()


@st.composite
def rows_with_holes(draw: st.DrawFn) -> Pixels:
    """A lattice of any steps, some or many of whose points are missing."""
    columns, rows = (np.cumsum(draw(st.lists(st.integers(1, 9), min_size=2, max_size=14))) for _ in range(2))
    u, v = np.meshgrid(columns, rows)
    uv = np.stack((u, v), axis=-1).reshape(-1, 2).astype(np.int32)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return uv[rng.random(len(uv)) < draw(st.sampled_from([1.0, 0.95, 0.7, 0.4]))]


@settings(max_examples=120, deadline=None)
@given(rows_with_holes())
def test_rows_zipped_together_are_the_triangulation_of_points_one_by_one(uv: Pixels) -> None:
    """There is one, even of points on circles: `in_disk` decides by a hash."""
    one_by_one = Mesh.of(np.random.default_rng(0).permutation(uv))
    zipped = Mesh.of(uv)
    if zipped is None:
        assert one_by_one is None
        return
    assert_delaunay(uv, zipped)
    assert one_by_one is not None
    assert corners_of(zipped) == corners_of(one_by_one)


def corners_of(mesh: Mesh) -> set[frozenset[tuple[int, int]]]:
    """Its triangles as sets of pixels."""
    return {frozenset((int(u), int(v)) for u, v in mesh.uv[corners]) for corners in mesh.real_triangles()}


def test_full_lattices_and_most_with_holes_are_zipped() -> None:
    """Else the test above would hold one by one against one by one."""
    uv = SeedGrid.from_array(np.full((480, 640), 1000), (128, 128)).lattice_uv.reshape(-1, 2)
    kept = np.random.default_rng(1).random(len(uv)) < 0.8
    for points in (uv, uv[kept]):
        starts = row_starts(points)
        assert starts is not None
        assert len(starts) == 129
    assert row_starts(uv[::-1]) is None
    assert row_starts(uv[::300]) is None


def nearest_reference(valid: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """Squared distance to the nearest sample, by trying all."""
    rows, columns = np.indices(valid.shape)
    v, u = np.nonzero(valid)
    d = (rows[..., None] - v) ** 2 + (columns[..., None] - u) ** 2
    return np.asarray(d.min(axis=-1))


@settings(max_examples=60, deadline=None)
@given(scattered())
def test_nearest_sample_is_exact(case: tuple[tuple[int, int], Pixels]) -> None:
    shape, uv = case
    valid = np.zeros(shape, np.bool_)
    valid[uv[:, 1], uv[:, 0]] = True
    nearest, gap_sq = nearest_sample(valid)
    assert valid.ravel()[nearest].all()
    rows, columns = np.indices(shape)
    distance = (nearest % shape[1] - columns) ** 2 + (nearest // shape[1] - rows) ** 2
    np.testing.assert_array_equal(distance, nearest_reference(valid))
    np.testing.assert_array_equal(gap_sq, distance)
    np.testing.assert_array_equal(nearest, nearest_sample(valid, threads=1)[0])


def test_nearest_sample_of_nothing_says_so() -> None:
    nearest, gap_sq = nearest_sample(np.zeros((3, 4), np.bool_))
    assert (nearest == -1).all()
    assert (gap_sq == FAR_SQ).all()


def candidates(uv: Pixels, depth: npt.NDArray[np.float64], shape: tuple[int, int]) -> list[list[set[float]]]:
    """All depths that the protocol allows at each pixel, by the letter of its text.

    Where two samples are equally near, or triangles share an edge, there is a choice.
    """
    mesh = Mesh.of(uv)  # itself held against the definition above
    triangulations = [] if mesh is None else list(uv[mesh.real_triangles()])
    height, width = shape
    allowed: list[list[set[float]]] = [[set() for _ in range(width)] for _ in range(height)]
    depth_of = {tuple(p): z for p, z in zip(uv.tolist(), depth, strict=True)}
    for v in range(height):
        for u in range(width):
            linear = []
            for corners in triangulations:
                system = np.vstack((corners.T, np.ones(3))).astype(float)
                weights = np.linalg.solve(system, (u, v, 1))
                if (weights < -1e-9).any():
                    continue
                z = np.array([depth_of[tuple(c)] for c in corners.tolist()])
                edges = [np.hypot(*(corners[i] - corners[i - 1])) for i in range(3)]
                if not (np.ptp(z) > STEP_MM and max(edges) > BRIDGE_PX):
                    linear.append(float(weights @ z))
            distance = ((uv - (u, v)) ** 2).sum(axis=1)
            near = depth[distance == distance.min()]
            allowed[v][u] = set(linear) if linear else set(near.tolist())
    return allowed


@settings(max_examples=25, deadline=None)
@given(scattered(most=14), st.integers(0, 2**32 - 1), st.sampled_from([0.0, 40.0, 3000.0]))
def test_reconstruction_follows_the_protocol(case: tuple[tuple[int, int], Pixels], seed: int, spread_mm: float) -> None:
    shape, uv = case
    depth = 1000 + np.floor(np.random.default_rng(seed).random(len(uv)) * (spread_mm + 1))
    model = reconstruct(uv, depth, shape)
    allowed = candidates(uv, depth, shape)
    for v in range(shape[0]):
        for u in range(shape[1]):
            assert min(abs(model[v, u] - z) for z in allowed[v][u]) < 0.01


def test_a_plane_is_reconstructed_exactly_and_samples_are_kept() -> None:
    rows, columns = np.indices((60, 80))
    plane = (1000 + 3 * columns + 2 * rows).astype(np.float32)
    seeds = SeedGrid.from_array(plane, (12, 16))
    uv, depth = seeds.lattice_uv.reshape(-1, 2), seeds.depth_mm.ravel()
    model = reconstruct(uv, depth, (60, 80))
    inside = (
        (columns >= uv[:, 0].min()) & (columns <= uv[:, 0].max()) & (rows >= uv[:, 1].min()) & (rows <= uv[:, 1].max())
    )
    np.testing.assert_allclose(model[inside], plane[inside], rtol=1e-6)
    np.testing.assert_array_equal(model[uv[:, 1], uv[:, 0]], depth)


def test_no_surface_is_stretched_over_a_wide_gap() -> None:
    uv = np.array([(0, 0), (0, 9), (30, 0), (30, 9)], np.int32)
    near_far = reconstruct(uv, np.array([1000, 1000, 2000, 2000]), (10, 31))
    assert set(np.unique(near_far)) == {1000.0, 2000.0}
    slope = reconstruct(uv, np.array([1000, 1000, 1040, 1040]), (10, 31))
    assert len(np.unique(slope)) > 20


def test_shots_that_missed_and_bad_values_are_left_out() -> None:
    uv = np.array([(1, 1), (5, 1), (1, 5), (3, 3), (4, 4)], np.int32)
    with_misses = reconstruct(uv, np.array([800, 900, 1000, 0, np.nan]), (7, 7))
    without = reconstruct(uv[:3], np.array([800, 900, 1000]), (7, 7))
    np.testing.assert_array_equal(with_misses, without)


@pytest.mark.parametrize("value", [-800.0, np.inf, -np.inf, np.nan])
def test_what_is_no_depth_is_no_sample(value: float) -> None:
    uv = np.array([(1, 1), (5, 1), (1, 5)], np.int32)
    depth = np.array([800, 900, value])
    np.testing.assert_array_equal(reconstruct(uv, depth, (7, 7)), reconstruct(uv[:2], depth[:2], (7, 7)))


@pytest.mark.parametrize(
    ("corners", "span_mm", "bridges"),
    [
        ([(0, 0), (20, 0), (0, 20)], STEP_MM, False),
        ([(0, 0), (20, 0), (0, 20)], STEP_MM + 1, True),
        ([(0, 0), (10, 0), (5, 5)], 1000, False),
        ([(0, 0), (11, 0), (5, 5)], 1000, True),
    ],
)
def test_a_bridge_exceeds_both_limits(corners: list[tuple[int, int]], span_mm: float, bridges: bool) -> None:
    """Just as wide or as long as a limit is still a surface."""
    assert BRIDGE_PX == 10
    depth = np.array([1000, 1000 + span_mm, 1000])
    model = reconstruct(np.array(corners, np.int32), depth, (21, 21))
    assert (len(np.unique(model)) == 2) == bridges


def test_the_last_of_two_measurements_of_a_pixel_counts() -> None:
    uv = np.array([(1, 1), (1, 1)], np.int32)
    assert (reconstruct(uv, np.array([800, 900]), (3, 3)) == 900).all()


def test_nothing_measured_is_nothing_known() -> None:
    assert (reconstruct(np.empty((0, 2), np.int32), np.empty(0), (4, 5)) == 0).all()
    assert (reconstruct(np.array([(1, 1)]), np.array([0]), (4, 5)) == 0).all()


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_threads_change_nothing(threads: int) -> None:
    rng = np.random.default_rng(1)
    uv = np.unique(rng.integers(0, 90, (500, 2)), axis=0)
    depth = rng.integers(500, 4000, len(uv))
    np.testing.assert_array_equal(reconstruct(uv, depth, (90, 90), threads=threads), reconstruct(uv, depth, (90, 90)))


def test_what_does_not_fit_is_refused_in_a_sentence() -> None:
    with pytest.raises(ValueError, match=r"column first.*\(3, 2\) and \(2,\)"):
        reconstruct(np.zeros((3, 2), int), np.zeros(2), (4, 4))
    for outside in ((4, 0), (0, 3), (-1, 0), (0, -1)):
        with pytest.raises(ValueError, match="outside the frame of 4x3 pixels"):
            reconstruct(np.array([outside]), np.array([1000]), (3, 4))
