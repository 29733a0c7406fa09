"""Colour images: forms, pairs in time, and laying one on depth by two cameras."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from selective_depth.drivers import DepthFrame, open_source
from selective_depth.drivers.colour import CONVERSIONS, PAIR_US, Colouring, jpeg_of, nearest, on_depth, rgb_of
from selective_depth.drivers.errors import SourceNotFoundError
from selective_depth.drivers.frame import Camera
from selective_depth.drivers.options import Options

DEPTH = np.full((6, 8), 1000, np.uint16)
CAMERA = Camera.kinect(8, 6)


def frame(**more: object) -> DepthFrame:
    return DepthFrame(DEPTH, 0, 100, CAMERA, **more)  # type: ignore[arg-type]


def test_a_frame_keeps_a_copy_of_its_colour() -> None:
    image = np.zeros((6, 8, 3), np.uint8)
    one = frame(colour=image, registered=True)
    image[:] = 9
    assert one.colour is not None and not one.colour.any() and not one.colour.flags.writeable
    assert one.colour_us == 100 and one.colour_camera == CAMERA
    uv = np.array([[3, 2]])
    assert one.colours_at(uv) is not None and frame(colour=image).colours_at(uv) is None
    assert frame().colours_at(uv) is None and frame().colour_us is None


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        ({"colour": np.zeros((6, 8), np.uint8)}, r"shape \(height, width, 3\), got uint8 \(6, 8\)"),
        ({"colour": np.zeros((6, 8, 3), np.uint16)}, "got uint16"),
        ({"colour": [1]}, "got list"),
        ({"colour": np.zeros((5, 8, 3), np.uint8), "registered": True}, "must have its rows and columns"),
        ({"colour": np.zeros((5, 8, 3), np.uint8), "colour_camera": CAMERA}, "camera is 6 rows by 8 columns"),
        ({"colour": np.zeros((6, 8, 3), np.uint8), "colour_us": 1 << 63}, "colour_us is 9223372036854775808"),
    ],
)
def test_colour_is_checked_at_the_edge(more: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        frame(**more)


@given(st.lists(st.integers(0, 10**6), max_size=30).map(sorted), st.integers(-(10**5), 11 * 10**5))
def test_the_nearest_time_is_the_nearest(times: list[int], time_us: int) -> None:
    at = nearest(times, time_us)
    gaps = [abs(each - time_us) for each in times]
    if at is None:
        assert not gaps or min(gaps) > PAIR_US
    else:
        assert gaps[at] == min(gaps) <= PAIR_US


def test_forms_of_pixels() -> None:
    image = np.zeros((4, 6, 3), np.uint8) + np.array((200, 90, 30), np.uint8)
    backward = {
        "RGB888": image, "BGR8": image[..., ::-1], "RGBA8": cv2.cvtColor(image, cv2.COLOR_RGB2RGBA),
        "BGRA8": cv2.cvtColor(image, cv2.COLOR_RGB2BGRA), "YUV422": cv2.cvtColor(image, cv2.COLOR_RGB2YUV_UYVY),
        "YUYV": cv2.cvtColor(image, cv2.COLOR_RGB2YUV_YUY2), "GRAY8": cv2.cvtColor(image, cv2.COLOR_RGB2GRAY),
        "JPEG": jpeg_of(image, 95),
    }  # fmt: skip
    patterns = {"RGGB": [[0, 1], [1, 2]], "GRBG": [[1, 0], [2, 1]], "BGGR": [[2, 1], [1, 0]], "GBRG": [[1, 2], [0, 1]]}
    for name, pattern in patterns.items():
        backward[f"BAYER_{name}8"] = image[0, 0][np.tile(pattern, (2, 3))]
    assert set(backward) == {*CONVERSIONS, "JPEG"}
    for form, raw in backward.items():
        data = raw if isinstance(raw, bytes) else np.ascontiguousarray(raw).tobytes()
        seen = rgb_of(data, form, 6, 4)
        wanted = np.array([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[0, 0]] * 3) if form == "GRAY8" else image[0, 0]
        assert seen is not None and seen.shape == (4, 6, 3), form
        assert np.abs(seen[1:3, 1:5].astype(int) - wanted).max() <= 3, form
        assert rgb_of(data[:-1], form, 6, 4) is None or form == "JPEG"
        assert rgb_of(data, form, 60, 4) is None


@settings(max_examples=30)
@given(st.binary(max_size=200))
def test_no_bytes_are_a_jpeg_by_accident(data: bytes) -> None:
    assert rgb_of(data, "JPEG", 6, 4) is None


def test_laid_on_depth_as_the_slow_way(rng: np.random.Generator) -> None:
    depth = rng.integers(500, 3000, (24, 32)).astype(np.uint16)
    depth[rng.random(depth.shape) < 0.2] = 0
    camera, other = Camera(32, 24, 30.0, 31.0, 15.5, 11.5), Camera(40, 30, 36.0, 35.0, 19.0, 15.0)
    colour = rng.integers(0, 255, (30, 40, 3), np.uint8)
    laid = on_depth(depth, camera, colour, other, (25.0, -3.0, 2.0))
    for row in range(24):
        for column in range(32):
            z = float(depth[row, column])
            if z == 0:
                assert not laid[row, column].any()
                continue
            x = (column - 15.5) / 30 * z - 25
            y = (row - 11.5) / 31 * z + 3
            u, v = x / (z - 2) * 36 + 19, y / (z - 2) * 35 + 15
            if min(abs(u % 1 - 0.5), abs(v % 1 - 0.5)) < 0.05:
                continue  # either neighbour will do
            inside = -0.5 < u < 39.5 and -0.5 < v < 29.5
            wanted = colour[round(v), round(u)] if inside else np.zeros(3)
            np.testing.assert_array_equal(laid[row, column], wanted)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.mark.parametrize("given", ["perhaps", "1,2,3", "1,2,3,4,5,6,7,8", "525,x,1,1,1,1,1"])
def test_what_is_said_of_colour_is_checked(given: str) -> None:
    with pytest.raises(SourceNotFoundError, match="give on, off, registered, unregistered, or fx,fy,cx,cy,x,y,z"):
        Colouring.of(Options(f"colour={given}", "it"))


def test_the_scenes_have_colour_that_lies_on_depth() -> None:
    for scene in ("workstation", "ball", "firehose"):
        with open_source(f"virtual:{scene}?noise=off&size=160x120") as source:
            one, two = source.read(), source.read()
        assert one.registered and one.colour is not None and two.colour is not None
        assert np.ptp(one.colour.astype(int), axis=(0, 1)).min() > 60  # no single tint
        # Where depth steps by a tenth, colour changes more than elsewhere.
        grey = one.colour.astype(np.int32).sum(axis=2)
        step = np.abs(np.diff(one.depth_mm.astype(int), axis=1)) > 100
        change = np.abs(np.diff(grey, axis=1))
        assert change[step].mean() > 4 * change[~step].mean()
    with open_source("virtual:ball?colour=off") as source:
        assert source.read().colour is None
