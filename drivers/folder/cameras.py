"""Files beside the frames that hold intrinsics or a scale, in the forms that publishers use."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from selective_depth.drivers.folder.images import damaged
from selective_depth.drivers.folder.sidecar import read_text
from selective_depth.drivers.frame import Camera

_FILES: Final = (
    *("camera_intrinsic.json", "intrinsic.json", "intrinsics.json", "camera_intrinsics.json"),
    *("cam_params.json", "../cam_params.json", "scene_camera.json", "calibration.txt"),
    *("intrinsic/intrinsic_depth.txt", "intrinsic_depth.txt", "intrinsics.txt"),
    *("camera-intrinsics.txt", "../camera-intrinsics.txt", "info.txt", "_info.txt"),
    *("lowres_wide_intrinsics/*.pincam", "*-meta.mat"),
)


@dataclass(frozen=True)
class CameraFile:
    """What a file says.

    Parameters
    ----------
    path : Path
        The file.
    intrinsics : tuple of float or None
        fx, fy, cx, cy in pixels.
    size : (int, int) or None
        Width and height that they are for.
    values_per_metre : float or None
        Scale of the depth images.
    varies : bool
        There are others for other frames.
    """

    path: Path
    intrinsics: tuple[float, float, float, float] | None = None
    size: tuple[int, int] | None = None
    values_per_metre: float | None = None
    varies: bool = False

    def camera(self, width: int, height: int) -> Camera | None:
        """The camera of images of a size; None where these intrinsics cannot be theirs.

        Without a size in the file, the principal point must lie in the middle half of the image:
        else they are those of another camera, or of another resolution.
        """
        if self.intrinsics is None or self.size not in (None, (width, height)):
            return None
        fx, fy, cx, cy = self.intrinsics
        if self.size is None and not (
            width / 4 < cx < width * 3 / 4 and height / 4 < cy < height * 3 / 4 and width / 4 < fx < width * 4
        ):
            return None
        try:
            return Camera(width, height, fx, abs(fy), cx, cy)  # -fy: y up, which images have not
        except ValueError:
            return None


def find_camera_file(root: Path) -> CameraFile:
    """What the first file of a known name beside the frames says; nothing if there is none.

    Raises
    ------
    DamagedRecordingError
        If it is there and cannot be understood.
    """
    path = next((path for name in _FILES for path in sorted(root.glob(name))), None)
    if path is None:
        return CameraFile(root)
    try:
        if path.suffix == ".mat":
            from scipy.io import loadmat  # a tenth of a second, for one kind of folder

            entries = loadmat(path)
            scale = float(entries["factor_depth"].item())
            return CameraFile(path, _matrix(entries["intrinsic_matrix"].ravel()), None, scale)
        text = read_text(path)
        if path.suffix == ".json":
            return _from_json(path, json.loads(text))
        if "m_calibrationDepthIntrinsic" in text:
            return _from_info(path, text)
        numbers = [float(word) for word in text.replace(",", " ").split()]
        if len(numbers) == 6:  # ARKitScenes
            return CameraFile(path, _matrix(numbers[2:]), (int(numbers[0]), int(numbers[1])))
        return CameraFile(path, _matrix(numbers))
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        advice = "put the camera and the scale into frames.toml, and rename or remove this file"
        raise damaged(path, f"holds no intrinsics in a known form ({error!s:.80})", advice) from error


def _matrix(numbers: Sequence[float], columns: bool = False) -> tuple[float, float, float, float]:
    """Focal lengths and principal point of 4 numbers, or a 3x3 or 4x4 matrix."""
    if len(numbers) == 4:
        fx, fy, cx, cy = map(float, numbers)
        return fx, fy, cx, cy
    shape = {9: (3, 3), 12: (3, 4), 16: (4, 4)}[len(numbers)]
    matrix = np.array(numbers, np.float64).reshape(shape, order="F" if columns else "C")
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])


def _from_json(path: Path, entries: dict[str, Any]) -> CameraFile:
    if "intrinsic_matrix" in entries:  # Open3D, by columns
        size = (int(entries["width"]), int(entries["height"]))
        return CameraFile(path, _matrix(entries["intrinsic_matrix"], columns=True), size)
    frames = [each for each in entries.values() if isinstance(each, dict) and "cam_K" in each]
    if frames:  # BOP, mm = value * depth_scale
        scales = {float(each.get("depth_scale", 1.0)) for each in frames}
        if len(scales) > 1:
            raise ValueError("depth_scale differs from frame to frame")
        varies = any(each["cam_K"] != frames[0]["cam_K"] for each in frames)
        return CameraFile(path, _matrix(frames[0]["cam_K"]), None, 1000 / scales.pop(), varies)
    camera = entries.get("camera", entries)
    fx, fy, cx, cy = (float(camera[key]) for key in ("fx", "fy", "cx", "cy"))
    width, height = (camera.get(key) or camera.get(key[0]) for key in ("width", "height"))
    scale = camera.get("scale")
    return CameraFile(
        path, (fx, fy, cx, cy), (int(width), int(height)) if width and height else None, float(scale) if scale else None
    )


def _from_info(path: Path, text: str) -> CameraFile:
    said = dict(re.findall(r"^\s*(\w+)\s*=\s*(.*)$", text, re.MULTILINE))
    size = (int(said["m_depthWidth"]), int(said["m_depthHeight"]))
    numbers = [float(word) for word in said["m_calibrationDepthIntrinsic"].split()]
    return CameraFile(path, _matrix(numbers), size, float(said.get("m_depthShift", 1000)))
