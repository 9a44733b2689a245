"""Splitting edges of tet meshes so that they stay conforming; knows no map and no tissue."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musclefit.compiling import njit
from musclefit.errors import MeshError
from musclefit.geometry.arrays import Int, Tets


@dataclass(frozen=True, eq=False, slots=True)
class SplitTets:
    """Tets after some edges were split.

    Parameters
    ----------
    tets : (k + a, 4) int64
        A tet around a split edge keeps its number for the half with the edge's smaller end; the other half is new.
    parent : (k + a,) int64
        The tet each was cut from, or itself.
    """

    tets: Tets
    parent: Int


class Incidence:
    """The tets at each of some vertices of a mesh, found once for many edges.

    Parameters
    ----------
    tets : (k, 4) int64
    vertices : (v,) int64
        Edges that have an end among these can be asked for.
    """

    def __init__(self, tets: Tets, vertices: Int) -> None:
        known = np.zeros(int(tets.max(initial=0)) + 1, dtype=bool)
        known[vertices] = True
        near = np.flatnonzero(known[tets].any(axis=1))
        corners = tets[near].ravel()
        order = np.argsort(corners, kind="stable")
        self._numbers, starts = np.unique(corners[order], return_index=True)
        self._known, self._starts = known, np.append(starts, len(order))
        self._tets = near[order // 4]

    def around(self, edge: Int) -> Int:
        """Numbers of the tets that have both ends of an edge, rising.

        Raises
        ------
        MeshError
            Neither end was among the vertices asked for.
        """
        if not self._known[edge].any():
            raise MeshError(f"edge {edge.tolist()} has no end among the vertices asked for")
        found: Int = np.intersect1d(self._at(int(edge[0])), self._at(int(edge[1])), assume_unique=True)
        return found

    def _at(self, vertex: int) -> Int:
        row = int(np.searchsorted(self._numbers, vertex))
        if row == len(self._numbers) or self._numbers[row] != vertex:
            return np.zeros(0, dtype=np.int64)
        return self._tets[self._starts[row] : self._starts[row + 1]]


def independent_edges(around: list[Int]) -> Int:
    """Numbers of edges no two of which have a tet in common, taken greedily in the order given.

    Parameters
    ----------
    around : list of (m,) int64
        The tets at each edge.
    """
    taken: set[int] = set()
    chosen = []
    for number, tets in enumerate(around):
        own = tets.tolist()
        if taken.isdisjoint(own):
            taken.update(own)
            chosen.append(number)
    return np.array(chosen, dtype=np.int64)


def tets_around(tets: Tets, edges: Int) -> list[Int]:
    """For each of (e, 2) edges the numbers of the tets that have both its ends, rising."""
    tets = np.ascontiguousarray(tets)
    return [_around(tets, int(a), int(b)) for a, b in edges]


@njit(cache=True)
def _around(tets, a, b):
    found = np.empty(64, dtype=np.int64)
    count = 0
    for t in range(len(tets)):
        has_a = tets[t, 0] == a or tets[t, 1] == a or tets[t, 2] == a or tets[t, 3] == a
        if has_a and (tets[t, 0] == b or tets[t, 1] == b or tets[t, 2] == b or tets[t, 3] == b):
            if count == len(found):
                more = np.empty(2 * count, dtype=np.int64)
                more[:count] = found
                found = more
            found[count] = t
            count += 1
    return found[:count].copy()


def split_edges(tets: Tets, edges: Int, middles: Int) -> SplitTets:
    """Put a vertex into each edge and cut every tet around it in two.

    Parameters
    ----------
    tets : (k, 4) int64
    edges : (e, 2) int64
        No two of them in one tet.
    middles : (e,) int64
        Numbers of the new vertices.

    Returns
    -------
    SplitTets
        As conforming as before, and of the same orientation when the vertices are between the ends of their edges.

    Raises
    ------
    MeshError
        An edge that no tet has, or two edges in one tet.
    """
    near = Incidence(tets, edges[:, 0])
    around = [near.around(edge) for edge in edges]
    empty = [number for number, own in enumerate(around) if not len(own)]
    if empty:
        raise MeshError(f"no tet has the edge {edges[empty[0]].tolist()}; name edges of the mesh")
    cut = np.concatenate(around) if around else np.zeros(0, np.int64)
    if len(np.unique(cut)) != len(cut):
        doubled = np.flatnonzero(np.bincount(cut) > 1)[0]
        raise MeshError(f"two of the edges to split are in tet {doubled}; split them one after the other")
    which = np.repeat(np.arange(len(edges)), [len(own) for own in around])
    first, second = edges[which, 0], edges[which, 1]
    middle = middles[which]
    low, high = tets[cut].copy(), tets[cut].copy()
    low[low == second[:, None]] = np.broadcast_to(middle[:, None], low.shape)[low == second[:, None]]
    high[high == first[:, None]] = np.broadcast_to(middle[:, None], high.shape)[high == first[:, None]]
    kept = tets.copy()
    kept[cut] = low
    return SplitTets(np.concatenate([kept, high]), np.concatenate([np.arange(len(tets)), cut]))
