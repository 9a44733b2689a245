"""Bones that keep their shape under a map of the whole body: each gets the motion that fits the map best, and local
corrections after the map's steps bring the field into line with it, so that what is attached to a bone stays on it.

Unlike bones that joints move (`flow.bones`), nobody prescribes where these go: the map says where, the limit how.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from scipy.spatial import cKDTree

from musclefit.anatomy.model import Anatomy
from musclefit.fields.compact import CompactBackend
from musclefit.fields.lattice_fit import LatticeBackend
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.march import Pace, march
from musclefit.flow.rules import cayley_fractions
from musclefit.flow.steppers import StepMaker
from musclefit.flow.steps import CayleyStep, Step, Trial
from musclefit.geometry.arrays import Bool, Float, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.similar import Similarity
from musclefit.geometry.subdivision import with_short_edges
from musclefit.geometry.winding import winding_numbers
from musclefit.progress import Progress
from musclefit.rig.model import BoneLimit

ITERATIONS, MISSED_MM = 40, 0.003
"""Of a correction's least squares at most, and the root mean square of what it may miss, at which it ends sooner."""

HANDLE_KERNEL, HANDLE_SUPPORT_MM = "wendland-c2", 20.0
"""Of the correction that puts the handles back exactly, from where the one for the bones leaves them."""

WITHIN = 0.5
"""Winding number of a bone around places that are inside it; bones that keep their shape may run into each other."""

SAMPLED_MM = 5.0
"""Longest edge of the bones' surfaces where the field is held to them."""

_FITS: Mapping[BoneLimit, Callable[[Points, Points], Similarity]] = MappingProxyType(
    {
        BoneLimit.RIGID: lambda source, target: Similarity.rigid(RigidMotion.fitted(source, target)),
        BoneLimit.SIMILAR: Similarity.fitted,
    }
)


@dataclass(frozen=True, eq=False, slots=True)
class KeptBone:
    """A bone, the motion it gets, and how far the map would have bent it.

    Parameters
    ----------
    name : str
    limit : BoneLimit
    motion : Similarity
        From rest to where the bone is put.
    bent_mm : float
        Largest distance of the map from that motion at the bone, before any correction.
    surface : (v, 3) float64, mm
        Samples of its surface at rest.
    contact : (v,) bool
        Samples that come close to another kept bone, or into it: there the field is not held, since two bones that
        move apart in their own ways, or into each other, leave no field that could follow both.
    """

    name: str
    limit: BoneLimit
    motion: Similarity
    bent_mm: float
    surface: Points
    contact: Bool

    @property
    def exposed(self) -> Points:
        """(e, 3) samples where the field is held, at rest, mm."""
        return self.surface[~self.contact]


def kept_bones(
    anatomy: Anatomy, deformation: Deformation, *, limits: Mapping[str, BoneLimit], contact_zone_mm: float
) -> tuple[KeptBone, ...]:
    """The motion of each bone that fits the map best.

    Parameters
    ----------
    anatomy : Anatomy
    deformation : Deformation
        Of the whole body.
    limits : mapping of bone to BoneLimit
    contact_zone_mm : float
        Samples closer than this to another of these bones, or within it, before or after, belong to the contact zone.
    """
    found, placed = [], {}
    for name, limit in limits.items():
        surface = anatomy[name].surface
        sampled = with_short_edges(surface, longest_mm=SAMPLED_MM).vertices
        moved = deformation(sampled)
        motion = _FITS[limit](sampled, moved)
        bent = float(np.linalg.norm(motion(sampled) - moved, axis=1).max())
        found.append(KeptBone(name, limit, motion, bent, sampled, np.zeros(len(sampled), dtype=bool)))
        placed[name] = (surface, surface.with_vertices(motion(surface.vertices)))
    return tuple(replace(bone, contact=_contact(bone, found, placed, contact_zone_mm)) for bone in found)


def _contact(
    bone: KeptBone, bones: Sequence[KeptBone], placed: Mapping[str, tuple[TriMesh, TriMesh]], zone: float
) -> Bool:
    """Samples closer than the zone to another bone, or within it, at rest or where both are put."""
    near = np.zeros(len(bone.surface), dtype=bool)
    for other in bones:
        if other is bone:
            continue
        ends = (bone.surface, other.surface), (bone.motion(bone.surface), other.motion(other.surface))
        for (mine, theirs), surface in zip(ends, placed[other.name], strict=True):
            low, high = theirs.min(axis=0) - zone, theirs.max(axis=0) + zone
            close = np.flatnonzero(((mine > low) & (mine < high)).all(axis=1) & ~near)
            if close.size:
                near[close] = np.asarray(cKDTree(theirs).query(mine[close])[0]) < zone
                near[close] |= winding_numbers(surface, mine[close]) > WITHIN
    return near


def keeping_bones(
    deformation: Deformation,
    bones: Sequence[KeptBone],
    *,
    handles: Points,
    tested: Points,
    lattices_mm: Sequence[float],
    pace: Pace,
    progress: Progress,
) -> Deformation:
    """The map followed by corrections that bring it into line with the bones; handles stay where the map puts them.

    Parameters
    ----------
    deformation : Deformation
    bones : sequence of KeptBone
    handles : (m, 3) float64, mm
        At rest.
    tested : (N, 3) float64, mm
        Points at rest where the rule is tested.
    lattices_mm : sequence of float
        Spacings of the corrections' lattices, wide to narrow.

    Returns
    -------
    Deformation
        The records of the corrections go on from 1: they cover (1, 2] of the path.
    """
    if deformation.status is not Status.CONVERGED or not sum(len(bone.exposed) for bone in bones):
        return deformation
    rest = np.concatenate([bone.exposed for bone in bones])
    targets = np.concatenate([bone.motion(bone.exposed) for bone in bones])
    starts = deformation(np.concatenate([tested, handles, rest]))
    held = starts[len(tested) :]
    goals = np.concatenate([held[: len(handles)], targets])
    stepper = _KeptStepper(held, goals, len(handles), LatticeBackend(tuple(lattices_mm), MISSED_MM, ITERATIONS))
    more = march(stepper, rule=cayley_fractions, tested=starts, pace=pace, progress=progress)
    records = tuple(replace(record, start=1.0 + record.start, end=1.0 + record.end) for record in more.records)
    return Deformation((*deformation.steps, *more.steps), (*deformation.records, *records), more.status)


def kept_residuals(bones: Sequence[KeptBone], deformation: Deformation) -> tuple[Float, Float]:
    """Distances of the map from the bones' motions at their samples, mm: exposed ones, and those in contact zones."""
    off = [np.linalg.norm(deformation(bone.surface) - bone.motion(bone.surface), axis=1) for bone in bones]
    exposed = [part[~bone.contact] for part, bone in zip(off, bones, strict=True)]
    contact = [part[bone.contact] for part, bone in zip(off, bones, strict=True)]
    return np.concatenate([np.zeros(0), *exposed]), np.concatenate([np.zeros(0), *contact])


@dataclass(frozen=True, eq=False, slots=True)
class _KeptStepper:
    """Corrections from where the map put the held points to where they belong, in stretches as long as the rule allows.

    Held points are the last of those tested: handles first, then samples of the bones.
    """

    starts: Points
    goals: Points
    handles: int
    backend: LatticeBackend

    @property
    def shortens_exactly(self) -> bool:
        """False: each correction is fitted to what the one before left."""
        return False

    def anchors(self, start: float) -> Points:  # noqa: ARG002
        """None."""
        return np.zeros((0, 3))

    def makers(self, start: float, end: float) -> Iterable[StepMaker]:  # noqa: ARG002
        """One step that holds the bones, then one that puts the handles exactly."""
        goals = (1.0 - end) * self.starts + end * self.goals

        def hold(tested: Points, _anchors: Points) -> Step:
            held = tested[-len(goals) :]
            middles, missed = 0.5 * (held + goals), goals - held
            return CayleyStep(self.backend.fit(middles, missed, around=middles[self.handles :]))

        def put(tested: Points, _anchors: Points) -> Step:
            now, there = tested[-len(goals) :][: self.handles], goals[: self.handles]
            return CayleyStep(CompactBackend(HANDLE_KERNEL, HANDLE_SUPPORT_MM).fit(0.5 * (now + there), there - now))

        return hold, put

    def trial_of_held(self, step: Step, held: Points) -> Trial:
        """As any point."""
        return step.trial(held)
