"""Manifold patches of a dirty surface: which to drop, which way they face, where to cut; knows faces, not tissues."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from musclefit.geometry.arrays import Bool, Faces, Int, Points
from musclefit.geometry.measures import area_vectors
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.faults import fans
from musclefit.geometry.surfaces.topology import Edges, closed_components, edges_of, repeats_a_face

_TINY = 1e-12
"""Size of a direction or a denominator below which it counts as none, no unit."""


def cancelled(faces: Faces) -> Bool:
    """(f,) True for faces to keep: of copies one, and none of two that lie on each other the opposite way round.

    Two opposite copies bound a sheet without thickness; without them the surface closes behind it, or leaves a hole.
    """
    low = np.sort(faces, axis=1)
    first = np.argmin(faces, axis=1)
    rolled = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    forward = (rolled == low).all(axis=1)
    keep = ~repeats_a_face(faces)
    _, group = np.unique(low, axis=0, return_inverse=True)
    group = group.ravel()
    either = np.zeros((group.max(initial=-1) + 1, 2), dtype=np.int64)
    np.add.at(either, (group[keep], forward[keep].astype(np.int64)), 1)
    opposed = (either[:, 0] > 0) & (either[:, 1] > 0)
    return keep & ~opposed[group]


def patches_of(edges: Edges) -> Int:
    """(f,) the manifold patch of each face: those joined by edges of exactly two faces."""
    return _pieces(edges, edges.faces_at == 2)


def _pieces(edges: Edges, joining: Bool) -> Int:
    n_faces = len(edges.of_face)
    rows, numbers = np.repeat(np.arange(n_faces), 3), edges.of_face.ravel()
    kept = joining[numbers]
    size = n_faces + len(edges.ends)
    graph = coo_array((np.ones(int(kept.sum()), np.int8), (rows[kept], n_faces + numbers[kept])), shape=(size, size))
    labels = connected_components(graph, directed=False)[1][:n_faces]
    return np.unique(labels, return_inverse=True)[1].astype(np.int64)


def superfluous(mesh: TriMesh) -> Bool:
    """(f,) True for faces of patches that hang on edges of more than two faces and leave fewer odd edges when dropped.

    Fins, flaps and walls inside. One patch after the other, the one that mends most edges for its area first.
    """
    areas = np.linalg.norm(area_vectors(mesh), axis=1)
    dropped = np.zeros(len(mesh.faces), dtype=bool)
    while True:
        kept = np.flatnonzero(~dropped)
        edges = edges_of(mesh.faces[kept])
        if not len(edges.non_manifold):
            return dropped
        patch = patches_of(edges)
        best: tuple[float, Int] | None = None
        hanging = np.unique(patch[(edges.faces_at[edges.of_face] > 2).any(axis=1)])
        for number in hanging:
            own = patch == number
            uses = np.bincount(edges.of_face[own].ravel(), minlength=len(edges.ends))
            before = (edges.faces_at % 2 == 1)[uses > 0].sum()
            after = ((edges.faces_at - uses) % 2 == 1)[uses > 0].sum()
            if after >= before or own.sum() > 0.5 * len(kept):
                continue
            score = float(before - after) / max(float(areas[kept[own]].sum()), _TINY)
            if best is None or score > best[0]:
                best = (score, kept[own])
        if best is None:
            return dropped
        dropped[best[1]] = True


def facing_outwards(mesh: TriMesh) -> Faces:
    """The faces of a closed surface with non-manifold edges, each patch turned so that the inside is behind it.

    What a component's own faces enclose an odd number of times is its inside, found by rays from its patches.
    Components without non-manifold edges stay as they are.
    """
    faces = mesh.faces.copy()
    component = closed_components(faces)
    for number in np.unique(component):
        own = np.flatnonzero(component == number)
        edges = edges_of(faces[own])
        if not len(edges.non_manifold):
            continue
        part = TriMesh(mesh.vertices, faces[own])
        patch = patches_of(edges)
        for label in np.unique(patch):
            members = np.flatnonzero(patch == label)
            if not _has_inside_behind(part, members):
                faces[own[members]] = faces[own[members]][:, ::-1]
    return faces


def _has_inside_behind(part: TriMesh, members: Int) -> bool:
    """Whether a ray along a face's normal leaves through an even number of other faces; the largest faces vote."""
    vectors = area_vectors(TriMesh(part.vertices, part.faces[members]))
    largest = np.argsort(-np.linalg.norm(vectors, axis=1))[:5]
    corners = part.corners()
    votes = 0
    for k in largest:
        for weights in ((0.31, 0.33, 0.36), (0.52, 0.21, 0.27), (0.17, 0.46, 0.37)):
            origin = np.array(weights) @ corners[members[k]]
            crossed = _crossed_by_ray(origin, vectors[k], np.delete(corners, members[k], axis=0))
            votes += 1 if crossed % 2 == 0 else -1
    return votes > 0


def _crossed_by_ray(origin: Points, direction: Points, corners: Points) -> int:
    """Triangles (f, 3, 3) that a ray goes through, by Möller and Trumbore."""
    a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(direction, v)
    det = np.einsum("fi,fi->f", u, p)
    safe = np.where(np.abs(det) > _TINY * np.abs(det).max(initial=_TINY), det, np.inf)
    s = origin - a
    q = np.cross(s, u)
    first, second = np.einsum("fi,fi->f", s, p) / safe, np.einsum("i,fi->f", direction, q) / safe
    t = np.einsum("fi,fi->f", v, q) / safe
    return int(((first >= 0) & (second >= 0) & (first + second <= 1) & (t > 0) & np.isfinite(safe)).sum())


@dataclass(frozen=True, eq=False, slots=True)
class Cut:
    """A surface cut open where it was non-manifold at vertices or edges.

    Parameters
    ----------
    mesh : TriMesh
        Each fan of faces has a vertex of its own; copies come after the old vertices.
    added : int
        Vertices added.
    """

    mesh: TriMesh
    added: int


def cut_at_non_manifold_vertices(mesh: TriMesh) -> Cut:
    """Give each fan of faces its own vertex, so that bodies that meet in an edge or a vertex only touch.

    At an edge of four or more faces, faces that have the inside between them stay together.
    """
    faces = mesh.faces
    fan = fans(faces, joined=_paired(mesh))
    numbers, first, inverse = np.unique(fan, return_index=True, return_inverse=True)
    old = faces.ravel()[first]
    _, keeper = np.unique(old, return_index=True)
    is_copy = np.ones(len(numbers), dtype=bool)
    is_copy[keeper] = False
    number_of = old.copy()
    number_of[is_copy] = len(mesh.vertices) + np.arange(int(is_copy.sum()))
    vertices = np.vstack([mesh.vertices, mesh.vertices[old[is_copy]]])
    return Cut(TriMesh(vertices, number_of[inverse.ravel()].reshape(-1, 3)), int(is_copy.sum()))


def _paired(mesh: TriMesh) -> Int:
    """(p, 2) half-edges that stay together: both of a two-faced edge; of a crowded one, those around the inside."""
    edges = edges_of(mesh.faces)
    order = np.argsort(edges.of_face.ravel(), kind="stable")
    starts = np.cumsum(edges.faces_at) - edges.faces_at
    two = starts[edges.faces_at == 2]
    pairs = [np.stack([order[two], order[two + 1]], axis=1)]
    for e in np.flatnonzero(edges.faces_at > 2):
        around = order[starts[e] : starts[e] + edges.faces_at[e]]
        pairs.append(_around_the_inside(mesh, edges.ends[e], around))
    return np.concatenate(pairs)


def _around_the_inside(mesh: TriMesh, ends: Int, around: Int) -> Int:
    """Pairs of the half-edges at one edge that have the inside between them, matched like brackets round the edge."""
    a, b = mesh.vertices[ends]
    axis = (b - a) / max(float(np.linalg.norm(b - a)), 1e-300)
    corners = mesh.faces[around // 3]
    tips = mesh.vertices[corners.sum(axis=1) - ends.sum()] - a
    flat = tips - np.outer(tips @ axis, axis)
    first = flat[0] / max(float(np.linalg.norm(flat[0])), 1e-300)
    angle = np.arctan2(flat @ np.cross(axis, first), flat @ first)
    forward = mesh.faces.ravel()[around] == ends[0]
    if 2 * int(forward.sum()) != len(around):
        return np.zeros((0, 2), dtype=np.int64)
    turn = [int(k) for k in np.lexsort((forward, angle))]
    pairs: list[tuple[int, int]] = []
    stack: list[int] = []
    for k in turn + turn:  # twice round, since a bracket may close after the start
        if k in stack or any(k in pair for pair in pairs):
            continue
        if not forward[k]:
            stack.append(k)
        elif stack:
            pairs.append((stack.pop(), k))
    return around[np.array(pairs, dtype=np.int64).reshape(-1, 2)]
