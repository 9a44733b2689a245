"""Overlapping tissues -> tissues that share no point, by a stated rule, with what each pair and tissue lost; no files.

*Priority*: of two that overlap, one keeps all and the other loses the overlap; who, `anatomy.choosing` decides pair by
pair. *Split*: two of one kind part the overlap where they are equally deep; between kinds, and where one lies in the
other, priority holds. All cuts are made with the tissues as they were given, so their order does not matter, and leave
a stated clearance; then the surroundings of triangles that are still nearer to another tissue are cut out. What is cut
is freed of slivers and, like all others, of places where it is closer to itself than half the clearance. The skin holds
the others and is left alone.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import igl
import numpy as np

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.repair.choosing import Chooser, Overlap
from musclefit.anatomy.repair.finishing import (
    SHEETS,
    SLIVER,
    SMOOTH,
    Log,
    finished,
    without_contacts,
    without_thin_walls,
)
from musclefit.anatomy.repair.midsurfaces import halves, own_sides
from musclefit.anatomy.repair.records import RepairSettings
from musclefit.anatomy.repair.resolutions import Choice, Gap, PairResolution, Resolved, Rule, ThinTissue, TissueCut
from musclefit.anatomy.repair.surface import whole_pieces
from musclefit.errors import InputError
from musclefit.geometry.arrays import Points
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.gaps import smallest_gap
from musclefit.geometry.queries.nearby_faces import faces_near
from musclefit.geometry.queries.solids import ROUNDING_MM3, Solid, candidate_pairs
from musclefit.geometry.surfaces.booleans import as_manifold, as_mesh, difference, grown_by, padded, shared
from musclefit.geometry.surfaces.crossings import crossings_between
from musclefit.geometry.surfaces.faults import faults_of
from musclefit.geometry.surfaces.thin_walls import thin_places
from musclefit.geometry.surfaces.topology import closed_components
from musclefit.progress import Progress

SPLIT_WORDS = "split: each keeps what it is deeper in"

CUT = 1.0 + SMOOTH + SLIVER + 0.5 * SHEETS
"""Distance that is cut around other tissues, in clearances: what tidying may take back of it is added."""

ROUNDS = 6
"""How often places that are still too near are cut out, a quarter of the clearance wider each time."""


@dataclass(slots=True)
class _Split:
    """An overlap that two surfaces part, and the tools for it, once they are made."""

    sides: tuple[TriMesh, TriMesh]
    common: TriMesh
    clearance_mm: float
    tools: list[TriMesh] = field(default_factory=list)

    def tool(self, side: int) -> TriMesh:
        """What to take from the first (0) or the second (1) surface."""
        if not self.tools:
            self.tools += halves(self.sides, self.common, clearance_mm=self.clearance_mm)
        return self.tools[side]


@dataclass(slots=True)
class _Plan:
    """What to take from one tissue: whole winners, and its side of pairs that are split."""

    winners: list[str] = field(default_factory=list)
    splits: list[tuple[_Split, int]] = field(default_factory=list)


@dataclass(slots=True)
class _Work:
    """What was done to one tissue so far."""

    clearance_mm: float = 0.0
    log: Log = field(default_factory=Log)


@dataclass(frozen=True, eq=False, slots=True)
class _Planned:
    """What to take from each tissue, the pairs that overlap, and who loses where two are near each other."""

    plans: dict[str, _Plan]
    pairs: tuple[PairResolution, ...]
    losers: dict[frozenset[str], str]
    chooser: Chooser

    def loser(self, one: str, other: str) -> str:
        """As decided for pairs that overlap, by kind and size for the others."""
        return self.losers.get(frozenset((one, other))) or self.chooser.before(one, other)[1]


class _Tissues:
    """Tissues that change, and their solids, each made once until the tissue changes."""

    def __init__(self, given: Mapping[str, Tissue]) -> None:
        self.now = dict(given)
        self._solids: dict[str, Solid] = {}

    def change(self, name: str, surface: TriMesh) -> None:
        """Put another surface in place of a tissue's."""
        if surface is not self.now[name].surface:
            self.now[name] = Tissue(name, self.now[name].kind, surface)
            self._solids.pop(name, None)

    def solid(self, name: str) -> Solid:
        """A tissue as a solid, as it is now."""
        if name not in self._solids:
            surface = self.now[name].surface
            self._solids[name] = Solid(as_manifold(surface), _box(surface), enclosed_volume(surface))
        return self._solids[name]

    def near(self, *, within_mm: float, changed: Collection[str]) -> list[tuple[str, str]]:
        """Pairs with a changed tissue whose boxes come within a distance."""
        names, grow = list(self.now), np.array([[-0.5], [0.5]]) * within_mm
        pairs = candidate_pairs([_box(tissue.surface) + grow for tissue in self.now.values()])
        found = [(names[i], names[j]) for i, j in pairs]
        return [(a, b) for a, b in found if a in changed or b in changed]

    def gaps(self, *, below_mm: float, changed: Collection[str]) -> tuple[Gap, ...]:
        """Pairs with a changed tissue that are apart by less than a distance, smallest gap first."""
        found = [
            Gap(a, b, smallest_gap(self.solid(a), self.solid(b), within_mm=below_mm))
            for a, b in self.near(within_mm=below_mm, changed=changed)
        ]
        return tuple(
            sorted((gap for gap in found if np.isfinite(gap.gap_mm)), key=lambda gap: (gap.gap_mm, gap.a, gap.b))
        )


def resolved(
    anatomy: Anatomy, *, rule: Rule, settings: RepairSettings, progress: Progress, choice: Choice = Choice.LEAST_LOSS
) -> Resolved:
    """Make the tissues of an anatomy, the skin left out, pairwise disjoint, with a clearance.

    Parameters
    ----------
    anatomy : Anatomy
        Of surfaces that bound solids.
    rule : Rule
    settings : RepairSettings
        Pieces that a cut leaves and that are stray or thin by these are taken out, and counted.
    progress : Progress
    choice : Choice

    Raises
    ------
    MeshError
        A surface is not a closed oriented 2-manifold.
    InputError
        A tissue would lose all it has.
    """
    given = {tissue.name: tissue for tissue in anatomy if tissue.kind is not TissueKind.SKIN}
    tissues, work = _Tissues(given), {name: _Work() for name in given}
    planned = _planned(tissues, rule=rule, choice=choice, settings=settings, progress=progress)
    distance = CUT * settings.clearance_mm
    grown: dict[str, TriMesh] = {}
    winners = sorted({winner for plan in planned.plans.values() for winner in plan.winners})
    with progress.stage("surroundings") as tick:
        for done, winner in enumerate(winners, start=1):
            grown[winner] = grown_by(given[winner].surface, distance_mm=distance)
            tick(done / len(winners))
    with progress.stage("cuts") as tick:
        for done, name in enumerate(planned.plans, start=1):
            work[name].clearance_mm = distance
            _cut(tissues, name, _tools(given, name, planned.plans, grown), work[name].log, settings=settings)
            tick(done / len(planned.plans))
    with progress.stage("thin places") as tick:
        for done, name in enumerate(given, start=1):
            if name not in planned.plans:
                walled = without_thin_walls(given[name].surface, work[name].log, settings=settings)
                tissues.change(name, without_contacts(walled, work[name].log, settings=settings))
            tick(done / len(given))
    _make_room(tissues, work, planned, settings=settings, progress=progress)
    with progress.stage("room that is left") as tick:
        gaps = tissues.gaps(below_mm=settings.clearance_mm, changed=given)
        tick(0.5)
        thin = _thin(tissues.now, width_mm=settings.wall_mm)
    cut = {name: own for name, own in work.items() if tissues.now[name] is not given[name]}
    return Resolved(
        Anatomy(tuple(tissues.now.get(tissue.name, tissue) for tissue in anatomy), anatomy.frame),
        planned.pairs,
        tuple(_said_cut(given[name], tissues.now[name], own, settings) for name, own in cut.items()),
        _meetings(tissues, progress=progress) if cut else (),
        settings.clearance_mm,
        gaps,
        thin,
    )


def _planned(
    tissues: _Tissues, *, rule: Rule, choice: Choice, settings: RepairSettings, progress: Progress
) -> _Planned:
    """Who loses what to whom, and the pairs."""
    given = dict(tissues.now)
    solids = {name: tissues.solid(name).manifold for name in given}
    chooser = Chooser(given, solids, choice=choice, settings=settings)
    plans: dict[str, _Plan] = defaultdict(_Plan)
    losers: dict[frozenset[str], str] = {}
    overlaps: list[Overlap] = []
    pairs: list[PairResolution] = []
    near = tissues.near(within_mm=0.0, changed=given)
    with progress.stage("overlaps") as tick:
        for done, (one, other) in enumerate(near, start=1):
            tick(done / len(near))
            a, b = (given[name] for name in chooser.before(one, other))
            common = as_mesh(solids[one] ^ solids[other])
            volume = enclosed_volume(common) if len(common.faces) else 0.0
            if volume <= ROUNDING_MM3 and not _cross(a.surface, b.surface):
                continue
            sides = own_sides(a.surface, b.surface, common) if rule is Rule.SPLIT and a.kind is b.kind else ()
            if volume > ROUNDING_MM3 and sides and all(len(side.faces) for side in sides):
                split = _Split(sides, common, CUT * settings.clearance_mm)
                plans[a.name].splits.append((split, 0))
                plans[b.name].splits.append((split, 1))
                # what lies within the clearance of the middle, both lose: half of it is said of each
                lost = 0.5 * (volume + _volume_in(common, split.tool(0)) - _volume_in(common, split.tool(1)))
                pairs.append(PairResolution(a.name, b.name, SPLIT_WORDS, volume, lost, volume - lost))
            else:
                overlaps.append(Overlap(one, other, volume))
    for made in chooser.decided(overlaps):
        plans[made.loser].winners.append(made.winner)
        losers[frozenset((made.winner, made.loser))] = made.loser
        volume = made.overlap.volume_mm3
        pairs.append(PairResolution(made.winner, made.loser, made.why, volume, 0.0, volume))
    largest_first = sorted(pairs, key=lambda pair: (-pair.overlap_mm3, pair.a, pair.b))
    return _Planned(dict(plans), tuple(largest_first), losers, chooser)


def _tools(
    given: Mapping[str, Tissue], name: str, plans: Mapping[str, _Plan], grown: Mapping[str, TriMesh]
) -> list[TriMesh]:
    """What to take from a tissue: its winners grown, each without what it loses itself to tissues that do not win."""
    own = plans[name]
    tools = [split.tool(side) for split, side in own.splits]
    for winner in own.winners:
        lost_to = plans[winner].winners if winner in plans else []
        others = [given[other].surface for other in lost_to if other not in own.winners]
        tool = difference(grown[winner], others, smooth_within_mm=0.0) if others else grown[winner]
        tools.append(tool)
    return [tool for tool in tools if len(tool.faces)]


def _make_room(
    tissues: _Tissues,
    work: Mapping[str, _Work],
    planned: _Planned,
    *,
    settings: RepairSettings,
    progress: Progress,
) -> None:
    """Cut out of tissues, in place, the surroundings of what is nearer than the clearance."""
    changed: Collection[str] = set(tissues.now)
    for attempt in range(ROUNDS):
        with progress.stage(f"places that are too near, round {attempt + 1}") as tick:
            near = tissues.gaps(below_mm=settings.clearance_mm, changed=changed)
            by_loser: dict[str, list[str]] = defaultdict(list)
            for gap in near:
                loser = planned.loser(gap.a, gap.b)
                by_loser[loser].append(gap.b if loser == gap.a else gap.a)
            before = dict(tissues.now)
            distance = (CUT + 0.25 * attempt) * settings.clearance_mm
            for done, (name, winners) in enumerate(sorted(by_loser.items()), start=1):
                surfaces = [before[winner].surface for winner in sorted(winners)]
                tools = [_tool_at(one, before[name].surface, settings.clearance_mm, distance) for one in surfaces]
                work[name].clearance_mm = distance
                _cut(tissues, name, tools, work[name].log, settings=settings)
                tick(done / len(by_loser))
        changed = set(by_loser)
        if not changed:
            return


def _tool_at(winner: TriMesh, loser: TriMesh, within_mm: float, distance_mm: float) -> TriMesh:
    """What to take from the loser: the surroundings of the winner's triangles near it, or all where one is inside."""
    faces = faces_near(winner, loser, within_mm=within_mm)
    return padded(winner, faces, distance_mm=distance_mm) if len(faces) else grown_by(winner, distance_mm=distance_mm)


def _cut(tissues: _Tissues, name: str, tools: list[TriMesh], log: Log, *, settings: RepairSettings) -> None:
    surface = tissues.now[name].surface
    left = difference(surface, tools, smooth_within_mm=SMOOTH * settings.clearance_mm)
    mesh = finished(left, log, settings=settings) if len(left.faces) else left
    if not len(mesh.faces):
        raise InputError(
            f"nothing is left of {name!r}: it lies wholly inside tissues that go before it. Leave it out, or "
            "give it another kind"
        )
    tissues.change(name, mesh)


def _said_cut(before: Tissue, after: Tissue, work: _Work, settings: RepairSettings) -> TissueCut:
    return TissueCut(
        after.name,
        enclosed_volume(before.surface),
        enclosed_volume(after.surface),
        whole_pieces(before.surface, settings),
        whole_pieces(after.surface, settings),
        work.clearance_mm,
        work.log.said(settings),
        faults_of(after.surface),
    )


def _thin(tissues: Mapping[str, Tissue], *, width_mm: float) -> tuple[ThinTissue, ...]:
    areas = {name: thin_places(tissue.surface, width_mm=width_mm).area_mm2 for name, tissue in tissues.items()}
    return tuple(ThinTissue(name, area) for name, area in areas.items() if area > 0.0)


def _volume_in(common: TriMesh, tool: TriMesh) -> float:
    part = shared(common, tool) if len(tool.faces) else tool
    return enclosed_volume(part) if len(part.faces) else 0.0


def _box(surface: TriMesh) -> Points:
    box: Points = np.stack([surface.vertices.min(axis=0), surface.vertices.max(axis=0)])
    return box


def _meetings(tissues: _Tissues, *, progress: Progress) -> tuple[tuple[str, str], ...]:
    """Pairs that cross, touch or lie in each other, exactly."""
    found = []
    pairs = tissues.near(within_mm=0.0, changed=tissues.now)
    starts = {name: _starts(tissue.surface) for name, tissue in tissues.now.items()}
    with progress.stage("pairs that still meet") as tick:
        for done, (one, other) in enumerate(pairs, start=1):
            tick(done / len(pairs))
            a, b = tissues.now[one].surface, tissues.now[other].surface
            if _cross(a, b) or _any_inside(starts[one], b) or _any_inside(starts[other], a):
                found.append((one, other))
    return tuple(found)


def _cross(one: TriMesh, other: TriMesh) -> bool:
    """Whether two surfaces share a point, exactly; only faces in both boxes are tried."""
    low = np.maximum(one.vertices.min(axis=0), other.vertices.min(axis=0))
    high = np.minimum(one.vertices.max(axis=0), other.vertices.max(axis=0))
    parts = []
    for mesh in (one, other):
        corners = mesh.corners()
        near = ((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)).all(axis=1)
        parts.append(TriMesh(mesh.vertices, mesh.faces[near]))
    return all(len(part.faces) for part in parts) and len(crossings_between(*parts)) > 0


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
