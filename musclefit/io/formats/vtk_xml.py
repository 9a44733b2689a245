"""The bytes of a VTK XML file (.vtp, .vtu) -> its arrays, and the same bytes with other points.

VTK is not asked: on damaged files its readers end the process, hang, or take a gigabyte for a file of a kilobyte. Here
nothing is allocated for a count that a file merely states, and every count is held against what the file contains.
Read are ASCII, base64 and appended data (base64 or raw), headers of 32 and 64 bits, both byte orders, and blocks
compressed with zlib, LZMA or LZ4.
"""

from __future__ import annotations

import base64
import binascii
import lzma
import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from musclefit.errors import MeshError
from musclefit.geometry.arrays import Int, Points
from musclefit.io.formats.surfaces import WAY_OUT, Polygons, polygons_cut, strips_cut

_DTYPES: Mapping[str, str] = MappingProxyType(
    {f"{'U' if sign == 'u' else ''}Int{8 * size}": f"{sign}{size}" for sign in "iu" for size in (1, 2, 4, 8)}
    | {"Float32": "f4", "Float64": "f8"}
)
_COMPRESSORS = ("vtkZLibDataCompressor", "vtkLZMADataCompressor", "vtkLZ4DataCompressor")
_DEEPEST = 32
"""Levels of nested elements; VTK writes at most 7."""
_MOST_SWOLLEN = 1100
"""How many times larger than its compressed block a block may become; zlib reaches 1032."""
_LZMA_MEMORY = 1 << 28
"""Bytes that the LZMA decoder may take."""
_SECTIONS: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "PolyData": {name: f"NumberOf{name}" for name in ("Verts", "Lines", "Strips", "Polys")},
        "UnstructuredGrid": {"Cells": "NumberOfCells"},
    }
)
"""Where cells are, and what states how many there are, by the type of the file."""
_COUNTS = ("NumberOfPoints", *(count for sections in _SECTIONS.values() for count in sections.values()))
_APPENDED = re.compile(rb"<AppendedData\b([^>]*)>\s*_")
_APPENDED_END = re.compile(rb"\s*</AppendedData>\s*</VTKFile>\s*\Z")

Array = NDArray[Any]


@dataclass(slots=True)
class _Element:
    """A DataArray as it stands: attributes, text, and where it begins and ends in the file."""

    attributes: Mapping[str, str]
    begin: int
    end: int = -1
    text: list[str] = field(default_factory=list)


@dataclass(slots=True)
class _Piece:
    """A Piece: its counts, and its DataArrays by section."""

    counts: Mapping[str, int]
    arrays: dict[str, list[_Element]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, slots=True)
class Cells:
    """Cells by their sizes and their vertices one after the other, 0-based over the whole file."""

    sizes: Int
    corners: Int


class VtkFile:
    """A VTK XML file of points and cells.

    Parameters
    ----------
    data : bytes
    source : str
        The file, for messages.
    kind : {"PolyData", "UnstructuredGrid"}

    Raises
    ------
    MeshError
        The bytes are not a whole file of that kind.
    """

    def __init__(self, data: bytes, source: str, *, kind: str) -> None:
        self._data, self._source = data, source
        self._pieces: list[_Piece] = []
        self._fields: list[_Element] = []
        self._head: Mapping[str, str] = {}
        if not data.rstrip().endswith(b"</VTKFile>"):
            raise MeshError(f"{source}: not a whole VTK XML file, its last tag </VTKFile> is missing; {WAY_OUT}")
        head = self._cut_off_appended()
        self._parse(head)
        found = self._head.get("type", "")
        if found != kind:
            raise MeshError(f"{source}: a VTK XML file of type {found[:40]!r}; expected {kind}: export it as that")
        order = self._head.get("byte_order", "LittleEndian")
        header = self._head.get("header_type", "UInt32")
        self._compressor = self._head.get("compressor", "")
        if order not in ("LittleEndian", "BigEndian") or header not in ("UInt32", "UInt64"):
            raise self.damaged(f"byte_order is {order[:20]!r} and header_type {header[:20]!r}")
        if self._compressor and self._compressor not in _COMPRESSORS:
            raise MeshError(
                f"{source}: compressed by {self._compressor[:40]!r}; read are {', '.join(_COMPRESSORS)}: export it so"
            )
        self._order = "<" if order == "LittleEndian" else ">"
        self._header = np.dtype(self._order + _DTYPES[header])
        offsets = {
            self._offset(e)
            for e in (*self._fields, *(e for p in self._pieces for s in p.arrays.values() for e in s))
            if e.attributes.get("format") == "appended"
        }
        self._offsets = sorted(offsets)

    # What the file holds

    def points(self) -> Points:
        """(n, 3) points of all pieces, in the file's unit."""
        return np.concatenate([np.zeros((0, 3)), *(self._points_of(piece) for piece in self._pieces)])

    def cells(self, section: str, *, count: str) -> Cells:
        """The cells of a section of all pieces, such as Polys, whose number ``count`` states."""
        sizes, corners, before = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], 0
        for piece in self._pieces:
            n_points, n_cells = piece.counts["NumberOfPoints"], piece.counts[count]
            if n_cells:
                ends = self._whole(piece, section, "offsets", n_cells)
                around = self._whole(piece, section, "connectivity", None)
                sizes.append(np.diff(ends, prepend=0))
                if sizes[-1].min() < 1 or int(ends[-1]) != len(around):
                    raise self.damaged(f"the offsets of its {section} do not fit their {len(around)} corners")
                if around.min() < 0 or around.max() >= n_points:
                    raise self.damaged(
                        f"its {section} use points {around.min()} to {around.max()} of {n_points} (counted from 0)"
                    )
                corners.append(around + before)
            before += n_points
        return Cells(np.concatenate(sizes), np.concatenate(corners))

    def cell_types(self) -> Int:
        """VTK's number of the type of each cell of an unstructured grid."""
        kinds = [self._whole(p, "Cells", "types", n) for p in self._pieces if (n := p.counts["NumberOfCells"])]
        return np.concatenate([np.zeros(0, np.int64), *kinds])

    def point_data(self, name: str, *, components: int) -> Array | None:
        """(n, components) of an array at points; None where a piece lacks it."""
        return self._data_of("PointData", name, count="NumberOfPoints", components=components)

    def cell_data(self, name: str, *, count: str = "NumberOfCells") -> Array | None:
        """(c,) of an array at cells; None where a piece lacks it.

        ``count`` states how many there are: of an unstructured grid, or of the one section of PolyData that has cells.
        """
        values = self._data_of("CellData", name, count=count, components=1)
        return None if values is None else values[:, 0]

    def vectors(self, section: str, *, count: str) -> dict[str, Array]:
        """The (rows, 3) arrays of real numbers at points or cells (PointData, CellData) that every piece has, by name.

        ``count`` states how many rows there are.
        """
        pieces = [{e.attributes.get("Name", ""): e for e in p.arrays.get(section, [])} for p in self._pieces]
        found: dict[str, Array] = {}
        for name, element in (pieces[0] if pieces else {}).items():
            if (
                element.attributes.get("NumberOfComponents") == "3"
                and element.attributes.get("type", "")[:5] == "Float"
            ):
                values = self._data_of(section, name, count=count, components=3)
                found |= {} if values is None else {name: values}
        return found

    def field_numbers(self) -> dict[str, Array]:
        """The arrays of numbers that belong to the file as a whole, by name."""
        named = {e.attributes.get("Name", ""): e for e in self._fields if e.attributes.get("type") in _DTYPES}
        return {name: self._values(element, name) for name, element in named.items()}

    def check(self) -> None:
        """Raise MeshError where cells or data do not fit the counts that the file states."""
        sections = _SECTIONS[self._head["type"]]
        for section, count in sections.items():
            self.cells(section, count=count)
        for piece in self._pieces:
            rows = {"PointData": piece.counts["NumberOfPoints"]}
            rows["CellData"] = sum(piece.counts[count] for count in sections.values())
            for section, count_of in rows.items():
                for element in piece.arrays.get(section, []):
                    if element.attributes.get("type") in _DTYPES:
                        self._require_rows(element, section, count_of)

    def _require_rows(self, element: _Element, section: str, rows: int) -> None:
        name = element.attributes.get("Name", "")[:40]
        components = self.whole_number(element.attributes.get("NumberOfComponents", "1"), "NumberOfComponents")
        values = self._values(element, name)
        if values.size != rows * components:
            raise self.damaged(f"{section} {name!r} has {values.size} values for {rows} rows of {components}")

    def with_points(self, points: Points) -> bytes:
        """The file with other points, (n, 3) in its unit, written as text; everything else stands as it was."""
        parts, at, first = [], 0, 0
        for piece in self._pieces:
            (element,) = piece.arrays.get("Points", [None])[:1]
            count = piece.counts["NumberOfPoints"]
            if element is None:
                continue
            rows = "\n".join(" ".join(repr(float(x)) for x in row) for row in points[first : first + count])
            name = element.attributes.get("Name", "Points").encode("ascii", "xmlcharrefreplace").decode()
            quoted = name.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
            tag = f'<DataArray type="Float64" Name="{quoted}" NumberOfComponents="3" format="ascii">'
            parts += [self._data[at : element.begin], f"{tag}\n{rows}\n</DataArray>".encode("ascii")]
            at, first = element.end, first + count
        return b"".join([*parts, self._data[at:]])

    # Its parts

    def _points_of(self, piece: _Piece) -> Points:
        count = piece.counts["NumberOfPoints"]
        if not count:
            return np.zeros((0, 3))
        elements = piece.arrays.get("Points", [])
        if len(elements) != 1:
            raise self.damaged(f"states {count} points and has {len(elements)} arrays of points")
        values = self._values(elements[0], "Points", components=3)
        if values.shape != (count, 3):
            raise self.damaged(f"states {count} points, but holds {values.size} coordinates of points")
        with np.errstate(invalid="ignore"):  # signalling NaN: whoever takes the points in refuses what is not finite
            return values.astype(np.float64)

    def _whole(self, piece: _Piece, section: str, name: str, count: int | None) -> Int:
        """An array of whole numbers, of a length that the file states (None: of any)."""
        found = [e for e in piece.arrays.get(section, []) if e.attributes.get("Name") == name]
        if len(found) != 1:
            raise self.damaged(f"its {section} have {len(found)} arrays named {name}")
        values = self._values(found[0], f"{section} {name}")
        if values.dtype.kind not in "iu" or (values.dtype.kind == "u" and values.size and values.max() > 2**63 - 1):
            raise self.damaged(f"the {name} of its {section} are not indices")
        if count is not None and values.size != count:
            raise self.damaged(f"states {count} {section}, but holds {values.size} {name} of them")
        return values.astype(np.int64)

    def _data_of(self, section: str, name: str, *, count: str, components: int) -> Array | None:
        rows = []
        for piece in self._pieces:
            found = [e for e in piece.arrays.get(section, []) if e.attributes.get("Name") == name]
            if len(found) != 1:
                return None
            values = self._values(found[0], name, components=components)
            if values.shape != (piece.counts[count], components):
                raise self.damaged(f"{name} has {values.size} values for {piece.counts[count]} rows of {components}")
            rows.append(values)
        return np.concatenate(rows) if rows else None

    # Decoding

    def _values(self, element: _Element, name: str, *, components: int = 0) -> Array:
        """The numbers of an array; flat, or (rows, ``components``)."""
        said = element.attributes.get("type", "")
        if said not in _DTYPES:
            raise self.damaged(f"{name} are of type {said[:20]!r}, which are not numbers")
        dtype = np.dtype(self._order + _DTYPES[said])
        way = element.attributes.get("format", "ascii")
        if way == "ascii":
            values = self._of_words("".join(element.text).split(), dtype, name)
        elif way in ("binary", "appended"):
            data = self._bytes_of(element, way, name)
            if len(data) % dtype.itemsize:
                raise self.damaged(f"{name} take {len(data)} bytes, which are no {said}")
            values = np.frombuffer(data, dtype)
        else:
            raise self.damaged(f"{name} are written as {way[:20]!r}")
        if not components:
            return values
        if self.whole_number(element.attributes.get("NumberOfComponents", "1"), "NumberOfComponents") != components:
            raise self.damaged(f"{name} have not {components} components")
        if values.size % components:
            raise self.damaged(f"{name} have {values.size} values, no multiple of {components}")
        return values.reshape(-1, components)

    def _of_words(self, words: list[str], dtype: np.dtype[Any], name: str) -> Array:
        try:
            exact = int if dtype.kind in "iu" else float
            with np.errstate(over="ignore"):  # what is beyond the type becomes infinite, and is refused as such
                return np.array([exact(word) for word in words], dtype=dtype.newbyteorder("="))
        except (ValueError, OverflowError) as error:
            raise self.damaged(f"{name} hold a value that is no {dtype.name} ({str(error)[:60]})") from None

    def _bytes_of(self, element: _Element, way: str, name: str) -> bytes:
        if way == "binary":
            blob = self._base64("".join(element.text).encode("ascii", "replace"), name)
        else:
            if self._blob is None:
                raise self.damaged(f"{name} are in appended data, of which it has none")
            begin = self._offset(element)
            end = next((offset for offset in self._offsets if offset > begin), len(self._blob))
            blob = bytes(self._blob[begin:end])
            if self._blob_encoding == "base64":
                blob = self._base64(blob, name)
        return self._decompressed(blob, name) if self._compressor else self._plain(blob, name)

    def _base64(self, text: bytes, name: str) -> bytes:
        """Base64 of one stream after the other: padding ends a stream, as it does that of a header."""
        try:
            streams = re.findall(rb"[^=]+={0,2}", b"".join(text.split()))
            return b"".join(base64.b64decode(stream, validate=True) for stream in streams)
        except binascii.Error as error:
            raise self.damaged(f"{name} are no base64 ({error})") from None

    def _plain(self, blob: bytes, name: str) -> bytes:
        size = self._header.itemsize
        count = int(np.frombuffer(blob, self._header, count=1)[0]) if len(blob) >= size else 0
        if len(blob) < size + count:
            raise self.damaged(f"{name} take {count} bytes, of which {max(len(blob) - size, 0)} are there")
        return blob[size : size + count]

    def _decompressed(self, blob: bytes, name: str) -> bytes:
        """Blocks behind a header: their number, their size, that of the last (0: as the others), their packed sizes."""
        size = self._header.itemsize
        if len(blob) < size:
            raise self.damaged(f"{name} have no data")
        n_blocks = int(np.frombuffer(blob, self._header, count=1)[0])
        if not n_blocks:
            return b""
        if len(blob) < size * (3 + n_blocks):
            raise self.damaged(f"{name} state {n_blocks} compressed blocks, for which they are too short")
        _, each, last, *packed = np.frombuffer(blob, self._header, count=3 + n_blocks).tolist()
        sizes = [each] * (n_blocks - 1) + [last or each]
        at, blocks = size * (3 + n_blocks), []
        for full, length in zip(sizes, packed, strict=True):
            block = blob[at : at + length]
            if len(block) < length or full > _MOST_SWOLLEN * length + 64:
                raise self.damaged(f"{name} have a block of {length} bytes that is cut short, or stated as {full}")
            blocks.append(self._block(block, full, name))
            at += length
        return b"".join(blocks)

    def _block(self, block: bytes, size: int, name: str) -> bytes:
        try:
            if self._compressor == "vtkZLibDataCompressor":
                out = zlib.decompressobj().decompress(block, size + 1)
            elif self._compressor == "vtkLZMADataCompressor":
                out = lzma.LZMADecompressor(memlimit=_LZMA_MEMORY).decompress(block, size + 1)
            else:
                out = _lz4(block, size)
        except (zlib.error, lzma.LZMAError, EOFError) as error:
            raise self.damaged(f"{name} cannot be decompressed ({error})") from None
        if len(out) != size:
            raise self.damaged(f"{name} have a block of {size} bytes that holds others")
        return out

    # Structure

    def _cut_off_appended(self) -> bytes:
        """Keep what stands after ``_`` in AppendedData; the XML before it, closed."""
        self._blob: memoryview | None = None
        self._blob_encoding = ""
        opened = _APPENDED.search(self._data)
        if opened is None:
            return self._data
        closed = _APPENDED_END.search(self._data, max(opened.end(), len(self._data) - 4096))
        if closed is None:
            raise self.damaged("its appended data have no end")
        said = re.search(rb"""encoding\s*=\s*["'](\w+)["']""", opened[1])
        self._blob_encoding = said[1].decode() if said else "base64"
        if self._blob_encoding not in ("raw", "base64"):
            raise self.damaged(f"its appended data are encoded as {self._blob_encoding[:20]!r}")
        end = closed.start() if self._blob_encoding == "base64" else len(self._data)
        self._blob = memoryview(self._data)[opened.end() : end]
        return self._data[: opened.start()] + b"</VTKFile>"

    def _parse(self, head: bytes) -> None:
        parser = expat.ParserCreate()
        parser.buffer_text = True
        structure = _Structure(self, parser, head)
        parser.StartElementHandler, parser.EndElementHandler = structure.start, structure.end
        parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = structure.text, structure.refuse
        try:
            parser.Parse(head, True)
        except expat.ExpatError as error:
            raise self.damaged(f"is no XML ({error})") from None
        except (ValueError, LookupError) as error:
            raise self.damaged(f"is in an encoding that is not read ({error})") from None
        self._head, self._pieces, self._fields = structure.head, structure.pieces, structure.fields

    def _offset(self, element: _Element) -> int:
        return self.whole_number(element.attributes.get("offset", ""), "an offset")

    def whole_number(self, word: str, what: str) -> int:
        """The count that a word says."""
        if not re.fullmatch(r"\s*[0-9]{1,18}\s*", word, re.ASCII):
            raise self.damaged(f"{what} is {word[:30]!r}, which is not a count")
        return int(word)

    def damaged(self, what: str) -> MeshError:
        """The error that says so, with the file and the way out."""
        return MeshError(f"{self._source}: as a VTK XML file it is damaged: {what}; {WAY_OUT}")


class _Structure:
    """What an XML parser meets: the attributes of the file, its pieces, and the arrays of the file as a whole."""

    def __init__(self, file: VtkFile, parser: expat.XMLParserType, data: bytes) -> None:
        self._file, self._parser, self._data = file, parser, data
        self._path: list[str] = []
        self._current: list[_Element] = []
        self.head: Mapping[str, str] = {}
        self.pieces: list[_Piece] = []
        self.fields: list[_Element] = []

    def start(self, name: str, attributes: dict[str, str]) -> None:
        """An element opens."""
        self._path.append(name)
        if len(self._path) > _DEEPEST:
            raise self._file.damaged(f"elements are nested more than {_DEEPEST} deep")
        if len(self._path) == 1 and name == "VTKFile":
            self.head = attributes
        if name == "Piece":
            counts = {key: self._file.whole_number(attributes.get(key, "0"), key) for key in _COUNTS}
            self.pieces.append(_Piece(counts))
        if name == "DataArray":
            element = _Element(attributes, self._parser.CurrentByteIndex)
            self._current.append(element)
            above, section = self._path[-3:-1] if len(self._path) >= 3 else ("", "")
            if section == "FieldData":
                self.fields.append(element)
            elif above == "Piece":
                self.pieces[-1].arrays.setdefault(section, []).append(element)

    def end(self, name: str) -> None:
        """An element closes."""
        self._path.pop()
        if name == "DataArray":
            element, at = self._current.pop(), self._parser.CurrentByteIndex
            closes = self._data.startswith(b"</DataArray", at)  # else it is <DataArray .../>, and this is behind it
            element.end = self._data.index(b">", at) + 1 if closes else at

    def text(self, words: str) -> None:
        """Text; that of elements inside of arrays is not theirs."""
        if self._path[-1] == "DataArray":
            self._current[-1].text.append(words)

    def refuse(self, *_: object) -> None:
        """A document type could define entities without end."""
        raise self._file.damaged("has a document type, which no VTK file needs")


def _lz4(block: bytes, size: int) -> bytes:
    from vtkmodules.vtkIOCore import vtkLZ4DataCompressor

    out = np.zeros(max(size, 1), dtype=np.uint8)
    decoder: Any = vtkLZ4DataCompressor()
    decoder.Uncompress(np.frombuffer(block, np.uint8), len(block), out, size)
    return out[:size].tobytes()


def read_vtp(data: bytes, source: str) -> Polygons:
    """Read VTK XML poly data, its polygons and triangle strips.

    Raises
    ------
    MeshError
        The file is damaged, or holds other counts than it states.
    """
    file = VtkFile(data, source, kind="PolyData")
    points = file.points()
    polys, strips = file.cells("Polys", count="NumberOfPolys"), file.cells("Strips", count="NumberOfStrips")
    faces = polygons_cut(points, polys.sizes, polys.corners, source)
    if not len(strips.sizes):
        return faces
    more = strips_cut(strips.sizes, strips.corners, source)
    return Polygons(points, np.concatenate([faces.faces, more]), faces.cut)
