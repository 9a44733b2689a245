"""Overlapping tissues -> tissues that share no point, by a stated rule, with what each pair and tissue lost; no files.

*Priority*: of two that overlap, the one further in keeps all (bone before muscle before other, and within a kind the
smaller), the other loses the overlap. *Split*: two of one kind part the overlap where they are equally deep; between
kinds, and where one lies in the other, priority holds. All cuts are made with the tissues as they were given, so their
order does not matter, and leave a stated clearance, so that the results are apart in exact arithmetic. The skin holds
the others and is left alone.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from musclefit.anatomy.midsurfaces import halves, own_sides
from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.repair import tidied
from musclefit.anatomy.repairs import Change, RepairSettings
from musclefit.errors import InputError
from musclefit.geometry.booleans import difference, grown_by, shared
from musclefit.geometry.crossings import crossings_between
from musclefit.geometry.faults import Faults, faults_of
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.solids import ROUNDING_MM3, candidate_pairs
from musclefit.geometry.volumes import enclosed_volume
from musclefit.geometry.winding import winding_numbers
from musclefit.progress import Progress

CLEARANCE_MM = 0.02
"""Distance that a cut aims to leave between two tissues, mm."""

SPLIT_WORDS = "split: each keeps what it is deeper in"

ROUNDS = 4
"""How often a tissue that still meets another is cut anew, with twice the clearance each time."""


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
    vanished : tuple of str
        Tissues of which nothing was left; not in the anatomy.
    """

    anatomy: Anatomy
    pairs: tuple[PairResolution, ...]
    cuts: tuple[TissueCut, ...]
    left: tuple[tuple[str, str], ...]
    vanished: tuple[str, ...]


@dataclass(slots=True)
class _Split:
    """An overlap that two surfaces part, and the tools made for it so far, by clearance."""

    sides: tuple[TriMesh, TriMesh]
    common: TriMesh
    tools: dict[float, tuple[TriMesh, TriMesh]] = field(default_factory=dict)

    def tool(self, side: int, clearance_mm: float) -> TriMesh:
        """What to take from the first (0) or the second (1) surface."""
        if clearance_mm not in self.tools:
            self.tools[clearance_mm] = halves(self.sides, self.common, clearance_mm=clearance_mm)
        return self.tools[clearance_mm][side]


@dataclass(slots=True)
class _Plan:
    """What to take from one tissue: whole winners, and its side of pairs that are split."""

    winners: list[str] = field(default_factory=list)
    splits: list[tuple[_Split, int]] = field(default_factory=list)


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
    tissues = {tissue.name: tissue for tissue in anatomy if tissue.kind is not TissueKind.SKIN}
    plans, pairs = _planned(tissues, rule=rule, progress=progress)
    results: dict[str, Tissue] = {}
    cuts: dict[str, TissueCut] = {}
    vanished: list[str] = []
    clearance = dict.fromkeys(plans, CLEARANCE_MM)
    waiting = list(plans)
    left: list[tuple[str, str]] = []
    for attempt in range(ROUNDS):
        with progress.stage(f"cuts, round {attempt + 1}") as tick:
            for done, name in enumerate(waiting, start=1):
                cut = _cut(tissues, name, plans[name], clearance_mm=clearance[name])
                mesh, changes = (
                    tidied(cut, settings=settings, most_mm=0.25 * clearance[name]) if len(cut.faces) else (cut, ())
                )
                tick(done / len(waiting))
                if not len(mesh.faces):
                    vanished.append(name)
                    continue
                results[name] = Tissue(name, tissues[name].kind, mesh)
                before, after = enclosed_volume(tissues[name].surface), enclosed_volume(mesh)
                cuts[name] = TissueCut(name, before, after, clearance[name], changes, faults_of(mesh))
        now = {name: results.get(name, tissue) for name, tissue in tissues.items() if name not in vanished}
        left = _meeting(now, changed=set(waiting), progress=progress)
        bad = {name for pair in left for name in pair if name in plans}
        waiting = sorted(bad | {name for name, cut in cuts.items() if not cut.after.none})
        for name in waiting:
            clearance[name] *= 2.0
        if not waiting:
            break
    if vanished:
        raise InputError(
            f"nothing is left of {vanished[0]!r}: it lies wholly inside tissues that go before it. Leave it out, or "
            "give it another kind"
        )
    kept = tuple(results.get(tissue.name, tissue) for tissue in anatomy)
    return Resolved(Anatomy(kept, anatomy.frame), pairs, tuple(cuts.values()), tuple(left), tuple(vanished))


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
    near = _near(tissues)
    with progress.stage("overlaps") as tick:
        for done, (one, other) in enumerate(near, start=1):
            tick(done / len(near))
            a, b = tissues[one], tissues[other]
            if not goes_before(a, b):
                a, b = b, a
            common = shared(a.surface, b.surface)
            volume = enclosed_volume(common) if len(common.faces) else 0.0
            if volume <= ROUNDING_MM3 and not _crosses(a.surface, b.surface):
                continue
            sides = own_sides(a.surface, b.surface, common) if rule is Rule.SPLIT and a.kind is b.kind else ()
            if volume > ROUNDING_MM3 and sides and all(len(side.faces) for side in sides):
                split = _Split(sides, common)
                plans[a.name].splits.append((split, 0))
                plans[b.name].splits.append((split, 1))
                lost = _volume_in(common, split.tool(0, CLEARANCE_MM))
                pairs.append(PairResolution(a.name, b.name, SPLIT_WORDS, volume, lost, volume - lost))
            else:
                plans[b.name].winners.append(a.name)
                same = f"the smaller {a.kind.value}"
                why = same if a.kind is b.kind else f"{a.kind.value} before {b.kind.value}"
                pairs.append(PairResolution(a.name, b.name, f"priority: {why}", volume, 0.0, volume))
    return dict(plans), tuple(sorted(pairs, key=lambda pair: -pair.overlap_mm3))


def _cut(tissues: Mapping[str, Tissue], name: str, plan: _Plan, *, clearance_mm: float) -> TriMesh:
    tools = [grown_by(tissues[winner].surface, distance_mm=clearance_mm) for winner in plan.winners]
    tools += [split.tool(side, clearance_mm) for split, side in plan.splits]
    return difference(tissues[name].surface, tools, smooth_within_mm=0.25 * clearance_mm)


def _volume_in(common: TriMesh, tool: TriMesh) -> float:
    part = shared(common, tool)
    return enclosed_volume(part) if len(part.faces) else 0.0


def _near(tissues: Mapping[str, Tissue]) -> list[tuple[str, str]]:
    names = list(tissues)
    boxes = [np.stack([t.surface.vertices.min(axis=0), t.surface.vertices.max(axis=0)]) for t in tissues.values()]
    return [(names[i], names[j]) for i, j in candidate_pairs(boxes)]


def _meeting(tissues: Mapping[str, Tissue], *, changed: set[str], progress: Progress) -> list[tuple[str, str]]:
    """Pairs with a changed tissue that cross, touch or lie in each other, exactly."""
    near = [pair for pair in _near(tissues) if changed & set(pair)]
    found = []
    with progress.stage("pairs that still meet") as tick:
        for done, (a, b) in enumerate(near, start=1):
            tick(done / len(near))
            first, second = tissues[a].surface, tissues[b].surface
            if _crosses(first, second) or _inside(first, second) or _inside(second, first):
                found.append((a, b))
    return found


def _crosses(one: TriMesh, other: TriMesh) -> bool:
    """Whether two surfaces share a point, exactly; only triangles in both bounding boxes are looked at."""
    low = np.maximum(one.vertices.min(axis=0), other.vertices.min(axis=0))
    high = np.minimum(one.vertices.max(axis=0), other.vertices.max(axis=0))
    parts = []
    for mesh in (one, other):
        corners = mesh.corners()
        near = ((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)).all(axis=1)
        parts.append(TriMesh(mesh.vertices, mesh.faces[near]))
    return bool(len(parts[0].faces) and len(parts[1].faces) and len(crossings_between(*parts)))


def _inside(one: TriMesh, other: TriMesh) -> bool:
    """Whether a surface that does not cross another starts inside it."""
    return bool(winding_numbers(other, one.vertices[one.faces[:1, 0]])[0] > 0.5)
