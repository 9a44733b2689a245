"""How tetrahedra hang together: takes tets, gives faces, boundary and edges; knows no positions and no tissue."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musclefit.geometry.arrays import Faces, Int, Tets

_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
"""Corners of a right-handed tet's faces, counter-clockwise seen from outside; face k is opposite corner k."""

_EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
"""Corners of a tet's edges; edge k and edge 5 - k are opposite."""


@dataclass(frozen=True, eq=False, slots=True)
class TetFaces:
    """The triangles of a tet mesh, each once.

    Parameters
    ----------
    corners : (f, 3) int64
        As the first tet that has it sees it from outside.
    tets : (f, 2) int64
        The tets at each side; the second is -1 at the boundary.
    odd : (o,) int64
        Numbers of tets at faces that more than two tets share, or that two tets see from the same side: there the mesh
        is no conforming one, whatever its positions. Of these faces, ``tets`` holds two.
    """

    corners: Faces
    tets: Int
    odd: Int

    @property
    def boundary(self) -> Faces:
        """(b, 3) faces of a single tet, counter-clockwise seen from outside."""
        found: Faces = self.corners[self.tets[:, 1] < 0]
        return found

    @property
    def boundary_tets(self) -> Int:
        """(b,) the tet behind each face of the boundary."""
        found: Int = self.tets[self.tets[:, 1] < 0, 0]
        return found


def tet_faces(tets: Tets) -> TetFaces:
    """The faces of (k, 4) right-handed tets."""
    faces = tets[:, _FACES].reshape(-1, 3)
    owners = np.repeat(np.arange(len(tets)), 4)
    low, middle, high = np.sort(faces, axis=1).T
    span = int(tets.max(initial=0)) + 1
    order = np.lexsort((high, low * span + middle))
    keys = np.stack([low, middle, high], axis=1)[order]
    starts = np.ones(len(order), dtype=bool)
    starts[1:] = (keys[1:] != keys[:-1]).any(axis=1)
    at = np.flatnonzero(starts)
    counts = np.diff(np.append(at, len(order)))
    first = order[at]
    second = order[np.minimum(at + 1, max(len(order) - 1, 0))]
    sides = np.stack([owners[first], np.where(counts > 1, owners[second], -1)], axis=1)
    same_side = (counts == 2) & (_turns(faces[first]) == _turns(faces[second]))
    wrong = np.flatnonzero(same_side | (counts > 2))
    odd = [owners[order[at[k] : at[k] + counts[k]]] for k in wrong]
    return TetFaces(faces[first], sides, np.unique(np.concatenate(odd)) if odd else np.zeros(0, np.int64))


def tet_edges(tets: Tets) -> tuple[Int, Int]:
    """The edges of (k, 4) tets: (e, 2) ends, the smaller number first, and (k, 6) the edges of each tet.

    Edge k and edge 5 - k of a tet have no common corner.
    """
    ends = np.sort(tets[:, _EDGES].reshape(-1, 2), axis=1)
    span = int(tets.max(initial=0)) + 1
    keys, of_tet = np.unique(ends[:, 0] * span + ends[:, 1], return_inverse=True)
    return np.stack([keys // span, keys % span], axis=1), of_tet.reshape(-1, 6).astype(np.int64)


def interface(faces: TetFaces, tets_inside: Int, *, count: int) -> Faces:
    """(f, 3) triangles between the numbered tets and all others, counter-clockwise seen from the others.

    Parameters
    ----------
    faces : TetFaces
    tets_inside : (i,) int64
    count : int
        Tets in all.
    """
    inside = np.zeros(count + 1, dtype=bool)  # the last stands for the outside, number -1
    inside[tets_inside] = True
    here, there = inside[faces.tets[:, 0]], inside[faces.tets[:, 1]]
    return np.concatenate([faces.corners[here & ~there], faces.corners[there & ~here][:, ::-1]])


def _turns(faces: Faces) -> Int:
    """(f,) 1 where a face runs through its corners' numbers in rising order, -1 where in falling order."""
    a, b, c = faces.T
    rising = (a < b).astype(np.int64) + (b < c) + (c < a)
    return np.where(rising == 2, 1, -1)
