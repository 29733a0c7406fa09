"""Depth images, checked before a decoder sees them: PNG, PGM, TIFF, EXR, and NumPy arrays.

Whole numbers come as uint16 (other widths as they are), floating point as it is; what they mean
is not known here.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from selective_depth.drivers.errors import DamagedRecordingError
from selective_depth.drivers.frame import DepthArray

SUFFIXES: Final = (".png", ".pgm", ".tif", ".tiff", ".exr", ".npy", ".npz")
SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
HEADER_BYTES: Final = 33  # signature, and the IHDR chunk with its length, name and checksum
MAX_SIDE: Final = 8192
MAX_FILE_BYTES: Final = 256 * 1024 * 1024

_COLOURS: Final = {0: "grey", 2: "colour", 3: "palette", 4: "grey + alpha", 6: "colour + alpha"}
_NEXT: Final = "depth frames are 16-bit grey PNG; convert this file or remove it from the folder"


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
    data = _read_bytes(path, MAX_FILE_BYTES)
    if suffix == ".pgm":
        raw = _pgm(data)
    elif suffix == ".exr":
        raw = _exr(path)
    else:
        raw = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if raw is None or raw.ndim != 2 or raw.dtype not in (np.uint16, np.float32):
        what = f"{raw.dtype} of shape {raw.shape}" if raw is not None else "damaged or cut off"
        raise DamagedRecordingError(f"'{path}' is {what}; a depth image is grey, of 16 bits or floating point.")
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
                loaded = loaded[names[0]]
    except (OSError, ValueError, EOFError, IndexError, KeyError, zipfile.BadZipFile) as error:
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


def _pgm(data: bytes) -> npt.NDArray[Any] | None:
    header = re.match(rb"P5\s+(?:#.*\s+)*(\d{1,5})\s+(\d{1,5})\s+(\d{1,5})\s", data)
    if header is None or int(header[3]) < 256:
        return None
    width, height = int(header[1]), int(header[2])
    if len(data) - header.end() < 2 * width * height or not 0 < max(width, height) <= MAX_SIDE:
        return None
    values = np.frombuffer(data, ">u2", width * height, header.end())
    return values.reshape(height, width).astype(np.uint16)


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
    return _size_from_header(path, _read_bytes(path, HEADER_BYTES))


def read_png(path: Path) -> DepthArray:
    """Raw values of a 16-bit grey PNG.

    The checksums are verified first: the decoder prints to stderr on damaged files, and some of
    its versions deliver half of a truncated one as if it were whole.

    Returns
    -------
    uint16 array of shape (height, width)

    Raises
    ------
    DamagedRecordingError
        Naming the file, what was expected and what was found.
    """
    data = _read_bytes(path, MAX_FILE_BYTES)
    shape = _size_from_header(path, data[:HEADER_BYTES])
    _check_chunks(path, data)
    raw = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if raw is None or raw.dtype != np.uint16 or raw.shape != shape:
        raise DamagedRecordingError(f"'{path}' cannot be decoded although its checksums are right; {_NEXT}.")
    return np.asarray(raw, dtype=np.uint16)


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
    try:
        # Opening a pipe or a device in the folder would wait for ever.
        if not path.is_file():
            raise DamagedRecordingError(f"'{path}' is no regular file; {_NEXT}.")
        with path.open("rb") as file:
            return file.read(limit)
    except OSError as error:
        raise DamagedRecordingError(
            f"'{path}' cannot be read ({error.strerror}); check that it is there and its permissions."
        ) from error


def _size_from_header(path: Path, header: bytes) -> tuple[int, int]:
    if header.startswith(b"version https://git-lfs"):
        raise DamagedRecordingError(f"'{path}' is a Git LFS pointer and not the image; `git lfs pull` fetches it.")
    if not header.startswith(SIGNATURE) or header[12:16] != b"IHDR":
        what = "empty" if not header else "no PNG file, whatever its name says"
        raise DamagedRecordingError(f"'{path}' is {what}; {_NEXT}.")
    if len(header) < HEADER_BYTES:
        raise DamagedRecordingError(f"'{path}' is cut off after {len(header)} bytes; copy it again.")
    width, height = (int.from_bytes(header[at : at + 4], "big") for at in (16, 20))
    bits, colour = header[24], header[25]
    if (bits, colour) != (16, 0):
        kind = _COLOURS.get(colour, f"colour type {colour}")
        raise DamagedRecordingError(f"'{path}' is an {bits}-bit {kind} PNG; {_NEXT}.")
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise DamagedRecordingError(
            f"'{path}' claims to be {width}x{height} pixels; allowed are 1 to {MAX_SIDE} each way."
        )
    return height, width


def _check_chunks(path: Path, data: bytes) -> None:
    """Walk the chunks: lengths, checksums, and the end mark."""
    view = memoryview(data)
    at = len(SIGNATURE)
    while at + 12 <= len(data):
        length = int.from_bytes(view[at : at + 4], "big")
        name, end = bytes(view[at + 4 : at + 8]), at + 12 + length
        if end > len(data):
            break
        if zlib.crc32(view[at + 4 : end - 4]) != int.from_bytes(view[end - 4 : end], "big"):
            raise DamagedRecordingError(
                f"'{path}' is damaged: the checksum of its part at byte {at} is wrong; copy it"
                " again, or remove it from the folder."
            )
        if name == b"IEND":
            return
        at = end
    raise DamagedRecordingError(
        f"'{path}' is cut off: it ends after {len(data)} bytes without its end mark; copy it again,"
        " or remove it from the folder."
    )
