"""Writing results: refused early where possible, and with one sentence where not."""

from __future__ import annotations

import errno
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from selective_depth.app.console.errors import UsageError
from selective_depth.drivers.errors import OutputError

PICTURES = (".png", ".webp")
_WEBP_QUALITY = 80
_FULL = (errno.ENOSPC, errno.EDQUOT)


def cannot_write(path: Path, error: OSError) -> OutputError:
    """The error of a file or folder that cannot be written: why, and what to do about it."""
    remedy = (
        "Make room there, or name another place."
        if error.errno in _FULL
        else "Name one in a folder that exists and is yours to write."
    )
    return OutputError(f"'{path}' cannot be written: {error.strerror or error}. {remedy}")


def check_output(*paths: Path | None) -> None:
    """Refuse files that cannot be made, before the work is done and not after.

    Raises
    ------
    OutputError
        If a folder does not exist.
    """
    for path in paths:
        if path is not None and not path.resolve().parent.is_dir():
            raise OutputError(f"'{path}' cannot be written: its folder does not exist. Make it.")


def check_picture(path: Path | None) -> None:
    """Refuse a picture that cannot be made, before the work is done and not after.

    Raises
    ------
    UsageError
        If its ending names no known kind.
    OutputError
        If its folder does not exist.
    """
    if path is not None and path.suffix.lower() not in PICTURES:
        raise UsageError(f"'{path}' is no picture's name: pictures end in .png or .webp.")
    check_output(path)


def write_output(path: Path, data: bytes | str) -> None:
    """Write a file.

    Raises
    ------
    OutputError
        If that fails, saying why.
    """
    try:
        path.write_bytes(data.encode() if isinstance(data, str) else data)
    except OSError as error:
        raise cannot_write(path, error) from error


def write_picture(path: Path, image: npt.NDArray[np.uint8]) -> None:
    """Write a blue-green-red picture as PNG or WebP, by the file's ending.

    Raises
    ------
    OutputError
        If that fails, saying why.
    """
    kind = path.suffix.lower()
    options = [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY] if kind == ".webp" else []
    _, data = cv2.imencode(kind, image, options)
    write_output(path, data.tobytes())
