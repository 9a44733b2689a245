"""Bones that stay rigid: after each step of the handles, compact corrections bring the field into line with them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from musclefit.anatomy.model import Anatomy
from musclefit.fields.compact import CompactBackend
from musclefit.flow.deformation import Deformation
from musclefit.flow.steppers import HandleStepper, StepMaker
from musclefit.flow.steps import CayleyStep, Step
from musclefit.geometry.arrays import Bool, Float, Points
from musclefit.geometry.distances import nearest_places, smooth_normals, thinned
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.subdivision import with_short_edges
from musclefit.rig.handles import BoneMotions

CORRECTION_KERNEL = "isochoric-wendland-c6"
CORRECTION_TOLERANCE = 0.01
"""Share of a correction's residual that its iteration may leave; the next level, or the next step, takes it up."""

SPACING_SHARE = 0.13
"""Sources of a correction stand this share of its support apart: as many as it can tell apart."""

FINEST_MM = 0.5
"""Sources of the last correction stand this far apart: nearly every sample of the bones."""

PATH_SAMPLES = 9
"""Poses along the path, ends included, at which the contact zone is looked for."""

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
    """

    bones: tuple[str, ...]
    surface: TriMesh
    contact: Bool

    @property
    def exposed(self) -> Points:
        """(e, 3) vertices outside the contact zone, at rest, mm."""
        return self.surface.vertices[~self.contact]

    def at(self, motions: Mapping[str, RigidMotion]) -> TriMesh:
        """The surface where the motions take it."""
        return self.surface.with_vertices(motions[self.bones[0]](self.surface.vertices))


def rigid_groups(
    anatomy: Anatomy, motions: BoneMotions, *, contact_zone_mm: float, sampled_mm: float
) -> tuple[RigidGroup, ...]:
    """Bones of the anatomy by common motion, with the contact zones between them.

    Parameters
    ----------
    anatomy : Anatomy
    motions : BoneMotions
        Bones that they do not know are left out: they follow the soft tissue.
    contact_zone_mm : float
        A vertex belongs to the contact zone when it comes closer than this to the surface of another group at one of
        ``PATH_SAMPLES`` poses.
    sampled_mm : float
        No edge of the groups' surfaces is longer.
    """
    samples = poses_on_the_way(motions)
    whole = [_group(anatomy, bones, sampled_mm) for bones in moving_together(anatomy, samples)]
    contact = [group.contact.copy() for group in whole]
    for sample in samples:
        surfaces = [group.at(sample) for group in whole]
        for k, surface in enumerate(surfaces):
            for other in (s for j, s in enumerate(surfaces) if j != k):
                contact[k] |= _closer(surface.vertices, other, contact_zone_mm)
    return tuple(replace(group, contact=where) for group, where in zip(whole, contact, strict=True))


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
    """A step of the handles, then compact isochoric corrections wide to narrow, then one that puts the handles exactly.

    The handles that must arrive exactly and the exposed vertices of the bones (`held_points`) are held to their rigid
    motion; each correction starts from where the steps before took them, so that errors do not add up. In the contact
    zone two bones slide past each other closer than any tissue between them could follow: there only the part along the
    bone's normal is held, and the field may slip.

    Parameters
    ----------
    handles : HandleStepper
        With Cayley steps.
    groups : sequence of RigidGroup
    motions : BoneMotions
    exact : int
        The first so many handles must arrive exactly; the others only help the first step.
    supports_mm : sequence of float
        Wide to narrow.

    References
    ----------
    M. Floater and A. Iske, J. Comput. Appl. Math. 73 (1996) 65 (coarse to fine); F. Narcowich and J. Ward, Math. Comp.
    63 (1994) 661 (kernels without divergence).
    """

    handles: HandleStepper
    groups: Sequence[RigidGroup]
    motions: BoneMotions
    exact: int
    supports_mm: Sequence[float]

    def held_points(self) -> Points:
        """(h, 3) points at rest that a march must have as its last tested points, mm."""
        return np.concatenate([self.handles.path.position(0.0)[: self.exact], *(g.exposed for g in self.groups)])

    @property
    def shortens_exactly(self) -> bool:
        """False: bones move on curves."""
        return False

    def anchors(self, start: float) -> Points:
        """(a, 3) vertices of the contact zones, exactly on their bones at the start of the stretch."""
        motions = self.motions.at(start)
        return np.concatenate([g.at(motions).vertices[g.contact] for g in self.groups])

    def makers(self, start: float, end: float) -> Iterable[StepMaker]:
        """The step of the handles, the corrections, and the handles' last correction."""
        yield from self.handles.makers(start, end)
        motions = self.motions.at(end)
        surfaces = [group.at(motions) for group in self.groups]
        handles = self.handles.path.position(end)[: self.exact]
        targets = np.concatenate(
            [handles, *(s.vertices[~g.contact] for g, s in zip(self.groups, surfaces, strict=True))]
        )
        for number, support in enumerate(self.supports_mm):
            last = number == len(self.supports_mm) - 1
            spacing = FINEST_MM if last else SPACING_SHARE * support
            yield self._correction(surfaces, targets, support=support, spacing=spacing)
        yield self._exact(targets)

    def _correction(self, surfaces: Sequence[TriMesh], targets: Points, *, support: float, spacing: float) -> StepMaker:
        backend = CompactBackend(CORRECTION_KERNEL, support, tolerance=CORRECTION_TOLERANCE)

        def make(tested: Points, anchors: Points) -> Step:
            held = tested[-len(targets) :]
            missed = targets - held
            kept = thinned(held, spacing_mm=spacing)
            places, normals = self._contact_targets(surfaces, anchors)
            slips = thinned(anchors, spacing_mm=spacing)
            off = np.einsum("si,si->s", places - anchors, normals)[slips, None] * normals[slips]
            at = np.vstack([held[kept] + 0.5 * missed[kept], anchors[slips] + 0.5 * off])
            moves = np.vstack([missed[kept], off])
            return CayleyStep(backend.fit_with_slip(at, moves, slip_normals=normals[slips]))

        return make

    def _exact(self, targets: Points) -> StepMaker:
        backend = CompactBackend(CORRECTION_KERNEL, self.supports_mm[-1])

        def make(tested: Points, _anchors: Points) -> Step:
            now, there = tested[-len(targets) :][: self.exact], targets[: self.exact]
            return CayleyStep(backend.fit(0.5 * (now + there), there - now))

        return make

    def _contact_targets(self, surfaces: Sequence[TriMesh], anchors: Points) -> tuple[Points, Points]:
        """Nearest places on their own bones, and the normals there, of the anchors."""
        counts = [int(group.contact.sum()) for group in self.groups]
        parts = np.split(anchors, np.cumsum(counts)[:-1])
        places, normals = [np.zeros((0, 3))], [np.zeros((0, 3))]
        for surface, part in zip(surfaces, parts, strict=True):
            if len(part):
                near = nearest_places(part, surface)
                places.append(near.places)
                normals.append(smooth_normals(surface, near))
        return np.concatenate(places), np.concatenate(normals)


def exposed_residuals(
    groups: Sequence[RigidGroup], deformation: Deformation, motions: Mapping[str, RigidMotion]
) -> Float:
    """Distances of the mapped exposed vertices of the bones from their rigid motion over the whole path, mm."""
    targets = np.concatenate([group.at(motions).vertices[~group.contact] for group in groups])
    moved = deformation(np.concatenate([group.exposed for group in groups]))
    residuals: Float = np.linalg.norm(moved - targets, axis=1)
    return residuals


def contact_residuals(groups: Sequence[RigidGroup], deformation: Deformation, motions: BoneMotions) -> Float:
    """How far the field carries the contact zones off the surface of their own bone, mm, the worst of all stretches.

    Each stretch starts from the vertices exactly on their bones; there the field may slip along, but not through.
    """
    contacts = [group for group in groups if group.contact.any()]
    worst = np.zeros(sum(int(group.contact.sum()) for group in contacts))
    for start, end, part in deformation.by_stretch():
        before, after = motions.at(start), motions.at(end)
        moved = part(np.concatenate([np.zeros((0, 3)), *(g.at(before).vertices[g.contact] for g in contacts)]))
        ends = np.cumsum([int(group.contact.sum()) for group in contacts])[:-1]
        for group, places, kept in zip(contacts, np.split(moved, ends), np.split(worst, ends), strict=True):
            np.maximum(kept, nearest_places(places, group.at(after)).distances, out=kept)
    return worst


def _group(anatomy: Anatomy, bones: Sequence[str], sampled_mm: float) -> RigidGroup:
    surfaces = [anatomy[bone].surface for bone in bones]
    offsets = np.cumsum([0, *(len(s.vertices) for s in surfaces[:-1])])
    surface = TriMesh(
        np.concatenate([s.vertices for s in surfaces]),
        np.concatenate([s.faces + offset for s, offset in zip(surfaces, offsets, strict=True)]),
    )
    surface = with_short_edges(surface, longest_mm=sampled_mm)
    return RigidGroup(tuple(bones), surface, np.zeros(len(surface.vertices), dtype=bool))


def _closer(points: Points, surface: TriMesh, limit: float) -> Bool:
    """Which points are closer to the surface than the limit; far ones are sorted out by its box."""
    low, high = surface.vertices.min(axis=0) - limit, surface.vertices.max(axis=0) + limit
    near: Bool = ((points > low) & (points < high)).all(axis=1)
    near[near] = nearest_places(points[near], surface).distances < limit if near.any() else False
    return near


def _same(a: RigidMotion, b: RigidMotion) -> bool:
    return bool(
        np.abs(a.rotation - b.rotation).max() < SAME_MOTION
        and np.abs(a.translation - b.translation).max() < SAME_MOTION
    )
