"""Did tetrahedra turn inside out? Tet anatomy and moved vertices -> check, by floating-point volumes."""

from __future__ import annotations

import numpy as np

from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.errors import MeshError
from musclefit.geometry.arrays import Points
from musclefit.geometry.volumes import signed_volumes
from musclefit.validate.model import MeshCheck, MeshClaim


def check_tets(rest: TetAnatomy, deformed_vertices: Points) -> MeshCheck:
    """Count the tets whose signed volume is not positive any more, and the extreme ratios of volumes.

    Parameters
    ----------
    rest : TetAnatomy
    deformed_vertices : (n, 3) float64, mm
        Of ``rest.mesh``, moved.

    Returns
    -------
    MeshCheck
        The claim is ``REFUTED`` where a tet is inverted, otherwise ``SAMPLED``: rounding can hide the sign of a nearly
        flat tet, so that nothing is certified here.

    Raises
    ------
    MeshError
        Wrong number of vertices, a position that is not finite, or a tet that is not positive at rest.
    """
    mesh = rest.mesh
    if deformed_vertices.shape != mesh.vertices.shape:
        raise MeshError(
            f"the tet mesh has vertices of shape {mesh.vertices.shape}, the moved ones have shape "
            f"{deformed_vertices.shape}; move every vertex of the tet mesh"
        )
    moved = mesh.with_vertices(deformed_vertices)
    before, after = signed_volumes(mesh.vertices, mesh.tets), signed_volumes(moved.vertices, mesh.tets)
    if not len(before):
        raise MeshError("the tet mesh has no tetrahedron, so nothing can be said of it")
    if before.min() <= 0.0:
        raise MeshError(
            f"tet {int(before.argmin())} has volume {before.min():.6g} mm³ at rest; a tet mesh must be right-handed"
        )
    ratios = after / before
    inverted = after <= 0.0
    names = rest.names
    counts = np.bincount(rest.tissue_of_tet[inverted], minlength=len(names))
    return MeshCheck(
        tets=len(before),
        inverted=int(inverted.sum()),
        min_volume_ratio=float(ratios.min()),
        max_volume_ratio=float(ratios.max()),
        claim=MeshClaim.REFUTED if inverted.any() else MeshClaim.SAMPLED,
        inverted_by_tissue=tuple(
            (names[i], int(counts[i])) for i in sorted(np.flatnonzero(counts), key=lambda i: (-counts[i], names[i]))
        ),
    )
