"""Finds where a closed surface comes close to itself, inside or outside, and cuts that out; knows no tissue.

At a place, a ball of a stated width lies against the surface from inside (or from outside). Where another part of the
surface that faces away reaches into the ball, the wall (or the slot) there is narrower than the width. So is the wedge
at an acute edge, up to the edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musclefit.geometry.arrays import Bool, Int, Points
from musclefit.geometry.measures import area_vectors
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.queries.solids import candidate_pairs
from musclefit.geometry.surfaces.booleans import difference, padded
from musclefit.geometry.surfaces.subdivision import with_short_edges
from musclefit.geometry.surfaces.uncrossing import compacted

OPPOSITE = -0.985
"""Cosine between the normals of two walls from which on they face away from each other: wedges below 10 degrees.

Wedges that are wider stay: triangles of 3 mm that are 0.05 mm off a bent surface lean by 4 degrees at most.
"""

SPACING_MM = 0.5
"""Longest edge of the triangles at whose middles balls are laid against the surface, mm."""


@dataclass(frozen=True, eq=False, slots=True)
class ThinPlaces:
    """Small triangles of a surface, and at which of them it is closer to itself than a width.

    Parameters
    ----------
    whole : TriMesh
        The triangles that were looked at: those with another part of the surface near that faces away.
    mesh : TriMesh
        The same, cut small.
    wall, slot : (f,) bool
        Which of the small ones have another side too near: through the inside, through the outside.
    """

    whole: TriMesh
    mesh: TriMesh
    wall: Bool
    slot: Bool

    @property
    def thin(self) -> Bool:
        """(f,) either of the two."""
        either: Bool = self.wall | self.slot
        return either

    @property
    def area_mm2(self) -> float:
        """Area of the thin triangles; of a thin wall both sides count."""
        return float(np.linalg.norm(area_vectors(self.mesh), axis=1)[self.thin].sum())

    def covering(self) -> TriMesh:
        """Few triangles that make up the thin ones: whole ones where all their parts are thin."""
        if not self.thin.any():
            return TriMesh(self.mesh.vertices, self.mesh.faces[:0])
        parent = nearest_places(self.mesh.corners().mean(axis=1), self.whole).faces
        all_thin = np.ones(len(self.whole.faces), dtype=bool)
        all_thin[parent[~self.thin]] = False
        all_thin[np.setdiff1d(np.arange(len(all_thin)), parent)] = False
        parts = self.mesh.faces[self.thin & ~all_thin[parent]]
        return TriMesh(self.mesh.vertices, np.concatenate([self.whole.faces[all_thin], parts]))


def thin_places(mesh: TriMesh, *, width_mm: float) -> ThinPlaces:
    """Where a closed surface is closer to itself than a width, at the middles of triangles of a stated size.

    Parameters
    ----------
    mesh : TriMesh
        Closed, outward oriented, without crossings.
    width_mm : float
    """
    opposed = _opposed(mesh, within_mm=width_mm)
    whole = compacted(TriMesh(mesh.vertices, mesh.faces[opposed]))
    looked = with_short_edges(whole, longest_mm=SPACING_MM)  # its first vertices are those of the whole
    middles, normals = looked.corners().mean(axis=1), _unit_normals(looked)
    wall, slot = (_reached_into(mesh, middles, normals, side * 0.5 * width_mm) for side in (-1.0, 1.0))
    return ThinPlaces(whole, looked, wall, slot)


def without_thin_places(mesh: TriMesh, found: ThinPlaces, *, width_mm: float, smooth_within_mm: float) -> TriMesh:
    """The surface less all within about a width of the thin triangles, on either side."""
    cover = found.covering()
    tool = padded(cover, np.arange(len(cover.faces)), distance_mm=width_mm)
    return difference(mesh, [tool], smooth_within_mm=smooth_within_mm)


def _opposed(mesh: TriMesh, *, within_mm: float) -> Int:
    """Faces that a face which faces away may come within a distance of, by their boxes and their planes."""
    corners = mesh.corners()
    low, high = corners.min(axis=1) - 0.5 * within_mm, corners.max(axis=1) + 0.5 * within_mm
    boxes = np.stack([low, high], axis=1)
    along = np.argsort(-np.ptp(mesh.vertices, axis=0))  # the sweep goes along the first axis
    pairs = candidate_pairs(list(boxes[:, :, along]))
    unit = _unit_normals(mesh)
    pairs = pairs[np.einsum("ki,ki->k", unit[pairs[:, 0]], unit[pairs[:, 1]]) < OPPOSITE]
    for one, other in ((0, 1), (1, 0)):
        first, second = pairs[:, one], pairs[:, other]
        heights = np.einsum("kci,ki->kc", corners[second] - corners[first][:, :1], unit[first])
        pairs = pairs[(heights.min(axis=1) < within_mm) & (heights.max(axis=1) > -within_mm)]
    return np.unique(pairs)


def _unit_normals(mesh: TriMesh) -> Points:
    normals = area_vectors(mesh)
    unit: Points = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return unit


def _reached_into(mesh: TriMesh, middles: Points, normals: Points, step_mm: float) -> Bool:
    """(k,) whether a side that faces away reaches into the ball that is centred a step along the normal."""
    if not len(middles):
        return np.zeros(0, dtype=bool)
    found = nearest_places(middles + step_mm * normals, mesh)
    away = np.einsum("ki,ki->k", _unit_normals(mesh)[found.faces], normals) < OPPOSITE
    reached: Bool = away & (found.distances < abs(step_mm) * (1.0 - 1e-9))
    return reached
