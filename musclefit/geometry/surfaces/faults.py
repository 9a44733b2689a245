"""What keeps a surface from bounding a solid: takes a surface, counts its faults; mends none and knows no tissue."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from musclefit.geometry.arrays import Faces, Int, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.geometry.surfaces.topology import (
    edges_of,
    has_no_area,
    merge_duplicate_vertices,
    nested_pieces,
    repeats_a_face,
    repeats_a_vertex,
)


@dataclass(frozen=True, slots=True)
class Faults:
    """How often each fault occurs in a surface; a surface without any bounds a solid.

    Parameters
    ----------
    collapsed : int
        Faces that use one vertex twice.
    doubled : int
        Faces whose three vertices an earlier face has already, either way round.
    boundary_edges : int
        Edges of one face.
    non_manifold_edges : int
        Edges of more than two faces.
    inconsistently_oriented_edges : int
        Edges run through more often one way than the other, open ones left out.
    non_manifold_vertices : int
        Vertices whose faces form more than one fan.
    flat : int
        Faces without area, exactly.
    touching : int
        Vertices exactly at the position of another one.
    crossings : int
        Pairs of triangles that cross or touch elsewhere than at common corners or edges, by exact predicates.
    misplaced : int
        Closed pieces that are inside-out and no cavity, or wholly inside another piece and no cavity.
    """

    collapsed: int
    doubled: int
    boundary_edges: int
    non_manifold_edges: int
    inconsistently_oriented_edges: int
    non_manifold_vertices: int
    flat: int
    touching: int
    crossings: int
    misplaced: int

    @property
    def none(self) -> bool:
        """Whether the surface bounds a solid: closed, manifold, oriented outwards, crossing and touching nowhere."""
        return not any(getattr(self, field.name) for field in fields(self))

    def said(self) -> str:
        """The faults that occur, in words."""
        words = (f"{getattr(self, field.name)} {field.name.replace('_', ' ')}" for field in fields(self))
        return ", ".join(word for word in words if not word.startswith("0 ")) or "none"


def faults_of(mesh: TriMesh) -> Faults:
    """Count the faults of a surface as it stands; vertices that no face uses are passed over."""
    used = np.unique(mesh.faces)
    mesh = TriMesh(mesh.vertices[used], np.searchsorted(used, mesh.faces))
    faces = mesh.faces[~repeats_a_vertex(mesh.faces)]
    sorted_faces = np.sort(faces, axis=1)
    edges = edges_of(faces)
    closed = len(faces) > 0 and not len(edges.odd) and not len(edges.unbalanced)
    merged = merge_duplicate_vertices(mesh.vertices, faces)
    return Faults(
        collapsed=len(mesh.faces) - len(faces),
        doubled=int(repeats_a_face(sorted_faces).sum()),
        boundary_edges=len(edges.boundary),
        non_manifold_edges=len(edges.non_manifold),
        inconsistently_oriented_edges=int(((edges.excess != 0) & (edges.faces_at > 1)).sum()),
        non_manifold_vertices=len(non_manifold_vertices(faces)),
        flat=int(has_no_area(TriMesh(mesh.vertices, faces)).sum()) if len(faces) else 0,
        touching=merged.removed,
        crossings=len(self_crossings(TriMesh(mesh.vertices, faces))) if len(faces) else 0,
        misplaced=_misplaced(TriMesh(mesh.vertices, faces)) if closed else 0,
    )


def non_manifold_vertices(faces: Faces) -> Int:
    """Numbers of the vertices whose faces form more than one fan, a fan being held together by edges of two faces."""
    corner_of = fans(faces)
    if not len(faces):
        return np.zeros(0, dtype=np.int64)
    pairs = np.unique(np.stack([faces.ravel(), corner_of.ravel()], axis=1), axis=0)
    vertices, count = np.unique(pairs[:, 0], return_counts=True)
    found: Int = vertices[count > 1]
    return found


def fans(faces: Faces, *, joined: Int | None = None) -> Int:
    """(f, 3) number of the fan that each face's corner belongs to.

    Parameters
    ----------
    faces : (f, 3) int64
    joined : (p, 2) int64, or None for the edges of exactly two faces
        Half-edges that hang together, each as ``3 face + corner`` of the corner that it starts from.
    """
    n_corners = faces.size
    if joined is None:
        edges = edges_of(faces)
        order = np.argsort(edges.of_face.ravel(), kind="stable")
        starts = (np.cumsum(edges.faces_at) - edges.faces_at)[edges.faces_at == 2]
        joined = np.stack([order[starts], order[starts + 1]], axis=1) if n_corners else np.zeros((0, 2), np.int64)
    flat = faces.ravel()
    first, second = joined[:, 0], joined[:, 1]
    after = np.arange(n_corners).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    same_way = flat[first] == flat[second]
    to_first = np.where(same_way, second, after[second])
    to_after = np.where(same_way, after[second], second)
    rows, columns = np.concatenate([first, after[first]]), np.concatenate([to_first, to_after])
    graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(n_corners, n_corners))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64).reshape(-1, 3)


def coincident_groups(vertices: Points) -> Int:
    """(n,) number of the position of each vertex; vertices exactly at one place have the same."""
    return merge_duplicate_vertices(vertices, np.zeros((0, 3), np.int64)).kept_as


def _misplaced(mesh: TriMesh) -> int:
    pieces = nested_pieces(mesh)
    wants_negative = pieces.depth % 2 == 1
    return int(((pieces.volumes > 0) == wants_negative).sum())
