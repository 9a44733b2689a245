"""Takes needles and caps out of a closed surface: short edges collapsed, long edges flipped; knows no tissue.

A needle is a triangle with an edge, a cap one with a height, below a stated length. Booleans leave both where two
surfaces meet at a small angle; split finer, they stay as flat as they are and cross each other at the first bend.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from heapq import heapify, heappop, heappush

import numpy as np

from musclefit.geometry.arrays import Bool, Float, Int, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.geometry.surfaces.uncrossing import compacted, grown

ATTEMPTS = 12
"""How often the work is done anew, with the vertices left alone around which it would make triangles cross."""

FEWEST_FACES = 12
"""Pieces with fewer faces are not made smaller still."""

LEAST_COSINE = 0.5
"""Between a triangle's normals before and after one of its corners is moved, unless it was a sliver before."""


@dataclass(frozen=True, eq=False, slots=True)
class Unslivered:
    """A surface with fewer slivers.

    Parameters
    ----------
    mesh : TriMesh
    slivers : int
        Triangles below the least height that there were.
    left : int
        Those that are left, where taking one out would bend the surface too far or make it cross itself.
    moved_mm : float
        No place is farther than this from the surface before, nor that from any place.
    """

    mesh: TriMesh
    slivers: int
    left: int
    moved_mm: float


def heights(mesh: TriMesh) -> Float:
    """(f,) least height of each triangle, mm: twice its area over its longest edge; 0 where it is a point."""
    corners = mesh.corners()
    along = np.roll(corners, -1, axis=1) - corners
    longest = np.linalg.norm(along, axis=2).max(axis=1)
    areas = np.linalg.norm(np.cross(along[:, 0], along[:, 1]), axis=1)
    least: Float = areas / np.where(longest > 0.0, longest, 1.0)
    return least


def without_slivers(mesh: TriMesh, *, least_mm: float, most_mm: float) -> Unslivered:
    """Collapse edges and flip edges until no triangle is lower than a length, where that can be done.

    Parameters
    ----------
    mesh : TriMesh
        Closed, consistently oriented, without crossings.
    least_mm : float
        Height below which a triangle is a sliver.
    most_mm : float
        How far any place of the surface may get from where it was.

    Returns
    -------
    Unslivered
        Closed, oriented and free of crossings as before. Each collapse moves places by at most the edge's length and
        each flip by at most the triangle's height; what is told is the largest sum of these at any vertex.
    """
    before = int((heights(mesh) < least_mm).sum())
    if not before:
        return Unslivered(mesh, 0, 0, 0.0)
    mesh, kept = compacted(mesh), np.zeros(len(np.unique(mesh.faces)), dtype=bool)
    known = len(self_crossings(mesh))
    for attempt in range(ATTEMPTS):
        work = _Work(mesh, kept, least_mm=least_mm, most_mm=most_mm)
        work.run()
        vertices, faces = work.result()
        found = self_crossings(TriMesh(vertices, faces))
        if len(found) <= known:
            done = compacted(TriMesh(vertices, faces))
            return Unslivered(done, before, int((heights(done) < least_mm).sum()), work.moved_mm)
        near = np.zeros(len(faces), dtype=bool)
        near[found.pairs.ravel()] = True
        crossed = np.zeros(len(kept), dtype=bool)
        crossed[faces[grown(faces, near, rings=attempt // 4)]] = True
        kept |= crossed[work.merged_into()]  # with the vertices that went into those
    return Unslivered(mesh, before, before, 0.0)


class _Work:
    """The surface while it is worked on: faces by vertex, and how far each vertex has been moved."""

    def __init__(self, mesh: TriMesh, kept: Bool, *, least_mm: float, most_mm: float) -> None:
        self._at: Points = mesh.vertices.copy()
        self._faces: list[tuple[int, int, int] | None] = [(int(a), int(b), int(c)) for a, b, c in mesh.faces]
        self._around: dict[int, set[int]] = defaultdict(set)
        for number, face in enumerate(mesh.faces.tolist()):
            for v in face:
                self._around[v].add(number)
        self._kept = kept
        self._moved = np.zeros(len(mesh.vertices))
        self._into = np.arange(len(mesh.vertices))
        self._least, self._most = least_mm, most_mm
        low = heights(mesh)
        self._heap = [(float(low[f]), int(f)) for f in np.flatnonzero(low < least_mm)]
        heapify(self._heap)

    @property
    def moved_mm(self) -> float:
        return float(self._moved.max(initial=0.0))

    def run(self) -> None:
        budget = 40 * len(self._heap) + 100
        while self._heap and budget:
            budget -= 1
            height, number = heappop(self._heap)
            face = self._faces[number]
            if face is None or abs(self._height(face) - height) > 1e-15:
                continue
            self._improve(number, face, height)

    def result(self) -> tuple[Points, Int]:
        faces = np.array([face for face in self._faces if face is not None], dtype=np.int64).reshape(-1, 3)
        return self._at, faces

    def merged_into(self) -> Int:
        """(n,) the vertex that each one is now."""
        into = self._into
        while True:
            further = into[into]
            if (further == into).all():
                return into
            into = further

    def _improve(self, number: int, face: tuple[int, int, int], height: float) -> None:
        corners = self._at[list(face)]
        lengths = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        order = np.argsort(lengths)
        if lengths[order[0]] < self._least and self._collapse(face[order[0]], face[(order[0] + 1) % 3]):
            return
        if self._flip(number, face, int(order[2]), height):
            return
        for k in order[:2]:
            if lengths[k] <= self._most and self._collapse(face[k], face[(k + 1) % 3]):
                return

    def _collapse(self, u: int, v: int) -> bool:
        """One vertex of two: at either's place, or in the middle."""
        shared = self._around[u] & self._around[v]
        if len(shared) != 2 or (self._kept[u] and self._kept[v]):
            return False
        ring_u, ring_v = self._ring(u), self._ring(v)
        tips = {w for f in shared for w in self._face(f) if w not in (u, v)}
        if len(tips) != 2 or (ring_u & ring_v) != tips or len(ring_u | ring_v) < 6:
            return False
        stay = [f for f in (self._around[u] | self._around[v]) if f not in shared]
        length = float(np.linalg.norm(self._at[u] - self._at[v]))
        middle = 0.5 * (self._at[u] + self._at[v])
        choices = [(self._at[u], 0.0, length), (self._at[v], length, 0.0), (middle, 0.5 * length, 0.5 * length)]
        if self._kept[u]:
            choices = choices[:1]
        elif self._kept[v]:
            choices = choices[1:2]
        best, best_height, best_moved = None, -1.0, 0.0
        for place, by_u, by_v in choices:
            moved = max(self._moved[u] + by_u, self._moved[v] + by_v)
            if moved > self._most:
                continue
            least = self._least_height_after(stay, {u, v}, place)
            if least > best_height:
                best, best_height, best_moved = place, least, moved
        if best is None:
            return False
        self._at[u], self._moved[u] = best, best_moved
        self._into[v] = u
        for f in shared:
            self._take_out(f)
        for f in list(self._around[v]):
            a, b, c = (u if w == v else w for w in self._face(f))
            self._faces[f] = (a, b, c)
            self._around[u].add(f)
        self._around[v].clear()
        for f in self._around[u]:
            self._queue(f)
        return True

    def _least_height_after(self, stay: list[int], moving: set[int], place: Points) -> float:
        """Least height of the faces that stay, once two of their corners are at a place; -1 where one would turn."""
        least = np.inf
        for f in stay:
            face = self._face(f)
            before = self._at[list(face)]
            after = np.array([place if w in moving else self._at[w] for w in face])
            old, new = _normal(before), _normal(after)
            was, now = _height(before, old), _height(after, new)
            if now <= 0.0 or now < min(was, self._least):
                return -1.0
            if was >= self._least and old @ new < LEAST_COSINE * np.linalg.norm(old) * np.linalg.norm(new):
                return -1.0
            least = min(least, now)
        return float(least)

    def _flip(self, number: int, face: tuple[int, int, int], k: int, height: float) -> bool:
        """The other diagonal for the longest edge of a cap."""
        a, b, m = face[k], face[(k + 1) % 3], face[(k + 2) % 3]
        shared = self._around[a] & self._around[b]
        if len(shared) != 2:
            return False
        (other,) = shared - {number}
        (c,) = (w for w in self._face(other) if w not in (a, b))
        if c == m or m in self._ring(c) or self._kept[m]:
            return False
        moved = max(self._moved[m], self._moved[a] + height, self._moved[b] + height)
        if moved > self._most:
            return False
        old = _normal(self._at[[a, b, m]]) + _normal(self._at[list(self._face(other))])
        least = min(height, self._height(self._face(other)))
        first, second = (a, c, m), (c, b, m)
        corners = [self._at[list(first)], self._at[list(second)]]
        normals = [_normal(corner) for corner in corners]
        if min(_height(x, n) for x, n in zip(corners, normals, strict=True)) <= least:
            return False
        if any(n @ old <= 0.0 for n in normals):
            return False
        self._take_out(number)
        self._take_out(other)
        self._put(number, first)
        self._put(other, second)
        self._moved[m] = moved
        self._queue(number)
        self._queue(other)
        return True

    def _face(self, number: int) -> tuple[int, int, int]:
        face = self._faces[number]
        assert face is not None
        return face

    def _ring(self, v: int) -> set[int]:
        return {w for f in self._around[v] for w in self._face(f)} - {v}

    def _take_out(self, number: int) -> None:
        for v in self._face(number):
            self._around[v].discard(number)
        self._faces[number] = None

    def _put(self, number: int, face: tuple[int, int, int]) -> None:
        self._faces[number] = face
        for v in face:
            self._around[v].add(number)

    def _queue(self, number: int) -> None:
        height = self._height(self._face(number))
        if height < self._least:
            heappush(self._heap, (height, number))

    def _height(self, face: tuple[int, int, int]) -> float:
        corners = self._at[list(face)]
        return _height(corners, _normal(corners))


def _normal(corners: Points) -> Float:
    u, v = corners[1] - corners[0], corners[2] - corners[0]
    return np.array([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])


def _height(corners: Points, normal: Float) -> float:
    longest = max(float(np.linalg.norm(corners[k] - corners[k - 1])) for k in range(3))
    return float(np.linalg.norm(normal)) / longest if longest > 0.0 else 0.0
