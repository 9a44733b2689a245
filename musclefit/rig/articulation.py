"""Joints fitted to bones: two surfaces in, axis or centre and residuals out, where they face each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.distances import nearest_places
from musclefit.geometry.fitting import CylinderFit, SphereFit, fitted_cylinder, fitted_sphere
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.volumes import area_vectors
from musclefit.rig.joint_kinds import JointKind

WITHIN_MM = 5.0
"""How close a triangle must come to the other bone to count as part of the joint's surface."""

FACING = 0.5
"""Least cosine between a triangle's normal and the way to the other bone."""

TRIM = 2.5
"""Points left over by more than this many times the median are left out, and the fit made again."""

TRIM_ROUNDS = 5

FEWEST = 30


@dataclass(frozen=True, eq=False, slots=True)
class FittedJoint:
    """A joint's axis or centre from the surface of one of its bones.

    Parameters
    ----------
    of : str
        Whose surface: "fixed" or "moving".
    fit : CylinderFit or SphereFit
        Of a hinge, or of a ball.
    used, left_out : int
        Triangles that the fit rests on, and those of the joint's surface that it does not fit.
    """

    of: str
    fit: CylinderFit | SphereFit
    used: int
    left_out: int


def fitted_joint(
    fixed: TriMesh, moving: TriMesh, *, kind: JointKind, within_mm: float = WITHIN_MM
) -> tuple[FittedJoint, ...]:
    """Fit a hinge or a ball to each of two bones where it faces the other; the better fit first.

    Parameters
    ----------
    fixed, moving : TriMesh
        At rest, mm.
    kind : JointKind
        A hinge is the axis of a cylinder, a ball the centre of a sphere.
    within_mm : float

    Returns
    -------
    tuple of FittedJoint
        Sorted by the root mean square of the residuals over the radius. Bones are no cylinders: how far the two agree
        tells more than either residual.

    Raises
    ------
    InputError
        Another kind, or bones that do not face each other within the distance.
    """
    if kind not in (JointKind.HINGE, JointKind.BALL):
        raise InputError(f"found kind {str(kind)!r}; only a hinge and a ball can be fitted to two bones")
    found = []
    for of, own, other in (("fixed", fixed, moving), ("moving", moving, fixed)):
        points, normals, _ = facing_triangles(own, other, within_mm=within_mm)
        if len(points) < FEWEST:
            raise InputError(
                f"{len(points)} triangles of the {of} bone face the other within {within_mm:g} mm; a fit needs "
                f"{FEWEST}: give bones that meet in a joint, or a larger distance"
            )
        kept = np.ones(len(points), dtype=bool)
        for _ in range(TRIM_ROUNDS):
            fit = _fit(points[kept], normals[kept], kind)
            off = np.abs(_off(fit, points))
            fresh = off <= TRIM * max(float(np.median(off[kept])), 1e-9)
            if (fresh == kept).all() or fresh.sum() < FEWEST:
                break
            kept = fresh
        found.append(FittedJoint(of, fit, int(kept.sum()), int((~kept).sum())))
    return tuple(sorted(found, key=lambda joint: joint.fit.rms / joint.fit.radius))


def facing_triangles(own: TriMesh, other: TriMesh, *, within_mm: float) -> tuple[Points, Points, Float]:
    """Middles, outward normals and areas of the triangles of a surface that face another one close by."""
    vectors = area_vectors(own)
    areas = np.linalg.norm(vectors, axis=1)
    normals = vectors / np.where(areas > 0.0, areas, 1.0)[:, None]
    middles = own.corners().mean(axis=1)
    low, high = other.vertices.min(axis=0) - within_mm, other.vertices.max(axis=0) + within_mm
    near = np.flatnonzero(((middles > low) & (middles < high)).all(axis=1) & (areas > 0.0))
    if not near.size:
        return middles[:0], normals[:0], areas[:0]
    places = nearest_places(middles[near], other)
    way = (places.places - middles[near]) / np.maximum(places.distances, 1e-12)[:, None]
    facing = (places.distances < within_mm) & (np.einsum("ti,ti->t", way, normals[near]) > FACING)
    chosen = near[facing]
    return middles[chosen], normals[chosen], areas[chosen]


def _fit(points: Points, normals: Points, kind: JointKind) -> CylinderFit | SphereFit:
    return fitted_sphere(points) if kind is JointKind.BALL else fitted_cylinder(points, normals)


def _off(fit: CylinderFit | SphereFit, points: Points) -> Float:
    off = points - fit.centre
    if isinstance(fit, CylinderFit):
        off = off - np.outer(off @ fit.axis, fit.axis)
    distances: Float = np.linalg.norm(off, axis=1) - fit.radius
    return distances
