"""Replay of `.oni` recordings by our own reader, with OpenNI2's player as the witness."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading
import weakref
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, OniSample
from oni_layouts import write_uncompressed
from raw_oni_player import digest_of, play_all

from selective_depth.drivers.errors import DamagedRecordingError, SourceEndedError, SourceNotFoundError
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.oni import OniReader, inspect_oni, write_oni
from selective_depth.drivers.open import open_source
from selective_depth.drivers.openni.runtime import find_runtime

pytestmark = pytest.mark.openni


def check_exact(path: Path, sample: OniSample) -> None:
    with OniReader(path) as recording:
        assert recording.frame_count == len(sample.depth_mm)
        frames = list(recording)
        assert [frame.index for frame in frames] == list(range(len(sample.depth_mm)))
        times = np.array([frame.timestamp_us for frame in frames])
        # The sensor's clock counts thirtieths of a second.
        due = np.arange(1, len(frames) + 1) * 1_000_000 // 30
        np.testing.assert_array_equal(np.diff(times), np.diff(due))
        for frame, depth_mm in zip(frames, sample.depth_mm, strict=True):
            np.testing.assert_array_equal(frame.depth_mm, depth_mm)


def test_every_frame_once_bit_exact_twenty_times_from_odd_paths(oni_sample: OniSample, tmp_path: Path) -> None:
    odd = tmp_path / "mit Leerzeichen" / "Übung ボール.oni"
    long = tmp_path / ("d" * 200) / ("e" * 200) / "long.oni"
    no_text = tmp_path / os.fsdecode(b"\xff\xfe.oni")
    for path in (odd, long, no_text):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to(oni_sample.path)
    for path in [oni_sample.path, odd, long, no_text] * 5:
        check_exact(path, oni_sample)


def test_camera_and_rate_are_the_recorded_ones(oni_sample: OniSample) -> None:
    with open_source(oni_sample.path) as recording:
        assert recording.fps == 30
        assert not recording.live
        assert recording.dropped == 0
        assert recording.camera.fx == pytest.approx(585, abs=1)
        assert recording.camera.fy == pytest.approx(585, abs=1)


def test_after_the_end_it_stays_ended(oni_sample: OniSample) -> None:
    with OniReader(oni_sample.path) as recording:
        assert len(list(recording)) == 12
        for _ in range(2):
            with pytest.raises(SourceEndedError, match="after 12 frames"):
                recording.read()
    with pytest.raises(SourceEndedError):
        recording.read()
    recording.close()


def test_frames_stay_good_after_close(oni_sample: OniSample) -> None:
    with OniReader(oni_sample.path) as recording:
        frame = recording.read()
    np.testing.assert_array_equal(frame.depth_mm, oni_sample.depth_mm[0])


def test_two_replays_of_one_file_at_once(oni_sample: OniSample) -> None:
    with OniReader(oni_sample.path) as one, OniReader(oni_sample.path) as other:
        for depth_mm in oni_sample.depth_mm:
            np.testing.assert_array_equal(one.read().depth_mm, depth_mm)
            np.testing.assert_array_equal(other.read().depth_mm, depth_mm)
    failures: list[BaseException] = []

    def replay() -> None:
        try:
            check_exact(oni_sample.path, oni_sample)
        except BaseException as error:  # noqa: BLE001 - told to the test
            failures.append(error)

    threads = [threading.Thread(target=replay) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures


def test_two_processes_replay_one_file_at_once(oni_sample: OniSample, tmp_path: Path) -> None:
    np.save(tmp_path / "depth.npy", oni_sample.depth_mm)
    script = (
        "import sys, numpy as np\n"
        "from selective_depth.drivers.oni import OniReader\n"
        "frames = [frame.depth_mm for frame in OniReader(sys.argv[1])]\n"
        "assert np.array_equal(frames, np.load(sys.argv[2]))\n"
    )
    command = [sys.executable, "-c", script, str(oni_sample.path), str(tmp_path / "depth.npy")]
    processes = [subprocess.Popen(command) for _ in range(2)]
    assert [process.wait(30) for process in processes] == [0, 0]


@pytest.mark.parametrize("keep", [0.1, 0.5])
def test_a_cut_file_is_good_as_far_as_it_goes_and_says_so(oni_sample: OniSample, tmp_path: Path, keep: float) -> None:
    cut = tmp_path / "cut.oni"
    data = oni_sample.path.read_bytes()
    cut.write_bytes(data[: int(len(data) * keep)])
    with OniReader(cut) as recording:
        frames = list(recording)
        assert "selective-depth check" in recording.notes[0]
    assert 0 < len(frames) < len(oni_sample.depth_mm)
    for frame in frames:
        np.testing.assert_array_equal(frame.depth_mm, oni_sample.depth_mm[frame.index])


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    text = tmp_path / "text.oni"
    text.write_text("not a recording")
    with pytest.raises(DamagedRecordingError, match=r"text\.oni"):
        OniReader(text)
    with pytest.raises(SourceNotFoundError, match=r"missing\.oni"):
        OniReader(tmp_path / "missing.oni")
    with pytest.raises(SourceNotFoundError, match="folder"):
        OniReader(tmp_path)
    os.mkfifo(tmp_path / "pipe.oni")
    with pytest.raises(SourceNotFoundError, match="regular file"):
        OniReader(tmp_path / "pipe.oni")


def test_a_recording_that_is_over_keeps_no_frame(oni_sample: OniSample) -> None:
    gc.disable()
    try:
        recording = OniReader(oni_sample.path)
        last = [weakref.ref(frame.depth_mm) for frame in recording][-1]
        assert last() is None
    finally:
        gc.enable()


@pytest.mark.slow
def test_two_hundred_cycles_of_open_read_three_close(oni_sample: OniSample) -> None:
    cycle(oni_sample, 200)


def test_cycles_of_open_read_three_close_leave_nothing(oni_sample: OniSample) -> None:
    cycle(oni_sample, 8)


def cycle(sample: OniSample, times: int) -> None:
    def open_files() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    files, threads = open_files(), threading.active_count()
    for _ in range(times):
        with OniReader(sample.path) as recording:
            for index in range(3):
                np.testing.assert_array_equal(recording.read().depth_mm, sample.depth_mm[index])
    assert open_files() == files
    assert threading.active_count() == threads


@pytest.mark.openni
def test_openni2_s_player_delivers_the_same_frames(oni_sample: OniSample, tmp_path: Path) -> None:
    """Of the recordings that come with the program, and of each codec and kind of stream.

    Where its own recorder swapped the last pixels of a frame, the player shows that and we do not:
    see `test_what_openni2s_recorder_swaps_is_read_rightly_and_repaired`.
    """
    draw = np.random.default_rng(3)
    depth_mm = draw.integers(0, 9999, (5, 120, 160)).astype(np.uint16)
    paths = [ROOT / "recordings" / "workstation.oni", oni_sample.path]
    camera = Camera.kinect(160, 120)
    frames = [DepthFrame(each, k, 40_000 * k, camera) for k, each in enumerate(depth_mm)]
    paths.append(tmp_path / "tables.oni")
    write_oni(paths[-1], frames)
    paths.append(tmp_path / "uncompressed.oni")
    write_uncompressed(paths[-1], depth_mm)
    outcomes = list(play_all(paths, find_runtime().path, patience_s=3.0))
    for path, outcome in zip(paths, outcomes, strict=True):
        with open_source(path) as recording:
            ours = [(f.index + 1, *f.shape, f.depth_mm.tobytes()) for f in recording]
            assert len(ours) == recording.frame_count
        assert inspect_oni(path, decode=True).swapped_frames == 0
        assert (outcome.ended, outcome.frames, outcome.digest) == ("frames", *digest_of(ours)), path


def test_no_runtime_and_no_process_is_needed(tmp_path: Path) -> None:
    """Not even imported, so that a broken sensor driver cannot touch a replay."""
    code = (
        "import sys; from selective_depth.drivers import open_source\n"
        "frames = list(open_source(sys.argv[1]))\n"
        "assert len(frames) == 30\n"
        "assert not [name for name in sys.modules if 'primesense' in name or '.openni' in name]\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(ROOT / "recordings" / "workstation.oni")],
        env={**os.environ, "OPENNI2_REDIST": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_a_killed_recording_is_read_to_its_last_whole_frame_and_says_so(tmp_path: Path) -> None:
    data = (ROOT / "recordings" / "workstation.oni").read_bytes()
    report = inspect_oni(ROOT / "recordings" / "workstation.oni")
    assert report.depth is not None
    killed = tmp_path / "killed.oni"
    killed.write_bytes(data[: report.depth.frames[12].record_offset + 100])
    with open_source(killed) as recording:
        assert len(list(recording)) == 12
        assert "selective-depth check" in recording.notes[0]
