"""Files that change while they are read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from selective_depth.drivers import DepthFrame, open_source
from selective_depth.drivers.errors import DamagedRecordingError
from selective_depth.drivers.frame import Camera
from selective_depth.drivers.oni import OniWriter, write_oni

CAMERA = Camera.kinect(64, 48)


def frames(count: int, level: int) -> list[DepthFrame]:
    return [DepthFrame(np.full((48, 64), level + k, np.uint16), k, 33_333 * k, CAMERA) for k in range(count)]


def test_a_file_that_still_grows_is_read_to_where_it_was(tmp_path: Path) -> None:
    path = tmp_path / "x.oni"
    writer = OniWriter(path)
    for frame in frames(5, 1000):
        writer.write(frame)
    with open_source(path) as source:
        assert source.frame_count == 5 and "not whole" in source.notes[0]
        seen = [source.read()]
        for frame in frames(9, 1000)[5:]:
            writer.write(frame)
        writer.close()
        seen += list(source)
    assert [int(frame.depth_mm[0, 0]) for frame in seen] == [1000, 1001, 1002, 1003, 1004]
    with open_source(path) as source:
        assert source.frame_count == 9 and not source.notes


def test_a_file_that_is_replaced_is_read_on_as_it_was(tmp_path: Path) -> None:
    path, other = tmp_path / "x.oni", tmp_path / "other.oni"
    write_oni(path, frames(5, 1000))
    write_oni(other, frames(3, 2000))
    with open_source(path) as source:
        first = source.read()
        other.replace(path)
        rest = list(source)
    assert [int(frame.depth_mm[0, 0]) for frame in (first, *rest)] == [1000, 1001, 1002, 1003, 1004]


@pytest.mark.parametrize("keep", [0.2, 0.5, 0.7])
def test_a_file_that_is_cut_meanwhile_ends_in_a_named_error(tmp_path: Path, keep: float) -> None:
    path = tmp_path / "x.oni"
    write_oni(path, frames(5, 1000))
    with open_source(path) as source:
        first = source.read()
        with path.open("r+b") as file:
            file.truncate(int(path.stat().st_size * keep))
        with pytest.raises(DamagedRecordingError, match="cannot be read beyond frame"):
            for _ in range(5):
                source.read()
    assert (first.depth_mm == 1000).all()
