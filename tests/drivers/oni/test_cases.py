"""Recordings as other recorders write them: right in every pixel, side, unit, time and camera."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from selective_depth.app.cli import run
from selective_depth.drivers.errors import DamagedRecordingError, SourceError, SourceNotFoundError
from selective_depth.drivers.frame import Camera
from selective_depth.drivers.oni import inspect_oni, repair_oni
from selective_depth.drivers.oni.codec import encode_depth
from selective_depth.drivers.oni.form import mended_times
from selective_depth.drivers.oni.nodes import OniNode, Property, integer, structure
from selective_depth.drivers.oni.records import CODEC_TABLE, HEADER, Kind, NodeType, pack_property, pack_record
from selective_depth.drivers.oni.writer import RecordWriter, depth_properties
from selective_depth.drivers.open import open_source

Depth = npt.NDArray[np.uint16]
CAMERA = Camera(80, 60, 73.0, 74.0, 40.0, 30.0)


@pytest.fixture(scope="module")
def scene() -> list[Depth]:
    with open_source("virtual:workstation?size=80x60") as source:
        return [source.read().depth_mm for _ in range(4)]


def write(
    path: Path,
    frames: list[Depth],
    *,
    between: dict[int, dict[str, Property]] | None = None,
    times_us: list[int] | None = None,
    streams: int = 1,
    **properties: Property,
) -> Path:
    """A recording; `between` are properties that change before a frame."""
    writer = RecordWriter(path)
    for node in range(1, streams + 1):
        depth = OniNode(node, "Depth", NodeType.DEPTH, CODEC_TABLE, depth_properties(CAMERA, 30) | properties)
        writer.add_node(depth)
    writer.begin()
    for number, mm in enumerate(frames):
        for name, (kind, value) in (between or {}).get(number, {}).items():
            writer._append(pack_record(kind, 1, pack_property(name, value)))
        time_us = (times_us or [33_333 * n for n in range(len(frames))])[number]
        for node in range(1, streams + 1):
            writer.add_frame(node, time_us, encode_depth(mm * node))
    writer.close()
    return path


def delivered(path: Path | str) -> list[Depth]:
    with open_source(path) as source:
        return [frame.depth_mm for frame in source]


def same(got: list[Depth], wanted: list[Depth]) -> None:
    for depth_mm, right_mm in zip(got, wanted, strict=True):
        np.testing.assert_array_equal(depth_mm, right_mm)


def mirrored(frames: list[Depth]) -> list[Depth]:
    return [np.ascontiguousarray(mm[:, ::-1]) for mm in frames]


def test_a_mirrored_recording_is_delivered_the_right_way_round(tmp_path: Path, scene: list[Depth]) -> None:
    path = write(tmp_path / "a.oni", mirrored(scene), xnMirror=integer(1))
    same(delivered(path), scene)
    report = inspect_oni(path)
    assert report.complete and "mirrored" in report.notes[0]
    repair_oni(path, tmp_path / "b.oni")
    assert not inspect_oni(tmp_path / "b.oni").notes
    same(delivered(tmp_path / "b.oni"), scene)


def test_a_side_that_is_switched_is_right_in_each_frame(tmp_path: Path, scene: list[Depth]) -> None:
    stored = scene[:2] + mirrored(scene[2:3]) + scene[3:]
    between = {2: {"xnMirror": integer(1)}, 3: {"xnMirror": integer(0)}}
    path = write(tmp_path / "a.oni", stored, between=between)
    same(delivered(path), scene)
    assert "in part" in inspect_oni(path).notes[0]


def test_a_side_that_was_switched_unsaid_is_put_right(tmp_path: Path, scene: list[Depth]) -> None:
    path = write(tmp_path / "a.oni", scene[:2] + mirrored(scene[2:]))
    with open_source(path) as source:
        same([frame.depth_mm for frame in source], scene)
        assert "turns into its mirror image at frame 3" in source.notes[0]
    repair_oni(path, tmp_path / "b.oni")
    same(delivered(tmp_path / "b.oni"), scene)


def test_tenths_of_millimetres_are_millimetres(tmp_path: Path, scene: list[Depth]) -> None:
    tenths = [mm.astype(np.uint16) * 10 + 4 for mm in scene]
    path = write(tmp_path / "a.oni", tenths, oniPixelFormat=integer(101))
    same(delivered(path), scene)
    assert inspect_oni(path).complete


def test_a_crop_shifts_the_camera(tmp_path: Path, scene: list[Depth]) -> None:
    cropped = [np.ascontiguousarray(mm[10:50, 20:60]) for mm in scene]
    path = write(tmp_path / "a.oni", cropped, xnCropping=structure("<IHHHH", 1, 20, 10, 40, 40))
    same(delivered(path), cropped)
    with open_source(path) as source:
        assert (source.camera.width, source.camera.height) == (40, 40)
        assert (source.camera.fx, source.camera.cx, source.camera.cy) == (pytest.approx(73.0), 20.0, 20.0)
    repair_oni(path, tmp_path / "b.oni")
    same(delivered(tmp_path / "b.oni"), cropped)


@pytest.mark.parametrize("format_", [102, 103])
def test_shifts_are_refused_and_not_called_damaged(
    tmp_path: Path, scene: list[Depth], format_: int, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "a.oni", scene, oniPixelFormat=integer(format_))
    with pytest.raises(SourceError, match="its pixels are shifts in 9") as caught:
        open_source(path)
    assert not isinstance(caught.value, DamagedRecordingError)
    assert run(["check", str(path)]) == 1
    said = capsys.readouterr().out
    assert "not damaged, but cannot be read" in said and "--repair" not in said


def test_of_several_depth_streams_one_is_asked_for(tmp_path: Path, scene: list[Depth]) -> None:
    path = write(tmp_path / "a.oni", scene, streams=2)
    same(delivered(path), scene)
    same(delivered(f"{path}?stream=1"), scene)
    same(delivered(f"{path}?stream=2"), [mm * 2 for mm in scene])
    assert "2 depth streams" in inspect_oni(path).notes[0]
    with pytest.raises(SourceNotFoundError, match="has 2 depth streams"):
        open_source(f"{path}?stream=3")


def test_a_size_that_changes_ends_what_is_readable(
    tmp_path: Path, scene: list[Depth], capsys: pytest.CaptureFixture[str]
) -> None:
    between = {2: {"xnMapOutputMode": structure("<III", 40, 30, 30)}}
    small = [np.ascontiguousarray(mm[::2, ::2]) for mm in scene[2:]]
    path = write(tmp_path / "a.oni", scene[:2] + small, between=between)
    frames = []
    with open_source(path) as source, pytest.raises(DamagedRecordingError, match="changes after"):
        frames += [source.read().depth_mm, source.read().depth_mm]
        source.read()
    same(frames, scene[:2])
    assert run(["check", str(path)]) == 1
    assert "readable to frame 2" in capsys.readouterr().out


def test_end_before_the_seek_table_is_how_openni_1_ends(tmp_path: Path, scene: list[Depth]) -> None:
    data = write(tmp_path / "a.oni", scene).read_bytes()
    end = pack_record(Kind.END, 0)
    removed = pack_record(Kind.NODE_REMOVED, 1, undone_offset=24)
    assert data.endswith(end)
    at = data.index(removed)
    table_at = at + len(removed)
    moved = bytearray(data[:at] + end + data[at : -len(end)])
    # The table has moved on: where it is stands at the end of the first record.
    fields_end = 24 + struct.unpack_from("<4sIII", moved, 24)[3]
    struct.pack_into("<Q", moved, fields_end - 8, table_at + len(end))
    path = tmp_path / "b.oni"
    path.write_bytes(moved)
    report = inspect_oni(path, decode=True)
    assert report.complete and report.tail_bytes == 0 and HEADER.size == len(end)
    same(delivered(path), scene)


@pytest.mark.parametrize(
    ("times_us", "mended_us"),
    [
        ([0, 33, 66, 2**64 - 50_000, 2**64 - 49_967], [0, 33, 66, 99, 132]),
        ([100, 133, 166, 20, 53, 86], [100, 133, 166, 199, 232, 265]),
        ([0, 33, 66, 99], [0, 33, 66, 99]),
        ([0, 2**50, 2**50 + 33, 2**50 + 66], [0, 33, 66, 99]),
    ],
)
def test_a_clock_that_jumps_goes_on_rising(times_us: list[int], mended_us: list[int]) -> None:
    assert mended_times(times_us)[0] == mended_us
    assert mended_times([]) == ([], None)


def test_a_jump_is_said_and_mended(tmp_path: Path, scene: list[Depth], capsys: pytest.CaptureFixture[str]) -> None:
    times_us = [0, 33_333, 2**64 - 10_000_000, 2**64 - 9_966_667]
    path = write(tmp_path / "a.oni", scene, times_us=times_us)
    assert run(["check", str(path), "--repair", str(tmp_path / "b.oni")]) == 0
    assert "the clock of Depth jumps at frame 3" in " ".join(inspect_oni(path).notes)
    assert inspect_oni(tmp_path / "b.oni").notes == ()
    for each in (path, tmp_path / "b.oni"):
        with open_source(each) as source:
            assert [frame.timestamp_us for frame in source] == [0, 33_333, 66_666, 99_999]


def test_a_pointer_of_git_lfs_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.oni"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12345\n")
    with pytest.raises(DamagedRecordingError, match=r"Git LFS pointer.*git lfs pull"):
        open_source(path)


# The recordings that went wrong


@pytest.mark.parametrize(
    ("name", "frames", "check_code", "said"),
    [
        ("ni154_workstation.oni", 30, 0, "nothing is wrong"),
        ("c1_16zT.oni", 27, 0, "mirrored"),
        ("wrap.oni", 8, 0, "clock of Depth jumps"),
        ("mirror.oni", 5, 0, "mirrored"),
        ("mirror_toggle2.oni", 6, 0, "turns into its mirror image at frame 4"),
        ("two_depth.oni", 5, 0, "2 depth streams"),
        ("killed.oni", 8, 1, "readable to frame 8"),
        ("um100.oni", 6, 0, "0.1 mm"),
        ("crop.oni", 5, 0, "cropped to 320x240 at 100, 60"),
        ("rgb_lossy.oni", 6, 0, "nothing is wrong"),
        ("color_only.oni", 0, 1, "no depth was recorded; it holds Image (5 frames)"),
        ("depth_never.oni", 0, 1, "never gave a frame; it holds Image (6 frames)"),
    ],
)
def test_check_and_replay_of_a_case_agree(
    shared_cases: Path, capsys: pytest.CaptureFixture[str], name: str, frames: int, check_code: int, said: str
) -> None:
    path = shared_cases / "oni" / name
    assert run(["check", str(path)]) == check_code
    assert said in capsys.readouterr().out
    if frames == 0:
        with pytest.raises(SourceError, match="cannot be read") as caught:
            open_source(path)
        assert not isinstance(caught.value, DamagedRecordingError)
        return
    with open_source(path) as source:
        got = list(source)
    assert len(got) == frames
    steps = np.diff([frame.timestamp_us for frame in got])
    assert ((steps > 30_000) & (steps < 40_000)).all()


def _of(cases: Path, name: str) -> list[Depth]:
    return delivered(cases / "oni" / name)


@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("mirror.oni", lambda mm: mm),
        ("mirror_toggle2.oni", lambda mm: mm),
        ("crop.oni", lambda mm: mm[60:300, 100:420]),
    ],
)
def test_the_cases_show_the_same_scene(shared_cases: Path, name: str, made: Callable[[Depth], Depth]) -> None:
    """All were made of the frames of the clock's case, whose side and size are plain."""
    right = [made(mm) for mm in _of(shared_cases, "wrap.oni")]
    for got in _of(shared_cases, name):
        # A frame that was just being delivered when the side was switched has both, in its top.
        assert any(np.array_equal(got[4:], mm[4:]) for mm in right)
