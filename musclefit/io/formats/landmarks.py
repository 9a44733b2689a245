"""Landmark files (CSV, Slicer markups, .trc) -> named points in mm; knows headings and frames, not bones or fields."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from musclefit.anatomy.findings import Finding, some_of
from musclefit.errors import InputError, LandmarkError
from musclefit.geometry.arrays import Points, frozen
from musclefit.io.formats.rows import PositionColumns, Rows, csv_lines
from musclefit.io.formats.texts import in_mm, read_text
from musclefit.io.formats.trc import read_trajectories
from musclefit.vocabulary import Unit

COINCIDENT_MM = 1e-9
"""Two landmarks of a file closer than this are one position written twice, mm; `rig.job` asks more of handles."""

_ENDINGS = ".csv, .fcsv, .mrk.json and .trc"
_POINT_LIST = "Fiducial"
_POINT_KINDS = (_POINT_LIST, "Line", "Angle", "Curve", "ClosedCurve")
"""Markups whose control points are places that someone pointed at; those of planes and boxes are made by Slicer."""
_FCSV_COLUMNS = "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"
_FCSV_SYSTEMS = {"0": "RAS", "1": "LPS", "RAS": "RAS", "LPS": "LPS"}


@dataclass(frozen=True, eq=False, slots=True)
class LandmarkTable:
    """Named landmarks of one file, or of two files matched by name.

    Parameters
    ----------
    names : tuple of str, length m
    positions : (m, 3) float64, mm
    bones : tuple of str, length m
        The bone each belongs to, "" for none.
    targets : (m, 3) float64, mm, or None where there are none
    coordinate_system : str
        "LPS" or "RAS" where the file says so, else "".
    path : Path
    findings : tuple of Finding

    Raises
    ------
    LandmarkError
        No landmark; two of one name, at one place or sent to one place; a position that is not finite.
    """

    names: tuple[str, ...]
    positions: Points
    bones: tuple[str, ...]
    targets: Points | None
    coordinate_system: str
    path: Path
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        if not self.names:
            raise LandmarkError(f"{self.path}: no landmark; add one row per landmark, or correct the path")
        seen: set[str] = set()
        for name in self.names:
            if name in seen:
                raise LandmarkError(f"{self.path}: two landmarks are named {name!r}; rename one")
            seen.add(name)
        object.__setattr__(self, "positions", _distinct(self.positions, self, "stand at"))
        if self.targets is not None:
            object.__setattr__(self, "targets", _distinct(self.targets, self, "are sent to"))

    def __len__(self) -> int:
        return len(self.names)


def _distinct(points: Points, table: LandmarkTable, verb: str) -> Points:
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise LandmarkError(
            f"{table.path}: landmark {table.names[bad[0]]!r} is not finite: {points[bad[0]]}; correct it, or leave it "
            "out"
        )
    pairs = sorted(cKDTree(points).query_pairs(COINCIDENT_MM))
    if pairs:
        a, b = pairs[0]
        x, y, z = points[a]
        raise LandmarkError(
            f"{table.path}: landmarks {table.names[a]!r} and {table.names[b]!r} {verb} one place, "
            f"({x:g}, {y:g}, {z:g}) mm; no one-to-one map can do that: correct or leave out one of them"
        )
    return frozen(points)


def read_landmarks(
    path: str | Path, *, units: Unit = Unit.MILLIMETRE, source_prefix: str = "", target_prefix: str = "target_"
) -> LandmarkTable:
    """Read a CSV (``.csv``), Slicer markups (``.fcsv``, ``.mrk.json``) or the markers of a ``.trc``.

    Parameters
    ----------
    path : path
        A CSV has the columns ``name``, ``x_mm``, ``y_mm``, ``z_mm`` (or ``x_cm`` .., ``x_m`` .., ``x`` ..), and may
        have ``bone`` and the targets ``target_x_mm`` ..; other columns are passed over. Columns are parted by comma,
        semicolon or tab. Slicer's positions stay in the frame that the file states. The markers of a .trc stand at
        their means over all frames; a finding ("averaged-frames") says how far they move.
    units : Unit
        Length unit where the file states none.
    source_prefix, target_prefix : str
        What the headings of positions and of targets start with; ``child_`` and ``adult_`` read ``child_x_mm`` ..

    Returns
    -------
    LandmarkTable
        In mm.

    Raises
    ------
    InputError
        No such file, or an ending that is not read.
    LandmarkError
        A missing column, an unknown unit, a value that is not a number, broken JSON, or what `LandmarkTable` refuses.
    """
    path = Path(path)
    name = path.name.lower()
    if not name.endswith((".csv", ".fcsv", ".mrk.json", ".trc")):
        raise InputError(f"{path}: landmarks are read from {_ENDINGS} files; correct the path or rename the file")
    text = read_text(path, error=LandmarkError)
    if not text.strip():
        raise LandmarkError(f"{path}: an empty file; export the landmarks again")
    if name.endswith(".mrk.json"):
        return _from_markups(text, path, units=units)
    if name.endswith(".fcsv"):
        return _from_fcsv(text, path, units=units)
    if name.endswith(".trc"):
        return _from_trc(text, path, units=units)
    rows = Rows.of_csv(text, path)
    positions, targets = PositionColumns.find(rows, source_prefix, units), None
    if positions is None:
        wanted = ", ".join(f"{source_prefix}{axis}_mm" for axis in "xyz")
        raise LandmarkError(f"{path}: no columns {wanted}; found are: {rows.said}")
    target_columns = PositionColumns.find(rows, target_prefix, units)
    if target_columns is not None:
        targets = target_columns.read(rows)
    return LandmarkTable(
        names=rows.texts("name"),
        positions=positions.read(rows),
        bones=rows.texts("bone") if "bone" in rows.headings else ("",) * len(rows.rows),
        targets=targets,
        coordinate_system="",
        path=path,
    )


def paired(source: LandmarkTable, target: LandmarkTable) -> LandmarkTable:
    """Send each landmark of one table to the landmark of the same name in another.

    Returns
    -------
    LandmarkTable
        Those that both have, in the source's order, with the other's positions as ``targets``; names that only one has
        are findings ("unmatched-landmarks"), and so is a frame that only one states ("one-frame").

    Raises
    ------
    LandmarkError
        No name in common, frames that differ, bones that differ, or a table that has targets already.
    """
    for table in (source, target):
        if table.targets is not None:
            raise LandmarkError(
                f"{table.path}: has target columns and is paired with a second file; use one of the two"
            )
    frames = source.coordinate_system, target.coordinate_system
    findings = [*source.findings, *target.findings]
    if frames[0] != frames[1]:
        if all(frames):
            raise LandmarkError(
                f"{source.path} is in {frames[0]}, but {target.path} in {frames[1]}: x and y have opposite signs; "
                "export both in one coordinate system"
            )
        stated, silent = (source, target) if frames[0] else (target, source)
        said = f"{stated.path.name} is in {stated.coordinate_system}, {silent.path.name} states no coordinate system"
        findings.append(Finding(silent.path.name, "one-frame", f"{said}; they are taken to be in one frame"))
    index = {name: i for i, name in enumerate(target.names)}
    both = [name for name in source.names if name in index]
    if not both:
        raise LandmarkError(
            f"{source.path} and {target.path} have no landmark name in common ({', '.join(source.names[:3])}, ... and "
            f"{', '.join(target.names[:3])}, ...); name pairs alike"
        )
    for table, other in ((source, target), (target, source)):
        alone = [name for name in table.names if name not in other.names]
        if alone:
            said = some_of(alone, most=6)
            message = f"{table.path.name}: {len(alone)} landmarks are not used, {other.path.name} names none so: {said}"
            findings.append(Finding(table.path.name, "unmatched-landmarks", message))
    rows = [source.names.index(name) for name in both]
    partners = [index[name] for name in both]
    return replace(
        source,
        names=tuple(both),
        positions=source.positions[rows],
        bones=tuple(_bone(source, i, target, j) for i, j in zip(rows, partners, strict=True)),
        targets=target.positions[partners],
        coordinate_system=frames[0] or frames[1],
        findings=tuple(findings),
    )


def positions_of(table: LandmarkTable, names: Sequence[str]) -> Points:
    """(m, 3) positions of the landmarks of these names, in their order, mm.

    Raises
    ------
    LandmarkError
        A name that the table does not have, or a table with target columns.
    """
    if table.targets is not None:
        raise LandmarkError(f"{table.path}: has target columns, but a keyframe is where the landmarks are; remove them")
    index = {name: i for i, name in enumerate(table.names)}
    missing = [name for name in names if name not in index]
    if missing:
        said = some_of(missing, most=6)
        raise LandmarkError(
            f"{table.path}: a keyframe says where every landmark is; {len(missing)} are missing: {said}"
        )
    positions: Points = table.positions[[index[name] for name in names]]
    return positions


def _bone(source: LandmarkTable, i: int, target: LandmarkTable, j: int) -> str:
    a, b = source.bones[i], target.bones[j]
    if a and b and a != b:
        raise LandmarkError(
            f"landmark {source.names[i]!r} is on bone {a!r} in {source.path}, on {b!r} in {target.path}; correct one"
        )
    return a or b


def _from_fcsv(text: str, path: Path, *, units: Unit) -> LandmarkTable:
    system = ""
    for line in text.splitlines():
        key, _, value = line.lstrip("# ").partition("=")
        if line.startswith("#") and key.strip().lower() == "coordinatesystem":
            said = value.strip().strip(",").upper()
            if said not in _FCSV_SYSTEMS:
                raise LandmarkError(f"{path}: CoordinateSystem is {value.strip()!r}; known are LPS, RAS, 0, 1")
            system = _FCSV_SYSTEMS[said]
    headings = fcsv_headings(text)
    body = "\n".join("" if line.startswith("#") else line for line in text.splitlines())
    rows = Rows(path, headings, tuple(csv_lines(body, path, delimiter=",")))
    rows.check_widths()
    return LandmarkTable(
        names=rows.texts("label"),
        positions=in_mm(rows.numbers(("x", "y", "z")), units, source=str(path), error=LandmarkError),
        bones=("",) * len(rows.rows),
        targets=None,
        coordinate_system=system,
        path=path,
    )


def fcsv_headings(text: str) -> tuple[str, ...]:
    """The columns of an .fcsv file, as its last line "# columns = ..." states them, or else Slicer's own."""
    columns = _FCSV_COLUMNS
    for line in text.splitlines():
        key, _, value = line.lstrip("# ").partition("=")
        if line.startswith("#") and key.strip().lower() == "columns":
            columns = value.strip()
    return tuple(heading.strip().lower() for heading in columns.split(","))


def _from_markups(text: str, path: Path, *, units: Unit) -> LandmarkTable:
    try:
        read = json.loads(text)
    except json.JSONDecodeError as error:
        raise LandmarkError(
            f"{path}: broken JSON at line {error.lineno}, column {error.colno} ({error.msg}); export it again"
        ) from error
    except RecursionError:
        raise LandmarkError(f"{path}: is nested too deeply to be read; export it again") from None
    except ValueError as error:  # a number with more digits than Python converts
        raise LandmarkError(f"{path}: cannot be read: {error}; export it again") from None
    markups = read.get("markups") if isinstance(read, dict) else None
    if not isinstance(markups, list) or not all(isinstance(markup, dict) for markup in markups):
        raise LandmarkError(f"{path}: no Slicer markups file: it has no list 'markups'; save a point list from Slicer")
    markup, findings = _one_point_list(markups, path)
    points = markup.get("controlPoints")
    if not isinstance(points, list):
        raise LandmarkError(f"{path}: the markup has no list 'controlPoints'; save a point list from Slicer")
    system = str(markup.get("coordinateSystem", "")).upper()
    if system not in ("", "LPS", "RAS"):
        raise LandmarkError(f"{path}: coordinateSystem is {system!r}; known are LPS and RAS")
    if not system:
        system = "LPS"
        said = f"{path.name}: states no coordinateSystem; taken to be in LPS, as Slicer takes it"
        findings.append(Finding(path.name, "assumed-frame", said))
    found = [_control_point(point, number, path) for number, point in enumerate(points, start=1)]
    return LandmarkTable(
        names=tuple(name for name, _ in found),
        positions=in_mm(
            np.reshape([position for _, position in found], (-1, 3)),
            _markup_unit(markup, path, units),
            source=str(path),
            error=LandmarkError,
        ),
        bones=("",) * len(found),
        targets=None,
        coordinate_system=system,
        path=path,
        findings=tuple(findings),
    )


def point_list_number(markups: Sequence[dict[str, Any]]) -> int:
    """Which markup of a file is its point list: the only one of type Fiducial, or the only one; -1 where none is."""
    lists = [number for number, markup in enumerate(markups) if markup.get("type", _POINT_LIST) == _POINT_LIST]
    if len(markups) == 1:
        return 0
    return lists[0] if len(lists) == 1 else -1


def _one_point_list(markups: list[dict[str, Any]], path: Path) -> tuple[dict[str, Any], list[Finding]]:
    """The point list of a file, and findings that tell which planes, lines and others were passed over."""
    chosen = point_list_number(markups)
    if chosen < 0:
        kinds = ", ".join(str(markup.get("type", _POINT_LIST)) for markup in markups) or "none"
        raise LandmarkError(
            f"{path}: {len(markups)} markups in one file; save one point list by itself, or with lines and planes "
            f"alone; found are: {kinds}"
        )
    kind = str(markups[chosen].get("type", _POINT_LIST))
    if kind not in _POINT_KINDS:
        raise LandmarkError(
            f"{path}: its markup is a {kind}, whose control points are not landmarks; save a point list from Slicer"
        )
    others = [str(markup.get("type", "?")) for number, markup in enumerate(markups) if number != chosen]
    said = f"{path.name}: its point list was read; {len(others)} other markups were passed over: {', '.join(others)}"
    return markups[chosen], [Finding(path.name, "markups-passed-over", said)] if others else []


def _from_trc(text: str, path: Path, *, units: Unit) -> LandmarkTable:
    read = read_trajectories(text, str(path), units=units)
    marker, motion = read.largest_motion()
    frames = len(read.positions)
    message = (
        f"{path.name}: {frames} frames were averaged; the marker that moves most, {marker!r}, is {motion:.3g} mm from "
        "its mean at most"
    )
    findings = [Finding(path.name, "averaged-frames", message)] if frames > 1 else []
    for name, lost in zip(read.names, read.lost, strict=True):
        if lost:
            said = (
                f"{path.name}: marker {name!r} is written 0 0 0 in {lost} of {frames} frames: lost, and left out there"
            )
            findings.append(Finding(path.name, "lost-marker", said))
    return LandmarkTable(
        names=read.names,
        positions=read.mean(),
        bones=("",) * len(read.names),
        targets=None,
        coordinate_system="",
        path=path,
        findings=tuple(findings),
    )


def _markup_unit(markup: dict[str, Any], path: Path, units: Unit) -> Unit:
    said = markup.get("coordinateUnits", markup.get("units", units.value))
    each = said if isinstance(said, list) else [said]
    if len({str(unit) for unit in each}) != 1 or str(each[0]) not in set(Unit):
        raise LandmarkError(f"{path}: coordinateUnits is {said!r}; known are {', '.join(Unit)}")
    return Unit(str(each[0]))


def _control_point(point: object, number: int, path: Path) -> tuple[str, list[float]]:
    name = point.get("label") if isinstance(point, dict) else None
    if not isinstance(point, dict) or not isinstance(name, str) or not name.strip():
        raise LandmarkError(f"{path}: control point {number} has no label; name it")
    if point.get("positionStatus", "defined") != "defined":
        raise LandmarkError(
            f"{path}: landmark {name!r} is {point['positionStatus']}; place it, or remove it from the list"
        )
    position = point.get("position")
    numbers = position if isinstance(position, list) else []
    if len(numbers) != 3 or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in numbers):
        raise LandmarkError(f"{path}: landmark {name!r} has the position {position!r}, not 3 numbers; place it")
    try:
        return name.strip(), [float(v) for v in numbers]
    except OverflowError:
        raise LandmarkError(f"{path}: landmark {name!r} is farther away than a number can say; place it") from None
