"""How often a closed surface winds around the space just outside each of its sheets, exactly; knows no tissue."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise

import numpy as np

from musclefit.geometry.arrays import Int
from musclefit.geometry.measures import area_vectors
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.topology import edges_of

UNKNOWN = np.iinfo(np.int64).min
"""Winding where no ray decides: another face lies on the sheet, or every ray tried meets an edge."""

_WEIGHTS = ((1, 1, 1), (3, 2, 2), (2, 5, 3), (7, 3, 5), (5, 7, 11), (13, 11, 5))
"""Of a face's corners, for the points that rays start from."""


@dataclass(frozen=True, eq=False, slots=True)
class Sheets:
    """The parts of a closed surface that hang together by edges of two faces.

    Parameters
    ----------
    of_face : (f,) int64
        The sheet of each face.
    outside : (s,) int64
        How often the surface winds around the points just outside each sheet, on the side that its normals point to;
        just inside it is one more. ``UNKNOWN`` where it could not be told. When the surface does not cross itself, a
        sheet's answer is the same all along it.
    """

    of_face: Int
    outside: Int


def sheets_of(mesh: TriMesh) -> Sheets:
    """Sheets and windings of a closed surface: the sum of the ways in which an outward ray leaves and enters it.

    The ray starts at a rational point of a face and runs along an axis; every crossing is decided in rational
    arithmetic.
    """
    edges = edges_of(mesh.faces)
    owners = np.repeat(np.arange(len(mesh.faces)), 3)
    two_faced = edges.faces_at[edges.of_face.ravel()] == 2
    order = np.argsort(edges.of_face.ravel()[two_faced], kind="stable")
    pairs = owners[two_faced][order].reshape(-1, 2)
    of_face = _labels(pairs, len(mesh.faces))
    sizes = np.linalg.norm(area_vectors(mesh), axis=1)
    outside = []
    for sheet in range(int(of_face.max(initial=-1)) + 1):
        own = np.flatnonzero(of_face == sheet)
        outside.append(_outside(mesh, int(own[np.argmax(sizes[own])])))
    return Sheets(of_face, np.array(outside, dtype=np.int64))


def _labels(pairs: Int, count: int) -> Int:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _outside(mesh: TriMesh, face: int) -> int:
    corners = [_exact(mesh.vertices[v]) for v in mesh.faces[face]]
    for axis in np.argsort(-np.abs(area_vectors(TriMesh(mesh.vertices, mesh.faces[face : face + 1]))[0])).tolist():
        sign = _side(corners, axis)
        if sign == 0:
            continue
        for weights in _WEIGHTS:
            total = sum(weights)
            start = [
                sum((w * c[k] for w, c in zip(weights, corners, strict=True)), Fraction(0)) / total for k in range(3)
            ]
            found = _crossed(mesh, face, start, axis=axis, sign=sign)
            if found is not None:
                return found
    return int(UNKNOWN)


def _crossed(mesh: TriMesh, face: int, start: list[Fraction], *, axis: int, sign: int) -> int | None:
    """Leavings less enterings of the ray, or None where it meets an edge or starts on another face."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    corners = mesh.corners()
    low, high = corners.min(axis=1), corners.max(axis=1)
    place = np.array([float(x) for x in start])
    slack = 1e-9 * (1.0 + float(np.abs(corners).max()))
    reached = (high[:, axis] if sign > 0 else -low[:, axis]) >= sign * place[axis] - slack
    beside = ((low <= place + slack) & (high >= place - slack))[:, [u, v]].all(axis=1)
    winding = 0
    for other in np.flatnonzero(reached & beside):
        if other == face:
            continue
        triangle = [_exact(corner) for corner in corners[other]]
        spread = [
            _area((a[u], a[v]), (b[u], b[v]), (start[u], start[v])) for a, b in pairwise([*triangle, triangle[0]])
        ]
        if max(spread) > 0 and min(spread) < 0:
            continue
        if min(abs(s) for s in spread) == 0:
            return None
        whole = sum(spread, Fraction(0))
        # spread[k] belongs to the edge from corner k to k + 1, and so weighs the corner across
        height = sum((spread[k] * triangle[(k + 2) % 3][axis] for k in range(3)), Fraction(0)) / whole
        if height == start[axis]:
            return None
        if (height > start[axis]) == (sign > 0):
            winding += sign if whole > 0 else -sign
    return winding


def _side(corners: list[list[Fraction]], axis: int) -> int:
    """Sign of the normal along an axis."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    a, b, c = ((corner[u], corner[v]) for corner in corners)
    area = _area(a, b, c)
    return (area > 0) - (area < 0)


def _area(a: tuple[Fraction, Fraction], b: tuple[Fraction, Fraction], c: tuple[Fraction, Fraction]) -> Fraction:
    """Twice the signed area of a triangle in a plane."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _exact(point: np.ndarray) -> list[Fraction]:
    return [Fraction(float(x)) for x in point]
