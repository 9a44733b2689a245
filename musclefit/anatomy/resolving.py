"""Overlapping tissues -> tissues that share no point, by a stated rule, with what each pair and tissue lost; no files.

*Priority*: of two that overlap, the one further in keeps all (bone before muscle before other, and within a kind the
smaller), the other loses the overlap. *Split*: two of one kind part the overlap where they are equally deep; between
kinds, and where one lies in the other, priority holds. All cuts are made with the tissues as they were given, so their
order does not matter, and leave a stated clearance, so that the results are apart in exact arithmetic. The skin holds
the others and is left alone.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import igl
import numpy as np

from musclefit.anatomy.midsurfaces import halves, own_sides
from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.repair import tidied
from musclefit.anatomy.repairs import Change, RepairSettings
from musclefit.errors import InputError
from musclefit.geometry.arrays import Int, Points
from musclefit.geometry.booleans import as_manifold, as_mesh, difference, grown_by, padded, shared
from musclefit.geometry.crossings import crossings_between
from musclefit.geometry.faults import Faults, faults_of
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.solids import ROUNDING_MM3, candidate_pairs
from musclefit.geometry.topology import closed_components
from musclefit.geometry.volumes import enclosed_volume
from musclefit.progress import Progress

CLEARANCE_MM = 0.02
"""Distance that a cut aims to leave between two tissues, mm."""

SPLIT_WORDS = "split: each keeps what it is deeper in"

ROUNDS = 6
"""How often places that still meet are cut out, with one clearance more each time."""


class Rule(StrEnum):
    """Who keeps what two tissues share; ``NONE`` leaves it shared."""

    NONE = "none"
    PRIORITY = "priority"
    SPLIT = "split"


@dataclass(frozen=True, slots=True)
class PairResolution:
    """One overlapping pair.

    ``overlap_mm3`` is what the two shared; ``a`` lost ``from_a_mm3`` of it and ``b`` the rest. ``rule`` says why.
    """

    a: str
    b: str
    rule: str
    overlap_mm3: float
    from_a_mm3: float
    from_b_mm3: float


@dataclass(frozen=True, slots=True)
class TissueCut:
    """One tissue that was cut: volumes, the clearance that it took, what was tidied, and the faults left."""

    name: str
    volume_before_mm3: float
    volume_after_mm3: float
    clearance_mm: float
    changes: tuple[Change, ...]
    after: Faults


@dataclass(frozen=True, eq=False, slots=True)
class Resolved:
    """An anatomy without overlaps, or with those that are ``left``.

    Parameters
    ----------
    anatomy : Anatomy
        Tissues that overlapped nothing, or kept what they shared, are the very same.
    pairs : tuple of PairResolution
        Largest overlap first.
    cuts : tuple of TissueCut
    left : tuple of (name, name)
        Pairs that still meet.
    """

    anatomy: Anatomy
    pairs: tuple[PairResolution, ...]
    cuts: tuple[TissueCut, ...]
    left: tuple[tuple[str, str], ...]


@dataclass(slots=True)
class _Split:
    """An overlap that two surfaces part, and the tools for it, once they are made."""

    sides: tuple[TriMesh, TriMesh]
    common: TriMesh
    tools: list[TriMesh] = field(default_factory=list)

    def tool(self, side: int) -> TriMesh:
        """What to take from the first (0) or the second (1) surface."""
        if not self.tools:
            self.tools += halves(self.sides, self.common, clearance_mm=CLEARANCE_MM)
        return self.tools[side]


@dataclass(slots=True)
class _Plan:
    """What to take from one tissue: whole winners, and its side of pairs that are split."""

    winners: list[str] = field(default_factory=list)
    splits: list[tuple[_Split, int]] = field(default_factory=list)


@dataclass(slots=True)
class _Work:
    """What was done to one tissue so far."""

    clearance_mm: float
    changes: list[Change] = field(default_factory=list)


@dataclass(frozen=True, eq=False, slots=True)
class _Meeting:
    """Two tissues that share a point: faces of the winner that cross the loser, or one lies in the other."""

    winner: str
    loser: str
    faces: Int
    inside: bool


def resolved(anatomy: Anatomy, *, rule: Rule, settings: RepairSettings, progress: Progress) -> Resolved:
    """Make the tissues of an anatomy, the skin left out, pairwise disjoint.

    Parameters
    ----------
    anatomy : Anatomy
        Of surfaces that bound solids.
    rule : Rule
    settings : RepairSettings
        Pieces that a cut leaves and that are stray or thin by these are taken out, and counted.
    progress : Progress

    Raises
    ------
    MeshError
        A surface is no closed oriented 2-manifold.
    InputError
        A tissue would lose all it has.
    """
    given = {tissue.name: tissue for tissue in anatomy if tissue.kind is not TissueKind.SKIN}
    plans, pairs = _planned(given, rule=rule, progress=progress)
    now, work = dict(given), {name: _Work(CLEARANCE_MM) for name in plans}
    with progress.stage("cuts") as tick:
        for done, (name, plan) in enumerate(plans.items(), start=1):
            now[name] = _tidied(given[name], _tools(given, plan), work[name], settings=settings)
            tick(done / len(plans))
    known = [(pair.a, pair.b) for pair in pairs]
    meetings = _meetings(now, known, given=given, progress=progress)
    for attempt in range(ROUNDS):
        # cuts only take away, so pairs that were apart are looked at once the others are apart
        meetings = meetings or _meetings(now, _near(now, changed=set(work)), given=given, progress=progress)
        if not meetings:
            break
        with progress.stage(f"places that still meet, round {attempt + 1}") as tick:
            losers, before = sorted({meeting.loser for meeting in meetings}), dict(now)
            for done, name in enumerate(losers, start=1):
                own = work.setdefault(name, _Work(CLEARANCE_MM))
                own.clearance_mm = CLEARANCE_MM * (attempt + 1)
                lost = [meeting for meeting in meetings if meeting.loser == name]
                tools = [tool for one in lost for tool in _tools_at(before, one, clearance_mm=own.clearance_mm)]
                now[name] = _tidied(now[name], tools, own, settings=settings)
                tick(done / len(losers))
        known = sorted({*known, *((meeting.winner, meeting.loser) for meeting in meetings)})
        meetings = _meetings(now, [pair for pair in known if set(losers) & set(pair)], given=given, progress=progress)
    else:
        meetings = _meetings(now, _near(now, changed=set(work)), given=given, progress=progress)
    kept = tuple(now.get(tissue.name, tissue) for tissue in anatomy)
    cuts = tuple(_said_cut(given[name], now[name], own) for name, own in work.items())
    left = tuple((meeting.winner, meeting.loser) for meeting in meetings)
    return Resolved(Anatomy(kept, anatomy.frame), pairs, cuts, left)


def goes_before(a: Tissue, b: Tissue) -> bool:
    """Whether ``a`` keeps what it shares with ``b`` under priority."""
    order = list(TissueKind)
    rank = order.index(a.kind) - order.index(b.kind)
    return rank > 0 or (rank == 0 and (enclosed_volume(a.surface), a.name) < (enclosed_volume(b.surface), b.name))


def _planned(
    tissues: Mapping[str, Tissue], *, rule: Rule, progress: Progress
) -> tuple[dict[str, _Plan], tuple[PairResolution, ...]]:
    """Who loses what to whom, and the pairs."""
    plans: dict[str, _Plan] = defaultdict(_Plan)
    pairs: list[PairResolution] = []
    near = _near(tissues, changed=tissues)
    solids = {name: as_manifold(tissue.surface) for name, tissue in tissues.items()}
    with progress.stage("overlaps") as tick:
        for done, (one, other) in enumerate(near, start=1):
            tick(done / len(near))
            a, b = tissues[one], tissues[other]
            if not goes_before(a, b):
                a, b = b, a
            common = as_mesh(solids[a.name] ^ solids[b.name])
            volume = enclosed_volume(common) if len(common.faces) else 0.0
            if volume <= ROUNDING_MM3 and not len(_crossing_faces(a.surface, b.surface)):
                continue
            sides = own_sides(a.surface, b.surface, common) if rule is Rule.SPLIT and a.kind is b.kind else ()
            if volume > ROUNDING_MM3 and sides and all(len(side.faces) for side in sides):
                split = _Split(sides, common)
                plans[a.name].splits.append((split, 0))
                plans[b.name].splits.append((split, 1))
                lost = _volume_in(common, split.tool(0))
                pairs.append(PairResolution(a.name, b.name, SPLIT_WORDS, volume, lost, volume - lost))
            else:
                plans[b.name].winners.append(a.name)
                same = f"the smaller {a.kind.value}"
                why = same if a.kind is b.kind else f"{a.kind.value} before {b.kind.value}"
                pairs.append(PairResolution(a.name, b.name, f"priority: {why}", volume, 0.0, volume))
    return dict(plans), tuple(sorted(pairs, key=lambda pair: -pair.overlap_mm3))


def _tools(given: Mapping[str, Tissue], plan: _Plan) -> list[TriMesh]:
    tools = [grown_by(given[winner].surface, distance_mm=CLEARANCE_MM) for winner in plan.winners]
    return tools + [split.tool(side) for split, side in plan.splits]


def _tools_at(now: Mapping[str, Tissue], meeting: _Meeting, *, clearance_mm: float) -> list[TriMesh]:
    """What to take from the loser where it still meets the winner: the surroundings of the winner's triangles there."""
    winner = now[meeting.winner].surface
    tools = [grown_by(winner, distance_mm=clearance_mm)] if meeting.inside else []
    if len(meeting.faces):
        tools.append(padded(winner, meeting.faces, distance_mm=clearance_mm))
    return tools


def _tidied(tissue: Tissue, tools: list[TriMesh], work: _Work, *, settings: RepairSettings) -> Tissue:
    cut = difference(tissue.surface, tools, smooth_within_mm=0.25 * work.clearance_mm)
    mesh, changes = tidied(cut, settings=settings, most_mm=0.25 * work.clearance_mm) if len(cut.faces) else (cut, ())
    if not len(mesh.faces):
        raise InputError(
            f"nothing is left of {tissue.name!r}: it lies wholly inside tissues that go before it. Leave it out, or "
            "give it another kind"
        )
    work.changes += changes
    return Tissue(tissue.name, tissue.kind, mesh)


def _said_cut(before: Tissue, after: Tissue, work: _Work) -> TissueCut:
    return TissueCut(
        after.name,
        enclosed_volume(before.surface),
        enclosed_volume(after.surface),
        work.clearance_mm,
        tuple(work.changes),
        faults_of(after.surface),
    )


def _volume_in(common: TriMesh, tool: TriMesh) -> float:
    part = shared(common, tool)
    return enclosed_volume(part) if len(part.faces) else 0.0


def _near(tissues: Mapping[str, Tissue], *, changed: Collection[str]) -> list[tuple[str, str]]:
    """Pairs with a changed tissue whose boxes touch."""
    names = list(tissues)
    boxes = [np.stack([t.surface.vertices.min(axis=0), t.surface.vertices.max(axis=0)]) for t in tissues.values()]
    pairs = [(names[i], names[j]) for i, j in candidate_pairs(boxes)]
    return [pair for pair in pairs if pair[0] in changed or pair[1] in changed]


def _meetings(
    tissues: Mapping[str, Tissue],
    pairs: Sequence[tuple[str, str]],
    *,
    given: Mapping[str, Tissue],
    progress: Progress,
) -> list[_Meeting]:
    """Those of the pairs that cross, touch or lie in each other, exactly; who goes before is as at the start."""
    found = []
    starts = {name: _starts(tissues[name].surface) for name in {name for pair in pairs for name in pair}}
    with progress.stage("pairs that still meet") as tick:
        for done, (one, other) in enumerate(pairs, start=1):
            tick(done / len(pairs))
            first = goes_before(given[one], given[other])
            winner, loser = (one, other) if first else (other, one)
            a, b = tissues[winner].surface, tissues[loser].surface
            faces = _crossing_faces(a, b)
            inside = not len(faces) and (_any_inside(starts[winner], b) or _any_inside(starts[loser], a))
            if len(faces) or inside:
                found.append(_Meeting(winner, loser, faces, inside))
    return found


def _crossing_faces(one: TriMesh, other: TriMesh) -> Int:
    """Faces of the first surface that share a point with the second, exactly; only those in both boxes are tried."""
    low = np.maximum(one.vertices.min(axis=0), other.vertices.min(axis=0))
    high = np.minimum(one.vertices.max(axis=0), other.vertices.max(axis=0))
    numbers = []
    for mesh in (one, other):
        corners = mesh.corners()
        numbers.append(np.flatnonzero(((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)).all(axis=1)))
    if not all(len(near) for near in numbers):
        return np.zeros(0, dtype=np.int64)
    parts = [TriMesh(mesh.vertices, mesh.faces[near]) for mesh, near in zip((one, other), numbers, strict=True)]
    return numbers[0][np.unique(crossings_between(*parts).pairs[:, 0])]


def _starts(surface: TriMesh) -> Points:
    """(p, 3) a vertex of each closed piece."""
    _, first = np.unique(closed_components(surface.faces), return_index=True)
    starts: Points = surface.vertices[surface.faces[first, 0]]
    return starts


def _any_inside(points: Points, surface: TriMesh) -> bool:
    """Whether any of a few points is inside a surface."""
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    near = np.ascontiguousarray(points[((points >= low) & (points <= high)).all(axis=1)])
    if not len(near):
        return False
    around = igl.winding_number(np.array(surface.vertices), np.array(surface.faces), near)
    return bool((np.atleast_1d(around) > 0.5).any())
