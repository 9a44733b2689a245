"""FEBio decks (.feb, versions 2 to 4): nodes and elements read, the coordinates of nodes rewritten in place.

The file is read by an XML parser that tells where each node's text stands in the bytes; entities are refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from types import MappingProxyType
from xml.parsers import expat

from musclefit.errors import InputError
from musclefit.geometry.arrays import Points
from musclefit.geometry.elements import CORNERS, CellKind
from musclefit.io.formats.decks.model import Deck, ElementTable, NodeTable, is_number_of_node, number_in

_SHAPES: Mapping[str, CellKind] = MappingProxyType(
    {
        **dict.fromkeys(("tet4", "tet10", "tet15", "tet20", "TET10G4", "TET10G8"), CellKind.TET),
        **dict.fromkeys(("hex8", "hex20", "hex27"), CellKind.HEX),
        **dict.fromkeys(("penta6", "penta15"), CellKind.WEDGE),
        **dict.fromkeys(("pyra5", "pyra13"), CellKind.PYRAMID),
        **dict.fromkeys(("quad4", "quad8", "quad9", "q4ans", "q4eas"), CellKind.QUAD),
        **dict.fromkeys(("tri3", "tri6", "tri7"), CellKind.TRIANGLE),
    }
)

_HOLD_PLACES = (
    "ElementData",
    "fiber",
    "mat_axis",
    "center_of_mass",
    "joint_origin",
    "origin",
    "insertion",
    "Initial",
    "MeshAdaptor",
)
"""Elements of a file that hold places, directions or what was measured at rest."""

_MESHES = ("Mesh", "Geometry")


class _Reader:
    """What expat tells, kept; positions are byte offsets."""

    def __init__(self, data: bytes, source: str) -> None:
        self.source, self.data = source, data
        self.nodes = NodeTable(source)
        self.where: list[tuple[int, int]] = []
        self.rows: list[tuple[str, str, str, list[str]]] = []
        self.kept: dict[str, int] = {}
        self.includes: list[str] = []
        self.root = ""
        self._path: list[tuple[str, Mapping[str, str]]] = []
        self._start = -1
        self._text: list[str] = []
        self._part = ""
        self._parser = expat.ParserCreate()
        self._parser.buffer_text = False
        self._parser.StartElementHandler = self._begin
        self._parser.EndElementHandler = self._end
        self._parser.CharacterDataHandler = self._characters
        self._parser.EntityDeclHandler = self._entity

    def read(self) -> None:
        """Read all of it."""
        try:
            self._parser.Parse(self.data, True)
        except expat.ExpatError as error:
            raise InputError(
                f"{self.source}: line {error.lineno}: is not valid XML ({expat.errors.messages[error.code]}); "
                "export it again"
            ) from None

    def _error(self, message: str) -> InputError:
        return InputError(f"{self.source}: line {self._parser.CurrentLineNumber}: {message}")

    def _entity(self, *_: object) -> None:
        raise self._error("declares an entity, which is not read; write the file without")

    def _begin(self, tag: str, attributes: dict[str, str]) -> None:
        if not self._path:
            self.root = tag
        self._path.append((tag, attributes))
        if tag == "Part":
            self._part = attributes.get("name", "")
        if tag in ("include", "Include") or (tag in _MESHES and "from" in attributes):
            self.includes.append(attributes.get("file") or attributes.get("from") or "?")
        if tag == "Instance":
            raise self._error("an Instance places a Part a second time; write the mesh out without parts")
        if tag in _HOLD_PLACES:
            self.kept[f"<{tag}>"] = self.kept.get(f"<{tag}>", 0) + 1
        if self._is_row(tag):
            self._start, self._text = -1, []

    def _characters(self, text: str) -> None:
        if self._path and self._is_row(self._path[-1][0]):
            if self._start < 0:
                self._start = self._parser.CurrentByteIndex
            self._text.append(text)

    def _end(self, tag: str) -> None:
        _, attributes = self._path[-1]
        if self._is_row(tag):
            if tag == "node":
                self._take_node(attributes, self._parser.CurrentByteIndex)
            else:
                cells = [cell.strip() for cell in "".join(self._text).split(",")]
                kind = self._path[-2][1].get("type", "")
                self.rows.append((kind, self._part, attributes.get("id", "?"), cells))
        if tag == "Part":
            self._part = ""
        self._path.pop()

    def _is_row(self, tag: str) -> bool:
        """Whether it is a node or an element of the mesh, which is where the reader is."""
        above = {"node": "Nodes", "elem": "Elements"}.get(tag)
        path = [name for name, _ in self._path]
        inside = path[:-1] if path and path[-1] == tag else path
        return above is not None and inside[-1:] == [above] and any(mesh in inside for mesh in _MESHES)

    def _take_node(self, attributes: Mapping[str, str], end: int) -> None:
        number, text = attributes.get("id", ""), "".join(self._text)
        if not is_number_of_node(number):
            raise self._error(f"a node's id is {number!r}; expected a whole number")
        cells = text.split(",")
        try:
            place = [number_in(cell) if cell.strip() else float("nan") for cell in cells]
        except ValueError as error:
            raise self._error(f"node {number}: a coordinate is {str(error)!r}; expected a number") from None
        if len(place) != 3 or any(value != value for value in place):
            raise self._error(f"node {number} has the coordinates {text.strip()!r}; expected x,y,z")
        if self.data[self._start : end].decode("latin-1") != text:
            raise self._error(f"node {number}: its coordinates hold a comment or an entity; write them plainly")
        name = f"{self._part}.{int(number)}" if self._part else str(int(number))
        self.nodes.add(name, (place[0], place[1], place[2]))
        self.where.append((self._start, end))


def parse_febio(data: bytes, *, source: str) -> Deck:
    """Read a FEBio file.

    Raises
    ------
    InputError
        No XML, no FEBio file, no node, a node that is defined twice or whose coordinates are not numbers, entities, or
        parts that are placed by instances; the message names the line.
    """
    if not data.strip():
        raise InputError(f"{source}: an empty deck; export it again")
    reader = _Reader(data, source)
    reader.read()
    if reader.root != "febio_spec":
        raise InputError(f"{source}: its first element is <{reader.root}>, not <febio_spec>; is it a FEBio file?")
    places = reader.nodes.nodes(reader.includes)
    elements = ElementTable(reader.nodes)
    for kind, part, number, row in reader.rows:
        shape = _SHAPES.get(kind)
        if shape is None or len(row) < CORNERS[shape]:
            elements.skip(f"of type {kind or 'not stated'}")
        else:
            prefix = f"{part}." if part else ""
            elements.add(shape, prefix + number, [prefix + cell for cell in row[: CORNERS[shape]]])
    return Deck(
        names=tuple(reader.nodes.index),
        nodes=places,
        elements=elements.elements(),
        unmeasured=elements.unmeasured,
        kept=reader.kept,
        includes=tuple(reader.includes),
        rewritten=partial(_rewritten, data, tuple(reader.where)),
    )


def _rewritten(data: bytes, where: Sequence[tuple[int, int]], moved: Points) -> bytes:
    parts, last = [], 0
    for (start, end), place in zip(where, moved.tolist(), strict=True):
        parts += [data[last:start], ",".join(repr(value) for value in place).encode("ascii")]
        last = end
    return b"".join([*parts, data[last:]])
