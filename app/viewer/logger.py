"""What is logged: one step of a run, or one frame after trainings of several lengths."""

from __future__ import annotations

import time
from collections.abc import Iterable

import cv2
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr

from selective_depth.app.pictures import palette as legend
from selective_depth.app.pipeline import STAGES, FrameResult, Model
from selective_depth.app.settings import ViewerOptions
from selective_depth.app.viewer.blueprint import Shown, blueprint, epoch_blueprint
from selective_depth.drivers.colour import jpeg_of
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.selectors.arrays import pixels_where
from selective_depth.selectors.memory import TemporalStep
from selective_depth.selectors.neural_gas import RegionSelection

DEPTH_COLOURS = legend.palette(legend.DEPTH_COLOURMAP)
CENTRE = np.float32(0.5)
"""Rerun puts pixel centres at halves, we at whole numbers."""
USUAL_US = 33_333
"""From one frame to the next, where their times do not tell."""
LINE_S = 0.5
"""How long the line that tells the gain stays at least, to be read."""
JPEG_QUALITY = 80
CLOUD_STEP = 3
"""The coloured cloud has every third pixel each way: all of them would be 5 MB a frame."""


class StepLogger:
    """Logs steps into one recording stream, from one thread.

    Parameters
    ----------
    stream : rr.RecordingStream
        Where to.
    options : ViewerOptions
        What the user asked to see.
    """

    def __init__(self, stream: rr.RecordingStream, options: ViewerOptions) -> None:
        self._stream = stream
        self._options = options
        self._shown: Shown | None = None
        self._timestamp_us, self._elapsed_s, self._logged_s = 0, 0.0, 0.0
        self._state = ""
        self._line, self._line_s = "", -LINE_S
        self._limits_mm = (0.0, 1.0)

    def log(self, step: FrameResult) -> None:
        """Log a step under its frame's number and time."""
        if self._shown is None:
            self._log_static(step)
        else:
            # A clock that stands, or that a recording played again sets back, is helped on.
            gone_us = step.frame.timestamp_us - self._timestamp_us
            self._elapsed_s += (gone_us if gone_us > 0 else USUAL_US) / 1e6
        self._timestamp_us, self._logged_s = step.frame.timestamp_us, time.monotonic()
        shown = self._shown_of(step)
        if shown != self._shown:  # a sensor's colour may come a little later
            self._lay_out(shown, step)
        self._stream.set_time("frame", sequence=step.frame.index)
        self._stream.set_time("time", duration=self._elapsed_s)
        self._log_sensor(step)
        self._log_colour(step.frame)
        self._log_gas(step.regions, shown.detail)
        self._log_improvement(step, shown.detail)
        self._log_acquisition(step)
        if step.memory is not None:
            self._log_memory(step.memory)
        self._log_figures(step)

    def log_trainings(self, frame: DepthFrame, trainings: Iterable[tuple[int, RegionSelection]]) -> None:
        """Log the regions of one frame after trainings of several lengths, by epoch."""
        near, far = legend.depth_limits_mm(frame.depth_mm)
        self._limits_mm = (float(near), float(far))
        self._stream.send_blueprint(epoch_blueprint(self._limits_mm), make_default=True)
        self._stream.send_recording_name(f"epochs of {frame.source}")
        self._log_camera(frame.camera)
        self._log_classes()
        holes = rr.SegmentationImage((frame.depth_mm == 0).view(np.uint8), opacity=1.0)
        self._stream.log("camera/depth", self._depth_image(frame.depth_mm), static=True)
        self._stream.log("camera/holes", holes, static=True)
        for epoch, regions in trainings:
            self._stream.set_time("epoch", sequence=epoch)
            self._log_gas(regions, detail=True)
            error = rr.Scalars(regions.quantisation_error_mm)
            self._stream.log("figures/quantisation_error_mm", error)

    def log_state(self, state: str) -> None:
        """Log the sensor's state without a frame, as long after the last one as it is on the wall."""
        if self._shown is not None:
            self._stream.set_time("time", duration=self._elapsed_s + time.monotonic() - self._logged_s)
            self._log_change(state)

    def _log_change(self, state: str) -> None:
        if state != self._state:
            self._state = state
            self._stream.log("sensor/state", rr.StateChange(state=state))

    def _log_static(self, step: FrameResult) -> None:
        log, options = self._stream.log, self._options
        near, far = legend.depth_limits_mm(step.frame.depth_mm)
        near = near if options.near_mm is None else options.near_mm
        far = far if options.far_mm is None else options.far_mm
        self._limits_mm = (float(near), float(max(far, near + 1)))
        self._stream.send_recording_name(step.frame.source or "depth")
        self._log_camera(step.frame.camera)
        pixels = step.seeds.lattice_uv.reshape(-1, 2) + CENTRE
        log("camera/seeds", rr.Points2D.from_fields(positions=pixels, radii=1.6), static=True)
        self._log_classes()
        states = rr.StateConfiguration(
            values=list(legend.STATE_COLOURS),
            labels=list(legend.STATE_COLOURS),
            colors=list(legend.STATE_COLOURS.values()),
        )
        log("sensor/state", states, static=True)
        names = [name.replace("_", " ") for name in STAGES]
        log("figures/stages", rr.SeriesLines(names=names, colors=list(legend.STAGE_COLOURS)), static=True)
        for name, (label, colour) in legend.FIGURES.items():
            log(f"figures/{name}", rr.SeriesLines(names=label, colors=colour), static=True)
        log("keys/stages", _png(legend.key("ms", list(zip(names, legend.STAGE_COLOURS, strict=True)))), static=True)

    def _shown_of(self, step: FrameResult) -> Shown:
        """What there is to see in a step; what was there once stays."""
        acquisition, before, look = step.acquisition, self._shown or Shown(), step.look or self._options
        return Shown(
            by="" if acquisition is None else acquisition.by or "a selector",
            rounds=max(before.rounds, 0 if acquisition is None else int(acquisition.round.max(initial=0))),
            visitor=look.layout == "visitor",
            detail=look.detail,
            hide=look.hide,
            memory=step.memory is not None,
            colour=before.colour or step.frame.colour is not None,
            registered=before.registered or (step.frame.colour is not None and step.frame.registered),
            truth=before.truth or step.frame.truth_mm is not None,
            live=before.live or step.state != "replay",
        )

    def _lay_out(self, shown: Shown, step: FrameResult) -> None:
        """Send the layout of what there is to see, and what explains it."""
        self._shown = shown
        layout = blueprint(shown, _middle_m(step.frame.depth_mm), self._limits_mm)
        self._stream.send_blueprint(layout, make_default=True)
        if step.frame.colour_camera is not None:
            self._log_camera(step.frame.colour_camera, "colour")
        self._stream.log("legend", _png(shown.legend(self._limits_mm)), static=True)
        for plot, (_, unit, names) in shown.plots.items():
            lines = [legend.FIGURES[name] for name in names]
            self._stream.log(f"keys/{plot}", _png(legend.key(unit, lines)), static=True)
        self._stream.log("guide", rr.TextDocument(shown.guide, media_type="text/markdown"), static=True)

    def _log_camera(self, camera: Camera, entity: str = "camera") -> None:
        log = self._stream.log
        log("/", rr.ViewCoordinates.RDF, static=True)
        pinhole = rr.Pinhole(
            resolution=[camera.width, camera.height],
            focal_length=[camera.fx, camera.fy],
            principal_point=[camera.cx + CENTRE, camera.cy + CENTRE],
            image_plane_distance=0.3,
        )
        log(entity, pinhole, static=True)

    def _log_classes(self) -> None:
        log = self._stream.log
        nothing = (0, "", (0, 0, 0, 0))
        hole = (1, legend.UNKNOWN, legend.HOLE)
        kept, long = (1, "kept triangles", legend.REGION), (2, "long edges", legend.LONG_EDGE)
        # A class means what the nearest context above says: one for all, one for the regions.
        log("camera", rr.AnnotationContext([nothing, hole]), static=True)
        log("camera/gas", rr.AnnotationContext([nothing, kept, long]), static=True)
        forgotten = (1, "forgotten in this frame", legend.FORGOTTEN)
        log("camera/memory", rr.AnnotationContext([nothing, forgotten]), static=True)
        for entity, scale, unknown in (
            ("camera/improvement/score", legend.IMPROVEMENT, (0, legend.UNKNOWN, legend.HOLE)),
            ("camera/errors", legend.ERROR, (0, legend.UNKNOWN, legend.HOLE)),
            ("camera/memory/age", legend.AGE, nothing),
        ):
            levels = enumerate(legend.palette(scale.colormap).tolist())
            classes = [(level, scale.told((level - 1) / 254), colour) for level, colour in levels if level]
            log(entity, rr.AnnotationContext([unknown, *classes]), static=True)

    def _log_sensor(self, step: FrameResult) -> None:
        log, depth_mm, seeds = self._stream.log, step.frame.depth_mm, step.seeds
        log("camera/depth", self._depth_image(depth_mm))
        log("camera/holes", rr.SegmentationImage((depth_mm == 0).view(np.uint8), opacity=1.0))
        near, far = self._limits_mm
        level = np.clip((seeds.depth_mm.ravel() - near) * (255 / (far - near)), 0, 255)
        colours = np.where(seeds.valid.ravel(), DEPTH_COLOURS[level.astype(np.uint8)], np.uint32(legend.HOLE))
        log("camera/seeds", rr.Points2D.from_fields(colors=colours))
        self._log_change(step.state)

    def _log_colour(self, frame: DepthFrame) -> None:
        """The colour image, as JPEG: a twentieth of its bytes; where it lies on depth, a cloud in its colours."""
        if frame.colour is None:
            return
        image = rr.EncodedImage(contents=jpeg_of(frame.colour, JPEG_QUALITY), media_type="image/jpeg")
        self._stream.log("colour", image)
        if frame.registered:
            uv = pixels_where(frame.depth_mm[::CLOUD_STEP, ::CLOUD_STEP]) * CLOUD_STEP
            points_m = frame.camera.points_mm(uv, frame.measure(uv)) * np.float32(0.001)
            packed = frame.colour[uv[:, 1], uv[:, 0]] @ np.array((1 << 24, 1 << 16, 1 << 8), np.uint32) | np.uint32(255)
            self._stream.log("world/cloud", rr.Points3D(points_m, colors=packed, radii=-1.8))

    def _log_gas(self, regions: RegionSelection, detail: bool = False) -> None:
        log = self._stream.log
        log("camera/gas/mask", rr.SegmentationImage(regions.mask.view(np.uint8)))
        if detail:
            complement = rr.SegmentationImage(regions.complement.astype(np.uint8) * 2)
            log("camera/gas/complement", complement)
        nodes_uv, kept = regions.nodes_uv + CENTRE, regions.triangles[regions.kept]
        outlines = nodes_uv[kept[:, (0, 1, 2, 0)]]
        strips = rr.LineStrips2D(_closed_strips(outlines), colors=legend.MESH, radii=0.35)
        log("camera/gas/triangles", strips)
        log("camera/gas/nodes", rr.Points2D(nodes_uv, colors=legend.NODE, radii=1.4))
        nodes_m = regions.nodes_mm * np.float32(0.001)
        log("world/nodes", rr.Points3D(nodes_m, colors=legend.NODE, radii=-1.5))
        mesh = rr.Mesh3D(vertex_positions=nodes_m, triangle_indices=kept, albedo_factor=legend.REGION)
        log("world/regions", mesh)

    def _log_improvement(self, step: FrameResult, detail: bool) -> None:
        log, improvement = self._stream.log, step.improvement
        known = improvement.known
        log("camera/improvement/score", _level_image(legend.IMPROVEMENT, improvement.score, known))
        if detail:
            log("camera/improvement/unknown", rr.SegmentationImage((~known).view(np.uint8), opacity=1.0))
            log("camera/improvement/estimate", self._depth_image(_as_depth(improvement.estimate_mm)))
            deviation_mm = np.sqrt(np.where(known, improvement.variance_mm2, 0))
            log("camera/errors/expected", _level_image(legend.ERROR, deviation_mm, known))

    def _log_acquisition(self, step: FrameResult) -> None:
        log, acquisition = self._stream.log, step.acquisition
        if acquisition is None:
            return
        shot = acquisition.round > 0
        uv, depth_mm, rounds = (array[shot] for array in (acquisition.uv, acquisition.depth_mm, acquisition.round))
        colours = legend.round_colours(self._shown.rounds if self._shown else 0)[rounds]
        log("camera/samples", rr.Points2D(uv + CENTRE, colors=colours, radii=0.9))
        hit = depth_mm > 0
        points_m = step.frame.camera.points_mm(uv[hit], depth_mm[hit]) * np.float32(0.001)
        log("world/samples", rr.Points3D(points_m, colors=colours[hit], radii=-1.5))
        if step.gain and step.gain != self._line and self._elapsed_s >= self._line_s + LINE_S:
            self._line, self._line_s = step.gain, self._elapsed_s
            # No PNG: the viewer in a browser takes those that follow each other for a film, and is long in decoding it.
            log("line", rr.Image(legend.headline(step.gain)[:, :, 0]))
        if step.model is not None:
            self._log_models(step.frame, step.model, to_truth=step.memory is not None)

    def _log_models(self, frame: DepthFrame, model: Model, to_truth: bool) -> None:
        """The model and the even lattice's, each with its error; the truth, where it is known.

        Errors are what the line tells: to the frame, or with a memory to the truth, if that is known.
        """
        log, even = self._stream.log, model.even
        against = frame if to_truth and frame.truth_mm is not None else None
        log("camera/model", self._depth_image(_as_depth(model.depth_mm)))
        log("camera/errors/selective", _error_image(model, against))
        if even is not None:
            log("camera/even", self._depth_image(_as_depth(even.depth_mm)))
            log("camera/errors/even", _error_image(even, against))
        if frame.truth_mm is not None:
            log("camera/truth", self._depth_image(frame.truth_mm))

    def _log_memory(self, memory: TemporalStep) -> None:
        """Age of what is known, fresh bright, and what was forgotten in this frame."""
        self._stream.log("camera/memory/age", _level_image(legend.AGE, memory.age_frames, memory.known))
        changed = np.zeros_like(memory.changed) if memory.restarted else memory.changed
        self._stream.log("camera/memory/changed", rr.SegmentationImage(changed.view(np.uint8)))

    def _log_figures(self, step: FrameResult) -> None:
        log = self._stream.log
        log("figures/stages", rr.Scalars([step.stages_ms.get(name, np.nan) for name in STAGES]))
        for name in legend.FIGURES:
            if np.isfinite(value := step.figures.get(name, np.nan)):
                log(f"figures/{name}", rr.Scalars(value))

    def _depth_image(self, depth_mm: npt.NDArray[np.uint16]) -> rr.DepthImage:
        return rr.DepthImage(depth_mm, meter=1000.0, colormap=legend.DEPTH_COLOURMAP, depth_range=list(self._limits_mm))


def _middle_m(depth_mm: npt.NDArray[np.uint16]) -> float:
    """Median depth in metres; 2 m without any."""
    known = depth_mm[depth_mm > 0]
    return float(np.median(known)) / 1000 if known.size else 2.0


def _as_depth(value_mm: npt.NDArray[np.float32]) -> npt.NDArray[np.uint16]:
    return np.where(value_mm > 0, value_mm, np.float32(0)).astype(np.uint16)


def _error_image(model: Model, against: DepthFrame | None) -> rr.SegmentationImage:
    """How far a model is off from its own frame, or from the truth of another."""
    if against is None or against.truth_mm is None:
        return _level_image(legend.ERROR, model.error_mm, ~np.isnan(model.error_mm))
    seen = (against.depth_mm > 0) & (against.truth_mm > 0)
    return _level_image(legend.ERROR, np.abs(model.depth_mm - against.truth_mm), seen)


def _level_image(
    scale: legend.Scale, values: npt.NDArray[np.generic], known: npt.NDArray[np.bool_]
) -> rr.SegmentationImage:
    """Values on a scale as its levels 1..255, whose colours and meaning are classes; 0 where nothing is known.

    So a map has colours that Rerun does not know, and takes a byte a pixel.
    """
    levels = cv2.convertScaleAbs(scale.place(values), alpha=254, beta=1)
    return rr.SegmentationImage(np.multiply(levels, known, dtype=np.uint8), opacity=1.0)


def _png(image: legend.Image) -> rr.EncodedImage:
    """A drawing, in a twentieth of its bytes."""
    return rr.EncodedImage(contents=cv2.imencode(".png", image[:, :, ::-1])[1].tobytes(), media_type="image/png")


def _closed_strips(points_uv: npt.NDArray[np.float32]) -> pa.Array:
    """Line strips of shape (n, points, 2) as the SDK holds them, without its loop over n."""
    count, length, _ = points_uv.shape
    inner = rr.encodings.Vec2DBatch(points_uv.reshape(-1, 2)).as_arrow_array()
    offsets = pa.array(np.arange(0, (count + 1) * length, length, dtype=np.int32))
    return pa.ListArray.from_arrays(offsets, inner, type=_STRIPS)


_STRIPS = rr.components.LineStrip2DBatch([]).as_arrow_array().type
