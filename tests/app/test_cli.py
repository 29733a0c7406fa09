"""The command: what people type, what they get wrong, and how they stop it."""

from __future__ import annotations

import dataclasses
import json
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader
from virtual_sensor import VirtualSensor

from selective_depth.app import cli
from selective_depth.app.archive.table import rows_of
from selective_depth.app.commands import run
from selective_depth.app.console import dispatch
from selective_depth.app.console.command import COMMANDS, SHELLS, parse
from selective_depth.app.console.settings_file import to_toml
from selective_depth.app.pipeline.report import save_settings
from selective_depth.app.settings import MOST_ROUNDS, GasOptions, PlayOptions, RunOptions, Settings, ViewerOptions
from selective_depth.app.viewer import sinks
from selective_depth.drivers.errors import OutputError
from selective_depth.drivers.open import open_source

pytestmark = pytest.mark.filterwarnings("ignore:RRD file has no footer")
ROOT = Path(__file__).parents[2]
QUICK = ("--seeds.rows", "24", "--seeds.columns", "32", "--gas.nodes", "60", "--headless")
ENDLESS = "virtual:ball?size=160x120&frames=1000000"


def refuse(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    """Run a command that must fail; return its code and the one line that it printed."""
    start_s = time.monotonic()
    code = cli.run(arguments)
    assert time.monotonic() - start_s < 10
    error = capsys.readouterr().err
    assert error.count("\n") == 1, error
    assert error.startswith("selective-depth: ")
    assert "Traceback" not in error
    assert code != 0
    return code, error


def start(*arguments: str, cwd: Path) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    environment.pop("DISPLAY", None)
    environment.pop("WAYLAND_DISPLAY", None)
    return subprocess.Popen(
        [sys.executable, "-m", "selective_depth.app", *arguments],
        cwd=cwd,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def depth_rows(path: Path) -> int:
    chunks = [chunk for chunk in RrdReader(str(path)).stream() if chunk.entity_path == "/camera/depth"]
    return sum(chunk.num_rows for chunk in chunks if not chunk.is_static)


# Help


def test_help_shows_examples_before_anything_else(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["--help"]) == 0
    text = capsys.readouterr().out
    assert text.index("Examples:") < text.index("Watch:")
    for name in COMMANDS:
        assert re.search(rf"^  {name} ", text, re.MULTILINE)


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_command_has_examples_that_parse(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    command = COMMANDS[name]
    with pytest.raises(SystemExit) as ended:
        cli.run([name, "--help"])
    assert ended.value.code in (0, None)
    text = capsys.readouterr().out
    assert text.index("Examples:") < text.index(" options ")
    assert "\x1b[" not in text  # no colours: this is no terminal
    assert command.examples
    for line, meaning in command.examples:
        words = line.split()
        assert words[:2] == ["selective-depth", name]
        assert meaning
        parse(command, words[2:])


def test_help_imports_nothing_heavy() -> None:
    probe = (
        "import sys; from selective_depth.app import cli; cli.run(['--help']);"
        "print([m for m in ('numpy', 'numba', 'cv2', 'rerun', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_version_names_both(capsys: pytest.CaptureFixture[str]) -> None:
    from importlib.metadata import version

    import selective_depth.app

    assert selective_depth.app.__version__ == version("selective-depth")
    assert cli.run(["--version"]) == 0
    own = re.escape(selective_depth.app.__version__)
    assert re.match(rf"selective-depth {own}\n.*OpenNI2 runtime", capsys.readouterr().out)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        selective_depth.app.nothing  # noqa: B018 - reading it is the test


@pytest.mark.parametrize("shell", SHELLS)
def test_completion_knows_the_commands(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["--completion", shell]) == 0
    script = capsys.readouterr().out
    for word in ("replay", "--gas.nodes", "--scale", "--preset", "--debug"):
        assert word in script


def test_fish_completes_commands_options_choices_and_files(tmp_path: Path) -> None:
    fish = shutil.which("fish")
    if fish is None:
        pytest.skip("no fish: apt-get install fish")
    script = subprocess.run([sys.executable, "-m", "selective_depth.app", "--completion", "fish"],
                            capture_output=True, text=True, check=True).stdout  # fmt: skip
    (tmp_path / "selective-depth.fish").write_text(script)
    (tmp_path / "walk.oni").touch()

    def completed(line: str) -> set[str]:
        source = f"source selective-depth.fish; complete --do-complete '{line}'"
        done = subprocess.run([fish, "--no-config", "-c", source], cwd=tmp_path, capture_output=True, text=True)
        assert done.stderr == ""
        return {found.partition("\t")[0] for found in done.stdout.splitlines()}

    assert completed("selective-depth rep") == {"replay"}
    assert completed("selective-depth replay --layout ") == {"engineer", "visitor"}
    assert completed("selective-depth replay --budg") == {"--budget"}
    assert completed("selective-depth replay wal") == {"walk.oni"}
    every = completed("selective-depth replay --")
    assert {"--scale", "--settings", "--gas.nodes", "--near-mm"} <= every
    assert all(found.startswith("-") for found in every), "a description's second line is no option"
    assert "--scale" not in completed("selective-depth screenshot x.rrd --")


# Wrong usage


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["repaly", "x"], "Did you mean 'replay'?"),
        (["xyz"], "There are: replay, live"),
        (["replay", "x", "--gas.nodes", "100000000"], "it must be from 1 to 100,000"),
        (["replay", "x", "--frames", "many"], "--frames is 'many'; it must be 1 or more"),
        (["replay", "x", "--gas.factor", "nan"], "--gas.factor is nan; it must be more than 0"),
        (["bench", "--frames", "0"], "--frames is 0; it must be 1 or more"),
        (["model", "x", "out", "--frame", "-1"], "--frame is -1; it must be 0 or more"),
        (["snapshot", "x", "--dpi", "0"], "--dpi is 0; it must be from 10 to 2,400"),
        (["--completion", "tcsh"], "bash, zsh and fish, not for 'tcsh'"),
        (["replay", "x", "y"], "'replay' takes one source, and 'y' is another; 'batch' takes several. "),
        (["replay", "x", "--gas.nods", "3"], "--gas.nods, 3: did you mean --gas.nodes?"),
        (["replay", "x", "--gas.nodes", "many"], "--gas.nodes"),
        (["replay", "x", "--gas.algorithm", "slow"], "'exact', 'fast'"),
        (["replay", "x", "--frames", "0"], "--frames is 0; it must be 1 or more"),
        (["replay", "x", "--threads", "0"], "--threads is 0"),
        (["replay", "x", "--budget", "2"], "--budget is 2; it must be a share between 0 and 1"),
        (["replay", "x", "--rounds", "0"], "--rounds is 0"),
        (["replay", "x", "--rounds", "255"], "--rounds is 255; it must be from 1 to 254"),
        (["replay", "x", "--gas.seed", "-1"], "--gas.seed is -1; it must be 0 or more"),
        (["snapshot", "virtual:ball", "--improvement.share", "2"], "--improvement.share is 2"),
        (["replay", "x", "--serve-memory", "much"], "--serve-memory is 'much'"),
        (["snapshot"], "no source was named"),
        (["screenshot", "x.rrd", "a.png", "--size", "1920"], "--size is '1920'; it must be WIDTHxHEIGHT"),
        (["screenshot", "x.rrd", "a.png", "--size", "1920x8"], "--size is 1920x8; it must be WIDTHxHEIGHT"),
        (["screenshot", "x.rrd", "a.png", "--time", "-1"], "--time is -1; it must be 0 or more"),
        (["screenshot", "x.rrd", "a.png", "--time", "1", "--frame", "1"], "--frame and --time both say what to show"),
        (["evaluate"], "no source was named"),
        (["evaluate", "x", "--budget"], "--budget names no share"),
        (["evaluate", "x", "--jobs", "0"], "--jobs is 0"),
        (["evaluate", "x", "--rounds", "300"], "--rounds is 300"),
        (["check", "x.oni", "--timeout", "nan"], "--timeout is nan"),
        (["record", "x.oni", "--seconds", "nan"], "--seconds is nan"),
        (["replay", "x", "--near-mm", "900", "--far-mm", "800"], "--far-mm is 800"),
        (["replay", "x", "--near-mm", "900", "--far-mm", "900"], "--far-mm is 900"),
        (["replay", "x", "--settings"], "--settings needs a file"),
        (["replay", "x", "--preset"], "--preset needs a name"),
        (["replay", "x", "--preset=pepper"], "--preset is 'pepper'; it must be paper"),
        (["check", "x.oni", "--preset", "paper"], "sets none of this command's options"),
        (["replay", "x", "--settings", "no.toml"], "'no.toml' does not exist"),
        (["record"], "OUT.oni"),
        (["record", "x.oni", "--frames", "-1"], "--frames is -1"),
    ],
)
def test_wrong_usage_is_one_line(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, line = refuse(capsys, *arguments)
    assert code == 2
    assert words in line


@pytest.mark.parametrize(
    ("text", "typed", "words", "named"),
    [
        ("[gas]\nnodse = 3\n", [], "--gas.nodse", True),
        ("frames = 0\n", [], "--frames is 0", True),
        ("budget = 0.1\n", ["--frames", "0"], "--frames is 0", False),
        ("frames = 9\n", ["--frames", "0"], "--frames is 0", False),
        ('realtime = "yes"\n', [], "--realtime is 'yes'", True),
        ("[gas]\nnodes = [1, 2]\n", [], "--gas.nodes is [1, 2]", True),
        ("[gas]\nnodes = true\n", [], "--gas.nodes is True", True),
        ("[gas]\nnodes = 1.5\n", [], "--gas.nodes is '1.5'; it must be from 1", True),
        ("[gas]\nnodes = 100000000\n", [], "--gas.nodes is 100000000; it must be from 1", True),
        ("near_mm = 2024-01-01\n", [], "--near-mm is '2024-01-01'", True),
    ],
)
def test_what_is_wrong_in_a_settings_file_is_said_to_stand_there(
    text: str, typed: list[str], words: str, named: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "s.toml"
    file.write_text(text)
    code, line = refuse(capsys, "replay", "x", *typed, "--settings", str(file))
    assert code == 2
    assert words in line
    assert (f"'{file}'" in line) == named


def test_an_empty_name_is_no_sample(capsys: pytest.CaptureFixture[str]) -> None:
    """It may be a variable of a script that was never set."""
    for command in ("replay", "bench"):
        code, line = refuse(capsys, command, "")
        assert code == 1
        assert "no name" in line


@pytest.mark.parametrize("columns", ["1", "5", "20"])
def test_help_in_hardly_any_columns(
    columns: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    with pytest.raises(SystemExit) as stop:
        cli.run(["replay", "--help"])
    assert stop.value.code == 0
    assert "SOURCE" in capsys.readouterr().out


def test_settings_survive_the_round_trip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = Settings(
        run=RunOptions(frames=7),
        play=PlayOptions(realtime=True),
        gas=GasOptions(nodes=500, algorithm="exact", factor=1.25),
        viewer=ViewerOptions(save=Path('a "b" c.rrd'), near_mm=400),
    )
    path = tmp_path / "s.toml"
    path.write_text(to_toml(settings, 'a "heading"', "of two lines"))
    assert tomllib.loads(path.read_text())["gas"]["nodes"] == settings.gas.nodes
    heard: list[Settings] = []
    monkeypatch.setattr(run, "watch", lambda source, settings: heard.append(settings) or 0)
    assert cli.run(["replay", "x", "--settings", str(path)]) == 0
    assert cli.run(["replay", "x", "--settings", str(path), "--gas.nodes", "99"]) == 0
    viewer = dataclasses.replace(settings.viewer, save=None)  # that run's results are that run's
    expected = dataclasses.replace(settings, viewer=viewer)
    assert heard[0] == expected
    gas = dataclasses.replace(settings.gas, nodes=99)
    assert heard[1] == dataclasses.replace(expected, gas=gas)


@pytest.mark.parametrize("name", ['a "b"\\c.rrd', "two\nlines \x07.rrd", "odd \udcff.rrd"])
def test_settings_are_toml_whatever_a_name_holds(name: str, tmp_path: Path) -> None:
    settings = Settings(viewer=ViewerOptions(connect=name.encode("utf-8", "replace").decode()))
    save_settings(tmp_path / "s.toml", settings, name)
    read = tomllib.loads((tmp_path / "s.toml").read_text(encoding="utf-8"))
    assert read["connect"] == settings.viewer.connect
    assert "save" not in read


def test_settings_of_an_earlier_run_never_replace_its_recording(tmp_path: Path) -> None:
    """Neither those that are written now nor those of earlier versions, which named the file."""
    kept = tmp_path / "keep.rrd"
    assert cli.run(["replay", ENDLESS, *QUICK, "--frames", "1", "--save", str(kept)]) == 0
    before, settings = kept.read_bytes(), tmp_path / "keep.toml"
    for older in ("", f"save = {str(kept)!r}\n"):
        settings.write_text(older + settings.read_text())
        scene = "virtual:workstation?size=160x120&frames=2"
        assert cli.run(["replay", scene, *QUICK, "--settings", str(settings)]) == 0
        assert kept.read_bytes() == before


@pytest.mark.skipif(sys.platform == "win32", reason="pipes with names and devices are POSIX's")
def test_settings_that_never_end_are_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for file in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        code, line = refuse(capsys, "replay", "x", "--settings", str(file))
        assert code == 2
        assert "not a regular file" in line
    (tmp_path / "large").write_bytes(bytes(1 << 20))
    assert "1 MiB or more" in refuse(capsys, "replay", "x", "--settings", str(tmp_path / "large"))[1]


# Bad input: what people really have


def test_cut_recording(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    whole = (ROOT / "recordings" / "workstation.oni").read_bytes()
    (tmp_path / "cut.oni").write_bytes(whole[:300_000])
    assert cli.run(["replay", str(tmp_path / "cut.oni"), *QUICK]) == 0
    assert "selective-depth check" in capsys.readouterr().out


@pytest.mark.openni
def test_no_sensor(capsys: pytest.CaptureFixture[str], tmp_path: Path, virtual_sensor: VirtualSensor) -> None:
    virtual_sensor.set(connected=0)
    for command in (["live"], ["record", str(tmp_path / "x.oni")]):
        _, line = refuse(capsys, *command)
        assert "no depth sensor" in line
    assert cli.run(["devices"]) == 1
    assert "no sensor found" in capsys.readouterr().out


def test_missing_path(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    _, line = refuse(capsys, "replay", str(tmp_path / "none.oni"), *QUICK)
    assert "does not exist" in line


def test_empty_folder(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    _, line = refuse(capsys, "replay", str(tmp_path), *QUICK)
    assert "PNG" in line


def test_eight_bit_png(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), np.full((480, 640), 7, np.uint8))
    _, line = refuse(capsys, "replay", str(tmp_path), *QUICK)
    assert "16" in line


def test_png_of_another_size(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for name, width in (("0.png", 160), ("1.png", 170)):
        cv2.imwrite(str(tmp_path / name), np.full((120, width), 2000, np.uint16))
    _, line = refuse(capsys, "replay", str(tmp_path), *QUICK)
    assert "170" in line


def test_text_named_oni(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "notes.oni").write_text("not a recording\n" * 100)
    refuse(capsys, "replay", str(tmp_path / "notes.oni"), *QUICK)


def test_no_runtime(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENNI2_REDIST", str(tmp_path))
    for command in (["live"], ["devices"], ["record", str(tmp_path / "x.oni")]):
        _, line = refuse(capsys, *command)
        assert "OpenNI2 runtime" in line
        assert str(tmp_path) in line


@pytest.mark.parametrize("place", ["missing/out.rrd", "folder.rrd"])
def test_unwritable_output(place: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "folder.rrd").mkdir()
    _, line = refuse(capsys, "replay", ENDLESS, *QUICK, "--save", str(tmp_path / place))
    assert "cannot be written" in line


@pytest.mark.parametrize(
    ("there", "name", "words"),
    [
        ("mine.oni", "mine.oni", "it must end in .rrd"),
        ("mine.toml", "mine.rrd", "mine.toml', which would be replaced"),
        ("mine.png", "mine.rrd", "mine.png', which would be replaced"),
        ("x", "s\udcff.rrd", "UTF-8"),
    ],
)
def test_saving_never_replaces_what_is_of_no_earlier_run(
    there: str, name: str, words: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / there).write_text("precious")
    code, line = refuse(capsys, "replay", ENDLESS, *QUICK, "--save", str(tmp_path / name))
    assert code == 2
    assert words in line
    assert [path.read_text() for path in tmp_path.iterdir()] == ["precious"]


def test_saving_replaces_an_earlier_run_when_asked_to(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["replay", ENDLESS, *QUICK, "--frames", "2", "--save", str(tmp_path / "a.rrd")]
    assert cli.run(arguments) == 0
    before = (tmp_path / "a.rrd").read_bytes()
    assert "exists already; give another name, or --overwrite" in refuse(capsys, *arguments)[1]
    assert (tmp_path / "a.rrd").read_bytes() == before
    assert cli.run([*arguments, "--overwrite"]) == 0
    assert len(list(tmp_path.iterdir())) == 3


def test_a_run_that_keeps_nothing_says_so(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    arguments = ["replay", ENDLESS, *QUICK, "--frames", "2"]
    assert cli.run(arguments) == 0
    assert "Nothing is kept of this run but the report" in capsys.readouterr().out
    assert cli.run([*arguments, "--json", str(tmp_path / "a.json")]) == 0
    assert "Nothing is kept" not in capsys.readouterr().out


def test_the_report_as_json_says_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["replay", ENDLESS, *QUICK, "--frames", "3", "--budget", "5%", "--json", str(tmp_path / "a.json")]
    assert cli.run([*arguments, "--table", str(tmp_path / "a.parquet")]) == 0
    shown = capsys.readouterr().out
    said = json.loads((tmp_path / "a.json").read_text())
    assert said["gain"] and said["gain"] in shown
    assert (said["frames"], said["schema"], said["by"]) == (3, 1, "surface score")
    assert said["settings"]["acquire"]["budget"] == 0.05 and "loop" in said["stages"]
    rows = list(rows_of(tmp_path / "a.parquet"))
    assert [row["frame"] for row in rows] == [0, 1, 2]
    assert rows[0]["even_rmse_mm"] == pytest.approx(said["means"]["even_rmse_mm"])


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("replay", ENDLESS, "--rounds", "4"), "--rounds is 4, but nothing is spent in them; give a --budget"),
        (("replay", ENDLESS, "--table", "a.csv"), "--table is 'a.csv'; it must end in .parquet"),
        (("live", "--loop"), "'live' does not take --loop"),
        (("replay", ENDLESS, "--speed", "0"), "--speed is 0; it must be more than 0"),
    ],
)
def test_what_would_do_nothing_is_refused(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], why: str
) -> None:
    code, said = refuse(capsys, *arguments)
    assert code == 2 and why in said


def test_settings_of_a_replay_are_those_of_a_sensor_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "s.toml"
    path.write_text(to_toml(Settings(gas=GasOptions(nodes=500))))
    heard: list[Settings] = []
    monkeypatch.setattr(run, "watch", lambda source, settings: heard.append(settings) or 0)
    assert cli.run(["live", "--settings", str(path)]) == 0
    assert heard[0].gas.nodes == 500


def test_a_save_that_fails_at_its_end_is_a_failed_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(sink: sinks.FileSink, item: object) -> None:
        raise OutputError("the disk went away")

    monkeypatch.setattr(sinks.FileSink, "put", fail)
    out = tmp_path / "a.rrd"
    assert cli.run(["replay", ENDLESS, *QUICK, "--frames", "1", "--save", str(out)]) == 1
    shown = capsys.readouterr().out
    assert "the disk went away" in shown
    assert "1  frames" in next(line for line in shown.splitlines() if "not shown in" in line)


def test_a_picture_of_nothing_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    picture = str(tmp_path / "a.png")
    assert "No such file" in refuse(capsys, "screenshot", str(tmp_path / "no.rrd"), picture)[1]
    (tmp_path / "a.rrd").write_text("no recording")
    assert "not a Rerun recording" in refuse(capsys, "screenshot", str(tmp_path / "a.rrd"), picture)[1]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="children are read from /proc")
def test_an_interrupted_evaluation_leaves_no_process(tmp_path: Path) -> None:
    process = start("evaluate", "virtual:ball?frames=30", "--every", "1", cwd=tmp_path)
    workers = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    deadline_s = time.monotonic() + 30
    while len(children := workers.read_text().split()) < 2:  # a worker, and Python's tracker
        assert time.monotonic() < deadline_s
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=5)  # whoever holds the pipes would make it wait
    assert process.returncode == 130
    assert "selective-depth: interrupted." in errors.splitlines()
    assert "Traceback" not in errors
    while any(Path(f"/proc/{child}").exists() for child in children):
        assert time.monotonic() < deadline_s
        time.sleep(0.05)


INTERRUPTED_STARTING = """
import os, signal, sys, time
from multiprocessing import util
from selective_depth.app.__main__ import main

start = util.spawnv_passfds

def interrupted(path, arguments, handles):
    number = start(path, arguments, handles)
    if "--multiprocessing-fork" in arguments:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1.0)
    return number

util.spawnv_passfds = interrupted
main()
"""


def test_a_worker_that_is_just_being_started_ends_without_a_word(tmp_path: Path) -> None:
    arguments = ["evaluate", "virtual:ball?frames=30", "--every", "1"]
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED_STARTING, *arguments],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=30,
    )
    assert done.returncode == 130
    assert [line for line in done.stderr.splitlines() if "frames" not in line] == ["selective-depth: interrupted."]


def test_interrupted_before_it_has_read_its_command_line() -> None:
    program = (
        "import os, signal, sys; from selective_depth.app.__main__ import main;"
        "find = type('', (), {'find_spec': staticmethod(lambda name, *_:"
        " os.kill(os.getpid(), signal.SIGINT) if name == 'tyro' else None)});"
        "sys.meta_path.insert(0, find); main()"
    )
    done = subprocess.run([sys.executable, "-c", program, "devices"], capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stderr) == (130, "selective-depth: interrupted.\n")


@pytest.mark.skipif(sys.platform == "win32", reason="no file size limit on Windows")
def test_output_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    """Beyond the limit every write fails, as on a full disk."""
    program = (
        "import resource, signal; resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0));"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "from selective_depth.app.__main__ import main; main()"
    )
    with (tmp_path / "out.txt").open("w") as out:
        done = subprocess.run(
            [sys.executable, "-B", "-c", program, "--help"],
            stdout=out,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONUNBUFFERED": ""},
        )
    assert done.returncode == 1
    assert done.stderr == "selective-depth: the output cannot be written: File too large.\n"


def test_nobody_at_the_viewers_address(capsys: pytest.CaptureFixture[str]) -> None:
    _, line = refuse(capsys, "replay", ENDLESS, *QUICK, "--connect", "rerun+http://127.0.0.1:9/proxy")
    assert "no viewer listens" in line


def test_selector_options_out_of_range(capsys: pytest.CaptureFixture[str]) -> None:
    _, line = refuse(capsys, "replay", ENDLESS, *QUICK, "--gas.nodes", "-5")
    assert "-5" in line


def test_unexpected_error_asks_for_debug(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> int:
        raise KeyError("surprise")

    monkeypatch.setattr(dispatch.command, "parse_with_settings", fail)
    code, line = refuse(capsys, "replay", "x")
    assert code == 1
    assert "KeyError" in line
    assert "--debug" in line
    with pytest.raises(KeyError):
        cli.run(["replay", "x", "--debug"])


# Whole runs


def test_replay_ends_with_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    scene = ENDLESS.replace("1000000", "4")
    assert cli.run(["replay", scene, *QUICK, "--budget", "0.05"]) == 0
    table = capsys.readouterr().out
    for words in ("frames", "frames/s", "per frame", "mm", "p50", "neural_gas", "model RMSE"):
        assert words in table
    assert "\x1b[" not in table


def test_real_sequence_is_saved_whole(shared_data: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    folder = shared_data / "sequence"
    assert cli.run(["replay", str(folder), "--headless", "--frames", "12", "--save", str(out)]) == 0
    pictures = sorted(folder.glob("*.png"))[:12]
    found = {}
    for chunk in RrdReader(str(out)).stream():
        if chunk.entity_path == "/camera/depth" and not chunk.is_static:
            batch = chunk.to_record_batch()
            frames = batch.column("frame").to_pylist()
            buffers = batch.column("DepthImage:buffer")
            for frame, buffer in zip(frames, buffers, strict=True):
                found[frame] = np.asarray(buffer.values.flatten()).view(np.uint16)
    assert sorted(found) == list(range(12))
    for frame, picture in enumerate(pictures):
        depth_mm = cv2.imread(str(picture), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(found[frame].reshape(depth_mm.shape), depth_mm)


def test_brackets_in_names_are_told_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "a[red]b"
    folder.mkdir()
    assert cli.run(["export", "virtual:ball?size=160x120", str(folder / "frames"), "--frames", "2"]) == 0
    table = tmp_path / "[bold].parquet"
    assert cli.run(["replay", str(folder / "frames"), *QUICK, "--table", str(table)]) == 0
    told = capsys.readouterr().out
    assert str(folder) in told and f"wrote {table}" in told


def interrupt(out: Path, arguments: list[str], after_s: float | None, number: int = signal.SIGINT) -> tuple[str, str]:
    """Stop an endless command after a time, or once it has saved something; return its output."""
    process = start(*arguments, cwd=out.parent)
    deadline_s = time.monotonic() + (120 if after_s is None else after_s)
    while time.monotonic() < deadline_s and process.poll() is None:
        if after_s is None and out.exists() and out.stat().st_size > 300_000:
            break
        time.sleep(0.05)
    assert process.poll() is None, process.communicate()
    start_s = time.monotonic()
    process.send_signal(number)
    output, errors = process.communicate(timeout=30)
    took_s = time.monotonic() - start_s
    assert process.returncode == 130, errors
    assert took_s < 3
    assert "Traceback" not in errors
    return output, errors


@pytest.mark.parametrize(
    "name", ["SIGINT", "SIGTERM", pytest.param("SIGHUP", marks=pytest.mark.skipif(
        sys.platform == "win32", reason="Windows has no SIGHUP"))]
)  # fmt: skip
def test_interrupted_run_ends_soon_and_keeps_its_file(tmp_path: Path, name: str) -> None:
    out = tmp_path / "out.rrd"
    arguments = ["replay", ENDLESS, *QUICK, "--save", str(out)]
    output, _ = interrupt(out, arguments, None, getattr(signal, name))
    assert "whole loop" in output
    assert depth_rows(out) > 0
    assert {path.suffix for path in tmp_path.iterdir()} == {".rrd", ".toml", ".png"}


def test_served_replay_stays_for_viewers_on_this_machine_only(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    scene = ENDLESS.replace("1000000", "3")
    address = f"127.0.0.1:{port}"
    process = start("replay", scene, *QUICK, "--serve", "--serve-address", address, cwd=tmp_path)
    assert process.stdout is not None
    said = [process.stdout.readline() for _ in range(2)]
    assert f"rerun+http://{address}/proxy" in said[0]
    assert "Ctrl-C ends" in said[1]
    socket.create_connection(("127.0.0.1", port), 5).close()
    for _, _, _, _, elsewhere in socket.getaddrinfo(socket.gethostname(), port, socket.AF_INET):
        if elsewhere[0].startswith("127."):
            continue
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(elsewhere, 1)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=10)
    assert process.returncode == 130, errors
    assert "whole loop" in output


@pytest.mark.openni
def test_live_sensor_from_the_command_line(
    virtual_sensor: VirtualSensor, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "live.rrd"
    assert cli.run(["devices"]) == 0
    assert "irtual" in capsys.readouterr().out
    assert cli.run(["live", *QUICK, "--frames", "15", "--save", str(out)]) == 0
    table = capsys.readouterr().out
    assert "skipped to keep up" in table
    assert "live" in table
    assert depth_rows(out) == 15
    recording = tmp_path / "Aufnahme groß.oni"
    assert cli.run(["record", str(recording), "--frames", "10"]) == 0
    written = re.search(r"(\d+) frames", capsys.readouterr().out)
    assert written is not None
    assert int(written[1]) >= 10
    assert cli.run(["replay", str(recording), *QUICK]) == 0


def test_a_recording_is_not_replaced_unasked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "b.oni"
    out.write_bytes(b"what was there")
    arguments = ["replay", ENDLESS, *QUICK, "--frames", "3", "--record", str(out)]
    assert cli.run(arguments) == 1
    assert "exists already. Give another name, or --overwrite" in capsys.readouterr().err
    assert out.read_bytes() == b"what was there"
    assert cli.run([*arguments, "--overwrite"]) == 0
    with open_source(out) as recorded:
        assert len(list(recorded)) == 3


def test_a_replay_is_recorded_from_its_first_frame_to_its_last(tmp_path: Path) -> None:
    out = tmp_path / "b.oni"
    assert cli.run(["replay", ENDLESS, *QUICK, "--frames", "7", "--start", "3", "--record", str(out)]) == 0
    with open_source(out) as recorded, open_source(ENDLESS) as made:
        made.skip(3)
        for frame in recorded:
            np.testing.assert_array_equal(frame.depth_mm, made.read().depth_mm)
        assert frame.index == 6


@pytest.mark.openni
def test_a_live_run_records_every_frame_of_the_sensor_bit_by_bit(
    virtual_driver: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those that the run skipped too: the numbers in the frames' corners leave none out."""
    seen_mm = np.random.default_rng(1).integers(500, 4000, (97, 120, 160), dtype=np.uint16)
    seen_mm[:, 0, 0] = 1000 + np.arange(97)
    for name, value in VirtualSensor(tmp_path / "sensor", seen_mm).env.items():
        monkeypatch.setenv(name, value)
    walk = tmp_path / "walk.oni"
    arguments = ["live", *QUICK, "--budget", "5%", "--frames", "60", "--record", str(walk)]
    assert cli.run([*arguments, "--save", str(tmp_path / "walk.rrd")]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"walk\.oni \(\d+ frames, [\d.,]+ MB, [\d,]+ MB a minute\)", shown), shown
    assert re.search(r"walk\.rrd \([\d.,]+ MB, [\d,]+ MB a minute\)", shown), shown
    with open_source(walk) as source:
        frames = list(source)
    assert len(frames) >= 60
    numbers = [int(frame.depth_mm[0, 0]) - 1000 for frame in frames]
    assert [number % 97 for number in range(numbers[0], numbers[0] + len(numbers))] == numbers
    for number, frame in zip(numbers, frames, strict=True):
        np.testing.assert_array_equal(frame.depth_mm, seen_mm[number])


@pytest.mark.slow
@pytest.mark.openni
@pytest.mark.parametrize("seed", range(50))
def test_interrupted_at_any_moment(tmp_path: Path, seed: int, virtual_sensor: VirtualSensor) -> None:
    out = tmp_path / ("out.oni" if seed % 3 == 2 else "out.rrd")
    arguments = (
        ["replay", ENDLESS, *QUICK, "--save", str(out)],
        ["live", *QUICK, "--save", str(out)],
        ["record", str(out)],
    )[seed % 3]
    interrupt(out, arguments, random.Random(seed).uniform(0.7, 6))
    if not out.exists() or not out.stat().st_size:
        return  # interrupted before there was anything to save
    if out.suffix == ".rrd":
        depth_rows(out)
    else:
        assert cli.run(["check", str(out)]) == 0


@pytest.mark.skipif(sys.platform == "win32", reason="no file size limit on Windows")
def test_file_that_stops_growing_is_noticed_and_kept_readable(tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    limited = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, -1));"
        "from selective_depth.app.cli import run; sys.exit(run(sys.argv[1:]))"
    )
    scene = ENDLESS + "&live=1"
    done = subprocess.run(
        [sys.executable, "-c", limited, "replay", scene, *QUICK, "--save", str(out)],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 1, done.stderr
    assert "which are kept" in done.stderr
    assert "Traceback" not in done.stderr
    assert 0 < depth_rows(out) < 1000


@pytest.mark.openni
def test_unplugged_sensor_is_told_and_taken_up_again(
    virtual_sensor: VirtualSensor, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "live.rrd"
    pull = threading.Timer(2.5, lambda: virtual_sensor.set(connected=0))
    plug = threading.Timer(3.5, lambda: virtual_sensor.set(connected=1))
    for timer in (pull, plug):
        timer.start()
    assert cli.run(["live", *QUICK, "--frames", "120", "--save", str(out)]) == 0
    pull.join()
    plug.join()
    errors = capsys.readouterr().err
    assert errors.index("sensor lost") < errors.index("sensor live")
    assert depth_rows(out) == 120
    states = [
        value
        for chunk in RrdReader(str(out)).stream()
        if chunk.entity_path == "/sensor/state" and not chunk.is_static
        for row in chunk.to_record_batch().column("StateChange:state").to_pylist()
        for value in row
    ]
    assert states[0] == states[-1] == "live"
    assert "lost" in states


def test_rounds_on_the_command_line_are_the_selectors_own() -> None:
    from selective_depth.selectors import acquire

    assert MOST_ROUNDS == acquire.MOST_ROUNDS


def test_defaults_on_the_command_line_are_the_selectors_own() -> None:
    import inspect

    from selective_depth.app.settings import GasOptions, ImprovementOptions
    from selective_depth.selectors.improvement import ImprovementSelector
    from selective_depth.selectors.neural_gas import NeuralGasSelector

    for options, selector in ((GasOptions(), NeuralGasSelector), (ImprovementOptions(), ImprovementSelector)):
        for name, parameter in inspect.signature(selector).parameters.items():
            if name not in ("threads", "by_sums"):  # by_sums is the option `formula`
                assert getattr(options, name) == parameter.default, name
