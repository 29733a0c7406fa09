"""Writing results whole or not at all: refused early where possible, else with one sentence."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
import numpy.typing as npt

from selective_depth.app.console.errors import UsageError
from selective_depth.drivers.errors import OutputError

PICTURES = (".png", ".webp", ".pdf", ".svg")
IMAGES = (".png", ".webp")
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


def check_picture(path: Path | None, endings: Sequence[str] = PICTURES, what: str = "picture") -> None:
    """Refuse a picture, or the like, that cannot be made, before the work is done and not after.

    Parameters
    ----------
    path : Path or None
        The picture, if there is to be one.
    endings : sequence of str, default .png, .webp, .pdf, .svg
        What it may end in.
    what : str, default "picture"
        What it is called.

    Raises
    ------
    UsageError
        If its ending names no known format.
    OutputError
        If its folder does not exist.
    """
    if path is not None and path.suffix.lower() not in endings:
        allowed = f"{', '.join(endings[:-1])} or {endings[-1]}"
        raise UsageError(f"'{path}' cannot be a {what}: its name must end in {allowed}.")
    check_output(path)


def make_folder(path: Path) -> None:
    """Make a folder, and those above it, unless it is there.

    Raises
    ------
    OutputError
        If that fails, saying why.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(path, error) from error


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Open a file that takes its name, and the older file's place, when it is whole on the disk.

    It is written under another name beside it and renamed at the end, so that a full disk, an
    error or a killed process leaves the older file as it was. Anything but a regular file, such as
    ``/dev/stdout`` or a named pipe, is written directly.

    Raises
    ------
    OutputError
        If that fails, saying why; nothing is left of the new file then.
    """
    part: Path | None = None
    try:
        if path.parent == Path("/dev") or (path.exists() and not path.is_file()):
            with path.open("wb") as file:
                yield file
            return
        target = Path(os.path.realpath(path))  # a link stays one
        part = target.with_name(f".{secrets.token_hex(6)}.part")
        with part.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if target.exists():
            shutil.copymode(target, part)
        part.replace(target)
    except OSError as error:
        raise cannot_write(path, error) from error
    finally:
        if part is not None:
            with suppress(OSError):  # renamed, or never made
                part.unlink()


def lock(file: BinaryIO) -> bool:
    """Keep other runs from a file for as long as it is open; False if one has it."""
    if sys.platform != "win32":
        import fcntl

        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:
            return True  # a file system without locks
    return True


def write_output(path: Path, data: bytes | str) -> None:
    """Write a file whole or not at all, text as UTF-8.

    Raises
    ------
    OutputError
        If that fails, saying why; an older file of that name stays as it was.
    """
    with replacing(path) as file:
        file.write(data.encode("utf-8", "backslashreplace") if isinstance(data, str) else data)


def write_image(path: Path, image: npt.NDArray[np.uint8 | np.uint16]) -> None:
    """Write a blue-green-red image, or one of grey, as PNG or WebP, by the file's ending.

    Raises
    ------
    OutputError
        If that fails, saying why.
    """
    kind = path.suffix.lower()
    options = [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY] if kind == ".webp" else []
    write_output(path, cv2.imencode(kind, image, options)[1].tobytes())
