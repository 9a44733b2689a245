"""Distances of points from surfaces, nearest places and smooth normals there."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from scipy.spatial import cKDTree

from musclefit.geometry.arrays import Float, Int, Points
from musclefit.geometry.meshes import TriMesh

EVERY = 64
"""Of so many samples one tells, by its distance, whether the others can be near enough to be asked."""


@dataclass(frozen=True, eq=False, slots=True)
class NearestPlaces:
    """Where (N, 3) points are nearest to a surface.

    Parameters
    ----------
    distances : (N,) float64, mm
        Not signed.
    places : (N, 3) float64, mm
    faces : (N,) int64
    """

    distances: Float
    places: Points
    faces: Int


class DistanceTree:
    """Distances from one surface, for many questions: its tree is built once.

    Parameters
    ----------
    surface : TriMesh
    """

    def __init__(self, surface: TriMesh) -> None:
        self._vertices = np.array(surface.vertices, dtype=np.float64)
        self._faces = np.array(surface.faces, dtype=np.int64)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def __call__(self, points: Points) -> Float:
        """(N,) distances of (N, 3) points from the surface, mm; not signed."""
        squared, _, _ = self._tree.squared_distance(self._vertices, self._faces, np.ascontiguousarray(points))
        distances: Float = np.sqrt(np.asarray(squared, dtype=np.float64)).reshape(-1)
        return distances

    def places(self, points: Points) -> NearestPlaces:
        """Nearest place on the surface for each of (N, 3) points, mm."""
        squared, faces, places = self._tree.squared_distance(self._vertices, self._faces, np.ascontiguousarray(points))
        return NearestPlaces(
            np.sqrt(np.asarray(squared, dtype=np.float64)).reshape(-1),
            np.asarray(places, dtype=np.float64).reshape(-1, 3),
            np.asarray(faces, dtype=np.int64).reshape(-1),
        )


class SampledDistances:
    """Distances of samples from surfaces, measured only where they can count.

    One sample in `EVERY` is measured; how far another is from the nearest of these bounds its distance from below.

    Parameters
    ----------
    points : (N, 3) float64, mm
        At least one.
    """

    def __init__(self, points: Points) -> None:
        self._points = points
        self._coarse = points[::EVERY]
        apart, owner = cKDTree(self._coarse).query(points)
        self._apart, self._owner = np.asarray(apart, dtype=np.float64), np.asarray(owner, dtype=np.int64)

    def distances(self, tree: DistanceTree, *, up_to_mm: float) -> Float:
        """(N,) distances from a surface, mm, where they are not above a bound; infinite elsewhere."""
        near = np.flatnonzero(self.at_least(tree) <= up_to_mm)
        found = np.full(len(self._points), np.inf)
        found[near] = tree(self._points[near])
        found[found > up_to_mm] = np.inf
        return found

    def at_least(self, tree: DistanceTree) -> Float:
        """(N,) bounds from below on the distances from a surface, mm."""
        return tree(self._coarse)[self._owner] - self._apart

    def smallest(self, tree: DistanceTree, *, up_to_mm: float) -> float:
        """The smallest distance from a surface, or the bound where that is smaller."""
        coarse = tree(self._coarse)
        bound = min(float(coarse.min()), up_to_mm)
        near = np.flatnonzero(coarse[self._owner] - self._apart < bound)
        return min(bound, float(tree(self._points[near]).min())) if len(near) else bound


def nearest_places(points: Points, surface: TriMesh) -> NearestPlaces:
    """Nearest place on the surface for each of (N, 3) points, mm."""
    squared, faces, places = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points), np.array(surface.vertices), np.array(surface.faces)
    )
    return NearestPlaces(
        np.sqrt(np.asarray(squared, dtype=np.float64)), np.asarray(places), np.asarray(faces, np.int64)
    )


def smooth_normals(surface: TriMesh, at: NearestPlaces) -> Points:
    """(N, 3) unit normals at places of a surface: its vertex normals, interpolated over each triangle."""
    corners = surface.faces[at.faces]
    by_vertex = np.asarray(igl.per_vertex_normals(np.array(surface.vertices), np.array(surface.faces)))
    a, b, c = (surface.vertices[corners[:, k]] for k in range(3))
    weights = barycentric(at.places, a, b, c)
    normals = np.einsum("nk,nkj->nj", weights, by_vertex[corners])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    unit: Points = normals / np.where(lengths > 0.0, lengths, 1.0)
    return unit


def thinned(points: Points, *, spacing_mm: float) -> Int:
    """Numbers of some of (N, 3) points, no two closer than the spacing, none farther from a chosen one."""
    tree = cKDTree(points)
    free = np.ones(len(points), dtype=bool)
    chosen = []
    for k in range(len(points)):
        if free[k]:
            chosen.append(k)
            free[tree.query_ball_point(points[k], spacing_mm)] = False
    return np.array(chosen, dtype=np.int64)


def barycentric(points: Points, a: Points, b: Points, c: Points) -> Float:
    """(N, 3) shares of the corners a, b, c at (N, 3) places of triangles; thirds where a triangle has no area."""
    u, v, w = b - a, c - a, points - a
    uu, uv, vv = (np.einsum("ni,ni->n", p, q) for p, q in ((u, u), (u, v), (v, v)))
    wu, wv = (np.einsum("ni,ni->n", w, q) for q in (u, v))
    area = uu * vv - uv * uv
    safe = np.where(area > 0.0, area, 1.0)
    second, third = (vv * wu - uv * wv) / safe, (uu * wv - uv * wu) / safe
    weights: Float = np.column_stack([1.0 - second - third, second, third])
    return np.clip(np.where(area[:, None] > 0.0, weights, 1.0 / 3.0), 0.0, 1.0)
