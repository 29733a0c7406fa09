"""Depth images, checked before a decoder sees them: PNG, PGM, TIFF, EXR, and NumPy arrays.

Whole numbers come as uint16 (other widths as they are), floating point as it is; what they mean
is not known here.
"""

from __future__ import annotations

import io
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

SUFFIXES: Final = (".png", ".pgm", ".tif", ".tiff", ".exr", ".npy", ".npz")
MAX_SIDE: Final = 8192
MAX_FILE_BYTES: Final = 256 * 1024 * 1024
MAX_STACK_BYTES: Final = 16 << 30

_GREY: Final = ("I;16", "I;16B", "I", "F")
"""Pillow's modes of depth images; of PNG files, the first."""
_COLOURS: Final = {"1": "a black-and-white", "L": "an 8-bit grey", "P": "a palette", "LA": "an 8-bit grey + alpha",
                "RGB": "a colour", "RGBA": "a colour + alpha"}  # fmt: skip
_ALLOWED: Final = f"allowed are 1 to {MAX_SIDE} pixels each way"
_NEXT: Final = "depth images are grey, of 16 bits or floating point; convert this file or remove it from the folder"


def damaged(path: Path, what: str, advice: str = _NEXT) -> DamagedRecordingError:
    """The error of a file: what is wrong with it, and what to do."""
    return DamagedRecordingError(f"'{path}' {what}; {advice}.")


def is_depth_png(path: Path) -> bool:
    """Whether an image is not a picture for people, a PNG file of 8 bits or in colour."""
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
    if suffix in (".npy", ".npz"):
        stack = read_stack(path)
        if len(stack) != 1:
            advice = "each file of a folder is one frame. Open this one by its own name"
            raise damaged(path, f"holds {len(stack)} frames", advice)
        return np.array(stack[0])
    if suffix == ".exr":
        return _read_exr(path)
    with opened(path, _NEXT) as file:
        data = io.BytesIO(file.read(MAX_FILE_BYTES))
    try:
        with _header(path, data) as image:
            image.verify()
        with Image.open(data) as image:
            return np.array(image, None if image.mode == "F" else np.uint16)
    except DAMAGED as error:
        raise _cut_off(path, error) from error


def read_size(path: Path) -> tuple[int, int]:
    """Height and width of a depth image; of a PNG, TIFF or PGM file, from its first bytes only."""
    if path.suffix.lower() in (".npy", ".npz", ".exr"):
        height, width = read_raw(path).shape
        return height, width
    with opened(path, _NEXT) as file, _header(path, file) as image:
        return image.height, image.width


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
                # NumPy unpacks no more than is there; only what is there may be far too much.
                if loaded.zip.getinfo(f"{names[0]}.npy").file_size > MAX_STACK_BYTES:
                    raise ValueError(f"it unpacks to more than {MAX_STACK_BYTES >> 30} GiB")
                loaded = np.asarray(loaded[names[0]])
    except (*DAMAGED, tokenize.TokenError, zipfile.BadZipFile) as error:
        what = f"cannot be read as a NumPy array of depth ({error!s:.120})"
        raise damaged(path, what, "write it again with numpy.save") from error
    array: npt.NDArray[Any] = loaded
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    array = array[None] if array.ndim == 2 else array
    kind = array.dtype.kind in "iuf" and (array.dtype.kind == "f" or array.dtype.itemsize > 1)
    if array.ndim != 3 or not kind or 0 in array.shape or max(array.shape[1:]) > MAX_SIDE:
        allowed = "(height, width) or (frames, height, width), of whole numbers of 16 bits or more or floating point"
        raise damaged(path, f"holds {array.dtype} of shape {array.shape}", f"depth is {allowed}")
    return array


def _read_exr(path: Path) -> npt.NDArray[Any]:
    try:
        import OpenEXR
    except ImportError:
        raise damaged(path, "is an EXR image, which needs the package OpenEXR", "pip install OpenEXR") from None
    try:
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
    except (RuntimeError, ValueError, OSError) as error:
        raise _cut_off(path, error) from error
    name = next((n for n in ("Z", "Y", "R", "V") if n in channels), None) or next(iter(channels))
    return np.asarray(channels[name].pixels, np.float32)


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


def opened(path: Path, remedy: str) -> BinaryIO:
    """A file of a recorded folder, open for reading.

    Parameters
    ----------
    path : Path
    remedy : str
        What to do about something that is not a regular file, such as a pipe.

    Raises
    ------
    DamagedRecordingError
        If it is not a regular file or cannot be opened.
    """
    try:
        # Opening a pipe or a device in the folder would wait for ever.
        if not path.is_file():
            raise damaged(path, "is not a regular file", remedy)
        return path.open("rb")
    except OSError as error:
        advice = "check that it is there and its permissions"
        raise damaged(path, f"cannot be read ({error.strerror})", advice) from error


def _header(path: Path, file: BinaryIO) -> Image.Image:
    """An image of which only the header was read, if it can be depth.

    Pillow reads it: OpenCV prints to stderr on damaged files, and some of its versions deliver half
    of a truncated one as if it were whole.
    """
    formats, modes = (("PNG",), _GREY[:1]) if path.suffix.lower() == ".png" else (("TIFF", "PPM"), _GREY)
    try:
        image = Image.open(file, formats=formats)
    except BOMBS as error:
        raise damaged(path, f"claims to be larger ({error})", _ALLOWED) from None
    except DAMAGED:
        file.seek(0)
        start = file.read(24)
        what = f"not a {' or '.join(formats)} file, whatever its name says"
        if start.startswith((b"\x89PNG", b"II*\0", b"MM\0*", b"P5")):
            what = "cut off"
        elif start.startswith(b"version https://git-lfs"):
            what = "a Git LFS pointer and not the image; `git lfs pull` fetches it"
        raise damaged(path, f"is {what if start else 'empty'}") from None
    if image.mode not in modes:
        raise damaged(path, f"is {_COLOURS.get(image.mode, f'a {image.mode}')} {image.format}")
    if max(image.size) > MAX_SIDE:
        raise damaged(path, f"claims to be {image.width}x{image.height} pixels", _ALLOWED)
    return image


def _cut_off(path: Path, error: Exception) -> DamagedRecordingError:
    return damaged(path, f"is damaged or cut off ({error})", "copy it again, or remove it from the folder")
