"""The sidecar of a recorded folder: scale, camera, frame rate and timestamps in ``frames.toml``.

::

    values_per_metre = 1000.0
    fps = 30.0
    missing = [0, 65535]
    timestamps_us = [0, 33333, 66667]

    [camera]
    width = 640
    height = 480
    fx = 585.0
    fy = 585.0
    cx = 320.0
    cy = 240.0

    colour_registered = true
    colour_place_mm = [25.0, 0.0, 0.0]
    colour_timestamps_us = [8, 33341, 66675]
    [colour_camera]
    …

Every entry may be left out. TOML is read by the standard library and can only hold data.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import tomli_w

from selective_depth.drivers.errors import DamagedRecordingError
from selective_depth.drivers.folder.images import MAX_SIDE, damaged, opened
from selective_depth.drivers.frame import MOST_PX, MOST_TIME_US, Camera

SIDECAR: Final = "frames.toml"

SCHEMA: Final = 1
MILLIMETRES: Final = 1000.0
"""Values per metre, where nothing is said."""

_MAX_TEXT_BYTES: Final = 16 * 1024 * 1024


@dataclass(frozen=True)
class Sidecar:
    """Settings of a recorded folder; None where nothing is said.

    Parameters
    ----------
    values_per_metre : float or None
        PNG value of one metre: 1000 = millimetres (the default), 5000 = the TUM recordings.
    camera : Camera or None
        Intrinsics; default: known from the layout, or a Kinect's.
    fps : float or None
        Nominal frame rate; default: from the timestamps, or 30.
    missing : tuple of int or None
        PNG values that mean "no measurement", beside 0 which always does.
    timestamps_us : tuple of int or None
        One per frame, in the order of the files' names; default: spaced by the frame rate.
    colour_registered : bool or None
        Whether the colour images lie on the depth images; default as the layout has it.
    colour_camera : Camera or None
        Intrinsics of the colour camera.
    colour_place_mm : tuple of three floats or None
        Where it stands along the depth camera's axes.
    colour_timestamps_us : tuple of int or None
        One per frame; of one without a colour image, any.
    schema : int
        Version of these entries.
    """

    values_per_metre: float | None = None
    camera: Camera | None = None
    fps: float | None = None
    missing: tuple[int, ...] | None = None
    timestamps_us: tuple[int, ...] | None = None
    colour_registered: bool | None = None
    colour_camera: Camera | None = None
    colour_place_mm: tuple[float, ...] | None = None
    colour_timestamps_us: tuple[int, ...] | None = None
    schema: int = SCHEMA


def read_sidecar(folder: Path) -> Sidecar:
    """The sidecar of a folder; nothing said if there is none.

    Raises
    ------
    DamagedRecordingError
        If it is not TOML, or an entry is unknown or wrong, naming the entry and what is allowed.
    """
    path = folder / SIDECAR
    if not path.exists():
        return Sidecar()
    try:
        entries = tomllib.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        advice = "correct it, or remove it to use defaults"
        raise damaged(path, f"is not valid TOML ({str(error) or 'nested too deep'})", advice) from error
    try:
        schema = entries.pop("schema", SCHEMA)
        if not isinstance(schema, int) or isinstance(schema, bool) or schema > SCHEMA:
            raise _WrongEntryError(
                "schema", schema, f"up to {SCHEMA}; a later version of this program wrote it, use that"
            )
        for name in entries:
            if name not in _ENTRIES:
                raise _WrongEntryError(name, "no such entry", f"one of {', '.join(Sidecar.__dataclass_fields__)}")
        return Sidecar(**{name: _ENTRIES[name](name, value) for name, value in entries.items()})
    except _WrongEntryError as error:
        name, got, allowed = error.args
        try:
            shown = f"{got!s:.80}"
        except ValueError:  # Python refuses to print whole numbers of thousands of digits
            shown = "a number too long to print"
        raise DamagedRecordingError(f"'{name:.40}' in '{path}' is wrong: got {shown}; allowed is {allowed}.") from None


def write_sidecar(folder: Path, sidecar: Sidecar) -> None:
    """Write ``frames.toml``, whole or not at all."""
    said = {name: _plain(value) for name, value in vars(sidecar).items() if value is not None}
    text = "# Depth frames as 16-bit PNG: what the numbers in the files mean.\n"
    new = folder / f"{SIDECAR}.new"
    try:
        new.write_text(text + tomli_w.dumps(said), encoding="utf-8")
        new.replace(folder / SIDECAR)
    except OSError:
        new.unlink(missing_ok=True)
        raise


def read_text(path: Path) -> str:
    """A small text file.

    Raises
    ------
    DamagedRecordingError
        If it is not a regular file, too large, unreadable or not UTF-8.
    """
    with opened(path, "remove it") as file:
        data = file.read(_MAX_TEXT_BYTES + 1)
    if len(data) > _MAX_TEXT_BYTES:
        raise damaged(path, f"is larger than {_MAX_TEXT_BYTES // 2**20} MiB, too large for such a file", "remove it")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise damaged(path, f"is not UTF-8 text (byte {error.start})", "correct it, or remove it") from error


def _plain(value: Any) -> Any:
    """What TOML can hold: a table of a camera, a list of a tuple, Python's numbers of NumPy's."""
    if isinstance(value, Camera):
        return {key: _plain(getattr(value, key)) for key in _CAMERA}
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return value.item() if isinstance(value, np.generic) else value


class _WrongEntryError(Exception):
    """An entry's name, what it is, and what is allowed."""


_Check = Callable[[str, Any], Any]
"""Takes the name of an entry and what TOML holds for it; returns its value, or raises `_WrongEntryError`."""


def _number(least: float, most: float, whole: bool = False) -> _Check:
    allowed = f"a {'whole ' * whole}number from {least} to {most}"

    def check(name: str, value: Any) -> float:
        right = isinstance(value, int if whole else int | float) and not isinstance(value, bool)
        if not right or not least <= value <= most:
            raise _WrongEntryError(name, value, allowed)
        return value if whole else float(value)

    return check


def _several(each: _Check, allowed: str, count: int | None = None) -> _Check:
    def check(name: str, values: Any) -> tuple[Any, ...]:
        if not isinstance(values, list) or count not in (None, len(values)):
            raise _WrongEntryError(name, values, allowed)
        return tuple(each(name, value) for value in values)

    return check


def _flag(name: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise _WrongEntryError(name, value, "true or false")
    return value


def _camera(name: str, value: Any) -> Camera:
    if not isinstance(value, dict) or set(value) != set(_CAMERA):
        raise _WrongEntryError(name, value, f"a table of exactly {', '.join(_CAMERA)}")
    numbers = {key: check(key, value[key]) for key, check in _CAMERA.items()}
    try:
        return Camera(**numbers)
    except ValueError as error:
        raise _WrongEntryError(name, error, "a possible camera") from error


_PX = _number(-MOST_PX, MOST_PX)
_SIDE = _number(1, MAX_SIDE, whole=True)
_TIMES = _several(_number(-MOST_TIME_US, MOST_TIME_US, whole=True), "a list of whole numbers")
_CAMERA: Final = {"width": _SIDE, "height": _SIDE, "fx": _PX, "fy": _PX, "cx": _PX, "cy": _PX}
_ENTRIES: Final[dict[str, _Check]] = {
    "values_per_metre": _number(1e-2, 1e6),
    "camera": _camera,
    "fps": _number(1e-3, 1e4),
    "missing": _several(_number(0, 65535, whole=True), "a list of whole numbers"),
    "timestamps_us": _TIMES,
    "colour_registered": _flag,
    "colour_camera": _camera,
    "colour_place_mm": _several(_PX, "a list of three numbers", 3),
    "colour_timestamps_us": _TIMES,
}
"""What each entry may be."""
