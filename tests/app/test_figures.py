"""The neural gas figures and the table: what is in them, and the commands that make them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader

from selective_depth.app import cli
from selective_depth.app.commands import figures
from selective_depth.app.pictures import palette, sheet, write_picture
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.oni import write_oni
from selective_depth.selectors.seeds import SeedGrid

OBJECT = "virtual:ball?size=160x120&noise=off&frames=3"


def ball() -> DepthFrame:
    """Half a ball before nothing."""
    rows, columns = np.indices((96, 128))
    square = (rows - 48.0) ** 2 + (columns - 64.0) ** 2
    depth = np.where(square < 40**2, 2000 - 6 * np.sqrt(np.maximum(40**2 - square, 0)), 0)
    return DepthFrame(depth.astype(np.uint16), 0, 0, Camera.kinect(128, 96))


@pytest.mark.parametrize("points", [200, 1000, 2500])
def test_as_many_seeds_as_asked_for_hit_the_object(points):
    assert len(figures.object_seeds(ball(), points).uv) == pytest.approx(points, rel=0.06)


def test_a_small_object_gives_all_the_seeds_it_has():
    frame = ball()
    seeds = figures.object_seeds(frame, 10**6)
    assert len(seeds.uv) == np.count_nonzero(frame.depth_mm)


def test_each_length_is_a_training_of_its_own():
    seeds = SeedGrid.from_frame(ball(), (40, 40))
    trained = dict(figures.epoch_selections(seeds, (1, 4), nodes=60))
    alone = dict(figures.epoch_selections(seeds, (4,), nodes=60))
    assert np.array_equal(trained[4]["3d"].nodes_mm, alone[4]["3d"].nodes_mm)
    assert trained[4]["3d"].quantisation_error_mm < trained[1]["3d"].quantisation_error_mm
    assert trained[4]["3d"].edge_metric == "3d" and trained[4]["image"].edge_metric == "image"
    assert np.array_equal(trained[4]["3d"].nodes_mm, trained[4]["image"].nodes_mm)


def test_figure_has_a_column_per_training_and_shows_its_nodes_and_regions(tmp_path: Path):
    frame = ball()
    seeds = SeedGrid.from_frame(frame, (40, 40))
    trained = list(figures.epoch_selections(seeds, (1, 3, 5), nodes=80))
    write_picture(tmp_path / "a.png", sheet(figures.epochs_figure(frame, seeds, trained), legend=False))
    picture = cv2.cvtColor(cv2.imread(str(tmp_path / "a.png")), cv2.COLOR_BGR2RGB).astype(int)
    rows = np.array_split(picture, 3)
    teal = palette.channels(palette.REGION).astype(int)
    kept = (np.abs(np.array_split(rows[1], 4, axis=1)[3] - teal).max(axis=2) < 60).sum()
    assert not trained[2][1]["3d"].mask.any() or kept > 2000
    dark = [(part.max(axis=2) < 90).sum() for part in np.array_split(rows[0], 4, axis=1)]
    assert min(dark[1:]) > 10 * dark[0]  # the object is light, what nodes are drawn on is dark
    empty = np.array_split(rows[2], 4, axis=1)[0]
    assert (empty[80:] == 255).all()  # under the object


def test_table_has_a_row_per_training_with_shares_that_add_up():
    wall = np.full((480, 640), 2000, np.uint16)
    wall[100:300, 200:400] = 1200
    frame = DepthFrame(wall, 0, 0, Camera.kinect())
    rows = list(figures.node_table([frame], nodes=(100, 200), epochs=(1,)))
    assert [(row.nodes, row.training) for row in rows] == [
        (100, "1 epochs"),
        (100, "fast"),
        (200, "1 epochs"),
        (200, "fast"),
    ]
    for row in rows:
        assert row.seconds > 0
        assert 0 < row.mask_share + row.complement_share <= 1
        assert 0 <= row.mask_error_share + row.complement_error_share <= 1 + 1e-6
    fast = rows[-1]
    assert fast.complement_error_share > 0.9  # the error is at the box's edges
    table = figures.table_markdown(rows).splitlines()
    assert len(table) == 2 + len(rows)
    assert all(line.count("|") == 9 for line in table)


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(figures, "EPOCHS", (1, 2))
    monkeypatch.setattr(figures, "FIRST_POINTS", 500)
    monkeypatch.setattr(figures, "FIRST_NODES", 100)
    monkeypatch.setattr(figures, "DENSITIES", (10, 15))
    monkeypatch.setattr(figures, "TABLE_NODES", (50,))
    monkeypatch.setattr(figures, "TABLE_EPOCHS", (1,))


def test_one_command_makes_each_figure(small, tmp_path: Path):
    for command, name in (("1", "one.png"), ("2", "two.webp")):
        assert cli.run(["figure", command, OBJECT, "--out", str(tmp_path / name)]) == 0
        picture = cv2.imread(str(tmp_path / name))
        assert picture is not None and picture.std() > 10


@pytest.mark.parametrize("number", ["1", "2", "4", "5"])
def test_each_figure_of_the_paper_has_a_command(number: str, small, tmp_path: Path):
    out = tmp_path / "figure.png"
    words = ["figure", number, "virtual:ball?size=160x120&noise=off", "--out", str(out)]
    words += ["--seeds.rows", "24", "--seeds.columns", "32", "--gas.nodes", "80"]
    assert cli.run([*words, "--gas.epochs", "2", "--dpi", "40"]) == 0
    picture = cv2.imread(str(out))
    assert picture is not None and picture.std() > 10


def test_a_figure_into_a_folder_has_every_panel_beside_it(small, tmp_path: Path):
    words = ["figure", "1", OBJECT, "--out", str(tmp_path / "new"), "--format", "svg", "--panel-width", "3"]
    assert cli.run(words) == 0
    names = {path.name for path in (tmp_path / "new").iterdir()}
    trained = {f"{what}-{length}-epochs.svg" for what in ("nodes", "kept-3d", "kept-image") for length in (1, 2)}
    assert names == {"figure-1.svg", "shaded.svg", *trained}


def test_sources_of_one_name_have_panels_of_their_own(tmp_path: Path):
    frames = [DepthFrame(np.full((48, 64), 900 + 100 * k, np.uint16), 0, 0, Camera.kinect(64, 48)) for k in range(2)]
    for name, frame in zip("ab", frames, strict=True):
        (tmp_path / name).mkdir()
        write_oni(tmp_path / name / "w.oni", [frame])
    words = ["figure", "4", *(str(tmp_path / name / "w.oni") for name in "ab"), "--out", str(tmp_path / "new")]
    assert cli.run([*words, "--dpi", "40"]) == 0
    names = {path.name for path in (tmp_path / "new").iterdir()}
    assert len(names) == 5 and {name.partition("-")[2][:2] for name in names if name.startswith("w-2-")} == {"2-"}


def test_the_table_of_the_paper_shows_our_times_beside_the_papers(capsys):
    assert cli.run(["table", "1", "virtual:ball?size=320x240&noise=off"]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if "ball" in line).split()
    assert row[-2:] == ["154", "1.41"]
    assert all(float(seconds) > 0 for seconds in row[1:4])


def test_epochs_go_on_a_timeline_of_their_own(small, tmp_path: Path):
    rrd = tmp_path / "out.rrd"
    words = ["figure", "1", OBJECT, "--out", str(tmp_path / "out.png"), "--save", str(rrd)]
    assert cli.run(words) == 0
    epochs: dict[str, set[int]] = {}
    for part in RrdReader(str(rrd)).stream():
        batch = part.to_record_batch()
        if "epoch" in batch.schema.names:
            known = epochs.setdefault(str(part.entity_path), set())
            known.update(int(value) for value in batch.column("epoch").to_pylist())
    for entity in ("/camera/gas/mask", "/camera/gas/nodes", "/world/nodes"):
        assert epochs[entity] == {1, 2}


def test_table_is_written(small, tmp_path: Path, capsys):
    out = tmp_path / "nodes.md"
    source = "virtual:ball?size=320x240&noise=off&frames=3"
    assert cli.run(["nodes", source, "--every", "2", "--out", str(out)]) == 0
    assert out.read_text(encoding="utf-8").count("\n| 50 |") == 2


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["figure", "1", OBJECT, "--out", "x.gif"], "must end in .png, .webp, .pdf or .svg"),
        (["figure", "1", OBJECT, "--out", "no/such/x.png"], "its folder does not exist"),
        (["figure", "1", OBJECT, "--frame", "9"], "the last is"),
        (["figure", "4", "--save", "x.rrd"], "figure 4 has none"),
        (["nodes", OBJECT, "--every", "0"], "--every is 0; it must be 1 or more"),
        (["nodes", OBJECT, "--out", "no/such/x.md"], "its folder does not exist"),
        (["nodes", "virtual:ball?live=1", "--every", "2"], "never ends"),
        (["figure", "1", "nowhere.ply"], "nowhere.ply"),
    ],
)
def test_bad_input_is_one_sentence_and_no_zero(words, sentence, capsys):
    assert cli.run(words) != 0
    said = capsys.readouterr().err
    assert sentence in said
    assert "Traceback" not in said


@pytest.mark.skipif(sys.platform == "win32", reason="limits of files are POSIX's")
def test_epochs_that_cannot_be_written_are_an_error_and_leave_nothing(tmp_path: Path):
    """Beyond the limit every write fails, as on a full disk."""
    rrd = tmp_path / "out.rrd"
    program = f"""
import resource, signal
from selective_depth.app import cli
from selective_depth.app.commands import figures
from selective_depth.app.pictures import palette, write_picture
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
figures.EPOCHS, figures.FIRST_POINTS, figures.FIRST_NODES = (1, 2), 500, 100
words = ["figure", "1", {OBJECT!r}, "--out", {str(tmp_path / "out.webp")!r}, "--save", {str(rrd)!r}]
raise SystemExit(cli.run(words))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 1, done.stderr
    assert f"writing '{rrd}' failed. Check the disk" in done.stderr
    assert not rrd.exists()
