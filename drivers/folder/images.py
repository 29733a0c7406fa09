"""Depth images, checked before a decoder sees them: PNG, PGM, TIFF, EXR, and NumPy arrays.

Whole numbers come as uint16 (other widths as they are), floating point as it is; what they mean
is not known here.
"""

from __future__ import annotations

import io
import math
import tokenize
import zipfile
from pathlib import Path
from typing import Any, BinaryIO, Final

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from selective_depth.drivers.colour import BOMBS, DAMAGED
from selective_depth.drivers.errors import DamagedRecordingError
from selective_depth.drivers.frame import DepthArray

SUFFIXES: Final = (".png", ".pgm", ".tif", ".tiff", ".exr", ".npy", ".npz")
MAX_SIDE: Final = 8192
MAX_FILE_BYTES: Final = 256 * 1024 * 1024
MAX_STACK_BYTES: Final = 16 << 30

_MODES: Final = {"1": "a 1-bit grey", "L": "an 8-bit grey", "P": "a palette", "LA": "an 8-bit grey + alpha",
                "RGB": "a colour", "RGBA": "a colour + alpha"}  # fmt: skip
_NEXT: Final = "depth frames are 16-bit grey PNG; convert this file or remove it from the folder"


def is_depth_png(path: Path) -> bool:
    """Whether an image is no picture for people: no PNG file of 8 bits or in colour."""
    with path.open("rb") as file:
        header = file.read(26)
    return not header.startswith(b"\x89PNG") or header[24:26] == b"\x10\x00"


def read_raw(path: Path) -> npt.NDArray[Any]:
    """Values of a depth image of any kind.

    Returns
    -------
    array of shape (height, width), of whole numbers of 16 bits or more, or floating point

    Raises
    ------
    DamagedRecordingError
        Naming the file and what is wrong with it.
    """
    suffix = path.suffix.lower()
    if suffix == ".png":
        return read_png(path)
    if suffix in (".npy", ".npz"):
        stack = read_stack(path)
        if len(stack) != 1:
            raise DamagedRecordingError(
                f"'{path}' holds {len(stack)} frames; one a file in a folder, or give it alone."
            )
        return np.array(stack[0])
    if suffix == ".exr":
        raw = _exr(path)
    else:
        try:
            with Image.open(io.BytesIO(_read_bytes(path, MAX_FILE_BYTES)), formats=("TIFF", "PPM")) as image:
                good = image.mode in ("I;16", "I;16B", "I", "F") and max(image.size) <= MAX_SIDE
                raw = np.array(image, None if image.mode == "F" else np.uint16) if good else None
        except (*DAMAGED, *BOMBS):
            raw = None
    if raw is None or raw.ndim != 2:
        raise DamagedRecordingError(
            f"'{path}' is damaged or cut off, or no depth image: those are grey, of 16 bits or floating point."
        )
    return raw


def read_size(path: Path) -> tuple[int, int]:
    """Height and width of a depth image; of a PNG file, from its first bytes only."""
    if path.suffix.lower() == ".png":
        return read_png_size(path)
    height, width = read_raw(path).shape
    return height, width


def read_stack(path: Path) -> npt.NDArray[Any]:
    """Frames of a NumPy file, shape (frames, height, width); an .npy file is mapped, not read.

    Of several arrays in an .npz file it is the one named ``depth_mm`` or ``depth``.

    Raises
    ------
    DamagedRecordingError
        If it is none, or holds no such array.
    """
    try:
        loaded = np.load(path, mmap_mode="r", allow_pickle=False)
        if not isinstance(loaded, np.ndarray):
            with loaded:
                names = [n for n in ("depth_mm", "depth") if n in loaded.files] or loaded.files
                if len(names) > 1 and names[0] not in ("depth_mm", "depth"):
                    raise ValueError(f"it holds {', '.join(names)}; name the one array 'depth'")
                loaded = _unpacked(path, names[0])
    except (*DAMAGED, tokenize.TokenError, zipfile.BadZipFile) as error:
        raise DamagedRecordingError(
            f"'{path}' cannot be read as a NumPy array of depth ({error!s:.120}); write it again with numpy.save."
        ) from error
    array: npt.NDArray[Any] = loaded
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    array = array[None] if array.ndim == 2 else array
    kind = array.dtype.kind in "iuf" and (array.dtype.kind == "f" or array.dtype.itemsize > 1)
    if array.ndim != 3 or not kind or 0 in array.shape or max(array.shape[1:]) > MAX_SIDE:
        raise DamagedRecordingError(
            f"'{path}' holds {array.dtype} of shape {array.shape}; depth is (height, width) or"
            " (frames, height, width), of whole numbers of 16 bits or more or floating point."
        )
    return array


def _unpacked(path: Path, name: str) -> npt.NDArray[Any]:
    """An array of an archive, after holding the size that its header states against what is there."""
    with zipfile.ZipFile(path) as archive:
        inner = next(each for each in archive.namelist() if each.removesuffix(".npy") == name)
        with archive.open(inner) as file:
            data = io.BytesIO(file.read(MAX_STACK_BYTES))
    version = np.lib.format.read_magic(data)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = header(data)
    if math.prod(shape) * kind.itemsize > data.getbuffer().nbytes:
        raise ValueError(f"it is cut off before the end of an array of shape {shape}")
    data.seek(0)
    return np.asarray(np.lib.format.read_array(data, allow_pickle=False))


def _exr(path: Path) -> npt.NDArray[Any] | None:
    try:
        import OpenEXR
    except ImportError:
        raise DamagedRecordingError(
            f"'{path}' is an EXR image, which needs the package OpenEXR: pip install OpenEXR."
        ) from None
    try:
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
    except (RuntimeError, ValueError, OSError):
        return None
    name = next((n for n in ("Z", "Y", "R", "V") if n in channels), None) or next(iter(channels))
    return np.asarray(channels[name].pixels, np.float32)


def read_png_size(path: Path) -> tuple[int, int]:
    """Height and width of a 16-bit grey PNG, from its first bytes only.

    Raises
    ------
    DamagedRecordingError
        If the file cannot be read or is no 16-bit grey PNG of a sensible size.
    """
    with _opened(path) as file, _png(path, file) as image:
        return image.height, image.width


def read_png(path: Path) -> DepthArray:
    """Raw values of a 16-bit grey PNG.

    Its checksums are verified first. Pillow does both: OpenCV prints to stderr on damaged files, and
    some of its versions deliver half of a truncated one as if it were whole.

    Returns
    -------
    uint16 array of shape (height, width)

    Raises
    ------
    DamagedRecordingError
        Naming the file, what was expected and what was found.
    """
    data = io.BytesIO(_read_bytes(path, MAX_FILE_BYTES))
    try:
        with _png(path, data) as image:
            image.verify()
        with Image.open(data) as image:
            return np.array(image, np.uint16)
    except DAMAGED as error:
        raise DamagedRecordingError(
            f"'{path}' is damaged or cut off ({error}); copy it again, or remove it from the folder."
        ) from error


def write_png(path: Path, raw: npt.NDArray[Any], compression: int = 3) -> None:
    """Write a 16-bit grey PNG, or one of 8-bit blue, green and red.

    Parameters
    ----------
    path : Path
        The file, replaced if it exists.
    raw : uint16 array of shape (height, width), or uint8 array of shape (height, width, 3)
        The values.
    compression : int, default 3
        0 (fast, large) to 9 (slow, small). A 640x480 Kinect frame: 3 takes a third of the time
        of 6, and 9 is 20 % smaller than 3.
    """
    done, encoded = cv2.imencode(".png", raw, [cv2.IMWRITE_PNG_COMPRESSION, compression])
    if not done:
        raise ValueError(f"an array of {raw.dtype} and shape {raw.shape} cannot be written as PNG")
    path.write_bytes(encoded.tobytes())


def _read_bytes(path: Path, limit: int) -> bytes:
    with _opened(path) as file:
        return file.read(limit)


def _opened(path: Path) -> BinaryIO:
    try:
        # Opening a pipe or a device in the folder would wait for ever.
        if not path.is_file():
            raise DamagedRecordingError(f"'{path}' is no regular file; {_NEXT}.")
        return path.open("rb")
    except OSError as error:
        raise DamagedRecordingError(
            f"'{path}' cannot be read ({error.strerror}); check that it is there and its permissions."
        ) from error


def _png(path: Path, file: BinaryIO) -> Image.Image:
    """A PNG file's image, of which only the header was read, if it can be depth."""
    try:
        image = Image.open(file, formats=("PNG",))
    except BOMBS as error:
        raise DamagedRecordingError(
            f"'{path}' claims to be larger ({error}) than is allowed, 1 to {MAX_SIDE} pixels each way."
        ) from None
    except DAMAGED:
        file.seek(0)
        start = file.read(24)
        what = (
            "cut off" if start.startswith(b"\x89PNG") else "no PNG file, whatever its name says" if start else "empty"
        )
        if start.startswith(b"version https://git-lfs"):
            what = "a Git LFS pointer and not the image; `git lfs pull` fetches it"
        raise DamagedRecordingError(f"'{path}' is {what}; {_NEXT}.") from None
    if image.mode != "I;16":
        raise DamagedRecordingError(f"'{path}' is {_MODES.get(image.mode, f'a {image.mode}')} PNG; {_NEXT}.")
    if max(image.size) > MAX_SIDE:
        raise DamagedRecordingError(
            f"'{path}' claims to be {image.width}x{image.height} pixels; allowed are 1 to {MAX_SIDE} each way."
        )
    return image
