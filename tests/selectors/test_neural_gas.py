"""Neural gas: the published steps, the batch passes, the live updates, and what they survive."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay, cKDTree

from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.selectors.neural_gas import BatchNeuralGas, NeuralGasSelector, node_pixels
from selective_depth.selectors.neural_gas import batch as fast
from selective_depth.selectors.neural_gas import exact as exact
from selective_depth.selectors.seeds import SeedGrid

Float32 = npt.NDArray[np.float32]
SEQUENCE = Camera(640, 480, 585, 585, 320, 240)
TABLETOP = Camera(640, 480, 525, 525, 319.5, 239.5)


def frame(path: Path, camera: Camera) -> DepthFrame:
    return DepthFrame(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), 0, 0, camera)


def seeds_of(folder: Path, name: str, index: int, shape: tuple[int, int]) -> SeedGrid:
    camera = SEQUENCE if name == "sequence" else TABLETOP
    return SeedGrid.from_frame(frame(folder / name / f"{index:06d}.png", camera), shape)


def quantisation_error(points: Float32, nodes: Float32) -> float:
    return float(cKDTree(nodes).query(points)[0].mean())


def overlap(a: npt.NDArray[np.bool_], b: npt.NDArray[np.bool_]) -> float:
    return float((a & b).sum() / (a | b).sum())


def scene(count: int, seed: int = 0) -> Float32:
    """Points on a wall and on a box before it."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-800, 800, count), rng.uniform(-600, 600, count)
    z = np.where((abs(x) < 250) & (abs(y) < 200), 1200 + 0.3 * x, 2000 + 0.1 * y)
    return np.stack((x, y, z), axis=1).astype(np.float32)


# --- exact -----------------------------------------------------------------------------------


def reference(points: Float32, nodes: Float32, draws: npt.NDArray[np.int32]) -> npt.NDArray:
    """Equations (1)-(4) as they stand, in float64: every node moves at every step."""
    w, x = nodes.astype(np.float64), points.astype(np.float64)
    steps, lambda_first = len(draws), max(len(nodes) / 2, 0.01)
    for t, p in enumerate(draws):
        alpha = 0.5 * (0.005 / 0.5) ** (t / steps)
        reach = lambda_first * (0.01 / lambda_first) ** (t / steps)
        order = np.argsort(((w - x[p]) ** 2).sum(axis=1), kind="stable")
        rank = np.empty(len(w))
        rank[order] = np.arange(len(w))
        w += (alpha * np.exp(-rank / reach))[:, None] * (x[p] - w)
    return w


def test_exact_meets_float64_reference_with_the_same_draws():
    points = scene(2000)
    rng = np.random.default_rng(1)
    first = points[rng.choice(2000, 300, replace=False)]
    draws = rng.integers(0, 2000, 10 * 2000, dtype=np.int32)
    ours, theirs = exact.anneal(points, first, draws), reference(points, first, draws)
    errors = quantisation_error(points, ours), quantisation_error(points, theirs)
    assert errors[0] == pytest.approx(errors[1], rel=1e-3)
    corners = theirs[Delaunay(theirs[:, :2]).simplices]
    mean_edge = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).mean()
    assert np.linalg.norm(ours - theirs, axis=1).mean() <= 0.01 * mean_edge


@settings(deadline=None, max_examples=30)
@given(
    nodes=st.integers(1, 90),
    count=st.integers(1, 60),
    scale=st.sampled_from([1e-2, 1.0, 1e4]),
    flat=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_exact_meets_reference_on_any_cloud(nodes, count, scale, flat, seed):
    rng = np.random.default_rng(seed)
    points = (rng.normal(size=(count, 3)) * scale).astype(np.float32)
    if flat:
        points[:, 2] = 0
    first = (rng.normal(size=(nodes, 3)) * scale).astype(np.float32)
    draws = rng.integers(0, count, 60, dtype=np.int32)
    difference = exact.anneal(points, first, draws) - reference(points, first, draws)
    assert np.abs(difference).max() <= 1e-4 * scale


@settings(deadline=None, max_examples=50)
@given(
    count=st.integers(1, 3000),
    kind=st.sampled_from(["even", "skewed", "equal", "two", "huge", "zero"]),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_ordering_sorts(count, kind, seed):
    rng = np.random.default_rng(seed)
    key = {
        "even": rng.random(count),
        "skewed": rng.random(count) ** 20,
        "equal": np.full(count, 3.0),
        "two": rng.integers(0, 2, count),
        "huge": rng.random(count) * 1e37,
        "zero": np.zeros(count),
    }[kind].astype(np.float64)
    expected = np.argsort(key, kind="stable")
    order, spare = np.empty((2, count), np.uint32)
    largest = exact._largest(key, count, np.empty(64))
    assert largest == key.max()
    exact._order(key, count, largest, order, spare, np.empty((2, 1024), np.uint32))
    assert np.array_equal(order, expected)


def test_every_node_moves_by_its_weight():
    # Nodes on a line from the one point drawn: ranks are known, and so is how far each moves.
    nodes = np.zeros((400, 3), np.float32)
    nodes[:, 0] = np.arange(1, 401)
    points = np.zeros((1, 3), np.float32)
    moved = nodes - exact.anneal(points, nodes, np.zeros(1, np.int32))
    weight = 0.5 * np.exp(-np.arange(400) / 200)
    assert np.allclose(moved[:, 0], weight * nodes[:, 0], rtol=1e-4)


# --- fast ------------------------------------------------------------------------------------


def winners_slowly(points, uv, nodes, nodes_uv, bin_px, rows, columns):
    """Nearest two distances among the nodes of the bins around, widened until nine are met."""
    column = np.clip(nodes_uv[:, 0] // bin_px, 0, columns - 1)
    row = np.clip(nodes_uv[:, 1] // bin_px, 0, rows - 1)
    result = []
    for p in range(len(points)):
        c, r = min(uv[p, 0] // bin_px, columns - 1), min(uv[p, 1] // bin_px, rows - 1)
        for ring in range(1, max(rows, columns) + 1):
            near = np.flatnonzero((abs(column - c) <= ring) & (abs(row - r) <= ring))
            if len(near) >= 9:
                break
        d2 = np.sort(((nodes[near].astype(float) - points[p]) ** 2).sum(axis=1))
        result.append((d2[0], d2[1] if len(d2) > 1 else math.inf))
    return np.array(result)


@settings(deadline=None, max_examples=30)
@given(
    count=st.integers(1, 60),
    nodes=st.integers(1, 60),
    bin_px=st.sampled_from([4.0, 7.5, 40.0]),
    equal=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_winners_meet_the_slow_search(count, nodes, bin_px, equal, seed):
    rng = np.random.default_rng(seed)
    uv = rng.uniform(0, 40, (count, 2)).astype(np.float32)
    nodes_uv = rng.uniform(-5, 45, (nodes, 2)).astype(np.float32)
    points = rng.normal(size=(count, 3)).astype(np.float32) * (0 if equal else 100)
    places = rng.normal(size=(nodes, 3)).astype(np.float32) * (0 if equal else 100)
    rows = columns = int(40 // bin_px) + 1
    seeds_in, nodes_in = (
        fast._sort_into_bins(*each, bin_px, rows, columns) for each in ((points, uv), (places, nodes_uv))
    )
    winner, d2 = np.empty(count, np.int32), np.empty((2, count), np.float32)
    fast._find_two(0, rows * columns, rows, columns, seeds_in, nodes_in, winner, d2)
    slow = winners_slowly(points, uv, places, nodes_uv, bin_px, rows, columns)
    assert np.allclose(d2[0], slow[:, 0], rtol=1e-4, atol=1e-3)
    some = np.isfinite(slow[:, 1])
    assert np.allclose(d2[1, some], slow[some, 1], rtol=1e-4, atol=1e-3)
    own = ((places[winner].astype(float) - points) ** 2).sum(axis=1)
    assert np.allclose(own, d2[0], rtol=1e-4, atol=1e-3)


def test_nodes_move_to_the_means_of_what_they_won():
    points = scene(500)
    uv = points[:, :2] * np.float32(0.1)
    rng = np.random.default_rng(0)
    winner = rng.integers(0, 40, 500, dtype=np.int32)
    winner[winner == 7] = 8  # one node wins nothing
    d2 = np.stack((rng.random(500), 1 + rng.random(500))).astype(np.float32)
    nodes, nodes_uv = np.full((40, 3), 9, np.float32), np.full((40, 2), 9, np.float32)
    fast._move(points, uv, winner, d2, nodes, nodes_uv, False)
    for j in range(40):
        won = winner == j
        place = points[won].mean(axis=0) if won.any() else [9, 9, 9]
        assert np.allclose(nodes[j], place, rtol=1e-5, atol=1e-2)
        pixel = uv[won].mean(axis=0) if won.any() else [9, 9]
        assert np.allclose(nodes_uv[j], pixel, rtol=1e-5, atol=1e-3)


@settings(deadline=None, max_examples=50)
@given(nodes=st.integers(2, 60), seed=st.integers(0, 2**32 - 1))
def test_only_useless_nodes_are_relocated_and_only_beside_worse_served_seeds(nodes, seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(200, 3)).astype(np.float32)
    uv = points[:, :2].copy()
    winner = rng.integers(0, nodes, 200, dtype=np.int32)
    d2 = np.sort(rng.exponential(size=(2, 200)) ** 3, axis=0).astype(np.float32)
    settled, relocated = np.zeros((2, nodes, 3), np.float32)
    for place, relocate in ((settled, False), (relocated, True)):
        fast._move(points, uv, winner, d2, place, np.zeros((nodes, 2), np.float32), relocate)
    moved = np.flatnonzero((settled != relocated).any(axis=1))
    error, utility = np.bincount(winner, d2[0], nodes), np.bincount(winner, d2[1] - d2[0], nodes)
    # What is given up is less than what is won, whichever way the pairs are formed.
    won = []
    for j in moved:
        seed_at = int(np.flatnonzero((points == relocated[j]).all(axis=1))[0])
        owner = winner[seed_at]
        assert d2[0, seed_at] == d2[0, winner == owner].max()
        won.append(error[owner])
    if len(moved):
        assert utility[moved].max() <= fast.GAIN * min(won) * (1 + 1e-4)
    assert len(set(won)) == len(won)


def test_dead_nodes_are_put_back():
    points = scene(3000)
    uv = (points[:, :2] / 5 + 200).astype(np.int32)
    gas = BatchNeuralGas(300, seed=0).train(points, uv)
    gas.nodes_mm_[:150] = 1e6  # as if a moving camera had left them behind
    gas.nodes_uv_[:150] = 0
    gas.update(points, uv)
    gas.update(points, uv)
    assert gas.won_.sum() >= 298
    fresh = BatchNeuralGas(300, seed=0).train(points, uv).quantisation_error_mm_
    assert gas.quantisation_error_mm_ < 1.02 * fresh


def check_quality(folder: Path, frames: list[tuple[str, int]], side: int, nodes: int) -> None:
    differences = []
    for name, index in frames:
        seeds = seeds_of(folder, name, index, (side, side))
        first, second = (NeuralGasSelector(nodes, algorithm="exact", seed=seed).select(seeds) for seed in (0, 1))
        quick = NeuralGasSelector(nodes, seed=0).select(seeds)
        error = quantisation_error(seeds.points_mm, quick.nodes_mm)
        assert error == pytest.approx(quick.quantisation_error_mm, rel=2e-3)
        assert error <= min(first.quantisation_error_mm, second.quantisation_error_mm), f"{name} {index}"
        among_exact = overlap(first.mask, second.mask)
        with_exact = (overlap(quick.mask, first.mask) + overlap(quick.mask, second.mask)) / 2
        differences.append(among_exact - with_exact)
    assert np.mean(differences) <= 0.04


def test_fast_is_no_worse_than_exact(shared_data):
    frames = [("sequence", 10), ("sequence", 90), ("tabletop", 2), ("tabletop", 9)]
    check_quality(shared_data, frames, side=64, nodes=700)


@pytest.mark.slow
def test_fast_is_no_worse_than_exact_on_every_frame(shared_data):
    frames = [("sequence", index) for index in range(10, 110, 10)]
    frames += [("tabletop", index) for index in range(12)]
    check_quality(shared_data, frames, side=128, nodes=2800)


# --- live ------------------------------------------------------------------------------------


def check_live(folder: Path, side: int, nodes: int, compared: range) -> None:
    selector = NeuralGasSelector(nodes, seed=0)
    ratios = []
    for index in range(compared[-1] + 1):
        seeds = seeds_of(folder, "sequence", index, (side, side))
        live = selector.update(seeds)
        if index in compared:
            cold = NeuralGasSelector(nodes, algorithm="exact", seed=0).select(seeds)
            error = quantisation_error(seeds.points_mm, live.nodes_mm)
            ratios.append(error / cold.quantisation_error_mm)
    assert max(ratios) <= 1.07
    assert np.mean(ratios) <= 1.04
    # A cut to another scene.
    seeds = seeds_of(folder, "tabletop", 0, (side, side))
    cold = NeuralGasSelector(nodes, algorithm="exact", seed=0).select(seeds)
    for _ in range(10):
        live = selector.update(seeds)
    assert quantisation_error(seeds.points_mm, live.nodes_mm) <= 1.10 * cold.quantisation_error_mm


def test_live_follows_a_moving_camera_and_a_cut(shared_data):
    check_live(shared_data, 64, 700, range(20, 61, 20))


@pytest.mark.slow
def test_live_follows_the_whole_sequence(shared_data):
    check_live(shared_data, 128, 2800, range(10, 111, 10))


def test_reheats_on_a_cut_and_not_on_the_way(shared_data):
    gas = BatchNeuralGas(700, seed=0)
    for index in (*range(30, 36), *range(97, 102)):
        seeds = seeds_of(shared_data, "sequence", index, (64, 64))
        gas.update(seeds.points_mm, seeds.uv)
        assert gas.reheated_ == (index == 97)  # the sequence is cut before this frame
    seeds = seeds_of(shared_data, "tabletop", 3, (64, 64))
    assert gas.update(seeds.points_mm, seeds.uv).reheated_


def test_only_a_jump_of_the_error_takes_the_passes_of_a_cold_training():
    points = scene(300)
    points[:, 2] = 1e4 * np.arange(300)  # each has one near node, its own
    uv = (points[:, :2] / 5 + 200).astype(np.int32)
    for jump, changed in ((1.9, False), (2.1, True)):
        gas = BatchNeuralGas(300, seed=0).adopt(points.copy(), uv.astype(np.float32), points)
        gas.quantisation_error_mm_ = 10.0  # as if these had been the nodes of a coarse training
        aside = np.float32([jump * 10, 0, 0])
        assert gas.update(points + aside, uv).reheated_ == changed
    assert not gas.train(points, uv).reheated_


def test_a_training_does_not_depend_on_where_in_the_image_its_seeds_lie():
    points = scene(2000)
    uv = (points[:, :2] / 5 + 200).astype(np.int32)
    offset = np.array([1300, -700], np.int32)
    here, there = (BatchNeuralGas(200, seed=0) for _ in range(2))
    here.train(points, uv)
    there.train(points, uv + offset)
    for _ in range(2):
        assert np.allclose(here.nodes_mm_, there.nodes_mm_, atol=1e-2)
        assert np.allclose(here.nodes_uv_ + offset, there.nodes_uv_, atol=1e-2)
        here.update(points, uv)
        there.update(points, uv + offset)


def test_adopted_nodes_are_taken_as_they_are():
    points = scene(500)
    uv = (points[:, :2] / 5 + 200).astype(np.int32)
    nodes_mm, nodes_uv = points[::7].copy(), uv[::7].astype(np.float32)
    gas = BatchNeuralGas(len(nodes_mm), seed=0).train(points, uv)
    gas.adopt(nodes_mm, nodes_uv, points)
    apart = np.linalg.norm(points[:, None] - nodes_mm[None], axis=2)
    assert gas.quantisation_error_mm_ == pytest.approx(apart.min(axis=1).mean(), rel=1e-5)
    assert gas.won_.all()
    assert not gas.reheated_
    before = nodes_uv.copy()
    gas.update(points, uv)
    assert np.array_equal(nodes_uv, before)  # whoever trained them keeps theirs


def test_update_outlives_an_empty_frame_and_a_nearly_empty_one():
    camera = Camera.kinect(160, 120)
    full = np.full((120, 160), 1500, np.uint16)
    full[30:80, 40:100] = 900
    sparse = np.zeros_like(full)
    sparse[60:64, 60:70] = 1000
    selector = NeuralGasSelector(200)
    counts = []
    for depth in (full, np.zeros_like(full), sparse, np.zeros_like(full), full, full):
        seeds = SeedGrid.from_frame(DepthFrame(depth, 0, 0, camera), (60, 60))
        selection = selector.update(seeds)
        counts.append(len(selection.nodes_mm))
        assert selection.mask.shape == full.shape
        assert np.isfinite(selection.nodes_mm).all()
        assert math.isnan(selection.quantisation_error_mm) == (len(seeds.uv) == 0)
    assert counts[1] == counts[3] == 0
    assert 1 <= counts[2] <= 20
    assert counts[5] >= 198


# --- one interface ---------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ["exact", "fast"])
def test_equal_seeds_give_equal_selections(algorithm):
    camera = Camera.kinect(160, 120)
    depth = (1000 + np.add.outer(np.arange(120), 3 * np.arange(160))).astype(np.uint16)
    seeds = SeedGrid.from_frame(DepthFrame(depth, 0, 0, camera), (40, 40))
    one, two, other = (
        NeuralGasSelector(150, 5, algorithm, seed, threads=threads).select(seeds)
        for seed, threads in ((3, 1), (3, 2), (4, 1))
    )
    assert np.array_equal(one.nodes_mm, two.nodes_mm)
    assert np.array_equal(one.mask, two.mask)
    assert not np.array_equal(one.nodes_mm, other.nodes_mm)


@pytest.mark.parametrize("algorithm", ["exact", "fast"])
def test_update_goes_on_from_what_select_has_trained(algorithm):
    camera = Camera.kinect(160, 120)
    depth = (1000 + np.add.outer(np.arange(120), 3 * np.arange(160))).astype(np.uint16)
    seeds = SeedGrid.from_frame(DepthFrame(depth, 0, 0, camera), (40, 40))
    selector = NeuralGasSelector(150, 20, algorithm)
    trained = selector.select(seeds)
    again = selector.update(seeds)
    moved = np.linalg.norm(again.nodes_mm - trained.nodes_mm, axis=1)
    assert np.median(moved) < 0.5 * trained.quantisation_error_mm
    assert again.quantisation_error_mm <= trained.quantisation_error_mm


@st.composite
def odd_seeds(draw) -> SeedGrid:
    """Seeds of a sensor without pinhole, in every degenerate arrangement."""
    kind = draw(st.sampled_from(["equal", "one", "none", "row", "column", "line", "few", "far"]))
    rows = 1 if kind == "row" else draw(st.integers(1, 12))
    columns = 1 if kind == "column" else draw(st.integers(1, 12))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    points = rng.uniform(500, 4000, (48, 64, 3))
    depth = np.ones((48, 64))
    if kind == "equal":
        points[:] = points[0, 0]
    elif kind == "line":
        points[:] = np.linspace(0, 1, 48)[:, None, None] * [1000, 0, 0] + [0, 0, 1500]
    elif kind == "far":
        points *= 1e4
    elif kind in ("none", "one"):
        depth[:] = 0
    elif kind == "few":
        depth[rng.random((48, 64)) < 0.9] = 0
    grid = SeedGrid.from_array(depth, (rows, columns), points_mm=points)
    if kind == "one":
        grid.depth_mm[0, 0] = 1
        grid.lattice_points_mm[0, 0] = points[0, 0]
    return grid


@settings(deadline=None, max_examples=60)
@given(
    seeds=odd_seeds(),
    nodes=st.sampled_from([1, 2, 3, 17, 60]),
    algorithm=st.sampled_from(["exact", "fast", "update"]),
    edge_metric=st.sampled_from(["3d", "image"]),
)
def test_degenerate_input_gives_a_sound_selection(seeds, nodes, algorithm, edge_metric):
    if algorithm == "update":
        selector = NeuralGasSelector(nodes, 2, edge_metric=edge_metric)
        selector.update(seeds)
        selection = selector.update(seeds)
    else:
        selector = NeuralGasSelector(nodes, 2, algorithm, edge_metric=edge_metric)
        selection = selector.select(seeds)
    assert selection.mask.shape == seeds.frame_shape
    assert np.isfinite(selection.nodes_mm).all() and np.isfinite(selection.nodes_uv).all()
    assert not (selection.mask & selection.complement).any()
    assert ((selection.score >= 0) & (selection.score <= 1)).all()
    assert (selection.score[~selection.mask] == 0).all()
    if len(seeds.uv) == 0:
        assert len(selection.nodes_mm) == 0
    else:
        low, high = seeds.points_mm.min(axis=0), seeds.points_mm.max(axis=0)
        slack = 1e-4 * np.abs(seeds.points_mm).max()
        assert (selection.nodes_mm >= low - slack).all()
        assert (selection.nodes_mm <= high + slack).all()
        assert math.isfinite(selection.quantisation_error_mm)


@pytest.mark.parametrize("algorithm", ["exact", "fast", "update"])
def test_nan_is_refused_with_a_sentence(algorithm):
    points = np.ones((48, 64, 3))
    seeds = SeedGrid.from_array(np.ones((48, 64)), (8, 8), points_mm=points)
    seeds.lattice_points_mm[2, 3] = np.nan
    selector = NeuralGasSelector(10, 2, "exact" if algorithm == "exact" else "fast")
    with pytest.raises(ValueError, match=r"1 of 64 samples have depth but no finite metric point"):
        (selector.update if algorithm == "update" else selector.select)(seeds)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"nodes": 0}, "nodes is 0; give at least 1"),
        ({"epochs": 0}, "epochs is 0; give at least 1"),
        ({"algorithm": "quick"}, "give 'exact' or 'fast'"),
        ({"seed": -1}, "seed is -1; give 0 or more"),
        ({"edge_metric": "4d"}, "give '3d' or 'image'"),
        ({"factor": 0.0}, "must be positive"),
        ({"factor": float("nan")}, "must be positive"),
    ],
)
def test_parameters_out_of_range_are_refused(arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        NeuralGasSelector(**arguments)


def panorama() -> SeedGrid:
    """A lidar's full turn in a round room: its rows end where they begin."""
    azimuth = np.linspace(-np.pi, np.pi, 512, endpoint=False)
    height = np.linspace(-500, 500, 64)
    points = np.stack(
        np.broadcast_arrays(3000 * np.sin(azimuth)[None, :], height[:, None], 3000 * np.cos(azimuth)[None, :]), axis=-1
    )
    return SeedGrid.from_array(np.full((64, 512), 3000.0), (32, 128), points_mm=points.astype(np.float32))


@pytest.mark.parametrize("algorithm", ["exact", "fast"])
def test_nodes_of_a_panorama_lie_at_the_pixels_of_their_seeds(algorithm):
    seeds = panorama()
    selection = NeuralGasSelector(400, 10, algorithm).select(seeds)
    azimuth = np.arctan2(selection.nodes_mm[:, 0], selection.nodes_mm[:, 2])
    column = (azimuth + np.pi) / (2 * np.pi) * 512
    off = np.abs((selection.nodes_uv[:, 0] - column + 256) % 512 - 256)
    assert np.median(off) < 4
    assert off.max() < 24  # a node's seeds span about ten columns
    assert len(selection.triangles) > 600


def test_nodes_of_a_camera_are_projected():
    camera = Camera.kinect(160, 120)
    seeds = SeedGrid.from_frame(DepthFrame(np.full((120, 160), 1000, np.uint16), 0, 0, camera), (30, 40))
    nodes = seeds.points_mm[::7]
    assert np.allclose(node_pixels(nodes, seeds), seeds.uv[::7], atol=1e-2)
