"""Tets that a map leaves inverted, mended by moving vertices off the map's places; says which and how far.

Bones that are held stand where their motions take them and never give way. All other vertices near a wrong place move
as little as keeps every tet right-handed and the boundary in front of the bones and of itself. Filler between bones
that slide past each other has no valid place at all in some poses: what still is inverted or crosses there is left out,
as joint space is. Nothing here proves anything: who calls has the result judged by exact predicates.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from musclefit.anatomy.model import TissueKind
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.geometry.arrays import Bool, Float, Int, Points, Tets
from musclefit.geometry.measures import signed_volumes
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.queries.sheet_winding import UNKNOWN, sheets_of
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.geometry.tets.orientation import orientations
from musclefit.geometry.tets.relocation import Planes, Springs, inverse_shapes, relocated
from musclefit.geometry.tets.topology import TetFaces, interface, tet_faces
from musclefit.geometry.tets.wall_planes import Divide, Wall, planes_before
from musclefit.progress import Progress

ROUNDS = 30
"""Of mending and looking again."""

STALLED = 10
"""Rounds without fewer wrong places than ever before after which it is given up."""

RINGS = 2
"""Of tets around a wrong place whose vertices may move."""

SOFTNESSES, ITERATIONS = (1.0, 0.5, 0.25, 0.125, 0.06, 0.03), 60
"""While tets are inverted: from soft to nearly a barrier, and the iterations of each."""

SHAPE, SETTLING, BARRIER = 0.1, 40, 1e-5
"""Once none is: how much shapes count beside the springs that pull to the map, the iterations, and the softness, which
is a barrier by then."""

NEARER = (0.01, 0.003)
"""Once nothing is wrong: how much shapes count as vertices come still nearer to the map, one after the other, as long
as nothing becomes wrong by it. Where shapes count so little before that, compressed tissue folds onto itself."""

HEALTHY = 0.2
"""Tets of more than this share of their volume at rest should keep the shape they have; others, that at rest."""

SPRING, FILLER_SPRING = 1.0, 0.1
"""Energy per mm² off the map once nothing is inverted; the second for vertices inside the filler."""

WEAK = 0.01
"""What springs are weakened by while tets are inverted."""

MARGIN_MM, MARGIN_STEP_MM, WIDEST_MM = 0.03, 0.1, 0.6
"""In front of bones, at first; more each time that a vertex's triangle crosses one; at most."""

DIVIDE_MM, DIVIDE_STEP_MM, WIDEST_DIVIDE_MM = 0.02, 0.03, 0.3
"""The same between triangles that crossed each other."""

LEAVING_OUT_FROM = 2
"""Round from which filler is left out."""

BETWEEN_MM = 15.0
"""Only where the distances of one of its corners from two bones add up to at most this, at rest or moved."""

OFF_MM = 0.01
"""Vertices farther than this from where they should be are counted as moved aside."""


@dataclass(frozen=True, slots=True)
class MovedAside:
    """How many vertices of a tissue are off the map by more than ``OFF_MM``, and the farthest, mm."""

    tissue: str
    vertices: int
    farthest_mm: float


@dataclass(frozen=True, eq=False, slots=True)
class Relocated:
    """Tets mended by moving vertices.

    Parameters
    ----------
    rest : TetAnatomy
        Without the filler that was left out.
    vertices : (n, 3) float64, mm
        Of ``rest``, moved.
    rounds : int
    moved_aside : tuple of MovedAside, most first
        A vertex counts for each tissue that has it.
    left_out : int
        Tets of filler.
    left_out_mm3 : float
    inverted_before, crossings_before : int
    inverted_left, crossings_left : int
        0 unless the rounds ran out; boundary faces inside tets count as crossing.
    """

    rest: TetAnatomy
    vertices: Points
    rounds: int
    moved_aside: tuple[MovedAside, ...]
    left_out: int
    left_out_mm3: float
    inverted_before: int
    crossings_before: int
    inverted_left: int
    crossings_left: int


def relocated_tets(rest: TetAnatomy, wanted: Points, *, bone: Int, progress: Progress) -> Relocated:
    """Move vertices until no tet is inverted and the boundary does not cross itself.

    Parameters
    ----------
    rest : TetAnatomy
    wanted : (n, 3) float64, mm
        Where the vertices should be.
    bone : (n,) int64
        Number of the held bones that each vertex belongs to, which stays where it should be; -1 for all others.
    progress : Progress
    """
    ground = _Ground.of(rest, wanted, bone)
    before = len(ground.inverted), len(ground.pairs)
    with progress.stage("move tet vertices") as tick:
        rounds, fewest, since = 0, sum(before), 0
        while ground.is_wrong and rounds < ROUNDS and since < STALLED:
            _mend(ground)
            _look(ground)
            rounds += 1
            fewest, since = (ground.wrong, 0) if ground.wrong < fewest else (fewest, since + 1)
            if ground.is_wrong:
                _make_room(ground, leave_out=rounds > LEAVING_OUT_FROM)
            tick(rounds / ROUNDS)
        if not ground.is_wrong:
            _come_nearer(ground)
    return _told(rest, ground, rounds, before)


@dataclass(slots=True)
class _Ground:
    """A mesh on its way; ``kept`` are the numbers of its tets in the mesh given."""

    rest: Points
    wanted: Points
    now: Points
    bone: Int
    labels: Int
    filler: int
    tets: Tets
    kept: Int
    volumes: Float
    springs: Float
    margins: Float
    walls: tuple[Wall, ...]
    faces: TetFaces
    free: Bool
    inverted: Int = field(default_factory=lambda: np.zeros(0, np.int64))
    pairs: Int = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    places: Points = field(default_factory=lambda: np.zeros((0, 3)))
    lapped: Int = field(default_factory=lambda: np.zeros(0, np.int64))
    """Boundary faces of sheets that lie inside tets, looked for once nothing else is wrong: a void of one tet that was
    left out may have turned inside out without its faces crossing."""
    divides: dict[tuple[int, ...], Divide] = field(default_factory=dict)

    @classmethod
    def of(cls, rest: TetAnatomy, wanted: Points, bone: Int) -> _Ground:
        """The given mesh where it should be, with what is wrong about it."""
        vertices, tets, labels = rest.mesh.vertices, rest.mesh.tets, rest.tissue_of_tet
        filler = next((k for k, t in enumerate(rest.anatomy) if t.kind is TissueKind.SKIN), -1)
        faces = tet_faces(tets)
        in_tissue = np.zeros(len(vertices), dtype=bool)
        in_tissue[tets[labels != filler]] = True
        groups = range(int(bone.max(initial=-1)) + 1)
        inside = [np.flatnonzero((bone[tets] == g).all(axis=1) & (labels != filler)) for g in groups]
        walls = tuple(
            Wall.of(interface(faces, own, count=len(tets)), rest=vertices, now=wanted) for own in inside if len(own)
        )
        ground = cls(
            rest=vertices,
            wanted=wanted,
            now=wanted,
            bone=bone,
            labels=labels,
            filler=filler,
            tets=tets,
            kept=np.arange(len(tets)),
            volumes=signed_volumes(vertices, tets),
            springs=np.where(in_tissue, SPRING, FILLER_SPRING),
            margins=np.full((len(walls), len(vertices)), MARGIN_MM),
            walls=walls,
            faces=faces,
            free=np.zeros(len(vertices), dtype=bool),
        )
        _look(ground)
        return ground

    @property
    def is_wrong(self) -> bool:
        """Whether a tet is inverted or flat, or the boundary crosses itself or lies inside tets."""
        return self.wrong > 0

    @property
    def wrong(self) -> int:
        """Inverted tets, crossing pairs and lapped faces."""
        return len(self.inverted) + len(self.pairs) + len(self.lapped)

    def leave_out(self, tets: Bool) -> None:
        """Go on without some tets, and without filler that hangs on nothing then."""
        kept = ~tets
        whole = np.flatnonzero(kept)
        within = tet_faces(self.tets[whole])
        ends = within.tets[within.tets[:, 1] >= 0]
        graph = coo_array((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(len(whole), len(whole)))
        _, piece = connected_components(graph, directed=False)
        hangs = np.ones(piece.max(initial=0) + 1, dtype=bool)
        hangs[piece[self.labels[whole] != self.filler]] = False
        hangs[np.bincount(piece).argmax()] = False
        kept[whole[hangs[piece]]] = False
        self.tets, self.labels, self.kept = self.tets[kept], self.labels[kept], self.kept[kept]
        self.volumes = self.volumes[kept]
        self.faces = tet_faces(self.tets)


def _look(ground: _Ground) -> None:
    """What is wrong where the vertices are now."""
    ground.inverted = np.flatnonzero(orientations(ground.now, ground.tets) <= 0)
    boundary = TriMesh(ground.now, ground.faces.boundary)
    crossings = self_crossings(boundary)
    ground.pairs, ground.places = crossings.pairs, crossings.places
    ground.lapped = np.zeros(0, np.int64)
    if not ground.wrong:
        sheets = sheets_of(boundary)
        bad = (sheets.outside != 0) & (sheets.outside != UNKNOWN)
        ground.lapped = np.flatnonzero(bad[sheets.of_face])


def _mend(ground: _Ground) -> None:
    """Untangle what is inverted, then, if nothing is, settle near where the vertices should be."""
    wrong = np.zeros(len(ground.tets), dtype=bool)
    wrong[ground.inverted] = True
    wrong[ground.faces.boundary_tets[ground.pairs.ravel()]] = True
    wrong[ground.faces.boundary_tets[ground.lapped]] = True
    near = np.zeros(len(ground.rest), dtype=bool)
    near[ground.tets[wrong]] = True
    for _ in range(RINGS):
        near[ground.tets[near[ground.tets].any(axis=1)]] = True
    ground.free |= near & (ground.bone < 0)
    patch = _Patch.of(ground)
    if not len(patch.free):
        return
    if len(ground.inverted):
        shapes, healthy = inverse_shapes(ground.rest, patch.tets), patch.ratios(ground) > HEALTHY
        shapes[healthy] = inverse_shapes(ground.now, patch.tets[healthy])
        for softness in SOFTNESSES:
            patch.relax(ground, shapes=shapes, share=1.0, spring=WEAK, softness=softness, iterations=ITERATIONS)
            if (patch.ratios(ground) > 0.0).all():
                break
    if (orientations(ground.now, ground.tets) > 0).all():
        _settle(ground, patch, share=SHAPE)


def _settle(ground: _Ground, patch: _Patch, *, share: float) -> None:
    """Come nearer to where the vertices should be, with no tet inverted."""
    shapes = inverse_shapes(ground.rest, patch.tets)
    patch.relax(ground, shapes=shapes, share=share, spring=1.0, softness=BARRIER, iterations=SETTLING)


def _come_nearer(ground: _Ground) -> None:
    """Come as near to where the vertices should be as leaves nothing wrong."""
    if not ground.free.any():
        return
    patch = _Patch.of(ground)
    for share in NEARER:
        before = ground.now
        _settle(ground, patch, share=share)
        _look(ground)
        if ground.is_wrong:
            ground.now = before
            _look(ground)
            return


@dataclass(frozen=True, eq=False, slots=True)
class _Patch:
    """The free vertices of a mesh and the tets and boundary faces around them."""

    free: Int
    tets: Tets
    volumes: Float
    walled: Int

    @classmethod
    def of(cls, ground: _Ground) -> _Patch:
        used = np.zeros(len(ground.rest), dtype=bool)
        used[ground.tets] = True
        free = ground.free & used
        around = free[ground.tets].any(axis=1)
        outer = ground.faces.boundary
        return cls(np.flatnonzero(free), ground.tets[around], ground.volumes[around], outer[free[outer].any(axis=1)])

    def ratios(self, ground: _Ground) -> Float:
        """Volumes over those at rest."""
        found: Float = signed_volumes(ground.now, self.tets) / self.volumes
        return found

    def relax(
        self, ground: _Ground, *, shapes: Float, share: float, spring: float, softness: float, iterations: int
    ) -> None:
        """Some iterations; the walls are looked at first."""
        planes = Planes.none()
        for wall, margins in zip(ground.walls, ground.margins, strict=True):
            seen = planes_before(wall, self.walled, rest=ground.rest, now=ground.now, margins=margins)
            planes = planes.and_also(seen)
        for divide in ground.divides.values():
            planes = planes.and_also(divide.planes())
        ground.now = relocated(
            ground.now,
            self.tets,
            free=self.free,
            shapes=shapes,
            weights=share * self.volumes,
            springs=Springs(ground.wanted[self.free], spring * ground.springs[self.free]),
            planes=planes,
            softness=softness,
            iterations=iterations,
        )


def _make_room(ground: _Ground, *, leave_out: bool) -> None:
    """Wider margins where triangles cross, and no filler any more where it still is wrong between held bones."""
    outer, behind = ground.faces.boundary, ground.faces.boundary_tets
    soft: Bool = np.any(ground.bone[outer] < 0, axis=1)
    filler: Bool = ground.labels[behind] == ground.filler
    both = np.concatenate([ground.pairs, ground.pairs[:, ::-1]])
    for wall, margins in zip(ground.walls, ground.margins, strict=True):
        touched = np.zeros(len(ground.rest), dtype=bool)
        touched[wall.used] = True
        near = np.unique(outer[both[touched[outer[both[:, 1]]].any(axis=1), 0]])
        margins[near] = np.minimum(margins[near] + MARGIN_STEP_MM, WIDEST_MM)
    between_bones = len(ground.walls) > 1
    dividing: Bool = np.all(soft[ground.pairs], axis=1)
    if between_bones:
        dividing = dividing & ~np.all(filler[ground.pairs], axis=1)
    _divide(ground, np.flatnonzero(dividing))
    if leave_out and between_bones:
        wrong = np.zeros(len(ground.tets), dtype=bool)
        wrong[ground.inverted] = True
        wrong[behind[ground.pairs.ravel()]] = True
        wrong[behind[ground.lapped]] = True
        wrong &= ground.labels == ground.filler
        wrong[wrong] = _between_bones(ground, ground.tets[wrong])
        if wrong.any():
            ground.leave_out(wrong)
            _look(ground)


def _between_bones(ground: _Ground, tets: Tets) -> Bool:
    """Which tets have a corner that is near two bones, at rest or now."""
    found = np.zeros(len(tets), dtype=bool)
    for positions, walls in (
        (ground.rest, [wall.rest for wall in ground.walls]),
        (ground.now, [wall.now for wall in ground.walls]),
    ):
        corners = positions[tets].reshape(-1, 3)
        apart = np.sort([nearest_places(corners, wall).distances for wall in walls], axis=0)
        found |= (apart[0] + apart[1]).reshape(-1, 4).min(axis=1, initial=np.inf) <= BETWEEN_MM
    return found


def _divide(ground: _Ground, chosen: Int) -> None:
    """A plane between the triangles of each chosen pair."""
    outer = ground.faces.boundary
    corners = ground.now[outer[ground.pairs[chosen].ravel()]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    apart = normals[0::2] - normals[1::2]
    apart /= np.maximum(np.linalg.norm(apart, axis=1, keepdims=True), 1e-12)
    for (i, j), place, normal in zip(ground.pairs[chosen], ground.places[chosen], apart, strict=True):
        first, second = outer[i], outer[j]
        key = (*first.tolist(), *second.tolist())
        old = ground.divides.get(key)
        if old is None:
            ground.divides[key] = Divide(first, second, place, normal, DIVIDE_MM)
        else:
            ground.divides[key] = old.wider(place, normal, by_mm=DIVIDE_STEP_MM, up_to_mm=WIDEST_DIVIDE_MM)


def _told(rest: TetAnatomy, ground: _Ground, rounds: int, before: tuple[int, int]) -> Relocated:
    used = np.unique(ground.tets)
    off = np.linalg.norm(ground.now - ground.wanted, axis=1)
    aside = []
    for k, name in enumerate(rest.names):
        own = off[np.unique(ground.tets[ground.labels == k])]
        if (own > OFF_MM).any():
            aside.append(MovedAside(name, int((own > OFF_MM).sum()), float(own.max())))
    left_out = np.ones(len(rest.mesh.tets), dtype=bool)
    left_out[ground.kept] = False
    mesh = TetMesh(rest.mesh.vertices[used], np.searchsorted(used, ground.tets))
    return Relocated(
        rest=replace(rest, mesh=mesh, tissue_of_tet=ground.labels) if left_out.any() else rest,
        vertices=ground.now[used] if left_out.any() else ground.now,
        rounds=rounds,
        moved_aside=tuple(sorted(aside, key=lambda item: (-item.vertices, item.tissue))),
        left_out=int(left_out.sum()),
        left_out_mm3=float(signed_volumes(rest.mesh.vertices, rest.mesh.tets[left_out]).sum()),
        inverted_before=before[0],
        crossings_before=before[1],
        inverted_left=len(ground.inverted),
        crossings_left=len(ground.pairs) + len(ground.lapped),
    )
