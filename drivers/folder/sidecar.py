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
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import tomli_w

from selective_depth.drivers.errors import DamagedRecordingError
from selective_depth.drivers.folder.images import MAX_SIDE
from selective_depth.drivers.frame import MOST_PX, MOST_TIME_US, Camera

SIDECAR: Final = "frames.toml"

SCHEMA: Final = 1

_MAX_TEXT_BYTES: Final = 16 * 1024 * 1024
_CAMERA_KEYS: Final = ("width", "height", "fx", "fy", "cx", "cy")


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
        If it is no TOML, or an entry is unknown or wrong, naming the entry and what is allowed.
    """
    path = folder / SIDECAR
    if not path.exists():
        return Sidecar()
    try:
        entries = tomllib.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise DamagedRecordingError(
            f"'{path}' is no valid TOML ({str(error) or 'nested too deep'}); correct it, or remove it to use defaults."
        ) from error
    known = Sidecar.__dataclass_fields__
    if not _is_integer(schema := entries.get("schema", SCHEMA)) or schema > SCHEMA:
        raise _wrong(path, "schema", schema, f"up to {SCHEMA}; a later version of this program wrote it, use that")
    for name in entries:
        if name not in known:
            raise _wrong(path, name, "no such entry", f"one of {', '.join(known)}")
    return Sidecar(
        values_per_metre=_number(path, entries, "values_per_metre", 1e-2, 1e6),
        camera=_camera(path, entries, "camera"),
        fps=_number(path, entries, "fps", 1e-3, 1e4),
        missing=_integers(path, entries, "missing", 0, 65535),
        timestamps_us=_integers(path, entries, "timestamps_us", -MOST_TIME_US, MOST_TIME_US),
        colour_registered=_truth(path, entries, "colour_registered"),
        colour_camera=_camera(path, entries, "colour_camera"),
        colour_place_mm=_place(path, entries, "colour_place_mm"),
        colour_timestamps_us=_integers(path, entries, "colour_timestamps_us", -MOST_TIME_US, MOST_TIME_US),
    )


def write_sidecar(folder: Path, sidecar: Sidecar) -> None:
    """Write ``frames.toml``, whole or not at all."""
    said: dict[str, Any] = {}
    for name, value in vars(sidecar).items():
        if isinstance(value, Camera):
            sizes = {key: int(getattr(value, key)) for key in _CAMERA_KEYS[:2]}
            said[name] = sizes | {key: float(getattr(value, key)) for key in _CAMERA_KEYS[2:]}
        elif name == "colour_place_mm" and value is not None:
            said[name] = [float(each) for each in value]
        elif isinstance(value, tuple):
            said[name] = [int(each) for each in value]  # NumPy's whole numbers too
        elif value is not None:
            said[name] = value if isinstance(value, bool) or name == "schema" else float(value)
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
        If it is no regular file, too large, unreadable or no UTF-8.
    """
    try:
        if not path.is_file():
            raise DamagedRecordingError(f"'{path}' is no regular file; remove it.")
        with path.open("rb") as file:
            data = file.read(_MAX_TEXT_BYTES + 1)
        if len(data) > _MAX_TEXT_BYTES:
            raise DamagedRecordingError(
                f"'{path}' is larger than {_MAX_TEXT_BYTES // 2**20} MiB, which no sidecar is; remove it."
            )
        return data.decode("utf-8-sig")
    except OSError as error:
        raise DamagedRecordingError(f"'{path}' cannot be read ({error.strerror}); check its permissions.") from error
    except UnicodeDecodeError as error:
        raise DamagedRecordingError(
            f"'{path}' is no UTF-8 text (byte {error.start}); correct it, or remove it."
        ) from error


def _camera(path: Path, entries: dict[str, Any], name: str) -> Camera | None:
    table = entries.get(name)
    if table is None:
        return None
    if not isinstance(table, dict) or set(table) != set(_CAMERA_KEYS):
        raise _wrong(path, name, table, f"a table of exactly {', '.join(_CAMERA_KEYS)}")
    for key in ("width", "height"):
        if not _is_integer(table[key]) or not 1 <= table[key] <= MAX_SIDE:
            raise _wrong(path, key, table[key], f"a whole number from 1 to {MAX_SIDE}")
    for key in _CAMERA_KEYS[2:]:
        _number(path, table, key, -MOST_PX, MOST_PX)
    try:
        return Camera(table["width"], table["height"], *(float(table[key]) for key in _CAMERA_KEYS[2:]))
    except ValueError as error:
        raise _wrong(path, name, error, "a camera that can be") from error


def _truth(path: Path, entries: dict[str, Any], name: str) -> bool | None:
    value = entries.get(name)
    if value is not None and not isinstance(value, bool):
        raise _wrong(path, name, value, "true or false")
    return value


def _place(path: Path, entries: dict[str, Any], name: str) -> tuple[float, ...] | None:
    values = entries.get(name)
    if values is None:
        return None
    if not isinstance(values, list) or len(values) != 3:
        raise _wrong(path, name, values, "a list of three numbers")
    return tuple(_number(path, {name: each}, name, -MOST_PX, MOST_PX) or 0.0 for each in values)


def _number(path: Path, entries: dict[str, Any], name: str, least: float, most: float) -> float | None:
    value = entries.get(name)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
        raise _wrong(path, name, value, f"a number from {least:g} to {most:g}")
    return float(value)


def _integers(path: Path, entries: dict[str, Any], name: str, least: int, most: int) -> tuple[int, ...] | None:
    values = entries.get(name)
    if values is None:
        return None
    if not isinstance(values, list) or not all(_is_integer(value) and least <= value <= most for value in values):
        raise _wrong(path, name, values, f"a list of whole numbers from {least} to {most}")
    return tuple(values)


def _is_integer(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _wrong(path: Path, name: str, got: object, allowed: str) -> DamagedRecordingError:
    try:
        shown = f"{got!s:.80}"
    except ValueError:  # Python refuses to print whole numbers of thousands of digits
        shown = "a number too long to print"
    return DamagedRecordingError(f"'{name:.40}' in '{path}' is wrong: got {shown}; allowed is {allowed}.")
