"""What is in an .oni file: against the real runtime, against itself, and when it is damaged."""

from __future__ import annotations

import io
import os
import re
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from conftest import OniSample
from oni_mutations import cuts, mutations
from raw_oni_player import digest_of, play_all
from virtual_sensor import record_oni

from selective_depth.drivers.errors import DamagedRecordingError, OutputError, SourceEndedError, SourceNotFoundError
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.oni import OniReader, OniReport, inspect_oni, repair_oni, write_oni
from selective_depth.drivers.oni.codec import encode_depth
from selective_depth.drivers.oni.inspection import _Inspection
from selective_depth.drivers.oni.nodes import OniNode, integer, structure
from selective_depth.drivers.oni.records import (
    BEGIN_FIELDS,
    CODEC_NONE,
    CODEC_TABLE,
    FILE_HEADER,
    FRAME_FIELDS,
    HEADER,
    MAGIC,
    OLD_HEADER,
    Kind,
    NodeType,
    pack_property,
)
from selective_depth.drivers.oni.writer import OniWriter, RecordWriter, depth_properties
from selective_depth.drivers.open import open_source
from selective_depth.drivers.openni.runtime import find_runtime

Depth = npt.NDArray[np.uint16]
CAMERA = Camera(80, 60, 73.0, 74.0, 40.0, 30.0)
COUNT = 6


def _frames(count: int = COUNT, camera: Camera = CAMERA) -> list[DepthFrame]:
    draw = np.random.default_rng(count)
    rows, columns = np.mgrid[0 : camera.height, 0 : camera.width]
    frames = []
    for number in range(count):
        depth = 500 + 7 * columns + 3 * rows + 100 * number + draw.integers(-9, 9, rows.shape)
        depth[draw.random(rows.shape) < 0.1] = 0
        depth[0, :2] = (65535, 1)
        frames.append(DepthFrame(depth.astype(np.uint16), number, 7000 + 33_366 * number, camera))
    return frames


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "recording.oni"
    assert write_oni(path, _frames()) == COUNT
    return path


@pytest.fixture
def killed(tmp_path: Path) -> Path:
    """A recording whose recorder was killed in the middle of a frame."""
    path = tmp_path / "killed.oni"
    writer = OniWriter(path)
    for frame in _frames():
        writer.write(frame)
    writer._writer._file.flush()
    path.write_bytes(path.read_bytes()[:-100])
    return path


def _read(path: Path) -> list[DepthFrame]:
    with OniReader(path) as reader:
        return list(reader)


def _assert_same(read: list[DepthFrame], expected: list[DepthFrame]) -> None:
    assert len(read) == len(expected)
    for index, (frame, original) in enumerate(zip(read, expected, strict=True)):
        np.testing.assert_array_equal(frame.depth_mm, original.depth_mm)
        assert frame.index == index
    first_us = expected[0].timestamp_us
    assert [frame.timestamp_us - read[0].timestamp_us for frame in read] == [
        frame.timestamp_us - first_us for frame in expected
    ]


# Against the real runtime


@pytest.mark.openni
def test_a_file_of_the_real_recorder_is_read_bit_by_bit(oni_sample: OniSample) -> None:
    report = inspect_oni(oni_sample.path, decode=True)
    assert not report.problems
    assert report.complete and report.openable
    assert report.readable_frames == len(oni_sample.depth_mm)
    assert report.fps == 30
    frames = _read(oni_sample.path)
    np.testing.assert_array_equal([frame.depth_mm for frame in frames], oni_sample.depth_mm)
    # The field of view goes through 32-bit floats.
    assert frames[0].camera.fx == pytest.approx(frames[0].camera.fy, rel=1e-3)


@pytest.mark.openni
def test_the_real_player_delivers_what_is_written_and_what_is_repaired(
    tmp_path: Path, recording: Path, killed: Path
) -> None:
    repaired = tmp_path / "repaired.oni"
    repair_oni(killed, repaired)
    wide = tmp_path / "wide.oni"
    write_oni(wide, _frames(2, Camera.kinect(1280, 1024)))
    paths = [recording, repaired, killed, wide]
    outcomes = list(play_all(paths, find_runtime().path, patience_s=3.0))
    for path, outcome, count in zip(paths, outcomes, (COUNT, COUNT - 1, COUNT - 1, 2), strict=True):
        expected = digest_of((frame.index + 1, *frame.shape, frame.depth_mm.tobytes()) for frame in _read(path))
        assert (outcome.ended, outcome.frames) == ("frames", count), path.name
        assert (outcome.frames, outcome.digest) == expected, path.name


@pytest.mark.openni
def test_what_openni2s_recorder_swaps_is_read_rightly_and_repaired(virtual_driver: Path, tmp_path: Path) -> None:
    """A lone last pixel after a run: the recorder's flaw, seen on real frames of a Kinect."""
    depth = np.full((3, 480, 640), 1000, np.uint16)
    depth[:, 0, 0] = 3000
    depth[1:, -1, -1] = 1001
    path, out = tmp_path / "swapped.oni", tmp_path / "repaired.oni"
    record_oni(depth, path)
    library = find_runtime().path
    wrong = next(play_all([path], library, patience_s=3.0))
    report = inspect_oni(path, decode=True)
    assert report.complete and report.swapped_frames == 2
    np.testing.assert_array_equal([frame.depth_mm for frame in _read(path)], depth)
    right = digest_of((number + 1, 480, 640, depth[number].tobytes()) for number in range(3))
    assert (wrong.frames, wrong.digest) != right

    assert repair_oni(path, out).swapped_frames == 0
    played = next(play_all([out], library, patience_s=3.0))
    assert (played.frames, played.digest) == right


@pytest.mark.openni
def test_a_killed_recording_of_the_real_recorder_comes_back(tmp_path: Path, oni_sample: OniSample) -> None:
    """As the recorder leaves it: no end, no frame count, no seek table, half a frame."""
    data = bytearray(oni_sample.path.read_bytes())
    frame = inspect_oni(oni_sample.path).depth.frames[8]  # type: ignore[union-attr]
    node = data.index(MAGIC)
    added = HEADER.size + 4 + len("Depth") + 1 + 4 + 4
    data[node + added : node + added + 4] = b"\xff" * 4
    data[node + added + 12 : node + added + 20] = b"\xff" * 8
    data[node + added + 20 : node + added + 28] = bytes(8)
    path = tmp_path / "killed.oni"
    path.write_bytes(data[: frame.payload_offset + 999])
    report = inspect_oni(path)
    assert (report.readable_frames, report.ended, report.openable) == (8, False, True)
    out = repair_oni(path, tmp_path / "out.oni")
    assert out.complete and out.readable_frames == 8
    for file in (path, tmp_path / "out.oni"):
        np.testing.assert_array_equal([frame.depth_mm for frame in _read(file)], oni_sample.depth_mm[:8])


def test_without_the_runtime_a_recording_opens_all_the_same(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENNI2_REDIST", str(tmp_path / "no runtime here"))
    with open_source(recording) as source:
        assert isinstance(source, OniReader)
        _assert_same(list(source), _frames())


# Writing and reading


def test_what_is_written_is_read_back(recording: Path) -> None:
    report = inspect_oni(recording, decode=True)
    assert report.complete and not report.problems
    assert (report.version, report.tail_bytes, report.fps) == ("1.0.1.0", 0, 30)
    assert report.duration_s == pytest.approx(5 * 0.033366)
    frames = _read(recording)
    _assert_same(frames, _frames())
    camera = frames[0].camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (80, 60, 40.0, 30.0)
    assert (camera.fx, camera.fy) == pytest.approx((73.0, 74.0))


def test_reading_ends_and_closes(recording: Path) -> None:
    reader = OniReader(recording)
    assert (reader.frame_count, reader.live, reader.fps) == (COUNT, False, 30)
    assert sum(1 for _ in reader) == COUNT
    with pytest.raises(SourceEndedError, match="has ended after 6 frames"):
        reader.read()
    reader.close()
    reader.close()
    with pytest.raises(SourceEndedError, match="closed"):
        reader.read()


def test_an_existing_file_is_never_overwritten(recording: Path) -> None:
    before = recording.read_bytes()
    for make in (OniWriter, lambda path: repair_oni(recording, path)):
        with pytest.raises(OutputError, match="exists already; give another name"):
            make(recording)
    assert recording.read_bytes() == before


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"out\.oni' cannot be written \(No such file"):
        OniWriter(tmp_path / "missing" / "out.oni")


@pytest.mark.skipif(sys.platform == "win32", reason="limits of files are POSIX's")
@pytest.mark.parametrize("size", [10, 5_000, 150_000, -1])
def test_a_full_disk_leaves_no_part_of_a_file(tmp_path: Path, size: int) -> None:
    """At whichever byte it is full, be it the last; a limit of the file's size does the same."""
    import resource

    frames = _frames(60)
    whole = tmp_path / "whole.oni"
    write_oni(whole, frames)
    size = size % whole.stat().st_size
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        for write in (write_oni, lambda path, _: repair_oni(whole, path)):
            with pytest.raises(OutputError, match=r"out\.oni' cannot be written \(File too large"):
                write(tmp_path / "out.oni", frames)
            assert list(tmp_path.iterdir()) == [whole]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert write_oni(tmp_path / "out.oni", frames) == len(frames)


def test_frames_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    with OniWriter(tmp_path / "out.oni") as writer:
        writer.write(_frames()[1])
        with pytest.raises(ValueError, match="write it to another file"):
            writer.write(_frames(1, Camera.kinect(20, 10))[0])
        with pytest.raises(ValueError, match="33366 us older than the first"):
            writer.write(_frames()[0])
    assert inspect_oni(tmp_path / "out.oni").complete


def test_a_failing_source_leaves_a_complete_file(tmp_path: Path) -> None:
    def failing() -> object:
        yield from _frames(3)
        raise RuntimeError("unplugged")

    with pytest.raises(RuntimeError, match="unplugged"):
        write_oni(tmp_path / "out.oni", failing())  # type: ignore[arg-type]
    assert inspect_oni(tmp_path / "out.oni", decode=True).complete
    assert len(_read(tmp_path / "out.oni")) == 3


def test_without_a_frame_there_is_no_file(tmp_path: Path) -> None:
    assert write_oni(tmp_path / "out.oni", []) == 0
    assert not (tmp_path / "out.oni").exists()


# Damage


def test_a_killed_recording_is_read_to_its_last_whole_frame(killed: Path) -> None:
    report = inspect_oni(killed)
    assert not report.complete and not report.ended
    assert report.openable
    assert report.readable_frames == COUNT - 1
    assert all(problem.harmless for problem in report.problems)
    text = " ".join(map(str, report.problems))
    assert "recorder was stopped" in text and "ends inside a NEW_DATA record" in text
    _assert_same(_read(killed), _frames()[:-1])


def test_repair_makes_a_killed_recording_whole(killed: Path, tmp_path: Path) -> None:
    before = killed.read_bytes()
    report = repair_oni(killed, tmp_path / "out.oni")
    assert report.complete and report.readable_frames == COUNT - 1
    _assert_same(_read(tmp_path / "out.oni"), _frames()[:-1])
    assert killed.read_bytes() == before


def test_frames_around_a_damaged_one_are_saved(recording: Path, tmp_path: Path) -> None:
    data = bytearray(recording.read_bytes())
    frames = inspect_oni(recording).depth.frames  # type: ignore[union-attr]
    data[frames[2].record_offset] ^= 1  # one frame's header
    data[frames[4].payload_offset + 2] ^= 0xFF  # another's table of depths
    recording.write_bytes(data)

    report = inspect_oni(recording, decode=True)
    assert not report.openable
    assert report.readable_frames == COUNT - 2
    offsets = [problem.offset for problem in report.problems]
    assert frames[2].record_offset in offsets and frames[4].record_offset in offsets

    with OniReader(recording) as reader:
        _assert_same([reader.read(), reader.read()], _frames()[:2])
        with pytest.raises(DamagedRecordingError, match=r"beyond frame 2 .*selective-depth check"):
            reader.read()

    kept = [frame for frame in _frames() if frame.index not in (2, 4)]
    repair_oni(recording, tmp_path / "out.oni")
    _assert_same(_read(tmp_path / "out.oni"), kept)
    with OniReader(recording, salvage=True) as reader:
        assert reader.frame_count == len(kept)
        _assert_same(list(reader), kept)
        assert reader.camera == inspect_oni(recording).camera


def test_a_frame_that_cannot_be_decoded_ends_the_replay_with_its_place(recording: Path) -> None:
    data = bytearray(recording.read_bytes())
    frame = inspect_oni(recording).depth.frames[1]  # type: ignore[union-attr]
    data[frame.payload_offset : frame.payload_offset + 2] = b"\0\0"
    recording.write_bytes(data)
    with OniReader(recording) as reader:
        reader.read()
        for _ in range(2):
            with pytest.raises(DamagedRecordingError, match=f"byte {frame.record_offset}: frame 2 cannot"):
                reader.read()


@pytest.mark.parametrize(
    ("times_us", "mended_us"),
    [
        ([0, 10, 20, 30], [0, 10, 20, 30]),
        ([0, 10, 2**62, 30], [0, 10, 20, 30]),
        ([0, 10, 20, 1, 40], [0, 10, 20, 30, 40]),
        ([7, 7, 7, 7], [7, 7, 7, 7]),
        ([2**62, 10, 20, 30], [10, 10, 20, 30]),
        ([2**60, 2**60 + 1, 5, 2**60 + 3], [2**60, 2**60 + 1, 2**60 + 2, 2**60 + 3]),
    ],
)
def test_repair_interpolates_times_that_break_the_order(
    tmp_path: Path, times_us: list[int], mended_us: list[int]
) -> None:
    writer = RecordWriter(tmp_path / "odd.oni")
    writer.add_node(OniNode(1, "Depth", NodeType.DEPTH, CODEC_TABLE, depth_properties(CAMERA, 30)))
    writer.begin()
    for time_us in times_us:
        writer.add_frame(1, time_us, encode_depth(_frames(1)[0].depth_mm))
    writer.close()
    assert repair_oni(tmp_path / "odd.oni", tmp_path / "out.oni").complete
    assert [frame.timestamp_us for frame in _read(tmp_path / "out.oni")] == mended_us


def test_timestamps_are_held_against_the_seek_table(recording: Path) -> None:
    data = bytearray(recording.read_bytes())
    frame = inspect_oni(recording).depth.frames[3]  # type: ignore[union-attr]
    struct.pack_into("<Q", data, frame.record_offset + HEADER.size, frame.timestamp_us + 1)
    recording.write_bytes(data)
    assert "disagree on its place or time" in str(inspect_oni(recording).problems[0])


@pytest.mark.parametrize(
    ("place", "value", "sentence"),
    [
        (0, b"RIFF", "begins with b'RIFF' instead of b'NI10'"),
        (4, b"\x09", r"version 9\.0\.1\.0"),
        (20, b"\xff\xff\xff\xff", "announces 4294967295 streams"),
        (24, b"X", "must begin with 'NIR'"),
        (28, b"\x63", "no record of kind 99"),
        (36, b"\xff\xff\xff\x7f", "cannot have 2147483647 bytes of header"),
        (36, b"\x01", "cannot have 1 bytes of header"),
        (40, b"\x01", "1 bytes of payload but needs none"),
        (44, b"\xff\xff", "refers ahead"),
        (52, b"\xff\xff", "its name is broken"),
        (56, b"\x07", "not plain text"),
        (62, b"\x09", "no depth stream"),
        (66, b"zz", "compression b'zz"),
        (70, b"\x63", "99 Depth frames are announced, 6 are there"),
        (90, b"\xff", "no valid seek table"),
    ],
)
def test_every_wrong_number_is_found_and_named(recording: Path, place: int, value: bytes, sentence: str) -> None:
    data = bytearray(recording.read_bytes())
    data[place : place + len(value)] = value
    recording.write_bytes(data)
    report = inspect_oni(recording)
    assert not report.openable
    assert re.search(sentence, " ".join(map(str, report.problems)))


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("xnMapOutputMode", struct.pack("<III", 0, 60, 30), "cannot be 0x60"),
        ("xnMapOutputMode", struct.pack("<III", 80, 60, 0), "at 0 a second"),
        ("xnMapOutputMode", struct.pack("<III", 2**31, 2**31, 30), "cannot be 2147483648x"),
        ("xnMapOutputMode", b"short", "has 5 bytes, not 12"),
        ("xnMapOutputMode", None, "frame size is not recorded"),
        ("xnCropping", None, "would deliver no frame at all"),
        ("xnCropping", struct.pack("<IHHHH", 1, 79, 0, 8, 8), "cannot be cropped"),
        ("xnFOV", struct.pack("<dd", float("nan"), 0.7), "field of view is wrong: "),
        ("oniRequiredFrameSize", (5).to_bytes(8, "little"), "do not have 5 bytes"),
        ("xnDeviceMaxDepth", (0).to_bytes(8, "little"), "largest depth cannot be 0"),
        ("oniPixelFormat", (200).to_bytes(8, "little"), "have format 200"),
    ],
)
def test_a_wrong_property_is_named(tmp_path: Path, name: str, value: bytes | None, sentence: str) -> None:
    properties = depth_properties(CAMERA, 30)
    kind = properties.pop(name)[0]
    if value is not None:
        properties[name] = (kind, value)
    path = tmp_path / "odd.oni"
    _write(path, properties)
    report = inspect_oni(path)
    assert not report.openable
    assert sentence in " ".join(map(str, report.problems))


@pytest.mark.parametrize("name", ["xnCropping", "xnFOV", "oniRequiredFrameSize"])
def test_repair_completes_what_openni2_needs(tmp_path: Path, name: str) -> None:
    properties = depth_properties(CAMERA, 30)
    kind, value = properties.pop(name)
    if name != "xnCropping":
        properties[name] = (kind, b"\xff" * len(value))
    _write(tmp_path / "odd.oni", properties)
    assert not inspect_oni(tmp_path / "odd.oni").openable
    assert repair_oni(tmp_path / "odd.oni", tmp_path / "out.oni").complete


def _write(
    path: Path,
    properties: dict[str, tuple[Kind, bytes]],
    codec: bytes = CODEC_TABLE,
    encode: Callable[[Depth], bytes] = encode_depth,
) -> None:
    """A recording of a colour and a depth stream, interleaved."""
    writer = RecordWriter(path)
    writer.add_node(OniNode(1, "Image", NodeType.IMAGE, b"JPEG", {"Gain": integer(3)}))
    writer.add_node(OniNode(2, "Depth", NodeType.DEPTH, codec, properties))
    writer.begin()
    for frame in _frames():
        writer.add_frame(1, frame.timestamp_us, b"no real JPEG")
        writer.add_frame(2, frame.timestamp_us, encode(frame.depth_mm))
    writer.close()


def test_other_streams_are_listed_and_survive_repair(tmp_path: Path) -> None:
    path, out = tmp_path / "both.oni", tmp_path / "out.oni"
    _write(path, depth_properties(CAMERA, 30))
    assert inspect_oni(path).complete
    cut = tmp_path / "cut.oni"
    cut.write_bytes(path.read_bytes()[: path.stat().st_size * 3 // 4])
    report = repair_oni(cut, out)
    assert [node.name for node in report.nodes] == ["Image", "Depth"]
    assert report.complete
    image = report.nodes[0]
    assert len(image.frames) in (report.readable_frames, report.readable_frames + 1)
    assert image.properties["Gain"] == integer(3)


def test_uncompressed_depth_is_read(tmp_path: Path) -> None:
    _write(
        tmp_path / "none.oni",
        depth_properties(CAMERA, 30),
        CODEC_NONE,
        lambda depth_mm: depth_mm.astype("<u2").tobytes(),
    )
    _assert_same(_read(tmp_path / "none.oni"), _frames())


def test_files_of_openni_1_are_read_and_brought_up_to_date(tmp_path: Path) -> None:
    """Version 1.0.0.4: offsets of 32 bits, the frame count in DATA_BEGIN, no seek table."""
    out = bytearray(FILE_HEADER.pack(b"NI10", 1, 0, 0, 4, 10**9, 1))

    def add(kind: Kind, fields: bytes = b"", payload: bytes = b"") -> None:
        out.extend(OLD_HEADER.pack(MAGIC, kind, 1, OLD_HEADER.size + len(fields), len(payload), 0) + fields + payload)

    add(Kind.NODE_ADDED_4, b"\x07\0\0\0Depth1\0" + struct.pack("<I4s", NodeType.DEPTH, b"16zT"))
    properties = depth_properties(CAMERA, 30)
    del properties["xnFOV"]
    properties["xnRealWorldTranslationData"] = structure("<ddd", 120.0, 0.1, 2.0)
    for name, (kind, value) in properties.items():
        add(kind, pack_property(name, value))
    add(Kind.STATE_READY)
    add(Kind.DATA_BEGIN, BEGIN_FIELDS.pack(COUNT, 10**9))
    for frame in _frames():
        fields = FRAME_FIELDS.pack(frame.timestamp_us, frame.index + 1)
        add(Kind.NEW_DATA, fields, encode_depth(frame.depth_mm))
    add(Kind.NODE_REMOVED)
    add(Kind.END)
    path = tmp_path / "old.oni"
    path.write_bytes(out)
    report = inspect_oni(path, decode=True)
    assert not report.problems and report.old and report.complete
    assert report.camera == Camera(80, 60, 600.0, 600.0, 40.0, 30.0)
    _assert_same(_read(path), _frames())
    repaired = repair_oni(path, tmp_path / "new.oni")
    assert not repaired.old and repaired.camera is not None
    assert repaired.camera.fx == pytest.approx(600)
    _assert_same(_read(tmp_path / "new.oni"), _frames())


def test_hundreds_of_damaged_files_give_frames_or_named_errors_and_can_be_repaired(
    recording: Path, tmp_path: Path
) -> None:
    sound = recording.read_bytes()
    path, out = tmp_path / "damaged.oni", tmp_path / "out.oni"
    saved = 0
    for name, data in [*cuts(sound, 50), *mutations(sound, 350, seed=1)]:
        path.write_bytes(data)
        report = inspect_oni(path, decode=True)
        try:
            frames = _read(path)
        except DamagedRecordingError:
            frames = []
        if report.complete:
            assert len(frames) == report.readable_frames, name
        if report.readable_frames == 0:
            assert not frames, name
            with pytest.raises(DamagedRecordingError, match="nothing can be saved"):
                repair_oni(path, out)
            continue
        assert len(frames) <= report.readable_frames, name
        repaired = repair_oni(path, out)
        assert repaired.complete and repaired.readable_frames == report.readable_frames, name
        again = _read(out)
        for frame, same in zip(frames, again, strict=False):
            np.testing.assert_array_equal(frame.depth_mm, same.depth_mm, name)
        out.unlink()
        saved += len(again)
    assert saved > 1200


# What is no recording at all


def test_what_is_no_file_is_said_at_once(tmp_path: Path) -> None:
    for asking in (inspect_oni, OniReader):
        with pytest.raises(SourceNotFoundError, match="does not exist"):
            asking(tmp_path / "none.oni")
    with pytest.raises(SourceNotFoundError, match="is a folder"):
        inspect_oni(tmp_path)
    with pytest.raises(SourceNotFoundError, match="does not exist"):
        inspect_oni(tmp_path / "a\0b.oni")
    with pytest.raises(SourceNotFoundError, match="cannot be read"):
        inspect_oni(tmp_path / ("x" * 5000))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes have names on POSIX systems only")
def test_a_pipe_does_not_hang(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.oni")
    with pytest.raises(SourceNotFoundError, match="not a regular file"):
        inspect_oni(tmp_path / "pipe.oni")


@pytest.mark.parametrize("content", [b"", b"NI10", b"text, not a recording", bytes(100_000)])
def test_what_is_no_recording_gets_a_report_and_no_frames(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "not.oni"
    path.write_bytes(content)
    report = inspect_oni(path)
    assert isinstance(report, OniReport)
    assert not report.openable and not report.complete
    assert report.problems[0].offset in (0, 4)
    for reading in (lambda: OniReader(path), lambda: repair_oni(path, tmp_path / "out.oni")):
        with pytest.raises(DamagedRecordingError, match=r"not\.oni"):
            reading()
    assert not (tmp_path / "out.oni").exists()


def test_checking_a_huge_hole_ends_in_time(tmp_path: Path, recording: Path) -> None:
    path = tmp_path / "huge.oni"
    with path.open("wb") as file:
        data = recording.read_bytes()
        file.write(data[: data.rindex(MAGIC)])
        file.truncate(1 << 36)
    start = time.monotonic()
    assert inspect_oni(path, decode=True, timeout_s=2).readable_frames == COUNT
    assert time.monotonic() - start < 5


def test_decoding_stops_in_time_and_a_slow_disk_is_no_damage(recording: Path) -> None:
    report = inspect_oni(recording, decode=True, timeout_s=0)
    assert (report.decoded_frames, report.complete, report.readable_frames) == (0, True, COUNT)
    assert inspect_oni(recording, decode=True).decoded_frames == COUNT
    assert inspect_oni(recording).decoded_frames == 0


def test_a_file_of_nothing_but_broken_records_is_read_once(tmp_path: Path) -> None:
    """Headers that claim a megabyte each: every search for the next record goes on where the last
    one ended."""
    path = tmp_path / "crafted.oni"
    header = HEADER.pack(MAGIC, 99, 1, HEADER.size, 1 << 20, 0)
    path.write_bytes(FILE_HEADER.pack(b"NI10", 1, 0, 1, 0, 10**9, 1) + header * 20_000)
    read = 0

    class Counting(io.FileIO):
        def read(self, size: int = -1, /) -> bytes:
            nonlocal read
            got = super().read(size)
            read += len(got)
            return got

    with Counting(path) as file:
        report = _Inspection(path, file).report_on()  # type: ignore[arg-type]
    assert not report.complete
    assert read < 4 * path.stat().st_size + (4 << 20)


def test_a_failing_disk_is_named(recording: Path) -> None:
    with OniReader(recording) as reader:
        assert reader._file is not None
        os.close(reader._file.fileno())
        with pytest.raises(DamagedRecordingError, match=r"cannot be read at byte .*Bad file"):
            reader.read()
        reader._file = None
