"""Recordings played from a frame on, in steps, in a loop, and at another speed."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from selective_depth.drivers import open_source
from selective_depth.drivers.bag import BagWriter
from selective_depth.drivers.errors import SourceEndedError
from selective_depth.drivers.folder import write_folder
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.oni import write_oni
from selective_depth.drivers.played import PlayedSource
from selective_depth.drivers.realtime import RealtimeSource
from selective_depth.drivers.source import DepthSource

PERIOD_US = 20_000


class Frames(DepthSource):
    """A recording of so many frames, each of the depth 1000 + its number."""

    live = False
    dropped = 0

    def __init__(self, count: int) -> None:
        self.uri, self.camera, self.fps, self.frame_count = "frames", Camera.kinect(4, 3), 1e6 / PERIOD_US, count
        self.at, self.closed = 0, False

    def read(self, timeout_s: float = 5.0) -> DepthFrame:
        if self.at == self.frame_count:
            raise SourceEndedError("over")
        self.at += 1
        depth_mm = np.full((3, 4), 1000 + self.at - 1, np.uint16)
        return DepthFrame(depth_mm, self.at - 1, 5_000_000 + (self.at - 1) * PERIOD_US, self.camera)

    def close(self) -> None:
        self.closed = True


@given(count=st.integers(1, 30), start=st.integers(0, 35), every=st.integers(1, 8))
def test_the_frames_are_those_of_a_slice(count: int, start: int, every: int) -> None:
    expected = list(range(count))[start::every]
    if start > count:
        with pytest.raises(SourceEndedError, match=f"--start is {start}, but 'frames' has {count} frames"):
            PlayedSource(Frames(count), start=start, every=every)
        return
    played = PlayedSource(Frames(count), start=start, every=every)
    assert played.frame_count == len(expected)
    frames = list(played)
    assert [frame.index for frame in frames] == expected
    assert [int(frame.depth_mm[0, 0]) - 1000 for frame in frames] == expected


@given(count=st.integers(1, 9), start=st.integers(0, 4), every=st.integers(1, 4))
def test_in_a_loop_numbers_and_times_go_on(count: int, start: int, every: int) -> None:
    there = list(range(count))[start::every]
    opened: list[Frames] = [Frames(count)]

    def again() -> Frames:
        opened.append(Frames(count))
        return opened[-1]

    if start >= count:
        with pytest.raises(SourceEndedError):
            PlayedSource(opened[0], again, start=start).read()
        return
    played = PlayedSource(opened[0], again, start=start, every=every)
    frames = [played.read() for _ in range(3 * len(there))]
    assert played.frame_count is None and played.state == "replay"
    assert [int(frame.depth_mm[0, 0]) - 1000 for frame in frames] == 3 * there
    assert len({frame.index for frame in frames}) == len(frames)
    steps_us = np.diff([frame.timestamp_us for frame in frames])
    assert (steps_us == every * PERIOD_US).all()
    assert (np.diff([frame.index for frame in frames]) > 0).all()
    played.close()
    assert all(each.closed for each in opened)


def test_a_real_recording_in_a_loop(tmp_path: Path) -> None:
    write_folder(tmp_path / "r", [Frames(5).read()])
    with PlayedSource(open_source(tmp_path / "r"), lambda: open_source(tmp_path / "r")) as played:
        assert [played.read().index for _ in range(3)] == [0, 1, 2]


@pytest.mark.parametrize("name", ["frames", "walk.oni", "walk.mcap", "virtual:ball?size=64x48&frames=9"])
def test_every_third_frame_of_each_kind_of_recording(name: str, tmp_path: Path) -> None:
    given = [DepthFrame(np.full((48, 64), 900 + k, np.uint16), k, 33_333 * k, Camera.kinect(64, 48)) for k in range(9)]
    if name == "frames":
        write_folder(tmp_path / name, given)
    elif name.endswith(".oni"):
        write_oni(tmp_path / name, given)
    elif name.endswith(".mcap"):
        BagWriter(tmp_path / name).write_all(given)
    uri = name if name.startswith("virtual:") else str(tmp_path / name)
    with open_source(uri) as source:
        whole = list(source)
    with PlayedSource(open_source(uri), start=1, every=3) as played:
        found = list(played)
    assert [frame.index for frame in found] == [1, 4, 7]
    for frame in found:
        np.testing.assert_array_equal(frame.depth_mm, whole[frame.index].depth_mm)


def test_what_a_recording_says_of_itself_is_heard_in_real_time_too() -> None:
    frames = Frames(3)
    frames.about = "a recording, read as one"
    with RealtimeSource(frames) as source:
        frames.notes, frames.damage = ("turned round in frame 2",), "cut short"
        assert source.about == frames.about
        assert source.notes == frames.notes and source.damage == frames.damage


@pytest.mark.parametrize(("speed", "seconds"), [(2.0, 0.2), (0.5, 0.8)])
def test_the_speed_is_that_asked_for(speed: float, seconds: float) -> None:
    with RealtimeSource(Frames(21), speed) as source:
        source.read()
        began_s, last = time.monotonic(), None
        with pytest.raises(SourceEndedError):
            while True:
                last = source.read()
        took_s = time.monotonic() - began_s
    assert last is not None and last.index == 20
    assert source.fps == speed * 50
    assert seconds * 0.95 < took_s < seconds + 1.5  # a loaded machine is late, never early


def test_whoever_taps_a_source_gets_what_nobody_reads() -> None:
    tapped: list[int] = []
    with RealtimeSource(Frames(10), 4.0) as source:
        source.tap = lambda frame: tapped.append(frame.index)
        source.read()
        time.sleep(0.01)
        with pytest.raises(SourceEndedError):
            while True:
                source.read()
                time.sleep(0.03)  # too slow for all of them
    assert source.dropped > 0
    assert tapped[-9:] == list(range(1, 10))
