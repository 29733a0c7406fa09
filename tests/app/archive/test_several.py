"""`check`, `export` and `evaluate` on several recordings, and `replay`, which takes one."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from archives import Archive, write

from selective_depth.app import cli
from selective_depth.drivers.open import open_source


def test_check_of_several(archive: Archive, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["check", str(archive.path)]) == 1
    out = capsys.readouterr().out
    assert "60 recordings, 3 not whole" in out
    lines = {line.split()[0]: line for line in out.splitlines() if line.startswith("lab/")}
    assert len(lines) == 60
    for name, frames in archive.frames.items():
        assert lines[name].split()[1:] == [str(frames), "whole"]
    assert lines["lab/day2/torn"].split()[1] == "4"
    whole = [str(archive.path / name.removeprefix("lab/")) for name in list(archive.frames)[:3]]
    assert cli.run(["check", *whole]) == 0
    assert "3 recordings, 0 not whole" in capsys.readouterr().out
    assert cli.run(["check", *whole, "--repair", "x.oni"]) == 2


def test_export_of_several(archive: Archive, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = tmp_path / "walk.oni"
    write(one, "ball", 2, 1)
    out = tmp_path / "out"
    assert cli.run(["export", str(archive.path / "day1"), str(one), str(out), "--frames", "2"]) == 1
    text = capsys.readouterr().out
    assert "not whole" in text and "lab" not in text
    with open_source(one) as source, open_source(out / "walk") as copy:
        for frame, same in zip(source, copy, strict=True):
            assert (frame.depth_mm == same.depth_mm).all()
    for name in archive.frames:
        if "/day1/" in name:
            with open_source(out / Path(name.removeprefix("lab/")).with_suffix("")) as copy:
                assert copy.frame_count == 2
    assert cli.run(["export", str(one)]) == 2
    assert "where to" in capsys.readouterr().err


def test_options_of_a_source_are_not_those_of_where_it_goes(tmp_path: Path) -> None:
    write(tmp_path / "scan", "ball", 2, 1)
    assert cli.run(["export", str(tmp_path / "scan"), str(tmp_path / "out"), "--scale", "500"]) == 0
    with open_source(tmp_path / "scan") as source, open_source(tmp_path / "out") as copy:
        assert (copy.read().depth_mm == 2 * source.read().depth_mm).all()


def test_replay_of_several_names_batch(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["replay", "a.oni", "b.oni"]) == 2
    assert "'replay' takes one source, and 'b.oni' is another; 'batch' takes several" in capsys.readouterr().err


def test_the_engine_leaves_dasks_own_settings_as_they_are() -> None:
    """Its threads, which may be ending still, look things up there. In a process that has not imported it yet."""
    script = (
        "import contextlib\nfrom selective_depth.app.archive.engine import engine\n"
        "from selective_depth.app.console.errors import UsageError\n"
        "with contextlib.suppress(UsageError), engine('no address'): pass\n"
        "import dask\nprint('comm' in dask.config.config['distributed'])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.stdout == "True\n", done.stderr
