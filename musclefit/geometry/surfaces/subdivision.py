"""Splitting edges of triangle surfaces so that neighbours stay joined; knows no map and no tissue."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from musclefit.compiling import njit
from musclefit.errors import MeshError
from musclefit.geometry.arrays import Bool, Faces, Int, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.edge_lengths import EdgeLengths


@dataclass(frozen=True, eq=False, slots=True)
class FaceEdges:
    """The edges of a surface.

    Parameters
    ----------
    ends : (e, 2) int64
        Vertex numbers, the smaller first.
    of_face : (f, 3) int64
        Edge k of a face joins its corners k and k + 1.
    """

    ends: Int
    of_face: Int

    @classmethod
    def of(cls, faces: Faces) -> FaceEdges:
        """The edges of (f, 3) faces, each once."""
        ends, of_face = np.empty((3 * len(faces), 2), np.int64), np.empty((len(faces), 3), np.int64)
        count = _number_edges(np.ascontiguousarray(faces), int(faces.max(initial=0)) + 1, ends, of_face)
        return cls(ends[:count].copy(), of_face)


@njit(cache=True)
def _number_edges(faces, vertices, ends, of_face):
    """Write all edges in order of their vertices, and which ones the faces have; gives how many there are."""
    starts = np.zeros(vertices + 1, np.int64)
    for f in range(len(faces)):
        for k in range(3):
            starts[min(faces[f, k], faces[f, (k + 1) % 3]) + 1] += 1
    starts = np.cumsum(starts)
    others, slots, filled = np.empty(3 * len(faces), np.int64), np.empty(3 * len(faces), np.int64), starts[:-1].copy()
    for f in range(len(faces)):
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            low, high = min(a, b), max(a, b)
            place = filled[low]
            while place > starts[low] and others[place - 1] > high:
                others[place], slots[place] = others[place - 1], slots[place - 1]
                place -= 1
            others[place], slots[place] = high, 3 * f + k
            filled[low] += 1
    count = 0
    for low in range(vertices):
        for place in range(starts[low], starts[low + 1]):
            if place == starts[low] or others[place] != others[place - 1]:
                ends[count, 0], ends[count, 1] = low, others[place]
                count += 1
            of_face[slots[place] // 3, slots[place] % 3] = count - 1
    return count


def longest_edges(vertices: Points, edges: FaceEdges, faces: Int) -> Bool:
    """(e,) which edges are the longest of the faces with some numbers."""
    a, b = edges.ends.T
    lengths = np.linalg.norm(vertices[b] - vertices[a], axis=1)
    of_faces = edges.of_face[faces]
    longest: Bool = np.zeros(len(edges.ends), dtype=bool)
    longest[np.take_along_axis(of_faces, lengths[of_faces].argmax(axis=1)[:, None], axis=1)] = True
    return longest


def split_edges(mesh: TriMesh, edges: FaceEdges, split: Bool) -> TriMesh:
    """Split the marked edges at their middles, and every face that has one into two, three or four.

    Parameters
    ----------
    mesh : TriMesh
    edges : FaceEdges
        Of ``mesh.faces``.
    split : (e,) bool

    Returns
    -------
    TriMesh
        The old vertices keep their numbers; the middle of the k-th marked edge is ``len(mesh.vertices) + k``. The
        surface is the same set of points, and stays closed and oriented as it was.

    Raises
    ------
    MeshError
        Not one mark for each edge.
    """
    if split.shape != (len(edges.ends),):
        raise MeshError(f"{len(edges.ends)} edges have marks of shape {split.shape}; give one for each")
    middle = np.full(len(edges.ends), -1, dtype=np.int64)
    middle[split] = len(mesh.vertices) + np.arange(int(split.sum()))
    ends = edges.ends[split]
    vertices = np.vstack([mesh.vertices, 0.5 * (mesh.vertices[ends[:, 0]] + mesh.vertices[ends[:, 1]])])
    return TriMesh(vertices, _split_faces(mesh.faces, middle[edges.of_face], vertices))


def with_short_edges(mesh: TriMesh, *, longest_mm: float | EdgeLengths) -> TriMesh:
    """The same surface with every edge longer than ``longest_mm``, at its middle, halved until none is."""
    return with_halved_edges(mesh, longest_mm=longest_mm)[0]


def with_halved_edges(mesh: TriMesh, *, longest_mm: float | EdgeLengths) -> tuple[TriMesh, tuple[Int, ...]]:
    """`with_short_edges`, and what its new vertices lie between.

    Returns
    -------
    TriMesh
    tuple of (m, 2) int64
        For each round of halving the numbers of the vertices in whose middle the new ones lie, in order.
    """
    lengths = longest_mm if isinstance(longest_mm, EdgeLengths) else EdgeLengths.even(longest_mm)
    rounds: list[Int] = []
    while True:
        edges = FaceEdges.of(mesh.faces)
        ends = mesh.vertices[edges.ends]
        long = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > lengths.near_mm
        long[long] = np.linalg.norm(ends[long, 1] - ends[long, 0], axis=1) > lengths.at(ends[long].mean(axis=1))
        if not long.any():
            return mesh, tuple(rounds)
        rounds.append(edges.ends[long])
        mesh = split_edges(mesh, edges, long)


def _split_faces(faces: Faces, middles: Int, vertices: Points) -> Faces:
    """Faces with the middles (f, 3) of their split edges (-1: whole) put in."""
    count = (middles >= 0).sum(axis=1)
    parts = [faces[count == 0]]
    # Turn each face so that its pattern of split edges starts at edge 0.
    one, m1 = _turned(faces, middles, count == 1, first=lambda m: m.argmax(axis=1))
    a, b, c = one.T
    p = m1[:, 0]
    parts += [np.column_stack([a, p, c]), np.column_stack([p, b, c])]
    two, m2 = _turned(faces, middles, count == 2, first=lambda m: (m.argmin(axis=1) + 1) % 3)
    a, b, c = two.T
    p, q = m2[:, 0], m2[:, 1]
    parts.append(np.column_stack([p, b, q]))
    short = np.linalg.norm(vertices[p] - vertices[c], axis=1) < np.linalg.norm(vertices[a] - vertices[q], axis=1)
    across = np.where(short[:, None], np.column_stack([a, p, c]), np.column_stack([a, p, q]))
    other = np.where(short[:, None], np.column_stack([p, q, c]), np.column_stack([a, q, c]))
    parts += [across, other]
    a, b, c = faces[count == 3].T
    p, q, r = middles[count == 3].T
    parts += [np.column_stack(t) for t in ((a, p, r), (p, b, q), (r, q, c), (p, q, r))]
    return np.concatenate(parts)


def _turned(faces: Faces, middles: Int, which: Bool, *, first: Callable[[Int], Int]) -> tuple[Faces, Int]:
    start = first(middles[which])
    order = (start[:, None] + np.arange(3)) % 3
    return np.take_along_axis(faces[which], order, axis=1), np.take_along_axis(middles[which], order, axis=1)
