"""Recorded folders: layouts, sidecar, round trip, and everything that can be wrong with a file."""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from selective_depth.drivers.errors import (
    DamagedRecordingError,
    OutputError,
    SourceEndedError,
    SourceError,
    SourceNotFoundError,
)
from selective_depth.drivers.folder import FolderWriter, RecordedFolder, write_folder
from selective_depth.drivers.folder.images import read_raw
from selective_depth.drivers.folder.sidecar import SIDECAR, Sidecar, read_sidecar, write_sidecar
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.oni import write_oni
from selective_depth.drivers.open import open_source
from selective_depth.drivers.realtime import RealtimeSource

Depth = npt.NDArray[np.uint16]


def _depth(rows: int = 6, columns: int = 8, seed: int = 0) -> Depth:
    return np.random.default_rng(seed).integers(0, 10_000, (rows, columns), dtype=np.uint16)


def _png(path: Path, image: npt.NDArray[np.generic] | None = None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), _depth() if image is None else image)
    return path


def _frames(path: Path) -> list[DepthFrame]:
    with RecordedFolder(path) as folder:
        return list(folder)


# Layouts


def test_plain_folder_is_read_in_natural_order_with_a_kinects_camera(tmp_path: Path) -> None:
    for number in (10, 9, 2):
        _png(tmp_path / f"{number}.png", _depth(480, 640, seed=number))
    with RecordedFolder(tmp_path) as folder:
        assert (folder.layout, folder.frame_count, folder.live) == ("plain", 3, False)
        assert folder.camera == Camera.kinect()
        assert folder.fps == 30.0
        frames = list(folder)
    assert {frame.source for frame in frames} == {str(tmp_path)}
    for number, frame in zip((2, 9, 10), frames, strict=True):
        np.testing.assert_array_equal(frame.depth_mm, _depth(480, 640, seed=number))
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [frame.timestamp_us for frame in frames] == [0, 33333, 66667]
    for frame, number in zip(frames, (2, 9, 10), strict=True):
        np.testing.assert_array_equal(frame.depth_mm, _depth(480, 640, seed=number))


@pytest.mark.parametrize("inner", ["", "depth"])
def test_tum_folder_uses_its_list_scale_and_sequence(tmp_path: Path, inner: str) -> None:
    root = tmp_path / "rgbd_dataset_freiburg2_desk"
    raw = np.array([[0, 5000, 65535, 12]] * 3, np.uint16)
    raw = np.tile(raw, (160, 160))
    _png(root / "depth" / "1311.1.png", np.zeros_like(raw))
    _png(root / "depth" / "1311.3.png", raw)
    _png(root / "depth" / "not-listed.png", _depth())
    (root / "depth.txt").write_text(
        "# depth maps\n# timestamp filename\n1311.300000 depth/1311.3.png\n\n1311.400000 depth/1311.1.png\n"
    )
    with RecordedFolder(root / inner) as folder:
        assert (folder.layout, folder.frame_count) == ("TUM", 2)
        assert (folder.camera.fx, folder.camera.cy) == (520.9, 249.7)
        assert folder.fps == 10.0
        first, second = folder
    assert first.depth_mm.any()
    assert not second.depth_mm.any()
    assert [first.timestamp_us, second.timestamp_us] == [1_311_300_000, 1_311_400_000]
    np.testing.assert_array_equal(first.depth_mm[0, :4], [0, 1000, 13107, 2])


def test_seven_scenes_folder_takes_only_its_depth_and_drops_the_invalid_mark(tmp_path: Path) -> None:
    raw = np.array([[65535, 1200], [0, 65534]], np.uint16)
    _png(tmp_path / "frame-000001.depth.png", raw)
    _png(tmp_path / "frame-000000.depth.png", raw)
    _png(tmp_path / "frame-000000.color.png", np.zeros((2, 2, 3), np.uint8))
    with RecordedFolder(tmp_path) as folder:
        assert (folder.layout, folder.frame_count) == ("7-Scenes", 2)
        assert folder.camera == Camera.kinect(2, 2)  # calibrated for 640x480 only
        np.testing.assert_array_equal(folder.read().depth_mm, [[0, 1200], [0, 65534]])


def test_redwood_folder_takes_its_timestamps_from_the_names(tmp_path: Path) -> None:
    for number in range(3):
        _png(tmp_path / "depth" / f"{number + 1:06d}-{number * 33369:012d}.png", _depth(480, 640))
    _png(tmp_path / "rgb" / "000001.png", np.zeros((2, 2, 3), np.uint8))
    with RecordedFolder(tmp_path) as folder:
        assert (folder.layout, folder.frame_count) == ("Redwood", 3)
        assert folder.camera == Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
        assert [frame.timestamp_us for frame in folder] == [0, 33369, 66738]


def test_sidecar_overrides_scale_camera_rate_and_timestamps(tmp_path: Path) -> None:
    raw = np.array([[0, 1, 500], [2000, 65535, 7]], np.uint16)
    _png(tmp_path / "a.png", raw)
    _png(tmp_path / "b.png", raw)
    (tmp_path / SIDECAR).write_text(
        "values_per_metre = 500\nmissing = [7]\nfps = 15.0\ntimestamps_us = [5, 70]\n"
        "[camera]\nwidth = 3\nheight = 2\nfx = 4\nfy = 5.5\ncx = 1\ncy = 0.5\n"
    )
    with RecordedFolder(tmp_path) as folder:
        assert folder.camera == Camera(3, 2, 4.0, 5.5, 1.0, 0.5)
        assert folder.fps == 15.0
        first, second = folder
    # 65535 would be 131 m, more than millimetres in 16 bits can say.
    np.testing.assert_array_equal(first.depth_mm, [[0, 2, 1000], [4000, 0, 0]])
    assert [first.timestamp_us, second.timestamp_us] == [5, 70]


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (240, 320), (1024, 1280)])
def test_any_size_is_read(tmp_path: Path, rows: int, columns: int) -> None:
    _png(tmp_path / "0.png", _depth(rows, columns))
    frame = _frames(tmp_path)[0]
    assert frame.shape == (rows, columns)
    assert frame.camera == Camera.kinect(columns, rows)


def test_real_frames_come_out_as_they_are_in_the_files(shared_data: Path) -> None:
    files = sorted((shared_data / "sequence").glob("*.png"))
    with open_source(shared_data / "sequence") as folder:
        assert folder.frame_count == len(files) == 120
        count = 0
        for frame, file in zip(folder, files, strict=True):
            assert frame.source == str(shared_data / "sequence")
            if count % 10 == 0:
                expected = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
                np.testing.assert_array_equal(frame.depth_mm, expected)
            count += 1
    assert count == 120


# Protocol


def test_after_the_last_frame_it_has_ended_and_closing_twice_is_harmless(tmp_path: Path) -> None:
    _png(tmp_path / "0.png")
    folder = RecordedFolder(tmp_path)
    folder.read()
    for _ in range(2):
        with pytest.raises(SourceEndedError, match="has ended after frame 1"):
            folder.read()
    folder.close()
    folder.close()
    with pytest.raises(SourceEndedError):
        folder.read()


def test_frames_before_a_damaged_one_stay_good(tmp_path: Path) -> None:
    for name in ("0", "1", "2"):
        _png(tmp_path / f"{name}.png")
    damaged = tmp_path / "1.png"
    data = bytearray(damaged.read_bytes())
    data[60] ^= 0xFF
    damaged.write_bytes(bytes(data))
    with RecordedFolder(tmp_path) as folder:
        first = folder.read()
        with pytest.raises(DamagedRecordingError, match=r"1\.png.*checksum.*copy it again"):
            folder.read()
    np.testing.assert_array_equal(first.depth_mm, _depth())


# Writing


def test_what_is_written_is_read_back_bit_by_bit(tmp_path: Path) -> None:
    camera = Camera(8, 6, 7.25, 7.5, 3.9, 2.8)
    frames = [DepthFrame(_depth(seed=number), number, 10**15 + 33_366 * number, camera) for number in range(3)]
    out = tmp_path / "neü er" / "folder"
    assert write_folder(out, frames, fps=29.97) == 3
    with RecordedFolder(out) as folder:
        assert (folder.fps, folder.camera) == (29.97, camera)
        for frame, expected in zip(folder, frames, strict=True):
            np.testing.assert_array_equal(frame.depth_mm, expected.depth_mm)
            assert (frame.index, frame.timestamp_us) == (expected.index, expected.timestamp_us)


def test_an_interrupted_recording_keeps_what_it_has(tmp_path: Path) -> None:
    writer = FolderWriter(tmp_path / "cut", fps=10)
    camera = Camera(8, 6, 7.25, 7.5, 3.9, 2.8)
    writer.write(DepthFrame(_depth(), 0, 0, camera))
    writer.write(DepthFrame(_depth(seed=1), 1, 5, camera))
    # Never closed: the timestamps are lost, nothing else.
    with RecordedFolder(tmp_path / "cut") as folder:
        assert (folder.frame_count, folder.camera, folder.fps) == (2, camera, 10.0)


def test_frames_are_never_mixed_into_a_folder_in_use(tmp_path: Path) -> None:
    _png(tmp_path / "old.png")
    with pytest.raises(OutputError, match="holds frames already"):
        FolderWriter(tmp_path)


def test_an_output_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        FolderWriter(tmp_path / "file" / "inside")


def test_a_full_disk_leaves_a_readable_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = FolderWriter(tmp_path / "full")
    camera = Camera.kinect(8, 6)
    writer.write(DepthFrame(_depth(), 0, 0, camera))

    def fail(path: Path, data: bytes) -> int:
        with path.open("wb") as file:
            file.write(data[:20])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OutputError, match="No space left"):
        writer.write(DepthFrame(_depth(), 1, 1, camera))
    writer.close()
    assert len(_frames(tmp_path / "full")) == 1


def test_frames_of_another_camera_are_refused(tmp_path: Path) -> None:
    with FolderWriter(tmp_path / "out") as writer:
        writer.write(DepthFrame(_depth(), 0, 0, Camera.kinect(8, 6)))
        with pytest.raises(ValueError, match="write it to another folder"):
            writer.write(DepthFrame(_depth(4, 4), 1, 1, Camera.kinect(4, 4)))


# What can be wrong


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(SourceNotFoundError, match="does not exist"):
        RecordedFolder(tmp_path / "nowhere")


def test_an_empty_folder_says_what_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(SourceNotFoundError, match=r"no depth frames in .*looked for 16-bit PNG"):
        RecordedFolder(tmp_path)


def test_a_folder_one_level_too_high_names_the_right_one(tmp_path: Path) -> None:
    _png(tmp_path / "take1" / "0.png")
    with pytest.raises(SourceNotFoundError, match=r"take1' holds PNG files \(1\): give that folder"):
        RecordedFolder(tmp_path)


@pytest.mark.parametrize(
    ("image", "kind"),
    [
        (np.zeros((6, 8), np.uint8), "an 8-bit grey"),
        (np.zeros((6, 8, 3), np.uint8), "a colour"),
        (np.zeros((6, 8, 4), np.uint16), "a colour [+] alpha"),
    ],
)
def test_a_png_that_is_no_depth_is_named_before_the_first_frame(
    tmp_path: Path, image: npt.NDArray[np.generic], kind: str
) -> None:
    _png(tmp_path / "0.png")
    _png(tmp_path / "1.png", image)
    with pytest.raises(DamagedRecordingError, match=rf"1\.png' is {kind} PNG.*convert"):
        RecordedFolder(tmp_path)


def test_a_png_of_another_size_says_expected_and_got(tmp_path: Path) -> None:
    _png(tmp_path / "0.png")
    _png(tmp_path / "1.png", _depth(5, 8))
    with pytest.raises(DamagedRecordingError, match=r"1\.png' is 8x5 pixels, but .* is 8x6"):
        RecordedFolder(tmp_path)


def test_a_png_of_another_size_than_the_sidecars_camera_is_named(tmp_path: Path) -> None:
    _png(tmp_path / "0.png")
    write_sidecar(tmp_path, Sidecar(camera=Camera.kinect()))
    with pytest.raises(DamagedRecordingError, match=r"0\.png' is 8x6 pixels, but .* is 640x480"):
        RecordedFolder(tmp_path)


@pytest.mark.parametrize("keep", [0, 7, 20, 33, 60, -12, -5])
def test_a_truncated_png_is_named(tmp_path: Path, keep: int) -> None:
    path = _png(tmp_path / "0.png")
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(DamagedRecordingError, match=r"0\.png"):
        _frames(tmp_path)


def test_text_named_png_is_named(tmp_path: Path) -> None:
    (tmp_path / "0.png").write_text("not an image")
    with pytest.raises(DamagedRecordingError, match="not a PNG file, whatever its name says"):
        RecordedFolder(tmp_path)


def test_a_png_that_grows_after_opening_is_not_delivered(tmp_path: Path) -> None:
    _png(tmp_path / "0.png")
    _png(tmp_path / "1.png")
    with RecordedFolder(tmp_path) as folder:
        _png(tmp_path / "0.png", _depth(12, 8))
        with pytest.raises(DamagedRecordingError, match="8x12"):
            folder.read()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes have names on POSIX systems only")
def test_a_pipe_in_the_folder_does_not_hang(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "0.png")
    with pytest.raises(DamagedRecordingError, match="not a regular file"):
        RecordedFolder(tmp_path)
    (tmp_path / "0.png").unlink()
    _png(tmp_path / "0.png")
    os.mkfifo(tmp_path / SIDECAR)
    with pytest.raises(DamagedRecordingError, match="not a regular file"):
        RecordedFolder(tmp_path)


def test_a_claim_of_gigantic_size_allocates_nothing(tmp_path: Path) -> None:
    header = b"IHDR" + struct.pack(">IIBBBBB", 2**31 - 1, 2**31 - 1, 16, 0, 0, 0, 0)
    (tmp_path / "0.png").write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + struct.pack(">I", 13)
        + header
        + struct.pack(">I", zlib.crc32(header))
        + struct.pack(">I", 99)
        + b"IDAT"
    )
    with pytest.raises(DamagedRecordingError, match="claims to be larger"):
        RecordedFolder(tmp_path)


def test_damaged_files_print_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = _png(tmp_path / "0.png", _depth(64, 64))
    whole = path.read_bytes()
    for place in range(8, len(whole), 97):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x55]) + whole[place + 1 :])
        with pytest.raises(DamagedRecordingError):
            _frames(tmp_path)
        path.write_bytes(whole[:place])
        with pytest.raises(DamagedRecordingError):
            _frames(tmp_path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("line", ["1.0 ../secret.png", "1.0 /etc/secret.png", "1.0 depth/../../x.png", "1.0 C:\\x.png"])
def test_a_tum_list_cannot_lead_outside_of_its_folder(tmp_path: Path, line: str) -> None:
    (tmp_path / "depth.txt").write_text(line)
    with pytest.raises(DamagedRecordingError, match="outside the folder"):
        RecordedFolder(tmp_path)


@pytest.mark.parametrize("line", ["no", "1 2 3", "nan depth/0.png", "inf depth/0.png", "x y"])
def test_a_wrong_line_of_a_tum_list_is_shown(tmp_path: Path, line: str) -> None:
    (tmp_path / "depth.txt").write_text(f"# comment\n{line}")
    with pytest.raises(DamagedRecordingError, match="line 2 of"):
        RecordedFolder(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fps = ", "not valid TOML"),
        ("speed = 3", "'speed'.*no such entry.*values_per_metre"),
        ("fps = 0", "'fps'.*got 0; allowed is a number from 0.001"),
        ("fps = true", "'fps'.*got True"),
        ("fps = nan", "'fps'.*got nan"),
        ("values_per_metre = -1000", "values_per_metre.*got -1000"),
        ("values_per_metre = 1e999", "values_per_metre.*got inf"),
        ("missing = 3", "missing.*a list of whole numbers"),
        ("missing = [70000]", "missing.*from 0 to 65535"),
        ("timestamps_us = [1.5]", "timestamps_us.*got 1.5; allowed is a whole number"),
        ("timestamps_us = [1, 2]", "holds 1 frames, but .* lists 2 timestamps"),
        ("camera = 3", "camera.*a table of exactly width"),
        ("[camera]\nwidth = 8", "camera.*a table of exactly width"),
        ("[camera]\nwidth = 8\nheight = 6\nfx = 0\nfy = 1\ncx = 1\ncy = 1", "camera.*focal length fx is 0"),
        ("[camera]\nwidth = 8.5\nheight = 6\nfx = 1\nfy = 1\ncx = 1\ncy = 1", "width.*whole number"),
        ("fps = 0x" + "f" * 5000, "too long to print"),
        ("a = " + "[" * 5000, "TOML"),
    ],
)
def test_a_wrong_sidecar_names_the_entry_and_what_is_allowed(tmp_path: Path, text: str, message: str) -> None:
    _png(tmp_path / "0.png")
    (tmp_path / SIDECAR).write_text(text)
    with pytest.raises(DamagedRecordingError, match=message):
        RecordedFolder(tmp_path)


# Nothing but the named errors, whatever is in the files


@settings(max_examples=200, deadline=None)
@given(data=st.binary(max_size=200))
def test_any_bytes_as_sidecar_give_settings_or_a_named_error(
    tmp_path_factory: pytest.TempPathFactory, data: bytes
) -> None:
    folder = tmp_path_factory.getbasetemp() / "any-sidecar"
    folder.mkdir(exist_ok=True)
    (folder / SIDECAR).write_bytes(data)
    with contextlib.suppress(SourceError):
        assert isinstance(read_sidecar(folder), Sidecar)


_VALUES = st.recursive(
    st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | st.text(max_size=5) | st.sampled_from([6, 8]),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["width", "height", "fx", "fy", "cx", "cy"]), inner, min_size=5)
    ),
    max_leaves=8,
)


@settings(max_examples=200, deadline=None)
@given(entries=st.dictionaries(st.sampled_from([*Sidecar.__dataclass_fields__, "other"]), _VALUES, max_size=5))
def test_any_toml_as_sidecar_opens_the_folder_or_gives_a_named_error(
    tmp_path_factory: pytest.TempPathFactory, entries: dict[str, object]
) -> None:
    folder = tmp_path_factory.getbasetemp() / "any-toml"
    if not folder.exists():
        _png(folder / "0.png")
    (folder / SIDECAR).write_text("\n".join(f"{k} = {_toml(v)}" for k, v in entries.items()))
    try:
        frame = _frames(folder)[0]
    except SourceError:
        return
    assert frame.shape == (6, 8)


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + "".join(f"\\U{ord(letter):08x}" for letter in value) + '"'
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(inner)}" for key, inner in value.items()) + "}"
    return repr(value)


@settings(max_examples=200, deadline=None)
@given(
    changes=st.lists(st.tuples(st.integers(0, 10**6), st.integers(1, 255)), max_size=4),
    cut=st.none() | st.integers(0, 10**6),
    mend=st.booleans(),
)
def test_any_damaged_png_gives_its_frame_or_a_named_error(
    tmp_path_factory: pytest.TempPathFactory, changes: list[tuple[int, int]], cut: int | None, mend: bool
) -> None:
    folder = tmp_path_factory.getbasetemp() / "any-png"
    source = folder / "whole.png"
    if not source.exists():
        _png(source, _depth(16, 16))
    data = bytearray(source.read_bytes())
    for place, change in changes:
        data[place % len(data)] ^= change
    if mend:
        data = _with_right_checksums(data)
    if cut is not None:
        del data[cut % len(data) :]
    path = folder / "damaged.png"
    path.write_bytes(bytes(data))
    try:
        raw = read_raw(path)
    except SourceError:
        return
    assert raw.dtype == np.uint16 and raw.ndim == 2
    if data == source.read_bytes():
        np.testing.assert_array_equal(raw, _depth(16, 16))


def _with_right_checksums(data: bytearray) -> bytearray:
    """The same file with its checksums made right, so that the damage reaches the decoder."""
    at = 8
    while at + 12 <= len(data):
        end = at + 12 + int.from_bytes(data[at : at + 4], "big")
        if end > len(data):
            break
        data[end - 4 : end] = zlib.crc32(data[at + 4 : end - 4]).to_bytes(4, "big")
        at = end
    return data


# What other people's public reports showed


def test_names_that_are_decimals_come_in_the_order_of_the_numbers(tmp_path: Path) -> None:
    names = ["1700000000.0625", "1700000000.125", "1700000000.5", "1700000001.0", "1700000001.25"]
    for number, name in enumerate(names, start=1):
        _png(tmp_path / f"{name}.png", np.full((6, 8), number, np.uint16))
    with RecordedFolder(tmp_path) as folder:
        assert [int(frame.depth_mm[0, 0]) for frame in folder] == [1, 2, 3, 4, 5]
        assert "leading zeros" in folder.notes[0]


def test_names_whose_two_readings_agree_are_no_matter(tmp_path: Path) -> None:
    for name in ("1.250", "1.750", "2.125"):
        _png(tmp_path / f"{name}.png", _depth(6, 8))
    with RecordedFolder(tmp_path) as folder:
        assert folder.notes == ()


@pytest.mark.parametrize("name", ["out.oni", "out"])
def test_a_clock_that_wraps_is_named_and_leaves_nothing_in_the_way(tmp_path: Path, name: str) -> None:
    times_us = [4294917295, 4294950628, 16666]
    frames = [DepthFrame(_depth(6, 8), index, time_us, Camera.kinect(8, 6)) for index, time_us in enumerate(times_us)]
    write_folder(tmp_path / "wrapped", frames)
    out = tmp_path / name
    if name == "out":  # a folder can hold them
        with open_source(tmp_path / "wrapped") as source:
            assert write_folder(out, source) == 3
        return
    for _ in range(2):
        with (
            open_source(tmp_path / "wrapped") as source,
            pytest.raises(ValueError, match=r"frame 2 of .*wrapped round.*timestamps_us"),
        ):
            write_oni(out, source)
        assert not out.exists()


@pytest.mark.skipif(os.name != "posix", reason="processes are forked on POSIX only")
@pytest.mark.parametrize("kind", ["folder", "oni", "realtime"])
def test_a_forked_process_is_told_to_open_the_source_itself(tmp_path: Path, kind: str) -> None:
    frames = [DepthFrame(_depth(6, 8), k, 33_333 * k, Camera.kinect(8, 6)) for k in range(4)]
    path = tmp_path / ("walk.oni" if kind == "oni" else "walk")
    _ = write_oni(path, frames) if kind == "oni" else write_folder(path, frames)
    with open_source(path) as opened:
        source = RealtimeSource(opened) if kind == "realtime" else opened
        source.read()
        child = os.fork()
        if child == 0:
            try:
                source.read(timeout_s=2)
            except SourceError as error:
                os._exit(0 if "open it in the process" in str(error) else 1)
            os._exit(2)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert source.read().index == 1
        source.close()


def test_a_disk_that_fills_leaves_nothing_in_the_way(small_disk: Path) -> None:
    """The real thing: a file system of one megabyte."""
    noise = np.random.default_rng(0).integers(1, 20_000, (480, 640)).astype(np.uint16)
    frames = [DepthFrame(noise, k, 33_333 * k, Camera.kinect()) for k in range(9)]
    for _ in range(2):
        with pytest.raises(OutputError, match="No space left"):
            write_folder(small_disk / "out", frames)
        with pytest.raises(OutputError, match="No space left"):
            write_oni(small_disk / "out.oni", frames)
        assert list(small_disk.iterdir()) == []
    assert write_folder(small_disk / "out", frames[:1]) == 1


def test_numbers_of_numpy_are_written_as_toml_has_them(tmp_path):
    camera = Camera(np.int64(4), np.int32(3), np.float64(2.5), np.float32(2.5), 2.0, 1)
    frame = DepthFrame(np.ones((3, 4), np.uint16), 0, np.int64(1 << 61), camera)
    assert write_folder(tmp_path / "kept", [frame], fps=np.float64(29.97)) == 1
    with RecordedFolder(tmp_path / "kept") as source:
        assert source.fps == 29.97
        back = source.read()
    assert back.camera == camera
    assert back.timestamp_us == 1 << 61
