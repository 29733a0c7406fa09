"""Everything in Rerun: what is logged, how it is laid out, and where it goes."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import socket
import tempfile
import time
from collections.abc import Iterable
from contextlib import ExitStack
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Self

import cv2
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb

from selective_depth.app.console import interrupt
from selective_depth.app.console.errors import UsageError, ViewerError
from selective_depth.app.console.output import cannot_write
from selective_depth.app.pictures import palette as legend
from selective_depth.app.pipeline import STAGES, FrameResult, SensorNote
from selective_depth.app.settings import ViewerOptions
from selective_depth.drivers.errors import OutputError
from selective_depth.drivers.frame import Camera, DepthFrame
from selective_depth.selectors.neural_gas import RegionSelection

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

APPLICATION = "selective-depth"
_MAGIC = b"RRF2"
DEPTH_COLOURS = legend.palette(legend.DEPTH_COLOURMAP)
LOAD_S = 5.0
"""How long a viewer may show nothing while it is loading nothing."""
PAINT_S = 30.0
"""How long it may take to paint what it has loaded."""
WRITE_S = 3.0
"""A file that has not grown for so long while it should has failed."""
SMALL_BYTES = 256 << 10
"""Less than an image of 640x480: an image makes a chunk, while small things are gathered."""
CENTRE = np.float32(0.5)
"""Rerun puts pixel centres at halves, we at whole numbers."""


# What is logged


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
        self._start_us: int | None = None
        self._state = ""
        self._limits_mm = (0.0, 1.0)

    def log(self, step: FrameResult) -> None:
        """Log a step under its frame's number and time."""
        if self._start_us is None:
            self._start_us = step.frame.timestamp_us
            self._log_static(step)
        self._stream.set_time("frame", sequence=step.frame.index)
        elapsed_us = step.frame.timestamp_us - self._start_us
        self._stream.set_time("time", duration=elapsed_us / 1e6)
        self._log_sensor(step)
        self._log_gas(step.regions)
        self._log_improvement(step)
        self._log_acquisition(step)
        self._log_figures(step)

    def log_trainings(
        self, frame: DepthFrame, trainings: Iterable[tuple[int, RegionSelection]]
    ) -> None:
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
            self._log_gas(regions)
            error = rr.Scalars(regions.quantisation_error_mm)
            self._stream.log("figures/quantisation_error_mm", error)

    def log_state(self, state: str) -> None:
        """Log the sensor's state, if it has changed, under the time of the last step."""
        if state != self._state and self._start_us is not None:
            self._state = state
            self._stream.log("sensor/state", rr.StateChange(state=state))

    def _log_static(self, step: FrameResult) -> None:
        camera, log, options = step.frame.camera, self._stream.log, self._options
        near, far = legend.depth_limits_mm(step.frame.depth_mm)
        near = near if options.near_mm is None else options.near_mm
        far = far if options.far_mm is None else options.far_mm
        self._limits_mm = (float(near), float(max(far, near + 1)))
        layout = blueprint(
            acquiring=step.acquisition is not None,
            detail=options.detail,
            look_at_m=_middle_m(step.frame.depth_mm),
            limits_mm=self._limits_mm,
        )
        self._stream.send_blueprint(layout, make_default=True)
        self._stream.send_recording_name(step.frame.source or "depth")
        self._log_camera(camera)
        pixels = step.seeds.lattice_uv.reshape(-1, 2) + CENTRE
        log("camera/seeds", rr.Points2D.from_fields(positions=pixels, radii=1.6), static=True)
        self._log_classes()
        rounds = 0 if step.acquisition is None else int(step.acquisition.round.max(initial=0))
        log("legend", rr.Image(legend.picture(self._limits_mm, rounds)), static=True)
        log("guide", rr.TextDocument(legend.HOW_TO_READ, media_type="text/markdown"), static=True)
        states = rr.StateConfiguration(
            values=list(legend.STATE_COLOURS),
            labels=list(legend.STATE_COLOURS),
            colors=list(legend.STATE_COLOURS.values()),
        )
        log("sensor/state", states, static=True)
        stages = rr.SeriesLines(names=list(STAGES), colors=list(legend.STAGE_COLOURS))
        log("figures/stages", stages, static=True)
        for name, (label, colour) in legend.FIGURES.items():
            log(f"figures/{name}", rr.SeriesLines(names=label, colors=colour), static=True)

    def _log_camera(self, camera: Camera) -> None:
        log = self._stream.log
        log("/", rr.ViewCoordinates.RDF, static=True)
        pinhole = rr.Pinhole(
            resolution=[camera.width, camera.height],
            focal_length=[camera.fx, camera.fy],
            principal_point=[camera.cx + CENTRE, camera.cy + CENTRE],
            image_plane_distance=0.3,
        )
        log("camera", pinhole, static=True)

    def _log_classes(self) -> None:
        log = self._stream.log
        nothing = (0, "", (0, 0, 0, 0))
        hole = (1, legend.UNKNOWN, legend.HOLE)
        kept, long = (1, "kept triangles", legend.REGION), (2, "long edges", legend.LONG_EDGE)
        # A class means what the nearest context above says: one for all, one for the regions.
        log("camera", rr.AnnotationContext([nothing, hole]), static=True)
        log("camera/gas", rr.AnnotationContext([nothing, kept, long]), static=True)

    def _log_sensor(self, step: FrameResult) -> None:
        log, depth_mm, seeds = self._stream.log, step.frame.depth_mm, step.seeds
        log("camera/depth", self._depth_image(depth_mm))
        log("camera/holes", rr.SegmentationImage((depth_mm == 0).view(np.uint8), opacity=1.0))
        near, far = self._limits_mm
        level = np.clip((seeds.depth_mm.ravel() - near) * (255 / (far - near)), 0, 255)
        colours = np.where(
            seeds.valid.ravel(), DEPTH_COLOURS[level.astype(np.uint8)], np.uint32(legend.HOLE)
        )
        log("camera/seeds", rr.Points2D.from_fields(colors=colours))
        self.log_state(step.state)

    def _log_gas(self, regions: RegionSelection) -> None:
        log = self._stream.log
        log("camera/gas/mask", rr.SegmentationImage(regions.mask.view(np.uint8)))
        if self._options.detail:
            complement = rr.SegmentationImage(regions.complement.astype(np.uint8) * 2)
            log("camera/gas/complement", complement)
        nodes_uv, kept = regions.nodes_uv + CENTRE, regions.triangles[regions.kept]
        outlines = nodes_uv[kept[:, (0, 1, 2, 0)]]
        strips = rr.LineStrips2D(_closed_strips(outlines), colors=legend.MESH, radii=0.35)
        log("camera/gas/triangles", strips)
        log("camera/gas/nodes", rr.Points2D(nodes_uv, colors=legend.NODE, radii=1.4))
        nodes_m = regions.nodes_mm * np.float32(0.001)
        log("world/nodes", rr.Points3D(nodes_m, colors=legend.NODE, radii=-1.5))
        mesh = rr.Mesh3D(
            vertex_positions=nodes_m, triangle_indices=kept, albedo_factor=legend.REGION
        )
        log("world/regions", mesh)

    def _log_improvement(self, step: FrameResult) -> None:
        log, improvement = self._stream.log, step.improvement
        known = improvement.known
        log("camera/improvement/score", _map_image(improvement.score, legend.IMPROVEMENT, known))
        log(
            "camera/improvement/unknown", rr.SegmentationImage((~known).view(np.uint8), opacity=1.0)
        )
        if self._options.detail:
            log(
                "camera/improvement/estimate", self._depth_image(_as_depth(improvement.estimate_mm))
            )
            deviation_mm = np.sqrt(np.where(known, improvement.variance_mm2, 0))
            image = _map_image(deviation_mm, legend.ERROR, known)
            log("camera/improvement/deviation", image)

    def _log_acquisition(self, step: FrameResult) -> None:
        log, acquisition = self._stream.log, step.acquisition
        if acquisition is None:
            return
        shot = acquisition.round > 0
        uv, depth_mm, rounds = (
            array[shot] for array in (acquisition.uv, acquisition.depth_mm, acquisition.round)
        )
        colours = legend.round_colours(int(rounds.max(initial=0)))[rounds]
        log("camera/samples", rr.Points2D(uv + CENTRE, colors=colours, radii=0.9))
        hit = depth_mm > 0
        points_m = step.frame.camera.points_mm(uv[hit], depth_mm[hit]) * np.float32(0.001)
        log("world/samples", rr.Points3D(points_m, colors=colours[hit], radii=-1.5))
        if step.model is not None:
            log("camera/model", self._depth_image(_as_depth(step.model.depth_mm)))
            error_mm = step.model.error_mm
            known = ~np.isnan(error_mm)
            log("camera/error", _map_image(error_mm, legend.ERROR, known))

    def _log_figures(self, step: FrameResult) -> None:
        log = self._stream.log
        log("figures/stages", rr.Scalars([step.stages_ms.get(name, np.nan) for name in STAGES]))
        for name, value in step.figures.items():
            if np.isfinite(value):
                log(f"figures/{name}", rr.Scalars(value))

    def _depth_image(self, depth_mm: npt.NDArray[np.uint16]) -> rr.DepthImage:
        return rr.DepthImage(
            depth_mm,
            meter=1000.0,
            colormap=legend.DEPTH_COLOURMAP,
            depth_range=list(self._limits_mm),
        )


def _middle_m(depth_mm: npt.NDArray[np.uint16]) -> float:
    """Median depth in metres; 2 m without any."""
    known = depth_mm[depth_mm > 0]
    return float(np.median(known)) / 1000 if known.size else 2.0


def _as_depth(value_mm: npt.NDArray[np.float32]) -> npt.NDArray[np.uint16]:
    return np.where(value_mm > 0, value_mm, np.float32(0)).astype(np.uint16)


def _map_image(
    value: npt.NDArray[np.float32], scale: legend.Scale, known: npt.NDArray[np.bool_]
) -> rr.DepthImage:
    """Values on a scale from 0 as a coloured 8-bit image: 1..255, and 0 where nothing is known."""
    # Saturates in one pass; what it makes of a NaN does not matter, that is nowhere known.
    levels = np.asarray(cv2.convertScaleAbs(value, alpha=254 / scale.limits[1], beta=1))
    np.multiply(levels, known, out=levels)
    return rr.DepthImage(levels, colormap=scale.colormap, depth_range=[1.0, 255.0])


def _closed_strips(points_uv: npt.NDArray[np.float32]) -> pa.Array:
    """Line strips of shape (n, points, 2) as the SDK holds them, without its loop over n."""
    count, length, _ = points_uv.shape
    inner = rr.encodings.Vec2DBatch(points_uv.reshape(-1, 2)).as_arrow_array()
    offsets = pa.array(np.arange(0, (count + 1) * length, length, dtype=np.int32))
    return pa.ListArray.from_arrays(offsets, inner, type=_STRIPS)


_STRIPS = rr.components.LineStrip2DBatch([]).as_arrow_array().type


# How it is laid out


def blueprint(
    *,
    acquiring: bool,
    detail: bool,
    look_at_m: float = 2.0,
    limits_mm: tuple[float, float] = (500.0, 5000.0),
) -> rrb.Blueprint:
    """Layout of the viewer, left to right in the order of the method.

    Parameters
    ----------
    acquiring : bool
        Whether a budget is spent: samples, model and error have views only then.
    detail : bool
        Whether the inner read-outs have views too.
    look_at_m : float, default 2.0
        Depth around which the view in space turns, in metres.
    limits_mm : tuple of float, default (500, 5000)
        Ends of the depth scale.
    """

    dim_range = list(legend.backdrop_limits_mm(limits_mm))

    def image(name: str, *entities: str, backdrop: bool = False) -> rrb.Spatial2DView:
        contents = [f"/camera/{entity}" for entity in entities]
        grey = rr.DepthImage.from_fields(colormap="grayscale", depth_range=dim_range)
        return rrb.Spatial2DView(
            origin="/camera",
            contents=contents + ["/camera/depth", "/camera/holes"] * backdrop,
            overrides={"/camera/depth": grey} if backdrop else None,
            background=legend.BACKGROUND,
            name=name,
        )

    gas = image("3a Neural gas", "gas/mask", "gas/triangles", "gas/nodes", backdrop=True)
    gas_long = image("3a Long edges", "gas/complement", backdrop=True)
    score = image("3b Improvement", "improvement/score", "improvement/unknown")
    estimate = image("3b Estimate", "improvement/estimate", "improvement/unknown")
    deviation = image("3b Deviation", "improvement/deviation", "improvement/unknown")
    columns: list[rrb.Container | rrb.View] = [
        rrb.Vertical(image("1 Sensor", "depth", "holes"), image("2 Seeds", "seeds")),
        rrb.Vertical(
            rrb.Tabs(gas, gas_long) if detail else gas,
            rrb.Tabs(score, estimate, deviation) if detail else score,
        ),
    ]
    space = ["/camera", "/camera/depth", "/world/nodes", "/world/regions"]
    if acquiring:
        columns.append(
            rrb.Vertical(
                image("4 Acquired", "samples", "holes"),
                rrb.Tabs(image("5 Error", "error", "holes"), image("5 Model", "model")),
            )
        )
        space.append("/world/samples")
    eye = rrb.EyeControls3D(
        position=(-0.5 * look_at_m, -0.45 * look_at_m, -0.45 * look_at_m),
        look_target=(0, 0, look_at_m),
        eye_up=(0, -1, 0),
    )
    columns.append(
        rrb.Spatial3DView(
            origin="/",
            contents=space,
            name="In space",
            eye_controls=eye,
            background=legend.BACKGROUND,
        )
    )

    def plot(name: str, *figures: str) -> rrb.TimeSeriesView:
        contents = [f"/figures/{figure}" for figure in figures]
        return rrb.TimeSeriesView(
            origin="/figures", contents=contents, name=name, plot_legend=rrb.Corner2D.LeftTop
        )

    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(*columns, column_shares=[1.0] * (len(columns) - 1) + [1.6]),
            rrb.Horizontal(
                rrb.TextDocumentView(origin="/guide", name="How to read it"),
                rrb.Spatial2DView(origin="/legend", name="Colours", background=legend.BACKGROUND),
                plot("Milliseconds per stage", "stages"),
                rrb.Vertical(
                    plot("Rate and drops", "fps", "dropped_sensor", "dropped_viewer"),
                    rrb.StateTimelineView(origin="/sensor/state", name="Sensor"),
                    row_shares=[2, 1],
                ),
                plot("Errors in mm", "quantisation_error_mm", "rmse_mm"),
                column_shares=[1.15, 1.15, 1, 0.9, 0.9],
            ),
            row_shares=[2.2, 1],
        ),
        rrb.TimePanel(timeline="frame", play_state="following", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def epoch_blueprint(limits_mm: tuple[float, float]) -> rrb.Blueprint:
    """Layout for trainings of several lengths: nodes, kept triangles and long edges, in space."""
    grey = rr.DepthImage.from_fields(
        colormap="grayscale", depth_range=list(legend.backdrop_limits_mm(limits_mm))
    )

    def image(name: str, *entities: str) -> rrb.Spatial2DView:
        contents = ["/camera/depth", "/camera/holes", *(f"/camera/gas/{name}" for name in entities)]
        return rrb.Spatial2DView(
            origin="/camera", contents=contents, overrides={"/camera/depth": grey}, name=name
        )

    space = rrb.Spatial3DView(
        origin="/", contents=["/world/nodes", "/world/regions"], name="In space"
    )
    error = rrb.TimeSeriesView(origin="/figures", name="Quantisation error in mm")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(image("Nodes", "nodes"), image("Long edges", "complement")),
            image("Kept triangles", "mask", "triangles"),
            rrb.Vertical(space, error, row_shares=[2, 1]),
        ),
        rrb.TimePanel(timeline="epoch", state="expanded"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def save_trainings(
    path: Path, frame: DepthFrame, trainings: Iterable[tuple[int, RegionSelection]]
) -> None:
    """Write an .rrd of one frame's regions after trainings of several lengths.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    try:
        with path.open("wb"):
            pass
    except OSError as error:
        raise cannot_write(path, error) from None
    never_wait_at_exit()
    recording = Recording.to_file(path, ViewerOptions(detail=True), index=True)
    recording.log_trainings(frame, trainings)
    if not recording.is_written(path):
        recording.abandon()
        if path.is_file():
            path.unlink()
        raise OutputError(
            f"writing '{path}' failed. Check the disk and its quota, and run it again."
        )
    recording.finish()


# Where it goes


class Recording:
    """A recording stream with one sink; whoever made it is the only thread to use it.

    Each sink has a stream of its own: what befalls one must not touch another.

    Parameters
    ----------
    target : rr.FileSink, rr.GrpcSink or rr.GrpcServerSink
        Where it goes; use `to_file`, `to_viewer` or `to_server`.
    options : ViewerOptions
        What the user asked to see.
    batching : rr.ChunkBatcherConfig, optional
        How rows are put together before they are sent; by default at once, for a viewer.
    """

    def __init__(
        self,
        target: rr.FileSink | rr.GrpcSink | rr.GrpcServerSink,
        options: ViewerOptions,
        batching: rr.ChunkBatcherConfig | None = None,
    ) -> None:
        self._stream = rr.RecordingStream(APPLICATION, batcher_config=batching)
        self._stream.set_sinks(target)
        # The SDK imports half of what it needs at first use, which takes it up to a second:
        # that is now, and not while the first frames come.
        blueprint(acquiring=True, detail=True)
        self._logger = StepLogger(self._stream, options)

    @classmethod
    def to_file(cls, path: Path, options: ViewerOptions, *, index: bool) -> Self:
        """Write an .rrd, with an index at its end or without.

        The index makes files quicker to open, but the SDK gathers it in memory, chunk by chunk:
        some 60 MB for 1,000 frames where every image is a chunk, 3 MB with up to 1 MiB in each.
        Without one, it is the images waiting for such a chunk to fill that cost memory, 50 MB
        instead of 17: then each goes by itself. Neither makes saving faster or slower.
        """
        batching = rr.ChunkBatcherConfig(
            flush_tick=timedelta(seconds=1), flush_num_bytes=1 << 20 if index else SMALL_BYTES
        )
        return cls(rr.FileSink(str(path), write_footer=index), options, batching)

    @classmethod
    def to_viewer(cls, url: str, options: ViewerOptions) -> Self:
        """Send to a viewer that listens; where none does, this blocks for 5 s."""
        return cls(rr.GrpcSink(url), options)

    @classmethod
    def to_server(cls, host: str, port: int, options: ViewerOptions) -> Self:
        """Serve viewers that join."""
        sink = rr.GrpcServerSink(host, port, server_memory_limit=options.serve_memory)
        return cls(sink, options)

    def log(self, item: FrameResult | SensorNote) -> None:
        """Log a step, or the sensor's state."""
        if isinstance(item, SensorNote):
            self._logger.log_state(item.state)
        else:
            self._logger.log(item)

    def log_trainings(
        self, frame: DepthFrame, trainings: Iterable[tuple[int, RegionSelection]]
    ) -> None:
        """Log one frame's regions after trainings of several lengths."""
        self._logger.log_trainings(frame, trainings)

    def flush(self, timeout_s: float = 1e9) -> bool:
        """Wait until everything is sent or written; False if it is not, in time or for good."""
        try:
            self._stream.flush(timeout_sec=timeout_s)
        except RuntimeError:
            return False
        return True

    def is_written(self, path: Path, patience_s: float = WRITE_S) -> bool:
        """Wait until everything is in its file; False if that does not grow while it should.

        The SDK's writer says nothing when a write fails, and never ends after it.
        """
        size = path.stat().st_size
        while not self.flush(patience_s):
            before, size = size, path.stat().st_size
            if size == before:
                return False
        return True

    def finish(self) -> None:
        """End it, with its index. Only after a `flush` that worked: else it waits for ever."""
        self._stream.disconnect()

    def abandon(self) -> None:
        """Give up on a sink that died.

        The SDK waits for ever for such a sink when its stream is destroyed, so it never is.
        """
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._stream))


def never_wait_at_exit() -> None:
    """Keep the SDK from waiting, when the program ends, for sinks that have died."""
    rr.unregister_shutdown()


def open_window(port: int, memory: str) -> None:
    """Start a viewer window that listens on a port and outlives this program.

    Raises
    ------
    ViewerError
        If it does not start.
    """
    try:
        rr.spawn(
            port=port,
            connect=False,
            memory_limit=memory,
            hide_welcome_screen=True,
            executable_path=viewer_executable(),
        )
    except RuntimeError as error:
        raise ViewerError(
            f"the viewer window does not start ({str(error).splitlines()[0]}). Use --headless"
            " --save FILE.rrd, and open the file elsewhere."
        ) from None


def viewer_executable() -> str | None:
    """The viewer that came with the SDK; None to search the PATH."""
    package = importlib.util.find_spec("rerun_cli")
    if package is None or package.origin is None:
        return None
    native = Path(package.origin).with_name("rerun.exe" if os.name == "nt" else "rerun")
    return str(native) if native.exists() else None


# Pictures of it


def screenshot(recording: Path, frame: int | None = None) -> npt.NDArray[np.uint8]:
    """Show a recording in an invisible viewer and take its picture.

    Parameters
    ----------
    recording : Path
        An .rrd that `--save` wrote.
    frame : int, optional
        Frame to show; default the last.

    Returns
    -------
    uint8 array of shape (1080, 1920, 3)
        The window, blue-green-red.

    Raises
    ------
    UsageError
        If the recording has no such frame.
    ViewerError
        If there is no such recording, or the viewer does not run here; it needs a graphics driver
        (Mesa's lavapipe will do).
    """
    from rerun.experimental import ViewerClient

    try:
        with recording.open("rb") as file:
            magic = file.read(len(_MAGIC))
    except OSError as error:
        raise ViewerError(f"'{recording}' cannot be shown: {error.strerror}.") from None
    if magic != _MAGIC:
        raise ViewerError(
            f"'{recording}' is no Rerun recording; 'selective-depth replay SOURCE --save"
            " FILE.rrd' makes one."
        )
    # The viewer complains on the terminal where there is none, as on a server.
    os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.gettempdir())
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = int(free.getsockname()[1])
    with ExitStack() as stack:
        try:
            with interrupt.deferred():
                client = ViewerClient.spawn(
                    headless=True,
                    port=port,
                    hide_welcome_screen=True,
                    executable_path=viewer_executable(),
                )
                stack.callback(client.quit)
        except RuntimeError as error:
            raise ViewerError(
                f"the viewer does not start ({str(error).splitlines()[0]}). Install a graphics"
                " driver: apt-get install mesa-vulkan-drivers libvulkan1."
            ) from None
        _load(client, recording, frame)
        return _settled_picture(client)


def _load(client: ViewerClient, recording: Path, frame: int | None) -> None:
    """Open a recording in a viewer and wait until all of it is there, at a frame if asked."""
    client.open(str(recording.resolve()))
    deadline_s = time.monotonic() + LOAD_S
    while True:
        state = client.get_state()
        shown = [each for each in state.recordings if each.store_id == state.active_recording]
        if shown and not state.loading:
            break
        if state.loading:
            deadline_s = time.monotonic() + LOAD_S
        elif time.monotonic() > deadline_s:
            raise ViewerError(f"the viewer finds nothing to show in '{recording}'.")
        time.sleep(0.1)
    if frame is None:
        return
    spans = {each.name: (each.start, each.end) for each in shown[0].timelines}
    first, last = spans.get("frame", (None, None))
    if first is None or last is None:
        raise UsageError(f"--frame is {frame}, but '{recording}' has no frames, only other times.")
    if not first <= frame <= last:
        raise UsageError(f"--frame is {frame}; the frames of '{recording}' are {first}..{last}.")
    client.set_time("frame", sequence=frame, play_state="paused")  # else it plays on to the end


def _settled_picture(client: ViewerClient) -> npt.NDArray[np.uint8]:
    """The viewer's window, once it does not change any more: it tells nobody when it is done."""
    deadline_s = time.monotonic() + PAINT_S
    before, now = b"", client.take_screenshot()
    while now != before and time.monotonic() < deadline_s:
        time.sleep(0.5)
        before, now = now, client.take_screenshot()
    taken = cv2.imdecode(np.frombuffer(now, np.uint8), cv2.IMREAD_COLOR)
    if taken is None:
        raise ViewerError("the viewer made no picture. Look at the recording with 'rerun' instead.")
    return np.asarray(taken, dtype=np.uint8)
