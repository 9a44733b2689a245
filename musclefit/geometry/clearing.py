"""Finds the triangles of a surface that come too close to another surface; knows no tissue and cuts nothing."""

from __future__ import annotations

import numpy as np

from musclefit.geometry.arrays import Int
from musclefit.geometry.booleans import REACH, as_mesh, padded_one_by_one
from musclefit.geometry.crossings import crossings_between
from musclefit.geometry.distances import nearest_places
from musclefit.geometry.meshes import TriMesh


def faces_near(mesh: TriMesh, other: TriMesh, *, within_mm: float) -> Int:
    """Faces that come closer to another surface than a distance; those up to 26 % farther may be among them.

    A face counts when its hull, grown by the distance, crosses the other surface, by exact predicates.

    Parameters
    ----------
    mesh : TriMesh
    other : TriMesh
        Closed, and not wholly within the distance of one face.
    within_mm : float
    """
    faces = _candidates(mesh, other, REACH * within_mm)
    if not len(faces):
        return faces
    hulls = [as_mesh(hull) for hull in padded_one_by_one(mesh, faces, distance_mm=within_mm)]
    starts = np.cumsum([0, *(len(hull.vertices) for hull in hulls[:-1])])
    joined = TriMesh(
        np.concatenate([hull.vertices for hull in hulls]),
        np.concatenate([hull.faces + start for hull, start in zip(hulls, starts, strict=True)]),
    )
    owner = np.repeat(np.arange(len(hulls)), [len(hull.faces) for hull in hulls])
    near: Int = faces[np.unique(owner[crossings_between(joined, other).pairs[:, 0]])]
    return near


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
