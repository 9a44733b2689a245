"""Joints fitted to bones: two surfaces in, axis or centre and residuals out, where they face each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.fitting import CylinderFit, SphereFit, fitted_cylinder, fitted_sphere, weighted_quantile
from musclefit.geometry.measures import area_vectors
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.surfaces.samples import surface_samples
from musclefit.rig.joint_kinds import JointKind

WITHIN_MM = 5.0
"""How close a place must come to the other bone to count as part of the joint's surface."""

SAMPLES_WITHIN = 5.0
"""The surfaces are cut until their triangles reach no farther than that distance over this from their corners."""

FACING = 0.5
"""Least cosine between the surface's normal and the way to the other bone."""

TRIM = 2.5
"""Places left over by more than this many times the median, by area, are left out, and the fit made again."""

TRIM_ROUNDS = 5

FEWEST = 30
"""Samples that a fit needs; as they are cut alike, they stand for an area."""


@dataclass(frozen=True, eq=False, slots=True)
class FittedJoint:
    """A joint's axis or centre from the surface of one of its bones.

    Parameters
    ----------
    of : str
        Whose surface: "fixed" or "moving".
    fit : CylinderFit or SphereFit
        Of a hinge, or of a ball.
    used_mm2, left_out_mm2 : float
        Area that the fit rests on, and that of the joint's surface that it does not fit.
    """

    of: str
    fit: CylinderFit | SphereFit
    used_mm2: float
    left_out_mm2: float


def fitted_joint(
    fixed: TriMesh, moving: TriMesh, *, kind: JointKind, within_mm: float = WITHIN_MM
) -> tuple[FittedJoint, ...]:
    """Fit a hinge or a ball to each of two bones where it faces the other; the better fit first.

    Every place counts by its area, however finely the surfaces are cut.

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
        points, normals, areas = facing_triangles(own, other, within_mm=within_mm)
        if len(points) < FEWEST:
            raise InputError(
                f"{areas.sum():.3g} mm² of the {of} bone face the other within {within_mm:g} mm ({len(points)} "
                f"samples; a fit needs {FEWEST}): give bones that meet in a joint, or a larger distance"
            )
        kept = np.ones(len(points), dtype=bool)
        fit = _fit(points, normals, areas, kind)
        for _ in range(TRIM_ROUNDS):
            off = np.abs(_off(fit, points))
            fresh = off <= TRIM * max(weighted_quantile(off[kept], areas[kept], 0.5), 1e-9)
            if (fresh == kept).all() or fresh.sum() < FEWEST:
                break
            kept = fresh
            fit = _fit(points[kept], normals[kept], areas[kept], kind, before=fit)
        found.append(FittedJoint(of, fit, float(areas[kept].sum()), float(areas[~kept].sum())))
    return tuple(sorted(found, key=lambda joint: joint.fit.rms / joint.fit.radius))


def facing_triangles(own: TriMesh, other: TriMesh, *, within_mm: float) -> tuple[Points, Points, Float]:
    """Middles, outward normals and areas of the small triangles of a surface that face another one close by.

    The surface is cut to samples (`surface_samples`) first, so that they are alike whatever triangles it has.
    """
    low, high = other.vertices.min(axis=0) - within_mm, other.vertices.max(axis=0) + within_mm
    corners = own.corners()
    near = ((corners.max(axis=1) > low) & (corners.min(axis=1) < high)).all(axis=1)
    if not near.any():
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    part = surface_samples(TriMesh(own.vertices, own.faces[near]), spacing_mm=within_mm / SAMPLES_WITHIN).mesh
    vectors = area_vectors(part)
    areas = np.linalg.norm(vectors, axis=1)
    normals = vectors / np.where(areas > 0.0, areas, 1.0)[:, None]
    middles = part.corners().mean(axis=1)
    inside = np.flatnonzero(((middles > low) & (middles < high)).all(axis=1) & (areas > 0.0))
    if not inside.size:
        return middles[:0], normals[:0], areas[:0]
    places = nearest_places(middles[inside], other)
    way = (places.places - middles[inside]) / np.maximum(places.distances, 1e-12)[:, None]
    facing = (places.distances < within_mm) & (np.einsum("ti,ti->t", way, normals[inside]) > FACING)
    chosen = inside[facing]
    return middles[chosen], normals[chosen], areas[chosen]


def _fit(
    points: Points, normals: Points, areas: Float, kind: JointKind, *, before: CylinderFit | SphereFit | None = None
) -> CylinderFit | SphereFit:
    if kind is JointKind.BALL:
        return fitted_sphere(points, weights=areas)
    near = before.axis if isinstance(before, CylinderFit) else None
    return fitted_cylinder(points, normals, weights=areas, near=near)


def _off(fit: CylinderFit | SphereFit, points: Points) -> Float:
    off = points - fit.centre
    if isinstance(fit, CylinderFit):
        off = off - np.outer(off @ fit.axis, fit.axis)
    distances: Float = np.linalg.norm(off, axis=1) - fit.radius
    return distances
