"""What is logged: one result of a run, or one frame after trainings of several lengths."""

from __future__ import annotations

import time
from collections.abc import Iterable

import cv2
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr

from selective_depth.app.pictures import palette
from selective_depth.app.pipeline import STAGES, FrameResult, Model
from selective_depth.app.settings import ViewerOptions
from selective_depth.app.viewer.blueprint import Shown, blueprint, epoch_blueprint
from selective_depth.app.viewer.images import ImageLogger
from selective_depth.drivers.colour import jpeg_of
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.selectors.arrays import pixels_where
from selective_depth.selectors.memory import TemporalStep
from selective_depth.selectors.neural_gas import RegionSelection

DEPTH_COLOURS = palette.palette(palette.DEPTH_COLOURMAP)
CENTRE = np.float32(0.5)
"""Rerun puts pixel centres at halves, we at whole numbers."""
USUAL_US = 33_333
"""From one frame to the next, where their times do not tell."""
LINE_S = 0.5
"""How long the line that tells the gain stays at least, to be read."""
JPEG_QUALITY = 80
MOST_JPEG = 6
"""A recording's own JPEG is logged as it is where it has a sixth of its image's bytes or less."""
CLOUD_STEP = 3
"""The coloured cloud has every third pixel each way: all of them would be 5 MB a frame."""


class ResultLogger:
    """Logs the results of frames into one recording stream, from one thread.

    Parameters
    ----------
    stream : rr.RecordingStream
        Where to.
    options : ViewerOptions
        What the user asked to see.
    """

    def __init__(self, stream: rr.RecordingStream, options: ViewerOptions) -> None:
        self._stream = stream
        self._log = stream.log
        self._images = ImageLogger(stream)
        self._options = options
        self._shown: Shown | None = None
        self._timestamp_us, self._elapsed_s, self._logged_s = 0, 0.0, 0.0
        self._state = ""
        self._line, self._line_s = "", -LINE_S
        self._limits_mm: tuple[float, float] = (0.0, 1.0)

    def log(self, result: FrameResult) -> None:
        """Log a result under its frame's number and time."""
        if self._shown is None:
            self._log_static(result)
        else:
            # Time goes on even where a clock stands still, or jumps back when a recording is played again.
            gone_us = result.frame.timestamp_us - self._timestamp_us
            self._elapsed_s += (gone_us if gone_us > 0 else USUAL_US) / 1e6
        self._timestamp_us, self._logged_s = result.frame.timestamp_us, time.monotonic()
        shown = self._shown_of(result)
        if shown != self._shown:  # a sensor's colour may come a little later
            self._lay_out(shown, result)
        self._stream.set_time("frame", sequence=result.frame.index)
        self._stream.set_time("time", duration=self._elapsed_s)
        self._log_sensor(result)
        self._log_colour(result.frame)
        self._log_gas(result.regions, shown.detail)
        self._log_improvement(result, shown.detail)
        self._log_acquisition(result)
        if result.memory is not None:
            self._log_memory(result.memory)
        self._log_figures(result)

    def log_trainings(self, frame: DepthFrame, trainings: Iterable[tuple[int, RegionSelection]]) -> None:
        """Log the regions of one frame after trainings of several lengths, by epoch."""
        self._limits_mm = palette.depth_limits_mm(frame.depth_mm)
        self._stream.send_blueprint(epoch_blueprint(self._limits_mm), make_default=True)
        self._stream.send_recording_name(f"epochs of {frame.source}")
        self._log_camera(frame.camera)
        self._log_classes()
        self._log_frame(frame.depth_mm, static=True)
        for epoch, regions in trainings:
            self._stream.set_time("epoch", sequence=epoch)
            self._log_gas(regions, detail=True)
            self._log("figures/quantisation_error_mm", rr.Scalars(regions.quantisation_error_mm))

    def log_state(self, state: str) -> None:
        """Log the sensor's state without a frame, as long after the last one as it is on the wall."""
        if self._shown is not None:
            self._stream.set_time("time", duration=self._elapsed_s + time.monotonic() - self._logged_s)
            self._log_change(state)

    def _log_change(self, state: str) -> None:
        if state != self._state:
            self._state = state
            self._log("sensor/state", rr.StateChange(state=state))

    def _log_static(self, result: FrameResult) -> None:
        options = self._options
        near, far = palette.depth_limits_mm(result.frame.depth_mm)
        near = near if options.near_mm is None else options.near_mm
        far = far if options.far_mm is None else options.far_mm
        self._limits_mm = near, max(far, near + 1)
        self._stream.send_recording_name(result.frame.source or "depth")
        self._log_camera(result.frame.camera)
        pixels = result.seeds.lattice_uv.reshape(-1, 2) + CENTRE
        self._log("camera/seeds", rr.Points2D.from_fields(positions=pixels, radii=1.6), static=True)
        self._log_classes()
        states = rr.StateConfiguration(
            values=list(palette.STATE_COLOURS),
            labels=list(palette.STATE_COLOURS),
            colors=list(palette.STATE_COLOURS.values()),
        )
        self._log("sensor/state", states, static=True)
        names = [name.replace("_", " ") for name in STAGES]
        self._log("figures/stages", rr.SeriesLines(names=names, colors=list(palette.STAGE_COLOURS)), static=True)
        for name, (label, colour) in palette.FIGURES.items():
            self._log(f"figures/{name}", rr.SeriesLines(names=label, colors=colour), static=True)
        self._log(
            "keys/stages", _png(palette.key("ms", list(zip(names, palette.STAGE_COLOURS, strict=True)))), static=True
        )

    def _shown_of(self, result: FrameResult) -> Shown:
        """What there is to see in a result; what was there once stays."""
        acquisition, before, look = result.acquisition, self._shown or Shown(), result.look or self._options
        return Shown(
            by="" if acquisition is None else acquisition.by or "a selector",
            rounds=max(before.rounds, 0 if acquisition is None else int(acquisition.round.max(initial=0))),
            visitor=look.layout == "visitor",
            detail=look.detail,
            hide=look.hide,
            memory=result.memory is not None,
            colour=before.colour or result.frame.colour is not None,
            registered=before.registered or (result.frame.colour is not None and result.frame.registered),
            truth=before.truth or result.frame.truth_mm is not None,
            live=before.live or result.state != "replay",
        )

    def _lay_out(self, shown: Shown, result: FrameResult) -> None:
        """Send the layout of what there is to see, and what explains it."""
        self._shown = shown
        layout = blueprint(shown, _middle_m(result.frame.depth_mm), self._limits_mm)
        self._stream.send_blueprint(layout, make_default=True)
        if result.frame.colour_camera is not None:
            self._log_camera(result.frame.colour_camera, "colour")
        self._log("legend", _png(shown.legend(self._limits_mm)), static=True)
        for plot, (_, unit, names) in shown.plots.items():
            lines = [palette.FIGURES[name] for name in names]
            self._log(f"keys/{plot}", _png(palette.key(unit, lines)), static=True)
        self._log("guide", rr.TextDocument(shown.guide, media_type="text/markdown"), static=True)

    def _log_camera(self, camera: Camera, entity: str = "camera") -> None:
        self._log("/", rr.ViewCoordinates.RDF, static=True)
        pinhole = rr.Pinhole(
            resolution=[camera.width, camera.height],
            focal_length=[camera.fx, camera.fy],
            principal_point=[camera.cx + CENTRE, camera.cy + CENTRE],
            image_plane_distance=0.3,
        )
        self._log(entity, pinhole, static=True)

    def _log_classes(self) -> None:
        nothing = (0, "", (0, 0, 0, 0))
        hole = (1, palette.UNKNOWN, palette.HOLE)
        kept, long = (1, "kept triangles", palette.REGION), (2, "long edges", palette.LONG_EDGE)
        # A class means what the nearest context above says: one for all, one for the regions.
        self._log("camera", rr.AnnotationContext([nothing, hole]), static=True)
        self._log("camera/gas", rr.AnnotationContext([nothing, kept, long]), static=True)
        forgotten = (1, "forgotten in this frame", palette.FORGOTTEN)
        self._log("camera/memory", rr.AnnotationContext([nothing, forgotten]), static=True)
        for entity, scale, unknown in (
            ("camera/improvement/score", palette.IMPROVEMENT, (0, palette.UNKNOWN, palette.HOLE)),
            ("camera/errors", palette.ERROR, (0, palette.UNKNOWN, palette.HOLE)),
            ("camera/memory/age", palette.AGE, nothing),
        ):
            levels = enumerate(palette.palette(scale.colormap).tolist())
            classes = [(level, scale.told((level - 1) / 254), colour) for level, colour in levels if level]
            self._log(entity, rr.AnnotationContext([unknown, *classes]), static=True)

    def _log_sensor(self, result: FrameResult) -> None:
        depth_mm, seeds = result.frame.depth_mm, result.seeds
        self._log_frame(depth_mm)
        near, far = self._limits_mm
        level = np.clip((seeds.depth_mm.ravel() - near) * (255 / (far - near)), 0, 255)
        colours = np.where(seeds.valid.ravel(), DEPTH_COLOURS[level.astype(np.uint8)], np.uint32(palette.HOLE))
        self._log("camera/seeds", rr.Points2D.from_fields(colors=colours))
        self._log_change(result.state)

    def _log_colour(self, frame: DepthFrame) -> None:
        """The colour image, as JPEG: a twentieth of its bytes; where it lies on depth, a cloud in its colours."""
        if frame.colour is None:
            return
        jpeg = frame.colour_jpeg
        if jpeg is None or len(jpeg) > frame.colour.size // MOST_JPEG:
            jpeg = jpeg_of(frame.colour, JPEG_QUALITY)
        self._log("colour", rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        if frame.registered:
            every = slice(None, None, CLOUD_STEP), slice(None, None, CLOUD_STEP)
            depth_mm, colours = frame.depth_mm[every], palette.packed(frame.colour[every])
            known = depth_mm > 0
            points_m = frame.camera.points_mm(pixels_where(known) * CLOUD_STEP, depth_mm[known]) * np.float32(0.001)
            self._log("world/cloud", rr.Points3D(points_m, colors=colours[known], radii=-1.8))

    def _log_gas(self, regions: RegionSelection, detail: bool = False) -> None:
        self._images.classes("camera/gas/mask", regions.mask.view(np.uint8))
        if detail:
            self._images.classes("camera/gas/complement", regions.complement.astype(np.uint8) * np.uint8(2))
        nodes_uv, kept = regions.nodes_uv + CENTRE, regions.triangles[regions.kept]
        outlines = _closed_strips(nodes_uv[kept[:, (0, 1, 2, 0)]])
        self._log("camera/gas/triangles", rr.LineStrips2D(outlines, colors=palette.MESH, radii=0.35))
        self._log("camera/gas/nodes", rr.Points2D(nodes_uv, colors=palette.NODE, radii=1.4))
        nodes_m = regions.nodes_mm * np.float32(0.001)
        self._log("world/nodes", rr.Points3D(nodes_m, colors=palette.NODE, radii=-1.5))
        mesh = rr.Mesh3D(vertex_positions=nodes_m, triangle_indices=kept, albedo_factor=palette.REGION)
        self._log("world/regions", mesh)

    def _log_improvement(self, result: FrameResult, detail: bool) -> None:
        improvement, known = result.improvement, result.improvement.known
        self._log_levels("camera/improvement/score", palette.IMPROVEMENT, improvement.score, known)
        if detail:
            self._images.classes("camera/improvement/unknown", (~known).view(np.uint8), opaque=True)
            self._log_depth("camera/improvement/estimate", _as_depth(improvement.estimate_mm))
            deviation_mm = np.sqrt(np.where(known, improvement.variance_mm2, 0))
            self._log_levels("camera/errors/expected", palette.ERROR, deviation_mm, known)

    def _log_acquisition(self, result: FrameResult) -> None:
        acquisition = result.acquisition
        if acquisition is None:
            return
        shot = acquisition.round > 0
        uv, depth_mm, rounds = (array[shot] for array in (acquisition.uv, acquisition.depth_mm, acquisition.round))
        colours = palette.round_colours(self._shown.rounds if self._shown else 0)[rounds]
        self._log("camera/samples", rr.Points2D(uv.astype(np.float32) + CENTRE, colors=colours, radii=0.9))
        hit = depth_mm > 0
        points_m = result.frame.camera.points_mm(uv[hit], depth_mm[hit]) * np.float32(0.001)
        self._log("world/samples", rr.Points3D(points_m, colors=colours[hit], radii=-1.5))
        if result.gain and result.gain != self._line and self._elapsed_s >= self._line_s + LINE_S:
            self._line, self._line_s = result.gain, self._elapsed_s
            # No PNG: the viewer in a browser takes those that follow each other for a film, and is long in decoding it.
            self._log("line", rr.Image(palette.headline(result.gain)[:, :, 0]))
        if result.model is not None:
            self._log_models(result.frame, result.model, to_truth=result.memory is not None)

    def _log_models(self, frame: DepthFrame, model: Model, to_truth: bool) -> None:
        """The model and the even lattice's, each with its error; the truth, where it is known.

        Errors are what the line tells: to the frame, or with a memory to the truth, if that is known.
        """
        for name, error, each in (("model", "selective", model), ("even", "even", model.even)):
            if each is not None:
                self._log_depth(f"camera/{name}", _as_depth(each.depth_mm))
                error_mm = _error_mm(each, frame, to_truth)
                self._log_levels(f"camera/errors/{error}", palette.ERROR, error_mm, ~np.isnan(error_mm))
        if frame.truth_mm is not None:
            self._log_depth("camera/truth", frame.truth_mm)

    def _log_memory(self, memory: TemporalStep) -> None:
        """Age of what is known, fresh bright, and what was forgotten in this frame."""
        self._log_levels("camera/memory/age", palette.AGE, memory.age_frames, memory.known)
        changed = np.zeros_like(memory.changed) if memory.restarted else memory.changed
        self._images.classes("camera/memory/changed", changed.view(np.uint8))

    def _log_figures(self, result: FrameResult) -> None:
        self._log("figures/stages", rr.Scalars([result.stages_ms.get(name, np.nan) for name in STAGES]))
        for name in palette.FIGURES:
            if np.isfinite(value := result.figures.get(name, np.nan)):
                self._log(f"figures/{name}", rr.Scalars(value))

    def _log_frame(self, depth_mm: npt.NDArray[np.uint16], *, static: bool = False) -> None:
        self._log_depth("camera/depth", depth_mm, static=static)
        self._images.classes("camera/holes", (depth_mm == 0).view(np.uint8), opaque=True, static=static)

    def _log_depth(self, entity: str, depth_mm: npt.NDArray[np.uint16], *, static: bool = False) -> None:
        self._images.depth(entity, depth_mm, palette.DEPTH_COLOURMAP, self._limits_mm, static=static)

    def _log_levels(
        self, entity: str, scale: palette.Scale, values: npt.NDArray[np.generic], known: npt.NDArray[np.bool_]
    ) -> None:
        """Values on a scale as its levels 1..255, whose colours and meaning are classes; 0 where nothing is known.

        So a map has colours that Rerun does not know, and takes a byte a pixel.
        """
        self._images.classes(entity, np.multiply(scale.levels(values), known, dtype=np.uint8), opaque=True)


def _middle_m(depth_mm: npt.NDArray[np.uint16]) -> float:
    """Median depth in metres; 2 m without any."""
    known = depth_mm[depth_mm > 0]
    return float(np.median(known)) / 1000 if known.size else 2.0


def _as_depth(value_mm: npt.NDArray[np.float32]) -> npt.NDArray[np.uint16]:
    return np.fmax(value_mm, np.float32(0)).astype(np.uint16)  # NaN, too, is 0


def _error_mm(model: Model, frame: DepthFrame, to_truth: bool) -> npt.NDArray[np.float32]:
    """How far a model is off from its own frame, or from the truth of a frame, if that is known."""
    if not to_truth or frame.truth_mm is None:
        return model.error_mm
    seen = (frame.depth_mm > 0) & (frame.truth_mm > 0)
    return np.where(seen, np.abs(model.depth_mm - frame.truth_mm), np.float32(np.nan))


def _png(image: palette.Image) -> rr.EncodedImage:
    """A drawing, in a twentieth of its bytes."""
    return rr.EncodedImage(contents=cv2.imencode(".png", image[:, :, ::-1])[1].tobytes(), media_type="image/png")


def _closed_strips(points_uv: npt.NDArray[np.float32]) -> pa.Array:
    """Line strips of shape (n, points, 2) as the SDK holds them, without its loop over n."""
    count, length, _ = points_uv.shape
    inner = rr.encodings.Vec2DBatch(points_uv.reshape(-1, 2)).as_arrow_array()
    offsets = pa.array(np.arange(0, (count + 1) * length, length, dtype=np.int32))
    return pa.ListArray.from_arrays(offsets, inner, type=_STRIPS)


_STRIPS = rr.components.LineStrip2DBatch([]).as_arrow_array().type
