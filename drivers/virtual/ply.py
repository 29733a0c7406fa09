"""Points and triangles from a PLY file (Stanford's polygon format, ascii or binary)."""

from __future__ import annotations

import struct
from array import array
from dataclasses import dataclass, field
from pathlib import Path

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
        if not order:
            data, order, start = _binary(data[start:], elements), "<", 0
        columns: _Columns = {}
        for element in elements:
            start = _read_element(data, start, order, element, columns)
        return _mesh(columns)
    except _NoPlyError:
        raise SourceNotFoundError(f"'{path}' is no PLY file: it does not begin with the line 'ply'") from None
    except _BadPlyError as error:
        raise DamagedRecordingError(f"'{path}' cannot be read: {error}. Export the object again as PLY.") from error


class _NoPlyError(Exception):
    """The file is something else."""


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
    return order, elements, start


def _binary(text: bytes, elements: list[_Element]) -> bytes:
    """A text body as a binary one in which everything is a double; `elements` are changed to it."""
    words = text.split()
    try:
        numbers = np.fromiter(map(float, words), "<f8", len(words))
    except ValueError as error:
        raise _BadPlyError(f"its text holds something else than numbers ({error!s:.100})") from error
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
    places, end = _walk(data, at, order, element, 1)
    width = end - at  # the usual case first: all rows are laid out as the first
    steps = width * np.arange(element.rows)
    uniform = width * element.rows <= len(data) - at and all(
        (_gather(data, begins - each.least + steps, None, order + each.count) == lengths[0]).all()
        for each, (begins, lengths) in zip(element.properties, places, strict=True)
        if each.count
    )
    if uniform:
        places = [(begins + steps, np.repeat(lengths, element.rows)) for begins, lengths in places]
        end = at + width * element.rows
    else:
        places, end = _walk(data, at, order, element, element.rows)
    for each, (begins, lengths) in zip(element.properties, places, strict=True):
        items = _gather(data, begins, lengths, order + each.scalar)
        columns[element.name, each.name] = _Column(lengths, items)
    return end


_Places = list[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]]
"""Of each property: the byte at which its items begin in each row, and their number."""


def _walk(data: bytes, at: int, order: str, element: _Element, rows: int) -> tuple[_Places, int]:
    """Where the items of the next rows lie, and the byte after them."""
    readers = [each.count and struct.Struct(order + each.count) for each in element.properties]
    sizes = [struct.calcsize(order + each.scalar) for each in element.properties]
    found = [(array("q"), array("q")) for _ in sizes]
    for _ in range(rows):
        for reader, size, (begins, lengths) in zip(readers, sizes, found, strict=True):
            length = 1
            if reader:
                _check_room(data, at, reader.size, element)
                number = reader.unpack_from(data, at)[0]
                at += reader.size
                if not 0 <= number < 2**31 or number != int(number):
                    raise _BadPlyError(f"it has a list of {number:g} items")
                length = int(number)
            _check_room(data, at, length * size, element)
            begins.append(at)
            lengths.append(length)
            at += length * size
    return [(np.array(begins, np.int64), np.array(lengths, np.int64)) for begins, lengths in found], at


def _gather(
    data: bytes, begins: npt.NDArray[np.int64], lengths: npt.NDArray[np.int64] | None, code: str
) -> npt.NDArray[np.float64]:
    """The numbers that begin at these bytes: runs of these lengths (default: 1), end to end."""
    kind = np.dtype(code)
    if lengths is not None:
        within = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        begins = np.repeat(begins, lengths) + within * kind.itemsize
    each_byte = np.frombuffer(data, np.uint8)
    picked = np.empty((len(begins), kind.itemsize), np.uint8)
    for byte in range(kind.itemsize):
        picked[:, byte] = each_byte[begins + byte]
    return picked.view(kind).ravel().astype(np.float64)


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
