"""Points and triangles from a PLY file (Stanford's polygon format, ascii or binary)."""

from __future__ import annotations

import re
import struct
from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from selective_depth.drivers.errors import DamagedRecordingError, SourceNotFoundError

_SCALARS = {
    "char": "b", "int8": "b", "uchar": "B", "uint8": "B",
    "short": "h", "int16": "h", "ushort": "H", "uint16": "H",
    "int": "i", "int32": "i", "uint": "I", "uint32": "I",
    "float": "f", "float32": "f", "double": "d", "float64": "d",
}  # fmt: skip
"""The codes of `struct`, which are NumPy's too."""
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_HEADER_LIMIT = 64 * 1024
_HEADER_END = re.compile(rb"end_header(\r\n|\r|\n)")
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
    scalar: str  # a code of `_SCALARS`, without byte order
    count: str | None = None  # the same of a list's length; None for a plain value

    @property
    def least(self) -> int:
        """Bytes it takes in a row at least: those of its value, or of its list's length."""
        return struct.calcsize("<" + (self.count or self.scalar))


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
        If there is no such file, or it is not a PLY file.
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
    if not data.startswith((b"ply\n", b"ply\r\n", b"ply\r")):
        raise SourceNotFoundError(f"'{path}' is not a PLY file: it does not begin with the line 'ply'")
    try:
        order, elements, start = _header(data)
        if not order:
            data, order, start = _binary(data[start:], elements), "<", 0
        columns: _Columns = {}
        for element in elements:
            start = _read_element(data, start, order, element, columns)
        return _mesh(columns)
    except _BadPlyError as error:
        raise DamagedRecordingError(f"'{path}' cannot be read: {error}. Export the object again as PLY.") from error


class _BadPlyError(Exception):
    """What is wrong, as a clause."""


@dataclass
class _Column:
    """One property of all rows: the lists' lengths, shape (rows,), and their items, end to end.

    A plain value is a list of one.
    """

    lengths: npt.NDArray[np.int64]
    items: npt.NDArray[np.float64]


_Columns = dict[tuple[str, str], _Column]


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """Byte order ('' = ascii), elements, and where the body begins."""
    end = _HEADER_END.search(data, 0, _HEADER_LIMIT)
    if end is None:
        raise _BadPlyError("its header has no end")
    order: str | None = None
    elements: list[_Element] = []
    for line in data[: end.start()].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        match words:
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, _] if name in _FORMATS and order is None:
                order = _FORMATS[name]
            case ["element", name, rows] if rows.isascii() and rows.isdecimal() and len(rows) < 12:
                if any(each.name == name for each in elements):
                    raise _BadPlyError(f"its header has two elements '{name:.40}'")
                elements.append(_Element(name, int(rows)))
            case ["property", scalar, name] if scalar in _SCALARS and elements:
                elements[-1].properties.append(_Property(name, _SCALARS[scalar]))
            case ["property", "list", count, scalar, name] if count in _SCALARS and scalar in _SCALARS and elements:
                if _SCALARS[count] in "fd":
                    raise _BadPlyError(f"its header gives a list length as {count}: '{line}'")
                elements[-1].properties.append(_Property(name, _SCALARS[scalar], _SCALARS[count]))
            case _:
                raise _BadPlyError(f"its header has the line '{line[:80]}'")
    if order is None:
        raise _BadPlyError("its header names no format")
    return order, elements, end.end()


def _binary(text: bytes, elements: list[_Element]) -> bytes:
    """A text body as a binary one in which everything is a double; `elements` are changed to it."""
    words = text.split()
    try:
        numbers = np.fromiter(map(float, words), "<f8", len(words))
    except ValueError as error:
        raise _BadPlyError(f"its text holds something other than numbers ({error!s:.100})") from error
    for element in elements:
        for each in element.properties:
            each.scalar, each.count = "d", each.count and "d"
    return numbers.tobytes()


def _read_element(data: bytes, at: int, order: str, element: _Element, columns: _Columns) -> int:
    """Cut one element out of the bytes; return where the next one begins."""
    if not element.rows or not element.properties:
        return at
    # Held against the bytes that are left before anything is sized by it.
    _check_room(data, at, element.rows * sum(each.least for each in element.properties), element)
    found, end = _walk(data, at, order, element, 1)
    size = (end - at) * element.rows
    alike = _table(data, at, order, element, found) if size <= len(data) - at else None
    found, end = (alike, at + size) if alike else _walk(data, at, order, element, element.rows)
    for each, column in zip(element.properties, found, strict=True):
        columns[element.name, each.name] = column
    return end


def _table(data: bytes, at: int, order: str, element: _Element, first: list[_Column]) -> list[_Column] | None:
    """The usual case: rows laid out as the first one, whose lists are of its lengths; None of others."""
    row: list[tuple[Any, ...]] = []
    for k, (each, column) in enumerate(zip(element.properties, first, strict=True)):
        row += [(f"length {k}", order + each.count)] if each.count else []
        row += [(f"items {k}", order + each.scalar, (len(column.items),))]
    try:
        table = np.frombuffer(data, np.dtype(row), element.rows, at)
    except ValueError:  # rows of gigabytes
        return None
    found = []
    for k, (each, column) in enumerate(zip(element.properties, first, strict=True)):
        if each.count and (table[f"length {k}"] != len(column.items)).any():
            return None
        items = table[f"items {k}"].ravel().astype(np.float64)
        found.append(_Column(np.full(element.rows, len(column.items)), items))
    return found


def _walk(data: bytes, at: int, order: str, element: _Element, rows: int) -> tuple[list[_Column], int]:
    """The next rows one by one, and the byte after them."""
    readers = [each.count and struct.Struct(order + each.count) for each in element.properties]
    found = [(array("q"), array("d")) for _ in readers]
    for _ in range(rows):
        for each, reader, (lengths, items) in zip(element.properties, readers, found, strict=True):
            length = 1
            if reader:
                _check_room(data, at, reader.size, element)
                number = reader.unpack_from(data, at)[0]
                at += reader.size
                if not 0 <= number < 2**31 or number != int(number):
                    raise _BadPlyError(f"it has a list of {number:g} items")
                length = int(number)
            size = length * struct.calcsize(order + each.scalar)
            _check_room(data, at, size, element)
            lengths.append(length)
            items.extend(struct.unpack_from(f"{order}{length}{each.scalar}", data, at))
            at += size
    return [_Column(np.array(lengths, np.int64), np.array(items, np.float64)) for lengths, items in found], at


def _check_room(data: bytes, at: int, needed: int, element: _Element) -> None:
    if needed > len(data) - at:
        raise _BadPlyError(f"it ends within its {element.rows} rows of '{element.name:.40}'")


def _mesh(columns: _Columns) -> Mesh:
    axes = []
    for axis in "xyz":
        column = columns.get(("vertex", axis))
        if column is None or (column.lengths != 1).any():
            raise _BadPlyError(f"it has no vertices with a plain property '{axis}'")
        axes.append(column.items)
    points = np.stack(axes, axis=1)
    if not (np.abs(points) < _LARGEST).all():  # NaN fails as well
        raise _BadPlyError(f"some of its coordinates are not finite, or beyond {_LARGEST:g}")
    faces = next((columns[key] for name in _FACE_LISTS if (key := ("face", name)) in columns), None)
    if faces is None:
        return Mesh(points, np.zeros((0, 3), np.int32))
    items = faces.items
    wrong = items[~((items >= 0) & (items < len(points)) & (items == np.floor(items)))]
    if len(wrong):
        raise _BadPlyError(
            f"a face names vertex {wrong[0]:g}; there are {len(points)} vertices, counted from 0 in whole numbers"
        )
    return Mesh(points, _fans(faces.lengths, items.astype(np.int32)))


def _fans(lengths: npt.NDArray[np.int64], corners: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Triangles of polygons: each cut into a fan round its first corner."""
    counts = np.maximum(lengths - 2, 0)
    first = np.repeat(np.cumsum(lengths) - lengths, counts)
    step = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.stack((corners[first], corners[first + step + 1], corners[first + step + 2]), axis=1).astype(np.int32)
