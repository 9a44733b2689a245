"""Volumes, areas and normals of meshes, and distances from their boxes."""

from __future__ import annotations

import numpy as np

from musclefit.geometry.arrays import Float, Points, Tets
from musclefit.geometry.meshes import TriMesh


def enclosed_volume(mesh: TriMesh) -> float:
    r"""Signed volume enclosed by a closed surface, mm³; negative when it is inside-out.

    .. math:: V = \tfrac{1}{6} \sum_f v_0 \cdot (v_1 \times v_2)

    evaluated about the centroid of the vertices, so that a mesh far from the origin loses no digits.
    """
    corners = mesh.corners() - mesh.vertices.mean(axis=0)
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0)


def volume_change_percent(before: TriMesh, after: TriMesh) -> float:
    """By how much of the volume at first another one differs, percent; the first encloses a volume."""
    volume = enclosed_volume(before)
    return 100.0 * (enclosed_volume(after) - volume) / volume


def area_vectors(mesh: TriMesh) -> Float:
    """(f, 3) outward normals whose lengths are the triangles' areas, mm²."""
    corners = mesh.corners()
    cross: Float = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * cross


def signed_volumes(vertices: Points, tets: Tets) -> Float:
    r"""Signed volume of each tetrahedron, positive when right-handed.

    .. math:: V = \tfrac{1}{6} \det [v_1 - v_0,\; v_2 - v_0,\; v_3 - v_0]

    Parameters
    ----------
    vertices : (n, 3) float64, mm
    tets : (k, 4) int64

    Returns
    -------
    (k,) float64, mm³
        Rounding makes the sign unreliable near zero; an exact predicate is needed to prove it.
    """
    first = vertices[tets[:, 0]]
    a, b, c = (vertices[tets[:, k]] - first for k in (1, 2, 3))
    volumes: Float = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    return volumes


def distances_from_box(points: Points, inside: Points) -> Float:
    """(N,) distances of (N, n) points from the axis-aligned box around others, mm; 0 where they are in it."""
    low, high = inside.min(axis=0), inside.max(axis=0)
    distances: Float = np.linalg.norm(np.maximum(0.0, np.maximum(low - points, points - high)), axis=1)
    return distances
