"""Proves that no two tetrahedra of a mesh share volume, or says why not; takes positions and tets, knows no map.

*Theorem.* Let every face belong to one tet (the boundary) or to two that see it from opposite sides, let every tet be
right-handed, let the boundary not cross itself, and let the boundary wind 0 times around the space just outside each
of its sheets. Then the interiors of the tets are pairwise disjoint; so tissues that are made of different tets, and
meet only at the faces they share, have no volume in common.

*Proof.* Seen as a piecewise linear map of the abstract complex, the number of tets that cover a generic point is the
map's degree there, all signs being +1, and so the winding number of the boundary around it. Winding changes only across
the boundary, by one at each of its faces, the inside having one more. The boundary does not cross itself, so each
region that it cuts out of space lies at a sheet, along which the numbers at both sides are constant: 0 outside, hence
1 inside. No generic point is covered twice.

Orientation, crossings and windings are decided by exact predicates. What vertices did on their way does not matter.
"""

from __future__ import annotations

import numpy as np

from musclefit.certify.model import MeshCertificate
from musclefit.geometry.arrays import Int
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.geometry.queries.sheet_winding import UNKNOWN, sheets_of
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.geometry.tets.orientation import orientations
from musclefit.geometry.tets.topology import TetFaces, tet_faces
from musclefit.vocabulary import Claim


def certify_mesh(mesh: TetMesh) -> MeshCertificate:
    """Judge a tet mesh where its vertices stand.

    Parameters
    ----------
    mesh : TetMesh
        With the positions to judge; positions before do not matter.

    Returns
    -------
    MeshCertificate
        CERTIFIED: the theorem above holds. REFUTED: a tet is inverted or flat, the boundary crosses or touches itself,
        or tets cover each other. UNDECIDED: the tets do not form a conforming mesh, or no ray told a winding; there
        is no tet to prove anything of; the note says which.
    """
    signs = orientations(mesh.vertices, mesh.tets)
    faces = tet_faces(mesh.tets)
    boundary, used = _boundary(mesh, faces)
    pairs = self_crossings(boundary)
    touching = len(used) - len(np.unique(boundary.vertices + 0.0, axis=0))
    failing = np.flatnonzero(signs <= 0)
    sheets = unknown = wrapped = 0
    if not failing.size and not len(pairs) and not len(faces.odd) and not touching and len(mesh.tets):
        found = sheets_of(boundary).outside
        sheets, unknown = len(found), int((found == UNKNOWN).sum())
        wrapped = int(((found != 0) & (found != UNKNOWN)).sum())
    claim, note = _claim(
        len(mesh.tets),
        {
            "inverted": int((signs < 0).sum()),
            "flat": int((signs == 0).sum()),
            "crossings": len(pairs),
            "wrapped": wrapped,
            "odd": len(faces.odd),
            "touching": touching,
            "unknown": unknown,
        },
    )
    behind = faces.boundary_tets
    return MeshCertificate(
        claim=claim,
        tets=len(mesh.tets),
        boundary_faces=len(boundary.faces),
        sheets=sheets,
        inverted=int((signs < 0).sum()),
        flat=int((signs == 0).sum()),
        crossings=len(pairs),
        failing=failing,
        crossing_tets=behind[pairs.pairs].reshape(-1, 2),
        crossing_places=pairs.places,
        note=note,
    )


def _boundary(mesh: TetMesh, faces: TetFaces) -> tuple[TriMesh, Int]:
    """The boundary as a surface of its own, and the mesh's numbers of its vertices."""
    used, local = np.unique(faces.boundary, return_inverse=True)
    return TriMesh(mesh.vertices[used], local.reshape(-1, 3)), used


def _claim(count: int, found: dict[str, int]) -> tuple[Claim, str]:
    refuting = {
        "inverted": "{} tets are inverted",
        "flat": "{} tets are exactly flat",
        "crossings": "{} pairs of boundary triangles cross or touch",
        "wrapped": "{} sheets of the boundary lie inside tets",
    }
    doubtful = {
        "odd": "{} tets are at faces of more than two tets, or of two on one side: the mesh is not conforming",
        "touching": "{} vertices of the boundary stand where another one stands",
        "unknown": "around {} sheets of the boundary no winding number could be told",
    }
    notes = [text.format(found[key]) for key, text in (refuting | doubtful).items() if found[key]]
    if any(found[key] for key in refuting):
        return Claim.REFUTED, "; ".join(notes)
    if notes or not count:
        return Claim.UNDECIDED, "; ".join(notes) or "the mesh has no tet"
    return Claim.CERTIFIED, ""
