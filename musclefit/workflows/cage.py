"""A cage of a skin, from a surface file to a PLY file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

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

    def said(self) -> str:
        """Size, edges and distance from the skin, in a line."""
        a, b = edges_of(self.mesh.faces).ends.T
        lengths = np.linalg.norm(self.mesh.vertices[a] - self.mesh.vertices[b], axis=1)
        short, middle, long = np.percentile(lengths, [5, 50, 95])
        off = nearest_places(self.skin.vertices, self.mesh).distances
        return (
            f"{len(self.mesh.vertices)} vertices, {len(self.mesh.faces)} triangles, closed, none cross; edges "
            f"{middle:.3g} mm (5 to 95 %: {short:.3g} to {long:.3g}); the skin is {off.mean():.2g} mm from it on "
            f"average, {off.max():.3g} mm at most; volume {enclosed_volume(self.mesh):.6g} mm³, the skin's "
            f"{enclosed_volume(self.skin):.6g}"
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
