"""How far one surface is from another, bracketed by a proof; takes two surfaces, knows no tissue."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from musclefit.geometry.arrays import Bool, Float, Int, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places

MOST_TRIANGLES = 400_000
"""Triangles under examination at which the search stops and gives the bracket it has."""

_RELATIVE = 0.02
"""The bracket's width over the distance, where that is wider than the tolerance."""

_ROUNDING_MM = 1e-9
"""Distances up to this are rounding, mm; nobody is asked about them."""


@dataclass(frozen=True, eq=False, slots=True)
class Reach:
    """The largest distance of any point of one surface from another surface.

    Parameters
    ----------
    at_least, at_most : float, mm
        The true value lies between, rounding aside.
    place : (3,) float64, mm
        The point of the first surface that is ``at_least`` away.
    passed_over_mm2 : float
        Area of the first surface that was not asked about.
    """

    at_least: float
    at_most: float
    place: Points
    passed_over_mm2: float


def everywhere(points: Points) -> Bool:
    """(N,) True: ask about every point."""
    return np.ones(len(points), dtype=bool)


def reach(
    surface: TriMesh, other: TriMesh, *, tolerance_mm: float, where: Callable[[Points], Bool] = everywhere
) -> Reach:
    r"""One-sided Hausdorff distance :math:`\max_{x \in A} \min_{y \in B} |x - y|`, by branch and bound.

    The distance from one triangle is a convex function, so on a triangle it is largest at a corner: the distance of
    all of a triangle of A is at most its largest corner distance from any one triangle of B. Triangles for which that
    exceeds what is known to occur are split in four.

    Parameters
    ----------
    surface, other : TriMesh
    tolerance_mm : float
        The bracket's width to stop at; a fiftieth of the distance where that is more.
    where : callable
        (N, 3) points of the first surface -> (N,) which of them to ask about. Triangles none of whose corners and
        middles are asked about, at the size that they have been split to, are passed over whole.

    Returns
    -------
    Reach
        0 for a surface without triangles; infinite where only the other has none.
    """
    corners = surface.corners()
    if not len(corners):
        return Reach(0.0, 0.0, np.zeros(3), 0.0)
    if not len(other.faces):
        return Reach(np.inf, np.inf, corners[0, 0], 0.0)
    targets = other.corners()
    low, place, settled, passed_over = 0.0, corners[0, 0], 0.0, 0.0
    while True:
        probes = np.concatenate([corners, corners.mean(axis=1, keepdims=True)], axis=1)
        near = nearest_places(probes.reshape(-1, 3), other)
        distances, faces = near.distances.reshape(-1, 4), near.faces.reshape(-1, 4)
        far = distances > max(low, _ROUNDING_MM)
        asked = np.ones_like(far)
        asked[far] = where(probes[far])
        heard = np.where(asked, distances, 0.0)
        worst = int(heard.argmax())
        if heard.flat[worst] > low:
            low, place = float(heard.flat[worst]), probes.reshape(-1, 3)[worst]
        ignored = ~asked.any(axis=1)
        passed_over += _area(corners[ignored])
        bounds = _bounds(corners, targets, faces)
        enough = max(low + tolerance_mm, (1.0 + _RELATIVE) * low)
        open_ = (bounds > enough) & ~ignored
        settled = max(settled, float(bounds[~open_ & ~ignored].max(initial=0.0)))
        if not open_.any() or 4 * int(open_.sum()) > MOST_TRIANGLES:
            left = float(bounds[open_].max(initial=0.0))
            return Reach(low, max(low, settled, left), place, passed_over)
        corners = _quartered(corners[open_])


def _bounds(corners: Float, targets: Float, faces: Int) -> Float:
    """(f,) upper bounds of the distance of all of each triangle, by each of four candidate triangles of the other."""
    bounds = np.full(len(corners), np.inf)
    for k in range(faces.shape[1]):
        triangles = targets[faces[:, k]]
        apart = [distances_from_triangles(corners[:, c], triangles) for c in range(3)]
        bounds = np.minimum(bounds, np.max(apart, axis=0))
    return bounds


def _area(corners: Float) -> float:
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * float(np.linalg.norm(normals, axis=1).sum())


def distances_from_triangles(points: Points, triangles: Float) -> Float:
    """(N,) distance of each of (N, 3) points from its own of (N, 3, 3) triangles, mm."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    best = np.full(len(points), np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        along = q - p
        squared = np.einsum("ni,ni->n", along, along)
        t = np.einsum("ni,ni->n", points - p, along) / np.where(squared > 0.0, squared, 1.0)
        foot = p + np.clip(t, 0.0, 1.0)[:, None] * along
        best = np.minimum(best, np.linalg.norm(points - foot, axis=1))
    normal = np.cross(b - a, c - a)
    size = np.linalg.norm(normal, axis=1)
    over = size > 0.0
    for p, q in ((a, b), (b, c), (c, a)):
        over &= np.einsum("ni,ni->n", np.cross(normal, q - p), points - p) >= 0.0
    height = np.abs(np.einsum("ni,ni->n", points - a, normal)) / np.where(size > 0.0, size, 1.0)
    nearest: Float = np.where(over, np.minimum(height, best), best)
    return nearest


def _quartered(corners: Float) -> Float:
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    p, q, r = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
    return np.concatenate([np.stack(t, axis=1) for t in ((a, p, r), (p, b, q), (r, q, c), (p, q, r))])
