"""Tables of text -> columns of names and positions in mm, or an error with line and column; knows no landmark."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from musclefit.errors import LandmarkError
from musclefit.geometry.arrays import Float, Points
from musclefit.io.formats.texts import in_mm
from musclefit.vocabulary import Unit


@dataclass(frozen=True, slots=True)
class Rows:
    """The rows of a text table by heading, each with its line number."""

    path: Path
    headings: tuple[str, ...]
    rows: tuple[tuple[int, tuple[str, ...]], ...]

    @classmethod
    def of_csv(cls, text: str, path: Path, *, key: str = "name") -> Rows:
        """Read a table parted by comma, semicolon or tab, whose first line has the headings, ``key`` among them.

        Raises
        ------
        LandmarkError
            There is no line of headings, or none of the key; or a row has another number of values.
        """
        first = (text.lstrip().splitlines() or [""])[0]
        delimiter = max(",;\t", key=first.count)
        lines = csv_lines(text, path, delimiter=delimiter)
        if not lines:
            raise LandmarkError(f"{path}: has no line of headings; export it again")
        headings = tuple(cell.strip().lower() for cell in lines[0][1])
        table = cls(path, headings, tuple(lines[1:]))
        table.require(key)
        table.check_widths()
        return table

    @property
    def said(self) -> str:
        """The headings in words."""
        return ", ".join(self.headings)

    def require(self, *wanted: str) -> None:
        """Raise LandmarkError unless each column is there, once."""
        for heading in wanted:
            if heading not in self.headings:
                raise LandmarkError(f"{self.path}: no column {heading}; found are: {self.said}")
            if self.headings.count(heading) > 1:
                raise LandmarkError(f"{self.path}: two columns are named {heading}; remove one")

    def check_widths(self) -> None:
        """Raise LandmarkError unless every row has a value for every column."""
        for line, cells in self.rows:
            if len(cells) != len(self.headings):
                raise LandmarkError(
                    f"{self.path}: line {line} has {len(cells)} values for {len(self.headings)} columns; correct it "
                    "(numbers are written with a point)"
                )

    def texts(self, heading: str) -> tuple[str, ...]:
        """One column; names and labels must not be empty.

        Raises
        ------
        LandmarkError
            A row has none.
        """
        self.require(heading)
        column = self.headings.index(heading)
        texts = tuple(cells[column].strip() for _, cells in self.rows)
        if heading in ("name", "label") and "" in texts:
            raise LandmarkError(
                f"{self.path}: line {self.rows[texts.index('')][0]} has no {heading}; name the landmark"
            )
        return texts

    def numbers(self, headings: Sequence[str]) -> Float:
        """(rows, columns) finite float64; LandmarkError names line and column of the first value that is none."""
        self.require(*headings)
        columns = [self.headings.index(heading) for heading in headings]
        with suppress(ValueError):  # all at once where every value is right
            values = np.array([[float(cells[k]) for k in columns] for _, cells in self.rows]).reshape(-1, len(columns))
            if np.isfinite(values).all():
                return values
        values = np.empty((len(self.rows), len(columns)))
        for i, (line, cells) in enumerate(self.rows):
            for k, column in enumerate(columns):
                try:
                    values[i, k] = float(cells[column])
                except ValueError as error:
                    raise LandmarkError(
                        f"{self.path}: line {line}: {headings[k]} is {cells[column]!r}, which is not a number (numbers "
                        "are written with a point); correct it"
                    ) from error
                if not np.isfinite(values[i, k]):
                    said = f"{headings[k]} is {cells[column]}, not finite"
                    raise LandmarkError(f"{self.path}: line {line}: {said}; correct it")
        return values


def plain_cell(cell: object) -> object:
    """A cell of a table that is written: control characters escaped, and no text that a spreadsheet would run."""
    if not isinstance(cell, str):
        return cell
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in cell)
    if text[:1] not in ("=", "+", "-", "@"):
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """A table as it is written, its headings first; cells are `plain_cell`, and None an empty one."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([plain_cell(cell) for cell in row] for row in rows)
    return text.getvalue()


def csv_of(rows: Sequence[Mapping[str, object]]) -> str:
    """The same of rows by heading, those of the first; empty where there is none."""
    return csv_text([rows[0], *([row.get(heading) for heading in rows[0]] for row in rows)]) if rows else ""


def csv_lines(text: str, path: Path, *, delimiter: str) -> list[tuple[int, tuple[str, ...]]]:
    """The rows that are not blank, each with its line number, from 1; LandmarkError where a line is not valid CSV."""
    reader = csv.reader(io.StringIO(text), delimiter=delimiter, strict=True)
    try:
        return [(reader.line_num, tuple(row)) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise LandmarkError(f"{path}: line {reader.line_num}: {error}; correct the line") from error


@dataclass(frozen=True, slots=True)
class PositionColumns:
    """The three headings of a position and their unit."""

    headings: tuple[str, ...]
    unit: Unit

    @classmethod
    def find(cls, rows: Rows, prefix: str, units: Unit) -> PositionColumns | None:
        """Find ``<prefix>x``, with or without a unit, and its sisters; None where there is none of the three.

        Raises
        ------
        LandmarkError
            A unit is unknown or not the same in all three, or one of the three is missing or there twice.
        """
        found: dict[str, tuple[str, str]] = {}
        for heading in rows.headings:
            said = re.fullmatch(rf"{re.escape(prefix.lower())}([xyz])(?:_([a-zµ]+))?", heading)
            if said is None:
                continue
            axis, unit = said[1], said[2] or ""
            if unit and unit not in set(Unit):
                known = ", ".join(Unit)
                raise LandmarkError(f"{rows.path}: column {heading} is in {unit!r}, an unknown unit; known are {known}")
            if axis in found:
                raise LandmarkError(f"{rows.path}: both {found[axis][0]} and {heading} give {axis}; remove one")
            found[axis] = heading, unit
        if not found:
            return None
        first, unit = next(iter(found.values()))
        for axis in "xyz":
            if axis not in found:
                missing = f"{prefix}{axis}" + (f"_{unit}" if unit else "")
                raise LandmarkError(f"{rows.path}: no column {missing} beside {first}; found are: {rows.said}")
        if any(other != unit for _, other in found.values()):
            said_units = ", ".join(heading for heading, _ in found.values())
            raise LandmarkError(f"{rows.path}: the columns {said_units} are in different units; write all in one")
        return cls(tuple(found[axis][0] for axis in "xyz"), Unit(unit) if unit else units)

    def read(self, rows: Rows) -> Points:
        """(rows, 3) positions, mm."""
        return in_mm(rows.numbers(self.headings), self.unit, source=str(rows.path), error=LandmarkError)
