"""Tapes pulled tight around the plane sections of a surface: their lengths, and how these change with its vertices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from musclefit.geometry.arrays import Float, Int, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.sections import level_curve


@dataclass(frozen=True, eq=False, slots=True)
class Tape:
    """The convex hull of one closed curve in which a plane cuts a surface: hollows are spanned, as a tape spans them.

    Parameters
    ----------
    edges : (p, 2) int64
        The edges of the surface that the tape touches, as vertex numbers, in order around it.
    weights : (p,) float64
        Where on its edge each touch is, in [0, 1].
    points : (p, 3) float64, mm
        The touches.
    """

    edges: Int
    weights: Float
    points: Points

    @property
    def length_mm(self) -> float:
        """Perimeter of the hull, mm."""
        return float(np.linalg.norm(self.points - np.roll(self.points, 1, axis=0), axis=1).sum())

    @property
    def slopes(self) -> Points:
        """(p, 3) derivatives of the length by the touches, which move with the surface: in the plane, outwards."""
        back, forth = (self.points - np.roll(self.points, k, axis=0) for k in (1, -1))
        slopes: Points = back / np.linalg.norm(back, axis=1)[:, None] + forth / np.linalg.norm(forth, axis=1)[:, None]
        return slopes

    def distance_mm(self, place: Float) -> float:
        """Of a place from the nearest touch, mm."""
        return float(np.linalg.norm(self.points - place, axis=1).min())


def tapes_across(surface: TriMesh, *, at: Float, normal: Float) -> tuple[Tape, ...]:
    """The tapes around all closed curves in which a plane cuts a closed surface, the longest first.

    Parameters
    ----------
    surface : TriMesh
        Closed.
    at : (3,) float64, mm
        A place in the plane.
    normal : (3,) float64
        Of the plane; any length above 0.
    """
    direction = normal / np.linalg.norm(normal)
    along = (surface.vertices - at) @ direction
    above = along > 0.0
    crossed = surface.faces[above[surface.faces].any(axis=1) & ~above[surface.faces].all(axis=1)]
    if not len(crossed):
        return ()
    ends, pairs = level_curve(crossed, above)
    edges = np.unique(ends, axis=0)
    first, second = along[edges[:, 0]], along[edges[:, 1]]
    weights = first / (first - second)
    points = surface.vertices[edges[:, 0]] + weights[:, None] * np.diff(surface.vertices[edges], axis=1)[:, 0]
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(edges),) * 2)
    count, curve = connected_components(links, directed=False)
    plane = np.linalg.svd(direction[None])[2][1:]
    tapes = []
    for number in range(count):
        here = np.flatnonzero(curve == number)
        try:
            tight = here[ConvexHull(points[here] @ plane.T).vertices]
        except QhullError:  # a curve without area: the plane touches a tip
            continue
        tapes.append(Tape(edges[tight], weights[tight], points[tight]))
    return tuple(sorted(tapes, key=lambda tape: -tape.length_mm))
