"""Did tetrahedra turn inside out, do any overlap? Tet anatomy and moved vertices -> check, by exact predicates."""

from __future__ import annotations

from collections import Counter

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.certify.meshes import certify_mesh
from musclefit.certify.model import MeshCertificate
from musclefit.certify.motions import largest_safe_fraction
from musclefit.errors import MeshError
from musclefit.geometry.arrays import Float, Int, Points
from musclefit.geometry.measures import signed_volumes
from musclefit.geometry.tets.quality import dihedral_angles
from musclefit.validate.model import MeshCheck, WorstTet
from musclefit.vocabulary import Claim

WORST = 8
"""Tets, crossing pairs of tissues and slivers that are named; all are counted."""


def check_tets(rest: TetAnatomy, deformed_vertices: Points) -> MeshCheck:
    """Prove that the moved tets share no volume, or count and name what keeps it from being so.

    Parameters
    ----------
    rest : TetAnatomy
    deformed_vertices : (n, 3) float64, mm
        Of ``rest.mesh``, moved.

    Returns
    -------
    MeshCheck
        Its claim is that of `certify.meshes.certify_mesh`. Inverted are tets of negative volume or none, by an exact
        predicate; ratios of volumes are floating-point numbers.

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
    proof = certify_mesh(moved)
    ratios = after / before
    straight = largest_safe_fraction(mesh.vertices, moved.vertices, mesh.tets)
    return MeshCheck(
        tets=len(before),
        inverted=len(proof.failing),
        min_volume_ratio=float(ratios.min()),
        max_volume_ratio=float(ratios.max()),
        claim=proof.claim,
        inverted_by_tissue=_by_tissue(rest, proof.failing),
        boundary_faces=proof.boundary_faces,
        crossings=proof.crossings,
        crossing_tissues=_crossing_tissues(rest, proof),
        worst=_worst(rest, moved.vertices, ratios, proof.failing),
        straight_fraction=straight.fraction,
        note=proof.note,
    )


def rest_findings(tets: TetAnatomy, *, sliver_deg: float) -> tuple[Finding, ...]:
    """What to know of a tet mesh before it is deformed: slivers, and why it is no proof of anything at rest.

    Parameters
    ----------
    tets : TetAnatomy
    sliver_deg : float
        A tet is a sliver when an angle between two of its faces is below this, or above 180 less this.
    """
    findings = []
    proof = certify_mesh(tets.mesh)
    if proof.claim is not Claim.CERTIFIED:
        findings.append(
            Finding(
                "tet mesh",
                "tets-at-rest",
                f"it is {proof.claim.value} already at rest ({proof.note}), so that its tissues are not proved apart "
                "there; choose another tets.envelope_fraction or tets.edge_length_fraction",
            )
        )
    angles = dihedral_angles(tets.mesh.vertices, tets.mesh.tets)
    sharpest = np.minimum(angles.min(axis=1), 180.0 - angles.max(axis=1))
    slivers = np.flatnonzero(~(sharpest >= sliver_deg))
    if slivers.size:
        named = slivers[np.argsort(sharpest[slivers], kind="stable")][:WORST]
        middles = tets.mesh.vertices[tets.mesh.tets[named]].mean(axis=1)
        told = (
            f"{sharpest[tet]:.2g} deg in {_tissue(tets, tet)} at ({x:.5g}, {y:.5g}, {z:.5g}) mm"
            for tet, (x, y, z) in zip(named, middles, strict=True)
        )
        findings.append(
            Finding(
                "tet mesh",
                "slivers",
                f"{slivers.size} of {len(sharpest)} tets have faces less than {sliver_deg:g} deg from flat, which a "
                f"small bend inverts; the sharpest: {'; '.join(told)}",
            )
        )
    return tuple(findings)


def _worst(rest: TetAnatomy, moved: Points, ratios: Float, failing: Int) -> tuple[WorstTet, ...]:
    """The tets with the smallest ratios, those that fail first."""
    fails = np.zeros(len(ratios), dtype=bool)
    fails[failing] = True
    named = np.lexsort((ratios, ~fails))[:WORST]
    places = rest.mesh.vertices[rest.mesh.tets[named]].mean(axis=1)
    moved_to = moved[rest.mesh.tets[named]].mean(axis=1)
    return tuple(
        WorstTet(
            tet=int(tet),
            tissue=_tissue(rest, tet),
            rest_place_mm=(float(p[0]), float(p[1]), float(p[2])),
            place_mm=(float(q[0]), float(q[1]), float(q[2])),
            volume_ratio=float(ratios[tet]),
        )
        for tet, p, q in zip(named, places, moved_to, strict=True)
    )


def _tissue(rest: TetAnatomy, tet: int) -> str:
    name: str = rest.names[rest.tissue_of_tet[tet]]
    return name


def _by_tissue(rest: TetAnatomy, failing: Int) -> tuple[tuple[str, int], ...]:
    counts = Counter(_tissue(rest, tet) for tet in failing)
    return tuple(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def _crossing_tissues(rest: TetAnatomy, proof: MeshCertificate) -> tuple[tuple[str, str, int], ...]:
    pairs = Counter(tuple(sorted((_tissue(rest, a), _tissue(rest, b)))) for a, b in proof.crossing_tets)
    ordered = sorted(pairs.items(), key=lambda item: (-item[1], item[0]))
    return tuple((a, b, count) for (a, b), count in ordered[:WORST])
