"""Local ordinary kriging against dense float64 solves, and the erratum of eq. (27)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_kriging import direct_improvement, gamma, krige

from selective_depth.drivers.kernels import njit
from selective_depth.selectors.improvement.lattice_tables import build_tables
from selective_depth.selectors.improvement.sums import MOMENTS_NUGGET, improve_by_sums
from selective_depth.selectors.improvement.systems import (
    MAX_SAMPLES,
    Box,
    krige_window,
    padded_pixels,
    sample_buffers,
    window_scratch,
)
from selective_depth.selectors.improvement.variogram import fit_moments, fit_samples, power_table

FRAME = (480, 640)


@njit()
def krige_or_sum(samples, count, a, b, between, distances, box, scratch, by_sums):  # only kernels call those
    krige_window(samples, count, a, b, between, distances, 0, box, FRAME, scratch)
    if by_sums:
        improve_by_sums(samples, count, a, b, box, scratch)


def window(uv, depth, a, b, w, u0, v0, width, height, by_sums=False):
    """Estimate, variance and improvement of a window's pixels, each of shape (height, width)."""
    samples = sample_buffers()
    count = len(uv)
    samples[0][:count], samples[1][:count] = uv.T
    samples[2][:count], samples[3][:count] = depth, np.arange(count)
    power = power_table(w, 64)
    step = uv[:, None] - uv
    between = power[64 + step[..., 1], 64 + step[..., 0]]
    room = padded_pixels(width, height)
    distances = np.zeros((MAX_SAMPLES, room), np.float32)
    v, u = np.mgrid[v0 - 1 : v0 + height + 1, u0 - 1 : u0 + width + 1]
    for n in range(count):
        line = power[64 + v - uv[n, 1], 64 + u - uv[n, 0]].ravel()
        distances[n, : line.size] = line
    scratch = window_scratch(room)
    box = Box(u0, v0, width, height)
    krige_or_sum(samples, count, a, b, between, distances, box, scratch, by_sums)
    size = (height + 2) * (width + 2)
    return [scratch[q][:size].reshape(height + 2, width + 2)[1:-1, 1:-1].astype(float) for q in range(3)]


@st.composite
def systems(draw):
    """Random samples in a box, depths from constant to extreme, semivariograms of every kind."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(2, 14))
    places = rng.choice(11 * 9, size=count, replace=False)
    uv = np.stack((100 + places % 11, 200 + places // 11), axis=1)
    kind = draw(st.sampled_from(("flat", "plane", "step", "noise", "extreme")))
    depth = {
        "flat": np.full(count, 1500.0),
        "plane": 800.0 + 12.0 * uv[:, 0] - 100,
        "step": np.where(uv[:, 0] < 105, 900.0, 3400.0),
        "noise": rng.normal(2000, 30, count),
        "extreme": rng.choice((400.0, 10_000.0), count),
    }[kind].astype(np.float32)
    a, b = draw(st.sampled_from(((1.0, 0.0), (30.0, 200.0), (0.0, 50.0), (4e4, 1e5), (2.0, 1e3))))
    return uv, depth, a, b, draw(st.sampled_from((0.7, 1.0, 1.4, 1.8)))


@settings(max_examples=60, deadline=None)
@given(systems())
def test_window_equals_the_published_systems(system):
    uv, depth, a, b, w = system
    z, variance, improvement = window(uv, depth, a, b, w, 101, 201, 9, 7)
    v, u = np.mgrid[201:208, 101:110]
    pixels = np.stack((u.ravel(), v.ravel()), axis=1)
    _, expected_z, expected_variance = krige(uv, depth.astype(float), pixels, a, b, w)
    floor = depth.min() / 2
    # Single precision, of what the depths differ by.
    off_mm = 1e-3 * np.ptp(depth) + 1e-4 * depth.min()
    np.testing.assert_allclose(z.ravel(), np.maximum(expected_z, floor), rtol=0, atol=off_mm)
    tolerance = 1e-3 * expected_variance.max()
    np.testing.assert_allclose(variance.ravel(), expected_variance, rtol=1e-3, atol=1e-3 * tolerance + 1e-9)
    for n in range(0, len(pixels), 7):
        s = pixels[n]
        around = s + np.array([(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)])
        expected = direct_improvement(uv, depth.astype(float), s, around, a, b, w, floor)
        assert improvement.ravel()[n] == pytest.approx(expected, rel=2e-3, abs=1e-9)


@settings(max_examples=60, deadline=None)
@given(systems())
def test_a_window_by_sums_equals_eq_13_near_w_2(system):
    """Where the nugget is large enough; elsewhere eq. (23) is taken, which equals it anyway."""
    uv, depth, a, b, _ = system
    _, _, improvement = window(uv, depth, a, b, 1.999, 101, 201, 9, 7, by_sums=True)
    v, u = np.mgrid[201:208, 101:110]
    pixels = np.stack((u.ravel(), v.ravel()), axis=1)
    for n in range(0, len(pixels), 5):
        around = pixels[n] + np.array([(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)])
        expected = direct_improvement(uv, depth.astype(float), pixels[n], around, a, b, 1.999, depth.min() / 2)
        if b >= MOMENTS_NUGGET * a:
            assert improvement.ravel()[n] == pytest.approx(expected, rel=5e-3, abs=1e-9)


def test_samples_are_met_exactly_and_improve_nothing():
    uv = np.array([(105, 204), (100, 204), (110, 204), (105, 200), (105, 208)])
    depth = np.array([1000, 1010, 1500, 990, 1005], np.float32)
    z, variance, improvement = window(uv, depth, 5.0, 40.0, 1.4, 101, 201, 9, 7)
    assert z[3, 4] == 1000
    assert variance[3, 4] == 0
    assert improvement[3, 4] == 0
    # The nugget: right beside the sample the variance is at least b.
    assert variance[3, 5] > 40


def test_pixels_outside_the_frame_are_no_neighbours():
    uv = np.array([(3, 3), (8, 3), (3, 7)])
    depth = np.array([900, 950, 1400], np.float32)
    _, _, improvement = window(uv, depth, 5.0, 10.0, 1.4, 0, 0, 4, 4)
    corner, inside = np.array((0, 0)), np.array([(0, 0), (1, 0), (0, 1)])
    expected = direct_improvement(uv, depth.astype(float), corner, inside, 5.0, 10.0, 1.4)
    assert improvement[0, 0] == pytest.approx(expected, rel=1e-3)


def test_kriging_weights_reproduce_a_general_solver():
    """Unit depths one by one give the weights themselves; they sum to one."""
    uv = np.array([(105, 204), (100, 200), (110, 201), (103, 208), (109, 208)])
    base = np.full(5, 5000.0, np.float32)
    estimate = [
        window(uv, base + 1000 * np.eye(5, dtype=np.float32)[n], 3.0, 20.0, 1.4, 101, 201, 9, 7)[0] for n in range(5)
    ]
    weights = (np.stack(estimate) - 5000) / 1000
    v, u = np.mgrid[201:208, 101:110]
    pixels = np.stack((u.ravel(), v.ravel()), axis=1)
    expected = krige(uv, base.astype(float), pixels, 3.0, 20.0, 1.4)[0].reshape(5, 7, 9)
    np.testing.assert_allclose(weights, expected, atol=1e-5)
    np.testing.assert_allclose(weights.sum(axis=0), 1, atol=1e-5)


@given(st.integers(0, 2**32 - 1), st.integers(2, 9), st.sampled_from((0.0, 1.0, 500.0)))
@settings(max_examples=60, deadline=None)
def test_fit_is_the_constrained_least_squares_solution(seed, count, noise):
    rng = np.random.default_rng(seed)
    uv = np.stack(np.unravel_index(rng.choice(99, count, replace=False), (9, 11)), axis=1)
    z = 1000 + 20 * uv[:, 0] + noise * rng.normal(size=count)
    h = gamma(uv, uv, 1.0, 0.0, 1.4)
    a, b = fit_samples(z, np.arange(count), count, h)
    assert a >= 0
    assert b >= 0
    pairs = np.triu_indices(count, 1)
    g = 0.5 * (z[pairs[0]] - z[pairs[1]]) ** 2

    def cost(a, b):
        return float(((a * h[pairs] + b - g) ** 2).sum())

    least = cost(a, b)
    for factor in (0.9, 1.1):
        assert cost(a * factor, b) >= least * (1 - 1e-9)
        assert cost(a, b * factor) >= least * (1 - 1e-9)
    if count > 2:
        assert cost(a, b + 1e-3 * g.max()) >= least * (1 - 1e-9)


def test_degenerate_fits_are_finite_and_sensible():
    assert fit_moments(0.0, 0.0, 0.0, 0.0, 0.0) == (0, 0)  # no pairs
    assert fit_moments(3.0, 15.0, 80.0, 0.0, 0.0) == (0, 0)  # constant depth
    a, b = fit_moments(1.0, 10.0, 100.0, 50.0, 500.0)  # two seeds left
    assert (a, b) == (pytest.approx(5), 0)
    a, b = fit_moments(2.0, 30.0, 500.0, 100.0, 1000.0)  # nearer pairs differ more
    assert (a, b) == (0, 50)


def test_tables_fit_in_memory_for_the_largest_lattice():
    from selective_depth.selectors.improvement.neighbourhoods import windows_of
    from selective_depth.selectors.seeds import SeedGrid

    for frame, lattice in (((480, 640), (128, 128)), ((1024, 1280), (256, 256)),
                           ((1024, 1280), (64, 64)), ((240, 320), (100, 90))):  # fmt: skip
        seeds = SeedGrid.from_array(np.zeros(frame, np.uint8), lattice)
        assert sum(table.nbytes for table in windows_of(seeds, 1.4).tables) <= 50e6


def test_eigenvalues_are_positive_so_that_no_semivariogram_is_singular():
    for exponent in (0.5, 1.4, 1.9):
        tables = build_tables([(4, 4, 5, 5), (3, 4, 5, 5), (20, 16, 1, 3)], exponent)
        assert (tables.eigenvalues > 0).all()


def _eq27(p, depth, s, targets, a, b, w, *, corrected):
    """Eq. (27), the paper's expansion for w = 2, with its last terms as printed or corrected.

    The sums over j expand (k_j . lambda_s - a h^2 - b)^2, with h^2 written out in coordinates;
    the kriging terms come from w < 2, as the paper asks.
    """
    n = len(p)
    _, zs, variance = krige(p, depth, s[None], a, b, w)
    _, z, _ = krige(p, depth, targets, a, b, w)
    K = np.ones((n + 1, n + 1))
    K[:n, :n] = gamma(p, p, a, b, w)
    K[n, n] = 0
    k_s = np.append(gamma(p, s[None], a, b, w)[:, 0], 1)
    lam = np.linalg.solve(K, k_s)
    k = np.ones((n + 1, len(targets)))
    k[:n] = gamma(p, targets, a, b, w)
    x, y = targets.T.astype(float)
    xs, ys = s.astype(float)
    q, qs = x**2 + y**2, xs**2 + ys**2

    def total(values):
        return (values / z).sum(axis=-1)

    body = lam @ ((k[:, None] * k[None]) / z).sum(axis=2) @ lam
    body -= (2 * a * qs + 2 * b) * (total(k) @ lam)
    body -= 2 * a * (total(k * q) @ lam)
    body += 4 * a * xs * (total(k * x) @ lam) + 4 * a * ys * (total(k * y) @ lam)
    body += (a**2 * qs**2 + 2 * a * b * qs + b**2) * total(np.ones_like(x))
    body += (2 * a**2 * qs + 2 * a * b) * total(q)
    body -= (4 * a**2 * qs * xs + 4 * a * b * xs) * total(x)
    body -= (4 * a**2 * qs * ys + 4 * a * b * ys) * total(y)
    body += a**2 * total(q**2) - 4 * a**2 * xs * total(q * x) - 4 * a**2 * ys * total(q * y)
    body += 4 * a**2 * xs**2 * total(x**2) + 8 * a**2 * xs * ys * total(x * y)
    body += 4 * a**2 * ys**2 * total(y**2)
    first = 2 * b / zs[0] if corrected else 2 * b / variance[0]
    return body / variance[0] + first - b**2 / (variance[0] * zs[0])


def test_erratum_of_eq_27():
    """With 2b / z(s) eq. (27) meets eq. (13) as w -> 2; with the printed 2b / var(s) it does not.

    Ratios to eq. (13), 4x4 seeds, a = 2, b = 30, m = 5x5 pixels:
    w = 1.9: corrected 0.936, printed 26; w = 1.99: 0.9940, 43; w = 1.999: 0.9995, 47.
    """
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(4) * 5 - 7, np.arange(4) * 4 - 6)
    p = np.stack((x.ravel(), y.ravel()), axis=1)
    depth = 900 + 3.0 * p[:, 0] + rng.normal(0, 6, 16)
    s = np.array((1, -1))
    dx, dy = np.meshgrid(np.arange(-2, 3), np.arange(-2, 3))
    targets = s + np.stack((dx.ravel(), dy.ravel()), axis=1)
    off = []
    for epsilon in (0.1, 0.01, 0.001):
        w = 2 - epsilon
        exact = direct_improvement(p, depth, s, targets, 2.0, 30.0, w)
        corrected = _eq27(p, depth, s, targets, 2.0, 30.0, w, corrected=True)
        printed = _eq27(p, depth, s, targets, 2.0, 30.0, w, corrected=False)
        print(f"w = {w}: corrected {corrected / exact:.6f}, printed {printed / exact:.2f}")
        off.append(abs(corrected / exact - 1))
        assert printed > 5 * exact
    assert off[1] < 0.2 * off[0]
    assert off[2] < 0.2 * off[1]
    assert off[2] < 1e-3
