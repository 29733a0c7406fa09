"""Points and triangles from a PLY file (Stanford's polygon format, ascii or binary)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.errors import DamagedRecordingError, SourceNotFoundError

_SCALARS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_HEADER_LIMIT = 64 * 1024
_LARGEST = 1e100  # of a coordinate: differences and squares still have room
_FACE_LISTS = ("vertex_indices", "vertex_index")


@dataclass(frozen=True, eq=False)
class Mesh:
    """An object's surface.

    Parameters
    ----------
    points : float64 array of shape (n, 3)
        Vertices, in the file's own unit and axes; all finite, n >= 1.
    triangles : int32 array of shape (m, 3)
        Corners as indices into `points`; m = 0 for a cloud of points only. Polygons are cut
        into fans.
    """

    points: npt.NDArray[np.float64]
    triangles: npt.NDArray[np.int32]


@dataclass
class _Property:
    name: str
    scalar: str  # numpy code without byte order
    count: str | None = None  # the same of a list's length; None for a plain value


@dataclass
class _Element:
    name: str
    rows: int
    properties: list[_Property] = field(default_factory=list)


def read_ply(path: Path) -> Mesh:
    """Read the vertices and faces of a PLY file.

    Other elements and properties (colours, normals, Stanford's triangle strips) are stepped
    over. Nothing is allocated on the word of the header alone: a count that the file is too
    short for is refused first.

    Parameters
    ----------
    path : Path
        A regular file.

    Raises
    ------
    SourceNotFoundError
        If there is no such file, or it is no PLY file.
    DamagedRecordingError
        If it is one and cannot be read: a bad header, a truncated body, a face that names no
        vertex, coordinates that are not finite.
    """
    if not path.is_file():
        raise SourceNotFoundError(f"'{path}' is not a file; give the path of a .ply file")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceNotFoundError(f"'{path}' cannot be read: {error.strerror}") from error
    try:
        order, elements, start = _header(data)
        columns = _ascii_body(data[start:], elements) if order == "" else None
        if columns is None:
            columns = _binary_body(data, start, order, elements)
        return _mesh(columns)
    except _NoPlyError:
        raise SourceNotFoundError(
            f"'{path}' is no PLY file: it does not begin with the line 'ply'"
        ) from None
    except _BadPlyError as error:
        raise DamagedRecordingError(
            f"'{path}' cannot be read: {error}. Export the object again as PLY."
        ) from error


class _NoPlyError(Exception):
    """The file is something else."""


class _BadPlyError(Exception):
    """What is wrong, as a clause."""


_Columns = dict[tuple[str, str], "npt.NDArray[np.generic] | _Lists"]


@dataclass
class _Lists:
    """A list property: the lists' lengths, shape (rows,), and their items, end to end."""

    lengths: npt.NDArray[np.int64]
    items: npt.NDArray[np.generic]


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """Byte order ('' = ascii), elements, and where the body begins."""
    if not data.startswith((b"ply\n", b"ply\r\n", b"ply\r")):
        raise _NoPlyError
    end = data.find(b"end_header", 0, _HEADER_LIMIT)
    if end < 0:
        raise _BadPlyError("its header has no end")
    start = end + len(b"end_header")
    if data[start : start + 2] == b"\r\n":
        start += 2
    elif data[start : start + 1] in (b"\n", b"\r"):
        start += 1
    else:
        raise _BadPlyError("nothing follows its header")
    order: str | None = None
    elements: list[_Element] = []
    for line in data[:end].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        match words:
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, _] if name in _FORMATS and order is None:
                order = _FORMATS[name]
            case ["element", name, rows] if rows.isascii() and rows.isdecimal() and len(rows) < 12:
                elements.append(_Element(name, int(rows)))
            case ["property", scalar, name] if scalar in _SCALARS and elements:
                elements[-1].properties.append(_Property(name, _SCALARS[scalar]))
            case ["property", "list", count, scalar, name] if (
                count in _SCALARS and scalar in _SCALARS and elements
            ):
                if _SCALARS[count].startswith("f"):
                    raise _BadPlyError(f"its header gives a list length as {count}: '{line}'")
                elements[-1].properties.append(_Property(name, _SCALARS[scalar], _SCALARS[count]))
            case _:
                raise _BadPlyError(f"its header has the line '{line[:80]}'")
    if order is None:
        raise _BadPlyError("its header names no format")
    return order, elements, start


def _ascii_body(data: bytes, elements: list[_Element]) -> _Columns:
    try:
        numbers = np.array(data.split(), dtype=np.float64)
    except ValueError as error:
        raise _BadPlyError(f"its text holds something else than numbers ({error})") from error
    columns: _Columns = {}
    at = 0
    for element in elements:
        at = _walk_numbers(numbers, at, element, columns)
    return columns


def _walk_numbers(
    numbers: npt.NDArray[np.float64], at: int, element: _Element, columns: _Columns
) -> int:
    """Cut one element out of a row of numbers; return where the next one begins."""
    properties, rows = element.properties, element.rows
    if not rows or not properties:
        return at
    _check_room(len(numbers) - at, rows * len(properties), element, "numbers")
    # The usual case first: all lists of the element are as long as those of its first row.
    lengths, width = [], 0
    for each in properties:
        length = 1
        if each.count is not None:
            _check_room(len(numbers) - at, width + 1, element, "numbers")
            length = _list_length(numbers[at + width])
            width += 1
        lengths.append(length)
        width += length
    if width * rows <= len(numbers) - at:
        table = numbers[at : at + width * rows].reshape(rows, width)
        column = 0
        uniform: _Columns = {}
        for each, length in zip(properties, lengths, strict=True):
            if each.count is not None:
                if not (table[:, column] == length).all():
                    break
                column += 1
                flat = table[:, column : column + length].ravel()
                uniform[element.name, each.name] = _Lists(np.full(rows, length), flat)
            else:
                uniform[element.name, each.name] = table[:, column]
            column += length
        else:
            columns.update(uniform)
            return at + width * rows
    values: list[list[float]] = [[] for _ in properties]
    counts: list[list[int]] = [[] for _ in properties]
    for _ in range(rows):
        for number, each in enumerate(properties):
            length = 1
            if each.count is not None:
                _check_room(len(numbers) - at, 1, element, "numbers")
                length = _list_length(numbers[at])
                counts[number].append(length)
                at += 1
            _check_room(len(numbers) - at, length, element, "numbers")
            values[number].extend(numbers[at : at + length].tolist())
            at += length
    _store(element, values, counts, columns)
    return at


def _binary_body(data: bytes, at: int, order: str, elements: list[_Element]) -> _Columns:
    columns: _Columns = {}
    for element in elements:
        at = _walk_bytes(data, at, order, element, columns)
    return columns


def _walk_bytes(data: bytes, at: int, order: str, element: _Element, columns: _Columns) -> int:
    """Cut one element out of the bytes; return where the next one begins."""
    properties, rows = element.properties, element.rows
    if not rows or not properties:
        return at
    least = sum(int((each.count or each.scalar)[1:]) for each in properties)
    _check_room(len(data) - at, rows * least, element, "bytes")
    # The usual case first: all lists of the element are as long as those of its first row.
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    width = 0
    for number, each in enumerate(properties):
        if each.count is None:
            fields.append((f"v{number}", order + each.scalar))
        else:
            length = _length_at(data, at + width, order + each.count, element)
            fields.append((f"n{number}", order + each.count))
            fields.append((f"v{number}", order + each.scalar, (length,)))
            width += int(each.count[1:])
        width = np.dtype(fields).itemsize
    if width * rows <= len(data) - at:
        table = np.frombuffer(data, np.dtype(fields), rows, at)
        if all((table[f"n{k}"] == table[f"n{k}"][0]).all()
               for k, each in enumerate(properties) if each.count is not None):  # fmt: skip
            for k, each in enumerate(properties):
                value = table[f"v{k}"]
                columns[element.name, each.name] = (
                    value
                    if each.count is None
                    else _Lists(table[f"n{k}"].astype(np.int64), value.ravel())
                )
            return at + width * rows
    values: list[list[float]] = [[] for _ in properties]
    counts: list[list[int]] = [[] for _ in properties]
    for _ in range(rows):
        for number, each in enumerate(properties):
            length = 1
            if each.count is not None:
                length = _length_at(data, at, order + each.count, element)
                counts[number].append(length)
                at += int(each.count[1:])
            size = length * int(each.scalar[1:])
            _check_room(len(data) - at, size, element, "bytes")
            values[number].extend(np.frombuffer(data, order + each.scalar, length, at).tolist())
            at += size
    _store(element, values, counts, columns)
    return at


def _store(
    element: _Element, values: list[list[float]], counts: list[list[int]], columns: _Columns
) -> None:
    for each, value, count in zip(element.properties, values, counts, strict=True):
        array = np.array(value, dtype=np.float64)
        columns[element.name, each.name] = (
            array if each.count is None else _Lists(np.array(count, dtype=np.int64), array)
        )


def _length_at(data: bytes, at: int, code: str, element: _Element) -> int:
    _check_room(len(data) - at, int(code[2:]), element, "bytes")
    return _list_length(float(np.frombuffer(data, code, 1, at)[0]))


def _list_length(number: float) -> int:
    if not 0 <= number < 2**31 or number != int(number):
        raise _BadPlyError(f"it has a list of {number:g} items")
    return int(number)


def _check_room(there: int, needed: int, element: _Element, unit: str) -> None:
    if needed > there:
        raise _BadPlyError(
            f"it ends within its {element.rows} rows of '{element.name}':"
            f" at least {needed - there} {unit} are missing"
        )


def _mesh(columns: _Columns) -> Mesh:
    axes = []
    for axis in "xyz":
        column = columns.get(("vertex", axis))
        if not isinstance(column, np.ndarray):
            raise _BadPlyError(f"it has no vertices with a plain property '{axis}'")
        axes.append(column.astype(np.float64))
    points = np.stack(axes, axis=1)
    if not (np.abs(points) < _LARGEST).all():  # NaN fails as well
        raise _BadPlyError(f"some of its coordinates are not finite, or beyond {_LARGEST:g}")
    faces = next((columns[key] for name in _FACE_LISTS if (key := ("face", name)) in columns), None)
    if not isinstance(faces, _Lists):
        return Mesh(points, np.zeros((0, 3), np.int32))
    items = faces.items.astype(np.float64)
    if items.size and not (items.min() >= 0 and items.max() < len(points)):
        raise _BadPlyError(
            f"a face names vertex {items.max():g} or {items.min():g}, but there are"
            f" {len(points)} vertices"
        )
    return Mesh(points, _fans(faces.lengths, items.astype(np.int32)))


def _fans(lengths: npt.NDArray[np.int64], corners: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Triangles of polygons: each cut into a fan round its first corner."""
    counts = np.maximum(lengths - 2, 0)
    first = np.repeat(np.cumsum(lengths) - lengths, counts)
    step = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.stack(
        (corners[first], corners[first + step + 1], corners[first + step + 2]), axis=1
    ).astype(np.int32)
