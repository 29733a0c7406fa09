"""The optional package that reads and writes bags, and its errors as ours."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from selective_depth.drivers.errors import DamagedRecordingError, SourceError


def rosbags(module: str) -> Any:
    """A module of the package rosbags.

    Raises
    ------
    SourceError
        If it is not installed.
    """
    import importlib

    try:
        return importlib.import_module(f"rosbags.{module}")
    except ImportError as error:
        raise SourceError("ROS bags need the package rosbags (no ROS): pip install 'selective-depth[ros]'.") from error


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turn whatever the package raises on a bag into one sentence that says how to mend it."""
    try:
        yield
    except SourceError:
        raise
    except Exception as error:
        mend = (
            f"ros2 bag reindex '{path}'"
            if path.is_dir()
            else f"rosbag reindex '{path}'"
            if path.suffix == ".bag"
            else f"mcap recover '{path}' -o OUT.mcap"
        )
        what = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise DamagedRecordingError(
            f"'{path}' cannot be read as a ROS bag ({what:.160}): it is cut off, damaged or lacks"
            f" its index. ROS repairs it with `{mend}`."
        ) from error
