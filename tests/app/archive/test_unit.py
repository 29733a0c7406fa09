"""Units of work in this process: ranges and their joining, resuming, what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from archives import TIMES, halve, tables, write

from selective_depth.app.archive import Job, unit
from selective_depth.app.archive.batch import recordings
from selective_depth.app.archive.table import COLUMNS, SCHEMA, SUMMARY, rows_of
from selective_depth.app.archive.unit import Cut, Recording, do_range, do_recording, join
from selective_depth.app.commands.batch import Keeping
from selective_depth.app.console.errors import AppError, UsageError
from selective_depth.app.console.tables import metadata_of, write_table
from selective_depth.app.settings import AcquireOptions, GasOptions, RunOptions, SeedOptions, Settings
from selective_depth.drivers.errors import OutputError

SETTINGS = Settings(
    seeds=SeedOptions(24, 32),
    gas=GasOptions(nodes=200, training="cold"),
    acquire=AcquireOptions(budget=0.05),
    run=RunOptions(threads=1),
)


def job_at(out: Path, **changes: Any) -> Job:
    return replace(Job(out, SETTINGS, Keeping()), **changes)


def plain(row: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in row.items() if not TIMES.search(name)}


@pytest.mark.parametrize("name", ["whole.oni", "whole", "torn", "cut.oni"])
def test_ranges_make_the_table_of_the_whole(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / name
    write(path, "workstation", 13, 3)
    if name == "torn":
        halve(path / "000009.png")
    elif name == "cut.oni":
        halve(path)
    recording = Recording(str(path), name)
    whole = do_recording(job_at(tmp_path / "a"), recording)
    assert isinstance(whole, dict)
    monkeypatch.setattr(unit, "RANGE_FRAMES", 2)
    monkeypatch.setattr(unit, "MOST_RANGES", 3)
    job = job_at(tmp_path / "b")
    cut = do_recording(job, recording)
    assert isinstance(cut, Cut) and len(cut.starts) > 1
    spans = [cut.span(at) for at in range(len(cut.starts))]
    assert [index for span in spans for index in span] == list(range(cut.stop))
    ranges = {at: do_range(job, recording, cut, at) for at in reversed(range(len(spans)))}
    assert do_range(job, recording, cut, 0) == ranges[0]  # done before
    joined = join(job, recording, cut, [ranges[at] for at in range(len(spans))])
    assert plain(joined) == plain(whole)
    assert whole["frames"] == {"whole.oni": 13, "whole": 13, "torn": 9}.get(name, whole["frames"])
    one, other = tables(tmp_path / "a"), tables(tmp_path / "b")
    assert one.keys() == other.keys() == {f"{name}.parquet"}
    assert one[f"{name}.parquet"].equals(other[f"{name}.parquet"])


def test_range_that_could_not_be_done_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unit, "RANGE_FRAMES", 3)
    recording, job = Recording("virtual:ball?frames=9&size=64x48", "ball"), job_at(tmp_path)
    cut = do_recording(job, recording)
    assert isinstance(cut, Cut)
    ranges = [do_range(job, recording, cut, at) for at in range(3)]
    lost = {"frames": 0, "failure": "its worker ended", "work_s": 0.0, "unfinished": True}
    row = join(job, recording, cut, [ranges[0], lost, ranges[2]])
    assert (row["state"], row["frames"], row["failure"]) == ("damaged", 3, "its worker ended")
    assert isinstance(do_recording(job, recording), Cut)
    assert [do_range(job, recording, cut, at) for at in range(3)] == ranges  # which are there still
    assert join(job, recording, cut, ranges)["state"] == "whole"
    done = do_recording(job, recording)
    assert isinstance(done, dict) and done["done_before"]


@pytest.mark.parametrize(
    "changes", [{"gas": GasOptions(nodes=200)}, {"acquire": AcquireOptions(budget=0.05, memory="still")}]
)
def test_what_is_carried_keeps_a_recording_in_one_piece(changes: dict[str, Any], tmp_path: Path) -> None:
    assert job_at(tmp_path, settings=replace(SETTINGS, **changes)).in_one_piece
    assert not job_at(tmp_path).in_one_piece
    assert job_at(tmp_path, keeper=Keeping(models=True)).in_one_piece


def test_what_changed_is_done_again(tmp_path: Path) -> None:
    path, out = tmp_path / "a.oni", tmp_path / "out"
    write(path, "ball", 3, 1)
    recording = Recording(str(path), "a.oni")

    def done_before(**changes: Any) -> bool:
        row = do_recording(job_at(out, **changes), recording)
        assert isinstance(row, dict) and row["frames"] > 0
        return bool(row.get("done_before"))

    assert not done_before()
    assert done_before()
    assert not done_before(force=True)
    assert done_before(settings=replace(SETTINGS, run=RunOptions(threads=2)))  # the same comes of it
    assert not done_before(settings=replace(SETTINGS, gas=GasOptions(nodes=100, training="cold")))
    assert not done_before()
    assert not done_before(keeper=Keeping(stills=1))
    assert not done_before()
    path.unlink()
    write(path, "ball", 4, 1)
    assert not done_before()
    moved = path.rename(tmp_path / "b.oni")
    row = do_recording(job_at(out), Recording(str(moved), "a.oni"))
    assert isinstance(row, dict) and row["done_before"] and row["source"] == str(moved)


def test_own_selector_that_changed(tmp_path: Path) -> None:
    own = tmp_path / "own.py"
    own.write_text("import numpy as np\ndef worth(samples):\n    return np.ones(samples.frame_shape, np.float32)\n")
    recording = Recording("virtual:ball?frames=2&size=64x48", "ball")
    job = job_at(tmp_path / "out", settings=replace(SETTINGS, acquire=AcquireOptions(budget=0.05, by=f"{own}:worth")))
    states = [do_recording(job, recording), do_recording(job, recording)]
    own.write_text(own.read_text() + "# otherwise\n")
    states.append(do_recording(job, recording))
    assert [bool(row.get("done_before")) for row in states if isinstance(row, dict)] == [False, True, False]


def test_table_says_what_it_is(tmp_path: Path) -> None:
    row = do_recording(job_at(tmp_path), Recording("virtual:ball?frames=11&size=64x48", "ball"))
    assert isinstance(row, dict) and list(row) == list(SUMMARY)
    table = pq.read_table(tmp_path / "ball.parquet")
    assert table.column_names == list(COLUMNS)
    said = metadata_of(tmp_path / "ball.parquet")
    assert said is not None
    assert said["schema"] == str(SCHEMA)
    assert json.loads(said["settings"])["gas"]["nodes"] == 200
    assert json.loads(said["summary"]) == row
    assert all(field.metadata[b"about"] for field in table.schema)
    assert table["frame"].to_pylist() == list(range(11))
    assert [value is not None for value in table["even_rmse_mm"].to_pylist()] == [n % 10 == 0 for n in range(11)]
    assert table["known_percent"].null_count == 11
    measured = table["measured_percent"].to_pylist()
    shots = table["shots"].to_pylist()
    assert [round(64 * 48 * share / 100) for share in measured] == [24 * 32 + shot for shot in shots]
    assert max(shots) == 154 == round(64 * 48 * 0.05)


def test_newer_or_foreign_table_is_left_alone(tmp_path: Path) -> None:
    recording = Recording("virtual:ball?frames=1&size=64x48", "ball")
    path = tmp_path / "ball.parquet"
    do_recording(job_at(tmp_path), recording)
    said = metadata_of(path) or {}
    newer = {"key": said["key"], "summary": said["summary"]}
    write_table(path, pq.read_table(path).replace_schema_metadata(newer), SCHEMA + 1)
    with pytest.raises(OutputError, match=f"has schema {SCHEMA + 1}.*reads {SCHEMA} and older. Update"):
        do_recording(job_at(tmp_path), recording)
    path.write_bytes(b"mine")
    with pytest.raises(OutputError, match="not a table that batch wrote"):
        do_recording(job_at(tmp_path), recording)
    assert path.read_bytes() == b"mine"
    do_recording(job_at(tmp_path, force=True), recording)
    assert len(list(rows_of(path))) == 1


def test_failures_are_sentences(tmp_path: Path) -> None:
    def failure(source: str, job: Job) -> str:
        row = do_recording(job, Recording(source, "x"))
        assert isinstance(row, dict) and (row["state"], row["frames"]) == ("failed", 0)
        assert not (tmp_path / "x.parquet").exists()
        return str(row["failure"])

    write(tmp_path / "a.oni", "ball", 2, 1)
    do_recording(job_at(tmp_path), Recording(str(tmp_path / "a.oni"), "x"))
    assert (tmp_path / "x.parquet").exists()
    assert "never ends" in failure("virtual:ball?live=1", job_at(tmp_path))  # nor stays an older table
    assert "does not exist" in failure(str(tmp_path / "b.oni"), job_at(tmp_path))
    (tmp_path / "empty.oni").touch()
    assert "empty.oni" in failure(str(tmp_path / "empty.oni"), job_at(tmp_path))
    many = replace(SETTINGS, seeds=SeedOptions(4000, 4000))
    assert "4000" in failure("virtual:ball?size=64x48", job_at(tmp_path, settings=many))
    with pytest.raises(AppError, match="a worker has version"):
        do_recording(job_at(tmp_path, version="0.0.1"), Recording("virtual:ball", "x"))


def test_names_of_recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("one/walk.oni", "two/walk.oni", "two/inner/scan", "two/out/old"):
        write(tmp_path / name, "ball", 1, 1)
    monkeypatch.chdir(tmp_path)
    found = list(recordings(["two", "one/walk.oni", "*/walk.oni", "virtual:ball?frames=1"], Path("two/out")))
    names = [each.name for each in found]
    assert names[:3] == ["two/walk.oni", "two/inner/scan", "walk.oni"]
    assert names[3].startswith("walk.oni-") and len(names[3]) == 17  # another of that name
    assert names[4:] == ["virtual_ball_frames=1"]
    assert [each.source for each in found[:3]] == [
        str(tmp_path / "two/walk.oni"), str(tmp_path / "two/inner/scan"), str(tmp_path / "one/walk.oni"),
    ]  # fmt: skip
    assert found[3].source == str(tmp_path / "two/walk.oni")
    assert [each.name for each in recordings(["two?scale=500"], Path("two/out"))] == ["two/walk.oni", "two/inner/scan"]
    assert next(iter(recordings(["two?scale=500"]))).source.endswith("walk.oni?scale=500")
    with pytest.raises(UsageError, match="nothing matches"):
        list(recordings(["*.bag"]))
