"""Triangles that cross: takes surfaces, gives the pairs and where, by exact predicates; knows no tissue."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from igl import predicates

from musclefit.geometry.arrays import Bool, Faces, Float, Int, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.topology import edges_of, merge_duplicate_vertices, repeats_a_vertex
from musclefit.geometry.tets.orientation import integers

TOUCHING_MM = 1e-8
"""Sheets that reach no farther through each other than this touch: a moved vertex is known no better, and an atom is
ten times as large."""

_SURELY_UNFOLDED = -0.5
"""Cosine at a common edge below which rounding cannot hide that two triangles lie on opposite sides of it, no unit."""


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

    def deeper(self, mesh: TriMesh, *, than_mm: float) -> Int:
        """(q, 2) those pairs of triangles of one surface that reach farther than a length through each other.

        A triangle reaches through the plane of another by what of it is on the side where less of it is; the lesser of
        both ways counts. What merely touches, or lies on another triangle, does not reach through it.
        """
        first, second = mesh.corners()[self.pairs[:, 0]], mesh.corners()[self.pairs[:, 1]]
        depths = np.minimum(_reach_through(first, second), _reach_through(second, first))
        deep: Int = self.pairs[depths > than_mm]
        return deep


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
    pairs, flat = np.sort(whole[found.reshape(-1, 2)], axis=1), coplanar.ravel().astype(bool)
    # libigl 2.6.3 compares rounded normals at a common edge: it takes neighbours 1e-9 apart for folded, and misjudges
    # those that run through their edge the same way; what has a common edge is judged here
    common = np.array([len(np.intersect1d(*pair)) for pair in merged.faces[pairs]], dtype=np.int64)
    # and it takes some for crossing that have nothing but their common corner in common: those are judged here, too
    kept = common != 2
    by_corner = np.flatnonzero(common == 1)
    kept[by_corner] = [_beyond_corner(merged.vertices, *pair) for pair in merged.faces[pairs[by_corner]]]
    folded = _folded_neighbours(merged.vertices, merged.faces, whole)
    pairs = np.concatenate([pairs[kept], folded])
    return _crossings(pairs, np.concatenate([flat[kept], np.ones(len(folded), dtype=bool)]), mesh, mesh)


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


def _reach_through(planes: Float, triangles: Float) -> Float:
    """(p,) how far (p, 3, 3) triangles reach through the planes of others, mm; infinite where these have no plane."""
    normals = np.cross(planes[:, 1] - planes[:, 0], planes[:, 2] - planes[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    apart = np.einsum("pki,pi->pk", triangles - planes[:, :1], normals) / np.where(lengths > 0.0, lengths, 1.0)[:, None]
    reach = np.minimum(np.maximum(apart.max(axis=1), 0.0), np.maximum(-apart.min(axis=1), 0.0))
    return np.where(lengths > 0.0, reach, np.inf)


def _beyond_corner(vertices: Points, first: Int, second: Int) -> bool:
    """Exactly: two triangles, (3,) vertex numbers of each, with one common corner share a point beside it.

    Seen from the corner, each triangle meets the other's plane in a ray; they share points when both rays are the same.
    In one plane, a side of one runs within the other.
    """
    (corner,) = np.intersect1d(first, second)
    others = [k for k in first if k != corner], [k for k in second if k != corner]
    places = integers(vertices[[corner, *others[0], *others[1]]])
    a, b, c, d = ([int(x) for x in place - places[0]] for place in places[1:])
    normals = _cross(a, b), _cross(c, d)
    heights = [(_dot(normals[1], a), _dot(normals[1], b)), (_dot(normals[0], c), _dot(normals[0], d))]
    if not any(heights[0]) or not any(heights[1]):
        return _within(a, c, d) or _within(b, c, d) or _within(c, a, b) or _within(d, a, b)
    if any(p * q > 0 for p, q in heights):
        return False
    rays = []
    for (p, q), (x, y) in zip(heights, ((a, b), (c, d)), strict=True):
        side = 1 if p > q else -1
        rays.append([side * (p * y[k] - q * x[k]) for k in range(3)])
    return _dot(*rays) > 0


def _within(direction: list[int], a: list[int], b: list[int]) -> bool:
    """A direction in the plane of two others lies between them."""
    normal = _cross(a, b)
    return _dot(_cross(a, direction), normal) >= 0 and _dot(_cross(direction, b), normal) >= 0


def _cross(a: list[int], b: list[int]) -> list[int]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _dot(a: list[int], b: list[int]) -> int:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _folded_neighbours(vertices: Points, faces: Faces, whole: Int) -> Int:
    """(k, 2) pairs of faces on one side of a common edge and exactly in one plane."""
    edges = edges_of(faces[whole])
    order = np.argsort(edges.of_face.ravel(), kind="stable")
    owners, starts = whole[order // 3], np.cumsum(edges.faces_at) - edges.faces_at
    plain, crowded = np.flatnonzero(edges.faces_at == 2), np.flatnonzero(edges.faces_at > 2)
    rows = [(plain, owners[starts[plain]], owners[starts[plain] + 1])]
    for e in crowded:
        around = owners[starts[e] : starts[e] + edges.faces_at[e]].tolist()
        pairs = np.array(list(combinations(sorted(around), 2)), dtype=np.int64)
        rows.append((np.full(len(pairs), e), pairs[:, 0], pairs[:, 1]))
    edge, first, second = (np.concatenate(column) for column in zip(*rows, strict=True))
    if not len(edge):
        return np.zeros((0, 2), dtype=np.int64)
    ends = edges.ends[edge]
    tips = [faces[own].sum(axis=1) - ends.sum(axis=1) for own in (first, second)]
    a, b, c, d = (np.ascontiguousarray(vertices[index]) for index in (*ends.T, *tips))
    in_plane = np.asarray(predicates.orient3d(a, b, c, d)).ravel().astype(np.int64) == 0
    candidates = np.flatnonzero(in_plane & (tips[0] != tips[1]) & (_cosine_at_edge(a, b, c, d) > _SURELY_UNFOLDED))
    kept = [i for i in candidates if _on_one_side(np.stack([a[i], b[i], c[i], d[i]]))]
    return np.unique(np.stack([first[kept], second[kept]], axis=1), axis=0)


def _cosine_at_edge(a: Points, b: Points, c: Points, d: Points) -> Float:
    """(k,) cosine of the angle between c and d seen along the edge a b: 1 folded, -1 flat; 1 where there is none."""
    along = b - a
    squared = np.einsum("ki,ki->k", along, along)[:, None]
    u, v = ((tip - a) - along * (np.einsum("ki,ki->k", tip - a, along)[:, None] / squared) for tip in (c, d))
    lengths = np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1)
    return np.where(lengths > 0, np.einsum("ki,ki->k", u, v) / np.where(lengths > 0, lengths, 1.0), 1.0)


def _on_one_side(corners: Points) -> bool:
    """Exactly: of four points in a plane, the last two lie on one side of the line through the first two."""
    for axes in ([0, 1], [1, 2], [2, 0]):
        shadow = np.ascontiguousarray(corners[:, axes])
        first, second = (predicates.orient2d(shadow[0], shadow[1], shadow[k]) for k in (2, 3))
        if first != predicates.COLLINEAR and second != predicates.COLLINEAR:
            return bool(first == second)
    return False  # one of the triangles is a line and covers nothing


def _crossings(pairs: Int, coplanar: Int | Bool, a: TriMesh, b: TriMesh) -> Crossings:
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    pairs = pairs[order]
    first, second = a.vertices[a.faces[pairs[:, 0]]], b.vertices[b.faces[pairs[:, 1]]]
    low = np.maximum(first.min(axis=1), second.min(axis=1))
    high = np.minimum(first.max(axis=1), second.max(axis=1))
    return Crossings(pairs, np.asarray(coplanar).ravel()[order].astype(bool), 0.5 * (low + high))
