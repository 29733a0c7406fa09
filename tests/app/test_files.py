"""The commands `check` and `export`: what they print, write and return."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

from selective_depth.app.cli import run
from selective_depth.app.commands.files import export
from selective_depth.app.console.errors import UsageError
from selective_depth.drivers.folder import RecordedFolder, write_folder
from selective_depth.drivers.folder.images import write_png
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.oni import OniReader, inspect_oni, write_oni
from selective_depth.drivers.open import open_source
from selective_depth.drivers.source import DepthSource


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    draw = np.random.default_rng(0)
    path = tmp_path / "walk.oni"
    camera = Camera.kinect(64, 48)
    write_oni(
        path, (DepthFrame(draw.integers(0, 4000, (48, 64), np.uint16), number, number, camera) for number in range(5))
    )
    return path


def _cut(path: Path) -> Path:
    cut = path.with_name("cut.oni")
    cut.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return cut


def test_check_of_a_whole_file(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", str(recording)]) == 0
    printed = capsys.readouterr().out
    assert "nothing is wrong with it" in printed
    for row in (("Depth (16zT)", "5"), ("frame size", "64x48"), ("readable depth frames", "5")):
        assert any(all(part in line for part in row) for line in printed.splitlines()), row


def test_check_of_a_cut_file_says_where_and_what_next(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cut = _cut(recording)
    assert run(["check", str(cut)]) == 1
    printed = capsys.readouterr().out
    assert f"byte {cut.stat().st_size}: the file ends without its END mark" in printed
    assert "5 Depth frames are announced, 2 are there" in printed
    assert "--repair" in printed


def test_check_repairs(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = recording.with_name("out.oni")
    assert run(["check", str(_cut(recording)), "--repair", str(out)]) == 0
    assert "2 depth frames, whole" in capsys.readouterr().out
    assert inspect_oni(out).complete
    assert run(["check", str(_cut(recording)), "--repair", str(out)]) == 1
    assert "exists already" in capsys.readouterr().err


def test_a_source_without_end_needs_a_number(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Endless(DepthSource):
        live, dropped, frame_count, fps = True, 0, None, 30.0
        camera = Camera.kinect(4, 4)

        def read(self, timeout_s: float = 5.0) -> DepthFrame:
            return DepthFrame(np.ones((4, 4), np.uint16), 0, 0, Camera.kinect(4, 4))

        def close(self) -> None:
            pass

    monkeypatch.setattr("selective_depth.app.pipeline.feed.open_source", lambda _: Endless())
    assert run(["export", "openni", str(tmp_path / "out")]) == 2
    assert "'openni' never ends; say how many" in capsys.readouterr().err
    assert run(["export", "openni", str(tmp_path / "out"), "--frames", "3"]) == 0
    with RecordedFolder(tmp_path / "out") as folder:
        assert folder.frame_count == 3


@pytest.mark.parametrize("content", ["", "text named .oni"])
def test_check_of_what_is_no_recording(tmp_path: Path, content: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "not.oni"
    path.write_text(content)
    assert run(["check", str(path)]) == 1
    assert "it is not an .oni recording" in capsys.readouterr().out


def test_check_of_a_missing_file_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", str(tmp_path / "none.oni")]) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1 and "does not exist" in printed.err


def test_export_to_a_folder_and_back(recording: Path) -> None:
    folder, again = recording.with_name("frames"), recording.with_name("again.oni")
    assert run(["export", str(recording), str(folder)]) == 0
    assert run(["export", str(folder), str(again), "--frames", "4"]) == 0
    with OniReader(recording) as first, RecordedFolder(folder) as second, OniReader(again) as third:
        frames = list(zip(first, second, third, strict=False))
        assert third.frame_count == 4
    assert len(frames) == 4
    for one, two, three in frames:
        np.testing.assert_array_equal(one.depth_mm, two.depth_mm)
        np.testing.assert_array_equal(one.depth_mm, three.depth_mm)
        assert one.timestamp_us == two.timestamp_us == three.timestamp_us
        assert one.camera == two.camera


def test_export_saves_what_is_readable_of_a_damaged_file(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for out in ("frames", "out.oni"):
        assert run(["export", str(_cut(recording)), str(recording.with_name(out))]) == 0
        assert "2 frames" in capsys.readouterr().out
    assert inspect_oni(recording.with_name("out.oni")).complete


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["walk.oni", "out", "--frames", "0"], 2, "--frames is 0; it must be 1 or more"),
        (["none.oni", "out"], 1, "does not exist"),
        (["walk.oni", "walk.oni"], 1, "exists already"),
        (["walk.oni", "full"], 1, "holds frames already"),
    ],
)
def test_export_refuses_in_one_line(
    recording: Path,
    arguments: list[str],
    code: int,
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(recording.parent)
    Path("full").mkdir()
    Path("full", "0.png").touch()
    assert run(["export", *arguments]) == code
    printed = capsys.readouterr()
    assert message in printed.err
    assert printed.err.count("\n") == 1


def test_a_damaged_recording_is_exported_alike_with_and_without_a_number(tmp_path: Path) -> None:
    data = bytearray((ROOT / "recordings" / "workstation.oni").read_bytes())
    report = inspect_oni(ROOT / "recordings" / "workstation.oni")
    assert report.depth is not None
    data[report.depth.frames[25].record_offset] ^= 0xFF
    damaged = tmp_path / "damaged.oni"
    damaged.write_bytes(data)
    assert export(str(damaged), tmp_path / "all", None) == 0
    assert export(str(damaged), tmp_path / "some", 28) == 0
    with open_source(tmp_path / "all") as every, open_source(tmp_path / "some") as some:
        assert (every.frame_count, some.frame_count) == (29, 28)


@pytest.mark.parametrize("name", ["out.npz", "out.PNG", "out.bag"])
def test_a_file_that_export_does_not_write_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError, match=r"name of a folder.*ends in \.oni"):
        export("virtual:ball", tmp_path / name, 1)
    assert not (tmp_path / name).exists()


def test_a_principal_point_goes_along(tmp_path: Path) -> None:
    camera = Camera(64, 48, 60.0, 60.0, 30.0, 24.0)
    write_folder(tmp_path / "in", [DepthFrame(np.ones((48, 64), np.uint16), 0, 0, camera)])
    assert export(str(tmp_path / "in"), tmp_path / "out.oni", None) == 0
    with open_source(tmp_path / "out.oni") as source:
        assert source.camera == camera


def test_options_of_a_source_are_given_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number in range(2):
        (tmp_path / "in" / "depth").mkdir(parents=True, exist_ok=True)
        write_png(tmp_path / "in" / "depth" / f"{number}.png", np.full((48, 64), 1500, np.uint16))
    words = [str(tmp_path / "in"), str(tmp_path / "out"), "--scale", "500", "--camera=60,61,32,24"]
    assert run(["export", *words]) == 0
    first = capsys.readouterr().out.splitlines()[0]
    assert "read as Redwood: 500 values a metre (as given); camera fx 60 fy 61" in first
    with open_source(tmp_path / "out") as saved:
        assert (saved.camera.fx, saved.read().depth_mm[0, 0]) == (60, 3000)
    assert run(["devices", "--scale", "500"]) == 2
    assert "--scale is an option of a source" in capsys.readouterr().err
