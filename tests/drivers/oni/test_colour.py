"""Colour in .oni files: written, read, checked and repaired without OpenNI2."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from selective_depth.drivers import DepthFrame, open_source
from selective_depth.drivers.frame import Camera
from selective_depth.drivers.oni import OniReader, inspect_oni, repair_oni, write_oni
from selective_depth.drivers.oni.nodes import OniNode, integer, structure
from selective_depth.drivers.oni.records import NodeType
from selective_depth.drivers.oni.writer import RecordWriter, depth_properties

CAMERA = Camera(64, 48, 58.0, 58.0, 31.5, 24.25)


def scene(number: int, size: tuple[int, int] = (48, 64)) -> npt.NDArray[np.uint8]:
    rows, columns = np.mgrid[0 : size[0], 0 : size[1]]
    return np.stack((3 * columns, 4 * rows, np.full_like(rows, 10 * number)), axis=-1).astype(np.uint8)


def frames(count: int, **more: object) -> list[DepthFrame]:
    depth = np.full((48, 64), 1500, np.uint16)
    late = 3000
    return [
        DepthFrame(depth + k, k, 33_333 * k, CAMERA, colour=scene(k), colour_us=33_333 * k - late, **more)  # type: ignore[arg-type]
        for k in range(count)
    ]


def psnr(one: npt.NDArray[np.uint8], other: npt.NDArray[np.uint8]) -> float:
    return float(10 * np.log10(255**2 / np.mean((one.astype(float) - other) ** 2)))


def test_both_streams_come_back_with_their_cameras_and_times(tmp_path: Path) -> None:
    path = tmp_path / "x.oni"
    write_oni(path, frames(5, registered=True))
    report = inspect_oni(path, decode=True)
    assert report.complete and [len(node.frames) for node in report.nodes] == [5, 5]
    with open_source(path) as source:
        assert source.camera == CAMERA  # the principal point too
        for before, after in zip(frames(5), source, strict=True):
            np.testing.assert_array_equal(before.depth_mm, after.depth_mm)
            assert after.registered and after.colour is not None and after.colour_us is not None
            assert after.timestamp_us - after.colour_us == 3000 and psnr(scene(after.index), after.colour) > 38


def test_a_camera_of_its_own_and_another_size(tmp_path: Path) -> None:
    other = Camera(80, 60, 70.0, 71.0, 40.5, 29.0)
    depth = np.full((48, 64), 1500, np.uint16)
    one = DepthFrame(depth, 0, 0, CAMERA, colour=scene(1, (60, 80)), colour_camera=other)
    write_oni(tmp_path / "x.oni", [one])
    with open_source(tmp_path / "x.oni") as source:
        back = source.read()
    assert back.colour is not None and back.colour.shape == (60, 80, 3)
    assert back.colour_camera == other and not back.registered
    with open_source(f"{tmp_path / 'x.oni'}?colour=off") as source:
        assert source.read().colour is None


def test_many_depths_move_colour_to_the_uncompressed_file_unchanged(tmp_path: Path) -> None:
    big = Camera.kinect(320, 240)
    many = np.arange(320 * 240, dtype=np.uint32).reshape(240, 320) % 65000
    calm = np.full((240, 320), 900, np.uint16)
    given = [
        DepthFrame(each.astype(np.uint16), k, 33_333 * k, big, colour=scene(k, (240, 320)), registered=True)
        for k, each in enumerate((calm, many, calm))
    ]
    write_oni(tmp_path / "x.oni", given)
    assert [node.codec for node in inspect_oni(tmp_path / "x.oni").nodes] == [b"NONE", b"JPEG"]
    with open_source(tmp_path / "x.oni") as source:
        for before, after in zip(given, source, strict=True):
            np.testing.assert_array_equal(before.depth_mm, after.depth_mm)
            assert before.colour is not None and after.colour is not None and psnr(before.colour, after.colour) > 35


def test_a_damaged_image_is_found_left_out_and_repaired(tmp_path: Path) -> None:
    path, mended = tmp_path / "x.oni", tmp_path / "mended.oni"
    write_oni(path, frames(4, registered=True))
    image = inspect_oni(path).nodes[1].frames[2]
    data = bytearray(path.read_bytes())
    data[image.payload_offset : image.payload_offset + 40] = bytes(40)
    path.write_bytes(data)
    report = inspect_oni(path, decode=True)
    assert [str(each) for each in report.problems] == [
        f"byte {image.record_offset}: frame 3 of Image cannot be decoded"
    ]
    with open_source(path) as source:
        seen = [frame.colour is None for frame in source]
    assert seen == [False, False, True, False]
    assert repair_oni(path, mended).complete
    assert [len(node.frames) for node in inspect_oni(mended).nodes] == [4, 3]
    with OniReader(path, salvage=True) as source:
        assert [frame.colour is None for frame in source] == seen


@pytest.mark.parametrize(
    ("form", "encode"),
    [
        (200, lambda image: image),
        (201, lambda image: cv2.cvtColor(image, cv2.COLOR_RGB2YUV_UYVY)),
        (202, lambda image: cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)),
        (205, lambda image: cv2.cvtColor(image, cv2.COLOR_RGB2YUV_YUY2)),
        (203, None),
    ],
)
def test_uncompressed_colour_of_other_recorders(
    tmp_path: Path, form: int, encode: Callable[[npt.NDArray[np.uint8]], npt.NDArray[np.uint8]] | None
) -> None:
    path = tmp_path / "x.oni"
    writer = RecordWriter(path)
    writer.add_node(OniNode(1, "Depth", NodeType.DEPTH, b"NONE", depth_properties(CAMERA, 30)))
    more = {"oniPixelFormat": integer(form), "xnMapOutputMode": structure("<III", 64, 48, 30), "xnMirror": integer(1)}
    writer.add_node(OniNode(2, "Image", NodeType.IMAGE, b"NONE", more))
    writer.add_node(OniNode(3, "IR", NodeType.IR, b"NONE", more))
    writer.begin()
    image = scene(5)[:, ::-1]
    writer.add_frame(2, 0, (encode or (lambda each: each))(np.ascontiguousarray(image)).tobytes())
    writer.add_frame(3, 0, bytes(64 * 48))
    writer.add_frame(1, 0, np.full((48, 64), 1500, "<u2").tobytes())
    writer.close()
    with open_source(path) as source:
        frame = source.read()
        if encode is None:
            assert frame.colour is None and "Image (NONE) has a format that is not read" in source.notes[0]
            return
    assert frame.colour is not None and not frame.registered  # nothing says so
    wanted = np.repeat(cv2.cvtColor(scene(5), cv2.COLOR_RGB2GRAY)[..., None], 3, 2) if form == 202 else scene(5)
    assert np.median(np.abs(frame.colour.astype(int) - wanted)) <= 4  # and the right way round


def test_colour_that_stops_in_mid_recording(tmp_path: Path) -> None:
    some = frames(6, registered=True)
    rest = [DepthFrame(each.depth_mm, each.index, each.timestamp_us, CAMERA) for each in some[3:]]
    write_oni(tmp_path / "x.oni", [*some[:3], *rest])
    with open_source(tmp_path / "x.oni") as source:
        assert [frame.colour is None for frame in source] == [False] * 3 + [True] * 3


def test_the_real_recorders_jpeg(shared_cases: Path) -> None:
    with open_source(shared_cases / "oni" / "rgb_lossy.oni") as source:
        for frame in source:
            assert frame.colour is not None and frame.colour_us == frame.timestamp_us and not frame.registered


def test_colour_that_is_a_jpeg_already_is_copied_without_loss(tmp_path: Path) -> None:
    write_oni(tmp_path / "one.oni", frames(3, registered=True))
    with open_source(tmp_path / "one.oni") as source:
        first = list(source)
    write_oni(tmp_path / "two.oni", first)
    with open_source(tmp_path / "two.oni") as source:
        for before, after in zip(first, source, strict=True):
            assert before.colour_jpeg and before.colour_jpeg == after.colour_jpeg
            assert before.colour is not None and after.colour is not None
            np.testing.assert_array_equal(before.colour, after.colour)


@pytest.mark.parametrize("option", ["colour=60,60,30,20,25,0,0", "colour=off"])
def test_what_is_not_the_recorded_image_has_no_jpeg(tmp_path: Path, option: str) -> None:
    write_oni(tmp_path / "x.oni", frames(1))
    with open_source(f"{tmp_path / 'x.oni'}?{option}") as source:
        assert source.read().colour_jpeg is None
