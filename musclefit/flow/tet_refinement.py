"""Tets as a map needs them: edges of tets that come out wrong are split, or their vertices moved aside."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.flow.tet_mending import MovedAside, relocated_tets
from musclefit.geometry.arrays import Float, Int, Points, Tets
from musclefit.geometry.measures import signed_volumes
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.geometry.tets.flatness import freeing_cut
from musclefit.geometry.tets.orientation import orientations
from musclefit.geometry.tets.subdivision import Incidence, independent_edges, split_edges, tets_around
from musclefit.geometry.tets.topology import tet_edges, tet_faces
from musclefit.progress import Progress

Map = Callable[[Points], Points]
"""Takes (N, 3) points at rest, mm, to where they go."""


@dataclass(frozen=True, eq=False, slots=True)
class CarriedTets:
    """Tets moved by a map, cut finer where they came out inverted or the boundary crossed itself.

    Parameters
    ----------
    rest : TetAnatomy
        At rest; new vertices are the middles of split edges and come after the old ones. It fills the same space: each
        tet was cut within itself and handed its tissue on.
    vertices : (n, 3) float64, mm
        Where the map takes the vertices of ``rest``.
    rounds, edges_split : int
    given, inverted_before, crossings_before : int
        Tets before, those of them that came out inverted or flat, and crossing pairs of boundary triangles before.
    cut_by_tissue : tuple of (tissue, tets that were cut), most first
    inverted_left, crossings_left : int
        0 unless a bound was met. Crossings are counted only where no tet is inverted.
    stopped : str
        Which bound ended it, in words; empty when nothing was left to do.
    moving_rounds : int
        Of moving vertices aside (`mended_tets`), after which ``vertices`` are no longer all where the map takes them.
    moved_aside : tuple of MovedAside
    left_out : int
        Tets of filler between held bones that were left out of ``rest``.
    left_out_mm3 : float
    """

    rest: TetAnatomy
    vertices: Points
    rounds: int
    edges_split: int
    given: int
    inverted_before: int
    crossings_before: int
    cut_by_tissue: tuple[tuple[str, int], ...]
    inverted_left: int
    crossings_left: int
    stopped: str = ""
    moving_rounds: int = 0
    moved_aside: tuple[MovedAside, ...] = ()
    left_out: int = 0
    left_out_mm3: float = 0.0


_ALL_WELL = (0, 0)
_DIVERGED, _DIVERGED_FROM = 4, 50
"""An order of splits is given up when it leaves this many times the wrong places it began with, a few more added."""
_FEW = 500
"""Wrong places up to which another order is tried after one was given up; of more, none was seen to be mended."""


@dataclass(slots=True)
class _Work:
    """A tet mesh on its way: positions at rest and moved, tets, and the tet of the given mesh each was cut from."""

    rest: Points
    moved: Points
    tets: Tets
    origin: Int
    cuts: Int
    inverted: Int = field(default_factory=lambda: np.zeros(0, np.int64))
    crossing: Int = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    """Pairs of tets behind crossing triangles."""
    edges_split: int = 0

    @classmethod
    def of(cls, rest: TetAnatomy, where: Map) -> _Work:
        """The given tets, moved."""
        tets = rest.mesh.tets
        return cls(rest.mesh.vertices, where(rest.mesh.vertices), tets, np.arange(len(tets)), np.zeros(len(tets), int))

    @property
    def wrong(self) -> tuple[int, int]:
        """Inverted tets, and pairs of boundary triangles that cross; fewer of the first is better."""
        return len(self.inverted), len(self.crossing)


@dataclass(frozen=True, eq=False, slots=True)
class HeldBones:
    """Bones that one motion takes exactly to where they must be, whatever the map does."""

    names: tuple[str, ...]
    motion: Map


def mended_tets(carried: CarriedTets, held: Sequence[HeldBones], *, progress: Progress) -> CarriedTets:
    """Put held bones exactly where they must be, and move other vertices aside where tets are wrong then.

    Parameters
    ----------
    carried : CarriedTets
    held : sequence of HeldBones
        Vertices of their tets stand where the motions take them; a vertex that two of them share stays with the map.
    progress : Progress

    Returns
    -------
    CarriedTets
        As given where nothing is held and moving left no fewer places wrong.
    """
    bone = _held_by(carried.rest, held)
    wanted = np.array(carried.vertices)
    for number, bones in enumerate(held):
        wanted[bone == number] = bones.motion(carried.rest.mesh.vertices[bone == number])
    found = relocated_tets(carried.rest, wanted, bone=bone, progress=progress)
    before, left = found.inverted_before + found.crossings_before, found.inverted_left + found.crossings_left
    if before and left >= before and not held:
        return replace(carried, stopped=f"{found.rounds} rounds of moving vertices")
    return replace(
        carried,
        rest=found.rest,
        vertices=found.vertices,
        inverted_before=carried.inverted_before or found.inverted_before,
        crossings_before=carried.crossings_before or found.crossings_before,
        inverted_left=found.inverted_left,
        crossings_left=found.crossings_left,
        stopped=f"{found.rounds} rounds of moving vertices" if left else "",
        moving_rounds=found.rounds,
        moved_aside=found.moved_aside,
        left_out=found.left_out,
        left_out_mm3=found.left_out_mm3,
    )


def _held_by(rest: TetAnatomy, held: Sequence[HeldBones]) -> Int:
    """(n,) which of the held bones each vertex belongs to; -1 for none or several."""
    bone = np.full(len(rest.mesh.vertices), -1)
    several = np.zeros(len(bone), dtype=bool)
    for number, bones in enumerate(held):
        labels = [k for k, tissue in enumerate(rest.anatomy) if tissue.name in bones.names]
        own = np.unique(rest.mesh.tets[np.isin(rest.tissue_of_tet, labels)])
        several[own] |= bone[own] >= 0
        bone[own] = number
    bone[several] = -1
    return bone


def moved_tets(rest: TetAnatomy, where: Map) -> CarriedTets:
    """Tets moved by a map and left as they are, inverted or not; nothing is counted."""
    return CarriedTets(
        rest=rest,
        vertices=where(rest.mesh.vertices),
        rounds=0,
        edges_split=0,
        given=len(rest.mesh.tets),
        inverted_before=0,
        crossings_before=0,
        cut_by_tissue=(),
        inverted_left=0,
        crossings_left=0,
        stopped="not asked for",
    )


def carried_tets(
    rest: TetAnatomy, where: Map, *, max_rounds: int, max_growth: float, progress: Progress
) -> CarriedTets:
    """Move tets, splitting edges of those that come out inverted or flat, or whose boundary faces cross.

    Of each such tet one edge is split, and with it all tets around it: the mesh stays conforming, no volume goes to
    another tissue, and the new vertices are where the map takes them. A nearly flat tet is cut where its nearest parts
    are (`geometry.tet_flatness`), which frees it however flat it is; of the others the longest edge is halved. A map
    without folds is nearly linear on small tets, so that it keeps them right-handed unless splitting makes them flatter
    and flatter. Where that happens, and few tets are wrong, all starts anew by halving longest edges alone, and then
    once more the slow way: a tet's longest edge waits until those of all tets around it are no longer than it, which
    keeps shapes (Rivara's longest-edge propagation). None of these has a proved end; the limits are its end then.

    Parameters
    ----------
    rest : TetAnatomy
    where : callable
        The map.
    max_rounds : int
    max_growth : float
        Tets at most, as a multiple of those given.

    Returns
    -------
    CarriedTets
        As given, only moved, where splitting left no fewer tets wrong than there were.
    """
    given = _judged(_Work.of(rest, where))
    best, outcomes = given, []
    with progress.stage("refine tets") as tick:
        for number, (order, share) in enumerate(_ORDERS):
            if given.wrong == _ALL_WELL:
                break
            work = replace(given)
            stopped, done = _refine(work, where, order, rounds=max(1, int(share * max_rounds)), growth=max_growth)
            tick((number + 1) / len(_ORDERS))
            outcomes.append((work, stopped, done))
            if not stopped or sum(given.wrong) > _FEW:
                break
    if outcomes:
        best, stopped, done = min(outcomes, key=lambda outcome: outcome[0].wrong)
        if best.wrong >= given.wrong:
            best = given
    else:
        stopped, done = "", 0
    return CarriedTets(
        rest=rest if best is given else _labelled(rest, best),
        vertices=best.moved,
        rounds=done,
        edges_split=best.edges_split,
        given=len(given.tets),
        inverted_before=len(given.inverted),
        crossings_before=len(given.crossing),
        cut_by_tissue=_cut_by_tissue(rest, best),
        inverted_left=len(best.inverted),
        crossings_left=len(best.crossing),
        stopped=stopped,
    )


def _refine(work: _Work, where: Map, order: _Order, *, rounds: int, growth: float) -> tuple[str, int]:
    """Split until nothing is wrong: which bound ended it before that, in words, and the rounds it took."""
    most, wrong = growth * len(work.tets), sum(work.wrong)
    for done in range(rounds):
        if work.wrong == _ALL_WELL:
            return "", done
        if sum(work.wrong) > _DIVERGED * (_DIVERGED_FROM + wrong):
            return f"splitting edges made {sum(work.wrong)} of {wrong} wrong places", done
        if len(work.tets) > most:
            return f"{len(work.tets)} tets, more than {growth:g} times those given", done
        if not _split(work, where, order(work)):
            return "no edge could be split without flattening a tet at rest", done
        _judged(work)
    return ("" if work.wrong == _ALL_WELL else f"{rounds} rounds of splitting edges"), rounds


def _judged(work: _Work) -> _Work:
    """The work with its inverted tets and, only where there is none, the crossings of the boundary."""
    work.inverted = np.flatnonzero(orientations(work.moved, work.tets) <= 0)
    work.crossing = np.zeros((0, 2), np.int64)
    if not work.inverted.size:
        faces = tet_faces(work.tets)
        pairs = self_crossings(TriMesh(work.moved, faces.boundary)).pairs
        work.crossing = faces.boundary_tets[pairs].reshape(-1, 2)
    return work


@dataclass(frozen=True, eq=False, slots=True)
class _Cut:
    """An edge, where on the way from its first to its second end it is to be split, and the tets around it."""

    ends: Int
    share: float
    around: Int


_Order = Callable[[_Work], list[_Cut]]
"""What to split next, most urgent first."""


def _wrong_tets(work: _Work) -> Int:
    return np.unique(np.concatenate([work.inverted, work.crossing.ravel()]))


def _freeing_cuts(work: _Work) -> list[_Cut]:
    """The cut that frees each flat wrong tet; the longest edge of each other one."""
    wrong = _wrong_tets(work)
    ends, lengths = _edges_by_length(work, wrong)
    near = Incidence(work.tets, work.tets[wrong].ravel())
    chosen: dict[tuple[int, int], tuple[float, _Cut]] = {}
    for tet, own, sizes in zip(wrong, ends, lengths, strict=True):
        tries = [(edge, 0.5) for edge in own]
        freeing = freeing_cut(work.rest[work.tets[tet]])
        if freeing is not None:
            i, j, share = freeing
            tries.insert(0, (work.tets[tet][[i, j]], share))
        cut = _first_possible(work, near, tries)
        if cut is not None:
            low, high = sorted(cut.ends.tolist())
            chosen.setdefault((low, high), (sizes[0], cut))
    return [cut for _, cut in sorted(chosen.values(), key=lambda item: -item[0])]


def _longest_edges(work: _Work) -> list[_Cut]:
    """The longest edge of each wrong tet that can be split."""
    wrong = _wrong_tets(work)
    ends, lengths = _edges_by_length(work, wrong)
    near = Incidence(work.tets, work.tets[wrong].ravel())
    chosen = {}
    for own, sizes in zip(ends, lengths, strict=True):
        cut = _first_possible(work, near, [(edge, 0.5) for edge in own])
        if cut is not None:
            chosen[int(cut.ends[0]), int(cut.ends[1])] = sizes[0], cut
    return [cut for _, cut in sorted(chosen.values(), key=lambda item: -item[0])]


def _edges_no_neighbour_exceeds(work: _Work) -> list[_Cut]:
    """From the longest edge of each wrong tet on to longer ones of the tets around, until there is none."""
    ends, _ = _edges_by_length(work, _wrong_tets(work))
    seen: set[tuple[int, int]] = set()
    chosen = []
    for edge in ends[:, 0]:
        while (int(edge[0]), int(edge[1])) not in seen:
            seen.add((int(edge[0]), int(edge[1])))
            around = tets_around(work.tets, edge[None])[0]
            candidates, lengths = _edges_by_length(work, around)
            size = lengths[0][(candidates[0] == edge).all(axis=1)][0]
            longest = int(np.argmax(lengths[:, 0]))
            if lengths[longest, 0] <= size:
                cut = _Cut(edge, 0.5, around)
                chosen += [cut] if _keeps_rest(work, cut) else []
                break
            edge = candidates[longest, 0]
    return chosen


_ORDERS: tuple[tuple[_Order, float], ...] = (
    (_freeing_cuts, 1.0 / 3.0),
    (_longest_edges, 1.0 / 3.0),
    (_edges_no_neighbour_exceeds, 1.0),
)
"""The ways to choose edges, each starting anew, and the share of the rounds that each may take."""


def _first_possible(work: _Work, near: Incidence, tries: list[tuple[Int, float]]) -> _Cut | None:
    """The first cut that leaves all pieces right-handed at rest, rounding of the new vertex included."""
    for ends, share in tries:
        cut = _Cut(ends, share, near.around(ends))
        if _keeps_rest(work, cut):
            return cut
    return None


def _edges_by_length(work: _Work, tets: Int) -> tuple[Int, Float]:
    """(t, 6, 2) edges of some tets, the longest at rest first, and (t, 6) their lengths."""
    numbers, of_tet = tet_edges(work.tets[tets])
    ends = numbers[of_tet]
    lengths = np.linalg.norm(work.rest[ends[..., 0]] - work.rest[ends[..., 1]], axis=2)
    order = np.argsort(-lengths, axis=1, kind="stable")
    return np.take_along_axis(ends, order[..., None], axis=1), np.take_along_axis(lengths, order, axis=1)


def _split(work: _Work, where: Map, cuts: list[_Cut]) -> bool:
    """Split those of the edges that have no tet in common; False where there is none."""
    if not cuts:
        return False
    chosen = [cuts[number] for number in independent_edges([cut.around for cut in cuts])]
    ends = np.array([cut.ends for cut in chosen])
    middles = np.array([_new_vertex(work, cut) for cut in chosen])
    split = split_edges(work.tets, ends, len(work.rest) + np.arange(len(chosen)))
    work.cuts = work.cuts.copy()
    np.add.at(work.cuts, work.origin[split.parent[len(work.tets) :]], 1)
    work.origin = work.origin[split.parent]
    work.tets = split.tets
    work.rest = np.vstack([work.rest, middles])
    work.moved = np.vstack([work.moved, where(middles)])
    work.edges_split += len(chosen)
    return True


def _new_vertex(work: _Work, cut: _Cut) -> Float:
    a, b = work.rest[cut.ends]
    place: Float = (1.0 - cut.share) * a + cut.share * b
    return place


def _keeps_rest(work: _Work, cut: _Cut) -> bool:
    """Whether all pieces are right-handed at rest."""
    corners = work.tets[cut.around]
    local = np.vstack([work.rest[corners].reshape(-1, 3), _new_vertex(work, cut)])
    old = np.arange(4 * len(corners)).reshape(-1, 4)
    halves = np.concatenate([np.where(corners == end, len(local) - 1, old) for end in cut.ends])
    return bool((orientations(local, halves) > 0).all() and (signed_volumes(local, halves) > 0.0).all())


def _labelled(rest: TetAnatomy, work: _Work) -> TetAnatomy:
    return replace(
        rest,
        mesh=TetMesh(work.rest, work.tets),
        tissue_of_tet=rest.tissue_of_tet[work.origin],
    )


def _cut_by_tissue(rest: TetAnatomy, work: _Work) -> tuple[tuple[str, int], ...]:
    counts = np.bincount(rest.tissue_of_tet, weights=work.cuts > 0, minlength=len(rest.names)).astype(int)
    found = [(rest.names[i], int(counts[i])) for i in np.flatnonzero(counts)]
    return tuple(sorted(found, key=lambda item: (-item[1], item[0])))
