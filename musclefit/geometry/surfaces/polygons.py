"""Polygons of any number of corners -> triangles, the non-convex ones too; triangle strips -> triangles."""

from __future__ import annotations

import numpy as np

from musclefit.geometry.arrays import Bool, Faces, Float, Int, Points

MOST_CORNERS = 10_000
"""Corners of a polygon that is not convex, at most; clipping its ears takes time with their square."""

_FLAT = 1e-12
"""A fan triangle whose area, seen along the polygon's normal, is at most this share of the polygon's is not kept."""


def cut_polygons(vertices: Points, sizes: Int, corners: Int) -> Faces:
    """Cut polygons into triangles that wind as they do.

    Convex polygons become fans about their first corners. The others, of which a fan would fold, are projected along
    their vector area and triangulated in that plane; a polygon that crosses itself there has no triangulation without
    folds, and gets one that matches its edges.

    Parameters
    ----------
    vertices : (n, 3) float64
    sizes : (p,) int64
        Corners of each polygon, at least 3.
    corners : int64
        The corners of all polygons, one polygon after the other.

    Returns
    -------
    (sum of sizes - 2, 3) int64

    Raises
    ------
    ValueError
        A polygon that is not convex has more than ``MOST_CORNERS`` corners.
    """
    faces = _fans(sizes, corners)
    of = np.repeat(np.arange(len(sizes)), sizes - 2)
    many = sizes > 3
    if not many.any() or corners.min() < 0 or corners.max() >= len(vertices):
        return faces  # whoever takes the faces in refuses vertices that are not there
    folded = many & _fan_folds(vertices, faces, of, len(sizes))
    starts, first = np.cumsum(sizes) - sizes, np.cumsum(sizes - 2) - (sizes - 2)
    for p in np.flatnonzero(folded):
        around = corners[starts[p] : starts[p] + sizes[p]]
        if len(around) > MOST_CORNERS:
            raise ValueError(f"a polygon that is not convex has {len(around)} corners, at most {MOST_CORNERS} are cut")
        flat = _projected(vertices[around])
        if flat is not None:
            import manifold3d  # only such polygons need it

            cut = np.asarray(manifold3d.triangulate([flat]), dtype=np.int64)
            if len(cut) == len(around) - 2:
                faces[first[p] : first[p] + len(cut)] = around[cut]
    return faces


def _fans(sizes: Int, corners: Int) -> Faces:
    """All triangles that the first corner of each polygon makes with the edges across."""
    of = np.repeat(np.arange(len(sizes)), sizes - 2)
    nth = np.arange(len(of)) - np.repeat(np.cumsum(sizes - 2) - (sizes - 2), sizes - 2)
    at = (np.cumsum(sizes) - sizes)[of]
    return np.stack([corners[at], corners[at + nth + 1], corners[at + nth + 2]], axis=1)


def _fan_folds(vertices: Points, faces: Faces, of: Int, count: int) -> Bool:
    """For each polygon, whether a triangle of its fan is flat or faces against the polygon's vector area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    with np.errstate(over="ignore", invalid="ignore"):
        areas = np.cross(b - a, c - a)
        whole = np.zeros((count, 3))
        np.add.at(whole, of, areas)
        along = np.einsum("ij,ij->i", areas, whole[of])
        bad = ~(along > _FLAT * np.einsum("ij,ij->i", whole, whole)[of])
    folds = np.zeros(count, dtype=np.bool_)
    folds[of[bad]] = True
    return folds


def _projected(points: Points) -> Float | None:
    """A polygon's corners in the plane across its vector area, (k, 2), counter-clockwise; None where it has none."""
    with np.errstate(over="ignore", invalid="ignore"):
        centred = points - points.mean(axis=0)
        normal = np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0)
        length = float(np.linalg.norm(normal))
    if not np.isfinite(length) or not length:
        return None
    normal = normal / length
    across = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    across /= np.linalg.norm(across)
    return np.ascontiguousarray(centred @ np.stack([across, np.cross(normal, across)], axis=1))


def cut_strips(sizes: Int, corners: Int) -> Faces:
    """The triangles of triangle strips, each second one turned round so that all wind as the first.

    Parameters
    ----------
    sizes : (s,) int64
        Corners of each strip, at least 3.
    corners : int64
        The corners of all strips, one strip after the other.

    Returns
    -------
    (t, 3) int64
        Without the triangles that name a corner twice, by which strips turn corners.
    """
    of = np.repeat(np.arange(len(sizes)), sizes - 2)
    nth = np.arange(len(of)) - np.repeat(np.cumsum(sizes - 2) - (sizes - 2), sizes - 2)
    at = (np.cumsum(sizes) - sizes)[of] + nth
    odd = nth % 2
    faces = np.stack([corners[at], corners[at + 1 + odd], corners[at + 2 - odd]], axis=1)
    same = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 0] == faces[:, 2])
    return np.ascontiguousarray(faces[~same])
