"""The improvement map: the published definition, its symmetries, and sense on real frames."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_kriging import reference_pixel
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import cKDTree

from selective_depth.selectors.improvement import ImprovementSelector
from selective_depth.selectors.improvement.map import LEVEL_SHIFT, LEVELS, best_threshold
from selective_depth.selectors.improvement.scattered import EXPONENT, improvement_scattered
from selective_depth.selectors.seeds import SeedGrid

SHAPE = (96, 128)
LATTICE = (24, 26)


def frames(folder: Path, name: str, step: int) -> list[np.ndarray]:
    paths = sorted((folder / name).glob("*.png"))[::step]
    assert paths
    return [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths]


@st.composite
def scenes(draw):
    """Depth images with planes, steps, noise and holes, from constant to extreme."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    depth = 900 + rng.uniform(-3, 3) * u + rng.uniform(-3, 3) * v
    for _ in range(draw(st.integers(0, 3))):
        near = rng.uniform(-1, 1) * (u - rng.uniform(0, 128)) + rng.uniform(-1, 1) * (v - 48) > 0
        depth = np.where(near, depth + draw(st.sampled_from((5, 300, 6000))), depth)
    depth = depth + draw(st.sampled_from((0, 2, 40))) * rng.normal(size=SHAPE)
    depth = np.clip(depth, 400, 10_000).round()
    holes = rng.random(SHAPE) < draw(st.sampled_from((0, 0.05, 0.5, 0.97)))
    if draw(st.booleans()):
        holes |= (u - rng.uniform(0, 128)) ** 2 + (v - rng.uniform(0, 96)) ** 2 < 900
    return np.where(holes, 0, depth).astype(np.float32)


def selected(depth, lattice=LATTICE, **options):
    return ImprovementSelector(**options).select(SeedGrid.from_array(depth, lattice))


@settings(max_examples=25, deadline=None)
@given(scenes())
def test_every_pixel_is_finite_and_in_range(depth):
    found = selected(depth)
    known = found.known
    assert np.isfinite(found.score).all()
    assert found.score.min() >= 0
    assert found.score.max() <= 1
    assert np.isfinite(found.raw).all()
    assert found.raw.min() >= 0
    assert np.isfinite(found.estimate_mm[known]).all()
    assert (found.estimate_mm[known] > 0).all()
    assert (found.variance_mm2[known] >= 0).all()
    assert np.isnan(found.estimate_mm[~known]).all()
    assert (found.score[~known] == 0).all()
    assert not found.mask[~known].any()
    assert found.mask.sum() <= 0.10 * known.sum()


@settings(max_examples=15, deadline=None)
@given(scenes(), st.integers(0, 1000))
def test_pixels_equal_eq_13_solved_directly(depth, seed):
    seeds = SeedGrid.from_array(depth, LATTICE)
    found = ImprovementSelector().select(seeds)
    rng = np.random.default_rng(seed)
    v, u = np.nonzero(found.known)
    if len(v) == 0:
        return
    for n in rng.integers(0, len(v), 6):
        assert_pixel(found, seeds, u[n], v[n])


def assert_pixel(found, seeds, u, v):
    z, variance, improvement = reference_pixel(seeds, int(u), int(v), EXPONENT)
    assert found.estimate_mm[v, u] == pytest.approx(z, rel=1e-3)
    # Beside extreme noise a, b >= 0 may be decided by rounding; the scale is the pixel's own.
    assert found.variance_mm2[v, u] == pytest.approx(variance, rel=2e-3, abs=1e-6 * z)
    assert found.raw[v, u] == pytest.approx(improvement, rel=2e-3, abs=1e-9 * z)


@settings(max_examples=15, deadline=None)
@given(scenes())
def test_mirroring_the_lattice_mirrors_the_map(depth):
    seeds = SeedGrid.from_array(depth, LATTICE)
    width = seeds.frame_shape[1]
    mirrored = SeedGrid(
        columns=(width - 1 - seeds.columns[::-1]).astype(np.int32),
        rows=seeds.rows,
        depth_mm=np.ascontiguousarray(seeds.depth_mm[:, ::-1]),
        frame_shape=seeds.frame_shape,
        camera=seeds.camera,
    )
    here, there = (ImprovementSelector().select(grid) for grid in (seeds, mirrored))
    np.testing.assert_array_equal(here.known, there.known[:, ::-1])
    np.testing.assert_allclose(here.score, there.score[:, ::-1], rtol=2e-3, atol=1e-5)


@settings(max_examples=15, deadline=None)
@given(scenes(), st.sampled_from((0.25, 0.3, 2.0, 3.7)))
def test_score_does_not_change_with_the_unit_of_depth(depth, factor):
    here, there = selected(depth), selected(depth * np.float32(factor))
    np.testing.assert_allclose(here.score, there.score, rtol=2e-3, atol=1e-5)
    np.testing.assert_array_equal(here.known, there.known)


@pytest.mark.parametrize("holes", [0.0, 0.4])
def test_score_is_one_half_where_a_share_of_the_measured_depth_is_gained(holes):
    rng = np.random.default_rng(0)
    depth = rng.uniform(800, 4000, SHAPE).astype(np.float32)
    depth[rng.random(SHAPE) < holes] = 0
    seeds = SeedGrid.from_array(depth, LATTICE)
    found = ImprovementSelector().select(seeds)
    half = 5e-4 * seeds.depth_mm[seeds.valid].mean()
    expected = np.where(found.known, found.raw / (found.raw + half), 0)
    np.testing.assert_allclose(found.score, expected, rtol=1e-5)


@pytest.mark.parametrize("depth_mm", [400, 1234, 10_000])
def test_constant_depth_improves_nowhere(depth_mm):
    found = selected(np.full(SHAPE, depth_mm, np.float32))
    assert (found.score == 0).all()
    assert not found.mask.any()
    assert found.known.all()
    np.testing.assert_allclose(found.estimate_mm, depth_mm, rtol=1e-6)


@settings(max_examples=20, deadline=None)
@given(st.floats(1, 4000), st.floats(1.05, 3), st.floats(0.2, 0.8), st.booleans())
def test_score_does_not_fall_as_a_step_grows(height_mm, factor, place, upright):
    """One straight step between two constant depths: raw and score rise everywhere, or stay.

    raw rises with the square of the height over a depth that grows at most in proportion; the
    scale of the score is a share of the mean depth, which does not outgrow it either.
    """
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    far = (u > place * SHAPE[1]) if upright else (v > place * SHAPE[0])
    low = selected(np.where(far, 800 + height_mm, 800).astype(np.float32))
    high = selected(np.where(far, 800 + factor * height_mm, 800).astype(np.float32))
    slack = 1e-4
    assert (high.raw >= low.raw * (1 - slack) - 1e-12).all()
    assert (high.score >= low.score * (1 - slack) - 1e-7).all()
    assert high.score.max() > 0


@settings(max_examples=15, deadline=None)
@given(scenes())
def test_lattice_and_general_path_agree(depth):
    seeds = SeedGrid.from_array(depth, LATTICE)
    here = ImprovementSelector().select(seeds)
    there = improvement_scattered(seeds.uv, seeds.depth_mm[seeds.valid], SHAPE, lattice=LATTICE)
    np.testing.assert_array_equal(here.known, there.known)
    known = here.known
    np.testing.assert_allclose(here.estimate_mm[known], there.estimate_mm[known], rtol=1e-4)
    np.testing.assert_allclose(here.raw, there.raw, rtol=2e-3, atol=1e-6)
    np.testing.assert_allclose(here.variance_mm2[known], there.variance_mm2[known], rtol=2e-3, atol=1e-3)


def test_threads_change_nothing(shared_data):
    seeds = SeedGrid.from_array(frames(shared_data, "sequence", 60)[0])
    one, two, five = (ImprovementSelector(threads=n).select(seeds) for n in (1, 2, 5))
    for other in (two, five):
        np.testing.assert_array_equal(one.raw, other.raw)
        np.testing.assert_array_equal(one.estimate_mm, other.estimate_mm)
        np.testing.assert_array_equal(one.mask, other.mask)
        np.testing.assert_array_equal(one.known, other.known)


@pytest.mark.parametrize(
    ("frame", "lattice"),
    [((240, 320), (64, 64)), ((240, 320), (128, 128)), ((96, 128), (1, 32)), ((96, 128), (32, 1)),
     ((60, 80), (1, 1)), ((60, 80), (60, 80)), ((60, 80), (7, 9)), ((300, 500), (101, 99)),
     ((1024, 1280), (64, 64))],
)  # fmt: skip
def test_any_lattice(frame, lattice):
    v, u = np.mgrid[: frame[0], : frame[1]]
    depth = np.where(u * 2 + v > frame[1], 1500 + u, 900 + v).astype(np.float32)
    seeds = SeedGrid.from_array(depth, lattice)
    found = ImprovementSelector().select(seeds)
    assert np.isfinite(found.score).all()
    known = found.known
    if lattice == (1, 1):
        return
    rng = np.random.default_rng(0)
    rows, columns = np.nonzero(known)
    for n in rng.integers(0, len(rows), 8):
        assert_pixel(found, seeds, columns[n], rows[n])
    if min(lattice) > 1:
        assert known.mean() > 0.9


@pytest.mark.parametrize("left", [0, 1, 2])
def test_few_seeds_left(left):
    depth = np.zeros(SHAPE, np.float32)
    seeds = SeedGrid.from_array(depth, LATTICE)
    kept = np.zeros_like(seeds.depth_mm)
    kept[10, 12 : 12 + left] = [1000, 1010][:left]
    seeds = SeedGrid(seeds.columns, seeds.rows, kept, SHAPE, seeds.camera)
    found = ImprovementSelector().select(seeds)
    assert np.isfinite(found.score).all()
    if left < 2:  # one sample tells nothing of how depth varies
        assert not found.known.any()
    else:
        assert 0 < found.known.sum() < 400
        values = found.estimate_mm[found.known]
        assert values.min() > 990
        assert values.max() < 1020


def test_pixels_far_from_every_sample_are_unknown(shared_data):
    for depth in frames(shared_data, "sequence", 60) + frames(shared_data, "tabletop", 6):
        seeds = SeedGrid.from_array(depth)
        known = ImprovementSelector().select(seeds).known
        v, u = np.nonzero(known)
        distance = cKDTree(seeds.uv).query(np.stack((u, v), axis=1))[0]
        assert distance.max() <= 6.5


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.booleans())
def test_threshold_takes_the_best_and_no_halves_of_ties(seed, share, ties):
    rng = np.random.default_rng(seed)
    raw = np.exp(rng.normal(0, 8, 4000)).astype(np.float32)
    raw[rng.random(4000) < 0.3] = 0
    if ties:
        raw = np.round(raw, 0).astype(np.float32)
    histogram = np.bincount(raw.view(np.int32) >> LEVEL_SHIFT, minlength=LEVELS)
    wanted = int(share * len(raw))
    mask = raw >= best_threshold(raw, histogram, wanted)
    assert mask.sum() <= wanted
    assert not mask[raw == 0].any()
    if mask.any() and not mask.all():
        assert raw[mask].min() > raw[~mask].max()
    # No more could have been taken: the next value would not fit.
    rest = raw[~mask & (raw > 0)]
    if len(rest):
        assert mask.sum() + (rest == rest.max()).sum() > wanted


@pytest.mark.parametrize("width", [127, 128])
def test_the_last_column_counts_towards_the_share(width):
    """A step along the right border is the best there is, and no two pixels are alike."""
    depth = 2000 + np.random.default_rng(width).normal(0, 2, (48, width))
    depth[:, -4:] -= 1000
    found = selected(depth.astype(np.float32), (12, 16), share=0.05)
    assert found.raw.max(axis=0).argmax() == width - 1
    assert found.mask[:, -1].all()
    assert found.mask.sum() == int(0.05 * found.known.sum())


def test_scattered_samples_change_only_what_lies_near(shared_data):
    depth = frames(shared_data, "sequence", 60)[0]
    seeds = SeedGrid.from_array(depth)
    rng = np.random.default_rng(1)
    extra = np.stack((rng.integers(300, 340, 200), rng.integers(200, 240, 200)), axis=1)
    uv = np.concatenate((seeds.uv, extra))
    values = np.concatenate((seeds.depth_mm[seeds.valid], depth[extra[:, 1], extra[:, 0]]))
    before = improvement_scattered(seeds.uv, seeds.depth_mm[seeds.valid], depth.shape)
    after = improvement_scattered(uv, values, depth.shape)
    changed = before.raw != after.raw
    v, u = np.nonzero(changed)
    assert changed.any()
    assert u.min() > 285
    assert u.max() < 355
    assert v.min() > 185
    assert v.max() < 255
    measured = values[-200:] > 0
    assert (after.raw[extra[measured, 1], extra[measured, 0]] == 0).all()
    # Asking for a part gives the same numbers there.
    where = np.zeros(depth.shape, np.bool_)
    where[180:260, 280:360] = True
    part = improvement_scattered(uv, values, depth.shape, where)
    np.testing.assert_array_equal(part.raw[where], after.raw[where])
    assert (part.raw[~where] == 0).all()


def test_too_coarse_a_lattice_is_named():
    with pytest.raises(ValueError, match="Take more seeds, for example 64x64"):
        selected(np.full((480, 640), 1000, np.float32), (2, 2))


def test_wrong_input_is_named():
    with pytest.raises(ValueError, match=r"share is 1\.5"):
        ImprovementSelector(share=1.5)
    with pytest.raises(ValueError, match="exponent is 2"):
        ImprovementSelector(exponent=2)
    with pytest.raises(ValueError, match="outside the frame of 128x96"):
        improvement_scattered(np.array([[128, 0]]), np.array([1000]), SHAPE)
    with pytest.raises(ValueError, match="uv must be whole numbers of shape"):
        improvement_scattered(np.zeros((2, 3), int), np.zeros(2), SHAPE)
    with pytest.raises(ValueError, match="where must be a number for every pixel"):
        improvement_scattered(np.zeros((0, 2), int), np.zeros(0), SHAPE, np.ones((2, 2), bool))


def test_real_frames_equal_eq_13(shared_data):
    """2,000 pixels of 10 + 12 frames, a third of them beside holes or at borders.

    Relative differences to eq. (13) in float64 when written: estimate 2e-7, variance 1e-5,
    improvement 5e-6 at the worst pixel; 4e-8, 2e-7 and 2e-7 at the median.
    """
    rng = np.random.default_rng(5)
    off = []
    for depth in frames(shared_data, "sequence", 12) + frames(shared_data, "tabletop", 1):
        seeds = SeedGrid.from_array(depth)
        found = ImprovementSelector().select(seeds)
        near_hole = cv2.dilate((~seeds.valid).astype(np.uint8), np.ones((3, 3)),
                               borderType=cv2.BORDER_CONSTANT, borderValue=1) > 0  # fmt: skip
        irregular = cv2.resize(near_hole.astype(np.uint8), depth.shape[::-1],
                               interpolation=cv2.INTER_NEAREST) > 0  # fmt: skip
        for region, count in ((irregular, 30), (~irregular, 61)):
            v, u = np.nonzero(found.known & region)
            for n in rng.integers(0, len(v), count):
                expected = np.array(reference_pixel(seeds, int(u[n]), int(v[n]), EXPONENT))
                got = np.array([m[v[n], u[n]] for m in
                                (found.estimate_mm, found.variance_mm2, found.raw)])  # fmt: skip
                off.append(np.abs(got - expected) / np.maximum(expected, 1e-6))
    worst = np.array(off)
    assert len(worst) >= 2000
    print("relative difference, estimate, variance, improvement:")
    for share in (50, 99, 99.9, 100):
        print(f"  {share} %: ", np.percentile(worst, share, axis=0))
    assert (np.percentile(worst, 99.9, axis=0) <= 1e-3).all()


def step_shares(values, known, centres, axis):
    """Mean differences across the two borders of a cell (left and right of its seeds) and
    across the border between seed-centred cells, over those elsewhere."""
    values, known = (values, known) if axis else (values.T, known.T)
    difference = np.abs(np.diff(values, axis=1))
    both = known[:, 1:] & known[:, :-1]
    index = np.arange(difference.shape[1])
    pixels, count = values.shape[1], len(centres)
    on_seeds = np.isin(index, centres) | np.isin(index, centres - 1)
    between = np.isin(index, -(-np.arange(1, count) * pixels // count) - 1)

    def mean(columns):
        return difference[:, columns][both[:, columns]].mean()

    return (
        mean(np.isin(index, centres)) / mean(~on_seeds),
        mean(np.isin(index, centres - 1)) / mean(~on_seeds),
        mean(between) / mean(~between),
    )


def test_no_seams(shared_data):
    """Steps of the raw map across borders over those elsewhere, at most 2 in every frame.

    When written: beside the seeds' columns 1.56 in the worst frame, 1.36 in the mean; beside
    their rows 1.53 and 1.38; between seed-centred cells 0.93 and 0.71, 0.92 and 0.83.
    """
    worst = []
    for depth in frames(shared_data, "tabletop", 1):
        seeds = SeedGrid.from_array(depth)
        found = ImprovementSelector().select(seeds)
        worst.append(
            step_shares(found.raw, found.known, seeds.columns, 1) + step_shares(found.raw, found.known, seeds.rows, 0)
        )
    print("columns: right, left of seeds, between cells; rows likewise")
    print(np.max(worst, axis=0).round(2), "mean", np.mean(worst, axis=0).round(2))
    assert np.max(worst) <= 2


def linear_interpolation(depth, seeds):
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    values = seeds.depth_mm[seeds.valid]
    linear = LinearNDInterpolator(seeds.uv, values)(u, v)
    outside = np.isnan(linear)
    pixels = np.stack((u[outside], v[outside]), axis=1)
    linear[outside] = values[cKDTree(seeds.uv).query(pixels)[1]]
    return linear


@pytest.mark.parametrize("step", [60, pytest.param(10, marks=pytest.mark.slow)])
def test_best_tenth_holds_the_interpolation_error(shared_data, step):
    """Share of the squared error of linear interpolation that the mask holds.

    Mean over every 10th frame when written: 97.3 %, least 94.9 %; the gradient of the
    interpolated depth 98.6 %.
    """
    shares, gradient_shares = [], []
    for depth in frames(shared_data, "sequence", step):
        seeds = SeedGrid.from_array(depth)
        found = ImprovementSelector().select(seeds)
        linear = linear_interpolation(depth, seeds)
        error = np.where(depth > 0, (linear - depth) ** 2, 0)
        shares.append(error[found.mask].sum() / error.sum())
        slope = np.where(found.known, np.hypot(*np.gradient(linear)), -1)
        best = np.argpartition(slope.ravel(), -found.mask.sum())[-found.mask.sum() :]
        gradient_shares.append(error.ravel()[best].sum() / error.sum())
    for name, held in (("improvement", shares), ("gradient", gradient_shares)):
        print(f"{name}: {np.mean(held):.4f}, least {np.min(held):.4f}")
    assert np.mean(shares) >= 0.95


@pytest.mark.parametrize("exponent", [0.0, -1.0, 1.99999, 2.0, np.nan])
def test_an_exponent_that_leaves_only_rounding_is_refused(exponent):
    with pytest.raises(ValueError, match="give more than 0 and at most"):
        ImprovementSelector(exponent=exponent)


def test_the_greatest_exponent_still_gives_a_map(shared_data):
    depth = cv2.imread(str(shared_data / "sequence" / "000040.png"), cv2.IMREAD_UNCHANGED)
    seeds = SeedGrid.from_array(depth, (64, 64))
    near, nearest = (ImprovementSelector(exponent=w).select(seeds) for w in (1.999, 1.9999))
    assert np.isfinite(nearest.raw).all() and (nearest.raw >= 0).all()
    both = near.known & nearest.known
    order = [np.argsort(np.argsort(each.raw[both])) for each in (near, nearest)]
    assert np.corrcoef(*order)[0, 1] > 0.99
