"""Which recordings are found below a folder."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from selective_depth.drivers.open import open_source
from selective_depth.drivers.search import find_recordings


def image(path: Path, kind: type = np.uint16) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((24, 32), 10_000 if kind is np.uint16 else 100, kind))


def found(folder: Path, leave_out: Path | None = None) -> list[str]:
    return [Path(each).relative_to(folder).as_posix() for each in find_recordings(str(folder), leave_out)]


def test_every_kind_is_found_once(tmp_path: Path) -> None:
    for name in (
        "b.oni",
        "a.bag",
        "c.MCAP",
        "ros/metadata.yaml",
        "ros/x.db3",
        "notes.txt",
        "day/read.me",
        ".old/d.oni",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    image(tmp_path / "png" / "1.png")
    image(tmp_path / "png" / "colour" / "1.png", np.uint8)
    image(tmp_path / "png" / "more" / "1.png")
    image(tmp_path / "day" / "tum" / "depth" / "1.0.png")
    image(tmp_path / "day" / "tum" / "rgb" / "1.0.png", np.uint8)
    (tmp_path / "day" / "tum" / "depth.txt").write_text("1.0 depth/1.0.png\n")
    image(tmp_path / "pictures" / "1.png", np.uint8)
    image(tmp_path / "pictures" / "2.png", np.uint8)
    for camera in ("2", "3"):
        image(tmp_path / "drive" / "proj_depth" / "groundtruth" / f"image_0{camera}" / "1.png")
    (tmp_path / "void").mkdir()
    kitti = "drive/proj_depth/groundtruth/image_0"
    everything = ["a.bag", "b.oni", "c.MCAP", "day/tum", f"{kitti}2", f"{kitti}3", "png", "png/more", "ros", "void"]
    assert found(tmp_path) == everything
    assert found(tmp_path, tmp_path / "png") == [name for name in everything if not name.startswith("png")]
    for name in ("day/tum", "png", "png/more", f"{kitti}3"):
        with open_source(tmp_path / name) as source:
            assert source.frame_count == 1


def test_what_cannot_be_understood_is_named(tmp_path: Path) -> None:
    image(tmp_path / "bad" / "depth" / "1.png")
    (tmp_path / "bad" / "depth.txt").write_text("nonsense\n")
    image(tmp_path / "torn" / "1.png")
    (tmp_path / "torn" / "1.png").write_bytes(b"")
    (tmp_path / "told").mkdir()
    (tmp_path / "told" / "frames.toml").touch()
    assert found(tmp_path) == ["bad", "told", "torn"]


def test_links_do_not_lead_in_circles(tmp_path: Path) -> None:
    image(tmp_path / "real" / "scan" / "1.png")
    (tmp_path / "real" / "up").symlink_to(tmp_path)
    (tmp_path / "linked").symlink_to(tmp_path / "real" / "scan")
    assert found(tmp_path) == ["linked", "real/scan"]


@pytest.mark.parametrize("name", ["walk.oni", "virtual:ball?frames=3", "nowhere"])
def test_what_is_no_folder_is_returned_as_it_is(name: str) -> None:
    assert list(find_recordings(name)) == [name]


def test_skipping_is_reading_past(tmp_path: Path) -> None:
    for at in range(5):
        path = tmp_path / "scan" / f"{at}.png"
        path.parent.mkdir(exist_ok=True)
        assert cv2.imwrite(str(path), np.full((24, 32), 1000 + at, np.uint16))
    for name in (str(tmp_path / "scan"), "virtual:ball?frames=5&size=32x24"):
        with open_source(name) as whole, open_source(name) as rest:
            rest.skip(3)
            expected = list(whole)[3:]
            frames = list(rest)
        assert [frame.index for frame in frames] == [3, 4]
        assert all((a.depth_mm == b.depth_mm).all() for a, b in zip(frames, expected, strict=True))
