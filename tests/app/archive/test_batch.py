"""The command `batch`, as processes: sixty recordings, and what can come between."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from archives import QUICK, START, Archive, Done, batch, children, finish, kill, same, start, tables, wait_for, write

from selective_depth.app import cli
from selective_depth.app.archive import Batch, Job
from selective_depth.app.commands.batch import Keeping
from selective_depth.app.commands.session import Session
from selective_depth.app.console.errors import UsageError
from selective_depth.app.pipeline import figures_of
from selective_depth.app.settings import AcquireOptions, GasOptions, SeedOptions, Settings, ViewerOptions

SETTINGS = Settings(
    seeds=SeedOptions(24, 32),
    gas=GasOptions(nodes=200),
    acquire=AcquireOptions(budget=0.05),
    viewer=ViewerOptions(headless=True),
)


def summary(out: Path) -> dict[str, dict[str, object]]:
    return {row["recording"]: row for row in pq.read_table(out / "summary.parquet").to_pylist()}


def made(out: Path) -> int:
    """How many tables are there under their names."""
    return sum(1 for _ in out.rglob("*.parquet")) if out.exists() else 0


def test_sixty_recordings(archive: Archive, undisturbed: tuple[Path, Done]) -> None:
    out, done = undisturbed
    assert done.code == 1, done.err
    rows = summary(out)
    assert len(rows) == 60
    assert {name: row["frames"] for name, row in rows.items() if row["state"] == "whole"} == archive.frames
    failures = {name: row for name, row in rows.items() if row["state"] != "whole"}
    assert {name: (row["state"], row["frames"]) for name, row in failures.items()} == {
        "lab/day1/cut.oni": ("damaged", failures["lab/day1/cut.oni"]["frames"]),
        "lab/day2/torn": ("damaged", 4),
        "lab/day3/nothing": ("failed", 0),
    }
    assert 0 < failures["lab/day1/cut.oni"]["frames"] < 6
    assert "the file ends inside" in failures["lab/day1/cut.oni"]["failure"]
    assert "000004.png" in failures["lab/day2/torn"]["failure"]
    assert "no depth frames" in failures["lab/day3/nothing"]["failure"]
    for row in failures.values():
        assert f"{row['recording']}: {row['failure']}" in done.out
    assert "60 recordings (3 not whole)" in done.out
    assert [name for name, row in rows.items() if row["colour"]] == ["lab/day0/ball-0"]
    for name, row in rows.items():
        path = out / f"{name}.parquet"
        assert path.exists() == bool(row["frames"])
        if path.exists():
            assert pq.read_metadata(path).num_rows == row["frames"]
    assert not [path for path in out.rglob("*") if path.name.startswith(".")]


@pytest.mark.parametrize("name", ["day0/ball-0", "day1/workstation-1.oni", "day1/cut.oni", "day2/torn"])
def test_figures_are_those_of_replay(archive: Archive, undisturbed: tuple[Path, Done], name: str) -> None:
    session = Session(str(archive.path / name), SETTINGS)
    session.run()
    report, row = session.report, summary(undisturbed[0])[f"lab/{name}"]
    assert row["frames"] == report.frames
    for figure in ("samples", "quantisation_error_mm", "rmse_mm", "even_rmse_mm", "measured_percent"):
        assert row[figure] == report.means[figure].value, figure
    assert session.last is not None
    last = pq.read_table(undisturbed[0] / f"lab/{name}.parquet").to_pylist()[-1]
    for figure, value in figures_of(session.last).items():
        assert last[figure] == value or (last[figure] is None and value != value), figure


@pytest.mark.slow
def test_again_nothing_is_done(archive: Archive, undisturbed: tuple[Path, Done]) -> None:
    out, _ = undisturbed
    before, times = tables(out), {path: path.stat().st_mtime_ns for path in out.rglob("lab/**/*.parquet")}
    done = batch(archive.path, "--out", out, *QUICK)
    assert done.code == 1
    assert "59 of them done before" in done.out and "; 0 frames in" in done.out
    assert {path: path.stat().st_mtime_ns for path in times} == times
    same(tables(out), before)


def test_killed_client(archive: Archive, undisturbed: tuple[Path, Done], tmp_path: Path) -> None:
    _killed_at_times(archive, undisturbed[0], tmp_path, [25])


@pytest.mark.slow
def test_killed_client_at_five_random_times(archive: Archive, undisturbed: tuple[Path, Done], tmp_path: Path) -> None:
    draw = random.Random(5)
    _killed_at_times(archive, undisturbed[0], tmp_path, sorted(draw.randrange(0, 55) for _ in range(5)))


def _killed_at_times(archive: Archive, expected: Path, out: Path, counts: list[int]) -> None:
    for count in counts:
        process = start(archive.path, "--out", out, *QUICK)
        wait_for(lambda count=count: made(out) > count)
        kill(process)
        for path in out.rglob("*.parquet"):  # whole under its name
            assert pq.read_table(path).num_rows
        assert not (out / "summary.parquet").exists()
    assert batch(archive.path, "--out", out, *QUICK).code == 1
    same(tables(out), tables(expected))
    assert not list(out.rglob(".*"))


@pytest.mark.slow
def test_killed_worker(archive: Archive, undisturbed: tuple[Path, Done], tmp_path: Path) -> None:
    process = start(archive.path, "--out", tmp_path, *QUICK)
    wait_for(lambda: made(tmp_path) > 10)
    with pytest.raises(UsageError, match="another run writes to"):
        Batch(Job(tmp_path, SETTINGS, Keeping()), []).run(None)
    assert len(children(process.pid)) == len(os.sched_getaffinity(0))
    os.kill(max(children(process.pid)), signal.SIGKILL)
    done = finish(process)
    assert done.code == 1
    assert "60 recordings (3 not whole" in done.out
    same(tables(tmp_path), tables(undisturbed[0]))


def test_ctrl_c(archive: Archive, tmp_path: Path) -> None:
    process = start(archive.path, "--out", tmp_path, *QUICK)
    wait_for(lambda: made(tmp_path) > 5)
    workers, asked_s = children(process.pid), time.monotonic()
    os.killpg(process.pid, signal.SIGINT)
    done = finish(process)
    assert time.monotonic() - asked_s < 3
    assert done.code == 130
    assert done.err.endswith("selective-depth: interrupted.\n") and "Traceback" not in done.err
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers), 10)
    assert all(pq.read_table(path).num_rows for path in tmp_path.rglob("*.parquet"))


def test_full_disk(archive: Archive, small_disk: Path) -> None:
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(800_000))
    done = batch(archive.path, "--out", small_disk / "out", *QUICK)
    last = done.err.strip().splitlines()[-1]
    assert done.code == 1
    assert last.startswith("selective-depth: '") and "cannot be written: No space left on device. Make room" in last
    assert "Traceback" not in done.err
    found = list((small_disk / "out").rglob("*.parquet"))
    assert found and all(pq.read_table(path).num_rows for path in found)
    assert not (small_disk / "out" / "summary.parquet").exists()
    ballast.unlink()  # what a worker was writing when all ended is swept by the next run
    batch(archive.path, "--out", small_disk / "out", *QUICK)
    assert not list((small_disk / "out").rglob(".*.part"))


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Path]:
    """The file of a scheduler that has two workers, each a process of its own."""
    file, quiet = tmp_path / "scheduler.json", {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    dask = [sys.executable, "-m", "dask"]
    on = ["--scheduler-file", str(file)]
    local = ["--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0"]
    alone = ["--nthreads", "1", "--no-dashboard", "--local-directory", str(tmp_path / "scratch")]
    started = [subprocess.Popen([*dask, "scheduler", *on, *local], **quiet)]
    try:
        wait_for(lambda: file.exists() and file.read_text().endswith("}"))
        started += [subprocess.Popen([*dask, "worker", *on, *alone], **quiet) for _ in range(2)]
        yield file
    finally:
        for process in started:
            process.terminate()
        for process in started:
            process.wait(30)


def test_scheduler_and_workers_of_their_own(
    archive: Archive, undisturbed: tuple[Path, Done], cluster: Path, tmp_path: Path
) -> None:
    address = json.loads(cluster.read_text())["address"]
    assert batch(archive.path, "--out", tmp_path / "out", *QUICK, "--scheduler", address).code == 1
    same(tables(tmp_path / "out"), tables(undisturbed[0]))


@pytest.mark.slow
def test_evaluate_on_a_cluster(cluster: Path, tmp_path: Path) -> None:
    compared = ("evaluate", "virtual:ball?frames=4&size=64x48", "--every", "2", *QUICK, "--json")
    for name, where in (("local", ("--jobs", "1")), ("spread", ("--scheduler", str(cluster)))):
        subprocess.run([*START, *compared, str(tmp_path / name), *where], check=True, stdout=subprocess.DEVNULL)
    local, spread = (json.loads((tmp_path / name).read_text()) for name in ("local", "spread"))
    assert local.pop("settings") != spread.pop("settings")
    assert local == spread


@pytest.mark.slow
def test_ranges_on_the_engine(tmp_path: Path) -> None:
    """A long recording in ranges, its client killed among them, is that of one piece."""
    scene, cold = "virtual:ball?frames=1300&size=64x48", ("--gas.training", "cold", *QUICK)
    assert batch(scene, "--out", tmp_path / "one", "--models", *cold).code == 0
    process = start(scene, "--out", tmp_path / "out", *cold)
    wait_for(lambda: made(tmp_path / "out") > 0)
    kill(process)
    parts = list(tmp_path.glob("out/.batch/*/*.parquet"))
    assert 0 < len(parts) < 4
    assert batch(scene, "--out", tmp_path / "out", *cold).code == 0
    same(tables(tmp_path / "out"), tables(tmp_path / "one"))


def test_scheduler_that_is_not_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(
        import_module("selective_depth.app.archive.engine")._QUIET, "distributed.comm.timeouts.connect", "0.5s"
    )
    assert cli.run(["batch", "virtual:ball", "--out", str(tmp_path), "--scheduler", "tcp://127.0.0.1:9"]) == 1
    assert "no scheduler answers at 'tcp://127.0.0.1:9'" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.slow
def test_list_on_stdin_and_what_is_kept(tmp_path: Path) -> None:
    write(tmp_path / "a b.oni", "ball", 4, 1)
    scene = "virtual:ball?frames=3&size=64x48"
    what = ("--models", "--rrd", "--stills", "1", "--keep", "masks", "maps", "depth")
    done = batch("-", "--out", tmp_path / "out", *QUICK, *what, stdin=f"{tmp_path / 'a b.oni'}\n\n{scene}\n")
    assert done.code == 0, done.err
    for name, frames in (("a b.oni", 4), ("virtual_ball_frames=3_size=64x48", 3)):
        kept = tmp_path / "out" / f"{name}.kept"
        for kind in ("masks", "maps", "depth"):
            assert [path.name for path in sorted((kept / kind).iterdir())] == [f"{n:06}.png" for n in range(frames)]
        assert [path.name for path in (kept / "stills").iterdir()] == ["000000.png"]
        assert sorted(path.name for path in (kept / "model").iterdir()) == ["cloud.ply", "depth.png", "samples.npz"]
        assert (kept / "recording.rrd").read_bytes()[:4] == b"RRF2"
        assert sorted(path.name for path in kept.iterdir()) == [
            "depth", "maps", "masks", "model", "recording.rrd", "stills",
        ]  # fmt: skip


@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        ([], 2, "no source was named"),
        (["{}", "--out", "{}"], 2, "which holds the recordings; name another folder"),
        (["{}", "--out", "{}/out", "--models"], 2, "of what a --budget acquires"),
        (["virtual:ball", "--out", "{}/out", "--by", "guess"], 2, "--by is 'guess'"),
        (["virtual:ball", "--out", "/dev/null/x"], 1, "'/dev/null/x' cannot be written"),
        (["virtual:ball", "--out", "{}/out", "--scheduler", "near"], 2, "--scheduler is 'near'"),
        (["virtual:ball", "--out", "{}/out", "--keep", "all"], 2, "--keep"),
    ],
)
def test_misuse_is_a_sentence(
    words: list[str], code: int, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = words or ["--out", "{}/out"]
    assert cli.run(["batch", *(word.replace("{}", str(tmp_path)) for word in words)]) == code
    assert sentence in capsys.readouterr().err
