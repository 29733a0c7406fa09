"""Memory: what observations are fused to, what shots are worth, what is forgotten, and honesty."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from selective_depth.drivers.open import open_source
from selective_depth.selectors.acquire import acquire
from selective_depth.selectors.arrays import pixels_where
from selective_depth.selectors.even import EvenSelector
from selective_depth.selectors.improvement import ImprovementSelector
from selective_depth.selectors.memory import TemporalAcquisition
from selective_depth.selectors.memory.change import Extent, around, contradicts, drift
from selective_depth.selectors.memory.store import AGREE_MM, AGREE_SHARE, KEPT, Memory, book, forget
from selective_depth.selectors.memory.temporal import PROBATION
from selective_depth.selectors.memory.worth import shot_worth, wrong
from selective_depth.selectors.neural_gas import LongEdgeSelector, NeuralGasSelector
from selective_depth.selectors.quality import errors_of
from selective_depth.selectors.seeds import SeedGrid
from selective_depth.selectors.triangulation import Mesh, Surface

SMALL = (96, 128)
SEEDS = (24, 32)


def wall(near_mm: int = 1200, u: int = 40) -> np.ndarray:
    """A box before a wall, with a hole."""
    depth = np.full(SMALL, 2000, np.uint16)
    depth[30:66, u : u + 40] = near_mm
    depth[5:15, 100:115] = 0
    return depth


def sensor(depth: np.ndarray):
    return lambda uv: depth[uv[:, 1], uv[:, 0]]


def fused_slowly(values: list[float]) -> tuple[float, int]:
    """The rule of `store`, written out: mean of what agrees with the middle one."""
    kept, before = [], 0.0
    for value in values:
        kept = [*kept, value][-KEPT:]
        ordered = sorted(kept)
        lower, upper = ordered[(len(kept) - 1) // 2], ordered[len(kept) // 2]
        middle = lower if abs(lower - before) <= abs(upper - before) else upper
        agreeing = [v for v in kept if abs(v - middle) <= max(AGREE_MM, AGREE_SHARE * middle)]
        before = float(np.mean(agreeing))
    return before, len(kept) - len(agreeing)


@settings(max_examples=80, deadline=None)
@given(
    st.lists(st.one_of(st.integers(990, 1010), st.integers(2490, 2510), st.integers(1, 60000)), min_size=1, max_size=70)
)
def test_observations_are_fused_as_the_rule_says(values: list[int]) -> None:
    memory = Memory.of((2, 2))
    at = np.array([[1, 0]], np.int32)
    for now, value in enumerate(values):
        book(memory, at, np.array([value], np.float32), now)
    expected, dissent = fused_slowly([float(v) for v in values])
    assert memory.fused_mm[0, 1] == pytest.approx(expected, rel=1e-5)
    assert memory.dissent[0, 1] == dissent
    assert memory.held[0, 1] == min(len(values), KEPT)
    assert memory.asked[0, 1] == len(values) - 1
    assert not memory.held[1].any()


def test_a_flickering_edge_is_one_of_its_surfaces_never_between() -> None:
    rng = np.random.default_rng(0)
    memory = Memory.of((1, 1))
    at = np.zeros((1, 2), np.int32)
    for now, near in enumerate(rng.random(40) < 0.4):
        book(memory, at, np.array([1000 if near else 2500], np.float32), now)
        assert memory.fused_mm[0, 0] in (1000, 2500)
    assert memory.fused_mm[0, 0] == 2500


def test_a_pixel_that_returns_no_more_is_known_no_more() -> None:
    memory = Memory.of((1, 2))
    both = np.array([[0, 0], [1, 0]], np.int32)
    book(memory, both, np.array([1000, 1000], np.float32), 0)
    for now in range(1, 4):
        book(memory, both[:1], np.zeros(1, np.float32), now)
    assert memory.held.tolist() == [[0, 1]]
    forget(memory, np.ones((1, 2), bool))
    assert not memory.held.any() and not memory.fused_mm.any()


def test_the_chance_of_a_wrong_majority_falls_with_agreement() -> None:
    assert wrong()[0, 0] == pytest.approx(0.5)
    assert (np.diff(wrong()[1:, 0]) < 0).all()
    assert wrong()[10, 5] == pytest.approx(0.5)
    assert wrong()[10, 1] < wrong()[10, 3] < wrong()[10, 5]


def worth_of(memory: Memory, model_mm: np.ndarray, now: int = 9) -> np.ndarray:
    layers = Surface(model_mm.shape).layers._replace(depth_mm=model_mm, gap_sq=np.zeros(model_mm.shape, np.int32))
    worth = np.empty(model_mm.shape, np.float32)
    tiles = np.arange(layers.touched.size)
    shot_worth(0, len(tiles), tiles, memory, layers, 40.0, (1.0, 1.4e-6), now, wrong(), worth)
    return worth


def test_a_shot_is_worth_most_where_an_edge_is_not_sure_and_nothing_twice_in_a_frame() -> None:
    model_mm = np.full((9, 30), 2000, np.float32)
    model_mm[:, 15:] = 1000
    memory = Memory.of(model_mm.shape)
    every = np.stack(np.meshgrid(np.arange(30), np.arange(9)), axis=-1).reshape(-1, 2)
    mm = model_mm[every[:, 1], every[:, 0]]
    for now in range(4):
        book(memory, every.astype(np.int32), mm, now)
    ambiguous = np.array([[20, 4]], np.int32)
    for now in (4, 5, 6):
        book(memory, ambiguous, np.array([2000], np.float32), now)
    worth = worth_of(memory, model_mm)
    assert np.unravel_index(worth.argmax(), worth.shape) == (4, 20)
    assert worth[4, 14] > 2 * worth[4, 3]
    book(memory, every.astype(np.int32), mm, 9)
    assert not worth_of(memory, model_mm).any()


def test_what_lies_outside_the_range_about_it_contradicts_and_a_miss_does_not() -> None:
    model_mm = np.full((20, 20), 2000, np.float32)
    model_mm[:, 10:] = 1000
    uv = np.array([[3, 3], [3, 4], [9, 5], [3, 6], [3, 7]], np.int32)
    mm = np.array([2000, 1000, 1000, 0, 2059], np.float32)
    assert contradicts(uv, mm, model_mm).tolist() == [False, True, False, False, False]
    assert around(np.array([[0, 0]], np.int32), (20, 20)).tolist() == [[0, 2], [2, 0]]


def test_a_moved_camera_shows_in_most_blocks_a_thing_that_moves_in_some() -> None:
    rng = np.random.default_rng(1)
    model_mm = np.full((120, 160), 2000, np.float32)
    uv = np.stack(np.meshgrid(np.arange(0, 160, 4), np.arange(0, 120, 4)), -1).reshape(-1, 2)
    noise_mm = np.full(len(uv), 6, np.float32)
    still = (2000 + rng.normal(0, 6, len(uv))).astype(np.float32)
    one = still.copy()
    one[(uv[:, 0] < 50) & (uv[:, 1] < 60)] -= 800
    assert drift(uv, still, model_mm, noise_mm) < 1.4
    assert drift(uv, one, model_mm, noise_mm) < 1.6
    assert drift(uv, still + 6, model_mm, noise_mm) > 2.2
    assert drift(uv, np.zeros(len(uv), np.float32), model_mm, noise_mm) == 0


def test_the_extent_of_a_change_follows_its_looks() -> None:
    extent = Extent((40, 40))
    uv = np.stack(np.meshgrid(np.arange(2, 40, 8), np.arange(2, 40, 8)), -1).reshape(-1, 2)
    extent.add(uv.astype(np.int32), uv[:, 0] < 20)
    changed, border_px = extent.changed()
    assert changed[:, :14].all() and not changed[:, 23:].any()
    assert (border_px > 0).any()
    assert not border_px[:, :13].any() and not border_px[:, 24:].any()


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_a_surface_whose_samples_change_equals_one_made_anew(seed: int, lattice: bool) -> None:
    """Samples come, get another depth, and are taken out again, on the hull and inside."""
    rng = np.random.default_rng(seed)
    surface, known = Surface(SMALL), np.zeros(SMALL, np.float32)
    for _ in range(6):
        if lattice and not known.any():
            known[:: int(rng.integers(1, 6)), :: int(rng.integers(2, 6))] = 1000
            surface.add(pixels_where(known > 0), known[known > 0])
        uv = pixels_in_a_bunch(rng)
        mm = rng.choice(np.array([0, 900, 1000, 1030, 4000], np.float32), len(uv))
        known[uv[:, 1], uv[:, 0]] = np.where(mm > 0, mm, known[uv[:, 1], uv[:, 0]])
        surface.put(uv, mm)
        assert_same(surface, known)
        out = pixels_in_a_bunch(rng)
        known[out[:, 1], out[:, 0]] = 0
        surface.remove(out)
        assert_same(surface, known)
        assert surface.points == np.count_nonzero(known)


def pixels_in_a_bunch(rng: np.random.Generator) -> np.ndarray:
    """Some pixels of a small frame, each once: of a box, which may be all of it."""
    (top, bottom), (left, right) = (np.sort(rng.choice(size + 1, 2, replace=False)) for size in SMALL)
    box = np.zeros(SMALL, bool)
    box[top:bottom, left:right] = rng.random((bottom - top, right - left)) < rng.choice([0.02, 0.1, 1.0])
    return pixels_where(box)


def assert_same(surface: Surface, known: np.ndarray) -> None:
    """Farther than a dozen pixels from all samples, a pixel now and then may take the second nearest."""
    anew = Surface(SMALL)
    anew.add(pixels_where(known > 0), known[known > 0])
    for name in ("samples_mm", "gap_sq", "depth_mm", "plain", "spread_mm2"):
        off = getattr(surface.layers, name) != getattr(anew.layers, name)
        assert not off[anew.layers.gap_sq < 12**2].any(), name
        assert np.count_nonzero(off) < off.size / 1000, name


def test_what_is_taken_out_leaves_the_triangulation_of_the_rest() -> None:
    rng = np.random.default_rng(7)
    uv = pixels_where(rng.random(SMALL) < 0.2)
    mesh = Mesh.of(uv)
    assert mesh is not None
    while len(uv) > 40:
        gone = rng.choice(len(uv), len(uv) // 5, replace=False).astype(np.int32)
        mesh.remove(gone)
        uv = np.delete(uv, gone, axis=0)
        np.testing.assert_array_equal(mesh.uv[: mesh.points], uv)
        left = {frozenset(map(tuple, uv[triangle])) for triangle in mesh.real_triangles()}
        anew = Mesh.of(uv)
        assert anew is not None
        assert left == {frozenset(map(tuple, uv[triangle])) for triangle in anew.real_triangles()}


@pytest.mark.parametrize("left", [0, 1, 2, 3])
def test_a_mesh_that_would_be_a_line_is_none(left: int) -> None:
    uv = np.array([[2 * u, 5] for u in range(left)] + [[3, 1], [4, 9]], np.int32)
    surface = Surface(SMALL)
    surface.add(uv, np.full(len(uv), 1000, np.float32))
    surface.remove(uv[left:])
    assert (surface.layers.depth_mm == (1000 if left else 0)).all()
    assert surface.points == left
    surface.add(uv[left:], np.full(2, 1000, np.float32))
    anew = Surface(SMALL)
    anew.add(uv, np.full(len(uv), 1000, np.float32))
    np.testing.assert_array_equal(surface.layers.plain, anew.layers.plain)


SELECTORS = {
    "its own": None,
    "improvement": ImprovementSelector(),
    "even": EvenSelector(),
    "long edges": LongEdgeSelector(NeuralGasSelector(nodes=60)),
    "a function": lambda samples: samples.gap_px(),
}


def rich(index: int) -> np.ndarray:
    """A scene that changes, with noise."""
    rng = np.random.default_rng(index)
    depth = wall(1200, 40 if index < 5 else 50).astype(int) + rng.integers(-5, 6, SMALL)
    return np.where(wall() == 0, 0, depth).astype(np.uint16)


@pytest.mark.parametrize("name", SELECTORS)
def test_nothing_is_known_that_was_not_asked_for(name: str) -> None:
    """All pixels that a run does not measure are changed: it measures the same, and knows it."""
    asked = [np.zeros(SMALL, bool) for _ in range(8)]

    def run(frames: list[np.ndarray], note: bool) -> list[tuple[np.ndarray, np.ndarray]]:
        memory = TemporalAcquisition(SMALL, budget=0.05, seeds=SEEDS, selector=SELECTORS[name])
        found = []
        for index, depth in enumerate(frames):

            def measure(uv: np.ndarray, depth=depth, index=index) -> np.ndarray:
                assert not asked[index][uv[:, 1], uv[:, 0]].any() or not note
                if note:
                    asked[index][uv[:, 1], uv[:, 0]] = True
                return depth[uv[:, 1], uv[:, 0]]

            step = memory.step(measure)
            found.append((step.uv, step.model_mm))
        return found

    frames = [rich(index) for index in range(8)]
    first = run(frames, note=True)
    for index, (uv, _) in enumerate(first):
        assert asked[index].sum() == len(uv), "each pixel once a frame, and all are told"
    other = [np.where(seen, depth, 60_000) for seen, depth in zip(asked, frames, strict=True)]
    for (uv, model), (uv_too, model_too) in zip(first, run(other, note=False), strict=True):
        np.testing.assert_array_equal(uv, uv_too)
        np.testing.assert_array_equal(model, model_too)


def test_the_budget_is_kept_in_every_frame_after_the_first() -> None:
    memory = TemporalAcquisition(SMALL, budget=0.03, seeds=SEEDS)
    counts = [len(memory.step(sensor(rich(index))).uv) for index in range(9)]
    assert counts[0] == SEEDS[0] * SEEDS[1] + round(0.05 * wall().size)
    assert max(counts[1:]) <= round(0.03 * wall().size)


def test_what_moved_is_forgotten_and_the_rest_is_not() -> None:
    memory = TemporalAcquisition(SMALL, budget=0.05, seeds=SEEDS)
    for _ in range(5):
        memory.step(sensor(wall()))
    changed = np.zeros(SMALL, bool)
    for _ in range(3):
        step = memory.step(sensor(wall(u=52)))
        changed |= step.changed
        assert not step.restarted
    assert changed[40:60, 42:50].mean() > 0.9, "where it was"
    assert changed[40:60, 84:90].mean() > 0.9, "where it is"
    assert not changed[80:].any() and not changed[:, :25].any()
    assert errors_of(step.model_mm, wall(u=52)).rmse_mm < 40


def test_a_cut_is_a_fresh_start() -> None:
    memory = TemporalAcquisition(SMALL, budget=0.03, seeds=SEEDS)
    for _ in range(4):
        memory.step(sensor(wall()))
    other = np.tile(np.linspace(900, 1500, SMALL[1]).astype(np.uint16), (SMALL[0], 1))
    step = memory.step(sensor(other))
    assert step.restarted and step.changed.all()
    fresh = TemporalAcquisition(SMALL, budget=0.03, seeds=SEEDS).step(sensor(other))
    assert (step.known == (fresh.known)).mean() > 0.95
    assert errors_of(step.model_mm, other).rmse_mm < 1.1 * errors_of(fresh.model_mm, other).rmse_mm


def test_where_the_budget_pays_for_it_a_memory_is_on_probation() -> None:
    memory = TemporalAcquisition(SMALL, budget=0.2, seeds=SEEDS)
    steps = [memory.step(sensor(wall())) for _ in range(PROBATION + 2)]
    assert [step.settled for step in steps] == [False] * (PROBATION + 1) + [True]
    plain = acquire(
        sensor(wall()), SeedGrid.from_array(wall(), SEEDS), rounds=4,
        shots=round(0.2 * wall().size) - SEEDS[0] * SEEDS[1],
    )  # fmt: skip
    np.testing.assert_array_equal(steps[3].model_mm, plain.reconstruct())


def test_repeats_are_worth_it_on_a_noisy_still_scene() -> None:
    source = open_source("virtual:workstation?speed=0&frames=10&size=320x240")
    truth = open_source("virtual:workstation?speed=0&noise=off&size=320x240").read().depth_mm
    memory = TemporalAcquisition((240, 320), budget=0.05, seeds=(64, 64))
    known, errors = [], []
    for frame in source:
        step = memory.step(frame.measure)
        known.append(int(step.known.sum()))
        seen = np.where(frame.depth_mm > 0, truth, 0)
        errors.append(errors_of(step.model_mm, seen).rmse_mm)
        whole = errors_of(np.where(seen > 0, frame.depth_mm, 1), seen).rmse_mm
    assert known == sorted(known)
    assert errors[-1] < 0.75 * errors[0]
    assert errors[-1] < 0.8 * whole
