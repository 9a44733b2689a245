"""A surface anew from tetrahedra: takes a soup of triangles and what fills it, gives the border of its inside."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from musclefit.errors import MeshError
from musclefit.geometry.arrays import Faces, Points, Tets
from musclefit.geometry.measures import signed_volumes
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.winding import winding_numbers
from musclefit.geometry.surfaces.uncrossing import compacted

Fill = Callable[[Points, Faces], tuple[Points, Tets]]
"""(n, 3) vertices and (f, 3) faces -> (m, 3) vertices and (k, 4) tets of one orientation, around and inside."""


def border_of_inside(soup: TriMesh, *, fill: Fill) -> TriMesh:
    """The border of the tets that a surface winds around more than half, whatever its holes and crossings.

    Parameters
    ----------
    soup : TriMesh
        Oriented as well as it can be.
    fill : callable
        Tetrahedralises the room around and inside, with the soup's triangles among its faces within an envelope.

    Returns
    -------
    TriMesh
        Closed; where tets meet in an edge or a vertex alone, the surface is not manifold there.

    Raises
    ------
    MeshError
        No tet is inside.

    References
    ----------
    Y. Hu et al., Tetrahedral meshing in the wild, ACM Trans. Graph. 37 (2018) 60.
    """
    vertices, tets = fill(np.array(soup.vertices), np.array(soup.faces))
    if len(tets) and np.median(signed_volumes(vertices, tets)) < 0.0:
        tets = tets[:, [0, 2, 1, 3]]
    inside = tets[winding_numbers(soup, vertices[tets].mean(axis=1)) > 0.5]
    if not len(inside):
        raise MeshError(f"a surface of {len(soup.faces)} triangles winds around none of {len(tets)} tets")
    return compacted(TriMesh(vertices, outer_faces(inside)))


def outer_faces(tets: Tets) -> Faces:
    """Faces of right-handed tets that belong to one tet alone, facing outwards."""
    corners = np.concatenate([tets[:, [0, 2, 1]], tets[:, [0, 1, 3]], tets[:, [0, 3, 2]], tets[:, [1, 2, 3]]])
    _, group, count = np.unique(np.sort(corners, axis=1), axis=0, return_inverse=True, return_counts=True)
    outer: Faces = corners[count[group.ravel()] == 1]
    return outer
