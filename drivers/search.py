"""Recordings below a folder, found by what they look like, without being opened."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from selective_depth.drivers.errors import DamagedRecordingError, SourceNotFoundError
from selective_depth.drivers.folder import SIDECAR, find_layout, is_depth_png
from selective_depth.drivers.options import parted

FILES = (".oni", ".bag", ".mcap")
"""Endings of recordings that are one file."""


def find_recordings(source: str, leave_out: Path | None = None) -> Iterator[str]:
    """Everything below a source that `open_source` would open, in the order of the names.

    Files are told by their ending, folders by their layout; what lies inside a recorded folder
    is part of it. A folder that holds nothing is named too, for opening it to say so.

    Parameters
    ----------
    source : str
        A folder, perhaps with options after ``?`` that hold for all that is in it. Anything else
        is returned as it is.
    leave_out : Path, optional
        A folder that is not looked into.

    Yields
    ------
    str
        As `open_source` takes it.
    """
    name, query = parted(source)
    if not Path(name).is_dir():
        yield source
        return
    for path in _below(Path(name), leave_out and leave_out.resolve()):
        yield f"{path}?{query}" if query else str(path)


def _below(folder: Path, leave_out: Path | None) -> Iterator[Path]:
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    except OSError:  # opening it says why
        yield folder
        return
    files = [entry.name for entry in entries if not entry.is_dir()]
    folders = [Path(entry.path) for entry in entries if entry.is_dir() and entry.name[0] != "."]
    # A link that leads back up would never end.
    folders = [each for each in folders if not (each.is_symlink() and folder.resolve().is_relative_to(each.resolve()))]
    if "metadata.yaml" in files or not (folders or set(files) - {SIDECAR}):  # a bag, or nothing
        yield folder
        return
    yield from (folder / name for name in files if Path(name).suffix.lower() in FILES)
    inside: list[str] = []
    try:
        found = find_layout(folder)
    except SourceNotFoundError:
        pass
    except DamagedRecordingError:  # opening it says why
        yield folder
        return
    else:
        pattern = found.row.depth
        if pattern != "*":
            several = set(pattern.rpartition("/")[0]) & set("*[")  # cameras of one recording
            yield from sorted({path.parent for path in folder.glob(pattern)}) if several else (folder,)
            return
        if SIDECAR in files or any(is_depth_png(found.files[at]) for at in (0, -1)):
            yield folder
            inside = [colour.partition("/")[0] for colour in found.row.colour.split("|")]
    for each in folders:
        if each.name not in inside and each.resolve() != leave_out:
            yield from _below(each, leave_out)
