"""Attached points that a map takes along: a file of landmarks, markers or a mesh -> points, and the file written moved.

Everything of the file that is no position is kept: columns, labels, comments, data at points and cells. PLY and STL
alone are written anew, as plain triangle surfaces.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy
from musclefit.errors import InputError, LandmarkError, MeshError
from musclefit.geometry.arrays import Points, frozen
from musclefit.geometry.images.grids import Frame, in_frame, stated_frame
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.queries.winding import winding_numbers
from musclefit.io.anatomy import read_surface
from musclefit.io.formats.landmarks import fcsv_headings, point_list_number, read_landmarks
from musclefit.io.formats.rows import PositionColumns, Rows, csv_lines
from musclefit.io.formats.texts import in_mm, read_bytes, read_text
from musclefit.io.formats.trc import read_trajectories
from musclefit.io.formats.vtk_xml import VtkFile
from musclefit.io.run_folder import ply_bytes
from musclefit.rig.job import AttachedPoints
from musclefit.vocabulary import Unit

Rewrite = Callable[[Points, Path], None]
"""Writes the file with its points, (k, 3) mm, moved to a path."""

INSIDE = 0.5
"""Winding number of the skin from which a point is inside."""


def read_points(path: Path, *, units: Unit) -> AttachedPoints:
    """Read the points of one file, in the order in which they stand in it.

    Parameters
    ----------
    path : Path
        CSV with columns x_mm, y_mm, z_mm (or cm, m, or without unit); Slicer's .fcsv and .mrk.json; .trc with all its
        frames; surfaces as .ply, .stl, .obj, .vtp, which may be open; tetrahedra and other grids as .vtu.
    units : Unit
        Where the file states none.

    Raises
    ------
    InputError
        Another ending, or a file that is not what its ending says.
    """
    ending = next((e for e in _READERS if path.name.lower().endswith(e)), None)
    if ending is None:
        raise InputError(f"{path}: points are read from {', '.join(_READERS)} files; rename or convert the file")
    points, rewrite = _READERS[ending](path, units)
    if not len(points):
        raise InputError(f"{path}: has no point; correct the path, or leave it out")
    return AttachedPoints(path.name, frozen(points), rewrite)


def points_frame(path: Path, *, units: Unit) -> Frame | None:
    """The frame that Slicer's markups state; None for files that state none."""
    if not path.name.lower().endswith((".fcsv", ".mrk.json")):
        return None
    return stated_frame(read_landmarks(path, units=units).coordinate_system)


def in_anatomy_frame(file: AttachedPoints, *, own: Frame | None, anatomy: Frame | None) -> AttachedPoints:
    """The points in the anatomy's frame, where both state theirs; they are written in their own, as they were read."""
    if own is None or anatomy is None or own is anatomy:
        return file
    back = partial(in_frame, of=anatomy, to=own)
    return AttachedPoints(
        file.name,
        frozen(in_frame(file.points, of=own, to=anatomy)),
        lambda moved, out: file.rewrite(back(moved), out),
    )


def outside_findings(further: Sequence[AttachedPoints], anatomy: Anatomy) -> tuple[Finding, ...]:
    """A finding for each file with points outside the skin, and how far: the map is less known there."""
    if anatomy.skin is None:
        return ()
    found = []
    for file in further:
        skin = anatomy.skin.surface
        outside = np.flatnonzero(winding_numbers(skin, file.points) < INSIDE)
        if outside.size:
            off = nearest_places(file.points[outside], skin).distances
            message = (
                f"{file.name}: {len(outside)} of {len(file.points)} points are outside the skin, up to "
                f"{off.max():.3g} mm from it (point {outside[np.argmax(off)] + 1}); they are taken along, and a map "
                "that is certified for the body but not for them does not pass"
            )
            found.append(Finding(file.name, "points-outside-skin", message))
    return tuple(found)


def _csv(path: Path, units: Unit) -> tuple[Points, Rewrite]:
    text = _text(path)
    first = text.lstrip().splitlines()[0] if text.strip() else ""
    delimiter = max(",;\t", key=first.count)
    lines = csv_lines(text, path, delimiter=delimiter)
    if not lines:
        raise LandmarkError(f"{path}: an empty file; export the points again")
    rows = Rows(path, tuple(cell.strip().lower() for cell in lines[0][1]), tuple(lines[1:]))
    rows.check_widths()
    columns = PositionColumns.find(rows, "", units)
    if columns is None:
        raise LandmarkError(f"{path}: no columns x_mm, y_mm, z_mm; found are: {rows.said}")
    at = [rows.headings.index(heading) for heading in columns.headings]

    def rewrite(moved: Points, out: Path) -> None:
        table = [list(cells) for _, cells in lines]
        for row, position in zip(table[1:], moved / columns.unit.in_mm, strict=True):
            for column, value in zip(at, position, strict=True):
                row[column] = repr(float(value))
        _write_rows(out, table, delimiter)

    return columns.read(rows), rewrite


def _fcsv(path: Path, units: Unit) -> tuple[Points, Rewrite]:
    points = read_landmarks(path, units=units).positions
    text = _text(path)
    at = [fcsv_headings(text).index(axis) for axis in "xyz"]
    rows = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if len(rows) != len(points) or any(len(next(csv.reader([row]))) <= max(at) for row in rows):
        raise LandmarkError(f"{path}: a landmark stands on several lines; write each on one")

    def rewrite(moved: Points, out: Path) -> None:
        lines, left = text.splitlines(), iter(moved / units.in_mm)
        for k, line in enumerate(lines):
            if line.strip() and not line.startswith("#"):
                cells = next(csv.reader([line]))
                for column, value in zip(at, next(left), strict=True):
                    cells[column] = repr(float(value))
                buffer = io.StringIO()
                csv.writer(buffer, lineterminator="").writerow(cells)
                lines[k] = buffer.getvalue()
        out.write_text("\n".join(lines) + "\n", encoding="utf-8")

    return points, rewrite


def _markups(path: Path, units: Unit) -> tuple[Points, Rewrite]:
    points = read_landmarks(path, units=units).positions
    stated = json.loads(_text(path))
    control_points = stated["markups"][point_list_number(stated["markups"])]["controlPoints"]
    first = np.array([point["position"] for point in control_points], dtype=np.float64)
    scale = _ratio(points, first)

    def rewrite(moved: Points, out: Path) -> None:
        for point, position in zip(control_points, moved / scale, strict=True):
            point["position"] = [float(x) for x in position]
        out.write_text(json.dumps(stated, indent=4, ensure_ascii=False) + "\n", encoding="utf-8")

    return points, rewrite


def _trc(path: Path, units: Unit) -> tuple[Points, Rewrite]:
    read = read_trajectories(_text(path), str(path), units=units)
    return read.seen, lambda moved, out: _write_text(out, read.with_seen(moved))


def _surface(path: Path, units: Unit) -> tuple[Points, Rewrite]:
    """PLY and STL: written anew, PLY in double precision."""
    raw = read_surface(path, units=units)

    def rewrite(moved: Points, out: Path) -> None:
        scaled = moved / units.in_mm
        if out.suffix.lower() == ".ply":
            out.write_bytes(ply_bytes(TriMesh(scaled, raw.faces)).replace(b"lengths in mm", _unit_bytes(units)))
            return
        record = np.zeros(
            len(raw.faces), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
        )
        record["corners"] = scaled[raw.faces]
        out.write_bytes(b"lengths as in the file it was made from".ljust(80) + len(raw.faces).to_bytes(4, "little"))
        with out.open("ab") as file:
            file.write(record.tobytes())

    return raw.vertices, rewrite


def _obj(path: Path, units: Unit) -> tuple[Points, Rewrite]:
    """OBJ: the lines of vertices are replaced, all others kept."""
    raw, text = read_surface(path, units=units), _text(path)

    def rewrite(moved: Points, out: Path) -> None:
        lines, left = text.splitlines(), iter(moved / units.in_mm)
        for k, line in enumerate(lines):
            words = line.split()
            if words[:1] == ["v"]:
                lines[k] = " ".join(["v", *(repr(float(x)) for x in next(left)), *words[4:]])
        _write_text(out, "\n".join(lines) + "\n")

    return raw.vertices, rewrite


def _vtk(path: Path, units: Unit) -> tuple[Points, Rewrite]:
    """VTK files: all but the positions is kept as it stands."""
    kind = "PolyData" if path.suffix.lower() == ".vtp" else "UnstructuredGrid"
    file = VtkFile(read_bytes(path), str(path), kind=kind)
    file.check()
    points = in_mm(file.points(), units, source=str(path), error=MeshError)
    if not np.isfinite(points).all():
        raise MeshError(f"{path}: has points that are not finite; export it again")
    return points, lambda moved, out: _write_bytes(out, file.with_points(moved / units.in_mm))


_READERS: Mapping[str, Callable[[Path, Unit], tuple[Points, Rewrite]]] = MappingProxyType(
    {
        ".csv": _csv,
        ".fcsv": _fcsv,
        ".mrk.json": _markups,
        ".trc": _trc,
        ".ply": _surface,
        ".stl": _surface,
        ".obj": _obj,
        ".vtp": _vtk,
        ".vtu": _vtk,
    }
)


def _text(path: Path) -> str:
    return read_text(path, error=LandmarkError)


def _write_bytes(out: Path, data: bytes) -> None:
    out.write_bytes(data)


def _write_text(out: Path, text: str) -> None:
    out.write_text(text, encoding="utf-8")


def _write_rows(out: Path, table: Sequence[Sequence[str]], delimiter: str) -> None:
    buffer = io.StringIO()
    csv.writer(buffer, delimiter=delimiter, lineterminator="\n").writerows(table)
    _write_text(out, buffer.getvalue())


def _unit_bytes(units: Unit) -> bytes:
    return f"lengths in {units}".encode("ascii")


def _ratio(points: Points, stated: Points) -> float:
    """How many mm one of the file's units is, from positions read in mm and as they stand."""
    k = int(np.argmax(np.abs(stated)))
    return float(points.ravel()[k] / stated.ravel()[k]) if stated.ravel()[k] else 1.0
