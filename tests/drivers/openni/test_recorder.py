"""Recording a live sensor of the real OpenNI2 runtime."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from raw_oni_player import digest_of, play_all
from virtual_sensor import VirtualSensor

from selective_depth.app import cli
from selective_depth.drivers.errors import (
    DeviceRefusedError,
    OutputError,
    RuntimeMissingError,
    SourceError,
    SourceNotFoundError,
)
from selective_depth.drivers.oni import OniReader, inspect_oni
from selective_depth.drivers.open import open_source
from selective_depth.drivers.openni import record
from selective_depth.drivers.openni.runtime import find_runtime

pytestmark = pytest.mark.openni


def images(path: Path) -> list[int]:
    """Which of the sensor's images a recording holds, in order; each must be whole."""
    found = []
    with OniReader(path) as recording:
        for frame in recording:
            right = int(frame.depth_mm[0, -1])
            assert np.all(frame.depth_mm[:, :320] == right + 1000)
            assert np.all(frame.depth_mm[:, 320:] == right)
            found.append(right - 1)
    return found


def consecutive(found: list[int]) -> bool:
    return found == [(found[0] + step) % 20 for step in range(len(found))]


def test_every_frame_from_the_first_on(virtual_sensor: VirtualSensor, tmp_path: Path) -> None:
    seen: list[int] = []
    out = tmp_path / "mit Leerzeichen ö.oni"
    virtual_sensor.set(limit=10)
    report = record(out, frames=10, progress=seen.append)
    assert (report.path, report.frames, report.ended, report.problem) == (out, 10, "done", "")
    assert images(out) == list(range(10))
    assert seen == sorted(seen)
    assert seen[-1] == 10
    # Nothing but records: the recorder's tail of zeros is cut off.
    assert inspect_oni(out).tail_bytes == 0


def test_frames_whose_last_pixel_differs_replay_bit_for_bit(virtual_sensor: VirtualSensor, tmp_path: Path) -> None:
    """The runtime's own encoder swaps two bytes of such frames; ours does not."""
    drawn = np.random.default_rng(5).integers(500, 9000, 4)
    frames = np.full((4, 480, 640), 1200, np.uint16)
    frames[:, -1, -40:-1] = drawn[:, None]
    frames[:, -1, -1] = drawn + 700
    images_file = tmp_path / "images.raw"
    frames.tofile(images_file)
    virtual_sensor.set(frames=images_file, limit=8)
    report = record(tmp_path / "out.oni", frames=8)
    assert (report.frames, report.problem) == (8, "")
    with OniReader(report.path) as recording:
        for index, frame in enumerate(recording):
            np.testing.assert_array_equal(frame.depth_mm, frames[index % 4])


def test_frames_of_a_wrong_size_are_not_recorded(virtual_sensor: VirtualSensor, tmp_path: Path) -> None:
    def disturb(frames: int) -> None:
        if frames == 6:
            virtual_sensor.set(odd=1)  # frames of half the height

    report = record(tmp_path / "out.oni", frames=20, progress=disturb)
    assert "15 wrong frames in a row" in report.ended
    assert 6 <= report.frames < 20 and "not whole" not in report.problem
    assert len(images(report.path)) == report.frames


def test_far_depth_is_recorded_as_it_was_delivered(
    virtual_sensor: VirtualSensor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenNI2's recorder turns values beyond its stream's largest, 10 m, into small depths."""
    draw = np.random.default_rng(3)
    frames = np.full((4, 480, 640), 10_000, np.uint16)
    frames[1] = draw.choice([0, 800, 9_999, 10_000, 10_001, 40_000, 65_534], (480, 640))
    frames[2] = draw.integers(0, 65_535, (480, 640))  # more depths than compression can tell
    frames.tofile(tmp_path / "far.raw")
    virtual_sensor.set(frames=tmp_path / "far.raw", limit=8)
    report = record(tmp_path / "out.oni", frames=8)
    assert (report.frames, report.problem, report.ended) == (8, "", "done")
    assert inspect_oni(report.path, decode=True).complete
    with OniReader(report.path) as recording:
        for index, frame in enumerate(recording):
            np.testing.assert_array_equal(frame.depth_mm, frames[index % 4])
    assert cli.run(["export", str(report.path), str(tmp_path / "frames")]) == 0
    with open_source(tmp_path / "frames") as folder:
        for index, frame in enumerate(folder):
            np.testing.assert_array_equal(frame.depth_mm, frames[index % 4])
    monkeypatch.delenv("OPENNI2_REDIST")  # the system's, without the sensor
    played = next(play_all([report.path], find_runtime().path, patience_s=3.0))
    right = digest_of((n + 1, 480, 640, frames[n % 4].tobytes()) for n in range(8))
    assert (played.frames, played.digest) == right


def test_so_long_as_asked(virtual_sensor: VirtualSensor, tmp_path: Path) -> None:
    report = record(tmp_path / "out.oni", duration_s=0.5)
    assert report.ended == "done"
    assert 5 <= report.frames <= 20
    assert consecutive(images(report.path))


@pytest.mark.parametrize(
    ("fault", "ended"), [({"connected": 0}, "unplugged"), ({"stall": 1}, "no frame for 3 s"), ({"crash": 1}, "SIGSEGV")]
)
def test_a_fault_of_the_sensor_ends_it_with_what_is_there(
    virtual_sensor: VirtualSensor, tmp_path: Path, fault: dict[str, int], ended: str
) -> None:
    def disturb(frames: int) -> None:
        if frames == 6:
            virtual_sensor.set(**fault)

    report = record(tmp_path / "out.oni", progress=disturb)
    assert ended in report.ended
    assert report.frames >= 5 and report.problem == ""
    assert len(images(report.path)) == report.frames


def test_a_file_that_cannot_grow_is_noticed(virtual_sensor: VirtualSensor, tmp_path: Path) -> None:
    # A limit on the file's size is what a full disk or a quota is: writes that fail.
    script = (
        "import resource, sys\n"
        "from selective_depth.drivers.openni import record\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (90_000_000, 90_000_000))\n"
        "report = record(sys.argv[1])\n"
        "print(report.ended, report.frames, report.problem, sep='|')\n"
    )
    out = tmp_path / "out.oni"
    noise = np.random.default_rng(0).integers(0, 9999, (4, 480, 640)).astype(np.uint16)
    noise.tofile(tmp_path / "noise.raw")
    virtual_sensor.set(frames=tmp_path / "noise.raw", fps=60)
    answer = subprocess.run([sys.executable, "-c", script, str(out)], capture_output=True, text=True, timeout=30).stdout
    ended, frames, problem = answer.strip().split("|")
    assert "cannot be written (File too large)" in ended
    assert int(frames) > 0 and "not whole" not in problem
    assert inspect_oni(out, decode=True).readable_frames == int(frames)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("out.txt", "end in .oni"),
        ("missing/out.oni", "cannot be written: No such file"),
        ("folder.oni", "is a folder"),
        ("there.oni", "exists already"),
    ],
)
def test_an_unusable_place_is_refused_at_once(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / "folder.oni").mkdir()
    (tmp_path / "there.oni").write_text("precious")
    with pytest.raises(OutputError, match=message):
        record(tmp_path / name)
    assert (tmp_path / "there.oni").read_text() == "precious"


def test_a_full_disk_is_refused_at_once_and_noticed_on_the_way(
    virtual_sensor: VirtualSensor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free_bytes = shutil.disk_usage(tmp_path).free
    monkeypatch.setattr("selective_depth.drivers.oni.recorder.RESERVE_BYTES", 2 * free_bytes)
    with pytest.raises(OutputError, match="MB are free"):
        record(tmp_path / "out.oni")
    assert not list(tmp_path.glob("out*"))
    plenty = shutil.disk_usage(tmp_path)._replace(free=9 * free_bytes)
    looks = iter([plenty] * 6)
    scarce = plenty._replace(free=1000)
    monkeypatch.setattr("shutil.disk_usage", lambda _: next(looks, scarce))
    report = record(tmp_path / "out.oni", duration_s=20)
    assert (report.ended, report.frames, report.problem) == ("the disk is full", 5, "")
    assert len(images(report.path)) == 5


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ({"connected": 0}, SourceNotFoundError),
        ({"refuse_open": 1}, DeviceRefusedError),
        ({"refuse_start": 1}, DeviceRefusedError),
    ],
)
def test_without_a_sensor_no_file_is_left(
    virtual_sensor: VirtualSensor, tmp_path: Path, fault: dict[str, int], error: type[SourceError]
) -> None:
    virtual_sensor.set(**fault)
    with pytest.raises(error):
        record(tmp_path / "out.oni")
    assert not list(tmp_path.glob("out*"))


def test_an_older_recording_is_replaced_only_once_the_sensor_streams(
    virtual_sensor: VirtualSensor, tmp_path: Path
) -> None:
    out = tmp_path / "out.oni"
    out.write_text("precious")
    virtual_sensor.set(refuse_start=1)
    with pytest.raises(DeviceRefusedError):
        record(out, frames=3, overwrite=True)
    assert out.read_text() == "precious"
    virtual_sensor.set(refuse_start=0)
    assert record(out, frames=3, overwrite=True).problem == ""
    assert len(images(out)) >= 3


def test_without_the_runtime_no_file_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENNI2_REDIST", str(tmp_path))
    with pytest.raises(RuntimeMissingError):
        record(tmp_path / "out.oni")
    assert not list(tmp_path.glob("out*"))


def test_ctrl_c_closes_the_file(virtual_sensor: VirtualSensor, tmp_path: Path) -> None:
    def press(frames: int) -> None:
        if frames == 5:
            os.kill(os.getpid(), signal.SIGINT)

    report = record(tmp_path / "out.oni", progress=press)
    assert report.ended == "interrupted"
    assert report.problem == ""
    assert report.frames >= 5
    assert consecutive(images(report.path))


@pytest.mark.parametrize("death", [signal.SIGTERM, signal.SIGKILL])
def test_a_killed_program_leaves_a_whole_file(
    virtual_sensor: VirtualSensor, tmp_path: Path, death: signal.Signals
) -> None:
    script = (
        "import sys\n"
        "from selective_depth.drivers.openni import record\n"
        "record(sys.argv[1], progress=lambda frames: print(frames, flush=True))\n"
    )
    out = tmp_path / "out.oni"
    with subprocess.Popen([sys.executable, "-c", script, str(out)], stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        while int(program.stdout.readline()) < 5:
            pass
        program.send_signal(death)
    deadline = time.monotonic() + 5
    while True:
        try:
            found = images(out)
            break
        except SourceError:
            assert time.monotonic() < deadline
            time.sleep(0.05)
    assert len(found) >= 5
    assert consecutive(found)
