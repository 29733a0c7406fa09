"""Colour as it is seen: in the viewer's stream, in the stills, in the cloud, and nothing without."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rerun.chunk import RrdReader

from selective_depth.app.cli import run
from selective_depth.app.commands.model import save_cloud
from selective_depth.app.commands.snapshot import still_of
from selective_depth.app.pictures import contact_sheet, panels_of
from selective_depth.app.settings import SeedOptions, Settings
from selective_depth.drivers import open_source
from selective_depth.selectors.acquire import acquire
from selective_depth.selectors.seeds import SeedGrid

SCENE = "virtual:ball?size=160x120&frames=2"
SMALL = Settings(seeds=SeedOptions(rows=24, columns=32))


def saved(path: Path, source: str) -> dict[str, list[object]]:
    """What a run of a source logs, by entity and component."""
    assert (
        run(["replay", source, "--headless", "--save", str(path), "--seeds.rows", "24", "--seeds.columns", "32"]) == 0
    )
    found: dict[str, list[object]] = {}
    for chunk in RrdReader(str(path)).stream():
        batch = chunk.to_record_batch()
        for name in (each for each in batch.schema.names if ":" in each):  # components, not times
            found.setdefault(f"{chunk.entity_path} {name}", []).extend(batch.column(name).to_pylist())
    return found


def component(found: dict[str, list[object]], entity: str, ending: str) -> list[object]:
    keys = [key for key in found if key.startswith(f"{entity} ") and key.endswith(ending)]
    assert len(keys) == 1, (entity, ending, sorted(found))
    return found[keys[0]]


def test_the_stream_holds_the_image_its_camera_and_a_coloured_cloud(tmp_path: Path) -> None:
    found = saved(tmp_path / "out.rrd", SCENE)
    with open_source(SCENE) as source:
        frames = list(source)
    jpegs = component(found, "/colour", ":blob")
    assert len(jpegs) == 2
    for frame, jpeg in zip(frames, jpegs, strict=True):
        image = np.array(Image.open(io.BytesIO(bytes(jpeg[0]))))  # type: ignore[index]
        assert frame.colour is not None and image.shape == frame.colour.shape
        assert np.abs(image.astype(int) - frame.colour).mean() < 4
    assert component(found, "/colour", ":resolution") == [[[160.0, 120.0]]]
    points = np.array(component(found, "/world/cloud", ":positions")[0])
    colours = np.array(component(found, "/world/cloud", ":colors")[0], np.uint32)
    first = frames[0]
    uv = np.rint(first.camera.project_uv(points * 1000)).astype(int)
    assert len(points) == np.count_nonzero(first.depth_mm[::3, ::3])
    assert first.colour is not None
    rgb = np.stack([colours >> 24, colours >> 16 & 255, colours >> 8 & 255], axis=-1)
    np.testing.assert_array_equal(rgb, first.colour[uv[:, 1], uv[:, 0]])


def test_without_colour_nothing_of_it_is_there(tmp_path: Path) -> None:
    found = saved(tmp_path / "out.rrd", f"{SCENE}&colour=off")
    assert not any(key.startswith(("/colour", "/world/cloud")) for key in found)


def test_an_unregistered_image_is_shown_but_colours_no_cloud(tmp_path: Path) -> None:
    found = saved(tmp_path / "out.rrd", f"{SCENE}&colour=unregistered")
    assert any(key.startswith("/colour ") for key in found)
    assert not any(key.startswith("/world/cloud") for key in found)


@pytest.mark.parametrize(("how", "names"), [("on", ["scene", "depth"]), ("off", ["depth", "neural-gas"])])
def test_stills_have_a_scene_where_there_is_one(how: str, names: list[str]) -> None:
    with open_source(f"{SCENE}&colour={how}") as source:
        row = still_of(source.read(), SMALL)
    panels = panels_of(row)
    assert [panel.name for panel in panels][:2] == names
    if how == "on":
        np.testing.assert_array_equal(panels[0].image, row.frame.colour)


def test_a_sheet_keeps_its_columns_where_one_source_has_no_colour() -> None:
    rows = []
    for how in ("on", "off"):
        with open_source(f"{SCENE}&colour={how}") as source:
            rows.append((how, still_of(source.read(), SMALL)))
    figure = contact_sheet(*rows)
    captions = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert captions.count("Scene") == 1 and captions.count("Depth") == 2
    lefts = [axes.get_position().x0 for axes in figure.axes if any(t.get_text() == "Depth" for t in axes.texts)]
    assert lefts[0] == pytest.approx(lefts[1])


def test_the_cloud_has_the_colours_of_the_scene(tmp_path: Path) -> None:
    with open_source(SCENE) as source:
        frame = source.read()
    acquisition = acquire(frame.measure, SeedGrid.from_frame(frame, (24, 32)), 0.05, 2)
    count = save_cloud(tmp_path / "c.ply", acquisition, frame.camera, frame.colours_at(acquisition.uv))
    data = (tmp_path / "c.ply").read_bytes().partition(b"end_header\n")[2]
    vertex = np.frombuffer(data, [("xyz", "<f4", 3), ("rgb", "u1", 3), ("round", "u1")])
    kept = acquisition.uv[acquisition.returned]
    assert len(vertex) == count == len(kept) and frame.colour is not None
    np.testing.assert_array_equal(vertex["rgb"], frame.colour[kept[:, 1], kept[:, 0]])
