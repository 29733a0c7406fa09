"""Files that may be anything: opened, skipped through and read so that nothing waits for ever."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path
from typing import BinaryIO

from selective_depth.drivers.errors import DamagedRecordingError, SourceNotFoundError
from selective_depth.drivers.oni.nodes import OniFrame


def open_regular(path: Path) -> BinaryIO:
    """Open a file for reading, unbuffered, unless reading it could take for ever.

    Raises
    ------
    SourceNotFoundError
        If there is no such file, it is not a regular file (a folder, a pipe, a device) or cannot be
        opened.
    """
    try:
        if not path.exists():
            raise SourceNotFoundError(f"'{path}' does not exist; check its name.")
        if not path.is_file():
            what = "a folder" if path.is_dir() else "not a regular file"
            raise SourceNotFoundError(f"'{path}' is {what}; give a recording, FILE.oni.")
        return path.open("rb", buffering=0)
    except OSError as error:
        raise unreadable(path, error) from error


def unreadable(path: Path, error: OSError) -> SourceNotFoundError:
    """The error of a file that the system does not let us read."""
    return SourceNotFoundError(f"'{path}' cannot be read ({error.strerror}); check its name and its permissions.")


def skip_hole(file: BinaryIO, offset: int) -> int:
    """First byte at or after an offset that is really on the disk."""
    if sys.platform != "linux":
        return offset
    try:
        return os.lseek(file.fileno(), offset, os.SEEK_DATA)
    except OSError as error:
        # Nothing but a hole up to the end; or a file system that does not know.
        return file.seek(0, os.SEEK_END) if error.errno == errno.ENXIO else offset


def read_payload(file: BinaryIO, frame: OniFrame) -> bytes:
    """Compressed data of a frame.

    Raises
    ------
    DamagedRecordingError
        If the disk does not give it.
    """
    try:
        file.seek(frame.payload_offset)
        return file.read(frame.payload_size)
    except OSError as error:
        raise DamagedRecordingError(
            f"'{file.name}' cannot be read at byte {frame.payload_offset} ({error.strerror}); is its disk in order?"
        ) from error
