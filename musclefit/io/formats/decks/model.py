"""A deck as a value: nodes, elements, what else of it holds places, and how to write it with its nodes moved."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Int, Points
from musclefit.geometry.elements import CellKind

ROUNDED = 1e-6
"""Largest rounding of a coordinate, in the deck's unit, that a column too narrow may bring."""

_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][+-]?\d+|[+-]\d+)?")
"""A number as decks write it; Fortran leaves out the E or writes D."""


@dataclass(frozen=True, eq=False, slots=True)
class Elements:
    """Elements of one shape.

    Parameters
    ----------
    kind : CellKind
    names : (k,) tuple of str
        Their numbers in the deck, with the part where numbers are those of parts.
    corners : (k, c) int64
        Indices of their corner nodes; nodes in the middle of edges are left out.
    """

    kind: CellKind
    names: tuple[str, ...]
    corners: Int


@dataclass(frozen=True, eq=False, slots=True)
class Deck:
    """The nodes and elements of a deck.

    Parameters
    ----------
    names : (n,) tuple of str
        The nodes' numbers, with the part where numbers are those of parts.
    nodes : (n, 3) float64
        In the deck's own unit.
    elements : tuple of Elements
        Solids and shells.
    unmeasured : mapping of str to int
        Elements whose shape is not measured, by their type: beams, springs, elements of nodes that are elsewhere.
    kept : mapping of str to int
        What else holds places or directions and stays as it is, by keyword.
    includes : tuple of str
        Files that the deck includes; they are not read.
    rewritten : callable
        Gives the bytes of the deck with its nodes moved to (n, 3) places, in the deck's unit.
    """

    names: tuple[str, ...]
    nodes: Points
    elements: tuple[Elements, ...]
    unmeasured: Mapping[str, int]
    kept: Mapping[str, int]
    includes: tuple[str, ...]
    rewritten: Callable[[Points], bytes]


class Lines:
    """The lines of a deck, each with its own end; bytes that are no text are kept.

    Parameters
    ----------
    data : bytes
    source : str
        The deck, for messages.

    Raises
    ------
    InputError
        The deck is empty, or not text.
    """

    def __init__(self, data: bytes, source: str) -> None:
        if not data.strip():
            raise InputError(f"{source}: an empty deck; export it again")
        if b"\0" in data:
            raise InputError(f"{source}: holds bytes of value 0, so it is not text; export the deck as text")
        self.source = source
        self.lines = data.decode("latin-1").split("\n")

    def __iter__(self) -> Iterator[tuple[int, str]]:
        """Numbers from 0, and lines without their end."""
        for number, line in enumerate(self.lines):
            yield number, line.rstrip("\r")

    def error(self, number: int, message: str) -> InputError:
        """An error that names the line."""
        return InputError(f"{self.source}: line {number + 1}: {message}")

    def with_lines(self, changed: Mapping[int, str]) -> bytes:
        """The bytes with some lines replaced; their ends stay."""
        lines = list(self.lines)
        for number, line in changed.items():
            lines[number] = line + ("\r" if lines[number].endswith("\r") else "")
        return "\n".join(lines).encode("latin-1")


MOST_DIGITS = 18
"""Of the number of a node or an element."""


def is_number_of_node(text: str) -> bool:
    """Whether a text is a whole number as decks count nodes and elements: ASCII digits, not more than 64 bits hold."""
    return text.isascii() and text.isdigit() and len(text) <= MOST_DIGITS


def number_in(text: str) -> float:
    """A coordinate as decks write it; a blank is 0.

    Raises
    ------
    ValueError
        It is not a finite number.
    """
    plain = text.strip()
    if not plain:
        return 0.0
    if not _NUMBER.fullmatch(plain):
        raise ValueError(plain)
    value = float(re.sub(r"(?<=[\d.])([+-]\d+)$", r"e\1", re.sub(r"[dD]", "e", plain)))
    if not math.isfinite(value):
        raise ValueError(plain)
    return value


def number_within(value: float, width: int) -> str:
    """The number with as many digits as fit into a column, a blank in front.

    Raises
    ------
    ValueError
        The column is too narrow for it.
    """
    for digits in range(17, 0, -1):
        text = f"{value:.{digits}g}"
        if len(text) < width:
            break
    if len(text) >= width or abs(float(text) - value) > ROUNDED:
        raise ValueError(f"{value!r} does not fit into {width} columns")
    return text.rjust(width)


class NodeTable:
    """Nodes by name, in the order in which they are met.

    Parameters
    ----------
    source : str
        The deck, for messages.
    """

    def __init__(self, source: str) -> None:
        self._source = source
        self.index: dict[str, int] = {}
        self.places: list[tuple[float, float, float]] = []

    def add(self, name: str, place: tuple[float, float, float]) -> None:
        """Add a node; InputError where it is there already."""
        if name in self.index:
            raise InputError(f"{self._source}: node {name} is defined twice; remove one of the two")
        self.index[name] = len(self.places)
        self.places.append(place)

    def nodes(self, includes: Sequence[str]) -> Points:
        """(n, 3) places; InputError where there is none."""
        if not self.places:
            more = f"; it includes {', '.join(includes[:3])}: give the file that holds the nodes" if includes else ""
            raise InputError(f"{self._source}: defines no node{more or '; correct the path, or export the deck again'}")
        return np.array(self.places, dtype=np.float64)


class ElementTable:
    """Elements by shape; those of nodes that the deck does not define are counted.

    Parameters
    ----------
    nodes : NodeTable
    """

    def __init__(self, nodes: NodeTable) -> None:
        self._index = nodes.index
        self._found: dict[CellKind, tuple[list[str], list[list[int]]]] = {}
        self.unmeasured: dict[str, int] = {}

    def add(self, kind: CellKind, name: str, corners: Sequence[str]) -> None:
        """Add an element of these corner nodes."""
        numbers = [self._index.get(corner, -1) for corner in corners]
        if min(numbers) < 0:
            self.skip("of nodes that are not in this file")
            return
        names, rows = self._found.setdefault(kind, ([], []))
        names.append(name)
        rows.append(numbers)

    def skip(self, what: str, count: int = 1) -> None:
        """Count elements that are not measured."""
        self.unmeasured[what] = self.unmeasured.get(what, 0) + count

    def elements(self) -> tuple[Elements, ...]:
        """All of them."""
        return tuple(
            Elements(kind, tuple(names), np.array(rows, dtype=np.int64)) for kind, (names, rows) in self._found.items()
        )
