"""Closes the holes of a triangle surface: takes faces, gives the rims and the triangles that fill them."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from musclefit.geometry.arrays import Faces, Float, Int, Points
from musclefit.geometry.surfaces.faults import fans
from musclefit.geometry.surfaces.topology import edges_of

LONGEST_RIM = 300
"""Edges of a rim up to which the patch of least area is sought; longer rims are halved at their narrowest chord."""


@dataclass(frozen=True, eq=False, slots=True)
class Hole:
    """A rim and the patch over it.

    Parameters
    ----------
    rim : (k,) int64
        Vertices in the order in which the patch runs through them.
    patch : (k - 2, 3) int64
    length_mm : float
        Of the rim.
    area_mm2 : float
        Of the patch.
    """

    rim: Int
    patch: Faces
    length_mm: float
    area_mm2: float


def filled_holes(vertices: Points, faces: Faces) -> tuple[Hole, ...]:
    """The holes of a consistently oriented surface, each with the patch of least area that uses no new vertex.

    Parameters
    ----------
    vertices : (n, 3) float64, mm
    faces : (f, 3) int64

    Returns
    -------
    tuple of Hole
        Longest rim first. A patch has no edge that the surface has already, apart from the rim's own, where there is
        such a patch.

    References
    ----------
    G. Barequet, M. Sharir, Filling gaps in the boundary of a polyhedron, Comput. Aided Geom. Des. 12 (1995) 207.
    """
    taken = {(int(a), int(b)) for a, b in edges_of(faces).ends}
    holes = []
    for rim in rims(vertices, faces):
        patch = _least_area(vertices, rim, taken)
        a, b, c = (vertices[patch[:, k]] for k in range(3))
        area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
        length = float(np.linalg.norm(vertices[rim] - vertices[np.roll(rim, -1)], axis=1).sum())
        holes.append(Hole(rim, patch, length, area))
        taken |= {(int(a), int(b)) for a, b in edges_of(patch).ends}
    return tuple(sorted(holes, key=lambda hole: -hole.length_mm))


def rims(vertices: Points, faces: Faces) -> list[Int]:
    """Closed walks along the boundary edges, run through as a patch does; no vertex comes twice in one.

    Where several rims meet in a vertex, each goes on along the other fan of faces that is nearest in direction.
    """
    edges = edges_of(faces)
    open_ = np.flatnonzero((edges.faces_at == 1)[edges.of_face.ravel()])
    start = faces.ravel()[open_]
    end = faces[:, [1, 2, 0]].ravel()[open_]
    after = np.arange(faces.size).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    fan = fans(faces).ravel()
    # the patch runs from the end of a face's edge back to its start
    leaving: dict[int, list[int]] = defaultdict(list)
    arriving: dict[int, list[int]] = defaultdict(list)
    for k in range(len(open_)):
        leaving[int(end[k])].append(k)
        arriving[int(start[k])].append(k)
    following = {}
    for vertex, incoming in arriving.items():
        outgoing = leaving.get(vertex, [])
        ranked = sorted(
            (fan[open_[i]] == fan[after[open_[o]]], -_cosine(vertices, vertex, int(end[i]), int(start[o])), i, o)
            for i in incoming
            for o in outgoing
        )
        used: set[int] = set()
        for _, _, i, o in ranked:
            if i not in following and o not in used:
                following[i] = o
                used.add(o)
    walks: list[Int] = []
    while following:
        first = next(iter(following))
        walk, k = [], first
        while k in following:
            walk.append(int(end[k]))
            k = following.pop(k)
        if k == first:
            walks += [np.array(part, dtype=np.int64) for part in _simple(walk)]
    return [walk for walk in walks if len(walk) >= 3]


def _cosine(vertices: Points, at: int, a: int, b: int) -> float:
    u, v = vertices[a] - vertices[at], vertices[b] - vertices[at]
    return float(u @ v / max(float(np.linalg.norm(u) * np.linalg.norm(v)), 1e-300))


def _simple(walk: list[int]) -> list[list[int]]:
    """A closed walk cut at the vertices that come twice."""
    parts: list[list[int]] = []
    stack: list[int] = []
    where: dict[int, int] = {}
    for vertex in walk:
        if vertex in where:
            at = where[vertex]
            parts.append(stack[at:])
            for gone in stack[at + 1 :]:
                del where[gone]
            del stack[at + 1 :]
        else:
            where[vertex] = len(stack)
            stack.append(vertex)
    return [*parts, stack]


def _least_area(vertices: Points, rim: Int, taken: set[tuple[int, int]]) -> Faces:
    """The triangulation of a rim with the least area, by dynamic programming; long rims are cut in two first."""
    n = len(rim)
    if n > LONGEST_RIM:
        i, j = _narrowest(vertices[rim])
        parts = (np.concatenate([rim[: i + 1], rim[j:]]), rim[i : j + 1])
        return np.concatenate([_least_area(vertices, part, taken) for part in parts])
    points = vertices[rim]
    free = np.ones((n, n))
    for i in range(n):
        for j in range(i + 2, n):
            pair = (min(int(rim[i]), int(rim[j])), max(int(rim[i]), int(rim[j])))
            if pair in taken and not (i == 0 and j == n - 1):
                free[i, j] = 1e9  # an edge that the surface has already is a last resort
    cost, split = np.zeros((n, n)), np.zeros((n, n), dtype=np.int64)
    for gap in range(2, n):
        for i in range(n - gap):
            j = i + gap
            m = np.arange(i + 1, j)
            area = 0.5 * np.linalg.norm(np.cross(points[m] - points[i], points[j] - points[i]), axis=1)
            total = cost[i, m] + cost[m, j] + area
            best = int(total.argmin())
            cost[i, j], split[i, j] = total[best] + (free[i, j] - 1.0), m[best]
    triangles, waiting = [], [(0, n - 1)]
    while waiting:
        first, last = waiting.pop()
        if last - first >= 2:
            middle = int(split[first, last])
            triangles.append((rim[first], rim[middle], rim[last]))
            waiting += [(first, middle), (middle, last)]
    return np.array(triangles, dtype=np.int64)


def _narrowest(points: Float) -> tuple[int, int]:
    """The chord that is shortest for the length of rim that it cuts off; each part keeps a quarter of the rim."""
    n = len(points)
    best, ends = np.inf, (0, n // 2)
    for i in range(0, n, max(n // 200, 1)):
        j = np.arange(i + n // 4, min(i + n - n // 4, n))
        if j.size:
            apart = np.linalg.norm(points[j] - points[i], axis=1)
            k = int(apart.argmin())
            if apart[k] < best:
                best, ends = float(apart[k]), (i, int(j[k]))
    return ends
