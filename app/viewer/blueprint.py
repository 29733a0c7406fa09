"""How it is laid out: the views of a run, and those of trainings of several lengths."""

from __future__ import annotations

from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb

from selective_depth.app.pictures import palette as legend

Part = rrb.Container | rrb.View

TITLES = {
    "scene": ("Scene", "what a colour camera sees"),
    "sensor": ("1 Sensor", "every pixel of the frame"),
    "seeds": ("2 Seeds", "the lattice that is measured first: all that the selectors know"),
    "gas": ("3a Neural gas", "nodes settle on surfaces; triangles whose edges are short are the regions it selects"),
    "score": ("3b Improvement", "where one more measurement would help"),
    "long": ("3a Edges", "the triangles that are left out: steps between surfaces"),
    "estimate": ("3b Estimate", "kriged depth between the seeds"),
    "deviation": ("3b Deviation", "how far that is expected to be off"),
    "samples": ("4 By {by}", "what was measured besides, where this selector wanted it, round by round"),
    "known": ("4 Known, by age", "all that is known, bright where just measured; red where forgotten"),
    "even": ("5 Even lattice", "the model of as many measurements, spread evenly"),
    "model": ("5 Selective", "the model of those that were selected"),
    "whole": ("5 Whole frame", "what the sensor measures with all its pixels"),
    "truth": ("5 Truth", "what a perfect sensor would measure"),
    "even_error": ("5 Error, even", "how far the even lattice's model is off"),
    "error": ("5 Error, selective", "how far the selective one is off, on the same scale"),
    "space": ("In space", "the cloud, the camera and what was measured"),
}
"""What each picture is called, and what it shows."""

VISITORS_GUIDE = """\
**Both models are made of equally many measurements**: of an even lattice, and of those that a selector \
asked for, where they tell most. *Light* in an error is off by centimetres, *dark* by millimetres.
"""


@dataclass(frozen=True)
class Shown:
    """What there is to see in a run.

    Parameters
    ----------
    by : str, default ""
        What drives the shots, if a budget is spent: samples, models and errors have views only then.
    rounds : int, default 0
        In how many rounds.
    visitor : bool, default False
        Whether it is for those who come by: large pictures, no times and no figures.
    detail : bool, default False
        Whether the inner read-outs have views too.
    memory : bool, default False
        Whether what is known lasts: its age and what was forgotten have a view then.
    colour : bool, default False
        Whether there is a colour image.
    registered : bool, default False
        Whether it lies on the depth image, so that the cloud has its colours.
    truth : bool, default False
        Whether exact depth is known.
    live : bool, default False
        Whether a sensor delivers, whose state may change.
    hide : tuple of str, optional
        Layers that are not shown: colour, cloud, nodes, triangles, samples.
    """

    by: str = ""
    rounds: int = 0
    visitor: bool = False
    detail: bool = False
    memory: bool = False
    colour: bool = False
    registered: bool = False
    truth: bool = False
    live: bool = False
    hide: tuple[str, ...] = ()

    @property
    def titles(self) -> dict[str, tuple[str, str]]:
        """Title and meaning of each picture that there is, by its key in `TITLES`; a visitor's have no numbers."""
        there = {
            "scene": self.colour and "colour" not in self.hide,
            "gas": not (self.visitor and self.by),
            "known": self.memory,
            "whole": self.by and not self.truth,
            "truth": self.by and self.truth,
        } | dict.fromkeys(("samples", "even", "model", "even_error", "error"), self.by)
        there |= dict.fromkeys(("long", "estimate", "deviation"), self.detail and not self.visitor)
        there["score"] = there["seeds"] = there["gas"]
        titles = {key: words for key, words in TITLES.items() if there.get(key, True)}
        return {key: (self._title(title), meaning) for key, (title, meaning) in titles.items()}

    @property
    def plots(self) -> dict[str, tuple[str, str, list[str]]]:
        """Plots of running figures by their key: title, unit, and names out of `palette.FIGURES`."""
        errors = ["quantisation_error_mm", *["rmse_mm", "even_rmse_mm"] * bool(self.by)]
        errors += ["truth_rmse_mm", "sensor_rmse_mm"] * bool(self.by and self.truth)
        plots = {
            "fps": ("Frames/s", "", ["fps"]),
            "dropped": ("Dropped", "frames", ["dropped_sensor"] * self.live + ["dropped_viewer"]),
            "errors": ("Errors", "mm", errors),
        }
        if self.memory:
            plots["pixels"] = ("Pixels", "%", ["measured_percent", "known_percent"])
        return plots

    def _title(self, title: str) -> str:
        number, _, rest = title.partition(" ")
        told = rest if self.visitor and number[0].isdigit() else title
        return told.format(by=self.by.removesuffix(", with memory"))

    @property
    def guide(self) -> str:
        """What each picture shows, in Markdown; for visitors, what it comes to."""
        if self.visitor and self.by:
            return VISITORS_GUIDE
        lines = [
            f"- **{title}** – {meaning}"
            for key, (title, meaning) in self.titles.items()
            if not self.visitor or key in ("gas", "score")
        ]
        return "\n".join(["Measured → wanted → known.\n"] * (not self.visitor) + lines)

    def legend(self, limits_mm: tuple[float, float]) -> legend.Image:
        """The colours of these pictures."""
        scales, swatches = [legend.depth_scale(limits_mm)], [(legend.UNKNOWN, legend.HOLE)]
        if "gas" in self.titles:
            scales.append(legend.IMPROVEMENT)
            swatches += [("kept triangles: regions selected", legend.REGION | 0xFF), ("neural-gas nodes", legend.NODE)]
        if self.by:
            scales += [legend.ERROR, legend.AGE if self.memory else legend.round_scale(self.rounds)]
        swatches += [("forgotten in this frame", legend.FORGOTTEN | 0xFF)] * self.memory
        return legend.picture(scales, swatches, 2 if self.visitor else 1)


def blueprint(shown: Shown, look_at_m: float = 2.0, limits_mm: tuple[float, float] = (500.0, 5000.0)) -> rrb.Blueprint:
    """Layout of the viewer: the pictures in the order of the method, and beside them what they mean.

    Parameters
    ----------
    shown : Shown
        What there is to see.
    look_at_m : float, default 2.0
        Depth around which the view in space turns, in metres.
    limits_mm : tuple of float, default (500, 5000)
        Ends of the depth scale.
    """
    views = _views(shown, look_at_m, limits_mm)
    parts: list[Part] = [_line()] if shown.by else []
    shares = [0.09 if shown.visitor else 0.055] if shown.by else []
    if shown.visitor:
        parts += [_pictures_for_visitors(shown, views), rrb.Horizontal(*_colours(titlebar=False))]
        shares += [1.0, 0.12]
    else:
        parts.append(
            rrb.Horizontal(_pictures(shown, views), _figures(shown), column_shares=[4.3 if shown.detail else 3.7, 1])
        )
        shares.append(1.0)
    return rrb.Blueprint(
        rrb.Vertical(*parts, row_shares=shares),
        rrb.TimePanel(timeline="time", play_state="following", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def _views(shown: Shown, look_at_m: float, limits_mm: tuple[float, float]) -> dict[str, Part]:
    """A view of each picture that there is, by its key in `TITLES`."""
    grey = _grey(limits_mm)
    over = {"gas": grey, "long": grey}
    contents = {
        "sensor": ("depth", "holes"),
        "seeds": ("seeds",),
        "gas": ("gas/mask", *(f"gas/{layer}" for layer in ("triangles", "nodes") if layer not in shown.hide)),
        "score": ("improvement/score",),
        "long": ("gas/complement",),
        "estimate": ("improvement/estimate", "improvement/unknown"),
        "deviation": ("errors/expected",),
        "samples": ("samples", "holes"),
        "known": ("memory/age", "memory/changed"),
        "even": ("even",),
        "model": ("model",),
        "whole": ("depth", "holes"),
        "truth": ("truth",),
        "even_error": ("errors/even",),
        "error": ("errors/selective",),
    }
    titles = {key: title for key, (title, _) in shown.titles.items()}
    views: dict[str, Part] = {
        key: _image(titles[key], *entities, over=over.get(key)) for key, entities in contents.items() if key in titles
    }
    if "scene" in titles:
        views["scene"] = rrb.Spatial2DView(origin="/colour", name=titles["scene"], background=legend.BACKGROUND)
    away_m = look_at_m * (0.4 if shown.by else 0.5)  # without a budget the view is taller than wide
    eye = rrb.EyeControls3D(
        position=(-away_m, -0.9 * away_m, look_at_m - 3 * away_m), look_target=(0, 0, look_at_m), eye_up=(0, -1, 0)
    )
    views["space"] = rrb.Spatial3DView(
        origin="/",
        contents=["/camera", *_in_space(shown)],
        name=titles["space"],
        eye_controls=eye,
        background=legend.BACKGROUND,
    )
    return views


def _in_space(shown: Shown) -> list[str]:
    """What lies in the view in space beside the camera."""
    layers = {
        "cloud": ["/world/cloud" if shown.registered else "/camera/depth"],
        "colour": ["/colour"] * shown.colour,
        "samples": ["/world/samples"] * bool(shown.by),
    }
    if "gas" in shown.titles:
        layers |= {"nodes": ["/world/nodes"], "triangles": ["/world/regions"]}
    return [entity for layer, entities in layers.items() if layer not in shown.hide for entity in entities]


def _columns(views: dict[str, Part], *columns: tuple[str, ...]) -> list[rrb.Vertical]:
    """Pictures under each other, in columns; those that are not there leave no gap."""
    return [rrb.Vertical(*(views[key] for key in column if key in views)) for column in columns]


def _pictures(shown: Shown, views: dict[str, Part]) -> rrb.Horizontal:
    """All of them: what is measured, then wanted; with a budget, what both models are like below."""
    inner = [("long", "estimate", "deviation")] * shown.detail
    if not shown.by:
        columns = _columns(views, ("scene", "sensor", "seeds"), *inner, ("gas", "score"), ("space",))
        return rrb.Horizontal(*columns, column_shares=[0.9, *[0.9] * len(inner), 1, 1.7])
    if "known" in views:
        views["samples"] = rrb.Tabs(views["known"], views["samples"])
    views["colours"] = rrb.Tabs(*_colours())
    last = "truth" if shown.truth else "whole"
    columns = _columns(
        views,
        ("scene", "sensor", "seeds", "samples"),
        *inner,
        ("gas", "even", "even_error"),
        ("score", "model", "error"),
        ("space", last, "colours"),
    )
    return rrb.Horizontal(*columns, column_shares=[0.9, *[0.9] * len(inner), 1, 1, 1])


def _pictures_for_visitors(shown: Shown, views: dict[str, Part]) -> rrb.Horizontal:
    """Few and large: the two models side by side, or without a budget what the selectors find."""
    if not shown.by:
        columns = _columns(views, ("scene" if "scene" in views else "seeds", "sensor"), ("gas", "score"), ("space",))
        return rrb.Horizontal(*columns, column_shares=[1, 1, 1.6])
    if "scene" in views:
        views["sensor"] = rrb.Tabs(views["scene"], views["sensor"])
    taken, last = "known" if shown.memory else "samples", "truth" if shown.truth else "whole"
    return rrb.Horizontal(
        *_columns(views, ("sensor", taken), ("even", "even_error"), ("model", "error"), (last, "space"))
    )


def _line() -> rrb.Spatial2DView:
    return rrb.Spatial2DView(origin="/line", name="The gain", titlebar=False, background=legend.BACKGROUND)


def _colours(titlebar: bool = True) -> list[rrb.View]:
    """The legend and the guide."""
    colours = rrb.Spatial2DView(origin="/legend", name="Colours", background=legend.BACKGROUND, titlebar=titlebar)
    return [colours, rrb.TextDocumentView(origin="/guide", name="Guide", titlebar=titlebar)]


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


def _figures(shown: Shown) -> rrb.Vertical:
    """How the run fares: plots, each with its key beside it, and the sensor's state."""

    def plot(key: str, title: str, unit: str, names: list[str]) -> Part:
        view = rrb.TimeSeriesView(
            origin="/figures",
            contents=[f"/figures/{name}" for name in names],
            name=title,
            plot_legend=rrb.PlotLegend(visible=False),
        )
        beside = rrb.Spatial2DView(origin=f"/keys/{key}", titlebar=False, name=f"{title}: lines",
                                   background=legend.BACKGROUND)  # fmt: skip
        return rrb.Horizontal(view, beside, column_shares=[2.6, 1]) if unit else view

    plots = [plot("stages", "Stages", "ms", ["stages"])]
    plots += [plot(key, *of) for key, of in shown.plots.items()]
    states = [rrb.StateTimelineView(origin="/sensor/state", name="Sensor")] * shown.live
    first = [] if shown.by else [rrb.Tabs(*_colours())]
    return rrb.Vertical(*first, *plots, *states)


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
