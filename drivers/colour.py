"""Colour beside depth: what pixels of any camera mean, which image goes with which, and where it lies."""

from __future__ import annotations

import io
import logging
import struct
import warnings
import zlib
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from selective_depth.drivers.frame import MOST_PX, Camera, ColourArray, DepthArray, DepthFrame, handed_over
from selective_depth.drivers.options import Options

PAIR_US: Final = 20_000
"""Images farther apart in time than this are not of one moment: at 30 frames/s the nearest is always nearer."""
MOST_PIXELS: Final = 1 << 26
BOMBS: Final = (Image.DecompressionBombError, Image.DecompressionBombWarning)
"""What Pillow raises of images too large to be meant: the second is a warning until told otherwise."""
DAMAGED: Final = (OSError, SyntaxError, ValueError, TypeError, LookupError, ArithmeticError, MemoryError, EOFError,
                  RuntimeError, struct.error, zlib.error)  # fmt: skip
"""What Pillow, and NumPy's files, raise of what is damaged."""
# What it makes of damaged files is said in our own words.
warnings.filterwarnings("ignore", module=r"PIL\.")
logging.getLogger("PIL").setLevel(logging.CRITICAL)
warnings.filterwarnings("error", category=Image.DecompressionBombWarning)
CONVERSIONS: Final = {
    "RGB888": (None, 3), "YUV422": (cv2.COLOR_YUV2RGB_UYVY, 2), "YUYV": (cv2.COLOR_YUV2RGB_YUY2, 2),
    "GRAY8": (cv2.COLOR_GRAY2RGB, 1), "BGR8": (cv2.COLOR_BGR2RGB, 3), "RGBA8": (cv2.COLOR_RGBA2RGB, 4),
    "BGRA8": (cv2.COLOR_BGRA2RGB, 4), "BAYER_RGGB8": (cv2.COLOR_BayerRGGB2RGB, 1),
    "BAYER_GRBG8": (cv2.COLOR_BayerGRBG2RGB, 1), "BAYER_BGGR8": (cv2.COLOR_BayerBGGR2RGB, 1),
    "BAYER_GBRG8": (cv2.COLOR_BayerGBRG2RGB, 1),
}  # fmt: skip
"""Pixel formats by name: OpenCV's conversion to RGB, and bytes a pixel."""


def rgb_of(data: Any, kind: str, width: int, height: int) -> ColourArray | None:
    """The image of raw pixels; None where they are too few, or a JPEG that cannot be decoded.

    Parameters
    ----------
    data : bytes-like
        Rows without gaps; of ``JPEG`` and ``PNG``, the file.
    kind : str
        A name of `CONVERSIONS`, ``JPEG`` or ``PNG``.
    width, height : int
        Size in pixels.
    """
    if kind in ("JPEG", "PNG"):
        decoded = rgb_of_file(io.BytesIO(data))
        return decoded if decoded is not None and decoded.shape == (height, width, 3) else None
    raw = np.frombuffer(data, np.uint8)
    conversion, size = CONVERSIONS[kind]
    if raw.size < width * height * size:
        return None
    raw = raw[: width * height * size].reshape(height, width, size)
    image = raw.copy() if conversion is None else cv2.cvtColor(raw, conversion)
    return handed_over(np.asarray(image, np.uint8))


def rgb_of_file(file: Path | io.BytesIO) -> ColourArray | None:
    """The image of a file; None if it is not an image, damaged or larger than `MOST_PIXELS`.

    Pillow reads it: OpenCV's decoders print on standard error what they find damaged.
    """
    try:
        with Image.open(file) as image:
            if image.width * image.height > MOST_PIXELS:
                return None
            return handed_over(np.array(image.convert("RGB"), np.uint8))
    except (*DAMAGED, *BOMBS):
        return None


def jpeg_of(colour: ColourArray, quality: int) -> bytes:
    """A colour image as JPEG, with its hues at full resolution."""
    bgr = cv2.cvtColor(colour, cv2.COLOR_RGB2BGR)
    choices = [
        cv2.IMWRITE_JPEG_QUALITY,
        quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    ]
    return bytes(cv2.imencode(".jpg", bgr, choices)[1])


def nearest(times_us: Sequence[int], time_us: int) -> int | None:
    """Index of the time nearest to another, of a rising list; None if none is within `PAIR_US`."""
    at = bisect_left(times_us, time_us)
    off_us = {k: abs(times_us[k] - time_us) for k in (at - 1, at) if 0 <= k < len(times_us)}
    best = min(off_us, key=off_us.__getitem__, default=None)
    return best if best is not None and off_us[best] <= PAIR_US else None


@dataclass(frozen=True)
class Colouring:
    """What a user says of a source's colour, after ``colour=``.

    Parameters
    ----------
    wanted : bool, default True
        False after ``off``: colour is not read at all.
    registered : bool or None
        True after ``registered``, False after ``unregistered``; else as the source tells.
    intrinsics : tuple of float or None
        fx, fy, cx, cy of the colour camera in pixels.
    place_mm : tuple of float or None
        Where it stands beside the depth camera, along that one's x, y and z, looking the same way.
        With both known, the image is registered by them.
    """

    wanted: bool = True
    registered: bool | None = None
    intrinsics: tuple[float, ...] | None = None
    place_mm: tuple[float, ...] | None = None

    @classmethod
    def of(cls, options: Options) -> Colouring:
        """The one among a source's options."""
        words = ("on", "off", "registered", "unregistered")
        numbers = options.words_or_numbers("colour", words, "fx,fy,cx,cy,x,y,z", -MOST_PX, MOST_PX)
        if isinstance(numbers, tuple):
            return cls(intrinsics=numbers[:4], place_mm=numbers[4:])
        return cls(numbers != "off", {"registered": True, "unregistered": False}.get(numbers))

    def told_by(self, intrinsics: tuple[float, ...] | None, place_mm: tuple[float, ...] | None = None) -> Colouring:
        """The same, completed by what a source knows of its cameras."""
        return replace(self, intrinsics=self.intrinsics or intrinsics, place_mm=self.place_mm or place_mm)

    def colour(
        self, frame: DepthFrame, colour: ColourArray, time_us: int, registered: bool, jpeg: bytes | None = None
    ) -> DepthFrame:
        """A frame with its colour image, registered if it can be.

        Parameters
        ----------
        frame : DepthFrame
        colour : uint8 array of shape (height, width, 3)
        time_us : int
            When it was taken.
        registered : bool
            Whether the source says that it lies on the depth image.
        jpeg : bytes, optional
            The file that it was read from.
        """
        height, width = colour.shape[:2]
        registered = registered if self.registered is None else self.registered
        camera = Camera(width, height, *self.intrinsics) if self.intrinsics else None
        if not registered and self.registered is None and camera and self.place_mm:
            colour = on_depth(frame.depth_mm, frame.camera, colour, camera, self.place_mm)
            camera, registered, jpeg = None, True, None
        registered = registered and colour.shape[:2] == frame.shape
        return replace(
            frame, colour=colour, colour_us=time_us, colour_camera=camera, registered=registered, colour_jpeg=jpeg
        )


ON: Final = Colouring()
"""Colour as the source tells."""


def on_depth(
    depth_mm: DepthArray, camera: Camera, colour: ColourArray, colour_camera: Camera, place_mm: Sequence[float]
) -> ColourArray:
    """A colour image laid on depth pixels by the two cameras; black where there is no depth.

    Each depth pixel takes the colour of the pixel that its point falls on. What the colour camera
    does not see, hidden by something nearer, has the colour of that.

    Parameters
    ----------
    depth_mm : uint16 array of shape (height, width)
    camera, colour_camera : Camera
        Both look the same way.
    colour : uint8 array of shape (colour height, colour width, 3)
    place_mm : sequence of three floats
        The colour camera along the depth camera's axes.
    """
    rows, columns = np.indices(depth_mm.shape, np.float32)
    z = depth_mm.astype(np.float32)
    away = np.maximum(z - np.float32(place_mm[2]), 1)
    u = ((columns - camera.cx) * (z / camera.fx) - place_mm[0]) / away * colour_camera.fx + colour_camera.cx
    v = ((rows - camera.cy) * (z / camera.fy) - place_mm[1]) / away * colour_camera.fy + colour_camera.cy
    u[depth_mm == 0] = -1e6
    laid: npt.NDArray[Any] = cv2.remap(colour, u.astype(np.float32), v.astype(np.float32), cv2.INTER_NEAREST)
    return handed_over(laid)
