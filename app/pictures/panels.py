"""One panel of a picture for each stage of a frame: what is shown, and how."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from selective_depth.app.pictures import palette
from selective_depth.app.pictures.palette import Image, Scale
from selective_depth.app.pipeline import FrameResult, Model
from selective_depth.drivers.frame import DepthFrame
from selective_depth.selectors.acquire import Acquisition
from selective_depth.selectors.improvement import ImprovementSelection
from selective_depth.selectors.neural_gas import RegionSelection

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Panel:
    """A picture with its caption and, where colours carry numbers, their scale.

    Parameters
    ----------
    name : str
        For file names.
    caption : str
        Above it.
    image : uint8 array of shape (height, width, 3)
        A colour for each pixel of the frame.
    scale : Scale or None
        What the colours mean.
    note : str
        Below it.
    overlay : callable or None
        Draws on the axes, in pixels of the frame, what is finer than these.
    marks : tuple of str, default ("hole",)
        What of `sheets.MARKS` a legend has to explain.
    """

    name: str
    caption: str
    image: Image
    scale: Scale | None = None
    note: str = ""
    overlay: Callable[[Axes], None] | None = None
    marks: tuple[str, ...] = ("hole",)


def with_holes(image: Image, hole: npt.NDArray[np.bool_]) -> Image:
    """An image with its holes in their own colour, which no scale contains."""
    image[hole] = palette.channels(palette.HOLE)
    return image


def backdrop(frame: DepthFrame) -> Image:
    """The frame in dim grey, to draw on."""
    black, white = palette.backdrop_limits_mm(palette.depth_limits_mm(frame.depth_mm))
    grey = np.clip((frame.depth_mm - black) * (255 / (white - black)), 0, 255).astype(np.uint8)
    return with_holes(np.repeat(grey[:, :, None], 3, axis=2), frame.depth_mm == 0)


def _scene_note(frame: DepthFrame) -> str:
    """How wide a part of the scene the frame shows at its median depth."""
    known = frame.depth_mm[frame.depth_mm > 0]
    if known.size == 0:
        return ""
    median_m = float(np.median(known)) / 1000
    return f"{frame.camera.width * median_m / frame.camera.fx:.2f} m wide at {median_m:.2f} m"


def depth_panel(frame: DepthFrame, caption: str = "Depth") -> Panel:
    """What the sensor sees."""
    scale = palette.depth_scale(palette.depth_limits_mm(frame.depth_mm))
    image = with_holes(scale.colour(frame.depth_mm / np.float32(1000)), frame.depth_mm == 0)
    return Panel("depth", caption, image, scale, _scene_note(frame))


def scene_panel(frame: DepthFrame) -> Panel | None:
    """What the colour camera saw; None where there was none."""
    if frame.colour is None:
        return None
    height, width = frame.shape
    image = cv2.resize(frame.colour, (width, height), interpolation=cv2.INTER_AREA)
    return Panel("scene", "Scene", np.asarray(image), note="" if frame.registered else "not registered to depth",
                 marks=())  # fmt: skip


def shaded_panel(frame: DepthFrame, caption: str = "Scene", note: str = "") -> Panel:
    """The surfaces of a frame lit from the upper left."""
    from matplotlib.colors import LightSource

    known = frame.depth_mm > 0
    mm_per_pixel = float(np.median(frame.depth_mm[known])) / frame.camera.fx if known.any() else 1
    near_mm = -cv2.GaussianBlur(frame.depth_mm.astype(np.float32), (0, 0), 1.5)
    light = LightSource(315, 45).hillshade(near_mm, dx=mm_per_pixel, dy=mm_per_pixel)
    grey = (60 + 190 * light).astype(np.uint8)
    image = with_holes(np.repeat(grey[:, :, None], 3, axis=2), ~known)
    return Panel("shaded", caption, image, note=note)


def draw_nodes(axes: Axes, regions: RegionSelection) -> None:
    """Draw the nodes of a neural gas."""
    u, v = regions.nodes_uv.T
    axes.plot(u, v, ".", color=hexadecimal(palette.NODE), markersize=2.2, markeredgewidth=0)


def draw_kept_triangles(axes: Axes, regions: RegionSelection) -> None:
    """Draw the outlines of the triangles that are kept."""
    from matplotlib.collections import PolyCollection

    corners = list(regions.nodes_uv[regions.triangles[regions.kept]])
    edge = hexadecimal(palette.MESH)
    axes.add_collection(PolyCollection(corners, facecolors="none", edgecolors=edge, linewidths=0.4))


def tinted(image: Image, mask: npt.NDArray[np.bool_]) -> Image:
    """An image with the selected regions in their colour, as translucent as in the viewer."""
    share = np.float32((palette.REGION & 0xFF) / 255)
    colour = palette.channels(palette.REGION).astype(np.float32)
    image[mask] = (share * colour + (1 - share) * image[mask]).astype(np.uint8)
    return image


def regions_panel(frame: DepthFrame, regions: RegionSelection) -> Panel:
    """The neural gas's nodes and the triangles that the published rule keeps."""

    def overlay(axes: Axes) -> None:
        draw_kept_triangles(axes, regions)
        draw_nodes(axes, regions)

    image = tinted(backdrop(frame), regions.mask)
    note = f"{len(regions.nodes_uv):,} nodes, {regions.mask.mean():.0%} kept"
    return Panel("neural-gas", "Neural gas regions", image, note=note, overlay=overlay, marks=("hole", "kept", "node"))


def improvement_panel(improvement: ImprovementSelection) -> Panel:
    """The improvement map; grey where no sample is near enough to say anything."""
    image = with_holes(palette.IMPROVEMENT.colour(improvement.score), ~improvement.known)
    return Panel("improvement", "Improvement map", image, palette.IMPROVEMENT, "eq. (23)")


def shots_panel(
    frame: DepthFrame, uv: npt.NDArray[np.integer], rounds: npt.NDArray[np.integer], caption: str, note: str = ""
) -> Panel:
    """Where measurements were taken, by round; those of round 0, the seeds, are not drawn."""
    image = backdrop(frame)
    last = max(int(rounds.max(initial=1)), 1)
    taken = rounds > 0
    colours = palette.channels(palette.round_colours(last))
    image[uv[taken, 1], uv[taken, 0]] = colours[rounds[taken].astype(int)]
    return Panel("acquired", caption, image, palette.round_scale(last) if last > 1 else None, note)


def samples_panel(frame: DepthFrame, acquisition: Acquisition) -> Panel:
    """Where the budget went, by round."""
    share = float((acquisition.round > 0).sum()) / frame.depth_mm.size
    by = acquisition.by.removesuffix(", with memory")
    return shots_panel(frame, acquisition.uv, acquisition.round, f"By {by}", f"{share:.1%} of the pixels, by round")


def error_panel(frame: DepthFrame, model_mm: npt.NDArray[np.float32], caption: str, name: str = "error") -> Panel:
    """How far a model, in millimetres, is from the full frame."""
    hole = frame.depth_mm == 0
    error_mm = np.abs(model_mm - frame.depth_mm.astype(np.float32))
    image = with_holes(palette.ERROR.colour(error_mm), hole)
    known = error_mm[~hole] if not hole.all() else np.zeros(1)
    note = f"RMSE {np.sqrt(np.mean(known**2)):.1f}, MAE {np.mean(known):.1f} mm"
    return Panel(name, caption, image, palette.ERROR, note)


def panels_of(result: FrameResult) -> list[Panel]:
    """Every panel of a frame, left to right: with a budget, the error of an even lattice's model and of its own too."""
    frame, acquisition = result.frame, result.acquisition
    scene = scene_panel(frame)
    shown = [scene] if scene is not None else []
    shown += [depth_panel(frame), regions_panel(frame, result.regions), improvement_panel(result.improvement)]
    if acquisition is None:
        return shown
    shown.append(samples_panel(frame, acquisition))
    even_mm = Model.of_even(frame, len(acquisition.uv)).depth_mm
    selective_mm = acquisition.reconstruct() if result.model is None else result.model.depth_mm
    if result.memory is not None and frame.truth_mm is not None:  # which its errors are held against
        frame = replace(frame, depth_mm=np.where(frame.depth_mm > 0, frame.truth_mm, np.uint16(0)))
    return [
        *shown,
        error_panel(frame, even_mm, "Error, even", "error-even"),
        error_panel(frame, selective_mm, "Error, selective", "error-selective"),
    ]


def hexadecimal(colour: int) -> str:
    """A packed colour as matplotlib takes it."""
    return f"#{colour:08x}"
