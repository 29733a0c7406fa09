"""Images in a recording: the pixels that were given, each entity's size and look told once."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader
from steps import make_step, save

from selective_depth.app.pictures import palette
from selective_depth.app.viewer.images import ImageLogger
from selective_depth.drivers.colour import jpeg_of


def rows_of(path: Path, *, static: bool, entity: str = "/x") -> list[dict[str, object]]:
    """What was logged of an entity, by component, in the order of its frames."""
    rows = []
    for chunk in RrdReader(str(path)).stream():
        if chunk.entity_path == entity and chunk.is_static == static:
            batch = chunk.to_record_batch()
            names = [name for name in batch.schema.names if ":" in name or name == "frame"]
            rows += batch.select(names).to_pylist()
    return sorted(rows, key=lambda row: row.get("frame", 0))


@pytest.fixture
def stream(tmp_path: Path) -> rr.RecordingStream:
    made = rr.RecordingStream("images")
    made.save(tmp_path / "x.rrd")
    return made


def test_pixels_are_those_given_whatever_their_order_in_memory(stream: rr.RecordingStream, tmp_path: Path) -> None:
    given = np.random.default_rng(0).integers(0, 60_000, (3, 30, 40)).astype(np.uint16)
    images = ImageLogger(stream)
    shown = [given[0], given[1][::-1], np.asfortranarray(given[2])]
    for number, image in enumerate(shown):
        stream.set_time("frame", sequence=number)
        images.depth("x", image, "viridis", (500, 4000))
    stream.disconnect()
    rows = rows_of(tmp_path / "x.rrd", static=False)
    for row, image in zip(rows, shown, strict=True):
        pixels = np.asarray(row["DepthImage:buffer"][0], np.uint8).view(np.uint16)
        np.testing.assert_array_equal(pixels.reshape(30, 40), image)
    (look,) = rows_of(tmp_path / "x.rrd", static=True)
    size = look["DepthImage:format"][0]
    assert (size["width"], size["height"]) == (40, 30) and look["DepthImage:depth_range"] == [[500, 4000]]
    assert look["DepthImage:meter"] == [1000]


def test_a_look_that_changes_is_told_again(stream: rr.RecordingStream, tmp_path: Path) -> None:
    images = ImageLogger(stream)
    for opaque in (False, False, True, True):
        images.classes("x", np.zeros((4, 5), np.uint8), opaque=opaque)
    stream.disconnect()
    assert len(rows_of(tmp_path / "x.rrd", static=False)) == 4
    told = [row.get("SegmentationImage:opacity") for row in rows_of(tmp_path / "x.rrd", static=True)]
    assert len(told) == 2 and None in told and [1.0] in told


def test_packed_colours_are_the_channels() -> None:
    colours = np.random.default_rng(1).integers(0, 256, (7, 9, 3)).astype(np.uint8)
    np.testing.assert_array_equal(palette.channels(palette.packed(colours)), colours)
    assert (palette.packed(colours) & 255 == 255).all()


@pytest.mark.parametrize("quality", [60, 100])
def test_a_recordings_own_jpeg_is_logged_unless_it_is_large(tmp_path: Path, quality: int) -> None:
    step = make_step(0)
    colour = np.random.default_rng(2).integers(0, 256, (*step.frame.shape, 3)).astype(np.uint8) // 8
    jpeg = jpeg_of(colour, quality)
    frame = dataclasses.replace(step.frame, colour=colour, registered=True, colour_jpeg=jpeg)
    save(tmp_path / "x.rrd", [dataclasses.replace(step, frame=frame)])
    logged = [bytes(row["EncodedImage:blob"][0]) for row in rows_of(tmp_path / "x.rrd", static=False, entity="/colour")]
    assert logged == [jpeg if quality == 60 else jpeg_of(colour, 80)]
