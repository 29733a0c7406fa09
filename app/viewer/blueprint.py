"""How it is laid out: the views of a run, and those of trainings of several lengths."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from selective_depth.app.pictures import palette

Part = rrb.Container | rrb.View

PICTURES = {
    "scene": ("Scene", "", "what a colour camera sees"),
    "sensor": ("1 Sensor", "depth holes", "every pixel of the frame"),
    "seeds": ("2 Seeds", "seeds", "the lattice that is measured first: all that the selectors know"),
    "gas": (
        "3a Neural gas",
        "gas/mask gas/triangles gas/nodes",
        "nodes settle on surfaces; triangles whose edges are short are the regions it selects",
    ),
    "score": ("3b Improvement", "improvement/score", "where one more measurement would help"),
    "long": ("3a Edges", "gas/complement", "the triangles that are left out, at depth discontinuities"),
    "estimate": ("3b Estimate", "improvement/estimate improvement/unknown", "kriged depth between the seeds"),
    "deviation": ("3b Deviation", "errors/expected", "how far that is expected to be off"),
    "samples": ("4 By {by}", "samples holes", "what was measured besides, where this selector wanted it, by round"),
    "known": (
        "4 Known, by age",
        "memory/age memory/changed",
        "all that is known, bright where just measured; red where forgotten",
    ),
    "even": ("5 Even lattice", "even", "the model of as many measurements, spread evenly"),
    "model": ("5 Selective", "model", "the model of those that were selected"),
    "whole": ("5 Whole frame", "depth holes", "what the sensor measures with all its pixels"),
    "truth": ("5 Truth", "truth", "what a perfect sensor would measure"),
    "even_error": ("5 Error, even", "errors/even", "how far the even lattice's model is off"),
    "error": ("5 Error, selective", "errors/selective", "how far the selective one is off, on the same scale"),
    "space": ("In space", "", "the cloud, the camera and what was measured"),
}
"""What each picture is called, the entities of the camera that are seen in it, and what it shows."""
OVER_DEPTH = ("gas", "long")
"""Pictures that lie over the frame in grey."""

COLUMNS: dict[tuple[str, bool], dict[str, float]] = {
    ("engineer", False): {"scene sensor seeds": 0.9, "long estimate deviation": 0.9, "gas score": 1, "space": 1.7},
    ("engineer", True): {
        "scene sensor seeds known|samples": 0.9,
        "long estimate deviation": 0.9,
        "gas even even_error": 1,
        "score model error": 1,
        "space whole truth colours|guide": 1,
    },
    ("visitor", False): {"scene seeds sensor": 1, "gas score": 1, "space": 1.6},
    ("visitor", True): {
        "scene|sensor known samples": 1,
        "even even_error": 1,
        "model error": 1,
        "whole truth space": 1,
    },
}
"""By layout, and whether a budget is spent: the pictures of each column, and how wide it is beside the others.

What is measured comes first, then what is wanted; with a budget, what both models are like. Those with a bar
between them share a place as tabs, and those that there are not leave no gap.
"""

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
        """Title and meaning of each picture that there is, by its key in `PICTURES`; a visitor's have no numbers."""
        scene = self.colour and "colour" not in self.hide
        there: dict[str, object] = {
            "scene": scene,
            "known": self.memory,
            "samples": self.by and not (self.visitor and self.memory),
            "whole": self.by and not self.truth,
            "truth": self.by and self.truth,
        }
        there |= dict.fromkeys(("even", "model", "even_error", "error"), self.by)
        there |= dict.fromkeys(("long", "estimate", "deviation"), self.detail and not self.visitor)
        there |= dict.fromkeys(("seeds", "gas", "score"), not (self.visitor and self.by))
        if self.visitor and scene:
            there["seeds"] = False
        return {
            key: (self._title(title), meaning) for key, (title, _, meaning) in PICTURES.items() if there.get(key, True)
        }

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

    def legend(self, limits_mm: tuple[float, float]) -> palette.Image:
        """The colours of these pictures."""
        scales, swatches = [palette.depth_scale(limits_mm)], [(palette.UNKNOWN, palette.HOLE)]
        if "gas" in self.titles:
            scales.append(palette.IMPROVEMENT)
            swatches += [
                ("kept triangles: regions selected", palette.REGION | 0xFF),
                ("neural-gas nodes", palette.NODE),
            ]
        if self.by:
            scales += [palette.ERROR, palette.AGE if self.memory else palette.round_scale(self.rounds)]
        swatches += [("forgotten in this frame", palette.FORGOTTEN | 0xFF)] * self.memory
        return palette.picture(scales, swatches, 2 if self.visitor else 1)


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
    parts: dict[Part, float] = {}
    if shown.by:
        parts[_flat("/line", "The gain", titlebar=False)] = 0.09 if shown.visitor else 0.055
    pictures = _pictures(shown, views)
    if shown.visitor:
        parts |= {pictures: 1.0, rrb.Horizontal(views["colours"], views["guide"]): 0.12}
    else:
        shares = [4.3 if shown.detail else 3.7, 1]
        parts[rrb.Horizontal(pictures, _figures(shown, views), column_shares=shares)] = 1.0
    time = rrb.TimePanel(timeline="time", play_state="following", state="collapsed")
    return _framed(rrb.Vertical(*parts, row_shares=list(parts.values())), time)


def _framed(content: Part, time: rrb.TimePanel) -> rrb.Blueprint:
    """A layout with no other panel open than the one of the time."""
    closed = rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed")
    return rrb.Blueprint(content, time, *closed, auto_views=False)


def _views(shown: Shown, look_at_m: float, limits_mm: tuple[float, float]) -> dict[str, Part]:
    """A view of each picture that there is, by its key in `PICTURES`."""
    titles = {key: title for key, (title, _) in shown.titles.items()}
    hidden, titlebar = {f"gas/{layer}" for layer in shown.hide}, not shown.visitor
    views: dict[str, Part] = {
        "colours": _flat("/legend", "Colours", titlebar=titlebar),
        "guide": rrb.TextDocumentView(origin="/guide", name="Guide", titlebar=titlebar),
    }
    for key, title in titles.items():
        if entities := [entity for entity in PICTURES[key][1].split() if entity not in hidden]:
            views[key] = _image(title, *entities, over_mm=limits_mm if key in OVER_DEPTH else None)
    if "scene" in titles:
        views["scene"] = _flat("/colour", titles["scene"])
    away_m = look_at_m * (0.4 if shown.by else 0.5)  # without a budget the view is taller than wide
    eye = rrb.EyeControls3D(
        position=(-away_m, -0.9 * away_m, look_at_m - 3 * away_m), look_target=(0, 0, look_at_m), eye_up=(0, -1, 0)
    )
    views["space"] = rrb.Spatial3DView(
        origin="/",
        contents=["/camera", *_in_space(shown)],
        name=titles["space"],
        eye_controls=eye,
        background=palette.BACKGROUND,
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


def _pictures(shown: Shown, views: dict[str, Part]) -> rrb.Horizontal:
    """Those that there are, in their `COLUMNS`."""
    columns: dict[Part, float] = {}
    layout = "visitor" if shown.visitor else "engineer"
    for places, share in COLUMNS[layout, bool(shown.by)].items():
        there = [[views[key] for key in place.split("|") if key in views] for place in places.split()]
        column = [rrb.Tabs(*tabs) if len(tabs) > 1 else tabs[0] for tabs in there if tabs]
        if column:
            columns[rrb.Vertical(*column)] = share
    return rrb.Horizontal(*columns, column_shares=list(columns.values()))


def _flat(origin: str, name: str, **options: Any) -> rrb.Spatial2DView:
    """View of what is flat, before the background that all of them have."""
    return rrb.Spatial2DView(origin=origin, name=name, background=palette.BACKGROUND, **options)


def _image(name: str, *entities: str, over_mm: tuple[float, float] | None = None) -> rrb.Spatial2DView:
    """View of entities of the camera, alone or over its depth in dim grey, given the ends of the depth scale."""
    contents = [f"/camera/{entity}" for entity in entities]
    if over_mm is None:
        return _flat("/camera", name, contents=contents)
    grey = rr.DepthImage.from_fields(colormap="grayscale", depth_range=list(palette.backdrop_limits_mm(over_mm)))
    contents += ["/camera/depth", "/camera/holes"]
    return _flat("/camera", name, contents=contents, overrides={"/camera/depth": grey})


def _figures(shown: Shown, views: dict[str, Part]) -> rrb.Vertical:
    """How the run fares: plots, each with its key beside it, and the sensor's state."""

    def plot(key: str, title: str, unit: str, names: list[str]) -> Part:
        view = rrb.TimeSeriesView(
            origin="/figures",
            contents=[f"/figures/{name}" for name in names],
            name=title,
            plot_legend=rrb.PlotLegend(visible=False),
        )
        beside = _flat(f"/keys/{key}", f"{title}: lines", titlebar=False)
        return rrb.Horizontal(view, beside, column_shares=[2.6, 1]) if unit else view

    plots = [plot("stages", "Stages", "ms", ["stages"])]
    plots += [plot(key, *of) for key, of in shown.plots.items()]
    states = [rrb.StateTimelineView(origin="/sensor/state", name="Sensor")] * shown.live
    first = [] if shown.by else [rrb.Tabs(views["colours"], views["guide"])]
    return rrb.Vertical(*first, *plots, *states)


def epoch_blueprint(limits_mm: tuple[float, float]) -> rrb.Blueprint:
    """Layout for trainings of several lengths: nodes, kept triangles and long edges, in space."""
    space = rrb.Spatial3DView(origin="/", contents=["/world/nodes", "/world/regions"], name="In space")
    error = rrb.TimeSeriesView(origin="/figures", name="Quantisation error in mm")
    image = partial(_image, over_mm=limits_mm)
    pictures = rrb.Horizontal(
        rrb.Vertical(image("Nodes", "gas/nodes"), image("Long edges", "gas/complement")),
        image("Kept triangles", "gas/mask", "gas/triangles"),
        rrb.Vertical(space, error, row_shares=[2, 1]),
    )
    return _framed(pictures, rrb.TimePanel(timeline="epoch", state="expanded"))
