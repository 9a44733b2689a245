"""Bones that keep their shape under a map of the whole body.

Each gets the motion that fits the map best, and a local part brings the field into line with it, so that what is
attached to a bone stays on it.

Without locks that part is corrections after the map's steps. With locks the body is marched anew, each step of a field
in three parts: the handles', one on lattices that takes what the first leaves of the bones' motions, and locks, which
make the field exactly the motion on each bone's whole surface.

Unlike bones that joints move (`flow.bones`), nobody prescribes where these go: the map says where, the limit how.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from musclefit.anatomy.model import Anatomy
from musclefit.errors import FieldError
from musclefit.fields.ffd import FfdField
from musclefit.fields.fitting.conjugate_gradients import CompactBackend
from musclefit.fields.fitting.lattices import LatticeBackend, met_exactly
from musclefit.fields.locked import Fade, LockedField
from musclefit.fields.protocol import Backend, Field
from musclefit.fields.radial import RadialField
from musclefit.fields.summed import BoundedField, SummedField
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.locks import BoneLocks, Stand, trial_without_locks
from musclefit.flow.march import Pace, march
from musclefit.flow.rules import cayley_fractions
from musclefit.flow.steppers import StepMaker
from musclefit.flow.steps import CayleyStep, Step, Trial
from musclefit.geometry.arrays import Bool, Float, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import DistanceTree, nearest_places, smooth_normals, thinned
from musclefit.geometry.queries.winding import winding_numbers
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.similarity import Similarity
from musclefit.geometry.surfaces.subdivision import with_short_edges
from musclefit.progress import Progress
from musclefit.rig.handles import Path
from musclefit.vocabulary import BoneLimit

ITERATIONS, MISSED_MM = 40, 0.003
"""Of a correction's least squares at most, and the root mean square of what it may miss, at which it ends sooner."""

HANDLE_KERNEL, HANDLE_SUPPORT_MM = "wendland-c2", 20.0
"""Of the correction that puts the handles back exactly, from where the one for the bones leaves them."""

WITHIN = 0.5
"""Winding number of a bone around places that are inside it; bones that keep their shape may collide."""

SAMPLED_MM = 5.0
"""Longest edge of the bones' surfaces where the field is held to them."""

PATH_SAMPLES = 5
"""Moments of the path, ends included, at which the contact zone is looked for."""

THINNED, LOCKED_ITERATIONS = 0.6, 10
"""Where bones are locked, the field need not come so close to them: how far apart the samples are that hold it, in
units of the narrowest lattice's spacing, and the iterations of least squares."""

HELD = 0.2
"""Where bones are locked, the field is held down to this clearance: so far into contact zones do locks have weight."""

EXACT_PASSES, EXACT_MM = 4, 1e-10
"""Of the exact handles: solved anew for what rounding left over, until they are met to this."""

CARRIED = 0.05
"""A handle that locks leave no more than this share of the other parts' field goes with its bone."""

IN_GAPS = (0.1, 0.3, 0.5)
"""Where the rule is tested beside contact zones, in units of how far apart bones must be for both to be locked; and, of
what locks fade over, beside the other places where the field is held."""

_FITS: Mapping[BoneLimit, Callable[[Points, Points], Similarity]] = MappingProxyType(
    {
        BoneLimit.RIGID: lambda source, target: Similarity.rigid(RigidMotion.fitted(source, target)),
        BoneLimit.SIMILAR: Similarity.fitted,
    }
)


@dataclass(frozen=True, eq=False, slots=True)
class KeptWay:
    """Where a bone stands on its way from rest to where it is put.

    Parameters
    ----------
    centre : (3,) float64, mm
        The middle of its samples at rest.
    times : tuple of float
        Rising moments of the path, 0 and 1 included.
    motions : tuple of Similarity
        From rest to each of them.
    """

    centre: Float
    times: tuple[float, ...]
    motions: tuple[Similarity, ...]

    def at(self, t: float) -> Similarity:
        """From rest to a moment; between those known it turns and grows evenly, and its middle goes straight."""
        k = int(np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.times) - 2))
        share = (t - self.times[k]) / (self.times[k + 1] - self.times[k])
        if share in (0.0, 1.0):
            return self.motions[k + int(share)]
        return self.motions[k].towards(self.motions[k + 1], share, centre=self.centre)


@dataclass(frozen=True, eq=False, slots=True)
class KeptBone:
    """A bone, the motion it gets, and how far the map would have bent it.

    Parameters
    ----------
    name : str
    limit : BoneLimit
    way : KeptWay
        How it gets to where it is put.
    bent_mm : float
        Largest distance of the map from its motion at the bone, before any correction.
    surface : (v, 3) float64, mm
        Samples of its surface at rest.
    clearance : (v,) float64
        How close each sample comes to another kept bone on the way, in units of their contact zone: 0 within it, 1
        where it stays outside the zone.
    """

    name: str
    limit: BoneLimit
    way: KeptWay
    bent_mm: float
    surface: Points
    clearance: Float

    @property
    def contact(self) -> Bool:
        """(v,) samples that come close to another kept bone, or into it.

        There the field is not held: two bones that move apart in their own ways, or into each other, leave no field
        that could follow both.
        """
        near: Bool = self.clearance < 1.0
        return near

    @property
    def motion(self) -> Similarity:
        """From rest to where the bone is put."""
        return self.way.motions[-1]

    @property
    def exposed(self) -> Points:
        """(e, 3) samples where the field is held, at rest, mm."""
        return self.surface[~self.contact]


def kept_samples(anatomy: Anatomy, names: Iterable[str]) -> tuple[Points, ...]:
    """Samples of bones' surfaces at rest, one array (v, 3) for each bone, mm."""
    return tuple(with_short_edges(anatomy[name].surface, longest_mm=SAMPLED_MM).vertices for name in names)


def kept_bones(
    anatomy: Anatomy,
    deformation: Deformation,
    *,
    limits: Mapping[str, BoneLimit],
    zones_mm: Float,
) -> tuple[KeptBone, ...]:
    """The motion of each bone that fits the map best.

    Parameters
    ----------
    anatomy : Anatomy
    deformation : Deformation
        Of the whole body.
    limits : mapping of bone to BoneLimit
    zones_mm : (K, K) float64
        Samples of one of these bones that come closer than this to another, or into it, at one of ``PATH_SAMPLES``
        moments, belong to the contact zone; measured in the other bone's own size at rest.
    """
    found = []
    for (name, limit), sampled in zip(limits.items(), kept_samples(anatomy, limits), strict=True):
        times, motions, moved = [0.0], [Similarity.identity()], sampled
        for _, end, part in deformation.by_stretch():
            moved = part(moved)
            times.append(end)
            motions.append(_FITS[limit](sampled, moved))
        if len(times) == 1:
            times, motions = [0.0, 1.0], [*motions, _FITS[limit](sampled, moved)]
        bent = float(np.linalg.norm(motions[-1](sampled) - moved, axis=1).max())
        way = KeptWay(sampled.mean(axis=0), tuple(times), tuple(motions))
        found.append(KeptBone(name, limit, way, bent, sampled, np.ones(len(sampled))))
    return _with_contacts(anatomy, found, zones_mm)


def _with_contacts(anatomy: Anatomy, bones: Sequence[KeptBone], zones: Float) -> tuple[KeptBone, ...]:
    """The bones with how close they come to each other."""
    times = np.linspace(0.0, bones[0].way.times[-1], PATH_SAMPLES) if bones else ()
    stands = [[bone.way.at(float(t)) for t in times] for bone in bones]
    posed = [[motion(bone.surface) for motion in own] for bone, own in zip(bones, stands, strict=True)]
    boxes = np.array([[(places.min(axis=0), places.max(axis=0)) for places in own] for own in posed])
    clear = [np.ones(len(bone.surface)) for bone in bones]
    for j, other in enumerate(bones):
        surface = anatomy[other.name].surface
        low, high, tree = surface.vertices.min(axis=0), surface.vertices.max(axis=0), DistanceTree(surface)
        for k in range(len(bones)):
            if k == j:
                continue
            zone = float(zones[k, j])
            for mine, theirs, own, whole in zip(posed[k], stands[j], boxes[k], boxes[j], strict=True):
                reach = zone * theirs.scale
                if (own[0] > whole[1] + reach).any() or (own[1] < whole[0] - reach).any():
                    continue
                there = theirs.undone(mine)
                close = np.flatnonzero(((there > low - zone) & (there < high + zone)).all(axis=1) & (clear[k] > 0.0))
                if not close.size:
                    continue
                shares = np.minimum(tree(there[close]) / zone, 1.0)
                boxed = np.flatnonzero(((there[close] > low) & (there[close] < high)).all(axis=1))
                if boxed.size:
                    within = winding_numbers(surface, there[close[boxed]]) > WITHIN
                    shares[boxed[within]] = 0.0
                clear[k][close] = np.minimum(clear[k][close], shares)
    return tuple(replace(bone, clearance=clearance) for bone, clearance in zip(bones, clear, strict=True))


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


@dataclass(frozen=True, eq=False, slots=True)
class LockedBoneStepper:
    """One step per stretch, of a field in three parts: the handles', splines that hold the bones, and locks.

    The splines take what the handles' part leaves of the bones' motions at their samples, in the least squares sense,
    and leave the handles where that part puts them. Each stretch starts from where the stretches before took the
    samples without locks (`trial_of_held`), so that errors do not add up.

    Parameters
    ----------
    path : Path
        Of the handles.
    backend : Backend
        Of their part; it must make fields that bound themselves.
    bones : tuple of KeptBone
    samples : tuple of (e, 3) float64, mm
        Of each bone's places at rest where the field is held.
    beside : tuple of (a, 3) float64, mm
        Of each bone, places beside it at rest where the rule is tested, too.
    locked : tuple of int
        Numbers of the bones that are locked.
    locks : BoneLocks
        Of these, in their order.
    lattices_mm : tuple of float
        Spacings of the splines' lattices, wide to narrow.
    """

    path: Path
    backend: Backend
    bones: tuple[KeptBone, ...]
    samples: tuple[Points, ...]
    beside: tuple[Points, ...]
    locked: tuple[int, ...]
    locks: BoneLocks
    lattices_mm: tuple[float, ...]

    @classmethod
    def of(
        cls,
        path: Path,
        backend: Backend,
        bones: Sequence[KeptBone],
        *,
        surfaces: Sequence[TriMesh],
        fades: Sequence[Fade],
        locked: Sequence[int],
        locks: BoneLocks,
        lattices_mm: Sequence[float],
    ) -> LockedBoneStepper:
        """With samples as far apart as the narrowest lattice asks for.

        Parameters
        ----------
        path : Path
        backend : Backend
        bones : sequence of KeptBone
        surfaces : sequence of TriMesh
            Of each at rest.
        fades : sequence of Fade
            Of each, as if all were locked.
        locked : sequence of int
        locks : BoneLocks
        lattices_mm : sequence of float
        """
        spacing, samples, beside = THINNED * min(lattices_mm), [], []
        for bone, surface, fade in zip(bones, surfaces, fades, strict=True):
            chosen = thinned(bone.surface, spacing_mm=spacing)
            places, contact = bone.surface[chosen], bone.contact[chosen]
            held = bone.clearance[chosen] >= HELD
            normals = smooth_normals(surface, nearest_places(places, surface))
            reach = np.where(contact, fade.apart_mm, fade.over_mm)
            samples.append(places[held])
            beside.append(np.concatenate([places + (share * reach)[:, None] * normals for share in IN_GAPS]))
        return cls(path, backend, tuple(bones), tuple(samples), tuple(beside), tuple(locked), locks, tuple(lattices_mm))

    @property
    def shortens_exactly(self) -> bool:
        """False: bones turn."""
        return False

    def held_points(self) -> Points:
        """(h, 3) points at rest that a march must have as its last tested points, mm."""
        return np.concatenate([self.path.position(0.0), *self.samples])

    def anchors(self, start: float) -> Points:
        """(a, 3) places beside the bones where the field is steep."""
        return self._moved(self.beside, start)

    def makers(self, start: float, end: float) -> Iterable[StepMaker]:
        """The one step.

        Raises
        ------
        FieldError
            When a step is made: the backend gave a field that bones cannot be locked in.
        """

        def make(tested: Points, _anchors: Points) -> Step:
            here, there = self.path.position(start), self.path.position(end)
            targets = self._moved(self.samples, end)
            held = tested[len(tested) - len(targets) - len(here) :]
            first = _bounded(self.backend.fit(0.5 * (here + there), there - here))
            middles = 0.5 * (held[len(here) :] + targets)
            handles = 0.5 * (here + there)
            left = targets - held[len(here) :] - first.displacement(middles)
            fit = LatticeBackend(self.lattices_mm, MISSED_MM, LOCKED_ITERATIONS)
            splines = fit.fit(
                np.concatenate([handles, middles]), np.concatenate([np.zeros_like(handles), left]), around=middles
            )
            locks = self.locks.of_step(self._stands(start), self._stands(end))
            field = LockedField(SummedField(first, splines), locks)
            for _ in range(EXACT_PASSES):
                missed = _missed_by(field, first, handles)
                off = np.flatnonzero(np.abs(missed).max(axis=1, initial=0.0) > EXACT_MM)
                if not off.size:
                    break
                splines = met_exactly(splines, handles[off], missed[off])
                field = replace(field, base=SummedField(first, splines))
            return CayleyStep(field)

        return (make,)

    def trial_of_held(self, step: Step, held: Points) -> Trial:
        """As any point; samples of bones go where the field would take them without locks."""
        return trial_without_locks(step, held, exact=len(self.path.position(0.0)))

    def _moved(self, places: Sequence[Points], t: float) -> Points:
        parts = [bone.way.at(t)(part) for bone, part in zip(self.bones, places, strict=True)]
        return np.concatenate([np.zeros((0, 3)), *parts])

    def _stands(self, t: float) -> list[Stand]:
        motions = [self.bones[k].way.at(t) for k in self.locked]
        return [Stand(motion.linear, np.asarray(motion.translation)) for motion in motions]


def _bounded(field: Field) -> BoundedField:
    """A field that bounds itself, as sums that are to be proved need it."""
    if not isinstance(field, RadialField | FfdField):
        raise FieldError(f"bones are locked in radial fields and in splines only; found a {type(field).__name__}")
    return field


def _missed_by(field: LockedField, first: Field, handles: Points) -> Points:
    """(m, 3) what the base must have more of at handles to take them as the handles' own part does, mm."""
    free = 1.0 - field.weights(handles)[0].sum(axis=0)
    missed = first.displacement(handles) - field.displacement(handles)
    least = np.where(free > CARRIED, free, np.inf)
    shares: Points = missed / least[:, None]
    return shares
