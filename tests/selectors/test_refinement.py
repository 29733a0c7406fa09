"""The finer lattice that is measured first where seeds are few: even, near depth, affordable."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from selective_depth.selectors.acquire import StepSelector, acquire
from selective_depth.selectors.acquire.refinement import COARSE_PX, HOLE_PITCHES, SHARE, finer_lattice
from selective_depth.selectors.samples import Samples, seed_pitch_px
from selective_depth.selectors.seeds import SeedGrid
from selective_depth.selectors.selection import Plan, plan_of


def flat(lattice: tuple[int, int], shape: tuple[int, int] = (120, 160)) -> SeedGrid:
    return SeedGrid.from_array(np.full(shape, 2000, np.uint16), lattice)


@example(rows=15, columns=2, shots=4473, seed=0)  # its rows are full long before its columns
@given(rows=st.integers(1, 40), columns=st.integers(1, 40), shots=st.integers(0, 20_000), seed=st.integers(0, 99))
@settings(deadline=None)
def test_new_pixels_are_no_seeds_not_deep_in_holes_and_within_the_budget(
    rows: int, columns: int, shots: int, seed: int
) -> None:
    holes = np.random.default_rng(seed).random((120, 160)) < seed / 100
    seeds = SeedGrid.from_array(np.where(holes, 0, 2000).astype(np.uint16), (rows, columns))
    uv, pitch_px = finer_lattice(seeds, shots)
    assert len(uv) <= SHARE * shots
    assert pitch_px == seed_pitch_px(seeds) or seed_pitch_px(seeds) > COARSE_PX
    pixels = {tuple(pixel) for pixel in uv.tolist()}
    assert len(pixels) == len(uv), "a pixel twice"
    assert not pixels & {tuple(pixel) for pixel in seeds.lattice_uv.reshape(-1, 2).tolist()}
    if len(uv):
        assert uv.min() >= 0
        assert uv[:, 0].max() < 160
        assert uv[:, 1].max() < 120
        apart = np.hypot(*(uv[:, None] - seeds.uv[None]).transpose(2, 0, 1)).min(axis=1)
        assert apart.max() <= HOLE_PITCHES * seed_pitch_px(seeds)


@pytest.mark.parametrize(("shots", "steps"), [(100, 0), (600, 1), (2000, 2)])
def test_the_gaps_shrink_as_said(shots: int, steps: int) -> None:
    """12x16 seeds, 10 px apart; the widest gap inside the lattice is half its diagonal."""
    seeds = flat((12, 16))
    uv, pitch_px = finer_lattice(seeds, shots)
    assert pitch_px == pytest.approx(10 / 2 ** (steps / 2))
    measured = np.concatenate((seeds.lattice_uv.reshape(-1, 2), uv))
    rows, columns = np.mgrid[20:100, 20:140]
    gaps = np.hypot(columns[..., None] - measured[:, 0], rows[..., None] - measured[:, 1]).min(axis=-1)
    assert gaps.max() <= pitch_px / 2**0.5 + 0.5


@pytest.mark.parametrize(("shots", "widest_px"), [(3276, 16), (20_000, 8), (60_000, 4)])
def test_the_pitch_is_the_widest_step_where_an_axis_is_full(shots: int, widest_px: int) -> None:
    """Every row has seeds: one step halves the gaps along it, as nothing can come between."""
    seeds = flat((64, 64), (64, 1024))
    uv, pitch_px = finer_lattice(seeds, shots)
    measured = np.zeros(seeds.frame_shape, np.bool_)
    measured[seeds.uv[:, 1], seeds.uv[:, 0]] = True
    measured[uv[:, 1], uv[:, 0]] = True
    gaps_px = [np.diff(np.flatnonzero(row)).max() for row in measured]
    assert max(gaps_px) == widest_px == pytest.approx(pitch_px, rel=0.01)


def test_the_last_row_and_column_are_reached() -> None:
    """12x16 seeds end 5 px before the border, half a step: the lattice goes on to the border."""
    uv, _ = finer_lattice(flat((12, 16)), 600)
    assert uv.max(axis=0).tolist() == [159, 119]


def test_distances_are_judged_by_the_finer_lattice() -> None:
    class Spy(StepSelector):
        def plan(self, samples: Samples) -> Plan:
            pitches_px.append(samples.pitch_px)
            return plan_of(StepSelector(), samples)

    pitches_px: list[float] = []
    seeds = flat((12, 16))
    for rounds in (1, 4):
        acquire(lambda uv: np.full(len(uv), 2000, np.uint16), seeds, 2000, rounds, Spy())
    assert pitches_px == [10, finer_lattice(seeds, 2000)[1]] == [10, 5]


def test_a_bar_between_coarse_seeds_is_found() -> None:
    depth = np.full((120, 160), 2000, np.uint16)
    depth[:, 79:82] = 1000  # seeds are at columns 75 and 85
    seeds = SeedGrid.from_array(depth, (12, 16))
    assert (seeds.depth_mm == 2000).all()
    model = acquire(lambda uv: depth[uv[:, 1], uv[:, 0]], seeds, 1500, rounds=4)
    assert model.rounds[0].shots == len(finer_lattice(seeds, 1500)[0])
    assert sum(r.shots for r in model.rounds) == 1500
    wrong = np.abs(model.reconstruct() - depth) > 50
    assert wrong.mean() < 0.002


def test_a_thing_in_a_hole_that_no_seed_met_is_found() -> None:
    depth = np.full((120, 160), 2000, np.uint16)
    depth[30:90, 60:100] = 0
    depth[56:64, 76:84] = 800  # seeds are at 55 and 65, 75 and 85
    seeds = SeedGrid.from_array(depth, (12, 16))
    assert not (seeds.depth_mm == 800).any()
    model = acquire(lambda uv: depth[uv[:, 1], uv[:, 0]], seeds, 1500, rounds=4)
    assert np.abs(model.reconstruct()[56:64, 76:84] - 800).max() < 1


def test_one_round_and_fine_seeds_spend_everything_on_the_score() -> None:
    assert not len(finer_lattice(flat((24, 32)), 100_000)[0])
    seeds = flat((12, 16))
    first = acquire(lambda uv: np.full(len(uv), 2000, np.uint16), seeds, 1500, rounds=1)
    assert [r.shots for r in first.rounds] == [1500]
