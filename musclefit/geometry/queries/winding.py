"""How often closed surfaces wind around points; knows triangles, not what they bound."""

from __future__ import annotations

import igl
import numpy as np

from musclefit.geometry.arrays import Bool, Float, Points
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
    vertices, places = _about_the_middle(mesh, points)
    numbers: Float = igl.fast_winding_number(vertices, mesh.faces, places)
    return numbers


def inside_surface(mesh: TriMesh, points: Points) -> Bool:
    """(N,) which of (N, 3) points, mm, a closed surface winds around; those outside its box are not asked about."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    found: Bool = ((points >= low) & (points <= high)).all(axis=1)
    found[found] = winding_numbers(mesh, points[found]) > 0.5
    return found


def exact_winding_numbers(mesh: TriMesh, points: Points) -> Float:
    """The same by summing every triangle's solid angle: off by rounding alone, and slow.

    Parameters
    ----------
    mesh : TriMesh
    points : (N, 3) float64, mm

    Returns
    -------
    (N,) float64
        Whole numbers for a closed surface, but for points on the surface itself.
    """
    if not len(points) or not len(mesh.faces):
        return np.zeros(len(points))
    vertices, places = _about_the_middle(mesh, points)
    numbers: Float = np.atleast_1d(igl.winding_number(vertices, np.asarray(mesh.faces), places))
    return numbers


def _about_the_middle(mesh: TriMesh, points: Points) -> tuple[Points, Points]:
    """Vertices and points as seen from the surface's middle: the expansions lose digits far from the origin."""
    middle = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    return np.ascontiguousarray(mesh.vertices - middle), np.ascontiguousarray(points - middle, dtype=np.float64)
