"""Motions of OpenSim (.mot, .sto): bytes -> times and the values of coordinates, by name; radians and metres."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.errors import InputError
from musclefit.geometry.arrays import Float
from musclefit.io.formats.texts import decoded
from musclefit.rig.multibody import Coordinate, CoordinateKind, Multibody
from musclefit.rig.table_reader import suggestion

ENDINGS = (".mot", ".sto")
_BEYOND = 1e-6
"""Radians or metres that a range may be left by rounding alone."""


@dataclass(frozen=True, eq=False, slots=True)
class CoordinateMotion:
    """Coordinates of a model over time.

    Parameters
    ----------
    times_s : (k,) float64, rising
    values : mapping of coordinate to (k,) float64, radians or metres
    findings : tuple of Finding
        Columns and coordinates that have no counterpart, values beyond ranges, locked coordinates.
    """

    times_s: Float
    values: Mapping[str, Float]
    findings: tuple[Finding, ...]

    def at(self, row: int) -> dict[str, float]:
        """The coordinates of a row."""
        return {name: float(column[row]) for name, column in self.values.items()}


def parse_opensim_motion(data: bytes, multibody: Multibody, *, source: str) -> CoordinateMotion:
    """Read a motion of a model's coordinates.

    Degrees or radians are what the header says (``inDegrees``); lengths are metres. Columns are matched by name, whole
    or as a path (``/jointset/elbow/elbow_flexion/value``). Locked coordinates stay where the model has them, coupled
    ones follow their couplers, and nothing is clamped; findings say all of it.

    Raises
    ------
    InputError
        No header, another number of rows or columns than it says, a value that is not a number, times that do not rise,
        angles without a unit, or no column that is a coordinate of the model.
    """
    lines = decoded(data, source).splitlines()
    ends = [k for k, line in enumerate(lines) if line.strip().lower() == "endheader"]
    if not ends:
        raise InputError(f"{source}: no line 'endheader'; expected a motion of OpenSim (.mot, .sto), whole")
    header, body = lines[: ends[0]], [(k, line) for k, line in enumerate(lines) if k > ends[0] and line.strip()]
    labels = body[0][1].split() if body else []
    if len(body) < 2 or labels[:1] != ["time"]:
        raise InputError(f"{source}: no rows below 'endheader'; expected a line of labels, 'time' first, and numbers")
    table = _table(labels, body[1:], source)
    _require_counts(header, table, source)
    if not (np.diff(table[:, 0]) > 0.0).all():
        line = body[1 + int(np.argmax(np.diff(table[:, 0]) <= 0.0)) + 1][0] + 1
        raise InputError(f"{source}: line {line}: time does not rise; remove or sort the rows")
    columns, unused = _matched(labels, multibody)
    if not columns:
        wanted = suggestion(labels[1] if len(labels) > 1 else "", multibody.coordinates)
        raise InputError(f"{source}: no column is a coordinate of the model; {wanted}")
    turning = [n for n in columns if multibody.coordinates[n].kind is CoordinateKind.ROTATIONAL]
    factor = _degrees(header, source) if turning else 1.0
    values, findings = {}, []
    for name, column in columns.items():
        of = multibody.coordinates[name]
        given = table[:, column] * (factor if of.kind is CoordinateKind.ROTATIONAL else 1.0)
        findings += range_findings(of, given, source)
        if not of.locked:
            values[name] = given
    findings += _name_findings(columns, unused, multibody, source)
    return CoordinateMotion(table[:, 0], values, tuple(findings))


def _table(labels: list[str], rows: list[tuple[int, str]], source: str) -> Float:
    doubled = [label for label in labels if labels.count(label) > 1]
    if doubled:
        raise InputError(f"{source}: two columns are named {doubled[0]!r}; remove one")
    values = np.empty((len(rows), len(labels)))
    for row, (line, text) in enumerate(rows):
        cells = text.split()
        if len(cells) != len(labels):
            raise InputError(
                f"{source}: line {line + 1} has {len(cells)} values for {len(labels)} columns; the file is cut short "
                "or damaged: export it again"
            )
        try:
            values[row] = [float(cell) for cell in cells]
        except ValueError as error:
            raise InputError(f"{source}: line {line + 1}: {error}; correct it") from None
        if not np.isfinite(values[row]).all():
            column = labels[int(np.argmin(np.isfinite(values[row])))]
            raise InputError(f"{source}: line {line + 1}: {column} is not finite; cut or fill the gap")
    return values


def _stated(header: list[str], *keys: str) -> str:
    for line in header:
        found = re.fullmatch(r"\s*(\w+)\s*[= ]\s*(\S+)\s*", line)
        if found and found[1].lower() in keys:
            return found[2]
    return ""


def _require_counts(header: list[str], table: Float, source: str) -> None:
    for what, count, keys in (
        ("rows", len(table), ("nrows", "datarows")),
        ("columns", table.shape[1], ("ncolumns", "datacolumns")),
    ):
        said = _stated(header, *keys)
        if said and said != str(count):
            raise InputError(
                f"{source}: the header says {said} {what}, the file has {count}; it is cut short or was edited: "
                "export it again, or correct the header"
            )


def _degrees(header: list[str], source: str) -> float:
    said = _stated(header, "indegrees").lower()
    if said not in ("yes", "no"):
        raise InputError(f"{source}: the header does not say the unit of angles; add the line inDegrees=yes (or no)")
    return float(np.pi / 180.0) if said == "yes" else 1.0


def _matched(labels: list[str], multibody: Multibody) -> tuple[dict[str, int], list[str]]:
    columns: dict[str, int] = {}
    unused = []
    for k, label in enumerate(labels[1:], start=1):
        parts = label.strip("/").split("/")
        name = parts[-2] if len(parts) > 1 and parts[-1] == "value" else label
        if name in multibody.coordinates and name not in columns:
            columns[name] = k
        else:
            unused.append(label)
    return columns, unused


def range_findings(of: Coordinate, values: Float, source: str) -> list[Finding]:
    """What is to be told of a coordinate's values: that it is locked, or leaves its range."""
    unit = "radians" if of.kind is CoordinateKind.ROTATIONAL else "m"
    if of.locked:
        off = float(np.abs(values - of.default).max())
        if off <= _BEYOND:
            return []
        message = f"{of.name} is locked at {of.default:.4g} {unit}; the motion, up to {off:.4g} off, is not followed"
        return [Finding(Path(source).name, "locked-coordinate", message)]
    beyond = float(max(of.low - values.min(), values.max() - of.high))
    if beyond <= _BEYOND:
        return []
    message = f"{of.name} goes {beyond:.4g} {unit} beyond its range, {of.low:.4g} to {of.high:.4g}; it is not clamped"
    return [Finding(Path(source).name, "beyond-range", message)]


def _name_findings(columns: Mapping[str, int], unused: list[str], multibody: Multibody, source: str) -> list[Finding]:
    name, findings = Path(source).name, []
    if unused:
        message = f"{len(unused)} columns are not coordinates of the model: {', '.join(unused)}"
        findings.append(Finding(name, "unused-columns", message))
    coupled = {coupler.dependent for coupler in multibody.couplers}
    still = [c for c in multibody.coordinates if c not in columns and c not in coupled]
    if still:
        message = f"{len(still)} coordinates have no column and stay at their defaults: {', '.join(still)}"
        findings.append(Finding(name, "coordinates-at-default", message))
    over = sorted(coupled & set(columns))
    if over:
        findings.append(Finding(name, "coupled-coordinates", f"follow their couplers, not the file: {', '.join(over)}"))
    return findings
