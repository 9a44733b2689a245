"""LS-DYNA keyword decks: nodes and elements read, nodes rewritten in their columns.

Fields stand in fixed columns (standard, long or I10, by ``*KEYWORD`` or by the sign behind a keyword) or between
commas. What generates or moves nodes elsewhere, and parameters in place of coordinates, are refused.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType

from musclefit.errors import InputError
from musclefit.geometry.arrays import Points
from musclefit.geometry.elements import CellKind
from musclefit.io.formats.decks.model import (
    Deck,
    ElementTable,
    Lines,
    NodeTable,
    is_number_of_node,
    number_in,
    number_within,
)

_REFUSED: Mapping[str, str] = MappingProxyType(
    {
        "NODE_TRANSFORM": "moves nodes after they are read; apply it first and export the deck",
        "NODE_SCALAR": "defines nodes without places",
        "NODE_RIGID_SURFACE": "defines nodes in a form that is not known here; write them as *NODE",
    }
)

_HOLD_PLACES = (
    "DEFINE_COORDINATE_SYSTEM",
    "DEFINE_BOX",
    "DEFINE_VECTOR",
    "DEFINE_SD_ORIENTATION",
    "DEFINE_TRANSFORMATION",
    "RIGIDWALL",
    "PART_INERTIA",
    "CONSTRAINED_NODAL_RIGID_BODY_INERTIA",
    "ELEMENT_SOLID_ORTHO",
    "ELEMENT_SHELL_BETA",
    "ELEMENT_BEAM_ORIENTATION",
    "INITIAL_STRESS",
    "INITIAL_FOAM_REFERENCE_GEOMETRY",
    "AIRBAG_REFERENCE_GEOMETRY",
    "AIRBAG_SHELL_REFERENCE_GEOMETRY",
    "CONTACT_GEBOD",
    "CONTACT_ENTITY",
    "SECTION_SEATBELT",
)
"""Keywords (and what their names begin with) whose cards hold places, directions or what was measured at rest."""


_INCLUDE_ONE = ("INCLUDE_TRANSFORM", "INCLUDE_AUTO_OFFSET", "INCLUDE_BINARY", "INCLUDE_NASTRAN", "INCLUDE_STAMPED_PART")
"""Keywords whose first card alone names a file."""

_CARDS: Mapping[str, int] = MappingProxyType({"": 1, "_THICKNESS": 2, "_BETA": 2, "_THICKNESS_BETA": 2, "_ORTHO": 3})
"""Cards of an element, by the option of its keyword."""


@dataclass(frozen=True, slots=True)
class _Columns:
    """Widths of whole numbers and of coordinates."""

    number: int
    place: int


_STANDARD, _LONG, _I10 = _Columns(8, 16), _Columns(20, 20), _Columns(10, 16)


@dataclass(frozen=True, slots=True)
class _NodeLine:
    """Where a node's coordinates stand: at (start, end) of a line in columns, or between its commas."""

    number: int
    spans: tuple[tuple[int, int], ...]
    commas: bool


def parse_lsdyna(data: bytes, *, source: str) -> Deck:
    """Read a keyword deck.

    Raises
    ------
    InputError
        No deck, no node, a node that is defined twice or whose coordinates are not numbers, or a keyword that makes
        nodes in another way; the message names the line.
    """
    lines = Lines(data, source)
    read = _Reading(lines, NodeTable(source))
    for number, line in lines:
        if line.startswith("$") or not line.strip():
            continue
        if line.startswith("*"):
            read.begin(number, line)
            if read.keyword == "END":
                break
        else:
            read.card(number, line)
    if not read.keyword:
        raise InputError(f"{source}: holds no keyword (a line that starts with *); is it an LS-DYNA deck?")
    places = read.nodes.nodes(read.includes)
    elements = ElementTable(read.nodes)
    for name, widths, cards in read.blocks:
        _add_elements(elements, name, widths, cards, lines)
    return Deck(
        names=tuple(read.nodes.index),
        nodes=places,
        elements=elements.elements(),
        unmeasured=elements.unmeasured,
        kept=read.kept,
        includes=tuple(read.includes),
        rewritten=partial(_rewritten, lines, tuple(read.where), tuple(read.nodes.index)),
    )


@dataclass(slots=True)
class _Reading:
    """What has been read so far, and which keyword the reader is in."""

    lines: Lines
    nodes: NodeTable
    blocks: list[tuple[str, _Columns, list[tuple[int, str]]]] = field(default_factory=list)
    kept: dict[str, int] = field(default_factory=dict)
    includes: list[str] = field(default_factory=list)
    where: list[_NodeLine] = field(default_factory=list)
    keyword: str = ""
    columns: _Columns = _STANDARD
    default: _Columns = _STANDARD
    first: bool = True

    def begin(self, number: int, line: str) -> None:
        """A line with a keyword."""
        self.keyword, self.columns = _keyword(line, self.default)
        self.first = True
        if self.keyword == "KEYWORD":
            self.default = _stated_columns(line) or self.default
        if self.keyword in _REFUSED:
            raise self.lines.error(number, f"*{self.keyword} {_REFUSED[self.keyword]}")
        if self.keyword.startswith(_HOLD_PLACES):
            self.kept[f"*{self.keyword}"] = self.kept.get(f"*{self.keyword}", 0) + 1
        if self.keyword.startswith("ELEMENT"):
            self.blocks.append((self.keyword, self.columns, []))

    def card(self, number: int, line: str) -> None:
        """A line below a keyword."""
        if self.keyword == "NODE":
            found, name, place = _node(self.lines, number, line, self.columns)
            self.nodes.add(name, place)
            self.where.append(found)
        elif self.keyword.startswith("ELEMENT"):
            self.blocks[-1][2].append((number, line))
        elif self.keyword == "INCLUDE" or (self.first and self.keyword in _INCLUDE_ONE):
            self.includes.append(line.strip())
        self.first = False


def _keyword(line: str, default: _Columns) -> tuple[str, _Columns]:
    """The keyword in capitals, and the columns that the sign behind it asks for."""
    word = line[1:].split()[0].upper() if line[1:].split() else ""
    rest = line[1 + len(word) :].strip()
    sign = word[-1:] if word[-1:] in "+-%" else rest[:1] if rest[:1] and rest[:1] in "+-%" else ""
    columns = {"+": _LONG, "-": _STANDARD, "%": _I10}.get(sign, default)
    return word.rstrip("+-%"), columns


def _stated_columns(line: str) -> _Columns | None:
    """What *KEYWORD says of all that follows."""
    said = line.upper().replace(" ", "")
    if re.search(r"LONG=[YK]", said):
        return _LONG
    return _I10 if re.search(r"I10=Y", said) else None


def _node(lines: Lines, number: int, line: str, columns: _Columns) -> tuple[_NodeLine, str, tuple[float, float, float]]:
    commas = "," in line
    if commas:
        ends = [found.start() for found in re.finditer(",", line)] + [len(line)]
        if len(ends) < 4:
            raise lines.error(number, f"a node has {len(ends)} values ({line.strip()!r}); expected number, x, y, z")
        spans = tuple((ends[k] + 1, ends[k + 1]) for k in range(3))
        name = line[: ends[0]].strip()
    else:
        starts = [columns.number + k * columns.place for k in range(3)]
        spans = tuple((start, start + columns.place) for start in starts)
        name = line[: columns.number].strip()
    if not is_number_of_node(name):
        raise lines.error(number, f"a node's number is {name!r}; expected a whole number in the first field")
    try:
        x, y, z = (number_in(line[a:b]) for a, b in spans)
    except ValueError as error:
        raise lines.error(
            number, f"node {name}: a coordinate is {str(error)!r}; expected a number (parameters are not evaluated)"
        ) from None
    return _NodeLine(number, spans, commas), str(int(name)), (x, y, z)


def _rewritten(lines: Lines, where: Sequence[_NodeLine], names: Sequence[str], moved: Points) -> bytes:
    changed: dict[int, str] = {}
    for name, line, place in zip(names, where, moved.tolist(), strict=True):
        text = lines.lines[line.number].rstrip("\r")
        if not line.commas:
            text = text.ljust(line.spans[-1][1])
        for (a, b), value in reversed(list(zip(line.spans, place, strict=True))):
            try:
                text = text[:a] + (repr(value) if line.commas else number_within(value, b - a)) + text[b:]
            except ValueError as error:
                raise lines.error(line.number, f"node {name}: {error}; write the deck in the long format") from None
        changed[line.number] = text
    return lines.with_lines(changed)


def _add_elements(
    elements: ElementTable, keyword: str, columns: _Columns, cards: Sequence[tuple[int, str]], lines: Lines
) -> None:
    family = next((f for f in ("ELEMENT_SOLID", "ELEMENT_TSHELL", "ELEMENT_SHELL") if keyword.startswith(f)), None)
    step = _CARDS.get(keyword[len(family or "") :])
    if family is None or step is None:
        elements.skip(f"cards of *{keyword}", len(cards))
        return
    rows = [_fields(line, columns.number) for _, line in cards]
    split = family == "ELEMENT_SOLID" and rows and all(len(row) == 2 for row in rows[:: step + 1]) and len(rows) > 1
    if split:  # the number and part on a card of their own, up to ten nodes on the next
        step += 1
    for k in range(0, len(rows) - step + 1, step):
        row = [*rows[k], *rows[k + 1]] if split else rows[k]
        if not all(is_number_of_node(field) for field in row):
            raise lines.error(cards[k][0], f"*{keyword}: found {cards[k][1].strip()!r}; expected whole numbers")
        if len(row) < 5:
            raise lines.error(cards[k][0], f"*{keyword}: found {len(row)} numbers; expected the element's nodes too")
        _add(
            elements,
            row[0],
            [node for field in row[2:] if (node := str(int(field))) != "0"],
            solid=family != "ELEMENT_SHELL",
        )


def _add(elements: ElementTable, name: str, nodes: list[str], *, solid: bool) -> None:
    """An element by its nodes; those that LS-DYNA writes twice make it a tetrahedron, wedge, pyramid or triangle."""
    if not solid:
        corners = nodes[:4]
        if len(corners) == 4 and corners[2] != corners[3]:
            elements.add(CellKind.QUAD, name, corners)
        else:
            elements.add(CellKind.TRIANGLE, name, corners[:3])
        return
    if len(nodes) == 10 and len(set(nodes)) == 10:
        elements.add(CellKind.TET, name, nodes[:4])
        return
    n = (nodes + nodes[-1:] * 8)[:8] if len(nodes) == 4 else nodes[:8]
    if len(n) < 8:
        elements.skip(f"solids of {len(nodes)} nodes")
    elif n[3] == n[4] == n[5] == n[6] == n[7]:
        elements.add(CellKind.TET, name, n[:4])
    elif n[4] == n[5] and n[6] == n[7] and n[4] != n[6]:
        elements.add(CellKind.WEDGE, name, [n[0], n[4], n[1], n[3], n[6], n[2]])
    elif n[4] == n[5] == n[6] == n[7]:
        elements.add(CellKind.PYRAMID, name, n[:5])
    else:
        elements.add(CellKind.HEX, name, n)


def _fields(line: str, width: int) -> list[str]:
    """The fields of a card, between commas or in columns; a blank is 0, blanks at the end are none."""
    text = line.rstrip().rstrip(",")
    fields = text.split(",") if "," in text else [text[k : k + width] for k in range(0, len(text), width)]
    return [field.strip() or "0" for field in fields]
