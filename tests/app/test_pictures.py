"""Pictures without a viewer: what is drawn where, and that holes stay visible."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from selective_depth.app.commands.snapshot import short_name, snapshot, still_row
from selective_depth.app.console.errors import UsageError
from selective_depth.app.pictures import stills
from selective_depth.app.settings import AcquireOptions, GasOptions, Settings
from selective_depth.drivers.errors import OutputError
from selective_depth.drivers.folder import write_folder
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.open import open_source

SMALL = Settings(gas=GasOptions(nodes=300), acquire=AcquireOptions(budget=0.02, rounds=2))


def step_frame() -> DepthFrame:
    """A wall with a box before it and a hole in it."""
    depth = np.full((240, 320), 2500, np.uint16)
    depth[80:160, 120:200] = 1500
    depth[20:60, 20:60] = 0
    return DepthFrame(depth, 0, 0, Camera.kinect(320, 240), "box")


@pytest.fixture(scope="module")
def row() -> stills.StillRow:
    return still_row(step_frame(), "box", SMALL)


def test_every_panel_has_the_size_of_the_frame(row: stills.StillRow) -> None:
    made = stills.panels(row)
    assert [panel.name for panel in made] == [
        "depth",
        "neural-gas",
        "improvement",
        "acquired",
        "error",
    ]
    for panel in made:
        assert panel.image.shape == (240, 320, 3)
        assert panel.image.dtype == np.uint8


def test_holes_have_a_colour_that_no_depth_has(row: stills.StillRow) -> None:
    image = stills.depth_panel(row.frame).image
    hole = image[30:50, 30:50].reshape(-1, 3)
    assert {tuple(c) for c in hole} == {tuple(stills.HOLE), tuple(stills.HATCH)}
    measured = image[row.frame.depth_mm > 0]
    assert not (measured == stills.HOLE).all(axis=1).any()


def test_near_is_brighter_than_far(row: stills.StillRow) -> None:
    grey = cv2.cvtColor(stills.depth_panel(row.frame).image, cv2.COLOR_BGR2GRAY)
    assert grey[120, 160] > grey[200, 300] + 40


def test_the_map_is_brightest_along_the_step(row: stills.StillRow) -> None:
    image = stills.improvement_panel(row.improvement).image.astype(int).sum(axis=2)
    assert image[120, 114:126].max() > image[120, 150:170].max() + 100


def test_shots_are_drawn_where_they_were_made(row: stills.StillRow) -> None:
    assert row.acquisition is not None
    image = stills.samples_panel(row.frame, row.acquisition).image
    colours = {tuple(c) for c in stills.ROUND_COLOURS}
    shot = row.acquisition.mask()
    assert all(tuple(c) in colours for c in image[shot])
    assert not any(tuple(c) in colours for c in image[~shot][::50])


def test_depth_limits_are_whole_half_metres() -> None:
    depth = np.linspace(1230, 3340, 10_000).astype(np.uint16)
    assert stills.depth_limits_mm(depth) == (1000, 3500)
    assert stills.depth_limits_mm(np.zeros(4, np.uint16)) == (500, 5000)
    low, high = stills.depth_limits_mm(np.full(9, 2000, np.uint16))
    assert low < high


def test_a_frame_without_depth_can_be_drawn() -> None:
    blank = DepthFrame(np.zeros((240, 320), np.uint16), 0, 0, Camera.kinect(320, 240))
    sheet = stills.contact_sheet([still_row(blank, "nothing", SMALL)])
    assert sheet.shape[1] == stills.SHEET_WIDTH


def test_no_text_leaves_its_panel(row: stills.StillRow) -> None:
    """The caption and the scale fit for three panels a row as for five."""
    for panel in stills.panels(row):
        for width in (300, 520):
            assert stills.text_width(panel.caption, 19 if width >= 420 else 16, 600) < width
            assert stills.finished(panel, width).shape[1] == width


def test_snapshots_of_one_name_and_of_strange_names_are_all_written(tmp_path: Path) -> None:
    frames = tmp_path / "frames\udcff"  # a name that is no UTF-8
    with open_source("virtual:ball?size=320x240&frames=1") as source:
        write_folder(frames, source)
    written = snapshot([str(frames), str(frames)], 0, tmp_path / "out", SMALL)
    assert len(written) == 11
    assert set(written) == set((tmp_path / "out").iterdir())


def test_snapshot_writes_the_sheet_and_every_panel(tmp_path: Path) -> None:
    sources = ["virtual:ball?size=320x240&frames=2", "virtual:workstation?size=320x240&frames=2"]
    written = snapshot(sources, 1, tmp_path / "new" / "pictures", SMALL)
    assert [path.name for path in written[:3]] == [
        "sheet.png",
        "ball-depth.png",
        "ball-neural-gas.png",
    ]
    assert len(written) == 11
    sheet = cv2.imread(str(written[0]))
    assert sheet is not None and sheet.shape[1] == 1600


def test_a_frame_beyond_the_end_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="the last is --frame 1"):
        snapshot(["virtual:ball?size=320x240&frames=2"], 2, tmp_path, SMALL)


def test_an_unwritable_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(OutputError, match="file' cannot be written: File exists"):
        snapshot(["virtual:ball?size=320x240&frames=1"], 0, tmp_path / "file", SMALL)


@pytest.mark.parametrize(
    ("uri", "name"),
    [
        ("virtual:ball?noise=off", "ball"),
        ("some/folder/", "folder"),
        ("walk one.oni", "walk one"),
        ("openni", "openni"),
    ],
)
def test_short_names(uri: str, name: str) -> None:
    assert short_name(uri) == name
