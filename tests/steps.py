"""Small steps made by hand, saved by the viewer and read back: the viewer is tested, not the selectors."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader

from selective_depth.app.pictures import palette as legend
from selective_depth.app.pipeline import STAGES, FrameResult, Model, StageTimes
from selective_depth.app.settings import ViewerOptions
from selective_depth.app.viewer import Viewer
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.selectors.acquire.loop import Acquisition, Round
from selective_depth.selectors.improvement import ImprovementSelection
from selective_depth.selectors.neural_gas import delaunay_regions
from selective_depth.selectors.seeds import SeedGrid

HEIGHT, WIDTH = 48, 64
HEADLESS = ViewerOptions(headless=True)


def make_step(index: int, *, acquiring: bool = True) -> FrameResult:
    """A small step with holes; its model is 12.5 mm off everywhere, and the even lattice's four times that."""
    rng = np.random.default_rng(index)
    depth_mm = rng.integers(600, 4000, (HEIGHT, WIDTH)).astype(np.uint16)
    depth_mm[5:12, 20:30] = 0
    camera = Camera.kinect(WIDTH, HEIGHT)
    frame = DepthFrame(depth_mm, index, 1_000_000 + index * 33_333, camera, "made/by hand")
    seeds = SeedGrid.from_frame(frame, (12, 16))
    known = depth_mm > 0
    score = np.where(known, rng.random((HEIGHT, WIDTH)), 0).astype(np.float32)
    improvement = ImprovementSelection(
        mask=score > 0.9,
        score=score,
        name="improvement",
        estimate_mm=np.where(known, depth_mm, np.nan).astype(np.float32),
        variance_mm2=np.where(known, 4.0, np.nan).astype(np.float32),
        known=known,
        raw=score,
    )
    regions = delaunay_regions(seeds.points_mm, seeds.uv.astype(np.float32), (HEIGHT, WIDTH))
    acquisition = model = None
    if acquiring:
        uv = np.array([[3, 4], [25, 7], [50, 40]], dtype=np.int32)
        acquisition = Acquisition(
            uv=np.vstack((seeds.lattice_uv.reshape(-1, 2), uv)),
            depth_mm=np.concatenate((seeds.depth_mm.ravel().astype(np.uint16), frame.measure(uv))),
            round=np.array([0] * seeds.depth_mm.size + [1, 1, 2], dtype=np.uint8),
            frame_shape=(HEIGHT, WIDTH),
            rounds=(Round(2, 1), Round(1, 1)),
            by="step score",
        )
        error_mm = np.where(known, 12.5, np.nan).astype(np.float32)
        even = Model(depth_mm.astype(np.float32) + 50, 4 * error_mm, 50.0)
        model = Model(depth_mm.astype(np.float32), error_mm, 12.5, even=even)
    return FrameResult(
        frame,
        seeds,
        regions,
        improvement,
        acquisition,
        model,
        stages_ms=dict.fromkeys(STAGES, 1.0),
        figures=dict.fromkeys(legend.FIGURES, 2.0),
    )


def save(path: Path, steps: list[FrameResult], **options: Any) -> None:
    chosen = dataclasses.replace(HEADLESS, save=path, **options)
    shown = Viewer(chosen, live=False, times=StageTimes(), frames=100)
    for step in steps:
        shown.show(step)
    assert shown.close() == []
    assert sum(shown.dropped.values()) == 0


def rows_of(path: Path) -> dict[str, int]:
    """Rows that carry data, by entity; static ones included."""
    rows: dict[str, int] = {}
    for chunk in RrdReader(str(path)).stream():
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    return rows


def images_of(path: Path, entity: str, dtype: type[np.generic]) -> list[np.ndarray]:
    """Images of an entity in the order of its frames, as they lie in the file."""
    found = {}
    for chunk in RrdReader(str(path)).stream():
        if chunk.entity_path != entity or chunk.is_static:
            continue
        batch = chunk.to_record_batch()
        buffer = next(n for n in batch.schema.names if n.endswith(":buffer"))
        for frame, data in zip(batch.column("frame").to_pylist(), batch.column(buffer), strict=True):
            pixels = np.asarray(data.values.flatten())
            found[frame] = pixels.view(dtype).reshape(HEIGHT, WIDTH)
    return [found[frame] for frame in sorted(found)]


def views_of(part: Any) -> list[Any]:
    """All views in a blueprint."""
    children = getattr(part, "contents", None) or []
    if hasattr(part, "root_container"):
        return views_of(part.root_container)
    if hasattr(part, "class_identifier") or isinstance(children, str):
        return [part]
    return [view for child in children for view in views_of(child)]
