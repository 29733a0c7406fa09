"""How it is laid out: the views of a run, and those of trainings of several lengths."""

from __future__ import annotations

import rerun as rr
import rerun.blueprint as rrb

from selective_depth.app.pictures import palette as legend


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
