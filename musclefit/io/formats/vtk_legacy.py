"""The bytes of a legacy VTK file (.vtk) of points and cells -> its arrays; knows no muscle.

VTK is not asked, for the reasons that `vtk_xml` states. Read are text and binary, versions 1 to 5, the data sets
POLYDATA and UNSTRUCTURED_GRID; every count that the file states is held against what it contains before anything is
allocated.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from musclefit.errors import MeshError
from musclefit.geometry.arrays import Int, Points
from musclefit.io.formats.surfaces import WAY_OUT
from musclefit.io.formats.vtk_xml import Cells

Array = NDArray[Any]

_TYPES: Mapping[str, str] = MappingProxyType(
    {
        **{"char": "i1", "signed_char": "i1", "unsigned_char": "u1", "short": "i2", "unsigned_short": "u2"},
        **{"int": "i4", "unsigned_int": "u4", "long": "i8", "unsigned_long": "u8", "vtkidtype": "i4"},
        **{"vtktypeint64": "i8", "vtktypeuint64": "u8", "vtktypeint32": "i4", "vtktypeuint32": "u4"},
        **{"float": "f4", "double": "f8"},
    }
)
_CELLS = ("VERTICES", "LINES", "POLYGONS", "TRIANGLE_STRIPS", "CELLS")
_OF_WIDTH: Mapping[str, int] = MappingProxyType(
    {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9, "TENSORS6": 6, "GLOBAL_IDS": 1, "PEDIGREE_IDS": 1, "EDGE_FLAGS": 1}
)
_HEAD = re.compile(rb"# vtk DataFile Version (\d+)\.(\d+)[^\n]*\n([^\n]*)\n\s*(ASCII|BINARY)\s*\n", re.IGNORECASE)
_METADATA = re.compile(rb"\r?\nMETADATA[ \t\r]*\n.*?\n[ \t\r]*(?:\n|\Z)", re.DOTALL)
_WORD = re.compile(rb"\s*(\S+)")
_LONGEST_TITLE = 256


@dataclass(slots=True)
class LegacyVtk:
    """What a legacy VTK file holds.

    Parameters
    ----------
    title : str
        Its second line.
    points : (n, 3) float64, in the file's unit
    cells : mapping of section, such as LINES or CELLS, to Cells
    point_data, cell_data : mapping of name to (rows, components)
    """

    title: str
    points: Points = field(default_factory=lambda: np.zeros((0, 3)))
    cells: dict[str, Cells] = field(default_factory=dict)
    point_data: dict[str, Array] = field(default_factory=dict)
    cell_data: dict[str, Array] = field(default_factory=dict)

    @property
    def all_cells(self) -> Cells:
        """Cells of all sections, in the order in which data at cells stand."""
        found = [self.cells[name] for name in _CELLS if name in self.cells]
        nothing = np.zeros(0, np.int64)
        return Cells(
            np.concatenate([nothing, *(c.sizes for c in found)]), np.concatenate([nothing, *(c.corners for c in found)])
        )


def read_legacy_vtk(data: bytes, source: str) -> LegacyVtk:
    """Read a legacy VTK file of points and cells.

    Parameters
    ----------
    data : bytes
    source : str
        The file, for messages.

    Raises
    ------
    MeshError
        Another data set, damaged, or cut short.
    """
    head = _HEAD.match(data)
    if head is None:
        raise MeshError(f"{source}: not a legacy VTK file: its first three lines are not those of one; {WAY_OUT}")
    title = head[3][:_LONGEST_TITLE].decode("utf-8", "replace").strip()
    body = data[head.end() :]
    words = _Text(body, source) if head[4].upper() == b"ASCII" else _Binary(body, source)
    return _Parser(words, LegacyVtk(title), version=int(head[1][:4])).read()


class _Text:
    """The words of a text file, one after the other."""

    def __init__(self, data: bytes, source: str) -> None:
        self._words, self._next, self._source = _METADATA.sub(b"\n\n", data).split(), 0, source

    def word(self) -> str:
        """The next word; empty at the end."""
        if self._next >= len(self._words):
            return ""
        self._next += 1
        return self._words[self._next - 1].decode("utf-8", "replace")

    def peek(self) -> str:
        at = self._next
        found = self.word()
        self._next = at
        return found

    def numbers(self, kind: str, count: int, what: str) -> Array:
        """So many numbers."""
        end = self._next + count
        if end > len(self._words):
            raise damaged(self._source, f"{what} are {count} numbers, of which {len(self._words) - self._next} follow")
        exact: Callable[[bytes], Any] = float if kind[0] == "f" else int
        try:
            with np.errstate(over="ignore"):
                found = np.array([exact(word) for word in self._words[self._next : end]], dtype=kind)
        except (ValueError, OverflowError) as error:
            raise damaged(self._source, f"{what} hold a value that is not a number ({str(error)[:60]})") from None
        self._next = end
        return found

    def skip_metadata(self) -> None:
        """There are none: they were left out."""
        raise damaged(self._source, "METADATA without an end")


class _Binary:
    """The same of a file whose numbers are binary, big-endian."""

    def __init__(self, data: bytes, source: str) -> None:
        self._data, self._at, self._source = data, 0, source

    def word(self) -> str:
        found = _WORD.match(self._data, self._at)
        if found is None:
            return ""
        self._at = found.end()
        return found[1][:200].decode("utf-8", "replace")

    def peek(self) -> str:
        at = self._at
        found = self.word()
        self._at = at
        return found

    def numbers(self, kind: str, count: int, what: str) -> Array:
        dtype = np.dtype(">" + kind)
        line_end = self._data.find(b"\n", self._at)
        if line_end < 0 or self._data[self._at : line_end].strip():
            raise damaged(self._source, f"{what} do not begin on a line of their own")
        begin, size = line_end + 1, count * dtype.itemsize
        if size > len(self._data) - begin:
            raise damaged(self._source, f"{what} take {size} bytes, of which {len(self._data) - begin} follow")
        self._at = begin + size
        return np.frombuffer(self._data, dtype, count=count, offset=begin)

    def skip_metadata(self) -> None:
        end = re.compile(rb"\n[ \t\r]*\n").search(self._data, self._at)
        self._at = end.end() if end else len(self._data)


class _Parser:
    """Sections by their first word."""

    def __init__(self, words: _Text | _Binary, found: LegacyVtk, *, version: int) -> None:
        self._words, self._found, self._version = words, found, version
        self._source = words._source
        self._data: tuple[dict[str, Array], int] | None = None  # where attributes go, and their rows

    def read(self) -> LegacyVtk:
        if self._words.word().upper() != "DATASET":
            raise damaged(self._source, "it states no DATASET")
        kind = self._words.word().upper()
        if kind not in ("POLYDATA", "UNSTRUCTURED_GRID"):
            raise MeshError(
                f"{self._source}: a legacy VTK file of {kind[:40] or 'no data set'}; read are POLYDATA and "
                "UNSTRUCTURED_GRID: export it as one of them"
            )
        while name := self._words.word().upper():
            self._section(name)
        for row, rows in ((self._found.point_data, len(self._found.points)), (self._found.cell_data, self._n_cells)):
            for key, values in row.items():
                if len(values) != rows:
                    raise damaged(self._source, f"{key[:40]!r} has {len(values)} rows for {rows} points or cells")
        return self._found

    @property
    def _n_cells(self) -> int:
        return sum(len(cells.sizes) for cells in self._found.cells.values())

    def _section(self, name: str) -> None:
        if name == "POINTS":
            count = self._count("POINTS")
            values = self._words.numbers(self._type(), 3 * count, "POINTS").reshape(-1, 3)
            with np.errstate(invalid="ignore"):  # signalling NaN: whoever takes the points in refuses them
                self._found.points = values.astype(np.float64)
        elif name in _CELLS:
            self._cells(name)
        elif name == "CELL_TYPES":
            self._words.numbers("i4", self._count(name), name)
        elif name in ("POINT_DATA", "CELL_DATA"):
            count = self._count(name)
            self._data = (self._found.point_data if name == "POINT_DATA" else self._found.cell_data, count)
        elif name == "METADATA":
            self._words.skip_metadata()
        elif name == "FIELD":
            self._field()
        else:
            self._attribute(name)

    def _cells(self, name: str) -> None:
        first, second = self._count(name), self._count(name)
        if self._version >= 5:
            offsets = self._named_whole("OFFSETS", first, name)
            corners = self._named_whole("CONNECTIVITY", second, name)
            sizes = np.diff(offsets)
            if first and (offsets[0] != 0 or offsets[-1] != second or (sizes < 0).any()):
                raise damaged(self._source, f"the offsets of its {name} do not fit their {second} corners")
        else:
            sizes, corners = _split(self._words.numbers("i4", second, name).astype(np.int64), first, name, self._source)
        n_points = len(self._found.points)
        if len(corners) and (corners.min() < 0 or corners.max() >= n_points):
            raise damaged(
                self._source, f"its {name} use points {corners.min()} to {corners.max()} of {n_points} (counted from 0)"
            )
        self._found.cells[name] = Cells(sizes, corners)

    def _named_whole(self, word: str, count: int, what: str) -> Int:
        if self._words.word().upper() != word:
            raise damaged(self._source, f"its {what} have no {word}")
        kind = self._type()
        if kind[0] == "f":
            raise damaged(self._source, f"the {word} of its {what} are not whole numbers")
        return self._words.numbers(kind, count, f"{what} {word}").astype(np.int64)

    def _field(self) -> None:
        self._words.word()
        for _ in range(self._count("FIELD")):
            if self._words.peek().upper() == "METADATA":
                self._words.word()
                self._words.skip_metadata()
            name, width, rows = unquote(self._words.word()), self._count("FIELD"), self._count("FIELD")
            values = self._words.numbers(self._type(), width * rows, name[:40] or "a field")
            if self._data is not None and width:
                self._keep(name, values.reshape(-1, width))

    def _attribute(self, name: str) -> None:
        if self._data is None:
            raise damaged(self._source, f"{name[:40]!r} stands where points, cells or data were expected")
        rows = self._data[1]
        label = unquote(self._words.word())
        if name == "SCALARS":
            kind, width = self._type(), 1
            if self._words.peek().isdecimal():
                width = self._count(name)
            if self._words.peek().upper() == "LOOKUP_TABLE":
                self._words.word()
                self._words.word()
        elif name == "LOOKUP_TABLE":
            binary = isinstance(self._words, _Binary)
            self._words.numbers("u1" if binary else "f4", 4 * self._count(name), name)
            return
        elif name == "COLOR_SCALARS":
            width, kind = self._count(name), "u1" if isinstance(self._words, _Binary) else "f4"
        elif name == "TEXTURE_COORDINATES":
            width, kind = self._count(name), self._type()
        elif name in _OF_WIDTH:
            width, kind = _OF_WIDTH[name], self._type()
        else:
            raise damaged(self._source, f"{name[:40]!r} is no attribute of a legacy VTK file")
        values = self._words.numbers(kind, width * rows, label[:40] or name)
        if width:
            self._keep(label, values.reshape(-1, width))

    def _keep(self, name: str, values: Array) -> None:
        assert self._data is not None
        self._data[0][name] = values

    def _type(self) -> str:
        said = self._words.word()
        if said.lower() not in _TYPES:
            raise damaged(self._source, f"it has values of type {said[:30]!r}; read are {', '.join(_TYPES)}")
        return _TYPES[said.lower()]

    def _count(self, what: str) -> int:
        said = self._words.word()
        if not re.fullmatch(r"[0-9]{1,12}", said):
            raise damaged(self._source, f"{what} states {said[:30]!r}, which is not a count")
        return int(said)


def _split(numbers: Int, count: int, name: str, source: str) -> tuple[Int, Int]:
    """Sizes and corners of cells that stand as a size and its corners, one cell after the other."""
    sizes: list[int] = []
    at = 0
    while at < len(numbers) and len(sizes) < count:
        size = int(numbers[at])
        if size < 0:
            break
        sizes.append(size)
        at += size + 1
    if at != len(numbers) or len(sizes) != count:
        raise damaged(source, f"its {name} are {len(numbers)} numbers, which are not {count} cells")
    found = np.array(sizes, dtype=np.int64)
    starts = np.cumsum(np.concatenate([[0], found[:-1] + 1])) if count else np.zeros(0, np.int64)
    corners = np.ones(len(numbers), dtype=bool)
    corners[starts] = False
    return found, numbers[corners]


def damaged(source: str, what: str) -> MeshError:
    """The error that says so, with the file and the way out."""
    return MeshError(f"{source}: as a legacy VTK file it is damaged: {what}; {WAY_OUT}")
