"""The one data type that flows through the app: a depth frame and its camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

DepthArray = npt.NDArray[np.uint16]
"""Depth image, shape (height, width), millimetres, 0 = no measurement."""
ColourArray = npt.NDArray[np.uint8]
"""Colour image, shape (height, width, 3), red-green-blue."""
_Value = TypeVar("_Value", bound=np.generic)

MOST_PX = 1e6
"""Greatest focal length, and farthest principal point, of any camera: so that no metric point of
any depth leaves the range of 32-bit floats."""
LEAST_FOCAL_PX = 1e-2
MOST_TIME_US = 1 << 62
"""Timestamps lie within this of 0: about 146,000 years, and their differences fit in 64 bits."""


@dataclass(frozen=True, slots=True)
class Camera:
    """Pinhole intrinsics of a depth image.

    Parameters
    ----------
    width, height : int
        Size of the image in pixels.
    fx, fy : float
        Focal lengths in pixels.
    cx, cy : float
        Principal point in pixels; integer coordinates are pixel centres.

    Raises
    ------
    ValueError
        If a value is out of its range: sizes from 1, focal lengths from `LEAST_FOCAL_PX` to
        `MOST_PX`, the principal point within `MOST_PX` of the first pixel.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"camera size is {self.width}x{self.height} pixels; both must be at least 1")
        for name, of_what, least in (
            ("fx", "focal length", LEAST_FOCAL_PX),
            ("fy", "focal length", LEAST_FOCAL_PX),
            ("cx", "principal point's", -MOST_PX),
            ("cy", "principal point's", -MOST_PX),
        ):
            value = getattr(self, name)
            if not least <= value <= MOST_PX:
                raise ValueError(f"the {of_what} {name} is {value} pixels; it must be from {least:g} to {MOST_PX:g}")

    @classmethod
    def from_fov(cls, width: int, height: int, fov_x_rad: float, fov_y_rad: float) -> Camera:
        """Intrinsics from a stream's fields of view, principal point at the image centre.

        Parameters
        ----------
        width, height : int
            Size of the image in pixels.
        fov_x_rad, fov_y_rad : float
            Horizontal and vertical field of view in radians, each in (0, pi).
        """
        for fov in (fov_x_rad, fov_y_rad):
            if not 0 < fov < math.pi:
                raise ValueError(f"field of view is {fov} rad; it must lie between 0 and pi")
        fx, fy = width / (2 * math.tan(fov_x_rad / 2)), height / (2 * math.tan(fov_y_rad / 2))
        return cls(width, height, fx, fy, width / 2, height / 2)

    @classmethod
    def kinect(cls, width: int = 640, height: int = 480) -> Camera:
        """Nominal intrinsics of a Kinect for Xbox 360, scaled to the image's width.

        585 pixels at 640x480, the calibration published with the 7-Scenes recordings; used
        where a source says nothing of its camera.
        """
        focal = 585.0 * width / 640.0
        return cls(width, height, focal, focal, width / 2, height / 2)

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """Focal lengths and principal point: fx, fy, cx, cy."""
        return self.fx, self.fy, self.cx, self.cy

    def points_mm(self, uv: npt.NDArray[np.generic], depth_mm: npt.NDArray[np.generic]) -> npt.NDArray[np.float32]:
        """Metric points of pixels: x right, y down, z forward, in millimetres.

        Parameters
        ----------
        uv : array of shape (..., 2)
            Pixels, column first.
        depth_mm : array of shape (...)
            Their depth; 0 = no measurement.

        Returns
        -------
        float32 array of shape (..., 3)
            NaN where there is no depth.
        """
        z = np.asarray(depth_mm, dtype=np.float32)
        z = np.where(z > 0, z, np.float32(np.nan))
        u = np.asarray(uv[..., 0], dtype=np.float32)
        v = np.asarray(uv[..., 1], dtype=np.float32)
        x = (u - np.float32(self.cx)) * (z / np.float32(self.fx))
        y = (v - np.float32(self.cy)) * (z / np.float32(self.fy))
        return np.stack((x, y, z), axis=-1)

    def project_uv(self, points_mm: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
        """Pixels (column, row) on which metric points of shape (..., 3) fall."""
        z = points_mm[..., 2]
        u = points_mm[..., 0] / z * self.fx + self.cx
        v = points_mm[..., 1] / z * self.fy + self.cy
        return np.stack((u, v), axis=-1).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class DepthFrame:
    """One depth image as a sensor delivered it. Checked here, trusted everywhere else.

    Parameters
    ----------
    depth_mm : uint16 array of shape (height, width)
        Depth along the optical axis in millimetres; 0 = no measurement. The frame keeps a copy, in
        this machine's byte order, with 0 where the array is masked; it is read-only. Only an array
        that is read-only and owns its memory is taken as it is, for nobody can change it.
    index : int
        Number of the frame in its source, from 0.
    timestamp_us : int
        The sensor's clock, microseconds; only differences mean anything. Within `MOST_TIME_US`.
    camera : Camera
        Intrinsics, of the image's size.
    source : str
        Where the frame came from, for messages and reports.
    truth_mm : uint16 array of shape (height, width) or None
        The exact depth, where a simulated sensor knows it; nobody who selects may look at it.
    colour : uint8 array of shape (height, width, 3) or None
        What a colour camera saw nearest in time, red-green-blue; None where there is none. Kept and
        read-only as `depth_mm` is.
    colour_us : int or None
        When, on the clock of `timestamp_us`; default that.
    colour_camera : Camera or None
        The colour camera's intrinsics, None if they are not known; default, where the images are
        registered, those of depth.
    registered : bool
        Whether the colour image lies on the depth image, pixel on pixel. Told by the device, the
        layout, the sidecar or the user, never assumed.
    colour_jpeg : bytes or None
        The JPEG file that `colour` was read from, where it was: who hands the image on as one need
        not make another, and loses nothing.

    Raises
    ------
    ValueError
        If an array's type or shape or a timestamp is not as stated, saying what was expected.
    """

    depth_mm: DepthArray
    index: int
    timestamp_us: int
    camera: Camera
    source: str = ""
    truth_mm: DepthArray | None = None
    colour: ColourArray | None = None
    colour_us: int | None = None
    colour_camera: Camera | None = None
    registered: bool = False
    colour_jpeg: bytes | None = None

    def __post_init__(self) -> None:
        _check_image("depth_mm", self.depth_mm, np.uint16)
        _check_time("timestamp_us", self.timestamp_us)
        _check_size("depth_mm", self.depth_mm, "the camera", self.camera)
        object.__setattr__(self, "depth_mm", _kept(self.depth_mm, np.uint16))
        if self.colour is not None:
            self._check_colour(self.colour)

    def _check_colour(self, colour: ColourArray) -> None:
        _check_image("colour", colour, np.uint8, (3,))
        if self.registered and colour.shape[:2] != self.shape:
            raise ValueError(
                f"colour has shape {colour.shape}; registered to depth it must have its rows and columns, {self.shape}"
            )
        camera = self.colour_camera or (self.camera if self.registered else None)
        if camera is not None:
            _check_size("colour", colour, "its camera", camera)
        time_us = self.timestamp_us if self.colour_us is None else self.colour_us
        _check_time("colour_us", time_us)
        for name, value in (("colour", _kept(colour, np.uint8)), ("colour_camera", camera), ("colour_us", time_us)):
            object.__setattr__(self, name, value)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.camera.height, self.camera.width

    def measure(self, uv: npt.NDArray[np.integer]) -> DepthArray:
        """The frame as a random-access sensor.

        Parameters
        ----------
        uv : int array of shape (n, 2)
            Pixels to measure, column first.

        Returns
        -------
        uint16 array of shape (n,)
            Depth in millimetres, 0 = no return.
        """
        depth_mm: DepthArray = self.depth_mm[uv[:, 1], uv[:, 0]]
        return depth_mm

    def colours_at(self, uv: npt.NDArray[np.integer]) -> ColourArray | None:
        """Colours of depth pixels (n, 2), shape (n, 3); None where colour does not lie on depth."""
        return self.colour[uv[:, 1], uv[:, 0]] if self.colour is not None and self.registered else None


def _check_image(name: str, image: object, kind: type[np.generic], channels: tuple[int, ...] = ()) -> None:
    # Asked of the object: the annotation does not keep a caller from giving a list.
    dtype = getattr(image, "dtype", type(image).__name__)
    shape: tuple[int, ...] = getattr(image, "shape", ())
    right_kind = isinstance(dtype, np.dtype) and dtype.newbyteorder("=") == kind
    if not right_kind or len(shape) < 2 or shape[2:] != channels or 0 in shape:
        form = ", ".join(("height", "width", *map(str, channels)))
        raise ValueError(f"{name} must be a {kind.__name__} array of shape ({form}), got {dtype} {shape}")


def _check_size(name: str, image: npt.NDArray[Any], whose: str, camera: Camera) -> None:
    if image.shape[:2] != (camera.height, camera.width):
        raise ValueError(
            f"{name} has shape {image.shape}, but {whose} is {camera.height} rows by {camera.width} columns"
        )


def _check_time(name: str, time_us: int) -> None:
    if not -MOST_TIME_US <= time_us <= MOST_TIME_US:
        raise ValueError(f"{name} is {time_us}; it must lie within {MOST_TIME_US} of 0")


def _kept(image: npt.NDArray[Any], kind: type[np.generic]) -> npt.NDArray[Any]:
    """An image that nobody can change: itself, where that is so already, or a copy."""
    own = type(image) is np.ndarray and image.base is None and not image.flags.writeable
    if own and image.flags.c_contiguous and image.dtype.isnative:
        return image
    # A sensor fills its buffer again: a frame that is kept stays what it was.
    return handed_over(np.array(np.ma.filled(image, 0), kind, order="C"))


def handed_over(image: npt.NDArray[_Value]) -> npt.NDArray[_Value]:
    """An image that its maker will not change any more: a frame need not copy it."""
    image.flags.writeable = False
    return image


def millimetres(raw: npt.NDArray[np.generic], values_per_metre: float, marks: Sequence[int] = ()) -> DepthArray:
    """Depth in whole millimetres of values of any kind.

    What is marked, not finite, below half a millimetre or beyond 65,535 mm becomes 0, no
    measurement.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        depth_mm = np.rint(np.where(np.isin(raw, marks), 0, raw) * (1000.0 / values_per_metre))
        within = (depth_mm > 0) & (depth_mm <= 65535)
    return np.where(within, depth_mm, 0).astype(np.uint16)
