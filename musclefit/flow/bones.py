"""Bones that stay rigid: the handles' field is brought into line with their motions by a local part on lattices."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from musclefit.anatomy.model import Anatomy
from musclefit.errors import FieldError
from musclefit.fields.corrected import CorrectedField
from musclefit.fields.fitting.solenoidal import SolenoidalBackend
from musclefit.fields.locked import LockedField
from musclefit.fields.radial import RadialField
from musclefit.fields.solenoidal import SolenoidalField
from musclefit.flow.deformation import Deformation
from musclefit.flow.locks import BoneLocks, Stand, trial_without_locks
from musclefit.flow.steppers import HandleStepper, StepMaker
from musclefit.flow.steps import CayleyStep, Step, Trial
from musclefit.geometry.arrays import Bool, Float, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import DistanceTree, nearest_places, smooth_normals
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.surfaces.subdivision import FaceEdges, split_edges, with_short_edges
from musclefit.rig.handles import BoneMotions

CONTACT_REACH = 2.0
"""Around the contact zones, as far as this times their width, bones are sampled as finely as in them: between coarser
samples the field, which is steep there, would leak through the bone."""

SLIP_PASSES = 2
"""Times that the contact zone is looked at again where the field slips it to, and the correction corrected."""

MORE_ITERATIONS = 0.5
"""Of each such pass, as a share of those of the first fit."""

EXACT_PASSES, EXACT_ITERATIONS, EXACT_MM = 4, 200, 1e-10
"""Of the exact handles: conjugate gradients, started anew for what rounding left over, until they are met to this."""

MISSED_MM = 0.003
"""A correction ends sooner when it misses its data by this root mean square."""

LEAST_GAIN = 0.02
"""Share of what is missed by which a few more iterations must lower it, or they are saved."""

PATH_SAMPLES = 9
"""Poses along the path, ends included, at which the contact zone is looked for."""

NARROW_REACH = 4.0
"""How far around contacts the narrowest lattice reaches where bones are locked, in units of its spacing."""

IN_GAPS = (0.1, 0.3, 0.5)
"""Where the rule is tested beside contact zones, in units of the gap: bones that are farther apart do not slip."""

SAME_MOTION = 1e-9
"""Bones whose motions differ by less than this, in rotation entries and mm, move as one."""


@dataclass(frozen=True, eq=False, slots=True)
class RigidGroup:
    """Bones that move as one.

    Parameters
    ----------
    bones : tuple of str
    surface : TriMesh
        All their surfaces at rest, cut so finely that its vertices sample them evenly.
    contact : (v,) bool
        Vertices that come close to a bone that moves otherwise, somewhere along the path.
    given : int
        The first so many vertices are the bones' own.
    """

    bones: tuple[str, ...]
    surface: TriMesh
    contact: Bool
    given: int

    @property
    def exposed(self) -> Points:
        """(e, 3) vertices outside the contact zone, at rest, mm."""
        return self.surface.vertices[~self.contact]

    def at(self, motions: Mapping[str, RigidMotion]) -> TriMesh:
        """The surface where the motions take it."""
        return self.surface.with_vertices(motions[self.bones[0]](self.surface.vertices))


def rigid_groups(
    anatomy: Anatomy, motions: BoneMotions, *, zones_mm: Float, sampled_mm: float, contact_sampled_mm: float
) -> tuple[RigidGroup, ...]:
    """Bones of the anatomy by common motion, with the contact zones between them.

    Parameters
    ----------
    anatomy : Anatomy
    motions : BoneMotions
        Bones that they do not know are left out: they follow the soft tissue.
    zones_mm : (K, K) float64
        A vertex of one of the K groups belongs to the contact zone when it comes closer than this to the surface of
        another at one of ``PATH_SAMPLES`` poses.
    sampled_mm : float
        No edge of the groups' surfaces is longer.
    contact_sampled_mm : float
        Nor is any in and around the contact zones longer than this.
    """
    samples = poses_on_the_way(motions)
    groups = [_group(anatomy, bones, sampled_mm) for bones in moving_together(anatomy, samples)]
    surfaces = [_Nearby(group.surface) for group in groups]  # cutting edges does not change them
    found = _contacts(groups, surfaces, samples, zones_mm)
    first = [replace(group, contact=contact) for group, contact in zip(groups, found, strict=True)]
    reach, longest = CONTACT_REACH * float(zones_mm.max(initial=0.0)), contact_sampled_mm
    finer = [_graded(g.surface, g.surface.vertices[g.contact], reach=reach, longest_mm=longest) for g in first]
    graded = [replace(group, surface=surface) for group, surface in zip(first, finer, strict=True)]
    return tuple(
        replace(group, contact=np.concatenate([group.contact, contact]))
        for group, contact in zip(graded, _contacts(graded, surfaces, samples, zones_mm), strict=True)
    )


def _contacts(
    groups: Sequence[RigidGroup],
    surfaces: Sequence[_Nearby],
    samples: Sequence[Mapping[str, RigidMotion]],
    zones: Float,
) -> list[Bool]:
    """Which vertices of each group, beyond those that its contact zone knows, come closer to another than their zone.

    Each is looked at in the frame of the other bone, whose surface is the same at all poses.
    """
    new = [group.surface.vertices[len(group.contact) :] for group in groups]
    found = [np.zeros(len(vertices), dtype=bool) for vertices in new]
    for sample in samples:
        motions = [sample[group.bones[0]] for group in groups]
        for k, vertices in enumerate(new):
            for j, surface in enumerate(surfaces):
                if j != k:
                    left = np.flatnonzero(~found[k])
                    there = (motions[j].inverse() @ motions[k])(vertices[left])
                    found[k][left] = surface.closer(there, float(zones[k, j]))
    return found


def poses_on_the_way(motions: BoneMotions) -> tuple[Mapping[str, RigidMotion], ...]:
    """Where every bone stands at ``PATH_SAMPLES`` places along the path, both ends included."""
    return tuple(motions.at(float(t)) for t in np.linspace(0.0, 1.0, PATH_SAMPLES))


def moving_together(anatomy: Anatomy, poses: Sequence[Mapping[str, RigidMotion]]) -> tuple[tuple[str, ...], ...]:
    """The anatomy's bones that the poses know, those of one motion in one group."""
    together: list[list[str]] = []
    for bone in (t.name for t in anatomy if t.name in poses[-1]):
        for group in together:
            if all(_same(pose[bone], pose[group[0]]) for pose in poses):
                group.append(bone)
                break
        else:
            together.append([bone])
    return tuple(tuple(group) for group in together)


@dataclass(frozen=True, eq=False, slots=True)
class BoneStepper:
    """One step per stretch, of a field in two parts: the handles' radial sum, and a local part that holds the bones.

    The local part is the curl of a B-spline potential on lattices around the bones, so that it has no divergence. It
    takes what the radial part leaves of the rigid motions of the bones' exposed vertices (`held_points`), in the least
    squares sense, and the exact handles to the last digit. Each stretch starts from where the stretches before took the
    held points, so that errors do not add up. In the contact zone two bones slide past each other closer than any
    tissue between them could follow: there only the part along the bone's normal is held, and the field may slip.

    Parameters
    ----------
    handles : HandleStepper
        With Cayley steps and a radial backend.
    groups : sequence of RigidGroup
    motions : BoneMotions
    exact : int
        The first so many handles must arrive exactly; the others only help.
    lattices_mm : sequence of float
        Spacings of the local part's lattices.
    iterations : int
        Of the first fit of the local part, from nothing.
    locks : BoneLocks or None
        Of the groups, in their order: on the bones' surfaces and around them the field of every step is then their
        rigid motion. The held points go where the field would take them without locks (`trial_of_held`).
    gaps_mm : sequence of float
        For each group, how wide the gaps are between which bones slip: there is no tissue to test the rule at, but the
        field is steepest there. Empty: it is not tested in gaps.
    """

    handles: HandleStepper
    groups: Sequence[RigidGroup]
    motions: BoneMotions
    exact: int
    lattices_mm: Sequence[float]
    iterations: int
    locks: BoneLocks | None = None
    gaps_mm: Sequence[float] = ()

    def held_points(self) -> Points:
        """(h, 3) points at rest that a march must have as its last tested points, mm."""
        return np.concatenate([self.handles.path.position(0.0)[: self.exact], *(g.exposed for g in self.groups)])

    @property
    def shortens_exactly(self) -> bool:
        """False: bones move on curves."""
        return False

    def anchors(self, start: float) -> Points:
        """(a, 3) vertices of the contact zones, exactly on their bones at the start, and places in the gaps between.

        Where bones slip, the field is steeper between them than on them.
        """
        beside = self._in_gaps(start) if self.gaps_mm else []
        return np.concatenate([self._slipping(start), *beside])

    def makers(self, start: float, end: float) -> Iterable[StepMaker]:
        """The one step."""

        def make(tested: Points, anchors: Points) -> Step:
            here, there = self.handles.path.position(start), self.handles.path.position(end)
            targets = np.concatenate([there[: self.exact], *self._exposed(end)])
            held, anchors = tested[-len(targets) :], anchors[: sum(int(g.contact.sum()) for g in self.groups)]
            here[: self.exact] = held[: self.exact]
            base = self._base(here, there)
            local = self._local(base, held, targets, anchors, start=start, end=end)
            exact, moves = 0.5 * (here + there)[: self.exact], (there - here)[: self.exact]
            whole = CorrectedField.of(base, local)
            if self.locks is None:
                return CayleyStep(_exact_at(exact, moves, whole))
            field = LockedField(whole, self.locks.of_step(self._stands(start), self._stands(end)))
            free = ~field.locked(exact)  # the others are carried by their bones, which are exact
            return CayleyStep(replace(field, base=_exact_at(exact[free], moves[free], whole)))

        return (make,)

    def trial_of_held(self, step: Step, held: Points) -> Trial:
        """As any point; samples of locked bones go where the field takes them without locks."""
        return trial_without_locks(step, held, exact=self.exact)

    def _exposed(self, t: float) -> list[Points]:
        return [s.vertices[~g.contact] for g, s in zip(self.groups, self._surfaces(t), strict=True)]

    def _stands(self, t: float) -> list[Stand]:
        motions = self.motions.at(t)
        return [Stand.of(motions[group.bones[0]]) for group in self.groups]

    def _base(self, here: Points, there: Points) -> RadialField | CorrectedField:
        """The handles' part."""
        field = self.handles.make(self.handles.backend, here, there).field
        if not isinstance(field, RadialField | CorrectedField):
            raise FieldError(
                f"bones are held rigid in radial sums and in curls of potentials; the backend made a "
                f"{type(field).__name__}: use a RadialBackend or an IsochoricFfdBackend"
            )
        return field

    def _local(
        self,
        base: RadialField | CorrectedField,
        held: Points,
        targets: Points,
        anchors: Points,
        *,
        start: float,
        end: float,
    ) -> SolenoidalField:
        """The bones' part: exposed vertices to their targets, and contact zones along their normals."""
        surfaces = self._surfaces(end)
        places = self._slipping(end)
        _, normals = self._nearest(surfaces, places)
        middles = 0.5 * np.concatenate([held + targets, anchors + places])
        backend = SolenoidalBackend(MISSED_MM, least_gain=LEAST_GAIN)
        local = backend.at_rest([self._seen_by(h, middles, middles[len(held) :]) for h in self.lattices_mm])
        for number in range(1 + SLIP_PASSES):
            if number:
                slipped = CayleyStep(CorrectedField.of(base, local))(anchors)
                places, normals = self._nearest(surfaces, slipped)
            at = 0.5 * np.concatenate([held + targets, anchors + places])
            left = np.concatenate([targets - held, places - anchors]) - CorrectedField.of(base, local).displacement(at)
            more = backend.fit(
                at,
                left,
                slip_normals=self._half_way(normals, start=start, end=end),
                on=local.levels,
                iterations=math.ceil(MORE_ITERATIONS * self.iterations) if number else self.iterations,
            )
            local = local.plus(more)
        return local

    def _seen_by(self, spacing: float, middles: Points, contacts: Points) -> tuple[float, Points]:
        """A lattice's spacing and what it is laid around: the narrowest only around contacts, where bones are locked.

        The field need not come close to the bones elsewhere then.
        """
        if self.locks is None or not len(contacts) or spacing > min(self.lattices_mm) or len(self.lattices_mm) == 1:
            return spacing, middles
        apart = cKDTree(contacts).query(middles, distance_upper_bound=NARROW_REACH * spacing)[0]
        return spacing, middles[np.isfinite(apart)]

    def _surfaces(self, t: float) -> list[TriMesh]:
        motions = self.motions.at(t)
        return [group.at(motions) for group in self.groups]

    def _slipping(self, t: float) -> Points:
        motions = self.motions.at(t)
        return np.concatenate([motions[g.bones[0]](g.surface.vertices[g.contact]) for g in self.groups])

    def _in_gaps(self, t: float) -> list[Points]:
        """Places beside the contact zones, outside the bones."""
        places = self._slipping(t)
        _, normals = self._nearest(self._surfaces(t), places)
        gaps = np.repeat(np.asarray(self.gaps_mm, dtype=np.float64), [int(g.contact.sum()) for g in self.groups])
        return [places + (share * gaps)[:, None] * normals for share in IN_GAPS]

    def _by_group(self, contacts: Points) -> list[Points]:
        counts = [int(group.contact.sum()) for group in self.groups]
        return np.split(contacts, np.cumsum(counts)[:-1])

    def _nearest(self, surfaces: Sequence[TriMesh], contacts: Points) -> tuple[Points, Points]:
        """Nearest places on their own bones, and the normals there."""
        places, normals = [np.zeros((0, 3))], [np.zeros((0, 3))]
        for surface, part in zip(surfaces, self._by_group(contacts), strict=True):
            if len(part):
                near = nearest_places(part, surface)
                places.append(near.places)
                normals.append(smooth_normals(surface, near))
        return np.concatenate(places), np.concatenate(normals)

    def _half_way(self, normals: Points, *, start: float, end: float) -> Points:
        """Normals at the end of a stretch, turned back to its middle with their bones."""
        before, after = self.motions.at(start), self.motions.at(end)
        turned = [np.zeros((0, 3))]
        for group, part in zip(self.groups, self._by_group(normals), strict=True):
            turn = Rotation.from_matrix(after[group.bones[0]].rotation @ before[group.bones[0]].rotation.T)
            turned.append(Rotation.from_rotvec(-0.5 * turn.as_rotvec()).apply(part) if len(part) else part)
        return np.concatenate(turned)


def _exact_at(points: Points, moves: Points, field: CorrectedField) -> CorrectedField:
    """The field with the least change of its local part that takes (m, 3) points by their moves exactly."""
    for _ in range(EXACT_PASSES):
        missed = moves - field.displacement(points)
        if np.abs(missed).max(initial=0.0) <= EXACT_MM:
            break
        more = SolenoidalBackend(0.1 * EXACT_MM).fit(
            points,
            missed,
            slip_normals=np.zeros((0, 3)),
            on=field.local.levels,
            iterations=EXACT_ITERATIONS,
        )
        field = CorrectedField(field.radial, field.local.plus(more))
    return field


def contact_residuals(groups: Sequence[RigidGroup], deformation: Deformation, motions: BoneMotions) -> Float:
    """How far the field carries the contact zones off the surface of their own bone, mm, the worst of all stretches.

    Each stretch starts from the vertices exactly on their bones; there the field may slip along, but not through.
    """
    contacts = [group for group in groups if group.contact.any()]
    worst = np.zeros(sum(int(group.contact.sum()) for group in contacts))
    if not contacts:
        return worst
    for start, end, part in deformation.by_stretch():
        before, after = motions.at(start), motions.at(end)
        moved = part(np.concatenate([np.zeros((0, 3)), *(g.at(before).vertices[g.contact] for g in contacts)]))
        ends = np.cumsum([int(group.contact.sum()) for group in contacts])[:-1]
        for group, places, kept in zip(contacts, np.split(moved, ends), np.split(worst, ends), strict=True):
            np.maximum(kept, nearest_places(places, group.at(after)).distances, out=kept)
    return worst


def _group(anatomy: Anatomy, bones: Sequence[str], sampled_mm: float) -> RigidGroup:
    surface = TriMesh.together([anatomy[bone].surface for bone in bones])
    given = len(surface.vertices)
    surface = with_short_edges(surface, longest_mm=sampled_mm)
    return RigidGroup(tuple(bones), surface, np.zeros(0, dtype=bool), given)


def _graded(surface: TriMesh, around: Points, *, reach: float, longest_mm: float) -> TriMesh:
    """The surface with no edge longer than a length where both ends are within reach of given points."""
    while len(around):
        edges = FaceEdges.of(surface.faces)
        apart = np.asarray(cKDTree(around).query(surface.vertices, distance_upper_bound=reach)[0], dtype=np.float64)
        near: Bool = apart < reach
        ends = surface.vertices[edges.ends]
        split = near[edges.ends].all(axis=1) & (np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > longest_mm)
        if not split.any():
            break
        surface = split_edges(surface, edges, split)
    return surface


class _Nearby:
    """A surface, and which points are close to it; far ones are sorted out by its box and its vertices.

    Parameters
    ----------
    surface : TriMesh
    """

    def __init__(self, surface: TriMesh) -> None:
        self._low, self._high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
        corners = surface.corners()
        self._longest = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(initial=0.0))
        self._vertices, self._tree = cKDTree(surface.vertices), DistanceTree(surface)

    def closer(self, points: Points, limit: float) -> Bool:
        """(N,) which points are closer to the surface than the limit."""
        near: Bool = ((points > self._low - limit) & (points < self._high + limit)).all(axis=1)
        # No place of a triangle is farther from its nearest corner than its longest edge.
        reach = (limit + self._longest) * (1.0 + 1e-9)
        near[near] = np.isfinite(self._vertices.query(points[near], distance_upper_bound=reach)[0])
        if near.any():
            near[near] = self._tree(points[near]) < limit
        return near


def _same(a: RigidMotion, b: RigidMotion) -> bool:
    return bool(
        np.abs(a.rotation - b.rotation).max() < SAME_MOTION
        and np.abs(a.translation - b.translation).max() < SAME_MOTION
    )
