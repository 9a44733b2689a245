"""Takes out what crosses, touches or is flat in a closed surface, and closes what that opens; knows no tissue."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array

from musclefit.geometry.arrays import Bool, Faces, Float, Int, Points
from musclefit.geometry.measures import area_vectors
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.geometry.surfaces.faults import coincident_groups, non_manifold_vertices
from musclefit.geometry.surfaces.holes import filled_holes
from musclefit.geometry.surfaces.patches import cut_at_non_manifold_vertices
from musclefit.geometry.surfaces.topology import edges_of, face_components, has_no_area, repeats_a_vertex

PART_MM = 0.01
"""How far vertices that coincide are moved from each other at most, mm."""

ATTEMPTS = 12
"""How often crossing triangles are taken out; the surroundings that go with them grow."""

RELAXATIONS = 15
"""How often the corners of crossing triangles are moved before triangles are taken out."""


@dataclass(frozen=True, eq=False, slots=True)
class Uncrossed:
    """A surface and what it took.

    Parameters
    ----------
    mesh : TriMesh
    pairs : int
        Crossing pairs of triangles that there were.
    removed, filled : int
        Triangles taken out and put in.
    left : int
        Crossing pairs that are still there.
    """

    mesh: TriMesh
    pairs: int
    removed: int
    filled: int
    left: int


def uncrossed(mesh: TriMesh) -> Uncrossed:
    """Take out the triangles that cross and fill the hole, with more of their surroundings each time that fails.

    Parameters
    ----------
    mesh : TriMesh
        Closed and consistently oriented.

    Returns
    -------
    Uncrossed
        Closed where ``left`` is 0; vertices away from the crossings stay where they are.

    References
    ----------
    M. Attene, A lightweight approach to repairing digitized polygon meshes, Vis. Comput. 26 (2010) 1393.
    """
    found = self_crossings(mesh)
    pairs, removed, filled = len(found), 0, 0
    for attempt in range(ATTEMPTS):
        if not len(found) and not len(edges_of(mesh.faces).odd):
            break
        bad = np.zeros(len(mesh.faces), dtype=bool)
        bad[found.pairs.ravel()] = True
        bad = grown(mesh.faces, bad, rings=attempt // 2)
        bad |= _islands(mesh, bad)
        if bad.all():
            break
        opened = cut_at_non_manifold_vertices(compacted(TriMesh(mesh.vertices, mesh.faces[~bad]))).mesh
        closed = with_holes_filled(opened)
        removed += int(bad.sum())
        filled += len(closed.faces) - len(opened.faces)
        mesh = parted(without_flat_faces(closed))
        found = self_crossings(mesh)
    left = len(found) + len(edges_of(mesh.faces).odd)
    return Uncrossed(mesh, pairs, removed, filled, left)


def relaxed(mesh: TriMesh, *, most_mm: float) -> TriMesh:
    """Move the corners of crossing triangles towards their neighbours' middles, a little at a time.

    Parameters
    ----------
    mesh : TriMesh
        Closed.
    most_mm : float
        How far a vertex may get from where it was.

    Returns
    -------
    TriMesh
        The state with the fewest crossings; the given one where none had fewer.
    """
    moved = best = mesh
    fewest: float = np.inf
    for _ in range(RELAXATIONS):
        found = self_crossings(moved)
        if len(found) < fewest:
            best, fewest = moved, len(found)
        if not len(found):
            break
        at = np.unique(moved.faces[found.pairs.ravel()])
        to = moved.vertices.copy()
        to[at] += 0.3 * (_middles_of_neighbours(moved)[at] - moved.vertices[at])
        away = to[at] - mesh.vertices[at]
        far = np.linalg.norm(away, axis=1, keepdims=True)
        to[at] = mesh.vertices[at] + away * np.minimum(1.0, most_mm / np.maximum(far, 1e-300))
        moved = moved.with_vertices(to)
    return best


def with_holes_filled(mesh: TriMesh) -> TriMesh:
    """The surface with a patch over each hole; see `holes.filled_holes`."""
    holes = filled_holes(mesh.vertices, mesh.faces)
    return TriMesh(mesh.vertices, np.concatenate([mesh.faces, *(hole.patch for hole in holes)])) if holes else mesh


def grown(faces: Faces, chosen: Bool, *, rings: int) -> Bool:
    """(f,) the chosen faces and those that share a vertex with them, ``rings`` times over."""
    for _ in range(rings):
        at = np.zeros(int(faces.max(initial=0)) + 1, dtype=bool)
        at[faces[chosen]] = True
        chosen = np.asarray(at[faces].any(axis=1), dtype=bool)
    return chosen


def _islands(mesh: TriMesh, gone: Bool) -> Bool:
    """(f,) faces of pieces that the removal cut off from most of their piece: below a tenth of its area."""
    areas = np.linalg.norm(area_vectors(mesh), axis=1)
    before = face_components(mesh.faces)
    kept = np.flatnonzero(~gone)
    island = np.zeros(len(mesh.faces), dtype=bool)
    if not kept.size:
        return island
    after = face_components(mesh.faces[kept])
    whole = np.bincount(before, weights=areas)
    part = np.bincount(after, weights=areas[kept])
    island[kept] = part[after] < 0.1 * whole[before[kept]]
    return island


def without_flat_faces(mesh: TriMesh) -> TriMesh:
    """Flip the longest edge of each face without area, or take its middle corner into an end; closed stays closed."""
    for _ in range(20):
        flat = np.flatnonzero(has_no_area(mesh))
        if not len(flat):
            return mesh
        mesh = _one_pass(mesh, flat)
    return mesh


def _one_pass(mesh: TriMesh, flat: Int) -> TriMesh:
    faces = mesh.faces.copy()
    edges = edges_of(faces)
    order = np.argsort(edges.of_face.ravel(), kind="stable")
    starts = np.cumsum(edges.faces_at) - edges.faces_at
    known = {(int(a), int(b)) for a, b in edges.ends}
    touched = np.zeros(len(faces), dtype=bool)
    merged = np.arange(len(mesh.vertices))
    for face in flat:
        if touched[face]:
            continue
        corners = mesh.vertices[faces[face]]
        lengths = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        k = int(lengths.argmax())
        a, b, m = (int(faces[face][(k + i) % 3]) for i in range(3))
        edge = edges.of_face[face, k]
        around = order[starts[edge] : starts[edge] + edges.faces_at[edge]] // 3
        other = [int(f) for f in around if f != face]
        c = int(faces[other[0]].sum() - a - b) if len(other) == 1 else -1
        if c >= 0 and c != m and (min(m, c), max(m, c)) not in known and not touched[other[0]] and lengths.min() > 0:
            faces[face], faces[other[0]] = (a, c, m), (c, b, m)
            known.add((min(m, c), max(m, c)))
            touched[[face, other[0]]] = True
        else:
            ends = (a, b) if lengths[(k + 2) % 3] <= lengths[(k + 1) % 3] else (b, a)
            near = np.flatnonzero(np.isin(faces, [m, *ends]).any(axis=1))
            if not touched[near].any():
                merged[m] = ends[0]
                touched[near] = True
    faces = merged[faces]
    return compacted(TriMesh(mesh.vertices, _without_folded(faces[~repeats_a_vertex(faces)])))


def _without_folded(faces: Faces) -> Faces:
    """The faces less pairs of opposite ones on the same three vertices."""
    low = np.sort(faces, axis=1)
    _, group, count = np.unique(low, axis=0, return_inverse=True, return_counts=True)
    kept: Faces = faces[count[group.ravel()] != 2]
    return kept


def parted(mesh: TriMesh) -> TriMesh:
    """The surface cut where it is not manifold, and each vertex on another one moved towards its neighbours.

    By at most ``PART_MM`` and a tenth of the way to the middle of its neighbours.
    """
    mesh = cut_at_non_manifold_vertices(mesh).mesh if len(non_manifold_vertices(mesh.faces)) or _crowded(mesh) else mesh
    used = np.unique(mesh.faces)
    group = coincident_groups(mesh.vertices[used])
    several = used[np.bincount(group)[group] > 1]
    if not several.size:
        return mesh
    towards = (_middles_of_neighbours(mesh) - mesh.vertices)[several]
    lengths = np.linalg.norm(towards, axis=1, keepdims=True)
    moved = mesh.vertices.copy()
    moved[several] += towards * np.minimum(0.1, PART_MM / np.maximum(lengths, 1e-300))
    return mesh.with_vertices(moved)


def touching_vertices(mesh: TriMesh) -> int:
    """How many vertices of a surface stand exactly on another one."""
    used = np.unique(mesh.faces)
    return len(used) - len(np.unique(coincident_groups(mesh.vertices[used])))


def _crowded(mesh: TriMesh) -> bool:
    return bool(len(edges_of(mesh.faces).non_manifold))


def _middles_of_neighbours(mesh: TriMesh) -> Points:
    ends = edges_of(mesh.faces).ends
    rows, columns = np.concatenate([ends[:, 0], ends[:, 1]]), np.concatenate([ends[:, 1], ends[:, 0]])
    n = len(mesh.vertices)
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(n, n)).tocsr()
    count = np.asarray(graph.sum(axis=1)).ravel()
    middles: Float = (graph @ mesh.vertices) / np.maximum(count, 1.0)[:, None]
    return middles


def compacted(mesh: TriMesh) -> TriMesh:
    """The surface without the vertices that no face uses."""
    used = np.unique(mesh.faces)
    if len(used) == len(mesh.vertices):
        return mesh
    return TriMesh(mesh.vertices[used], np.searchsorted(used, mesh.faces))
