"""How it is laid out: the views of a run, and those of trainings of several lengths."""

from __future__ import annotations

import rerun as rr
import rerun.blueprint as rrb

from selective_depth.app.pictures import palette as legend


def blueprint(
    *,
    by: str | None,
    detail: bool,
    memory: bool = False,
    colour: bool = False,
    coloured_cloud: bool = False,
    look_at_m: float = 2.0,
    limits_mm: tuple[float, float] = (500.0, 5000.0),
) -> rrb.Blueprint:
    """Layout of the viewer, left to right in the order of the method.

    Parameters
    ----------
    by : str or None
        What drives the shots, if a budget is spent: samples, model and error have views only then.
    memory : bool, default False
        Whether what is known lasts: its age and what was forgotten have a view then.
    detail : bool
        Whether the inner read-outs have views too.
    colour : bool, default False
        Whether there is a colour image.
    coloured_cloud : bool, default False
        Whether it lies on the depth image, so that the cloud has its colours.
    look_at_m : float, default 2.0
        Depth around which the view in space turns, in metres.
    limits_mm : tuple of float, default (500, 5000)
        Ends of the depth scale.
    """
    grey = _grey(limits_mm)
    gas = _image("3a Neural gas", "gas/mask", "gas/triangles", "gas/nodes", over=grey)
    gas_long = _image("3a Long edges", "gas/complement", over=grey)
    score = _image("3b Improvement", "improvement/score", "improvement/unknown")
    estimate = _image("3b Estimate", "improvement/estimate", "improvement/unknown")
    deviation = _image("3b Deviation", "improvement/deviation", "improvement/unknown")
    columns: list[rrb.Container | rrb.View] = [
        rrb.Vertical(
            *([rrb.Spatial2DView(origin="/colour", name="Scene", background=legend.BACKGROUND)] if colour else []),
            _image("1 Sensor", "depth", "holes"),
            _image("2 Seeds", "seeds"),
        ),
        rrb.Vertical(
            rrb.Tabs(gas, gas_long) if detail else gas, rrb.Tabs(score, estimate, deviation) if detail else score
        ),
    ]
    cloud = "/world/cloud" if coloured_cloud else "/camera/depth"
    space = ["/camera", cloud, "/world/nodes", "/world/regions", *(["/colour"] if colour else [])]
    if by is not None:
        samples = _image(f"4 Acquired by {by}", "samples", "holes")
        known = _image("4 Known, by age", "memory/age", "memory/changed")
        columns.append(
            rrb.Vertical(
                rrb.Tabs(known, samples) if memory else samples,
                rrb.Tabs(_image("5 Error", "error", "holes"), _image("5 Model", "model")),
            )
        )
        space.append("/world/samples")
    eye = rrb.EyeControls3D(
        position=(-0.5 * look_at_m, -0.45 * look_at_m, -0.45 * look_at_m),
        look_target=(0, 0, look_at_m),
        eye_up=(0, -1, 0),
    )
    columns.append(
        rrb.Spatial3DView(origin="/", contents=space, name="In space", eye_controls=eye, background=legend.BACKGROUND)
    )
    shares = [1.0] * (len(columns) - 1) + [1.6]
    return rrb.Blueprint(
        rrb.Vertical(rrb.Horizontal(*columns, column_shares=shares), _figures(memory), row_shares=[2.2, 1]),
        rrb.TimePanel(timeline="frame", play_state="following", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def _image(name: str, *entities: str, over: rr.DepthImage | None = None) -> rrb.Spatial2DView:
    """View of entities of the camera, alone or over its depth in grey."""
    contents = [f"/camera/{entity}" for entity in entities]
    return rrb.Spatial2DView(
        origin="/camera",
        contents=contents if over is None else [*contents, "/camera/depth", "/camera/holes"],
        overrides=None if over is None else {"/camera/depth": over},
        background=legend.BACKGROUND,
        name=name,
    )


def _grey(limits_mm: tuple[float, float]) -> rr.DepthImage:
    """How depth looks below something else: dim, within a wider range."""
    dim_range = list(legend.backdrop_limits_mm(limits_mm))
    return rr.DepthImage.from_fields(colormap="grayscale", depth_range=dim_range)


def _figures(memory: bool) -> rrb.Horizontal:
    """The lower row: what is seen above, and how the run fares."""

    def plot(name: str, *figures: str) -> rrb.TimeSeriesView:
        contents = [f"/figures/{figure}" for figure in figures]
        return rrb.TimeSeriesView(origin="/figures", contents=contents, name=name, plot_legend=rrb.Corner2D.LeftTop)

    errors = ("rmse_mm", "truth_rmse_mm", "sensor_rmse_mm", "even_rmse_mm")
    return rrb.Horizontal(
        rrb.TextDocumentView(origin="/guide", name="How to read it"),
        rrb.Spatial2DView(origin="/legend", name="Colours", background=legend.BACKGROUND),
        plot("Milliseconds per stage", "stages"),
        rrb.Vertical(
            plot("Rate and drops", "fps", "dropped_sensor", "dropped_viewer"),
            rrb.StateTimelineView(origin="/sensor/state", name="Sensor"),
            row_shares=[2, 1],
        ),
        plot("Errors in mm", "quantisation_error_mm", *errors),
        *([plot("Pixels, %", "measured_percent", "known_percent")] if memory else []),
        column_shares=[1.15, 1.15, 1, 0.9, 0.9, *([0.9] if memory else [])],
    )


def epoch_blueprint(limits_mm: tuple[float, float]) -> rrb.Blueprint:
    """Layout for trainings of several lengths: nodes, kept triangles and long edges, in space."""
    grey = _grey(limits_mm)
    space = rrb.Spatial3DView(origin="/", contents=["/world/nodes", "/world/regions"], name="In space")
    error = rrb.TimeSeriesView(origin="/figures", name="Quantisation error in mm")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(_image("Nodes", "gas/nodes", over=grey), _image("Long edges", "gas/complement", over=grey)),
            _image("Kept triangles", "gas/mask", "gas/triangles", over=grey),
            rrb.Vertical(space, error, row_shares=[2, 1]),
        ),
        rrb.TimePanel(timeline="epoch", state="expanded"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )
