"""Files of measures of a body (TOML, JSON, CSV) -> measures in mm; knows no body.

TOML and JSON hold one table, ``measures``, of one table for each measure; a CSV has one row for each, and empty cells
where a measure has no such key::

    [measures]
    stature = { kind = "stature", value = 178, unit = "cm" }
    waist = { kind = "girth", value = 92, unit = "cm", height = 108 }
    "right calf" = { kind = "girth", value = 38, unit = "cm", from = "right knee", to = "right ankle" }
    "right arm" = { kind = "length", value = 0.33, unit = "m", from = "right acromion", to = "right elbow" }

Heights are in the measure's own unit. ``at``, ``from`` and ``to`` are names of landmarks on the template.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from musclefit.errors import RigError
from musclefit.io.formats.rows import Rows
from musclefit.io.formats.tables import parse_table
from musclefit.io.formats.texts import LARGEST_MM, decoded, read_bytes
from musclefit.pipeline.body_measures import BodyMeasure, MeasureKind
from musclefit.rig.table_reader import Section
from musclefit.vocabulary import Unit

ENDINGS = (".toml", ".json", ".csv")

_ALWAYS = ("kind", "value", "unit")
_MORE = {MeasureKind.STATURE: (), MeasureKind.GIRTH: ("height", "at", "from", "to"), MeasureKind.LENGTH: ("from", "to")}


def read_body_measures(path: str | Path) -> tuple[BodyMeasure, ...]:
    """Read the measures of a file.

    Raises
    ------
    InputError
        A file that cannot be read.
    RigError, LandmarkError
        What is not valid TOML, JSON or CSV; a key that is missing, unknown or of another kind of measure; a value that
        is not a length above 0; no measure.
    """
    path = Path(path)
    data = read_bytes(path)
    if path.suffix.lower() == ".csv":
        table: dict[str, Any] = {"measures": _of_rows(Rows.of_csv(decoded(data, str(path), error=RigError), path))}
    else:
        table = parse_table(data, source=str(path))
    whole = Section(table, str(path))
    whole.refuse_unknown(["measures"])
    whole.require(["measures"])
    measures = whole.section("measures")
    if not measures.table:
        raise whole.error("measures", "holds no measure; add one, such as the stature")
    return tuple(_measure(name, measures.section(name)) for name in measures.table)


def _measure(name: str, row: Section) -> BodyMeasure:
    row.require(_ALWAYS)
    kind, unit = row.choice("kind", MeasureKind), row.choice("unit", Unit)
    row.refuse_unknown([*_ALWAYS, *_MORE[kind]])
    if ("from" in row) != ("to" in row):
        missing = "to" if "from" in row else "from"
        raise row.error(missing, "is missing; a line between two landmarks needs both ends")
    if kind is MeasureKind.LENGTH:
        row.require(["from", "to"])
    if kind is MeasureKind.GIRTH:
        if not any(key in row for key in ("height", "at", "from")):
            raise row.error("height", "is missing; say at which height, at which landmark, or between which two")
        for key in ("at", "from"):
            if "height" in row and key in row:
                raise row.error(key, "stands beside a height; a girth is taken at one of them: remove the other")
    return BodyMeasure(
        name,
        kind,
        wanted_mm=_length(row, "value", unit),
        unit=unit,
        height_mm=_length(row, "height", unit) if "height" in row else None,
        at=row.text("at") if "at" in row else "",
        ends=(row.text("from"), row.text("to")) if "from" in row else (),
    )


def _length(row: Section, key: str, unit: Unit) -> float:
    value = row.number(key)
    if not 0.0 < value * unit.in_mm < LARGEST_MM:
        raise row.error(key, f"found {value:g}; expected a length above 0")
    return value * unit.in_mm


def _of_rows(rows: Rows) -> dict[str, dict[str, Any]]:
    """The table that a TOML file would hold; empty cells are keys that are not there."""
    rows.require("name", *_ALWAYS)
    table: dict[str, dict[str, Any]] = {}
    for name, (line, cells) in zip(rows.texts("name"), rows.rows, strict=True):
        if name in table:
            raise RigError(f"{rows.path}: line {line}: a second measure {name!r}; rename or remove one")
        given = {key: cell.strip() for key, cell in zip(rows.headings, cells, strict=True) if key != "name"}
        table[name] = {key: _cell(key, cell, rows.path, line) for key, cell in given.items() if cell}
    return table


def _cell(key: str, cell: str, path: Path, line: int) -> str | float:
    if key not in ("value", "height"):
        return cell
    try:
        return float(cell)
    except ValueError:
        raise RigError(
            f"{path}: line {line}: {key} is {cell!r}, which is not a number (numbers are written with a point); "
            "correct it"
        ) from None
