"""Colour images of recorded folders: which goes with which depth image, and what is said of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from selective_depth.drivers import DepthFrame, open_source
from selective_depth.drivers.folder import write_folder
from selective_depth.drivers.folder.images import write_png
from selective_depth.drivers.frame import Camera

SIZE = (48, 64)


def depth_image(path: Path, number: int, values_per_mm: int = 1) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, np.full(SIZE, (1000 + 10 * number) * values_per_mm, np.uint16))


def colour_image(path: Path, number: int, size: tuple[int, int] = SIZE) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((*size, 3), (0, 200, 10 * number), np.uint8))


def numbers(path: Path) -> list[tuple[int, int | None]]:
    """Which depth image each frame is, and which colour image it has."""
    with open_source(path) as source:
        return [
            (
                (int(frame.depth_mm[0, 0]) - 1000) // 10,
                None if frame.colour is None else round(frame.colour[..., 0].mean() / 10),
            )
            for frame in source
        ]


def tum(root: Path, colour_s: dict[int, float]) -> Path:
    """Ten depth images a thirtieth of a second apart, and colour images at other times."""
    lines = []
    for k in range(10):
        depth_image(root / "depth" / f"{k}.png", k, 5)
        lines.append(f"{100 + k / 30:.6f} depth/{k}.png")
    (root / "depth.txt").write_text("# depth\n" + "\n".join(lines))
    for k in colour_s:
        colour_image(root / "rgb" / f"{k}.png", k)
    return root


def test_tum_colour_is_the_nearest_in_time(tmp_path: Path) -> None:
    # Shuffled, one missing from the list, one from the disk, one too late.
    times = {k: 100 + k / 30 + 0.009 for k in (7, 2, 9, 0, 5, 1, 8, 6)} | {4: 100 + 4 / 30 + 0.021}
    root = tum(tmp_path / "some", times)
    (root / "rgb" / "5.png").unlink()
    (root / "rgb.txt").write_text("\n".join(f"{time:.6f} rgb/{k}.png" for k, time in times.items()))
    # 4's image is 12 ms before 5's depth.
    assert numbers(root) == [(0, 0), (1, 1), (2, 2), (3, None), (4, None), (5, 4), (6, 6), (7, 7), (8, 8), (9, 9)]
    with open_source(root) as source:
        frame = source.read()
        assert frame.registered and frame.colour_us == frame.timestamp_us + 9000
        assert f"colour of 8 of 10 frames from '{root / 'rgb'}'" in source.about


def test_tum_associations_are_taken_as_they_are(tmp_path: Path) -> None:
    root = tum(tmp_path / "some", dict.fromkeys(range(10), 0.0))
    pairs = [f"{100 + k / 30:.6f} depth/{k}.png {100 + k / 30 + 0.03:.6f} rgb/{9 - k}.png" for k in range(10)]
    (root / "associations.txt").write_text("\n".join(pairs))
    (root / "depth.txt").unlink()
    (root / "rgb" / "3.png").unlink()
    assert numbers(root) == [(k, None if k == 6 else 9 - k) for k in range(10)]


@pytest.mark.parametrize("folder", ["color", "colour", "rgb", "image"])
@pytest.mark.parametrize("given", ["", "depth"])
def test_plain_folders_pair_by_number(tmp_path: Path, folder: str, given: str) -> None:
    for k in (0, 1, 2, 10):
        depth_image(tmp_path / "depth" / f"{k:05d}.png", k)
    for k in (10, 1, 0, 5):
        colour_image(tmp_path / folder / f"frame_{k}.jpg", k)
    assert numbers(tmp_path / given) == [(0, 0), (1, 1), (2, None), (10, 10)]
    with open_source(tmp_path) as source:
        assert not source.read().registered
        assert "--colour registered" in source.notes[-1]
    with open_source(f"{tmp_path}?colour=registered") as source:
        assert source.read().registered and not any("colour" in note for note in source.notes)
    with open_source(f"{tmp_path}?colour=off") as source:
        assert source.read().colour is None and "colour" not in source.about


def test_redwood_and_seven_scenes(tmp_path: Path) -> None:
    for k in range(3):
        depth_image(tmp_path / "redwood" / "depth" / f"{k:07d}-{33000 * k:012d}.png", k)
        colour_image(tmp_path / "redwood" / "rgb" / f"{k + 4:07d}-{33000 * k + 5000:012d}.jpg", k)
        depth_image(tmp_path / "seven" / f"frame-{k:06d}.depth.png", k)
        colour_image(tmp_path / "seven" / f"frame-{k:06d}.color.png", k)
    assert numbers(tmp_path / "redwood") == numbers(tmp_path / "seven") == [(0, 0), (1, 1), (2, 2)]
    with open_source(tmp_path / "redwood") as source:
        frame = source.read()
        assert frame.registered and frame.colour_us == 5000
    with open_source(tmp_path / "seven") as source:
        assert not source.read().registered


def test_colour_that_cannot_be_read_is_said_once(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for k in range(3):
        depth_image(tmp_path / "depth" / f"{k}.png", k)
        colour_image(tmp_path / "rgb" / f"{k}.jpg", k)
    whole = (tmp_path / "rgb" / "0.jpg").read_bytes()
    (tmp_path / "rgb" / "0.jpg").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "rgb" / "1.jpg").write_bytes(b"")
    with open_source(f"{tmp_path}?colour=registered") as source:
        assert [frame.colour is None for frame in source] == [True, True, False]
        assert [note for note in source.notes if "cannot be read as a colour image" in note] == list(source.notes[-1:])
    assert capfd.readouterr().err == ""


def test_a_larger_colour_image_is_not_registered(tmp_path: Path) -> None:
    depth_image(tmp_path / "depth" / "0.png", 0)
    colour_image(tmp_path / "rgb" / "0.png", 3, (96, 128))
    with open_source(f"{tmp_path}?colour=registered") as source:
        frame = source.read()
        assert frame.colour is not None and frame.colour.shape == (96, 128, 3) and not frame.registered


def test_two_known_cameras_register(tmp_path: Path) -> None:
    """A wall at 1 m, seen 25 mm beside: each colour pixel moves by 25 of its focal length's thousandths."""
    depth = np.full(SIZE, 1000, np.uint16)
    depth[:, :10] = 0
    write_png(tmp_path / "0.png", depth)
    (tmp_path / "rgb").mkdir()
    stripes = np.zeros((*SIZE, 3), np.uint8)
    stripes[..., 1] = np.arange(64) * 4
    assert cv2.imwrite(str(tmp_path / "rgb" / "0.png"), stripes)
    with open_source(f"{tmp_path}?camera=80,80,32,24&colour=80,80,32,24,25,0,0") as source:
        frame = source.read()
    assert frame.registered and frame.colour is not None and frame.colour_camera == frame.camera
    np.testing.assert_array_equal(frame.colour[5, 10:, 1], (np.arange(10, 64) - 2) * 4)
    assert not frame.colour[:, :10].any()


def test_written_and_read_again(tmp_path: Path, random_frames: Callable[[int], list[DepthFrame]]) -> None:
    frames = random_frames(4)
    write_folder(tmp_path / "out", frames)
    with open_source(tmp_path / "out") as source:
        for before, after in zip(frames, source, strict=True):
            np.testing.assert_array_equal(before.depth_mm, after.depth_mm)
            assert (before.colour is None) == (after.colour is None)
            if before.colour is not None and after.colour is not None:
                np.testing.assert_array_equal(before.colour, after.colour)
                assert (after.colour_us, after.registered, after.colour_camera) == (
                    before.colour_us,
                    before.registered,
                    before.colour_camera,
                )


@pytest.fixture
def random_frames() -> Callable[[int], list[DepthFrame]]:
    """Frames with colour of a camera of its own, the third without."""

    def make(count: int) -> list[DepthFrame]:
        draw = np.random.default_rng(0)
        return [
            DepthFrame(
                draw.integers(500, 4000, SIZE, np.uint16),
                k,
                33_333 * k,
                Camera.kinect(64, 48),
                colour=None if k == 2 else draw.integers(0, 255, (40, 60, 3), np.uint8),
                colour_us=None if k == 2 else 33_333 * k + 7,
                colour_camera=None if k == 2 else Camera(60, 40, 50.0, 51.0, 29.5, 19.5),
            )
            for k in range(count)
        ]

    return make


def test_real_pairs(shared_data: Path) -> None:
    for name, count in (("livingroom", 3), ("sequence", 6)):
        with open_source(shared_data / "rgbd" / name) as source:
            frames = list(source)
            assert len(frames) == count and all(frame.colour is not None for frame in frames)
            assert not any(frame.registered for frame in frames)
