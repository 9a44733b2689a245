"""How often closed surfaces wind around points; knows triangles, not what they bound."""

from __future__ import annotations

import igl
import numpy as np

from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.meshes import TriMesh


def winding_numbers(mesh: TriMesh, points: Points) -> Float:
    """Generalised winding number of a surface around each point: 1 inside, 0 outside a closed surface.

    Parameters
    ----------
    mesh : TriMesh
        Counter-clockwise seen from outside. Pieces that overlap count twice, inside-out pieces count -1.
    points : (N, 3) float64, mm

    Returns
    -------
    (N,) float64
        By a tree of far-field expansions: off by less than 0.01 of the exact sum for closed surfaces, so that a
        threshold of 0.5 is safe; close to holes and on the surface itself any value between the two sides occurs.

    References
    ----------
    A. Jacobson et al., ACM Trans. Graph. 32 (2013) 33; G. Barill et al., ACM Trans. Graph. 37 (2018) 43.
    """
    if not len(points) or not len(mesh.faces):
        return np.zeros(len(points))
    numbers: Float = igl.fast_winding_number(mesh.vertices, mesh.faces, np.ascontiguousarray(points, dtype=np.float64))
    return numbers
