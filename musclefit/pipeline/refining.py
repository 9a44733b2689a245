"""The march and the surfaces that it is tested at: cut at rest, marched, cut finer where the map bends them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.errors import NotConvergedError
from musclefit.flow.bones import RigidGroup
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.kept_bones import KeptBone
from musclefit.flow.rules import cayley_fractions
from musclefit.flow.surface_refinement import Carried, CutAnatomy, carried_finely, cut_at_rest, finely_carried
from musclefit.flow.tracked_points import MAX_RETURNS, Riders, riders_of
from musclefit.geometry.arrays import Float, Gradients, Points
from musclefit.geometry.measures import area_vectors, enclosed_volume, volume_change_percent
from musclefit.geometry.surfaces.edge_lengths import EdgeLengths
from musclefit.geometry.surfaces.samples import EDGES_PER_SPACING, surface_samples
from musclefit.pipeline.chosen_settings import bone_choices, surface_choices
from musclefit.pipeline.deformers import Deformed, keep_bones, locked_march_of, locks_kept, march_of
from musclefit.pipeline.kept_bones import bone_limits
from musclefit.progress import Progress
from musclefit.rig.job import Job
from musclefit.vocabulary import StepKind, TestedAt

FEWEST_SAMPLES = 50_000
"""Surfaces are sampled as closely as the rig's longest edge says, but with no more samples than about this many, or
than the anatomy has vertices."""

CLOSER_MARCHES = 2
"""Times that a march is made anew for the volume of muscles."""


@dataclass(frozen=True, eq=False, slots=True)
class Sampled:
    """Where a map was looked at.

    Parameters
    ----------
    points : (N, 3) float64, mm
        At rest: the vertices of the surfaces, then what lies between them.
    determinants : (N,) float64
        Of the map's Jacobian there; not a number where the map has no value.
    gap_mm : float
        No place of a surface is farther from one of them.
    """

    points: Points
    determinants: Float
    gap_mm: float


@dataclass(frozen=True, eq=False, slots=True)
class Made:
    """A deformation, the tissues moved by it, and where it was looked at.

    Parameters
    ----------
    deformed : Deformed
    carried : Carried
    sampled : Sampled
    returns : int
        Times that the march was taken back by what its surfaces, or a proof, came to need.
    tested_too : callable
        Takes (k, 3) places at rest, mm, that the map must be tested at as well; gives what is made of it then, or None
        where the map stays as it is.
    findings : tuple of Finding
        Why the march was made anew.
    """

    deformed: Deformed
    carried: Carried
    sampled: Sampled
    returns: int
    tested_too: Callable[[Points], Made | None]
    findings: tuple[Finding, ...] = ()

    def after(self, returns: int, findings: tuple[Finding, ...]) -> Made:
        """What is made after an earlier march was given up: its returns are counted, and why it was stays said."""

        def tested_too(places: Points) -> Made | None:
            again = self.tested_too(places)
            return None if again is None else again.after(returns, findings)

        return replace(self, returns=self.returns + returns, tested_too=tested_too, findings=findings)


def deform_finely(job: Job, *, progress: Progress) -> Made:
    """March the job's handles and move the tissues, held closer to bones where muscles would change more than they may.

    Where locks fade, the field changes volumes by as much as it misses the bones' own motion there, which falls with
    the iterations of its fit. Where bones are rigid, the rig leaves their number open and a muscle is beyond its limit,
    the path is marched anew with twice as many, at most ``CLOSER_MARCHES`` times.

    Parameters
    ----------
    job : Job
    """
    made = _deform_once(job, progress=progress)
    limit, bones = job.rig.limits.muscle_volume_percent, job.rig.bones
    if limit is None or not bones.rigid or bones.iterations is not None:
        return made
    iterations = bone_choices(job).iterations
    change, muscle = _worst_volume_change(made.carried)
    for _ in range(CLOSER_MARCHES):
        if not change > limit or made.deformed.deformation.status is not Status.CONVERGED:
            break
        iterations *= 2
        closer = replace(job, rig=replace(job.rig, bones=replace(bones, iterations=iterations)))
        again = _deform_once(closer, progress=progress)
        left, whose = _worst_volume_change(again.carried)
        if again.deformed.deformation.status is not Status.CONVERGED or left > change:
            break
        why = Finding(
            muscle,
            "more-iterations",
            f"{muscle}: its volume changed by {change:.3g} %, more than {limit:g} %; the path was marched anew with "
            f"{iterations} iterations for the field beside the bones",
        )
        made = again.after(made.returns + 1, (*made.findings, why))
        change, muscle = left, whose
    return made


def _worst_volume_change(carried: Carried) -> tuple[float, str]:
    """The largest relative change of a muscle's volume, percent, and whose it is."""
    changes = [
        (abs(volume_change_percent(t.surface, carried.deformed[t.name].surface)), t.name)
        for t in carried.rest.of_kind(TissueKind.MUSCLE)
        if enclosed_volume(t.surface) > 0.0
    ]
    return max(changes, default=(0.0, ""))


def _deform_once(job: Job, *, progress: Progress) -> Made:
    """March the job's handles, tested on the surfaces, and move the tissues, finely where the rig says so.

    Surfaces that are to be refined are cut to the rig's longest edge before the march. An implicit march is also tested
    between the vertices of what is not cut, so that no place of a surface is farther than a spacing from a tested one;
    the paper's loop keeps to the vertices. What refinement adds is put to every step, and takes the march back to a
    step that it forbids.

    Parameters
    ----------
    job : Job
    """
    settings, surfaces, chosen = job.rig.deformer, job.rig.surfaces, surface_choices(job)
    whole = _moved_as_wholes(job)
    cut = _cut(job, whole)
    points = cut.anatomy.vertices()
    between, gap = _between(cut.anatomy, longest_mm=chosen.longest.most_mm)
    along = between if settings.step is StepKind.CAYLEY and settings.tested_at is TestedAt.ALL_POINTS else between[:0]
    tested = np.vstack([points, along])
    groups: tuple[RigidGroup, ...] = ()
    kept: tuple[KeptBone, ...] = ()
    if locks_kept(job):
        made, kept = locked_march_of(job, tested, progress=progress)
    else:
        made, groups = march_of(job, tested, progress=progress)
    riders: Riders = riders_of(made, tested, progress=progress)
    if bone_limits(job) and not kept:
        riders = KeptRiders.of(job, riders, tested, progress)

    def refined(riders: Riders) -> Made:
        if surfaces.refine:
            carried, riders = finely_carried(cut, riders, tolerance_mm=chosen.chord_mm, whole=whole, progress=progress)
        else:
            moved, jacobians = riders.moved[: len(points)], riders.jacobians[: len(points)]
            carried = Carried(cut.anatomy, cut.anatomy.with_vertices(moved), np.linalg.det(jacobians), {}, 0)
        deformation = riders.deformation
        if carried.unsolved and deformation.status is Status.CONVERGED:
            deformation = replace(deformation, status=Status.UNSOLVED)
        of_between = np.linalg.det(riders.jacobians[len(points) : len(tested)])
        sampled = _looked_at(carried, deformation, between, gap, known=of_between if len(along) else None)
        held = riders.kept if isinstance(riders, KeptRiders) else kept

        def tested_too(places: Points) -> Made | None:
            joined = riders.joined(places)
            return None if joined is None or joined.returns == riders.returns else refined(joined)

        return Made(Deformed(deformation, groups, held), carried, sampled, riders.returns, tested_too)

    return refined(riders)


def move_finely(job: Job, deformation: Deformation, *, progress: Progress) -> Made:
    """The tissues moved by a finished map, as finely as the rig says, with no bone held.

    Parameters
    ----------
    job : Job
    deformation : Deformation
    """
    surfaces, chosen = job.rig.surfaces, surface_choices(job)
    if surfaces.refine:
        carried = carried_finely(
            job.anatomy,
            deformation,
            tolerance_mm=chosen.chord_mm,
            longest_mm=chosen.longest,
            whole=frozenset(),
            progress=progress,
        )
    else:
        moved, jacobians = deformation.with_jacobian(job.anatomy.vertices())
        carried = Carried(job.anatomy, job.anatomy.with_vertices(moved), np.linalg.det(jacobians), {}, 0)
    between, gap = _between(_cut(job, frozenset()).anatomy, longest_mm=chosen.longest.most_mm)
    sampled = _looked_at(carried, deformation, between, gap, known=None)
    return Made(Deformed(deformation, ()), carried, sampled, 0, lambda _: None)


@dataclass(frozen=True, eq=False, slots=True)
class KeptRiders:
    """Points that a march carries, and after it the corrections that keep single bones.

    Where a point that joins later takes the march back, or fails a correction, the corrections are made anew.

    Parameters
    ----------
    free : Riders
        Of the march.
    keep : callable
        Makes the corrections for a map, tested at points at rest.
    rest : (N, 3) float64, mm
        All that joined.
    made : Deformed
        The whole map, and the bones that it keeps.
    moved, jacobians
        Of the whole map, at all that joined.
    redone : int
        Times that only the corrections were made anew.
    """

    free: Riders
    keep: Callable[[Deformation, Points], Deformed]
    rest: Points
    made: Deformed
    moved: Points
    jacobians: Gradients
    redone: int = 0

    @classmethod
    def of(cls, job: Job, free: Riders, rest: Points, progress: Progress) -> KeptRiders:
        """The corrections made for the first (N, 3) points, mm."""
        return _kept(free, lambda map_, points: keep_bones(job, map_, points, progress=progress), rest, 0)

    @property
    def deformation(self) -> Deformation:
        """The whole map."""
        return self.made.deformation

    @property
    def kept(self) -> tuple[KeptBone, ...]:
        """The bones that it keeps."""
        return self.made.kept

    @property
    def returns(self) -> int:
        """Times that the march was taken back or the corrections were made anew."""
        return self.free.returns + self.redone

    def joined(self, points: Points) -> KeptRiders | None:
        """With more points; None where the rule fails at one of them and shorter steps do not help."""
        free = self.free.joined(points)
        if free is None:
            return None
        if free.returns == self.free.returns:
            more = self._corrected(free.moved[len(self.moved) :], free.jacobians[len(self.moved) :])
            if more is not None:
                moved, jacobians = np.vstack([self.moved, more[0]]), np.concatenate([self.jacobians, more[1]])
                rest = np.vstack([self.rest, points])
                return replace(self, free=free, rest=rest, moved=moved, jacobians=jacobians)
            if self.redone >= MAX_RETURNS:
                return None
        redone = self.redone + (free.returns == self.free.returns)
        again = _kept(free, self.keep, np.vstack([self.rest, points]), redone)
        return again if again.deformation.status is Status.CONVERGED else None

    def _corrected(self, points: Points, jacobians: Gradients) -> tuple[Points, Gradients] | None:
        """Points of the march put to the corrections; None where the rule fails at one."""
        for step in self.deformation.steps[len(self.free.deformation.steps) :]:
            try:
                trial = step.trial(points)
            except NotConvergedError:
                return None
            if not float(cayley_fractions(trial.gradients).min(initial=math.inf)) > 1.0:
                return None
            points, jacobians = trial.moved, step.jacobian_from(trial.gradients) @ jacobians
        return points, jacobians


def _kept(free: Riders, keep: Callable[[Deformation, Points], Deformed], rest: Points, redone: int) -> KeptRiders:
    made = keep(free.deformation, rest)
    steps = made.deformation.steps[len(free.deformation.steps) :]
    corrections = Deformation(steps, (), made.deformation.status)
    moved, jacobians = corrections.with_jacobian(free.moved)
    return KeptRiders(free, keep, rest, made, moved, jacobians @ free.jacobians, redone)


def _moved_as_wholes(job: Job) -> frozenset[str]:
    """The bones that are moved by motions of their own, and need no finer triangles."""
    if job.rig.bones.rigid:
        assert job.motions is not None  # a rig with rigid bones is driven by joints
        return frozenset(job.motions.at(1.0)) & {tissue.name for tissue in job.anatomy}
    return frozenset(bone_limits(job))


def _cut(job: Job, whole: frozenset[str]) -> CutAnatomy:
    longest = surface_choices(job).longest if job.rig.surfaces.refine else None
    return _cut_once(job.anatomy, longest, whole)


@lru_cache(maxsize=2)
def _cut_once(anatomy: Anatomy, longest: EdgeLengths | None, whole: frozenset[str]) -> CutAnatomy:
    """The surfaces cut at rest, for every pose that the same anatomy is sent to; as they are without lengths."""
    if longest is None:
        return CutAnatomy(anatomy, {}, anatomy)
    return cut_at_rest(anatomy, longest_mm=longest, whole=whole)


@lru_cache(maxsize=2)
def _between(anatomy: Anatomy, *, longest_mm: float) -> tuple[Points, float]:
    """Samples of the surfaces that are none of their vertices, and the largest gap that they leave, mm."""
    area = sum(float(np.linalg.norm(area_vectors(tissue.surface), axis=1).sum()) for tissue in anatomy)
    count = max(FEWEST_SAMPLES, len(anatomy.vertices()))
    spacing = max(longest_mm / EDGES_PER_SPACING, math.sqrt(area / count))
    samples = [surface_samples(tissue.surface, spacing_mm=spacing) for tissue in anatomy]
    return np.vstack([part.between for part in samples]), max(part.gap_mm for part in samples)


def _looked_at(
    carried: Carried, deformation: Deformation, between: Points, gap: float, *, known: Float | None
) -> Sampled:
    """The determinants at the vertices and between them; places without a value are told by ones that are no number."""
    if known is None:
        try:
            known = np.linalg.det(deformation.jacobian(between)) if len(between) else np.zeros(0)
        except NotConvergedError:
            known = np.full(len(between), np.nan)
    points = np.vstack([carried.rest.vertices(), between])
    return Sampled(points, np.concatenate([carried.determinants, known]), gap)
