"""The comparison of strategies, and the model as files."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.csv as pa_csv
import pytest

from selective_depth.app.cli import run
from selective_depth.app.commands.model import save_cloud, save_depth, save_model
from selective_depth.app.console.errors import UsageError
from selective_depth.app.console.exit_codes import FAILED, MISUSED, OK
from selective_depth.app.evaluation import evaluate as protocol
from selective_depth.app.evaluation.evaluate import Errors, Outcome, outcomes, summarise
from selective_depth.app.evaluation.over_time import over_time
from selective_depth.app.evaluation.quadtree import quadtree
from selective_depth.app.evaluation.report import TITLES, comparison, print_results, to_markdown
from selective_depth.app.evaluation.strategies import STRATEGIES, Case, strategies_of
from selective_depth.app.pictures import palette
from selective_depth.app.settings import ComparisonOptions, SeedOptions, Settings
from selective_depth.drivers.errors import OutputError, SourceNotFoundError
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.source import DepthSource
from selective_depth.drivers.virtual.ply import read_ply
from selective_depth.selectors.acquire import acquire
from selective_depth.selectors.seeds import SeedGrid

WIDTH, HEIGHT = 160, 120


def frame(index: int = 0, hole: bool = True) -> DepthFrame:
    """A ball and a bar before a slanted wall, with a hole."""
    rows, columns = np.indices((HEIGHT, WIDTH))
    depth = 2000 + 3 * columns
    ball = (columns - 60 - index) ** 2 + (rows - 60) ** 2
    depth = np.where(ball < 35**2, 1000 + ball // 20, depth)
    depth[:, 130:133] = 1200
    if hole:
        depth[20:40, 100:120] = 0
    camera = Camera.kinect(WIDTH, HEIGHT)
    return DepthFrame(depth.astype(np.uint16), index, 0, camera, "made")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "frames"
    path.mkdir()
    for index in range(3):
        cv2.imwrite(str(path / f"{index:06d}.png"), frame(index).depth_mm)
    return path


SHAPE = (32, 32)
SHOTS = 900
SETTINGS = Settings(seeds=SeedOptions(*SHAPE))


def case_of(shots: int, rounds: int, seen: DepthFrame | None = None) -> Case:
    return Case(seen or frame(), SETTINGS, shots, rounds)


@pytest.mark.parametrize("name", STRATEGIES)
def test_every_strategy_keeps_to_its_budget(name: str) -> None:
    case = case_of(SHOTS, 4)
    uv = STRATEGIES[name].pixels(case)
    assert len(np.unique(uv, axis=0)) == len(uv), "no pixel is paid for twice"
    assert (uv >= 0).all() and (uv < (WIDTH, HEIGHT)).all()
    if STRATEGIES[name].reference:
        assert len(uv) > SHOTS + len(case.seed_uv)
        return
    if name == "uniform":
        assert abs(len(uv) - SHOTS - len(case.seed_uv)) < 0.02 * len(uv)
        return
    np.testing.assert_array_equal(uv[: len(case.seed_uv)], case.seed_uv)
    assert len(uv) <= SHOTS + len(case.seed_uv)
    if name != "oracle":  # it stops when nothing is wrong any more
        assert len(uv) == SHOTS + len(case.seed_uv)


@pytest.mark.parametrize("name", [n for n in STRATEGIES if n != "oracle"])
def test_no_strategy_but_the_oracle_sees_what_it_does_not_measure(name: str) -> None:
    truth = frame()
    first = STRATEGIES[name].pixels(case_of(SHOTS, 3, truth))
    known = np.zeros(truth.shape, np.bool_)
    known[first[:, 1], first[:, 0]] = True
    seeds = SeedGrid.from_frame(truth, SHAPE).lattice_uv.reshape(-1, 2)
    known[seeds[:, 1], seeds[:, 0]] = True
    other = np.where(known, truth.depth_mm, 777).astype(np.uint16)
    changed = DepthFrame(other, 0, 0, truth.camera)
    second = STRATEGIES[name].pixels(case_of(SHOTS, 3, changed))
    np.testing.assert_array_equal(first, second)


def test_what_returned_nothing_is_counted_among_all_measurements() -> None:
    case = case_of(SHOTS, 1)
    u, v = STRATEGIES["random"].pixels(case).T
    in_hole = (v >= 20) & (v < 40) & (u >= 100) & (u < 120)
    assert in_hole.any()
    assert protocol.run_strategy("random", case).missed == in_hole.mean()


def made_of(depth_mm: np.ndarray) -> Case:
    camera = Camera.kinect(WIDTH, HEIGHT)
    return case_of(300, 4, DepthFrame(depth_mm.astype(np.uint16), 0, 0, camera))


@pytest.mark.parametrize("upright", [True, False])
def test_the_gradient_shoots_at_steps_either_way(upright: bool) -> None:
    rows, columns = np.indices((HEIGHT, WIDTH))
    place, step = (columns, 80) if upright else (rows, 60)
    case = made_of(np.where(place < step, 1000, 2000))
    shots = STRATEGIES["gradient"].pixels(case)[len(case.seed_uv) :]
    assert np.abs(shots[:, 0 if upright else 1] - step).max() <= 5  # one step of the seeds


@pytest.mark.parametrize(("name", "inside"), [("neural_gas", True), ("neural_gas_complement", False)])
def test_the_gas_shoots_in_its_regions_and_its_complement_outside(name: str, inside: bool) -> None:
    case = case_of(400, 1)
    u, v = STRATEGIES[name].pixels(case)[len(case.seed_uv) :].T
    share = case.regions.mask[v, u].mean()
    assert (share if inside else 1 - share) > 0.9


def test_a_spread_fills_its_mask_evenly_before_it_goes_elsewhere() -> None:
    case = made_of(np.full((HEIGHT, WIDTH), 2000))
    small = np.zeros((HEIGHT, WIDTH), np.bool_)
    small[50:66, 70:86] = True
    assert (small & case.open).sum() < case.shots
    u, v = case.spread(small)[len(case.seed_uv) :].T
    assert small[v, u].sum() == (small & case.open).sum()
    tiles = case.spread(~small)[len(case.seed_uv) :] // 20
    assert len(np.unique(tiles, axis=0)) == 48, "every part of a wide mask gets its share"


def test_the_oracle_knows_where_nothing_returns() -> None:
    case = case_of(SHOTS, 1)
    shots = STRATEGIES["oracle"].pixels(case)[len(case.seed_uv) :]
    assert len(shots) > 100
    assert (case.frame.measure(shots) > 0).all()


def test_the_oracle_shoots_at_maxima_before_what_lies_beside_them() -> None:
    depth = np.full((HEIGHT, WIDTH), 2000, np.uint16)
    lattice_uv = made_of(depth).seeds.lattice_uv
    u, v = lattice_uv[10, 10]
    depth[v + 1, u + 1 : u + 4] = 2900, 3000, 2900
    far_u, far_v = lattice_uv[20, 20]
    depth[far_v + 1, far_u + 1] = 2500
    case = dataclasses.replace(made_of(depth), shots=32)  # two a batch
    shots = STRATEGIES["oracle"].pixels(case)[len(case.seed_uv) :]
    assert {tuple(uv) for uv in shots[:2]} == {(u + 2, v + 1), (far_u + 1, far_v + 1)}


@pytest.mark.parametrize("name", [n for n in STRATEGIES if "loop" not in n and "uniform" not in n and n != "oracle"])
def test_one_shot_goes_no_farther_than_is_worth_it(name: str) -> None:
    """1.3 steps of 5 px from a seed with depth; a hole of 70x70 pixels is mostly beyond."""
    depth = frame().depth_mm.copy()
    depth[20:90, 20:90] = 0
    case = made_of(depth)
    shots = STRATEGIES[name].pixels(case)[len(case.seed_uv) :]
    assert len(shots) == 300
    apart_px = np.hypot(*(shots[:, None] - case.seeds.uv[None]).transpose(2, 0, 1)).min(axis=1)
    assert apart_px.max() <= 6.5


class Endless(DepthSource):
    """A source that would never stop."""

    frame_count = None

    def __init__(self) -> None:
        self.index = -1

    def read(self, timeout_s: float = 5.0) -> DepthFrame:
        self.index += 1
        assert self.index < 2 * protocol.ENDLESS_FRAMES
        return DepthFrame(np.ones((1, 1), np.uint16), self.index, 0, Camera.kinect(1, 1))

    def close(self) -> None:
        pass


def test_a_source_without_end_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(protocol, "open_source", lambda uri: Endless())
    found = [each.index for each in protocol.frames_of(["here", "there"], 1, None)]
    assert found == 2 * list(range(protocol.ENDLESS_FRAMES))


def test_so_many_frames_of_each_source(folder: Path) -> None:
    for frames in (1, 2):
        found = protocol.frames_of([str(folder)] * 2, 1, frames)
        assert [each.index for each in found] == 2 * list(range(frames))


def test_figures_are_those_of_the_definition() -> None:
    def outcome(name: str, strategy: str, *rmse: float) -> Outcome:
        return Outcome(name, 0.05, strategy, tuple(Errors(r, r / 2, 0.1, 9, 0.2) for r in rmse))

    found = [
        outcome("a", "uniform", 40.0),
        outcome("a", "loop", 10.0, 20.0),
        outcome("a", "oracle", 0.0),
        outcome("b", "uniform", 20.0),
        outcome("b", "loop", 10.0),
        outcome("b", "oracle", 10.0),
    ]
    loop = summarise(found)["0.05"]["loop"]
    assert loop["geo"] == pytest.approx((0.25 * 0.5 * 0.5) ** (1 / 3))
    assert loop["worst"] == 0.5
    assert loop["share"] == pytest.approx((0.75 + 0.5 + 1.0) / 3)
    assert loop["share_min"] == 0.5
    assert loop["rmse_mm"] == pytest.approx(40 / 3)
    assert loop["mae_mm"] == pytest.approx(20 / 3)
    assert "| +5% |" in to_markdown(found)


def test_frames_and_seeds_do_not_depend_on_how_many_processes(folder: Path) -> None:
    options = ComparisonOptions(
        every=2, budget=(0.05,), rounds=2, random_seeds=2, strategies=("random", "loop"), jobs=1
    )
    told: list[tuple[int, int]] = []
    alone = outcomes([str(folder)], options, SETTINGS, lambda a, b: told.append((a, b)))
    assert told == [(0, 2), (1, 2), (2, 2), (2, 2)]
    assert [o.strategy for o in alone] == ["uniform", "random", "loop", "oracle"] * 2
    assert [len(o.errors) for o in alone] == [1, 2, 1, 1] * 2
    assert alone == outcomes([str(folder)], dataclasses.replace(options, jobs=2), SETTINGS)


def test_no_more_frames_are_read_ahead_than_keep_the_processes_busy(
    monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    plain, read, done = protocol.frames_of, 0, 0

    def frames_of(*arguments: Any) -> Iterator[DepthFrame]:
        nonlocal read
        for each in plain(*arguments):
            read += 1
            assert read - done <= 4
            yield each

    def progress(now: int, total: int) -> None:
        nonlocal done
        done = now

    monkeypatch.setattr(protocol, "frames_of", frames_of)
    options = ComparisonOptions(every=1, budget=(0.05,), strategies=(), jobs=2)
    found = outcomes([str(folder)] * 5, options, SETTINGS, progress)
    assert read == done == len(found) / 2 > 8


def test_selecting_pays_on_a_made_scene() -> None:
    cases = [("loop", 0.3), ("step", 0.7)]
    uniform = protocol.run_strategy("uniform", case_of(SHOTS, 8)).rmse_mm
    for name, most in cases:
        found = protocol.run_strategy(name, case_of(SHOTS, 8))
        assert found.rmse_mm < most * uniform


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (["--every", "0"], "--every is 0; it must be 1 or more"),
        (["--rounds", "0"], "--rounds is 0; it must be from 1 to 254"),
        (["--frames", "0"], "--frames is 0"),
        (["--jobs", "0"], "--jobs is 0; it must be 1 or more"),
        (["--budget", "1.5"], "--budget is 1.5; it must be a share between 0 and 1"),
        (["--budget", "5"], "--budget is 5; it must be a share"),
        (["--strategies", "gradiant"], "has 'gradiant'; it takes main, all, FILE.py:NAME, or"),
    ],
)
def test_misuse_is_refused_in_a_sentence(
    option: list[str], words: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["evaluate", str(folder), *option]) == MISUSED
    assert words in " ".join(capsys.readouterr().err.split())


def test_a_source_that_shows_nothing_is_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "000000.png"), np.zeros((48, 64), np.uint16))
    with pytest.raises(SourceNotFoundError, match="no frame with depth"):
        outcomes([str(tmp_path)], ComparisonOptions(), Settings())


def test_the_command_writes_table_file_and_picture(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, picture = tmp_path / "out.json", tmp_path / "out.png"
    words = ["evaluate", str(folder), "--budget", "0.05", "--rounds", "2", "--jobs", "1"]
    words += ["--seeds.rows", "32", "--seeds.columns", "32", "--random-seeds", "1"]
    own = tmp_path / "own.py"
    own.write_text("def far_first(samples):\n    return samples.gap_px()\n")
    words += ["--strategies", "main", f"{own}:far_first", "--gas.nodes", "60"]
    files = {"json": out, "picture": picture, "page": tmp_path / "page.md"}
    files |= {"table": tmp_path / "table.csv", "curves": tmp_path / "curves.svg"}
    for option, path in files.items():
        words += [f"--{option}", str(path)]
    assert run(words) == OK
    printed = capsys.readouterr().out
    document = json.loads(out.read_text())
    for name in strategies_of(["main"]):
        assert name in printed
        row = document["0.05"][name]
        assert {"geo", "worst", "share", "share_min", "rmse_mm", "mae_mm"} <= set(row)
    assert document["0.05"]["uniform"]["geo"] == pytest.approx(1)
    assert document["0.05"]["oracle"]["share"] == pytest.approx(1)
    mine = f"{own}:far_first/loop"
    assert document["0.05"][mine]["ratio_geometric_mean"] == document["0.05"][mine]["geo"]
    assert document["schema"] == 1 and document["settings"]["gas"]["nodes"] == 60
    assert [each["0.05"] for each in document["sources"].values()] == [document["0.05"]]
    rows = pa_csv.read_csv(tmp_path / "table.csv").to_pylist()
    assert len(rows) == len(document["frames"])
    assert {row["index"] for row in rows} == {0}
    loop = next(row for row in rows if row["strategy"] == "loop")
    assert loop["rmse_mm"] == pytest.approx(document["0.05"]["loop"]["rmse_mm"])
    assert "<svg" in (tmp_path / "curves.svg").read_text()
    assert "(`loop`) |" in (tmp_path / "page.md").read_text()
    image = cv2.imread(str(picture))
    assert image is not None and image.shape[1] == 1600
    assert run(["evaluate", str(folder), "--budget", "2"]) == MISUSED
    assert run(["evaluate", str(folder), "--picture", "out.gif"]) == MISUSED
    assert run(["evaluate", str(folder), "--json", str(tmp_path / "no" / "out.json")]) == FAILED
    assert run(["evaluate", str(folder), "--table", "out.xls"]) == MISUSED


def test_a_quad_tree_splits_where_the_corners_foretold_worst() -> None:
    depth = np.full((96, 128), 2000, np.uint16)
    depth[:, 70:] = 1000  # an upright step
    depth[:, 110:] = 0
    seeds = SeedGrid.from_array(depth, (12, 16))
    asked: list[tuple[int, int]] = []

    def measure(uv: np.ndarray) -> np.ndarray:
        asked.extend(map(tuple, uv.tolist()))
        return depth[uv[:, 1], uv[:, 0]]

    uv = quadtree(measure, seeds, 200)
    assert [tuple(pixel) for pixel in uv[len(seeds.lattice_uv.reshape(-1, 2)) :].tolist()] == asked
    assert len(asked) == len(set(asked)) == 200
    near = sum(60 <= u <= 80 for u, _ in asked)
    assert near > 150


def test_the_picture_shows_shots_and_errors(tmp_path: Path) -> None:
    shown = comparison(case_of(960, 2))
    images = [axes.images[0].get_array() for axes in shown.axes if axes.get_xlim()[1] == WIDTH - 0.5]
    assert len(images) == 2 * len(TITLES)
    at = [list(TITLES).index(name) for name in ("uniform", "loop")]
    for image, rounds in zip((images[at[0]], images[at[1]]), (1, 2), strict=True):
        seen = {tuple(pixel) for pixel in image.reshape(-1, 3).tolist()}
        colours = palette.channels(palette.round_colours(rounds)[1:])
        assert all(tuple(colour) in seen for colour in colours.tolist())
    brightness = [images[len(TITLES) + each].astype(int).sum() for each in at]
    assert brightness[1] < brightness[0]  # the loop errs less


@pytest.mark.parametrize(
    ("budget", "said"), [("0.005", "+0.5%"), ("0.025", "+2.5%"), ("0.05", "+5%"), ("0.10", "+10%")]
)
def test_a_budget_is_said_as_it_was_asked_for(budget: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    figures = dict.fromkeys(("geo", "worst", "share", "share_min", "rmse_mm", "mae_mm", "wrong", "missed"), 0.5)
    print_results({budget: {"loop": figures}}, frames=3, rounds=2)
    assert f"{said} of the pixels" in capsys.readouterr().out


def test_the_model_as_files(tmp_path: Path) -> None:
    seen = frame()
    acquisition = acquire(seen.measure, SeedGrid.from_frame(seen, SHAPE), 0.05, 3)
    cloud, depth, samples = save_model(tmp_path / "new" / "model", acquisition, seen)
    kept = acquisition.returned
    points = seen.camera.points_mm(acquisition.uv[kept], acquisition.depth_mm[kept])
    np.testing.assert_allclose(read_ply(cloud).points, points, rtol=1e-6)
    header, _, body = cloud.read_bytes().partition(b"end_header\n")
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\ncomment")
    rows = np.frombuffer(body, [("xyz", "<f4", 3), ("rgb", "u1", 3), ("round", "u1")])
    np.testing.assert_array_equal(rows["round"], acquisition.round[kept])
    assert len({tuple(c) for c in rows["rgb"].tolist()}) == 4
    image = cv2.imread(str(depth), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(image, np.rint(acquisition.reconstruct()))
    with np.load(samples) as loaded:
        np.testing.assert_array_equal(loaded["uv"], acquisition.uv)
        np.testing.assert_array_equal(loaded["depth_mm"], acquisition.depth_mm)
        np.testing.assert_array_equal(loaded["round"], acquisition.round)
        assert tuple(loaded["shape"]) == seen.shape


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    seen = frame()
    acquisition = acquire(seen.measure, SeedGrid.from_frame(seen, SHAPE), 10, 1)
    with pytest.raises(OutputError, match=r"cloud\.ply' cannot be written: No such file"):
        save_cloud(tmp_path / "missing" / "cloud.ply", acquisition, seen.camera)
    with pytest.raises(OutputError, match="cannot be written"):
        save_depth(tmp_path / "missing" / "depth.png", np.zeros((2, 2)))
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="model' cannot be written: Not a directory"):
        save_model(tmp_path / "file" / "model", acquisition, seen)


def test_the_model_command(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "model"
    words = ["model", str(folder), str(out), "--frame", "1", "--rounds", "2"]
    assert run([*words, "--seeds.rows", "32", "--seeds.columns", "32"]) == OK
    assert sorted(p.name for p in out.iterdir()) == ["cloud.ply", "depth.png", "samples.npz"]


@pytest.mark.slow
def test_the_figures_of_the_documentation_hold(shared_data: Path) -> None:
    """The targets of the project, on frames that nothing was tuned on."""
    strategies = ("gradient", "improvement", "step", "loop", "uniform_x3", "uniform_70")
    found = outcomes([str(shared_data / "sequence")], ComparisonOptions(strategies=strategies), Settings())
    results = summarise(found)
    for budget, geo in (("0.05", 0.145), ("0.10", 0.13)):
        loop = results[budget]["loop"]
        assert loop["geo"] <= geo
        assert loop["share"] >= 0.96 and loop["share_min"] >= 0.91
    table = results["0.05"]
    assert table["step"]["geo"] <= min(0.22, table["gradient"]["geo"])
    assert table["step"]["worst"] <= 0.30 and table["step"]["share"] >= 0.87
    assert table["improvement"]["geo"] <= 0.41
    assert table["loop"]["rmse_mm"] < table["uniform_70"]["rmse_mm"]
    assert table["loop"]["mae_mm"] <= table["uniform_x3"]["mae_mm"]


def test_strategies_are_named_by_groups_or_one_by_one() -> None:
    every = strategies_of(["all"])
    assert set(every) == set(STRATEGIES)
    assert strategies_of(["improvement/loop", "main"])[0] == "improvement/loop"
    assert {"neural-gas/one-shot", "neural-gas/loop", "gradient/loop"} <= set(every)
    with pytest.raises(UsageError, match="'nope'; it takes main, all, FILE"):
        strategies_of(["nope"])


def test_over_time_a_memory_is_held_against_what_it_replaces(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, picture = tmp_path / "out.json", tmp_path / "memory.png"
    uri = "virtual:ball?speed=0&frames=6&size=160x120"
    words = ["evaluate", uri, "--over-time", "--budget", "5%", "--json", str(out), "--picture", str(picture)]
    words += ["--width", "6", "--dpi", "50"]
    assert run([*words, "--seeds.rows", "32", "--seeds.columns", "32", "--rounds", "4"]) == OK
    found = json.loads(out.read_text())["over_time"][uri]
    assert set(found) == {"memory", "memoryless", "whole_frame", "median"}
    for course in found.values():
        assert len(course["rmse_mm"]) == len(course["mae_mm"]) == 6
    assert found["memory"]["rmse_mm"][0] == pytest.approx(found["memoryless"]["rmse_mm"][0])
    assert found["memory"]["mae_mm"][-1] < 0.8 * found["memoryless"]["mae_mm"][-1]
    assert found["median"]["rmse_mm"][-1] < found["whole_frame"]["rmse_mm"][-1]
    assert cv2.imread(str(picture)).shape[1] == 6 * 50
    assert "memoryless" in capsys.readouterr().out
    assert run(["evaluate", "--over-time"]) == MISUSED
    assert run(["evaluate", uri, "--over-time", "--budget", "5%", "--curves", "x.pdf"]) == MISUSED


def test_over_time_a_recording_without_truth_is_held_against_itself(folder: Path) -> None:
    *_, (_, _, courses) = over_time(str(folder), ComparisonOptions(rounds=2), SETTINGS)
    assert courses["whole_frame"].rmse_mm == [0, 0, 0]
    assert all(value > 0 for value in courses["memory"].rmse_mm)
