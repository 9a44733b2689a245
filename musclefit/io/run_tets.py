"""The tetrahedra of a finished run, read back from its folder; knows no solver."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path

import numpy as np

from musclefit.errors import InputError
from musclefit.io.formats.solvers import LabelledTets


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
    import pyvista as pv

    from musclefit.io.run_folder import REPORT_JSON, TETS

    report, grid_file = folder / REPORT_JSON, folder / TETS
    if not report.is_file():
        raise InputError(f"{folder} holds no {REPORT_JSON} of a run; name the folder that a run wrote")
    if not grid_file.is_file():
        raise InputError(f"{folder} holds no {TETS}: the run made no tetrahedra; run it with tets.enabled = true")
    title = str(json.loads(report.read_text(encoding="utf-8")).get("title", ""))
    grid = pv.read(grid_file)
    if not isinstance(grid, pv.UnstructuredGrid) or "tissue" not in grid.cell_data:
        raise InputError(f"{grid_file} has no tissues at its cells; run the rig again")
    tissue = np.asarray(grid.cell_data["tissue"], dtype=np.int64)
    names = {int(values[0]): _unescaped(key) for key, values in grid.field_data.items() if len(values) == 2}
    missing = sorted(set(np.unique(tissue).tolist()) - set(names))
    if missing:
        raise InputError(f"{grid_file} names no tissue of number {missing[0]}; run the rig again")
    key = "rest_position_mm"
    if shape is Shape.REST and key not in grid.point_data:
        raise InputError(f"{grid_file} holds no positions at rest; run the rig again, or export the deformed shape")
    points = grid.point_data[key] if shape is Shape.REST else grid.points
    return LabelledTets(
        title=f"{title} ({shape.value})",
        vertices=np.asarray(points, dtype=np.float64),
        tets=np.asarray(grid.cells_dict[pv.CellType.TETRA], dtype=np.int64),
        tissue_of_tet=tissue,
        names=tuple(names.get(number, "") for number in range(max(names) + 1)),
    )


def _unescaped(text: str) -> str:
    return text.encode("ascii").decode("unicode_escape")
