"""Pictures without a viewer: what is drawn where, and that holes stay visible."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from selective_depth.app.commands.snapshot import short_name, snapshot, still_of
from selective_depth.app.console.errors import UsageError
from selective_depth.app.pictures import contact_rows, contact_sheet, palette, write_picture
from selective_depth.app.pictures import panels as parts
from selective_depth.app.pictures import sheet as parts_sheet
from selective_depth.app.pictures.palette import Scale
from selective_depth.app.pipeline import FrameResult, Pipeline
from selective_depth.app.settings import AcquireOptions, GasOptions, PanelOptions, Settings
from selective_depth.drivers.errors import OutputError
from selective_depth.drivers.folder import write_folder
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.drivers.open import open_source
from selective_depth.selectors.even import even_lattice
from selective_depth.selectors.reconstruct import reconstruct

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = PanelOptions()
REMEMBERING = Settings(gas=GasOptions(nodes=300), acquire=AcquireOptions(budget=0.03, memory="still"))
SMALL = Settings(gas=GasOptions(nodes=300), acquire=AcquireOptions(budget=0.02, rounds=2))


def step_frame() -> DepthFrame:
    """A wall with a box before it and a hole in it."""
    depth = np.full((240, 320), 2500, np.uint16)
    depth[80:160, 120:200] = 1500
    depth[20:60, 20:60] = 0
    return DepthFrame(depth, 0, 0, Camera.kinect(320, 240), "box")


@pytest.fixture(scope="module")
def row() -> FrameResult:
    return still_of(step_frame(), SMALL)


def hexadecimal(colour: int) -> tuple[int, ...]:
    return tuple(palette.channels(colour).tolist())


def test_every_panel_has_the_size_of_the_frame(row: FrameResult) -> None:
    made = parts.panels_of(row)
    names = ["depth", "neural-gas", "improvement", "acquired", "error-even", "error-selective"]
    assert [panel.name for panel in made] == names
    for panel in made:
        assert panel.image.shape == (240, 320, 3)
        assert panel.image.dtype == np.uint8


def test_holes_have_a_colour_that_no_depth_and_no_score_has(row: FrameResult) -> None:
    hole = np.array(hexadecimal(palette.HOLE))
    image = parts.depth_panel(row.frame).image
    assert (image[30:50, 30:50] == hole).all()
    assert not (image[row.frame.depth_mm > 0] == hole).all(axis=1).any()
    for name in (palette.DEPTH_COLOURMAP, palette.ERROR.colormap, palette.ROUND_COLOURMAP):
        away = np.abs(palette.channels(palette.palette(name)).astype(int) - hole).max(axis=1)
        assert away.min() > 25, name


def test_near_is_darker_than_far_as_in_the_viewer(row: FrameResult) -> None:
    grey = cv2.cvtColor(parts.depth_panel(row.frame).image, cv2.COLOR_RGB2GRAY)
    assert grey[120, 160] < grey[200, 300] - 40


def test_colours_of_a_scale_go_from_limit_to_limit_and_are_dark_where_nothing_is_known() -> None:
    values = np.array([-5.0, 0.0, 20.0, 100.0, 1e9, np.nan])
    linear = Scale("any", "ice", (0.0, 100.0))
    colours = palette.channels(palette.palette("ice"))
    np.testing.assert_array_equal(linear.colour(values), colours[[0, 0, 51, 255, 255, 0]])
    np.testing.assert_array_equal(replace(linear, root=True).colour(values), colours[[0, 0, 114, 255, 255, 0]])


def test_a_bar_names_values_where_their_colours_are() -> None:
    ticks = palette.ERROR.ticks
    assert [text for _, text in ticks] == ["0", "5", "25", "100 mm"]
    for at, text in ticks:
        value = float(text.split()[0])
        np.testing.assert_array_equal(palette.ERROR.colour(value), palette.ERROR.bar[round(255 * at)])
    assert len(palette.round_scale(4).bar) == 4


def test_no_two_quantities_share_colours() -> None:
    scales = (palette.depth_scale((500, 5000)), palette.IMPROVEMENT, palette.ERROR, palette.AGE)
    assert len({scale.colormap for scale in scales}) == len(scales)
    assert palette.round_scale(3).colormap == palette.AGE.colormap  # both tell when something was measured


def test_the_map_is_brightest_along_the_step(row: FrameResult) -> None:
    image = parts.improvement_panel(row.improvement).image.astype(int).sum(axis=2)
    assert image[120, 114:126].max() > image[120, 150:170].max() + 100


def test_shots_are_drawn_where_they_were_made(row: FrameResult) -> None:
    assert row.acquisition is not None
    image = parts.samples_panel(row.frame, row.acquisition).image
    colours = {hexadecimal(int(colour)) for colour in palette.round_colours(2)[1:]}
    shot = row.acquisition.mask()
    assert {tuple(c) for c in image[shot].tolist()} == colours
    assert not any(tuple(c) in colours for c in image[~shot][::50].tolist())


def test_depth_limits_are_whole_half_metres() -> None:
    depth = np.linspace(1230, 3340, 10_000).astype(np.uint16)
    assert palette.depth_limits_mm(depth) == (1000, 3500)
    assert palette.depth_limits_mm(np.zeros(4, np.uint16)) == (500, 5000)
    low, high = palette.depth_limits_mm(np.full(9, 2000, np.uint16))
    assert low < high


def test_a_frame_without_depth_can_be_drawn(tmp_path: Path) -> None:
    blank = DepthFrame(np.zeros((240, 320), np.uint16), 0, 0, Camera.kinect(320, 240))
    write_picture(tmp_path / "a.png", contact_sheet(("nothing", still_of(blank, SMALL))))
    sheet = cv2.imread(str(tmp_path / "a.png"))
    assert sheet is not None and sheet.shape[1] == 1600


def drawings(row: FrameResult) -> dict[str, Figure]:
    """Sheets with few and many panels, and every panel alone."""
    scene = np.zeros((*row.frame.shape, 3), np.uint8)
    coloured = replace(row, frame=replace(row.frame, colour=scene, registered=True))
    title, few = "walk.oni, frame 12", replace(row, acquisition=None)
    alone = {panel.name: parts_sheet([(title, [panel])], 5.3) for panel in parts.panels_of(coloured)}
    return {"few": contact_sheet(("box", few)), "many": contact_sheet((title, coloured)), **alone}


def test_no_text_leaves_the_page_or_runs_into_another(row: FrameResult) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.text import Text

    drawn = drawings(row)
    assert len(drawn) == 9
    for name, figure in drawn.items():
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        renderer = canvas.get_renderer()
        texts = [text for text in figure.findobj(Text) if text.get_text() and text.get_visible()]
        texts = [text for text in texts if text.axes is None or text in text.axes.texts]
        boxes = [text.get_window_extent(renderer) for text in texts]
        assert len(boxes) >= 2, name
        for at, box in enumerate(boxes):
            assert box.x0 >= 0 and box.y0 >= 0, (name, texts[at])
            assert box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1, (name, texts[at])
            for other in range(at):
                assert not box.overlaps(boxes[other]), (name, texts[at], texts[other])


def test_errors_are_those_of_as_many_measurements_spread_evenly_and_by_selection(row: FrameResult) -> None:
    assert row.acquisition is not None
    even, selective = parts.panels_of(row)[-2:]
    assert even.scale is selective.scale is palette.ERROR
    frame, count = row.frame, len(row.acquisition.uv)
    uv = even_lattice(frame.shape, count)
    assert len(uv) == pytest.approx(count, rel=0.02)
    for panel, model_mm in (
        (even, reconstruct(uv, frame.measure(uv), frame.shape)),
        (selective, row.acquisition.reconstruct()),
    ):
        off = (model_mm - frame.depth_mm)[frame.depth_mm > 0]
        assert f"RMSE {np.sqrt(np.mean(off**2)):.1f}" in panel.note


def test_with_a_memory_the_model_and_the_truth_are_the_memorys() -> None:
    with open_source("virtual:ball?size=320x240&speed=0&frames=4") as source, Pipeline(REMEMBERING) as pipeline:
        results = [pipeline.make(frame) for frame in source]
    truth_mm, model = results[-1].frame.truth_mm, results[-1].model
    assert truth_mm is not None and model is not None
    seen = (results[-1].frame.depth_mm > 0) & (truth_mm > 0)
    rmse_mm = np.sqrt(np.mean((model.depth_mm - truth_mm)[seen] ** 2))
    assert f"RMSE {rmse_mm:.1f}," in parts.panels_of(results[-1])[-1].note
    assert model.truth_rmse_mm == pytest.approx(rmse_mm, rel=1e-4)


def test_the_ending_is_the_format_and_size_and_resolution_are_as_asked(row: FrameResult, tmp_path: Path) -> None:
    begins = {"pdf": b"%PDF", "svg": b"<?xml", "webp": b"RIFF", "png": b"\x89PNG"}
    for ending, begin in begins.items():
        path = tmp_path / f"a.{ending}"
        write_picture(path, parts_sheet(contact_rows([("box", row)]), 8.0), 150)
        assert path.read_bytes().startswith(begin)
    sheet = cv2.imread(str(tmp_path / "a.png"))
    assert sheet is not None and sheet.shape[1] == 8 * 150


def test_snapshots_of_one_name_and_of_strange_names_are_all_written(tmp_path: Path) -> None:
    frames = tmp_path / "frames\udcff"  # a name that is no UTF-8
    with open_source("virtual:ball?size=320x240&frames=1") as source:
        write_folder(frames, source)
    written = snapshot([str(frames), str(frames)], 0, tmp_path / "out", SMALL, PAGE)
    assert len(written) == 1 + 2 * 7
    assert set(written) == set((tmp_path / "out").iterdir())


def test_snapshot_writes_the_sheet_and_every_panel(tmp_path: Path) -> None:
    sources = ["virtual:ball?size=320x240&frames=2", "virtual:workstation?size=320x240&frames=2"]
    written = snapshot(sources, 1, tmp_path / "new" / "pictures", SMALL, PAGE)
    assert [path.name for path in written[:3]] == ["sheet.png", "ball-scene.png", "ball-depth.png"]
    assert len(written) == 1 + 2 * 7
    sheet = cv2.imread(str(written[0]))
    assert sheet is not None and sheet.shape[1] == 1600
    for path in written[1:]:
        single = cv2.imread(str(path))
        assert single is not None and single.shape[1] == 530


def test_bare_panels_are_the_pixels_of_the_frame(tmp_path: Path) -> None:
    written = snapshot(["virtual:ball?size=320x240"], 0, tmp_path, SMALL, PanelOptions(bare=True, format="webp"))
    assert {path.suffix for path in written} == {".webp"}
    for path in written[1:]:
        single = cv2.imread(str(path))
        assert single is not None and single.shape == (240, 320, 3)


def test_panels_for_a_paper_are_as_wide_as_asked_and_hold_every_pixel(tmp_path: Path) -> None:
    page = PanelOptions(format="pdf", panel_width=3.5)
    written = snapshot(["virtual:ball?size=320x240"], 0, tmp_path / "new", SMALL, page)
    for path in written[1:]:
        pdf = path.read_bytes()
        assert re.search(rb"/MediaBox \[ *0 0 252 ", pdf), path  # 3.5 inches in points
        assert b"/Width 320" in pdf and b"/Height 240" in pdf
        assert b"/Type3" not in pdf  # which journals refuse


def test_a_row_says_which_frame_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    titles: list[str] = []
    plain = parts_sheet

    def noting(rows, *more, **options):
        titles.extend(title for title, _ in rows)
        return plain(rows, *more, **options)

    monkeypatch.setattr("selective_depth.app.commands.snapshot.sheet", noting)
    snapshot(["virtual:ball?size=320x240&frames=3"], 2, tmp_path / "a.svg", SMALL, PAGE)
    assert titles == ["ball, frame 2"]


def test_a_format_that_cannot_be_made_is_refused_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"must end in \.png, \.webp, \.pdf or \.svg"):
        snapshot(["virtual:ball"], 0, tmp_path / "a.gif", SMALL, PAGE)


def test_an_out_that_ends_like_a_picture_is_the_sheet_alone(tmp_path: Path) -> None:
    source = "virtual:ball?size=320x240&frames=1"
    out = tmp_path / "pic.pdf"
    assert snapshot([source], 0, out, SMALL, PAGE) == [out]
    assert out.read_bytes().startswith(b"%PDF")
    assert list(tmp_path.iterdir()) == [out]


def test_a_frame_beyond_the_end_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="the last is --frame 1"):
        snapshot(["virtual:ball?size=320x240&frames=2"], 2, tmp_path, SMALL, PAGE)


def test_an_unwritable_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(OutputError, match="file' cannot be written: File exists"):
        snapshot(["virtual:ball?size=320x240&frames=1"], 0, tmp_path / "file", SMALL, PAGE)


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
