"""The kept model against one drawn pixel by pixel from the same triangles."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from selective_depth.selectors.triangulation import BRIDGE_PX, STEP_MM, TILE_PX, Surface

Case = tuple[tuple[int, int], npt.NDArray[np.int32], npt.NDArray[np.float32], list[int]]


@st.composite
def batches(draw: st.DrawFn) -> Case:
    """An image, samples of it with misses and steps among them, and where they are cut."""
    height, width = draw(st.integers(1, 40)), draw(st.integers(1, 40))
    count = draw(st.integers(1, min(90, height * width)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    index = rng.permutation(height * width)[:count]
    uv = np.stack((index % width, index // width), axis=-1).astype(np.int32)
    few = [0, 500, 510, 520, 900, 60_000]
    depth = rng.choice(few, count) if draw(st.booleans()) else rng.uniform(0.01, 4000, count)
    cuts = sorted(draw(st.lists(st.integers(0, count), max_size=4)))
    return (height, width), uv, depth.astype(np.float32), cuts


def filled(case: Case) -> Surface:
    shape, uv, depth_mm, cuts = case
    surface = Surface(shape)
    for part in np.split(np.arange(len(uv)), cuts):
        surface.add(uv[part], depth_mm[part])
    return surface


def reference(surface: Surface) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """The model, and where it is linear, by trying every triangle on every pixel."""
    layers = surface.layers
    rows, columns = np.indices(layers.depth_mm.shape)
    model = layers.samples_mm.ravel()[layers.nearest].astype(float)
    plain = np.zeros(model.shape, np.bool_)
    if surface._mesh is not None:
        plain |= layers.samples_mm > 0
    triangles = [] if surface._mesh is None else surface._mesh.real_triangles()
    for corners in triangles:
        at, z = surface._uv[corners].astype(float), surface._depth_mm[corners]
        longest = max(np.linalg.norm(at[i] - at[i - 1]) for i in range(3))
        if np.ptp(z) > STEP_MM and longest > BRIDGE_PX:
            continue
        weights = np.linalg.solve(
            np.vstack((at.T, np.ones(3))), np.stack((columns.ravel(), rows.ravel(), np.ones(rows.size)))
        )
        inside = (weights > -1e-9).all(axis=0).reshape(model.shape)
        model[inside] = (z @ weights).reshape(model.shape)[inside]
        plain |= inside
    return model, plain


@settings(max_examples=120, deadline=None)
@given(batches())
def test_the_model_is_that_of_its_triangles_however_the_samples_came(case: Case) -> None:
    shape, uv, depth_mm, _ = case
    surface = filled(case)
    layers = surface.layers
    if not (depth_mm > 0).any():
        assert not layers.depth_mm.any()
        return
    model, plain = reference(surface)
    np.testing.assert_allclose(layers.depth_mm, model, rtol=1e-4, atol=0.01)
    np.testing.assert_array_equal(layers.plain, plain)
    known = uv[depth_mm > 0]
    rows, columns = np.indices(shape)
    distance = (columns[..., None] - known[:, 0]) ** 2 + (rows[..., None] - known[:, 1]) ** 2
    np.testing.assert_array_equal(layers.gap_sq, distance.min(axis=-1))


@settings(max_examples=80, deadline=None)
@given(batches())
def test_in_whatever_order_and_batches_samples_come_all_is_the_same_to_the_last_bit(case: Case) -> None:
    shape, uv, depth_mm, _ = case
    ordered = np.lexsort((uv[:, 0], uv[:, 1]))
    at_once = filled((shape, uv[ordered], depth_mm[ordered], []))
    for layer, same in zip(filled(case).layers[:-1], at_once.layers[:-1], strict=True):
        np.testing.assert_array_equal(layer, same)


@settings(max_examples=40, deadline=None)
@given(batches())
def test_the_spread_is_the_variance_of_a_triangle_s_corners(case: Case) -> None:
    surface = filled(case)
    spread = surface.layers.spread_mm2
    variances = [0.0]
    if surface._mesh is not None:
        corners = surface._depth_mm[surface._mesh.real_triangles()]
        variances += corners.astype(float).var(axis=1).tolist()
    nearest = np.abs(np.array(variances)[:, None] - spread.ravel().astype(float)).min(axis=0)
    assert (nearest <= 1e-3 * (1 + spread.ravel())).all()


@settings(max_examples=60, deadline=None)
@given(batches())
def test_what_changes_is_booked_with_its_neighbours(case: Case) -> None:
    shape, uv, depth_mm, cuts = case
    surface = Surface(shape)
    for part in np.split(np.arange(len(uv)), cuts):
        before = [layer.copy() for layer in surface.layers[:-1]]
        surface.layers.touched[:] = False
        surface.add(uv[part], depth_mm[part])
        pairs = zip(before, surface.layers[:-1], strict=True)
        changed = np.logical_or.reduce([old != new for old, new in pairs])
        for v, u in np.argwhere(changed):
            rows = np.clip([v - 1, v, v + 1], 0, shape[0] - 1) // TILE_PX
            columns = np.clip([u - 1, u, u + 1], 0, shape[1] - 1) // TILE_PX
            assert surface.layers.touched[np.ix_(rows, columns)].all()


def test_a_batch_far_from_all_others_and_one_of_misses_change_what_they_must() -> None:
    surface = Surface((30, 200))
    surface.add(np.array([(1, 1), (5, 2), (2, 8)], np.int32), np.array([900, 910, 920]))
    before = surface.layers.depth_mm.copy()
    surface.add(np.array([(100, 20)], np.int32), np.array([0]))
    np.testing.assert_array_equal(surface.layers.depth_mm, before)
    surface.add(np.array([(199, 29)], np.int32), np.array([5000]))
    assert surface.layers.depth_mm[29, 190] == 5000
    assert surface.layers.gap_sq[29, 190] == 81


@pytest.mark.parametrize("threads", [1, 2])
def test_threads_do_not_matter(threads: int) -> None:
    rng = np.random.default_rng(5)
    index = rng.permutation(120 * 160)[:3000]
    uv = np.stack((index % 160, index // 160), axis=-1).astype(np.int32)
    depth_mm = rng.choice([1000, 1020, 3000], len(uv))
    one, other = Surface((120, 160), 1), Surface((120, 160), threads)
    one.add(uv, depth_mm)
    other.add(uv, depth_mm)
    for layer, same in zip(one.layers, other.layers, strict=True):
        np.testing.assert_array_equal(layer, same)
