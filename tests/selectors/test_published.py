"""Eq. (27) as a path of its own, against eq. (13), and the map that is kept between rounds."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kriging_systems import local_systems
from reference_kriging import reference_pixel

from selective_depth.selectors.acquire import acquire
from selective_depth.selectors.improvement import ImprovementSelector
from selective_depth.selectors.samples import Samples
from selective_depth.selectors.seeds import SeedGrid
from selective_depth.selectors.selection import plan_of


def ratios(shared_data, frames, pixels):
    """Map over eq. (13) at random known pixels that have a nugget in all of their systems."""
    rng = np.random.default_rng(27)
    found = []
    paths = sorted((shared_data / "sequence").glob("*.png"))[:: 120 // frames]
    for path in paths:
        seeds = SeedGrid.from_array(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        chosen = ImprovementSelector(exponent=1.999, by_sums=True).select(seeds)
        v, u = np.nonzero(chosen.raw > 0)
        for n in rng.integers(0, len(v), pixels // len(paths)):
            systems_here = local_systems(seeds, int(u[n]), int(v[n]), 1.999)
            if all(each.b > 0 for each in systems_here):
                expected = reference_pixel(seeds, int(u[n]), int(v[n]), 1.999)[2]
                found.append(chosen.raw[v[n], u[n]] / expected)
    return np.array(found)


def test_the_map_by_sums_equals_eq_13(shared_data):
    found = ratios(shared_data, 4, 300)
    assert len(found) > 100
    assert np.mean(np.abs(found - 1) <= 1e-3) >= 0.99


@pytest.mark.slow
def test_the_map_by_sums_equals_eq_13_at_2000_pixels_of_10_frames(shared_data):
    found = ratios(shared_data, 10, 2000)
    print(len(found), "with a nugget; ratio", np.percentile(found, (0.5, 50, 99.5)))
    assert np.mean(np.abs(found - 1) <= 1e-3) >= 0.99


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_a_map_kept_between_rounds_equals_the_whole_map_anew(seed, by_sums):
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:96, :128]
    depth = 1500 + 3 * u + 600 * (rng.uniform(-1, 1) * (u - 64) + rng.uniform(-1, 1) * (v - 48) > 0)
    depth = np.where(rng.random((96, 128)) < 0.1, 0, depth + rng.integers(0, 9, (96, 128)))
    seeds = SeedGrid.from_array(depth.astype(np.uint16), (24, 26))
    rule = ImprovementSelector(exponent=1.9 if by_sums else 1.2, by_sums=by_sums)

    class Plainly:  # no plan: everything anew in every round
        name = "plainly"
        select = rule.select

    def measure(uv):
        return depth[uv[:, 1], uv[:, 0]]

    kept, anew = (acquire(measure, seeds, 0.05, 4, by).uv for by in (rule, Plainly()))
    np.testing.assert_array_equal(kept, anew)


def test_a_round_maps_again_only_where_something_was_measured(monkeypatch):
    from selective_depth.selectors.improvement import selector as room

    depth = np.full((480, 640), 2000, np.uint16)
    depth[200:300, 200:400] = 1000
    samples = Samples.of(SeedGrid.from_array(depth))
    plan = plan_of(ImprovementSelector(), samples)
    asked = []
    plainly = room.map_scattered
    monkeypatch.setattr(
        room,
        "map_scattered",
        lambda measured, where, *rest, **more: (
            asked.append(float(where.mean())) or plainly(measured, where, *rest, **more)
        ),
    )
    for _ in range(3):
        uv = plan.best(200)
        samples.add(uv, depth[uv[:, 1], uv[:, 0]])
    assert asked[0] == 1
    assert all(0 < share < 0.2 for share in asked[1:])
