"""Finds the triangles of a surface that come too close to another surface; knows no tissue and cuts nothing."""

from __future__ import annotations

from itertools import product

import numpy as np

from musclefit.geometry.arrays import Int, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.surfaces.crossings import crossings_between

_SIDES = np.array(list(product((0, 1), repeat=3)))
"""(8, 3) corners of a box: at the low or the high end along each of its axes."""
_QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
_BOX = np.concatenate([_QUADS[:, [0, 1, 2]], _QUADS[:, [0, 2, 3]]])
"""(12, 3) the box's triangles."""


def faces_near(mesh: TriMesh, other: TriMesh, *, within_mm: float) -> Int:
    """Faces that come closer to another surface than a distance, and some beside these.

    A face counts when the box along its longest edge and its plane, grown by the distance, crosses the other surface,
    by exact predicates.

    Parameters
    ----------
    mesh : TriMesh
    other : TriMesh
        Closed, and not wholly within the distance of one face.
    within_mm : float
    """
    faces = _candidates(mesh, other, within_mm)
    if not len(faces):
        return faces
    boxes = _boxes(mesh.corners()[faces], within_mm)
    joined = TriMesh(boxes.reshape(-1, 3), (8 * np.arange(len(faces))[:, None, None] + _BOX).reshape(-1, 3))
    near: Int = faces[np.unique(crossings_between(joined, other).pairs[:, 0] // len(_BOX))]
    return near


def _boxes(corners: Points, within_mm: float) -> Points:
    """(k, 8, 3) corners of boxes around triangles (k, 3, 3), which keep the distance on all sides."""
    edges = np.roll(corners, -1, axis=1) - corners
    longest = np.linalg.norm(edges, axis=2).argmax(axis=1)
    along = _unit(edges[np.arange(len(edges)), longest])
    across = np.cross(edges[:, 0], edges[:, 1])
    spare = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=1)])  # for triangles without area
    normal = _unit(np.where(np.linalg.norm(across, axis=1, keepdims=True) > 0.0, across, spare))
    normal = _unit(normal - np.einsum("ki,ki->k", normal, along)[:, None] * along)
    axes = np.stack([along, np.cross(normal, along), normal], axis=1)
    places = np.einsum("kai,kci->kca", axes, corners)
    ends = np.stack([places.min(axis=1) - within_mm, places.max(axis=1) + within_mm], axis=1)
    picked = ends[:, _SIDES, np.arange(3)]
    boxes: Points = np.einsum("kai,kba->kbi", axes, picked)
    return boxes


def _unit(vectors: Points) -> Points:
    unit: Points = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
    return unit


def _candidates(mesh: TriMesh, other: TriMesh, within_mm: float) -> Int:
    """Faces that cannot be told to be farther from the other surface by their boxes and their middles' distances."""
    corners = mesh.corners()
    low, high = other.vertices.min(axis=0) - within_mm, other.vertices.max(axis=0) + within_mm
    faces = np.flatnonzero(((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)).all(axis=1))
    if not len(faces):
        return faces
    middles = corners[faces].mean(axis=1)
    radii = np.linalg.norm(corners[faces] - middles[:, None], axis=2).max(axis=1)
    kept: Int = faces[nearest_places(middles, other).distances <= radii + within_mm]
    return kept
