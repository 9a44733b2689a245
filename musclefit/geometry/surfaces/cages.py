"""A coarse cage from a closed surface: even triangles, as many vertices as asked for, and none that cross.

Edges are collapsed: first the shortest, which gives even triangles, then those whose loss changes the shape least, so
that thin limbs keep their vertices; no collapse is made after which triangles would cross. The vertices are then evened
out on the surface and moved outwards until the cage encloses as much as the surface; a move that would make triangles
cross is taken back.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import igl
import numpy as np

from musclefit.errors import InputError, MeshError
from musclefit.geometry.arrays import Bool, Float, Points
from musclefit.geometry.measures import area_vectors, enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.geometry.surfaces.topology import edges_of, repeats_a_vertex

FEWEST_VERTICES = 20
"""Of a cage: fewer follow no body."""

EVEN_STAGE = 4
"""The shortest edges are collapsed down to this many times the vertices, then the least important ones."""

ROUNDS = 3
"""Times that the vertices are evened out: few, since each takes vertices away from tips."""

EVENED_SHARE = 0.3
"""How far a vertex goes to the middle of its neighbours in one round."""

VOLUME_ROUNDS = 6
"""Newton steps towards the volume of the surface."""


def cage_of(surface: TriMesh, *, vertices: int) -> TriMesh:
    """Make a cage that follows a closed surface.

    Parameters
    ----------
    surface : TriMesh
        Closed, every edge at two faces, outward, and not crossing itself.
    vertices : int
        How many the cage has, from ``FEWEST_VERTICES`` to those of the surface.

    Returns
    -------
    TriMesh
        Closed, every edge at two faces, without crossing triangles, and of the surface's topology; it neither encloses
        the surface nor lies in it, but encloses nearly the same volume.

    Raises
    ------
    InputError
        A number of vertices out of range.
    MeshError
        A surface that is open, that crosses itself, or that cannot be made so coarse without crossings.
    """
    if not FEWEST_VERTICES <= vertices <= len(surface.vertices):
        raise InputError(
            f"a cage of {vertices} vertices is asked for; give from {FEWEST_VERTICES} to {len(surface.vertices)}, "
            "those of the surface"
        )
    _require_sound(surface, what="the surface")
    characteristic = len(np.unique(surface.faces)) - len(edges_of(surface.faces).ends) + len(surface.faces)
    cage = surface
    for collapse, count in ((igl.decimate, EVEN_STAGE * vertices), (igl.qslim, vertices)):
        if count < len(cage.vertices):
            cage = _collapsed(cage, collapse, n_faces=2 * (count - characteristic))
    if len(cage.vertices) > vertices:
        raise MeshError(
            f"edges can be collapsed down to {len(cage.vertices)} vertices only before triangles would cross; ask for "
            f"{len(cage.vertices)} or more"
        )
    for _ in range(ROUNDS):
        cage = _moved_without_crossing(cage, _evened(cage, surface))
    wanted = enclosed_volume(surface)
    for _ in range(VOLUME_ROUNDS):
        cage = _moved_without_crossing(cage, _inflated(cage, wanted))
    _require_sound(cage, what="the cage")
    return cage


def _collapsed(mesh: TriMesh, collapse: Callable[..., Any], *, n_faces: int) -> TriMesh:
    vertices, faces, *_ = collapse(
        np.asfortranarray(mesh.vertices),
        np.asfortranarray(mesh.faces.astype(np.int32)),
        n_faces,
        block_intersections=True,
    )
    return TriMesh(np.array(vertices), np.array(faces, dtype=np.int64))


def _evened(cage: TriMesh, surface: TriMesh) -> Points:
    """Vertices on their way to the middle of their neighbours, taken back onto the surface."""
    ends = edges_of(cage.faces).ends
    sums, counts = np.zeros_like(cage.vertices), np.zeros(len(cage.vertices))
    for a, b in (ends.T, ends.T[::-1]):
        np.add.at(sums, a, cage.vertices[b])
        np.add.at(counts, a, 1.0)
    middles = sums / counts[:, None]
    normals = _normals(cage)
    along = middles - cage.vertices
    along -= np.einsum("vi,vi->v", along, normals)[:, None] * normals
    return nearest_places(cage.vertices + EVENED_SHARE * along, surface).places


def _inflated(cage: TriMesh, wanted: float) -> Points:
    """Vertices moved along their normals by one length, so that the volume comes to what is wanted."""
    area = float(np.linalg.norm(area_vectors(cage), axis=1).sum())
    moved: Points = cage.vertices + (wanted - enclosed_volume(cage)) / area * _normals(cage)
    return moved


def _moved_without_crossing(cage: TriMesh, target: Points) -> TriMesh:
    """The cage with as many vertices at their targets as can be without crossings; the others stay."""
    stays = np.zeros(len(cage.vertices), dtype=bool)
    while not stays.all():
        moved = cage.with_vertices(np.where(stays[:, None], cage.vertices, target))
        blocked = _crossing_or_turned(cage, moved)
        if not blocked.any():
            return moved
        more = np.unique(cage.faces[blocked])
        if stays[more].all():
            # what stays blocks what moves: its neighbours stay too
            more = np.unique(cage.faces[np.isin(cage.faces, more).any(axis=1)])
            if stays[more].all():
                return cage
        stays[more] = True
    return cage


def _crossing_or_turned(before: TriMesh, after: TriMesh) -> Bool:
    """(f,) triangles that cross another, or that have turned by more than a right angle."""
    turned: Bool = np.einsum("fi,fi->f", area_vectors(before), area_vectors(after)) <= 0.0
    turned[self_crossings(after).pairs.ravel()] = True
    return turned


def _normals(mesh: TriMesh) -> Float:
    """(n, 3) unit normals at the vertices, weighted by area."""
    sums = np.zeros_like(mesh.vertices)
    for corner in mesh.faces.T:
        np.add.at(sums, corner, area_vectors(mesh))
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    normals: Float = sums / np.where(lengths > 0.0, lengths, 1.0)
    return normals


def _require_sound(mesh: TriMesh, *, what: str) -> None:
    """Raise MeshError where a mesh is open, not manifold, inside out, or crosses itself."""
    edges = edges_of(mesh.faces[~repeats_a_vertex(mesh.faces)])
    if len(edges.odd) or len(edges.non_manifold) or len(edges.unbalanced):
        raise MeshError(
            f"{what} is not a closed surface with two faces at each edge: {len(edges.boundary)} boundary edges, "
            f"{len(edges.non_manifold)} with more than two faces; repair it with musclefit repair IN OUT"
        )
    if enclosed_volume(mesh) <= 0.0:
        raise MeshError(f"{what} is inside out; reverse its triangles")
    crossings = self_crossings(mesh)
    if len(crossings):
        named = "; ".join(
            f"{a} and {b} near ({', '.join(f'{x:.5g}' for x in place)}) mm"
            for (a, b), place in zip(crossings.pairs[:8].tolist(), crossings.places, strict=False)
        )
        more = f"; and {len(crossings) - 8} more" if len(crossings) > 8 else ""
        raise MeshError(f"{what} crosses itself at {len(crossings)} pairs of triangles: {named}{more}; repair it first")
