"""Planes that keep triangles in front of walls and of each other; takes positions, knows no tissue."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from musclefit.geometry.arrays import Bool, Faces, Float, Int, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import NearestPlaces, nearest_places, smooth_normals
from musclefit.geometry.queries.winding import winding_numbers
from musclefit.geometry.tets.relocation import Planes

SAMPLED_MM, MOST_SAMPLES = 0.7, 16
"""Triangles are kept in front of walls at points this far apart, at most so many along an edge."""

REACH_MM = 0.8
"""Points farther in front of a wall than this need no plane ..."""

DEEPEST_MM = 1.5
"""... and those farther behind it than this get none: nobody knows which way out is theirs."""

REST_SHARE = 0.8
"""A point need not be farther from a wall than this share of its distance at rest."""


@dataclass(frozen=True, eq=False, slots=True)
class Wall:
    """A closed surface that others stay outside of, at rest and now; ``used`` are the numbers of its vertices."""

    rest: TriMesh
    now: TriMesh
    used: Int

    @classmethod
    def of(cls, faces: Faces, *, rest: Points, now: Points) -> Wall:
        """The wall of (f, 3) faces into positions at rest and now."""
        used, local = np.unique(faces, return_inverse=True)
        local = local.reshape(-1, 3)
        return cls(TriMesh(rest[used], local), TriMesh(now[used], local), used)


def planes_before(wall: Wall, faces: Faces, *, rest: Points, now: Points, margins: Float) -> Planes:
    """The planes that keep triangles in front of a wall as it is seen from where they are now.

    Parameters
    ----------
    wall : Wall
    faces : (f, 3) int64
        The triangles; those of the wall itself are left out.
    rest, now : (n, 3) float64, mm
    margins : (n,) float64, mm
        How far in front each vertex should be; a triangle takes the largest of its corners.
    """
    low = wall.now.vertices.min(axis=0) - DEEPEST_MM
    high = wall.now.vertices.max(axis=0) + DEEPEST_MM
    corners = now[faces]
    near = ((corners.max(axis=1) > low) & (corners.min(axis=1) < high)).all(axis=1)
    near &= ~np.isin(faces, wall.used).all(axis=1)
    faces = faces[near]
    of_face, shares = _samples(now[faces])
    points = _points(now, faces[of_face], shares)
    close = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
    if not len(close):
        return Planes.none()
    at = nearest_places(points[close], wall.now)
    picked = at.distances < DEEPEST_MM
    close, at = close[picked], _rows(at, picked)
    if not len(close):
        return Planes.none()
    points, off = points[close], points[close] - at.places
    sides = np.where(winding_numbers(wall.now, points) > 0.5, -1.0, 1.0)
    away = sides[:, None] * off / np.maximum(at.distances, 1e-12)[:, None]
    normals = np.where(at.distances[:, None] > 1e-3, away, smooth_normals(wall.now, at))
    picked = sides * at.distances < REACH_MM
    chosen = faces[of_face[close[picked]]]
    at_rest = _points(rest, chosen, shares[close[picked]])
    before = nearest_places(at_rest, wall.rest).distances if len(chosen) else np.zeros(0)
    return Planes(
        chosen,
        shares[close[picked]],
        at.places[picked],
        normals[picked],
        np.minimum(margins[chosen].max(axis=1, initial=0.0), REST_SHARE * before),
    )


@dataclass(frozen=True, eq=False, slots=True)
class Divide:
    """A plane between two triangles that crossed: the first stays behind it, the second in front.

    ``first`` and ``second`` are (3,) vertices, ``place`` and ``normal`` (3,), mm; both keep ``margin_mm`` from it.
    """

    first: Int
    second: Int
    place: Float
    normal: Float
    margin_mm: float

    def wider(self, place: Float, normal: Float, *, by_mm: float, up_to_mm: float) -> Divide:
        """Where they cross again."""
        return replace(self, place=place, normal=normal, margin_mm=min(self.margin_mm + by_mm, up_to_mm))

    def planes(self) -> Planes:
        """Of all corners that the triangles do not share."""
        rows = [
            (face, k, sign)
            for face, other, sign in ((self.first, self.second, -1.0), (self.second, self.first, 1.0))
            for k in range(3)
            if face[k] not in other
        ]
        return Planes(
            np.array([face for face, _, _ in rows], dtype=np.int64).reshape(-1, 3),
            np.array([np.eye(3)[k] for _, k, _ in rows]).reshape(-1, 3),
            np.tile(self.place, (len(rows), 1)),
            np.array([sign * self.normal for _, _, sign in rows]).reshape(-1, 3),
            np.full(len(rows), self.margin_mm),
        )


def _samples(corners: Float) -> tuple[Int, Float]:
    """Of (f, 3, 3) triangles: the triangle of each of some points spread over them, and its barycentric coordinates."""
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1, initial=0.0)
    parts = np.clip(np.ceil(longest / SAMPLED_MM), 1, MOST_SAMPLES).astype(int)
    numbers, shares = [np.zeros(0, np.int64)], [np.zeros((0, 3))]
    for n in np.unique(parts):
        lattice = np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]) / n
        which = np.flatnonzero(parts == n)
        numbers.append(np.repeat(which, len(lattice)))
        shares.append(np.tile(lattice, (len(which), 1)))
    return np.concatenate(numbers), np.concatenate(shares)


def _points(vertices: Points, faces: Faces, shares: Float) -> Points:
    points: Points = (vertices[faces] * shares[:, :, None]).sum(axis=1)
    return points


def _rows(at: NearestPlaces, picked: Bool) -> NearestPlaces:
    return NearestPlaces(**{name: getattr(at, name)[picked] for name in NearestPlaces.__slots__})
