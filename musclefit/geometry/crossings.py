"""Triangles that cross: takes surfaces, gives the pairs and where, by exact predicates; knows no tissue."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from igl import predicates

from musclefit.geometry.arrays import Bool, Int, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.topology import merge_duplicate_vertices, repeats_a_vertex


@dataclass(frozen=True, eq=False, slots=True)
class Crossings:
    """Pairs of triangles that share a point which is no common corner or edge.

    Parameters
    ----------
    pairs : (p, 2) int64
        Face numbers; of the first and of the second surface, or both of the same.
    coplanar : (p,) bool
        Both triangles lie in one plane.
    places : (p, 3) float64, mm
        A place at each pair: the middle of where the boxes of the two triangles overlap.
    """

    pairs: Int
    coplanar: Bool
    places: Points

    def __len__(self) -> int:
        return len(self.pairs)


def self_crossings(mesh: TriMesh) -> Crossings:
    """Pairs of triangles of one surface that cross or touch, by exact predicates.

    Vertices at exactly the same position count as one, so that a surface that touches itself at its vertices or edges
    does not cross itself there. Contact elsewhere (a vertex on another triangle) counts; so do two triangles folded
    onto each other. Faces that repeat a vertex and second copies of a face are passed over.

    Parameters
    ----------
    mesh : TriMesh

    Returns
    -------
    Crossings
        Each pair once, smaller face number first, sorted.
    """
    merged = merge_duplicate_vertices(mesh.vertices, mesh.faces)
    whole = np.flatnonzero(~repeats_a_vertex(merged.faces))
    _, found, coplanar = predicates.find_self_intersections(
        np.ascontiguousarray(merged.vertices), np.ascontiguousarray(merged.faces[whole])
    )
    pairs = np.sort(whole[found.reshape(-1, 2)], axis=1)
    return _crossings(pairs, coplanar, mesh, mesh)


def crossings_between(a: TriMesh, b: TriMesh) -> Crossings:
    """Pairs of triangles of two surfaces that cross or touch, by exact predicates; any contact counts.

    Two closed surfaces without crossings are apart or one lies wholly within the other.
    """
    whole_a, whole_b = np.flatnonzero(~repeats_a_vertex(a.faces)), np.flatnonzero(~repeats_a_vertex(b.faces))
    if not whole_a.size or not whole_b.size:
        return _crossings(np.zeros((0, 2), np.int64), np.zeros(0, bool), a, b)
    _, found, coplanar = predicates.find_intersections(
        np.array(a.vertices), np.array(a.faces[whole_a]), np.array(b.vertices), np.array(b.faces[whole_b])
    )
    found = found.reshape(-1, 2)
    return _crossings(np.stack([whole_a[found[:, 0]], whole_b[found[:, 1]]], axis=1), coplanar, a, b)


def _crossings(pairs: Int, coplanar: Int | Bool, a: TriMesh, b: TriMesh) -> Crossings:
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    pairs = pairs[order]
    first, second = a.vertices[a.faces[pairs[:, 0]]], b.vertices[b.faces[pairs[:, 1]]]
    low = np.maximum(first.min(axis=1), second.min(axis=1))
    high = np.minimum(first.max(axis=1), second.max(axis=1))
    return Crossings(pairs, np.asarray(coplanar).ravel()[order].astype(bool), 0.5 * (low + high))
