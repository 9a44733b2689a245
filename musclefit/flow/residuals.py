"""How far a map is from the rigid motions of bones on their surfaces, between the places where it is held to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from musclefit.flow.bones import RigidGroup
from musclefit.flow.deformation import Deformation
from musclefit.geometry.arrays import Float
from musclefit.geometry.measures import area_vectors
from musclefit.geometry.rigid import RigidMotion


@dataclass(frozen=True, eq=False, slots=True)
class SurfaceResiduals:
    """Residuals on the exposed surface of bones.

    Parameters
    ----------
    distances : (n,) float64, mm
        Of the map from the rigid motion, at the middles of the triangles that the groups' surfaces are cut to.
    areas : (n,) float64, mm²
        Of these triangles.
    gap_mm : float
        No place of these triangles is farther from their middle.
    """

    distances: Float
    areas: Float
    gap_mm: float


def surface_residuals(
    groups: Sequence[RigidGroup], deformation: Deformation, motions: Mapping[str, RigidMotion]
) -> SurfaceResiduals:
    """Distances of the map from the bones' rigid motions over the whole path, on all their exposed surface.

    The field is held to the bones at the corners of the triangles that are looked at, so it is farthest off between
    them. Triangles with a corner in the contact zone are left out: there it may slip.

    Parameters
    ----------
    groups : sequence of RigidGroup
    deformation : Deformation
    motions : mapping of bone to RigidMotion
        From rest to the end of the path.
    """
    rest, targets, areas, gap = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)], 0.0
    for group in groups:
        exposed = ~group.contact[group.surface.faces].any(axis=1)
        corners = group.surface.corners()[exposed]
        middles = corners.mean(axis=1)
        rest.append(middles)
        targets.append(motions[group.bones[0]](middles))
        areas.append(np.linalg.norm(area_vectors(group.surface)[exposed], axis=1))
        gap = max(gap, float(np.linalg.norm(corners - middles[:, None], axis=2).max(initial=0.0)))
    places = np.concatenate(rest)
    off = deformation(places) - np.concatenate(targets) if len(places) else places
    return SurfaceResiduals(np.linalg.norm(off, axis=1), np.concatenate(areas), gap)
