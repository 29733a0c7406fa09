"""Frames and cameras: checked at the edge, and metric points that project back."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from selective_depth.drivers.frame import Camera, DepthFrame

CAMERA = Camera(4, 3, 5.0, 6.0, 1.5, 1.0)


def frame_of(depth_mm: np.ndarray) -> DepthFrame:
    return DepthFrame(depth_mm, index=0, timestamp_us=0, camera=CAMERA, source="test")


def test_a_frame_is_read_only() -> None:
    frame = frame_of(np.ones((3, 4), np.uint16))
    with pytest.raises(ValueError, match="read-only"):
        frame.depth_mm[0, 0] = 7


@pytest.mark.parametrize(
    "wrong",
    [
        np.ones((3, 4), np.float32),
        np.ones((3, 4), np.int32),
        np.ones((3, 4), bool),
        np.ones((3, 4), "u1"),
        np.ones((3, 4, 1), np.uint16),
        np.ones(12, np.uint16),
        [[1] * 4] * 3,
    ],
)
def test_type_and_dimensions_are_checked(wrong: Any) -> None:
    with pytest.raises(ValueError, match="uint16 array of shape"):
        frame_of(wrong)


def test_a_transposed_frame_is_refused() -> None:
    with pytest.raises(ValueError, match="3 rows by 4 columns"):
        frame_of(np.ones((4, 3), np.uint16))


def test_measure_takes_column_then_row() -> None:
    depth = np.arange(12, dtype=np.uint16).reshape(3, 4)
    assert frame_of(depth).measure(np.array([[3, 1], [0, 2]])).tolist() == [7, 8]


@pytest.mark.parametrize("fov", [0.0, -1.0, math.pi, math.nan])
def test_impossible_field_of_view_is_refused(fov: float) -> None:
    with pytest.raises(ValueError, match="between 0 and pi"):
        Camera.from_fov(640, 480, fov, 0.8)


@pytest.mark.parametrize(
    "change",
    [
        {"width": 0},
        {"fx": 0.0},
        {"fx": 1e-300},
        {"fx": 3.2e7},
        {"fy": -1.0},
        {"fy": math.nan},
        {"cx": math.inf},
        {"cy": -1e7},
    ],
)
def test_impossible_camera_is_refused(change: dict[str, float]) -> None:
    values = {"width": 4, "height": 3, "fx": 5.0, "fy": 5.0, "cx": 2.0, "cy": 1.5} | change
    with pytest.raises(ValueError, match="must be"):
        Camera(**values)  # type: ignore[arg-type]


def test_field_of_view_spans_the_image() -> None:
    camera = Camera.from_fov(640, 480, math.radians(58.5), math.radians(45.6))
    half_width_mm = 1000 * math.tan(math.radians(58.5) / 2)
    edge = camera.points_mm(np.array([640, 240]), np.array(1000))
    assert edge[0] == pytest.approx(half_width_mm, rel=1e-5)


@given(st.integers(0, 639), st.integers(0, 479), st.integers(1, 65535), st.floats(100, 2000))
def test_points_project_back_onto_their_pixels(u: int, v: int, z: int, focal: float) -> None:
    camera = Camera(640, 480, focal, focal * 1.01, 319.5, 239.5)
    point = camera.points_mm(np.array([u, v]), np.array(z, np.uint16))
    assert point[2] == z
    np.testing.assert_allclose(camera.project_uv(point), [u, v], atol=2e-3)


def test_no_depth_is_no_point() -> None:
    assert np.isnan(CAMERA.points_mm(np.array([1, 1]), np.array(0))).all()


PLAIN = np.arange(12, dtype=np.uint16).reshape(3, 4)
KINDS = {
    "plain": PLAIN,
    "big-endian": PLAIN.astype(">u2"),
    "column by column": np.asfortranarray(PLAIN),
    "every second of a larger one": np.repeat(np.repeat(PLAIN, 2, 0), 2, 1)[::2, ::2],
    "backwards": PLAIN[::-1, ::-1].copy()[::-1, ::-1],
    "masked nowhere": np.ma.asarray(PLAIN),
    "masked": np.ma.masked_equal(np.where(PLAIN == 0, 65535, PLAIN).astype(np.uint16), 65535),
    "in a buffer": np.frombuffer(PLAIN.tobytes(), np.uint16).reshape(3, 4),
}


@pytest.mark.parametrize("kind", KINDS)
def test_whatever_the_array_is_like_the_frame_is_plain(kind: str) -> None:
    frame = frame_of(KINDS[kind])
    assert type(frame.depth_mm) is np.ndarray
    assert frame.depth_mm.dtype == np.uint16 and frame.depth_mm.dtype.isnative
    assert frame.depth_mm.flags.c_contiguous and not frame.depth_mm.flags.writeable
    np.testing.assert_array_equal(frame.depth_mm, PLAIN)


def test_frames_stay_what_they_were_and_the_owner_keeps_its_array() -> None:
    """A sensor fills one buffer again and again."""
    buffer = np.zeros(12, np.uint16)
    frames = []
    for index in range(3):
        buffer[:] = 1000 + index
        frames.append(frame_of(buffer.reshape(3, 4)))
    assert [int(frame.depth_mm[0, 0]) for frame in frames] == [1000, 1001, 1002]
    owned = np.ones((3, 4), np.uint16)
    frame_of(owned)
    owned[:] = 7


def test_what_nobody_can_change_is_not_copied() -> None:
    handed_over = np.ones((3, 4), np.uint16)
    handed_over.flags.writeable = False
    assert frame_of(handed_over).depth_mm is handed_over
    changing = np.ones(12, np.uint16)
    window = changing.reshape(3, 4)
    window.flags.writeable = False
    frame = frame_of(window)
    changing[:] = 9
    assert (frame.depth_mm == 1).all()


@pytest.mark.parametrize("timestamp_us", [-(2**63), 2**62 + 1, 10**30])
def test_a_time_out_of_range_is_refused(timestamp_us: int) -> None:
    with pytest.raises(ValueError, match="timestamp_us is"):
        DepthFrame(PLAIN, 0, timestamp_us, CAMERA)
