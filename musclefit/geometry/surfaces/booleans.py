"""Unions and differences of closed surfaces, with a clearance and without the slivers they leave; knows no tissue."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import manifold3d
import numpy as np

from musclefit.errors import MeshError
from musclefit.geometry.arrays import Float, Int, Points
from musclefit.geometry.measures import area_vectors
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.crossings import self_crossings

LEAST_COSINE = 0.3
"""Cosine between a vertex's direction of growth and a face's normal that is still made up for by going farther."""

SHRINKS = 8
"""How often growth is halved where it makes triangles cross, before it is left out there."""

PAD_SMOOTH = 0.1
"""How far the surface around padded triangles may move for the slivers of their union to go, in distances."""

_GOLDEN = 0.5 * (1.0 + 5.0**0.5)
_CORNERS = np.array(
    [np.roll([0.0, one, other], axis) for axis in range(3) for one in (-1.0, 1.0) for other in (-_GOLDEN, _GOLDEN)]
)
AROUND = _CORNERS * (3.0**0.5 / _GOLDEN**2)
"""(12, 3) corners of an icosahedron around the unit ball."""


def united(parts: Sequence[TriMesh], *, smooth_within_mm: float) -> TriMesh:
    """The union of closed, outward oriented surfaces.

    Parameters
    ----------
    parts : sequence of TriMesh
    smooth_within_mm : float
        Vertices that the result can do without are taken out where no place moves farther than this.

    Raises
    ------
    MeshError
        A part is not a closed oriented 2-manifold.
    """
    solids = [as_manifold(part) for part in parts]
    return as_mesh(manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add).simplify(smooth_within_mm))


def with_balls(mesh: TriMesh, centres: Points, *, radius_mm: float) -> TriMesh:
    """The union of a closed, outward oriented surface and balls, for which icosahedra inside of them stand.

    Parameters
    ----------
    mesh : TriMesh
    centres : (n, 3) float64, mm
    radius_mm : float

    Returns
    -------
    TriMesh
        Away from the balls its triangles are those of the surface as given.

    Raises
    ------
    MeshError
        The surface is not a closed oriented 2-manifold.
    """
    inside = _CORNERS / np.linalg.norm(_CORNERS[0])
    balls = [manifold3d.Manifold.hull_points(np.ascontiguousarray(at + radius_mm * inside)) for at in centres]
    return as_mesh(manifold3d.Manifold.batch_boolean([as_manifold(mesh), *balls], manifold3d.OpType.Add))


def difference(whole: TriMesh, tools: Sequence[TriMesh], *, smooth_within_mm: float) -> TriMesh:
    """What is left of a closed surface's inside without that of the tools; see `united`."""
    solids = [as_manifold(whole), *(as_manifold(tool) for tool in tools)]
    left = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Subtract)
    return as_mesh(left.simplify(smooth_within_mm))


def shared(a: TriMesh, b: TriMesh) -> TriMesh:
    """The surface of what the insides of two closed surfaces share; without triangles where they share nothing."""
    return as_mesh(as_manifold(a) ^ as_manifold(b))


def grown_by(mesh: TriMesh, *, distance_mm: float) -> TriMesh:
    """A surface with each vertex moved outwards so that the planes of its faces move by about the distance.

    Each vertex goes along the mean of its faces' normals, farther where that is oblique to one of them. Meant for
    distances far below the lengths of the edges; at a sharp corner or a crease the planes move by less, and where
    triangles would come to cross each other, vertices move by less or stay.
    """
    unit = area_vectors(mesh)
    unit = unit / np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-300)
    normals = vertex_normals(mesh)
    cosine = np.ones(len(mesh.vertices))
    np.minimum.at(cosine, mesh.faces.ravel(), np.einsum("fi,fki->fk", unit, normals[mesh.faces]).ravel())
    steps = normals * (distance_mm / np.maximum(cosine, LEAST_COSINE))[:, None]
    share = np.ones((len(mesh.vertices), 1))
    for shrinks in range(SHRINKS + 1):
        grown = mesh.with_vertices(mesh.vertices + share * steps)
        found = self_crossings(grown)
        if not len(found):
            return grown
        share[np.unique(mesh.faces[found.pairs.ravel()])] *= 0.5 if shrinks < SHRINKS - 1 else 0.0
    return mesh


def padded(mesh: TriMesh, faces: Int, *, distance_mm: float) -> TriMesh:
    """A closed surface that keeps the distance from some triangles on all sides: their hulls grown, united.

    Parameters
    ----------
    mesh : TriMesh
    faces : (k,) int64
    distance_mm : float
        Kept everywhere; exceeded by at most half, at the corners of the icosahedra that stand for balls.
    """
    around = mesh.corners()[faces][:, :, None, :] + (1.0 + PAD_SMOOTH) * distance_mm * AROUND
    hulls = [manifold3d.Manifold.hull_points(np.ascontiguousarray(points.reshape(-1, 3))) for points in around]
    whole = manifold3d.Manifold.batch_boolean(hulls, manifold3d.OpType.Add)
    return as_mesh(whole.simplify(PAD_SMOOTH * distance_mm))


def vertex_normals(mesh: TriMesh) -> Points:
    """(n, 3) unit normals of the vertices, faces weighted by their angle there; 0 where no face is."""
    corners = mesh.corners()
    unit = area_vectors(mesh)
    unit = unit / np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-300)
    sums = np.zeros_like(mesh.vertices)
    for k in range(3):
        u, v = corners[:, (k + 1) % 3] - corners[:, k], corners[:, (k + 2) % 3] - corners[:, k]
        angle = np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), np.einsum("fi,fi->f", u, v))
        np.add.at(sums, mesh.faces[:, k], unit * angle[:, None])
    lengths: Float = np.linalg.norm(sums, axis=1, keepdims=True)
    return sums / np.maximum(lengths, 1e-300)


def as_manifold(mesh: TriMesh) -> Any:
    """The surface as manifold3d's own, in double precision.

    Raises
    ------
    MeshError
        It is not a closed oriented 2-manifold.
    """
    vertices = np.array(mesh.vertices, dtype=np.float64, order="C")
    manifold = manifold3d.Manifold(manifold3d.Mesh64(vertices, np.array(mesh.faces, dtype=np.uint64, order="C")))
    if manifold.status() != manifold3d.Error.NoError:
        raise MeshError(
            f"a surface of {len(mesh.faces)} triangles is not a closed oriented 2-manifold ({manifold.status().name}); "
            "repair it before it is cut or united"
        )
    return manifold


def as_mesh(manifold: Any) -> TriMesh:
    """A manifold3d surface as a mesh; vertices that it holds apart for their properties are one."""
    mesh = manifold.to_mesh64()
    vertices = np.array(np.asarray(mesh.vert_properties)[:, :3], dtype=np.float64)
    faces = np.array(np.asarray(mesh.tri_verts), dtype=np.int64).reshape(-1, 3)
    merged = np.arange(len(vertices))
    merged[np.asarray(mesh.merge_from_vert, dtype=np.int64)] = np.asarray(mesh.merge_to_vert, dtype=np.int64)
    return TriMesh(vertices, merged[faces])
