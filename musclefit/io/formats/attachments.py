"""Attachment files: takes a CSV of what is known of muscles' ends, gives `StatedEnd` records."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.meshes import TriMesh
from musclefit.io.anatomy import read_surface
from musclefit.io.formats.rows import csv_lines
from musclefit.io.formats.texts import decoded
from musclefit.io.named_files import is_there
from musclefit.muscles.attachments import End, StatedEnd

_NONE: Mapping[str, TriMesh] = MappingProxyType({})

COLUMNS = ("muscle", "end", "bone", "within_mm", "vertices", "sheet")


def read_attachments(path: str | Path, *, tissues: Mapping[str, TriMesh] = _NONE) -> tuple[StatedEnd, ...]:
    """Read what is known of muscles' ends better than by distance.

    Parameters
    ----------
    path : path of a CSV file
        Columns ``muscle``, ``end`` ("origin" or "insertion") and ``bone`` (several joined by " + "; empty for a free
        end); optionally ``within_mm``, how close to the bone the area is, ``vertices``, numbers of the muscle's
        vertices from 0, parted by blanks, that make up the area instead, and ``sheet``, the surface of a tendon sheet
        on which fibres begin: a tissue's name, or a surface file in mm, from the table's folder. With a sheet, an empty
        ``bone`` leaves what distance finds.
    tissues : mapping of name to surface
        Those that a sheet may be.

    Raises
    ------
    InputError
        The file cannot be read, lacks a column or has an unknown one, or a value is none of those expected; the message
        names file and line.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: the attachments cannot be read: {error.strerror or error}") from None
    text = decoded(data, str(path))
    lines = csv_lines(text, path, delimiter=",") if text.strip() else []
    if not lines:
        raise InputError(f"{path}: is empty; expected the columns {', '.join(COLUMNS[:3])}")
    headings = tuple(cell.strip().lower() for cell in lines[0][1])
    unknown = [heading for heading in headings if heading not in COLUMNS]
    missing = [heading for heading in COLUMNS[:3] if heading not in headings]
    if unknown or missing or len(set(headings)) < len(headings):
        raise InputError(
            f"{path}: found the columns {', '.join(headings)}; expected {', '.join(COLUMNS[:3])}, and optionally "
            f"{' and '.join(COLUMNS[3:])}, each once"
        )
    return tuple(_stated(path, line, headings, cells, tissues) for line, cells in lines[1:])


def _stated(
    path: Path, line: int, headings: tuple[str, ...], cells: tuple[str, ...], tissues: Mapping[str, TriMesh]
) -> StatedEnd:
    where = f"{path}: line {line}"
    if len(cells) != len(headings):
        raise InputError(f"{where} has {len(cells)} values for {len(headings)} columns; give one for each")
    values = {key: cell.strip() for key, cell in zip(headings, cells, strict=True)}
    if values["end"] not in set(End):
        raise InputError(f"{where}: the end is {values['end']!r}; expected origin or insertion")
    try:
        within = float(values["within_mm"]) if values.get("within_mm") else None
        vertices = tuple(int(number) for number in values.get("vertices", "").split())
    except ValueError as error:
        raise InputError(f"{where}: {error}; within_mm is a length in mm, vertices are whole numbers") from None
    if within is not None and not 0.0 < within < float("inf"):
        raise InputError(f"{where}: within_mm is {within}; expected a finite length above 0")
    bones = tuple(bone.strip() for bone in values["bone"].split("+") if bone.strip())
    sheet = _sheet(path, where, values["sheet"], tissues) if values.get("sheet") else None
    return StatedEnd(values["muscle"], End(values["end"]), bones, within, vertices, sheet)


def _sheet(path: Path, where: str, name: str, tissues: Mapping[str, TriMesh]) -> TriMesh:
    """A tissue, or a surface file."""
    if name in tissues:
        return tissues[name]
    file = path.parent / name
    if not is_there(file):
        raise InputError(f"{where}: the sheet {name!r} is neither a tissue nor a file in {path.parent}")
    raw = read_surface(file)
    if not len(raw.faces) or not np.isfinite(raw.vertices).all():
        raise InputError(f"{where}: {file} has no triangles, or vertices that are not finite; export it again")
    return raw.mesh()
