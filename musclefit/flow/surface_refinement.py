"""Surfaces as fine as a map needs: edges that the map bends are split, and every new vertex goes through the map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from musclefit.anatomy.model import Anatomy
from musclefit.flow.deformation import Deformation
from musclefit.flow.tracked_points import PlainRiders, Riders
from musclefit.geometry.arrays import Bool, Float, Gradients, Int, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.crossings import TOUCHING_MM, self_crossings
from musclefit.geometry.surfaces.edge_lengths import EdgeLengths
from musclefit.geometry.surfaces.subdivision import FaceEdges, longest_edges, split_edges, with_short_edges
from musclefit.progress import Progress, Silent, Tick

MAX_ROUNDS = 16
"""Each round halves what is bent, and beside it what is longest: from 30 mm to a tenth of a millimetre in 8 to 16."""

MAX_CROSSING_ROUNDS = 24
"""Rounds in which triangles that come to cross each other are halved."""

SHORTEST_SHARE = 0.02
"""Edges shorter than this share of the chord tolerance are not split for that: what crosses there are slivers."""

PATIENCE, MULTIPLIED, MANY = 16, 32, 2000
"""Halving is given up, and taken back to where the fewest triangles crossed, after so many rounds in a row that left no
fewer than the round before, or where it left this many times the fewest and more pairs than are soon looked at. Where
sheets all but touch along a strip the pairs multiply at first: long triangles become many before they become straight
enough."""


@dataclass(frozen=True, eq=False, slots=True)
class Carried:
    """An anatomy moved by a map.

    Parameters
    ----------
    rest, deformed : Anatomy
        The same triangles; the vertices that were given come first in each tissue, the middles of split edges after.
    determinants : (N,) float64
        Of the map's Jacobian, in the order of ``rest.vertices()``.
    splits : mapping of tissue to number of split edges
    undecided_edges : int
        Edges still bent beyond the tolerance when the rounds ran out, or that could not be split.
    crossings_left : int
        Pairs of triangles that come to cross in tissues that do not cross themselves as given: halving them further
        does not make them fewer, or they are slivers.
    unsolved : int
        Points of the finer surfaces at which the map's rule fails, whatever the steps: they were left out.
    """

    rest: Anatomy
    deformed: Anatomy
    determinants: Float
    splits: dict[str, int]
    undecided_edges: int
    crossings_left: int = 0
    unsolved: int = 0


@dataclass(frozen=True, eq=False, slots=True)
class CutAnatomy:
    """An anatomy whose edges were halved at rest until none was longer than a length.

    Parameters
    ----------
    anatomy : Anatomy
        The vertices that were given come first in each tissue.
    splits : mapping of tissue to number of split edges
    given : Anatomy
        As it was before: what does not cross itself there may come to do so by the rounding of an edge's middle.
    """

    anatomy: Anatomy
    splits: dict[str, int]
    given: Anatomy


def cut_at_rest(anatomy: Anatomy, *, longest_mm: float | EdgeLengths, whole: frozenset[str]) -> CutAnatomy:
    """The same surfaces with no edge longer than a length, for a march to be tested at: no bend hides in between.

    Parameters
    ----------
    anatomy : Anatomy
    longest_mm : float or EdgeLengths
    whole : frozenset of str
        Tissues that are not split: bones that move rigidly.
    """
    cut = [
        t if t.name in whole else replace(t, surface=with_short_edges(t.surface, longest_mm=longest_mm))
        for t in anatomy
    ]
    more = {t.name: len(t.surface.vertices) - len(anatomy[t.name].surface.vertices) for t in cut}
    return CutAnatomy(
        Anatomy(tuple(cut), anatomy.frame), {name: number for name, number in more.items() if number}, anatomy
    )


@dataclass(slots=True)
class _Work:
    """One tissue on its way: its surface at rest, which of the riders its vertices are, and where they are."""

    name: str
    surface: TriMesh
    rows: Int
    moved: Points
    jacobians: Gradients


def carried(anatomy: Anatomy, deformation: Deformation) -> Carried:
    """Move the given vertices and no others."""
    moved, jacobians = deformation.with_jacobian(anatomy.vertices())
    return Carried(anatomy, anatomy.with_vertices(moved), np.linalg.det(jacobians), {}, 0)


def carried_finely(
    anatomy: Anatomy,
    deformation: Deformation,
    *,
    tolerance_mm: float,
    longest_mm: float | EdgeLengths,
    whole: frozenset[str],
    progress: Progress,
) -> Carried:
    """Move the tissues by a finished map, cut finer where it bends them; see `finely_carried`.

    Parameters
    ----------
    anatomy : Anatomy
    deformation : Deformation
    tolerance_mm : float
    longest_mm : float or EdgeLengths
    whole : frozenset of str
        Tissues that are not split: bones that move rigidly.
    """
    cut = cut_at_rest(anatomy, longest_mm=longest_mm, whole=whole)
    riders = PlainRiders.of(deformation, cut.anatomy.vertices())
    return finely_carried(cut, riders, tolerance_mm=tolerance_mm, whole=whole, progress=progress)[0]


def finely_carried(
    cut: CutAnatomy, riders: Riders, *, tolerance_mm: float, whole: frozenset[str], progress: Progress
) -> tuple[Carried, Riders]:
    r"""Move the tissues, splitting edges whose middle would be off the map by more than the tolerance.

    The middle of an edge e is off by about :math:`|(J_1 - J_0)\, e| / 8`, J the Jacobians at its ends; edges must be
    short enough before that no bend hides between their ends. The map is one-to-one, so that fine enough surfaces of
    disjoint tissues stay disjoint, and those that do not cross themselves come to none: where triangles still do, they
    are cut finer, as long as that leaves fewer that cross.

    The new vertices join the riders, which may change the map: then all that was moved before is moved anew.

    Parameters
    ----------
    cut : CutAnatomy
    riders : Riders
        Of the map, with ``cut.anatomy.vertices()`` as the first that joined.
    tolerance_mm : float
    whole : frozenset of str
        Tissues that are not split: bones that move rigidly.

    Returns
    -------
    Carried, Riders
        The tissues, and the map that they were moved by in the end.
    """
    refinement = _Refinement(cut, riders, tolerance_mm=tolerance_mm, whole=whole)
    with (progress or Silent()).stage("refine surfaces") as tick:
        refinement.follow_bends(tick)
        refinement.part_crossings(tick)
    return refinement.carried(), refinement.riders


class _Refinement:
    """Surfaces on their way to being fine enough; the riders change with every round."""

    def __init__(self, cut: CutAnatomy, riders: Riders, *, tolerance_mm: float, whole: frozenset[str]) -> None:
        anatomy = cut.anatomy
        self.riders = riders
        self._cut, self._tolerance_mm = cut, tolerance_mm
        where = anatomy.slices()
        rows = np.arange(len(riders.moved))
        self._works = [
            _Work(t.name, t.surface, rows[at], riders.moved[at], riders.jacobians[at])
            for t, at in ((t, where[t.name]) for t in anatomy)
        ]
        self._open = [work for work in self._works if work.name not in whole]
        self._bent_left = self._crossings_left = self._unsolved = 0

    def follow_bends(self, tick: Tick) -> None:
        """Split what the map bends, round by round."""
        waiting, done = self._open, 0
        while True:
            marked = [(w, e, b) for w in waiting for e, b in [_bent(w, self._tolerance_mm)] if b.any()]
            self._bent_left = sum(int(bent.sum()) for _, _, bent in marked)
            if not marked or done == MAX_ROUNDS:
                return
            returns = self.riders.returns
            if not self._split(marked, split_bent):
                return
            if self.riders.returns == returns:
                waiting, done = [work for work, _, _ in marked], done + 1
                tick(done / (MAX_ROUNDS + MAX_CROSSING_ROUNDS))
            else:  # what was straight enough may not be any more under another map
                waiting = self._open

    def part_crossings(self, tick: Tick) -> None:
        """Halve what comes to cross, tissue by tissue, until it does not or halving no longer makes it fewer."""
        given = self._cut.given
        shortest = SHORTEST_SHARE * self._tolerance_mm
        fewest: dict[str, tuple[int, TriMesh, Int]] = {}
        last: dict[str, int] = {}
        idle: dict[str, int] = {}
        waiting = [(work, pairs) for work in self._open if len(pairs := _crossing_pairs(work))]
        # What crosses itself as given stays.
        waiting = [(w, pairs) for w, pairs in waiting if not len(self_crossings(given[w.name].surface).pairs)]
        for done in range(MAX_CROSSING_ROUNDS + 1):
            marked = []
            for work, pairs in waiting:
                if not len(pairs):
                    fewest.pop(work.name, None)
                    continue
                name, count = work.name, len(pairs)
                if name not in fewest or count < fewest[name][0]:
                    fewest[name] = (count, work.surface, work.rows)
                idle[name] = idle.get(name, 0) + 1 if count >= last.get(name, count + 1) else 0
                last[name] = count
                edges, crossing = _longest_of_crossing(work, pairs, shortest)
                if crossing.any() and idle[name] < PATIENCE and count < max(MULTIPLIED * fewest[name][0], MANY):
                    marked.append((work, edges, crossing))
            if not marked or done == MAX_CROSSING_ROUNDS or not self._split(marked, split_edges):
                break
            waiting = [(work, _crossing_pairs(work)) for work, _, _ in marked]
            tick((MAX_ROUNDS + done + 1) / (MAX_ROUNDS + MAX_CROSSING_ROUNDS))
        for work in self._works:
            if work.name in fewest:
                number, work.surface, work.rows = fewest[work.name]
                self._crossings_left += number
        self._look_up()

    def carried(self) -> Carried:
        """The tissues as they are now."""
        given = self._cut.anatomy
        rest = Anatomy(tuple(replace(given[w.name], surface=w.surface) for w in self._works), given.frame)
        deformed = Anatomy(
            tuple(replace(given[w.name], surface=w.surface.with_vertices(w.moved)) for w in self._works), given.frame
        )
        more = {w.name: len(w.rows) - len(given[w.name].surface.vertices) for w in self._works}
        splits = {name: number + self._cut.splits.get(name, 0) for name, number in more.items()}
        return Carried(
            rest,
            deformed,
            np.linalg.det(np.concatenate([w.jacobians for w in self._works])),
            {name: number for name, number in splits.items() if number},
            self._bent_left,
            self._crossings_left,
            self._unsolved,
        )

    def _split(
        self,
        marked: Sequence[tuple[_Work, FaceEdges, Bool]],
        finer_of: Callable[[TriMesh, FaceEdges, Bool], TriMesh],
    ) -> bool:
        """Split the marked edges and let the new vertices join; nothing changes where the map has no place for them."""
        finer = [finer_of(work.surface, edges, split) for work, edges, split in marked]
        fresh = [surface.vertices[len(work.rows) :] for surface, (work, _, _) in zip(finer, marked, strict=True)]
        joined, returns = self.riders.joined(np.concatenate(fresh)), self.riders.returns
        if joined is None:
            self._unsolved = sum(len(part) for part in fresh)
            return False
        first = len(self.riders.moved)
        self.riders = joined
        for (work, _, _), surface, part in zip(marked, finer, fresh, strict=True):
            work.surface, work.rows = surface, np.append(work.rows, np.arange(first, first + len(part)))
            first += len(part)
        self._look_up(None if joined.returns != returns else [work for work, _, _ in marked])
        return True

    def _look_up(self, works: Sequence[_Work] | None = None) -> None:
        """Where the vertices of some tissues are, or of all."""
        moved, jacobians = self.riders.moved, self.riders.jacobians
        for work in self._works if works is None else works:
            work.moved, work.jacobians = moved[work.rows], jacobians[work.rows]


def _crossing_pairs(work: _Work) -> Int:
    """(p, 2) pairs of triangles of a tissue that cross after the map, by more than rounding."""
    moved = work.surface.with_vertices(work.moved)
    return self_crossings(moved).deeper(moved, than_mm=TOUCHING_MM)


def _longest_of_crossing(work: _Work, pairs: Int, shortest_mm: float) -> tuple[FaceEdges, Bool]:
    """The edges of a tissue, and the longest one of each crossing triangle.

    What crosses are mostly caps, triangles whose apex almost lies on their longest edge: that edge alone is in the way.
    """
    edges = FaceEdges.of(work.surface.faces)
    a, b = edges.ends.T
    lengths = np.linalg.norm(work.surface.vertices[b] - work.surface.vertices[a], axis=1)
    marked: Bool = longest_edges(work.surface.vertices, edges, np.unique(pairs)) & (lengths > shortest_mm)
    return edges, marked


def bent_edges(edges: FaceEdges, vertices: Points, jacobians: Gradients, *, tolerance_mm: float) -> Bool:
    r"""(e,) which edges have a middle that a map takes farther than a tolerance from the middle of where their ends go.

    By about :math:`|(J_1 - J_0)\, e| / 8`, J the Jacobians at the ends of an edge e.

    Parameters
    ----------
    edges : FaceEdges
    vertices : (n, 3) float64, mm
        At rest.
    jacobians : (n, 3, 3) float64
        Of the map there.
    tolerance_mm : float
    """
    a, b = edges.ends.T
    turned = np.einsum("eij,ej->ei", jacobians[b] - jacobians[a], vertices[b] - vertices[a])
    bent: Bool = np.linalg.norm(turned, axis=1) / 8.0 > tolerance_mm
    return bent


def split_bent(surface: TriMesh, edges: FaceEdges, bent: Bool) -> TriMesh:
    """A surface with bent edges split, and with them the longest edge of every triangle that has one.

    Without the longest ones, a short bent edge would be cut from thinner and thinner triangles, whose long edges come
    to be bent in turn: no number of rounds would end that.

    References
    ----------
    M.-C. Rivara, Int. J. Numer. Methods Eng. 20 (1984) 745 (longest-side bisection).
    """
    beside = np.flatnonzero(bent[edges.of_face].any(axis=1))
    return split_edges(surface, edges, bent | longest_edges(surface.vertices, edges, beside))


def _bent(work: _Work, tolerance_mm: float) -> tuple[FaceEdges, Bool]:
    """The edges of a tissue, and which of them the map bends beyond the tolerance."""
    edges = FaceEdges.of(work.surface.faces)
    return edges, bent_edges(edges, work.surface.vertices, work.jacobians, tolerance_mm=tolerance_mm)
