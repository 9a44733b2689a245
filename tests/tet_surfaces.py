"""The closed surface of some tetrahedra of a mesh, sheets that only meet at corners or edges apart; knows no tissue."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from musclefit.geometry.arrays import Int
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.geometry.tets.topology import tet_faces


def surface_of_tets(mesh: TetMesh, part: Int) -> TriMesh:
    """The boundary of the numbered tets, counter-clockwise seen from outside.

    Where tets of the part meet at a corner or an edge without a chain of shared faces around that corner, each side has
    a corner of its own at the same place: a pinch does not join sheets, so that the surface suits boolean operations.

    Parameters
    ----------
    mesh : TetMesh
    part : (p,) int64
    """
    tets = mesh.tets[part]
    faces = tet_faces(tets)
    shared = faces.tets[:, 1] >= 0
    links = [[_slot(tets, faces.tets[shared, side], faces.corners[shared, k]) for k in range(3)] for side in (0, 1)]
    first, second = (np.concatenate(side) for side in links)
    count = 4 * len(tets)
    graph = coo_array((np.ones(len(first), dtype=np.int8), (first, second)), shape=(count, count))
    fan = np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)
    outer, behind = faces.boundary, faces.boundary_tets
    corners = np.stack([fan[_slot(tets, behind, outer[:, k])] for k in range(3)], axis=1)
    places = np.empty((int(fan.max(initial=-1)) + 1, 3))
    places[fan] = mesh.vertices[tets.ravel()]
    used, local = np.unique(corners, return_inverse=True)
    return TriMesh(places[used], local.reshape(-1, 3))


def _slot(tets: Int, numbers: Int, vertices: Int) -> Int:
    """Four times a tet's number and the place in it that a vertex has, row by row."""
    slots: Int = 4 * numbers + (tets[numbers] == vertices[:, None]).argmax(axis=1)
    return slots
