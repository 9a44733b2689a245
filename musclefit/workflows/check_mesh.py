"""Quality of a run's tetrahedra before and after, by tissue."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.geometry.arrays import Points, Tets
from musclefit.geometry.elements import CellKind, scaled_jacobians
from musclefit.geometry.tets.quality import dihedral_angles
from musclefit.io.atomic import check_file_writable, write_atomically
from musclefit.io.formats.rows import csv_text
from musclefit.io.run_tets import Shape, read_run_tets
from musclefit.workflows.results import Shown

ALL = "all tissues"
LOW = 0.01
"""Besides the worst, what this share of the tetrahedra does not exceed is told."""


@dataclass(frozen=True, slots=True)
class TetQuality:
    """Shapes of one tissue's tetrahedra in one shape; angles in degrees.

    A scaled Jacobian is 1 for the regular tetrahedron and not above 0 for one that is turned inside out. Dihedral
    angles are 70.5° in the regular one; an angle that does not exist, at an edge without length, is left out.
    """

    tissue: str
    shape: str
    tets: int
    inside_out: int
    scaled_jacobian_min: float
    scaled_jacobian_low: float
    scaled_jacobian_mean: float
    dihedral_min_deg: float
    dihedral_low_deg: float
    dihedral_max_deg: float


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class MeshQuality(Shown):
    """Quality of all tissues' tetrahedra, at rest and deformed.

    Parameters
    ----------
    title : str
    rows : tuple of TetQuality
        All tissues together first, each at rest and deformed.
    """

    title: str
    rows: tuple[TetQuality, ...]

    def said(self) -> str:
        """The worst before and after, in a line."""
        rest, moved = self.rows[:2]
        return (
            f"{rest.tets} tetrahedra; smallest scaled Jacobian {rest.scaled_jacobian_min:.3g} at rest, "
            f"{moved.scaled_jacobian_min:.3g} deformed; inside out {rest.inside_out} and {moved.inside_out}"
        )

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """One table of all rows."""
        return {"quality": self.rows}

    def to_json(self) -> dict[str, Any]:
        """The title and all rows."""
        return {"title": self.title, "quality": [asdict(row) for row in self.rows]}


def check_mesh(run: str | Path, *, out: str | Path | None = None) -> MeshQuality:
    """Scaled Jacobians and dihedral angles of a run's tetrahedra before and after, for all and by tissue.

    Parameters
    ----------
    run : path
        The folder that a run with tetrahedra wrote.
    out : path, optional
        A CSV file to write the table to; replaced.

    Returns
    -------
    MeshQuality
        All tissues together first, then each of them, at rest and deformed.

    Raises
    ------
    InputError
        No run, a run without tetrahedra, or a file that cannot be written.
    """
    if out is not None:
        check_file_writable(Path(out))
    shapes = {shape: read_run_tets(Path(run), shape=shape) for shape in (Shape.REST, Shape.DEFORMED)}
    rest = shapes[Shape.REST]
    owns = {ALL: np.arange(len(rest.tets))} | {
        rest.names[k]: np.flatnonzero(rest.tissue_of_tet == k) for k in np.unique(rest.tissue_of_tet)
    }
    rows = tuple(
        _quality(name, shape, tets.vertices, tets.tets[own])
        for name, own in owns.items()
        for shape, tets in shapes.items()
    )
    found = MeshQuality(rest.title.removesuffix(f" ({Shape.REST.value})"), rows)
    if out is not None:
        heads = [field.name for field in fields(TetQuality)]
        write_atomically(Path(out), csv_text([heads, *(asdict(row).values() for row in rows)]))
    return found


def _quality(tissue: str, shape: Shape, vertices: Points, tets: Tets) -> TetQuality:
    jacobians = scaled_jacobians(vertices, tets, kind=CellKind.TET)
    angles = dihedral_angles(vertices, tets)
    smallest = np.nanmin(angles, axis=1) if np.isfinite(angles).any(axis=1).all() else angles[np.isfinite(angles)]
    return TetQuality(
        tissue=tissue,
        shape=shape.value,
        tets=len(tets),
        inside_out=int((jacobians <= 0.0).sum()),
        scaled_jacobian_min=float(jacobians.min()),
        scaled_jacobian_low=float(np.quantile(jacobians, LOW)),
        scaled_jacobian_mean=float(jacobians.mean()),
        dihedral_min_deg=float(smallest.min(initial=0.0 if not len(smallest) else np.inf)),
        dihedral_low_deg=float(np.quantile(smallest, LOW)) if len(smallest) else 0.0,
        dihedral_max_deg=float(np.nanmax(angles)) if np.isfinite(angles).any() else 180.0,
    )
