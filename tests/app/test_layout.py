"""How it is laid out: what each layout shows, is called and explains, and what is logged for it."""

from __future__ import annotations

import dataclasses
import re
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader
from steps import HEADLESS, HEIGHT, WIDTH, images_of, make_step, rows_of, save, views_of

from selective_depth.app.pictures import palette
from selective_depth.app.pipeline import FrameResult, SensorNote, StageTimes
from selective_depth.app.viewer import Viewer
from selective_depth.app.viewer.blueprint import Shown, blueprint
from selective_depth.selectors.memory import TemporalAcquisition


def coloured(step: FrameResult) -> FrameResult:
    """The step with colour that lies on depth, and with exact depth."""
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    frame = dataclasses.replace(step.frame, colour=image, registered=True, truth_mm=step.frame.depth_mm)
    return dataclasses.replace(step, frame=frame)


def remembering(step: FrameResult) -> FrameResult:
    memory = TemporalAcquisition((HEIGHT, WIDTH), budget=0.1, seeds=(12, 16), camera=step.frame.camera)
    return dataclasses.replace(step, memory=memory.step(step.frame.measure))


def titles_of(shown: Shown) -> list[str]:
    return [view.name for view in views_of(blueprint(shown))]


@pytest.mark.parametrize(("visitor", "acquiring", "rich"), list(product([False, True], repeat=3)))
def test_every_view_shows_something_that_was_logged(tmp_path: Path, visitor: bool, acquiring: bool, rich: bool) -> None:
    step = dataclasses.replace(make_step(0, acquiring=acquiring), state="live", gain="1 mm")
    if rich:
        step = coloured(step)
        step = remembering(step) if acquiring else step
    shown = Shown(
        by="step score" if acquiring else "", rounds=2, visitor=visitor, detail=rich, memory=acquiring and rich,
        colour=rich, registered=rich, truth=rich, live=True,
    )  # fmt: skip
    save(tmp_path / "out.rrd", [step], detail=rich, layout="visitor" if visitor else "engineer")
    logged = rows_of(tmp_path / "out.rrd")
    views = views_of(blueprint(shown))
    assert len(views) >= 7
    assert len({view.name for view in views}) == len(views)
    for view in views:
        contents = view.contents
        if isinstance(contents, str):
            contents = [str(contents).replace("$origin", str(view.origin).rstrip("/"))]
        for path in contents:
            inside = [entity for entity in logged if entity.startswith(path.removesuffix("/**"))]
            assert inside, f"view '{view.name}' shows {path}, which nobody logs"


@pytest.mark.parametrize("visitor", [False, True])
def test_without_a_budget_nothing_speaks_of_what_it_would_buy(visitor: bool) -> None:
    shown = Shown(visitor=visitor, detail=True, colour=True, truth=True)
    words = " ".join([shown.guide, *titles_of(shown)])
    assert not re.search(r"\b[45]\b|[Ss]elective|[Ee]ven|by |round", words), words
    spending = dataclasses.replace(shown, by="step score", rounds=2, visitor=False)
    assert re.search(r"\b4\b.*\b5\b", spending.guide, re.DOTALL)
    assert shown.legend((500, 5000)).size < spending.legend((500, 5000)).size


@pytest.mark.parametrize("by", ["surface score", "neural gas, long edges", "surface score, with memory"])
def test_the_panel_of_what_was_acquired_names_its_selector(by: str) -> None:
    plain = by.removesuffix(", with memory")
    assert f"4 By {plain}" in titles_of(Shown(by=by))
    assert f"By {plain}" in titles_of(Shown(by=by, visitor=True))
    assert f"**4 By {plain}**" in Shown(by=by).guide


def test_inner_read_outs_have_views_and_titles_of_their_own() -> None:
    inner = {"3a Edges", "3b Estimate", "3b Deviation"}
    for by in ("", "step score"):
        shown = Shown(by=by, detail=True)
        assert inner <= set(titles_of(shown)) and all(title in shown.guide for title in inner)
        assert not inner & set(titles_of(dataclasses.replace(shown, detail=False)))
        assert len(titles_of(dataclasses.replace(shown, visitor=True))) == len(titles_of(Shown(by=by, visitor=True)))


def test_visitors_see_no_figures_and_no_numbers() -> None:
    for by in ("", "step score"):
        views = views_of(blueprint(Shown(by=by, visitor=True, memory=bool(by), live=True)))
        assert not any(isinstance(view, rrb.TimeSeriesView | rrb.StateTimelineView) for view in views)
        assert not any(view.name[0].isdigit() for view in views)
    assert {"Even lattice", "Selective", "Error, even", "Error, selective"} <= {view.name for view in views}


def test_the_two_models_stand_beside_the_truth_or_the_whole_frame_with_their_errors_below() -> None:
    for visitor, truth in product([False, True], repeat=2):
        titles = titles_of(Shown(by="step score", visitor=visitor, truth=truth))
        order = [title for title in titles if re.search("Even|Error,|Selective|Truth|Whole", title)]
        last = "Truth" if truth else "Whole frame"
        plain = [title.removeprefix("5 ") for title in order]
        assert plain == ["Even lattice", "Error, even", "Selective", "Error, selective", last]


@pytest.mark.parametrize("layer", ["colour", "cloud", "nodes", "triangles", "samples"])
def test_a_layer_that_is_hidden_is_in_no_view(layer: str) -> None:
    entities = {
        "colour": "/colour", "cloud": "/world/cloud", "nodes": "/nodes", "triangles": "/triangles|/regions",
        "samples": "/world/samples",
    }  # fmt: skip
    shown = Shown(by="step score", colour=True, registered=True)

    def there(given: Shown) -> bool:
        paths = [path for view in views_of(blueprint(given)) for path in [str(view.origin), *view.contents]]
        return any(re.search(entities[layer], path) for path in paths)

    assert there(shown)
    assert not there(dataclasses.replace(shown, hide=(layer,)))


def test_rates_and_counts_have_plots_of_their_own_and_no_legend_covers_a_curve() -> None:
    shown = Shown(by="step score", memory=True, truth=True, live=True)
    plots = [view for view in views_of(blueprint(shown)) if isinstance(view, rrb.TimeSeriesView)]
    assert [plot.name for plot in plots] == ["Stages", "Frames/s", "Dropped", "Errors", "Pixels"]
    for plot in plots:
        assert plot.properties["PlotLegend"].visible.as_arrow_array().to_pylist() == [False]


def test_a_look_that_changes_on_the_way_is_laid_out_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[Any] = []
    monkeypatch.setattr(rr.RecordingStream, "send_blueprint", lambda self, layout, **more: sent.append(layout))
    steps = [make_step(index) for index in range(4)]
    steps[2] = dataclasses.replace(steps[2], look=dataclasses.replace(HEADLESS, layout="visitor"))
    steps[3] = dataclasses.replace(steps[3], look=dataclasses.replace(HEADLESS, layout="visitor"))
    save(tmp_path / "out.rrd", steps)
    assert len(sent) == 2
    assert "Even lattice" in [view.name for view in views_of(sent[1])]


def columns_of(path: Path, entity: str, *names: str) -> list[tuple[Any, ...]]:
    """Values of an entity's columns, row by row, in the order of the first."""
    rows: list[tuple[Any, ...]] = []
    for chunk in RrdReader(str(path)).stream():
        if chunk.entity_path == entity and not chunk.is_static:
            batch = chunk.to_record_batch()
            columns = [batch.column(name) for name in names]
            nanoseconds = [each.cast(pa.int64()) if each.type == pa.duration("ns") else each for each in columns]
            rows += zip(*(each.to_pylist() for each in nanoseconds), strict=True)
    return sorted(rows, key=lambda row: row[0])


def test_an_outage_is_as_long_on_the_timeline_as_on_the_wall(tmp_path: Path) -> None:
    shown = Viewer(dataclasses.replace(HEADLESS, save=tmp_path / "out.rrd"), live=True, times=StageTimes(), frames=9)
    step = dataclasses.replace(make_step(0), state="live")
    shown.show(step)
    time.sleep(0.3)
    shown.show(SensorNote("lost"))
    time.sleep(0.3)
    later = dataclasses.replace(step.frame, index=1, timestamp_us=step.frame.timestamp_us + 600_000)
    shown.show(dataclasses.replace(step, frame=later))
    assert shown.close() == []
    rows = columns_of(tmp_path / "out.rrd", "/sensor/state", "time", "StateChange:state")
    seconds = [row[0] / 1e9 for row in rows]
    assert [row[1] for row in rows] == [["live"], ["lost"], ["live"]]
    assert seconds[1] == pytest.approx(0.3, abs=0.15)
    assert seconds[2] == pytest.approx(0.6)


def test_time_goes_on_where_a_clock_stands_or_goes_back(tmp_path: Path) -> None:
    steps = []
    for index, timestamp_us in enumerate((500, 100_500, 100_500, 200, 50_200)):
        step = make_step(index)
        frame = dataclasses.replace(step.frame, timestamp_us=timestamp_us)
        steps.append(dataclasses.replace(step, frame=frame))
    save(tmp_path / "out.rrd", steps)
    rows = columns_of(tmp_path / "out.rrd", "/camera/depth", "frame", "time")
    seconds = [row[1] / 1e9 for row in rows]
    np.testing.assert_allclose(seconds, [0, 0.1, 0.133333, 0.166666, 0.216666], atol=1e-5)


def test_the_line_can_be_read_before_it_changes_and_the_even_model_is_logged_when_there_is_one(tmp_path: Path) -> None:
    steps = []
    for index, gain in enumerate(("", "first", "second", "", "third", "third", "fourth")):
        step = make_step(index)
        late = dataclasses.replace(step.frame, timestamp_us=(0, 1, 2, 3, 7, 20, 21)[index] * 100_000)
        step = dataclasses.replace(step, frame=late)
        assert step.model is not None
        model = step.model if index == 1 else dataclasses.replace(step.model, even=None)
        steps.append(dataclasses.replace(step, gain=gain, model=model))
    save(tmp_path / "out.rrd", steps)
    assert [row[0] for row in columns_of(tmp_path / "out.rrd", "/line", "frame")] == [1, 4, 6]
    for entity in ("/camera/even", "/camera/errors/even"):
        assert [row[0] for row in columns_of(tmp_path / "out.rrd", entity, "frame")] == [1]


def test_errors_of_both_models_are_on_one_scale_and_with_a_memory_to_the_truth(tmp_path: Path) -> None:
    plain = make_step(0)
    truth = np.where(plain.frame.depth_mm > 0, plain.frame.depth_mm + 25, 0).astype(np.uint16)
    frame = dataclasses.replace(plain.frame, truth_mm=truth)
    known = frame.depth_mm > 0
    for remembers, errors_mm in ((False, (12.5, 50.0)), (True, (25.0, 25.0))):
        step = dataclasses.replace(plain, frame=frame)
        step = remembering(step) if remembers else step
        save(tmp_path / "out.rrd", [step])
        for name, error_mm in zip(("selective", "even"), errors_mm, strict=True):
            image = images_of(tmp_path / "out.rrd", f"/camera/errors/{name}", np.uint8)[0]
            assert (image[known] == 1 + round(254 * (error_mm / 100) ** 0.5)).all()
            assert not image[~known].any()


def test_a_level_means_what_its_class_says_and_has_its_colour() -> None:
    draw = np.random.default_rng(0)
    for scale in (palette.ERROR, palette.IMPROVEMENT, palette.AGE, palette.depth_scale((800, 3000))):
        low, high = scale.limits
        values = (low + (high - low) * draw.uniform(-0.2, 1.3, (30, 40))).astype(np.float32)
        levels = scale.levels(values)
        assert levels.min() == 1 and levels.max() == 255
        off = np.abs(palette.channels(palette.palette(scale.colormap)[levels]).astype(int) - scale.colour(values))
        assert off.max() <= 12  # a level or two of 255
        inside = (values - low) * (values - high) < 0
        told = np.array([float(scale.told((level - 1) / 254).split()[0]) for level in levels[inside]])
        assert np.abs(told - values[inside]).max() < 0.012 * abs(high - low) + 0.06
