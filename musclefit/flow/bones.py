"""Bones that stay rigid: after each step of the handles, compact corrections bring the field into line with them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from musclefit.anatomy.model import Anatomy
from musclefit.fields.compact import CompactBackend
from musclefit.flow.steppers import HandleStepper, StepMaker
from musclefit.flow.steps import CayleyStep, Step
from musclefit.geometry.arrays import Bool, Float, Int, Points
from musclefit.geometry.distances import nearest_places, smooth_normals, thinned
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.rig.handles import BoneMotions

CORRECTION_KERNEL = "isochoric-wendland-c6"
CORRECTION_TOLERANCE = 0.02
"""Share of a correction's residual that its iteration may leave; the next level, or the next step, takes it up."""

SPACING_SHARE = 0.2
"""Sources of a correction stand this share of its support apart: as many as it can tell apart."""

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
        All their surfaces at rest.
    vertices : (v,) int64
        Where the vertices of ``surface`` stand among the vertices of the anatomy.
    contact : (v,) bool
        Vertices that come close to a bone that moves otherwise, somewhere along the path.
    """

    bones: tuple[str, ...]
    surface: TriMesh
    vertices: Int
    contact: Bool

    def at(self, motions: Mapping[str, RigidMotion]) -> TriMesh:
        """The surface where the motions take it."""
        return self.surface.with_vertices(motions[self.bones[0]](self.surface.vertices))


def rigid_groups(anatomy: Anatomy, motions: BoneMotions, *, contact_zone_mm: float) -> tuple[RigidGroup, ...]:
    """Bones of the anatomy by common motion, with the contact zones between them.

    Parameters
    ----------
    anatomy : Anatomy
    motions : BoneMotions
        Bones that they do not know are left out: they follow the soft tissue.
    contact_zone_mm : float
        A vertex belongs to the contact zone when it comes closer than this to the surface of another group at one of
        ``PATH_SAMPLES`` poses.
    """
    samples = [motions.at(float(t)) for t in np.linspace(0.0, 1.0, PATH_SAMPLES)]
    together: list[list[str]] = []
    for bone in (t.name for t in anatomy if t.name in samples[-1]):
        for group in together:
            if all(_same(sample[bone], sample[group[0]]) for sample in samples):
                group.append(bone)
                break
        else:
            together.append([bone])
    whole = [_group(anatomy, bones) for bones in together]
    contact = [np.zeros(len(group.vertices), dtype=bool) for group in whole]
    for sample in samples:
        surfaces = [group.at(sample) for group in whole]
        for k, surface in enumerate(surfaces):
            for other in (s for j, s in enumerate(surfaces) if j != k):
                contact[k] |= _closer(surface.vertices, other, contact_zone_mm)
    return tuple(RigidGroup(g.bones, g.surface, g.vertices, c) for g, c in zip(whole, contact, strict=True))


@dataclass(frozen=True, eq=False, slots=True)
class BoneStepper:
    """A step of the handles, then compact isochoric corrections wide to narrow, then one that puts the handles exactly.

    Exposed vertices of the bones are held to their rigid motion; each correction starts from where the steps before
    took them, so that errors do not add up. In the contact zone two bones slide past each other closer than any tissue
    between them could follow: there only the part along the bone's normal is held, and the field may slip.

    Parameters
    ----------
    handles : HandleStepper
        With Cayley steps.
    groups : sequence of RigidGroup
    motions : BoneMotions
    tested_handles : (m,) int64
        Where the first m handles, which must arrive exactly, stand among the tested points; the vertices of the anatomy
        come first there.
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
    tested_handles: Int
    supports_mm: Sequence[float]

    @property
    def shortens_exactly(self) -> bool:
        """False: bones move on curves."""
        return False

    def anchors(self, start: float) -> Points:
        """(a, 3) vertices of the contact zones, exactly on their bones at the start of the stretch."""
        motions = self.motions.at(start)
        return np.concatenate([np.zeros((0, 3)), *(g.at(motions).vertices[g.contact] for g in self.groups)])

    def makers(self, start: float, end: float) -> Iterable[StepMaker]:
        """The step of the handles, the corrections, and the handles' last correction."""
        yield from self.handles.makers(start, end)
        motions = self.motions.at(end)
        surfaces = [group.at(motions) for group in self.groups]
        for support in self.supports_mm:
            yield self._correction(surfaces, support)
        yield self._exact(self.handles.path.position(end)[: len(self.tested_handles)])

    def _correction(self, surfaces: Sequence[TriMesh], support: float) -> StepMaker:
        backend = CompactBackend(CORRECTION_KERNEL, support, tolerance=CORRECTION_TOLERANCE)

        def make(tested: Points, anchors: Points) -> Step:
            held = np.concatenate([tested[g.vertices[~g.contact]] for g in self.groups])
            missed = np.concatenate([s.vertices[~g.contact] for g, s in self._with(surfaces)]) - held
            kept = thinned(held, spacing_mm=SPACING_SHARE * support)
            places, normals = self._contact_targets(surfaces, anchors)
            slips = thinned(anchors, spacing_mm=SPACING_SHARE * support)
            off = np.einsum("si,si->s", places - anchors, normals)[slips, None] * normals[slips]
            at = np.vstack([held[kept] + 0.5 * missed[kept], anchors[slips] + 0.5 * off])
            moves = np.vstack([missed[kept], off])
            return CayleyStep(backend.fit_with_slip(at, moves, slip_normals=normals[slips]))

        return make

    def _exact(self, targets: Points) -> StepMaker:
        backend = CompactBackend(CORRECTION_KERNEL, self.supports_mm[-1])

        def make(tested: Points, _anchors: Points) -> Step:
            now = tested[self.tested_handles]
            return CayleyStep(backend.fit(0.5 * (now + targets), targets - now))

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

    def _with(self, surfaces: Sequence[TriMesh]) -> Iterable[tuple[RigidGroup, TriMesh]]:
        return zip(self.groups, surfaces, strict=True)


@dataclass(frozen=True, slots=True)
class BoneAgreement:
    """How far the field is from the bones' rigid motions, mm: exposed vertices, and contact ones along the normal."""

    exposed: Float
    contact: Float


def agreement(
    groups: Sequence[RigidGroup], mapped: Callable[[Points], Points], motions: Mapping[str, RigidMotion]
) -> BoneAgreement:
    """Distances of the mapped bone vertices from their rigid motion.

    Parameters
    ----------
    groups : sequence of RigidGroup
    mapped : callable
        The whole map, (N, 3) mm -> (N, 3) mm.
    motions : mapping of bone to RigidMotion
        Rest to the end of the path.

    Returns
    -------
    BoneAgreement
        ``exposed``: full distances of the vertices outside the contact zone. ``contact``: distances of the others from
        the surface of their bone.
    """
    exposed, contact = [np.zeros(0)], [np.zeros(0)]
    for group in groups:
        surface = group.at(motions)
        moved = mapped(group.surface.vertices)
        exposed.append(np.linalg.norm(moved - surface.vertices, axis=1)[~group.contact])
        if group.contact.any():
            contact.append(nearest_places(moved[group.contact], surface).distances)
    return BoneAgreement(np.concatenate(exposed), np.concatenate(contact))


def _group(anatomy: Anatomy, bones: list[str]) -> RigidGroup:
    where = anatomy.slices()
    surfaces = [anatomy[bone].surface for bone in bones]
    offsets = np.cumsum([0, *(len(s.vertices) for s in surfaces[:-1])])
    surface = TriMesh(
        np.concatenate([s.vertices for s in surfaces]),
        np.concatenate([s.faces + offset for s, offset in zip(surfaces, offsets, strict=True)]),
    )
    vertices = np.concatenate([np.arange(where[bone].start, where[bone].stop) for bone in bones])
    return RigidGroup(tuple(bones), surface, vertices, np.zeros(len(vertices), dtype=bool))


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
