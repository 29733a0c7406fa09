"""Replay of `.oni` recordings through the real OpenNI2 runtime."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import threading
import weakref
from pathlib import Path

import numpy as np
import pytest
from conftest import OniSample

from selective_depth.drivers.errors import (
    DamagedRecordingError,
    RuntimeMissingError,
    SourceEndedError,
    SourceNotFoundError,
)
from selective_depth.drivers.open import open_source
from selective_depth.drivers.openni import OpenNIRecording

pytestmark = pytest.mark.openni


def check_exact(path: Path, sample: OniSample) -> None:
    with OpenNIRecording(path) as recording:
        assert recording.frame_count == len(sample.depth_mm)
        frames = list(recording)
        assert [frame.index for frame in frames] == list(range(len(sample.depth_mm)))
        times = np.array([frame.timestamp_us for frame in frames])
        # The sensor's clock counts thirtieths of a second.
        due = np.arange(1, len(frames) + 1) * 1_000_000 // 30
        np.testing.assert_array_equal(np.diff(times), np.diff(due))
        for frame, depth_mm in zip(frames, sample.depth_mm, strict=True):
            np.testing.assert_array_equal(frame.depth_mm, depth_mm)


def test_every_frame_once_bit_exact_twenty_times_from_odd_paths(
    oni_sample: OniSample, tmp_path: Path
) -> None:
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
    with OpenNIRecording(oni_sample.path) as recording:
        assert len(list(recording)) == 12
        for _ in range(2):
            with pytest.raises(SourceEndedError, match="after 12 frames"):
                recording.read()
    with pytest.raises(SourceEndedError):
        recording.read()
    recording.close()


def test_frames_stay_good_after_close(oni_sample: OniSample) -> None:
    with OpenNIRecording(oni_sample.path) as recording:
        frame = recording.read()
    np.testing.assert_array_equal(frame.depth_mm, oni_sample.depth_mm[0])


def test_two_replays_of_one_file_at_once(oni_sample: OniSample) -> None:
    with OpenNIRecording(oni_sample.path) as one, OpenNIRecording(oni_sample.path) as other:
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
        "from selective_depth.drivers.openni import OpenNIRecording\n"
        "frames = [frame.depth_mm for frame in OpenNIRecording(sys.argv[1])]\n"
        "assert np.array_equal(frames, np.load(sys.argv[2]))\n"
    )
    command = [sys.executable, "-c", script, str(oni_sample.path), str(tmp_path / "depth.npy")]
    processes = [subprocess.Popen(command) for _ in range(2)]
    assert [process.wait(30) for process in processes] == [0, 0]


@pytest.mark.parametrize("death", [signal.SIGSEGV, signal.SIGKILL])
def test_a_crash_on_the_way_is_a_named_error(oni_sample: OniSample, death: signal.Signals) -> None:
    with OpenNIRecording(oni_sample.path) as recording:
        good = [recording.read() for _ in range(3)]
        assert recording._worker is not None
        os.kill(recording._worker.pid, death)
        with pytest.raises(DamagedRecordingError, match=death.name):
            while True:
                good.append(recording.read())
        with pytest.raises(DamagedRecordingError):
            recording.read()
    assert [frame.index for frame in good] == list(range(len(good)))
    for frame in good:
        np.testing.assert_array_equal(frame.depth_mm, oni_sample.depth_mm[frame.index])


def test_a_hang_on_the_way_is_a_named_error(
    oni_sample: OniSample, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("selective_depth.drivers.openni.replay._SILENT_S", 0.3)
    with OpenNIRecording(oni_sample.path) as recording:
        recording.read()
        assert recording._worker is not None
        os.kill(recording._worker.pid, signal.SIGSTOP)
        with pytest.raises(DamagedRecordingError, match="hangs"):
            for _ in range(20):
                recording.read(timeout_s=0.4)


@pytest.mark.parametrize("keep", [0.1, 0.5])
def test_a_cut_file_is_refused_or_good_as_far_as_it_goes(
    oni_sample: OniSample, tmp_path: Path, keep: float
) -> None:
    cut = tmp_path / "cut.oni"
    data = oni_sample.path.read_bytes()
    cut.write_bytes(data[: int(len(data) * keep)])
    frames = []
    with pytest.raises(DamagedRecordingError, match="selective-depth check"):
        frames.extend(OpenNIRecording(cut))
    for frame in frames:
        np.testing.assert_array_equal(frame.depth_mm, oni_sample.depth_mm[frame.index])


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    text = tmp_path / "text.oni"
    text.write_text("not a recording")
    with pytest.raises(DamagedRecordingError, match=r"text\.oni"):
        OpenNIRecording(text)
    with pytest.raises(SourceNotFoundError, match=r"missing\.oni"):
        OpenNIRecording(tmp_path / "missing.oni")
    with pytest.raises(SourceNotFoundError, match="folder"):
        OpenNIRecording(tmp_path)
    os.mkfifo(tmp_path / "pipe.oni")
    with pytest.raises(SourceNotFoundError, match="regular file"):
        OpenNIRecording(tmp_path / "pipe.oni")


def test_without_the_runtime_it_says_what_to_install(
    oni_sample: OniSample, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENNI2_REDIST", str(tmp_path))
    with pytest.raises(RuntimeMissingError, match="libopenni2-0"):
        OpenNIRecording(oni_sample.path)


def test_a_recording_that_is_over_keeps_no_frame(oni_sample: OniSample) -> None:
    gc.disable()
    try:
        recording = OpenNIRecording(oni_sample.path)
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
        with OpenNIRecording(sample.path) as recording:
            for index in range(3):
                np.testing.assert_array_equal(recording.read().depth_mm, sample.depth_mm[index])
    assert open_files() == files
    assert threading.active_count() == threads
