"""Abaqus input decks: nodes and elements read, nodes rewritten between their commas.

Nodes of parts carry their part's name. What generates or places nodes in another way (``*NGEN``, ``*SYSTEM``,
instances that are moved, cylindrical coordinates, nodes in other files) is refused: such nodes would not go where the
map takes them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType

from musclefit.errors import InputError
from musclefit.geometry.arrays import Points
from musclefit.geometry.elements import CORNERS, CellKind
from musclefit.io.formats.decks.model import Deck, ElementTable, Lines, NodeTable, is_number_of_node, number_in

_REFUSED = ("NGEN", "NFILL", "NCOPY", "NMAP")

_HOLD_PLACES = (
    "ORIENTATION",
    "TRANSFORM",
    "DISTRIBUTION",
    "NORMAL",
    "IMPERFECTION",
    "INITIAL CONDITIONS",
    "RIGID SURFACE",
    "MASS",
    "ROTARY INERTIA",
)
"""Keywords whose data lines may hold places, directions or what was measured at rest."""

_SHAPES: Mapping[str, tuple[CellKind, int]] = MappingProxyType(
    {
        "C3D4": (CellKind.TET, 4),
        "C3D5": (CellKind.PYRAMID, 5),
        "C3D6": (CellKind.WEDGE, 6),
        "C3D8": (CellKind.HEX, 8),
        "C3D10": (CellKind.TET, 10),
        "C3D15": (CellKind.WEDGE, 15),
        "C3D20": (CellKind.HEX, 20),
        "COH3D6": (CellKind.WEDGE, 6),
        "COH3D8": (CellKind.HEX, 8),
        "SC6": (CellKind.WEDGE, 6),
        "SC8": (CellKind.HEX, 8),
        **{f"{family}3": (CellKind.TRIANGLE, 3) for family in ("S", "STRI", "R3D", "M3D", "SFM3D")},
        **{f"{family}4": (CellKind.QUAD, 4) for family in ("S", "R3D", "M3D", "SFM3D")},
        **{f"{family}6": (CellKind.TRIANGLE, 6) for family in ("M3D", "SFM3D")},
        **{f"{family}8": (CellKind.QUAD, 8) for family in ("S", "M3D", "SFM3D")},
        "STRI65": (CellKind.TRIANGLE, 6),
    }
)
"""Shape and number of nodes of element types, without the letters that follow the number."""


@dataclass(slots=True)
class _Reading:
    """What has been read so far, and where the reader is."""

    lines: Lines
    nodes: NodeTable
    elements: list[tuple[str, str, int, list[str]]] = field(default_factory=list)
    where: list[int] = field(default_factory=list)
    kept: dict[str, int] = field(default_factory=dict)
    includes: list[str] = field(default_factory=list)
    part: str = ""
    instances: dict[str, int] = field(default_factory=dict)

    def named(self, number: str) -> str:
        return f"{self.part}.{number}" if self.part else number


def parse_abaqus(data: bytes, *, source: str) -> Deck:
    """Read an input deck.

    Raises
    ------
    InputError
        No deck, no node, a node that is defined twice or whose coordinates are not numbers, or a keyword that makes or
        places nodes in another way; the message names the line.
    """
    lines = Lines(data, source)
    reading = _Reading(lines, NodeTable(source))
    keyword = ""
    for keyword, options, number, rows in _blocks(lines):
        _take(reading, keyword, options, number, rows)
    if not keyword:
        raise InputError(f"{source}: holds no keyword (a line that starts with *); is it an Abaqus deck?")
    for part, count in reading.instances.items():
        if count > 1:
            raise InputError(
                f"{source}: part {part!r} has {count} instances, which one set of nodes cannot follow; write the deck "
                "without parts (setValues(noPartsInputFile=ON))"
            )
    places = reading.nodes.nodes(reading.includes)
    elements = ElementTable(reading.nodes)
    for kind, part, number, row in reading.elements:
        _add(elements, kind, part, row, lines, number)
    return Deck(
        names=tuple(reading.nodes.index),
        nodes=places,
        elements=elements.elements(),
        unmeasured=elements.unmeasured,
        kept=reading.kept,
        includes=tuple(reading.includes),
        rewritten=partial(_rewritten, lines, tuple(reading.where)),
    )


def _blocks(lines: Lines) -> Iterator[tuple[str, dict[str, str], int, list[tuple[int, str]]]]:
    """Each keyword with its parameters, the number of its line and its data lines."""
    keyword, options, start, going_on = "", "", -1, False
    rows: list[tuple[int, str]] = []
    for number, line in lines:
        if line.startswith("**") or not line.strip():
            continue
        if line.lstrip().startswith("*"):
            if keyword:
                yield keyword, _options(options), start, rows
            head, _, options = line.strip()[1:].partition(",")
            keyword, start, rows = " ".join(head.upper().split()), number, []
            going_on = line.rstrip().endswith(",")
        elif going_on:
            options += line
            going_on = line.rstrip().endswith(",")
        else:
            rows.append((number, line))
    if keyword:
        yield keyword, _options(options), start, rows


def _options(text: str) -> dict[str, str]:
    pairs = (part.partition("=") for part in text.split(","))
    return {" ".join(key.upper().split()): value.strip().strip('"') for key, _, value in pairs if key.strip()}


def _take(
    reading: _Reading, keyword: str, options: Mapping[str, str], number: int, rows: Sequence[tuple[int, str]]
) -> None:
    lines = reading.lines
    if keyword in _REFUSED:
        raise lines.error(
            number, f"*{keyword} generates nodes, which would not go where the map takes them; write them out as *NODE"
        )
    if keyword == "SYSTEM" and rows:
        raise lines.error(
            number, "*SYSTEM places the nodes that follow in a system of their own; write them in the global one"
        )
    if keyword in ("PART", "INSTANCE"):
        reading.part = options.get("NAME" if keyword == "PART" else "PART", "")
    if keyword in ("END PART", "END INSTANCE"):
        reading.part = ""
    if keyword == "INSTANCE":
        reading.instances[reading.part] = reading.instances.get(reading.part, 0) + 1
        _require_unmoved(lines, options, rows)
    if keyword == "INCLUDE" and "INPUT" in options:
        reading.includes.append(options["INPUT"])
    if keyword in _HOLD_PLACES:
        reading.kept[f"*{keyword}"] = reading.kept.get(f"*{keyword}", 0) + 1
    if keyword == "NODE":
        _take_nodes(reading, options, number, rows)
    if keyword == "ELEMENT":
        _take_elements(reading, options, number, rows)
    if keyword == "ELGEN":
        reading.elements.append(("*ELGEN", reading.part, number, []))


def _require_unmoved(lines: Lines, options: Mapping[str, str], rows: Sequence[tuple[int, str]]) -> None:
    for number, line in rows[:2]:
        numbers = [number_in(part) for part in line.split(",") if re.fullmatch(r"[\s\d.eEdD+-]+", part)]
        if any(numbers):
            raise lines.error(
                number,
                f"instance {options.get('NAME', '')!r} is moved or turned ({line.strip()}); write the deck without "
                "parts (setValues(noPartsInputFile=ON)), so that nodes stand where they are",
            )


def _take_nodes(reading: _Reading, options: Mapping[str, str], number: int, rows: Sequence[tuple[int, str]]) -> None:
    lines = reading.lines
    if options.get("SYSTEM", "R").upper() not in ("R", ""):
        raise lines.error(number, f"*NODE, SYSTEM={options['SYSTEM']}: not rectangular; write the nodes in x, y, z")
    if "INPUT" in options:
        reading.includes.append(options["INPUT"])
    for at, line in rows:
        cells = line.split(",")
        name = cells[0].strip()
        if not is_number_of_node(name):
            raise lines.error(at, f"a node's number is {name!r}; expected a whole number before the first comma")
        try:
            place = [number_in(cell) for cell in (*cells[1:4], "", "", "")[:3]]
        except ValueError as error:
            raise lines.error(at, f"node {name}: a coordinate is {str(error)!r}; expected a number") from None
        reading.nodes.add(reading.named(str(int(name))), (place[0], place[1], place[2]))
        reading.where.append(at)


def _take_elements(reading: _Reading, options: Mapping[str, str], number: int, rows: Sequence[tuple[int, str]]) -> None:
    kind = options.get("TYPE", "").upper()
    if "INPUT" in options:
        reading.includes.append(options["INPUT"])
    wanted = _shape(kind)
    row: list[str] = []
    for at, line in rows:
        row += [cell.strip() for cell in line.split(",") if cell.strip()]
        if wanted is None or len(row) > wanted[1]:
            reading.elements.append((kind, reading.part, at, row))
            row = []
    if row:
        raise reading.lines.error(number, f"*ELEMENT, TYPE={kind}: the last element has {len(row) - 1} nodes, not all")


def _shape(kind: str) -> tuple[CellKind, int] | None:
    """Shape and number of nodes of an element type such as C3D8RH; None where it is not known."""
    plain = re.match(r"(STRI65|STRI3|[A-Z]+3D\d+|[A-Z]+\d+)", kind)
    return _SHAPES.get(plain[1]) if plain else None


def _add(elements: ElementTable, kind: str, part: str, row: Sequence[str], lines: Lines, number: int) -> None:
    shape = _shape(kind)
    if shape is None:
        elements.skip(f"of type {kind or 'not stated'}")
        return
    if not all(is_number_of_node(cell) for cell in row):
        raise lines.error(number, f"an element of type {kind} has {', '.join(row)!r}; expected whole numbers")
    prefix = f"{part}." if part else ""
    corners = [f"{prefix}{int(cell)}" for cell in row[1 : 1 + CORNERS[shape[0]]]]
    elements.add(shape[0], prefix + row[0], corners)


def _rewritten(lines: Lines, where: Sequence[int], moved: Points) -> bytes:
    changed = {}
    for number, place in zip(where, moved.tolist(), strict=True):
        cells = lines.lines[number].rstrip("\r").split(",")
        cells += [""] * (4 - len(cells))
        for k, value in enumerate(place, start=1):
            cells[k] = f" {value!r}" if cells[k].startswith((" ", "\t")) or not cells[k] else repr(value)
        changed[number] = ",".join(cells)
    return lines.with_lines(changed)
