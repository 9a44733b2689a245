"""A cage of a skin, from a surface file to a PLY file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.anatomy.cleaning import take_in
from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import TissueKind
from musclefit.errors import InputError
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.surfaces.cages import cage_of
from musclefit.geometry.surfaces.topology import edges_of
from musclefit.io.anatomy import read_surface
from musclefit.io.atomic import write_bytes_atomically
from musclefit.io.run_folder import ply_bytes
from musclefit.vocabulary import Unit
from musclefit.workflows.given import word
from musclefit.workflows.results import Shown

VERTICES = 500


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class Cage(Shown):
    """A cage, the skin that it follows, and what was found in the skin's file."""

    mesh: TriMesh
    skin: TriMesh
    findings: tuple[Finding, ...]

    def measures(self) -> dict[str, float]:
        """Numbers of vertices and triangles; edges, distances from the skin and volumes with their units."""
        a, b = edges_of(self.mesh.faces).ends.T
        lengths = np.linalg.norm(self.mesh.vertices[a] - self.mesh.vertices[b], axis=1)
        short, middle, long = np.percentile(lengths, [5, 50, 95])
        off = nearest_places(self.skin.vertices, self.mesh).distances
        return {
            "vertices": len(self.mesh.vertices),
            "triangles": len(self.mesh.faces),
            "edge_median_mm": float(middle),
            "edge_5_percent_mm": float(short),
            "edge_95_percent_mm": float(long),
            "skin_off_mean_mm": float(off.mean()),
            "skin_off_max_mm": float(off.max()),
            "volume_mm3": enclosed_volume(self.mesh),
            "skin_volume_mm3": enclosed_volume(self.skin),
        }

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """The measures."""
        return {"measures": [self.measures()]}

    def said(self) -> str:
        """Size, edges and distance from the skin, in a line."""
        found = self.measures()
        return (
            f"{found['vertices']} vertices, {found['triangles']} triangles, closed, none cross; edges "
            f"{found['edge_median_mm']:.3g} mm (5 to 95 %: {found['edge_5_percent_mm']:.3g} to "
            f"{found['edge_95_percent_mm']:.3g}); the skin is {found['skin_off_mean_mm']:.2g} mm from it on "
            f"average, {found['skin_off_max_mm']:.3g} mm at most; volume {found['volume_mm3']:.6g} mm³, the skin's "
            f"{found['skin_volume_mm3']:.6g}"
        )


def cage(
    skin: str | Path,
    out: str | Path | None = None,
    *,
    vertices: int = VERTICES,
    units: Unit | str = Unit.MILLIMETRE,
) -> Cage:
    """Make a cage that follows a skin: even triangles, none of which cross. Move its vertices, and it drives a body.

    Parameters
    ----------
    skin : path
        The closed surface to follow: PLY, STL, OBJ, VTP.
    out : path, optional
        The cage to write: PLY, in mm.
    vertices : int
        How many vertices the cage has.
    units : {"mm", "cm", "m"}
        Of the skin's file.

    Returns
    -------
    Cage
        The mesh, in mm, with the skin that it follows and what was found in the skin's file.

    Raises
    ------
    InputError, MeshError
        Another ending than .ply; a skin that cannot be read or is not closed, or too few vertices.
    """
    if out is not None and Path(out).suffix.lower() != ".ply":
        raise InputError(f"{out}: cages are written as PLY; name a file that ends in .ply")
    path = Path(skin)
    raw = read_surface(path, units=word(Unit, units, what="units"))
    tissue, findings = take_in(path.stem, TissueKind.SKIN, vertices=raw.vertices, faces=raw.faces, source=str(path))
    made = cage_of(tissue.surface, vertices=vertices)
    if out is not None:
        write_bytes_atomically(Path(out), ply_bytes(made))
    return Cage(made, tissue.surface, tuple(findings))
