"""The bytes of a PLY file, ASCII or binary -> vertices and faces as they stand in it; knows the format, not tissues."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from musclefit.errors import MeshError
from musclefit.geometry.arrays import Faces, Float, Int
from musclefit.io.formats.surfaces import WAY_OUT, Polygons, polygons_cut, strips_cut

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {b"ascii": "", b"binary_little_endian": "<", b"binary_big_endian": ">"}
_CORNER_LISTS = ("vertex_indices", "vertex_index")
_STRIPS = "tristrips"
"""The element of triangle strips, as the scans of Stanford's repository have it instead of faces."""


@dataclass(frozen=True, slots=True)
class _Property:
    """One property; ``count_type`` is "" unless it is a list."""

    name: str
    value_type: str
    count_type: str


@dataclass(frozen=True, slots=True)
class _Element:
    """One element: its name, how many rows it states, its properties."""

    name: str
    rows: int
    properties: tuple[_Property, ...]


@dataclass(frozen=True, eq=False, slots=True)
class _Column:
    """All values of one property one after the other, and how many each row has."""

    values: NDArray[Any]
    sizes: Int


def read_ply(data: bytes, source: str) -> Polygons:
    """Read PLY; elements other than vertices, faces and triangle strips are read past.

    Raises
    ------
    MeshError
        The bytes are not PLY, or hold fewer or more values than the header states; ``source`` names the file.
    """
    order, elements, start = _header(data, source)
    by_name = {element.name: element for element in elements}
    if "vertex" not in by_name or not {"face", _STRIPS} & by_name.keys():
        missing = "face" if "vertex" in by_name else "vertex"
        raise MeshError(f"{source}: a PLY file without {missing} elements; export it as a triangle surface")
    for name in ({"vertex", "face", _STRIPS} & by_name.keys()) - ({"face"} if _STRIPS in by_name else set()):
        wanted = ("x", "y", "z") if name == "vertex" else _CORNER_LISTS
        have = [p.name for p in by_name[name].properties if bool(p.count_type) == (name != "vertex")]
        if not (set(wanted) <= set(have) or (name != "vertex" and set(wanted) & set(have))):
            raise MeshError(f"{source}: PLY element {name} has {have}; it needs {' or '.join(wanted)}")
    reader = _Binary(data, start, order, source) if order else _Ascii(data[start:], source)
    columns = {element.name: reader.element(element) for element in elements}
    reader.finish()
    with np.errstate(invalid="ignore"):  # signalling NaN: whoever takes the surface in refuses what is not finite
        vertices = np.stack([columns["vertex"][axis].values.astype(np.float64) for axis in "xyz"], axis=1)
    faces = _corner_lists(columns.get("face", {}))
    cut = polygons_cut(vertices, faces.sizes, _indices(faces.values, source), source)
    strips = _corner_lists(columns.get(_STRIPS, {}))
    if not len(strips.values):
        return cut
    return Polygons(vertices, np.concatenate([cut.faces, _strip_faces(strips, source)]), cut.cut)


def _corner_lists(columns: dict[str, _Column]) -> _Column:
    """The lists of corners of an element; none where there is no such element."""
    none = _Column(np.zeros(0, np.int64), np.zeros(0, np.int64))
    return next((columns[name] for name in _CORNER_LISTS if name in columns), none)


def _strip_faces(strips: _Column, source: str) -> Faces:
    """The triangles of strips; within a list, -1 ends a strip."""
    corners = _indices(strips.values, source)
    ends = np.zeros(len(corners) + 1, dtype=np.bool_)
    ends[np.cumsum(strips.sizes)] = True
    number = np.cumsum((corners == -1) | ends[:-1])[corners != -1]
    sizes = np.unique(number, return_counts=True)[1]
    return strips_cut(sizes, corners[corners != -1], source)


def _indices(values: NDArray[Any], source: str) -> Int:
    """Whole numbers; MeshError where the file stores others."""
    if values.dtype.kind == "f" and not (np.isfinite(values) & (np.abs(values) < 2**53)).all():
        raise MeshError(f"{source}: a face has a corner that is not a whole number; {WAY_OUT}")
    whole: Int = values.astype(np.int64)
    if (whole != values).any():
        raise MeshError(f"{source}: a face has a corner that is not a whole number; {WAY_OUT}")
    return whole


def _header(data: bytes, source: str) -> tuple[str, list[_Element], int]:
    end = re.search(rb"^end_header[ \t]*(\r?\n|\r|\Z)", data, re.MULTILINE)
    if data[:3] != b"ply" or end is None:
        raise MeshError(f"{source}: not a PLY file (no 'ply' ... 'end_header'); {WAY_OUT}")
    order = None
    elements: list[_Element] = []
    for number, line in enumerate(data[: end.start()].splitlines(), start=1):
        words = line.split()
        try:
            if words and words[0] == b"format":
                order = _ORDERS[words[1]]
            elif words and words[0] == b"element":
                elements.append(_Element(words[1].decode(), _count(words[2]), ()))
            elif words and words[0] == b"property":
                last = elements.pop()
                elements.append(_Element(last.name, last.rows, (*last.properties, _property(words[1:]))))
        except (KeyError, IndexError, ValueError) as error:
            said = line[:60].decode("latin-1")
            raise MeshError(f"{source}: line {number}: {said!r} cannot be read as PLY header; {WAY_OUT}") from error
    _require_different([element.name for element in elements], "element", source)
    for element in elements:
        _require_different([p.name for p in element.properties], f"property of {element.name}", source)
    if order is None:
        raise MeshError(f"{source}: the PLY header states no format; {WAY_OUT}")
    return order, elements, end.end()


def _require_different(names: list[str], what: str, source: str) -> None:
    if len(set(names)) < len(names):
        twice = max(names, key=names.count)
        raise MeshError(f"{source}: the PLY header has two times the {what} {twice!r}; {WAY_OUT}")


def _count(word: bytes) -> int:
    if not word.isdigit():
        raise ValueError(f"{word!r} is not a count")
    return int(word)


def _property(words: list[bytes]) -> _Property:
    if words[0] == b"list":
        count_type = _TYPES[words[1].decode()]
        if count_type.startswith("f"):
            raise ValueError("a count is a whole number")
        return _Property(words[3].decode(), _TYPES[words[2].decode()], count_type)
    return _Property(words[1].decode(), _TYPES[words[0].decode()], "")


class _Binary:
    """Reads elements one after the other from the bytes behind the header."""

    def __init__(self, data: bytes, start: int, order: str, source: str) -> None:
        self._data, self._at, self._order, self._source = data, start, order, source

    def element(self, element: _Element) -> dict[str, _Column]:
        if not element.rows or not element.properties:
            return {p.name: _Column(np.zeros(0), np.zeros(0, np.int64)) for p in element.properties}
        alike = self._rows_alike(element)
        return self._rows_one_by_one(element) if alike is None else alike

    def finish(self) -> None:
        left = len(self._data) - self._at
        if left and self._data[self._at :].strip():
            raise MeshError(f"{self._source}: has {left} bytes more than its PLY header states; {WAY_OUT}")

    def _rows_alike(self, element: _Element) -> dict[str, _Column] | None:
        """All rows at once, as long as every list is as long as in the first row; else None."""
        fields: list[tuple[str, str, tuple[int, ...]]] = []
        size = 0
        for p in element.properties:
            length = 1
            if p.count_type:
                length = int(self._scalar(self._at + size, p.count_type, element))
                if length < 0:
                    return None
                fields.append((f"count of {p.name}", self._order + p.count_type, ()))
                size += np.dtype(p.count_type).itemsize
            fields.append((p.name, self._order + p.value_type, (length,)))
            size += length * np.dtype(p.value_type).itemsize
        if self._at + size * element.rows > len(self._data):
            if any(p.count_type for p in element.properties):
                return None
            self._too_short(element)
        rows = np.frombuffer(self._data, np.dtype(fields), count=element.rows, offset=self._at)
        for p in element.properties:
            if p.count_type and (rows[f"count of {p.name}"] != rows[f"count of {p.name}"][0]).any():
                return None
        self._at += size * element.rows
        return {
            p.name: _Column(rows[p.name].ravel(), np.full(element.rows, rows[p.name].shape[1]))
            for p in element.properties
        }

    def _rows_one_by_one(self, element: _Element) -> dict[str, _Column]:
        values: dict[str, list[NDArray[Any]]] = {p.name: [] for p in element.properties}
        for _ in range(element.rows):
            for p in element.properties:
                length = 1
                if p.count_type:
                    length = int(self._scalar(self._at, p.count_type, element))
                    self._at += np.dtype(p.count_type).itemsize
                size = length * np.dtype(p.value_type).itemsize
                if length < 0 or self._at + size > len(self._data):
                    self._too_short(element)
                dtype = self._order + p.value_type
                values[p.name].append(np.frombuffer(self._data, dtype, count=length, offset=self._at))
                self._at += size
        return {
            name: _Column(np.concatenate(rows), np.array([len(row) for row in rows])) for name, rows in values.items()
        }

    def _scalar(self, at: int, kind: str, element: _Element) -> float:
        dtype = np.dtype(self._order + kind)
        if at + dtype.itemsize > len(self._data):
            self._too_short(element)
        return float(np.frombuffer(self._data, dtype, count=1, offset=at)[0])

    def _too_short(self, element: _Element) -> None:
        raise MeshError(
            f"{self._source}: ends within its {element.rows} {element.name} elements, after {len(self._data)} bytes; "
            f"{WAY_OUT}"
        )


class _Ascii:
    """Reads elements one after the other from the words behind the header."""

    def __init__(self, body: bytes, source: str) -> None:
        self._words, self._at, self._source = body.split(), 0, source

    def element(self, element: _Element) -> dict[str, _Column]:
        if any(p.count_type for p in element.properties):
            return self._with_lists(element)
        width = len(element.properties)
        numbers = self._take(element.rows * width, element).reshape(element.rows, width)
        return {
            p.name: _Column(numbers[:, i], np.ones(element.rows, np.int64)) for i, p in enumerate(element.properties)
        }

    def finish(self) -> None:
        left = len(self._words) - self._at
        if left:
            raise MeshError(f"{self._source}: has {left} values more than its PLY header states; {WAY_OUT}")

    def _with_lists(self, element: _Element) -> dict[str, _Column]:
        values: dict[str, list[Float]] = {p.name: [] for p in element.properties}
        if len(element.properties) == 1 and self._words[self._at :]:
            alike = self._lists_alike(element)
            if alike is not None:
                return alike
        for _ in range(element.rows):
            for p in element.properties:
                length = self._whole(self._take(1, element), element)[0] if p.count_type else 1
                values[p.name].append(self._take(int(length), element))
        empty = np.zeros(0)
        return {
            p.name: _Column(
                self._of_type(np.concatenate([empty, *values[p.name]]), p, element),
                np.array([len(row) for row in values[p.name]], dtype=np.int64),
            )
            for p in element.properties
        }

    def _lists_alike(self, element: _Element) -> dict[str, _Column] | None:
        (p,) = element.properties
        first = self._words[self._at]
        width = int(first) + 1 if first.isdigit() and len(first) < 10 else 0
        block = self._words[self._at : self._at + element.rows * width]
        if not width or len(block) < element.rows * width or any(word != first for word in block[::width]):
            return None
        numbers = self._take(element.rows * width, element).reshape(element.rows, width)[:, 1:]
        return {p.name: _Column(self._of_type(numbers.ravel(), p, element), np.full(element.rows, width - 1))}

    def _of_type(self, numbers: Float, p: _Property, element: _Element) -> Float | Int:
        return numbers if p.value_type.startswith("f") else self._whole(numbers, element)

    def _whole(self, numbers: Float, element: _Element) -> Int:
        if not ((np.abs(numbers) < 2**53).all() and (numbers == np.floor(numbers)).all()):
            raise MeshError(f"{self._source}: a {element.name} has an index that is not a whole number; {WAY_OUT}")
        return numbers.astype(np.int64)

    def _take(self, count: int, element: _Element) -> Float:
        words = self._words[self._at : self._at + count]
        if count < 0 or len(words) < count:
            raise MeshError(
                f"{self._source}: ends within its {element.rows} {element.name} elements, after {len(self._words)} "
                f"values; {WAY_OUT}"
            )
        self._at += count
        try:
            return np.array(words, dtype=object).astype(np.float64)
        except ValueError as error:
            raise MeshError(
                f"{self._source}: a {element.name} has a value that is not a number ({error}); {WAY_OUT}"
            ) from error
