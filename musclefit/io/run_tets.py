"""The tetrahedra of a finished run, read back from its folder; knows no solver."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Points
from musclefit.io.formats.solvers import LabelledTets
from musclefit.io.formats.tables import parse_json
from musclefit.io.formats.texts import read_bytes
from musclefit.io.formats.vtk_xml import VtkFile

_TETRAHEDRON = 10
"""VTK's number of this type of cell."""

_SOLID = 3
"""Dimension of a tissue made of tetrahedra, as `musclefit.io.run_folder` writes it beside its number."""


class Shape(StrEnum):
    """Which positions: after the deformation, or before."""

    DEFORMED = "deformed"
    REST = "rest"


def read_run_tets(folder: Path, *, shape: Shape) -> LabelledTets:
    """The labelled tetrahedra that a run wrote.

    Raises
    ------
    InputError
        The folder holds no run, or one without tetrahedra, or the file is not as a run writes it.
    """
    from musclefit.io.run_folder import REPORT_JSON, TETS

    report, grid_file = folder / REPORT_JSON, folder / TETS
    if not report.is_file():
        raise InputError(f"{folder} holds no {REPORT_JSON} of a run; name the folder that a run wrote")
    if not grid_file.is_file():
        raise InputError(f"{folder} holds no {TETS}: the run made no tetrahedra; run it with tets.enabled = true")
    grid = VtkFile(read_bytes(grid_file), str(grid_file), kind="UnstructuredGrid")
    cells, tissues = grid.cells("Cells", count="NumberOfCells"), grid.cell_data("tissue")
    if tissues is None or not len(tissues):
        raise InputError(f"{grid_file} has no tissues at its cells; run the rig again")
    if (grid.cell_types() != _TETRAHEDRON).any() or (cells.sizes != 4).any():
        raise InputError(f"{grid_file} has cells that are not tetrahedra; run the rig again")
    tissue = tissues.astype(np.int64)
    names = {int(v[0]): _unescaped(key) for key, v in grid.field_numbers().items() if len(v) == 2 and v[1] == _SOLID}
    missing = sorted(set(np.unique(tissue).tolist()) - set(names))
    if missing:
        raise InputError(f"{grid_file} names no tissue of number {missing[0]}; run the rig again")
    points: Points | None = grid.points()
    if shape is Shape.REST:
        points = grid.point_data("rest_position_mm", components=3)
    if points is None:
        raise InputError(f"{grid_file} holds no positions at rest; run the rig again, or export the deformed shape")
    return LabelledTets(
        title=f"{_title(report)} ({shape.value})",
        vertices=np.asarray(points, dtype=np.float64),
        tets=cells.corners.reshape(-1, 4),
        tissue_of_tet=tissue,
        names=tuple(names.get(number, "") for number in range(int(tissue.max()) + 1)),
    )


def _title(report: Path) -> str:
    """The title in a report; InputError where it is not as a run writes it."""
    table = parse_json(read_bytes(report), source=str(report))
    return str(table.get("title", ""))


def _unescaped(text: str) -> str:
    try:
        return text.encode("ascii").decode("unicode_escape")
    except UnicodeError:
        return text
