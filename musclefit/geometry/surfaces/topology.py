"""How triangles hang together: takes vertices and faces, gives edges, pieces and orientation; knows no tissue."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from musclefit.geometry.arrays import Bool, Faces, Int, Points
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh

_NEARLY_FLAT = 1e-10
"""Twice a triangle's area over its longest edge squared below which it is tested exactly for zero area, no unit."""


@dataclass(frozen=True, eq=False, slots=True)
class Merged:
    """Vertices without exact duplicates, in the order of first occurrence; ``kept_as (n,)`` maps old to new numbers."""

    vertices: Points
    faces: Faces
    kept_as: Int

    @property
    def removed(self) -> int:
        """How many vertices went."""
        return len(self.kept_as) - len(self.vertices)


def merge_duplicate_vertices(vertices: Points, faces: Faces) -> Merged:
    """Make vertices at exactly the same position one vertex.

    Parameters
    ----------
    vertices : (n, 3) float64, mm
    faces : (f, 3) int64

    Returns
    -------
    Merged
        0.0 and -0.0 are the same position; positions that differ in the last digit are not.
    """
    positions = vertices + 0.0
    order = np.lexsort(positions.T[::-1])
    starts = np.ones(len(order), dtype=bool)
    starts[1:] = (positions[order[1:]] != positions[order[:-1]]).any(axis=1)
    group = np.empty(len(order), dtype=np.int64)
    group[order] = np.cumsum(starts) - 1
    first = np.full(int(starts.sum()), len(order), dtype=np.int64)
    np.minimum.at(first, group, np.arange(len(order)))
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    kept_as = rank[group]
    return Merged(vertices[np.sort(first)], kept_as[faces], kept_as)


@dataclass(frozen=True, eq=False, slots=True)
class Edges:
    """The edges of a triangle surface.

    Parameters
    ----------
    ends : (e, 2) int64, smaller vertex number first
    faces_at : (e,) int64
        How many faces stand at each edge.
    excess : (e,) int64
        How many of them run through the edge from the smaller number to the larger, less those that run back.
    of_face : (f, 3) int64
        The edge from corner 0 to 1, 1 to 2, 2 to 0 of each face.
    """

    ends: Int
    faces_at: Int
    excess: Int
    of_face: Int

    @property
    def boundary(self) -> Int:
        """(b, 2) edges of a single face: the rims of holes."""
        found: Int = self.ends[self.faces_at == 1]
        return found

    @property
    def odd(self) -> Int:
        """(o, 2) edges with an odd number of faces; none exactly when the surface is closed."""
        found: Int = self.ends[self.faces_at % 2 == 1]
        return found

    @property
    def non_manifold(self) -> Int:
        """(m, 2) edges with more than two faces."""
        found: Int = self.ends[self.faces_at > 2]
        return found

    @property
    def unbalanced(self) -> Int:
        """(u, 2) edges that are run through more often one way than the other; none when closed and well oriented."""
        found: Int = self.ends[self.excess != 0]
        return found


def edges_of(faces: Faces) -> Edges:
    """Every edge of (f, 3) faces once, sorted; faces that repeat a vertex must have been left out."""
    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    low, high = directed.min(axis=1), directed.max(axis=1)
    span = int(faces.max()) + 1 if faces.size else 1
    keys, of_face, faces_at = np.unique(low * span + high, return_inverse=True, return_counts=True)
    excess = np.zeros(len(keys), dtype=np.int64)
    np.add.at(excess, of_face, np.where(directed[:, 0] == low, 1, -1))
    return Edges(
        np.stack([keys // span, keys % span], axis=1), faces_at.astype(np.int64), excess, of_face.reshape(-1, 3)
    )


def chains(edges: Int) -> list[Int]:
    """Groups of (e, 2) edges that hang together: of boundary edges, the holes; each (k, 2), largest first."""
    if not len(edges):
        return []
    numbers, local = np.unique(edges, return_inverse=True)
    local = local.reshape(-1, 2)
    labels = _labels(local[:, 0], local[:, 1], len(numbers))[local[:, 0]]
    groups = [edges[labels == label] for label in np.unique(labels)]
    return sorted(groups, key=len, reverse=True)


def face_components(faces: Faces) -> Int:
    """(f,) number of the piece of each face; pieces share no edge, and are numbered by their first face."""
    edges = edges_of(faces)
    return _components(edges, np.ones(len(edges.ends), dtype=bool))


def closed_components(faces: Faces) -> Int:
    """(f,) as `face_components`, but closed bodies that only meet at edges of more than two faces are apart."""
    edges = edges_of(faces)
    joined = _components(edges, np.ones(len(edges.ends), dtype=bool))
    if not len(edges.non_manifold):
        return joined
    apart = _components(edges, edges.faces_at == 2)
    whole = {piece: not len(edges_of(faces[apart == piece]).odd) for piece in np.unique(apart)}
    can_part = np.ones(joined.max() + 1, dtype=bool)
    np.logical_and.at(can_part, joined, np.array([whole[piece] for piece in apart]))
    return _by_first_occurrence(np.where(can_part[joined], apart, len(faces) + joined))


def _components(edges: Edges, joining: Bool) -> Int:
    """(f,) pieces when only the edges under ``joining (e,)`` hold faces together."""
    n_faces = len(edges.of_face)
    faces, numbers = np.repeat(np.arange(n_faces), 3), edges.of_face.ravel()
    kept = joining[numbers]
    return _by_first_occurrence(_labels(faces[kept], n_faces + numbers[kept], n_faces + len(edges.ends))[:n_faces])


def _labels(a: Int, b: Int, n_nodes: int) -> Int:
    graph = coo_array((np.ones(len(a), dtype=np.int8), (a, b)), shape=(n_nodes, n_nodes))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _by_first_occurrence(labels: Int) -> Int:
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    numbers: Int = rank[inverse]
    return numbers


@dataclass(frozen=True, eq=False, slots=True)
class Orientation:
    """Which faces to turn so that neighbours agree.

    Parameters
    ----------
    faces : (f, 3) int64, turned where ``turned``
    turned : (f,) bool
        The smaller part of each piece; all False where the faces agreed already.
    one_sided : (f,) bool
        True for the faces of pieces that cannot be oriented, such as a Möbius band; these are left as they are.
    """

    faces: Faces
    turned: Bool
    one_sided: Bool


def consistent_orientation(faces: Faces) -> Orientation:
    """Turn as few faces as possible so that both faces of every two-faced edge run through it in opposite ways.

    Pieces are oriented one by one, so an inside-out piece stays inside-out. Edges with more than two faces tie nothing.
    """
    edges = edges_of(faces)
    n_faces = len(faces)
    order = np.argsort(edges.of_face.ravel(), kind="stable")
    starts = np.cumsum(edges.faces_at) - edges.faces_at
    two_faced = starts[edges.faces_at == 2]
    a, b = order[two_faced] // 3, order[two_faced + 1] // 3
    agree = edges.excess[edges.faces_at == 2] == 0
    # each face has two nodes, as it is and turned; agreeing neighbours join like to like, the others like to unlike
    to_same, to_other = np.where(agree, b, b + n_faces), np.where(agree, b + n_faces, b)
    labels = _labels(np.concatenate([a, a + n_faces]), np.concatenate([to_same, to_other]), 2 * n_faces)
    as_it_is, as_turned = labels[:n_faces], labels[n_faces:]
    one_sided = as_it_is == as_turned
    piece = np.minimum(as_it_is, as_turned)
    second_state = (as_it_is > as_turned) & ~one_sided
    sizes = np.bincount(piece, minlength=2 * n_faces)
    in_second = np.bincount(piece[second_state], minlength=2 * n_faces)
    first_is_most = (2 * in_second <= sizes)[piece]
    turned = np.where(first_is_most, second_state, ~second_state) & ~one_sided
    return Orientation(turn(faces, turned), turned, one_sided)


def turn(faces: Faces, which: Bool) -> Faces:
    """The same (f, 3) faces with those under ``which (f,)`` run through the other way."""
    turned = faces.copy()
    turned[which] = faces[which][:, ::-1]
    return turned


def repeats_a_vertex(faces: Faces) -> Bool:
    """(f,) True for faces that use a vertex number twice."""
    repeated: Bool = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return repeated


def repeats_a_face(faces: Faces) -> Bool:
    """(f,) True for faces whose three vertices, run through the same way, an earlier face has already."""
    if not len(faces):
        return np.zeros(0, dtype=bool)
    first_corner = np.argmin(faces, axis=1)
    rolled = np.stack([faces[np.arange(len(faces)), (first_corner + k) % 3] for k in range(3)], axis=1)
    _, first = np.unique(rolled, axis=0, return_index=True)
    repeated = np.ones(len(faces), dtype=bool)
    repeated[first] = False
    return repeated


def has_no_area(mesh: TriMesh) -> Bool:
    """(f,) True for triangles whose corners lie exactly on one line, by exact predicates."""
    corners = mesh.corners()
    sides = corners - np.roll(corners, 1, axis=1)
    longest = np.einsum("fik,fik->fi", sides, sides).max(axis=1)
    twice_area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    flat: Bool = twice_area <= _NEARLY_FLAT * longest
    for face in np.flatnonzero(flat):
        shadows = (np.ascontiguousarray(corners[face][:, axes]) for axes in ([0, 1], [1, 2], [2, 0]))
        flat[face] = all(igl.predicates.orient2d(*shadow) == igl.predicates.COLLINEAR for shadow in shadows)
    return flat


@dataclass(frozen=True, eq=False, slots=True)
class Pieces:
    """The pieces of a closed surface and how they are nested.

    Parameters
    ----------
    of_face : (f,) int64
        The piece of each face.
    volumes : (p,) float64, mm³
        Signed volume of each piece, negative when inside-out.
    depth : (p,) int64
        How many other pieces each lies in; 0 for the outermost.
    outermost : (p,) int64
        The outermost piece around each, or itself.
    """

    of_face: Int
    volumes: Points
    depth: Int
    outermost: Int


def nested_pieces(mesh: TriMesh) -> Pieces:
    """Find the pieces of a closed, consistently oriented surface, and which lies in which.

    One vertex of a piece stands for the whole of it: for pieces that cross each other the answer is that vertex's.
    """
    of_face = closed_components(mesh.faces)
    count = int(of_face.max(initial=-1)) + 1
    faces = [mesh.faces[of_face == piece] for piece in range(count)]
    volumes = np.array([enclosed_volume(_compact(mesh.vertices, own)) for own in faces])
    low = np.array([mesh.vertices[own].min(axis=(0, 1)) for own in faces])
    high = np.array([mesh.vertices[own].max(axis=(0, 1)) for own in faces])
    inside = np.zeros((count, count), dtype=bool)
    for outer in range(count if count > 1 else 0):
        near = ((low >= low[outer]) & (high <= high[outer])).all(axis=1)
        near[outer] = False
        candidates = np.flatnonzero(near)
        if candidates.size:
            probes = np.ascontiguousarray(mesh.vertices[[faces[c][0, 0] for c in candidates]])
            shell = _compact(mesh.vertices, faces[outer])
            around = igl.winding_number(shell.vertices, shell.faces, probes)
            inside[candidates, outer] = np.abs(around) > 0.5
    depth = inside.sum(axis=1)
    outermost = np.arange(count)
    for piece in np.flatnonzero(depth):
        around = np.flatnonzero(inside[piece])
        outermost[piece] = around[np.argmin(depth[around])]
    return Pieces(of_face, volumes, depth.astype(np.int64), outermost)


def _compact(vertices: Points, faces: Faces) -> TriMesh:
    used, local = np.unique(faces, return_inverse=True)
    return TriMesh(vertices[used], local.reshape(-1, 3))
