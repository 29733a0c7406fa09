"""The virtual Kinect: exact shapes, the sensor's errors, the source."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from kinect_residuals import in_steps, plane_residuals

from selective_depth.drivers.errors import SourceEndedError, SourceNotFoundError, SourceTimeoutError
from selective_depth.drivers.frame import Camera
from selective_depth.drivers.open import open_source
from selective_depth.drivers.virtual import noise as kinect_noise
from selective_depth.drivers.virtual import source as virtual
from selective_depth.drivers.virtual.noise import depth_steps, kinect_depth
from selective_depth.drivers.virtual.renderer import CYLINDER, DISC, NEAREST_MM, QUAD, SPHERE, TORUS, Shapes, cast
from selective_depth.drivers.virtual.scenes import SCENES
from selective_depth.drivers.virtual.source import VirtualSource, camera_pose

SMALL = Camera(32, 24, 27.0, 29.0, 15.0, 12.5)
KINECT = Camera.kinect()
WHITE = np.array([0.0, 1.0], np.float32)


def depth_at(source: VirtualSource, index: int, *, noise: bool) -> npt.NDArray[np.uint16]:
    """Depth of a frame, exact or as a Kinect reports it, whatever was read so far."""
    return source._render(index, noise=noise)[0]


# The reference: every ray against every shape, in the words of the geometry books.


def hits(kind: int, centre, first, second, size, ray) -> list[float]:
    """Depths at which the points z * ray lie on the shape, by its equation."""
    length = np.linalg.norm(ray)
    unit = ray / length
    if kind in (QUAD, DISC):
        normal = np.cross(first, second) if kind == QUAD else first
        if abs(unit @ normal) < 1e-12:
            return []
        t = (centre @ normal) / (unit @ normal)
        offset = t * unit - centre
        if kind == DISC:
            inside = size[1] <= np.linalg.norm(offset) <= size[0]
        else:
            facing = unit @ normal < 0
            inside = facing and abs(offset @ first) <= size[0] and abs(offset @ second) <= size[1]
        return [t / length] if inside else []
    if kind == SPHERE:
        roots = np.roots([1.0, -2 * unit @ centre, centre @ centre - size[0] ** 2])
    elif kind == CYLINDER:
        across = unit - (unit @ first) * first
        beside = centre - (centre @ first) * first
        roots = np.roots([across @ across, -2 * across @ beside, beside @ beside - size[0] ** 2])
    else:
        # (p.p + R^2 - r^2)^2 = 4 R^2 (p.p - (p.a)^2), with p = t * unit - centre; t counted from
        # the point next to the centre, where the equation is best conditioned.
        nearest = unit @ centre
        start = nearest * unit - centre
        p2 = np.array([1.0, 0.0, start @ start])
        pa = np.array([unit @ first, start @ first])
        left = p2 + np.array([0, 0, size[0] ** 2 - size[1] ** 2])
        right = 4 * size[0] ** 2 * (p2 - np.polymul(pa, pa))
        roots = np.roots(np.polysub(np.polymul(left, left), right))
        roots = roots[np.abs(roots.imag) < 1e-4] + nearest
    found = []
    for root in roots:
        if abs(root.imag) > 1e-4:
            continue
        t = float(root.real)
        if kind == CYLINDER:
            point = t * unit - centre
            outwards = point - (point @ first) * first
            if abs(point @ first) > size[1] or outwards @ unit > 0:  # past an end; from inside
                continue
        found.append(t / length)
    return found


def slow_cast(shapes: Shapes, camera: Camera) -> npt.NDArray[np.float64]:
    depth = np.full((camera.height, camera.width), np.inf)
    for row in range(camera.height):
        for column in range(camera.width):
            ray = np.array(((column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, 1.0))
            for kind, centre, first, second, size in zip(
                shapes.kind, shapes.centre, shapes.first, shapes.second, shapes.size, strict=True
            ):
                for z in hits(kind, centre, first, second, size, ray):
                    if NEAREST_MM <= z < depth[row, column]:
                        depth[row, column] = z
    return np.where(np.isfinite(depth), depth, 0.0)


def one_shape(kind: int, centre, turn, size) -> Shapes:
    return Shapes(
        np.array([kind]),
        np.array([1]),
        np.array([centre], np.float64),
        np.array([turn[0]]),
        np.array([turn[1]]),
        np.array([size], np.float64),
    )


def random_turn(seed: int) -> npt.NDArray[np.float64]:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def agree(fast: npt.NDArray[np.float32], slow: npt.NDArray[np.float64], close_mm: float) -> None:
    """Equal depth; on an outline rounding decides what is seen, and rays graze the surface."""
    fast_mm = np.where(fast > 0, 1.0 / np.maximum(fast, 1e-12), 0.0)
    apart = np.abs(fast_mm - slow) - 1e-6 * slow
    on_outline = cv2.dilate(slow, np.ones((3, 3))) - cv2.erode(slow, np.ones((3, 3))) > 1
    assert (apart[~on_outline] <= close_mm).all()
    assert (apart[on_outline] > 0.5).sum() <= max(1, 0.03 * on_outline.sum())


@pytest.mark.parametrize("kind", [QUAD, SPHERE, CYLINDER, DISC, TORUS])
@settings(max_examples=12, deadline=None, phases=(Phase.reuse, Phase.generate))
@given(
    seed=st.integers(0, 10_000),
    x=st.floats(-900, 900),
    y=st.floats(-700, 700),
    z=st.floats(500, 3000),
    large=st.floats(80, 400),
    small=st.floats(0.1, 0.6),
)
def test_a_shape_is_where_geometry_says(kind, seed, x, y, z, large, small):
    shapes = one_shape(kind, (x, y, z), random_turn(seed), (large, large * small))
    inside_hull = math.hypot(x, y, z) < 2.5 * large
    if inside_hull and kind in (SPHERE, CYLINDER, TORUS):
        return  # solids are seen from outside; that they vanish from inside is tested below
    nearness, material = cast(shapes, SMALL)
    agree(nearness, slow_cast(shapes, SMALL), close_mm=0.05)
    assert ((material == 1) == (nearness > 0)).all()


def test_a_camera_inside_a_ball_or_a_pipe_sees_through_it():
    for kind in (SPHERE, CYLINDER):
        shapes = one_shape(kind, (0, 0, 100), np.eye(3), (400, 300))
        assert not cast(shapes, SMALL)[0].any()


def test_nothing_behind_the_camera_is_seen():
    for kind in (QUAD, SPHERE, CYLINDER, DISC, TORUS):
        shapes = one_shape(kind, (0, 0, -900), random_turn(3), (300, 60))
        assert not cast(shapes, SMALL)[0].any()


def test_a_floor_that_runs_under_the_camera_fills_the_image_below_the_horizon():
    turn = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    shapes = one_shape(QUAD, (0, 1000, 0), turn, (1e6, 1e6))
    nearness, _ = cast(shapes, SMALL)
    rows = np.arange(24)
    expected = np.maximum((rows - SMALL.cy) / SMALL.fy / 1000, 0)
    assert np.allclose(nearness, expected[:, None], atol=1e-9)


@pytest.mark.parametrize("name", SCENES)
def test_a_whole_scene_is_what_its_shapes_are(name):
    camera = Camera.kinect(48, 36)
    scene = SCENES[name]()
    shapes = scene.shapes.seen_from(*camera_pose(scene, 7.0, seed=3))
    # Only pixels of a coarse image are tried: the reference takes 0.1 ms for each ray and shape.
    pixels = np.random.default_rng(0).permutation(48 * 36)[:150]
    nearness, _ = cast(shapes, camera)
    wrong = 0
    for row, column in zip(*np.divmod(pixels, 48), strict=True):
        ray = np.array(((column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, 1.0))
        depths = [
            z
            for kind, centre, first, second, size in zip(
                shapes.kind, shapes.centre, shapes.first, shapes.second, shapes.size, strict=True
            )
            for z in hits(kind, centre, first, second, size, ray)
            if z >= NEAREST_MM
        ]
        wrong += abs(min(depths, default=0.0) - 1 / nearness[row, column]) > 0.05
    assert wrong == 0


# The sensor's errors, each alone.


def wall(depth_mm: float, camera: Camera = KINECT) -> npt.NDArray[np.float32]:
    return np.full((camera.height, camera.width), 1 / depth_mm, np.float32)


def measured(nearness, seed=5, albedo=WHITE, camera=KINECT):
    return kinect_depth(nearness, np.ones(nearness.shape, np.uint8), albedo, camera, seed)


@pytest.mark.parametrize("depth_mm", [1100, 2000, 3100, 4000])
def test_error_of_a_wall_is_the_stated_one(depth_mm):
    # Turned a little, so that it lies at every height between two steps.
    nearness = wall(depth_mm) * np.linspace(0.98, 1.02, 640, dtype=np.float32)
    depth = measured(nearness)[:, :-9]
    assert (depth > 0).all()
    assert np.isin(depth, depth_steps(KINECT)).all()
    error = in_steps(depth.astype(float)) - 8 * 585 * 75 * nearness[:, :-9]
    assert abs(error.mean()) < 0.05
    # The stated error and that of rounding to whole steps (1/12).
    stated = math.sqrt((8 * kinect_noise.NOISE_PX) ** 2 + 1 / 12)
    assert error.std() == pytest.approx(stated, rel=0.08)


def test_depth_comes_in_steps_that_grow_with_the_square_of_depth():
    steps = np.flip(depth_steps(KINECT)[depth_steps(KINECT) > 0].astype(int))
    assert steps.min() >= 500
    assert steps.max() <= 9000
    gaps = np.diff(steps)
    for depth_mm, gap_mm in ((1000, 2.85), (2000, 11.4), (4000, 45.6)):
        at = np.argmin(abs(steps - depth_mm))
        assert gaps[at - 2 : at + 3].mean() == pytest.approx(gap_mm, rel=0.15)


def test_neighbours_share_part_of_their_error():
    error = in_steps(measured(wall(2000))[:, :-9].astype(float))
    error -= error.mean()
    beside = [(error[:, : -k or None] * error[:, k:]).mean() / error.var() for k in (1, 3, 9)]
    assert 0.4 < beside[0] < 0.65
    assert 0.15 < beside[1] < 0.4
    assert abs(beside[2]) < 0.06


def test_errors_of_two_frames_have_nothing_in_common():
    errors = [in_steps(measured(wall(2005), seed=k)[:, :-9].astype(float)) for k in (1, 2, 3, 2**32)]
    likeness = np.corrcoef([error.ravel() for error in errors])
    assert np.abs(likeness - np.eye(4)).max() < 0.03


def test_the_projector_casts_a_shadow_to_the_left_of_a_nearer_surface():
    nearness = wall(2400)
    nearness[100:380, 300:420] = 1 / 1200
    depth = measured(nearness)
    holes = (depth[120:360] == 0).sum(axis=1)
    expected = 585 * 75 * (1 / 1200 - 1 / 2400)
    assert holes.mean() - 8 == pytest.approx(expected, abs=1.0)  # 8: the columns at the border
    assert (depth[120:360, 430:620] > 0).all()


def test_outlines_are_ragged_but_stay_in_place():
    nearness = wall(2400)
    nearness[:, 320:] = 1 / 1200
    depth = measured(nearness)
    first_near = (depth[:, 200:400] < 1800) & (depth[:, 200:400] > 0)
    edge = 200 + first_near.argmax(axis=1)
    assert abs(edge.mean() - 320) < 0.5
    assert 0.5 < edge.std() < 1.5


@pytest.mark.parametrize(("degrees", "share"), [(60, 0.0), (72, 0.0), (88, 1.0)])
def test_a_surface_seen_at_a_grazing_angle_is_lost(degrees, share):
    tangent = math.tan(math.radians(degrees))
    across = (np.arange(480) - 240) / 585
    nearness = np.tile(((1 + tangent * across) / 2000)[:, None], (1, 640)).astype(np.float32)
    middle = measured(np.maximum(nearness, 0))[238:243, :-9]
    assert (middle == 0).mean() == pytest.approx(share, abs=0.02)


def test_dark_surfaces_are_lost_where_bright_ones_are_not():
    dark = np.array([0.0, 0.05], np.float32)
    assert (measured(wall(1000), albedo=dark)[:, :-9] > 0).all()
    patchy = (measured(wall(2010), albedo=dark)[:, :-9] == 0).mean()
    assert 0.2 < patchy < 0.8
    assert (measured(wall(4500), albedo=dark) == 0).mean() > 0.98


@pytest.mark.parametrize("depth_mm", [300, 480, 9600, 20000])
def test_nothing_is_reported_out_of_range(depth_mm):
    assert (measured(wall(depth_mm)) > 0).mean() < 1e-4
    assert measured(wall(depth_mm)).max() <= 9000


def test_nothing_is_reported_where_nothing_is():
    assert not measured(np.zeros((480, 640), np.float32)).any()


@pytest.mark.parametrize("size", [(320, 240), (1280, 1024), (17, 16)])
def test_other_image_sizes_have_the_same_steps(size):
    camera = Camera.kinect(*size)
    depth = measured(wall(2000, camera), camera=camera)
    border = math.ceil(8 * size[0] / 640)
    assert (depth[:, -border:] == 0).all()
    assert np.isin(depth, depth_steps(KINECT)).all()


def test_errors_are_like_those_of_a_real_sensor(shared_data):
    real = np.concatenate(
        [
            plane_residuals(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
            for path in sorted((shared_data / "sequence").glob("*.png"))[::20]
        ]
    )
    source = VirtualSource("workstation")
    made = np.concatenate([plane_residuals(depth_at(source, k, noise=True)) for k in (0, 40, 80)])
    assert len(made) > 50
    sizes, likeness = [], []
    for rest in (real, made):
        sizes.append(np.median(rest.std(axis=(1, 2))))
        likeness.append([(rest[:, :, :-k] * rest[:, :, k:]).mean() / rest.var() for k in (1, 2, 3)])
    assert sizes[1] == pytest.approx(sizes[0], rel=0.1)
    assert likeness[1] == pytest.approx(likeness[0], abs=0.1)


# The source.


@pytest.mark.parametrize("name", ["workstation", "ball", "firehose", "exercise-ball", "fire-hose"])
def test_every_scene_opens_and_looks_like_a_room(name):
    with open_source(f"virtual:{name}?frames=2") as source:
        frames = list(source)
    assert [frame.index for frame in frames] == [0, 1]
    assert frames[1].timestamp_us - frames[0].timestamp_us == 33333
    assert source.frame_count == 2
    depth = frames[0].depth_mm
    assert depth.shape == (480, 640)
    assert 0.6 < (depth > 0).mean() < 0.99
    assert 1000 < np.median(depth[depth > 0]) < 3000
    with pytest.raises(SourceEndedError):
        source.read()


def test_frames_without_noise_are_the_exact_depth_in_whole_millimetres():
    source = VirtualSource("firehose?noise=off&size=160x120")
    exact = source.read().depth_mm
    scene = SCENES["firehose"]()
    shapes = scene.shapes.seen_from(*camera_pose(scene, 0.0, seed=1))
    nearness, _ = cast(shapes, source.camera)
    assert (exact > 0).all()
    assert np.abs(exact - 1 / nearness.astype(float)).max() <= 0.501


def test_a_frame_depends_on_its_number_and_the_seed_alone():
    one, two = VirtualSource("ball?size=160x120"), VirtualSource("ball?size=160x120&frames=9")
    frames = [frame.depth_mm for frame in two]
    assert (depth_at(one, 7, noise=True) == frames[7]).all()
    assert (depth_at(one, 3, noise=True) == frames[3]).all()
    other = VirtualSource("ball?size=160x120&seed=2")
    assert (depth_at(other, 3, noise=True) != frames[3]).mean() > 0.5
    still = VirtualSource("ball?size=160x120&speed=0")
    assert (depth_at(still, 0, noise=False) == depth_at(still, 99, noise=False)).all()
    assert (depth_at(still, 0, noise=True) != depth_at(still, 99, noise=True)).mean() > 0.2


@settings(max_examples=60, deadline=None)
@given(time_s=st.floats(0, 1e5), seed=st.integers(0, 10**9), name=st.sampled_from(list(SCENES)))
def test_the_hand_moves_smoothly_and_stays_near(time_s, seed, name):
    scene = SCENES[name]()
    turn, place = camera_pose(scene, time_s, seed)
    assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(turn) == pytest.approx(1)
    assert (np.abs(place) <= 1.1 * scene.sway_mm).all()
    later_turn, later = camera_pose(scene, time_s + 1 / 30, seed)
    assert np.linalg.norm(later - place) < 25  # 0.75 m/s
    angle = math.acos(min(1, (np.trace(turn.T @ later_turn) - 1) / 2))
    assert math.degrees(angle) < 1.5


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("kitchen", "workstation, ball, firehose"),
        ("", "workstation, ball, firehose"),
        ("ball?nose=off", "noise"),
        ("ball?noise=maybe", r"kinect\+fixed, off"),
        ("ball?frames=-1", "whole number"),
        ("ball?frames=1e3", "whole number"),
        ("ball?speed=nan", "a number from 0 to 100"),
        ("ball?size=640", "WIDTHxHEIGHT"),
        ("ball?size=0x480", "WIDTHxHEIGHT"),
        ("ball?size=9999x9999", "WIDTHxHEIGHT"),
        ("ball?seed=1&seed=2", "twice"),
        ("ball?seed", "no value"),
        ("ball?live=yes", "0, 1"),
    ],
)
def test_what_cannot_be_opened_is_told_with_what_can(name, says):
    with pytest.raises(SourceNotFoundError, match=says):
        open_source(f"virtual:{name}")


@settings(max_examples=200, deadline=None)
@given(text=st.text(st.characters(codec="utf-8"), max_size=30))
def test_any_options_open_or_are_refused_by_name(text):
    try:
        VirtualSource(f"ball?{text}").close()
    except SourceNotFoundError as error:
        assert len(str(error)) > 20


class Clock:
    """Stands in for the module `time`."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def test_a_live_scene_keeps_time_and_drops_what_nobody_read(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(virtual, "time", clock)
    source = VirtualSource("ball?live=1&size=64x48")
    assert source.live
    assert source.frame_count is None
    assert [source.read().index for _ in range(3)] == [0, 1, 2]
    assert clock.now == pytest.approx(100 + 2 / 30)
    assert source.dropped == 0
    clock.now += 0.51
    assert source.read().index == 17
    assert source.dropped == 14
    with pytest.raises(SourceTimeoutError):
        source.read(timeout_s=0.001)
    source.close()
    source.close()
    with pytest.raises(SourceEndedError):
        source.read()


def test_a_live_scene_with_a_number_of_frames_ends(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(virtual, "time", clock)
    source = VirtualSource("ball?live=1&size=64x48&frames=5")
    source.read()
    clock.now += 3
    assert source.read().index == 4
    with pytest.raises(SourceEndedError):
        source.read()
    assert source.dropped == 3
