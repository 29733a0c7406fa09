"""The multi-resolution model as files: its cloud, its dense depth, its samples."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from selective_depth.app.commands.snapshot import nth_frame
from selective_depth.app.console.exit_codes import OK
from selective_depth.app.console.output import make_folder, replacing, write_image, write_output
from selective_depth.app.pictures import palette
from selective_depth.app.pipeline import FrameResult, say, selector_of
from selective_depth.app.settings import Settings
from selective_depth.drivers.frame import Camera, ColourArray, DepthFrame
from selective_depth.selectors.acquire import Acquisition, acquire
from selective_depth.selectors.arrays import pixels_where
from selective_depth.selectors.seeds import SeedGrid


def save_cloud(path: Path, acquisition: Acquisition, camera: Camera, colours: ColourArray | None = None) -> int:
    """Write the samples that returned depth as a point cloud (binary PLY).

    Points are in millimetres, x right, y down, z forward; each has the `round` it was measured
    in (0 = seed), and the colour that the colour camera saw there or, without, that of its round
    in the pictures of this program.

    Parameters
    ----------
    path : Path
        A file that ends in .ply; overwritten.
    acquisition : Acquisition
        The model.
    camera : Camera
        Intrinsics of its frame.
    colours : uint8 array of shape (n, 3), optional
        Colour of each sample, as `DepthFrame.colours_at` tells it.

    Returns
    -------
    int
        Number of points.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    kept = acquisition.returned
    rounds = acquisition.round[kept]
    vertex = np.empty(int(kept.sum()), [("xyz", "<f4", 3), ("rgb", "u1", 3), ("round", "u1")])
    vertex["xyz"] = camera.points_mm(acquisition.uv[kept], acquisition.depth_mm[kept])
    vertex["round"] = rounds
    last = int(acquisition.round.max(initial=1))
    vertex["rgb"] = palette.channels(palette.round_colours(last))[rounds] if colours is None else colours[kept]
    header = ["ply", "format binary_little_endian 1.0"]
    header += ["comment selective-depth: millimetres, x right, y down, z forward; round 0 = seed"]
    header += [f"element vertex {len(vertex)}", *(f"property float {axis}" for axis in "xyz")]
    header += [f"property uchar {channel}" for channel in ("red", "green", "blue", "round")]
    write_output(path, "\n".join([*header, "end_header\n"]).encode("ascii") + vertex.tobytes())
    return len(vertex)


def save_depth(path: Path, depth_mm: npt.NDArray[np.floating]) -> None:
    """Write dense depth as a 16-bit PNG, whole millimetres, 0 = unknown.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    write_image(path, np.clip(np.rint(np.nan_to_num(depth_mm)), 0, 65535).astype(np.uint16))


def save_samples(path: Path, acquisition: Acquisition) -> None:
    """Write all measurements, also those that returned nothing, as NPZ.

    It holds ``uv`` (column, row), ``depth_mm`` (0 = no return), ``round`` (0 = seed) and
    ``shape`` (height, width); read it with ``numpy.load``.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    shape = np.array(acquisition.frame_shape, np.int32)
    with replacing(path) as file:
        np.savez_compressed(
            file, uv=acquisition.uv, depth_mm=acquisition.depth_mm, round=acquisition.round, shape=shape
        )


def save_model(
    folder: Path, acquisition: Acquisition, frame: DepthFrame, depth_mm: npt.NDArray[np.floating] | None = None
) -> list[Path]:
    """Write ``cloud.ply``, ``depth.png`` and ``samples.npz`` into a folder, made if missing.

    The dense depth is that of the samples, unless another is given.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    make_folder(folder)
    cloud, depth, samples = (folder / n for n in ("cloud.ply", "depth.png", "samples.npz"))
    save_cloud(cloud, acquisition, frame.camera, frame.colours_at(acquisition.uv))
    save_depth(depth, acquisition.reconstruct() if depth_mm is None else depth_mm)
    save_samples(samples, acquisition)
    return [cloud, depth, samples]


def save_result(folder: Path, result: FrameResult) -> list[Path]:
    """Write the model of a run's frame as `save_model` does; of a memory, all that it knows.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    acquisition = result.acquisition
    assert acquisition is not None  # there is a budget
    if result.memory is not None:
        known_mm = result.memory.known_mm
        uv, depth_mm = pixels_where(known_mm), known_mm[known_mm > 0]
        acquisition = replace(acquisition, uv=uv, depth_mm=depth_mm, round=np.zeros(len(uv), np.uint8))
    dense_mm = None if result.model is None else result.model.depth_mm
    return save_model(folder, acquisition, result.frame, dense_mm)


def model_frame(source: str, out: Path, number: int, settings: Settings) -> int:
    """Acquire one frame of a source selectively and save the model; returns the exit code.

    Raises
    ------
    OutputError
        If a file cannot be written.
    UsageError
        If there is no such frame, or no such selector.
    """
    selector = selector_of(settings, None)
    frame = nth_frame(source, number)
    seeds = SeedGrid.from_frame(frame, (settings.seeds.rows, settings.seeds.columns))
    how = settings.acquire
    acquisition = acquire(frame.measure, seeds, float(how.budget), how.rounds, selector)
    for path in save_model(out, acquisition, frame):
        say(f"wrote {path}")
    return OK
