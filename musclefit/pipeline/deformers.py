"""From a rig's settings to a deformation of its handles; orders `fields` and `flow`, knows no formula and no file."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from musclefit.anatomy.model import Anatomy
from musclefit.fields.ffd import Lattice
from musclefit.fields.fitting.ffd import FfdBackend
from musclefit.fields.fitting.multilevel import MultilevelBackend
from musclefit.fields.isochoric_ffd import IsochoricFfdBackend
from musclefit.fields.kernels import KERNELS
from musclefit.fields.protocol import Backend
from musclefit.fields.radial import RadialBackend
from musclefit.flow.bones import BoneStepper, RigidGroup, rigid_groups
from musclefit.flow.control_lattice import march_lattice
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.kept_bones import KeptBone, LockedBoneStepper, keeping_bones, kept_bones, kept_samples
from musclefit.flow.locks import BoneLocks, LockSettings
from musclefit.flow.march import Marching, Pace, one_shot, points_beside
from musclefit.flow.rules import rule_for
from musclefit.flow.steppers import HandleStep, HandleStepper, cayley_step, explicit_step
from musclefit.flow.steps import ExplicitStep
from musclefit.geometry.arrays import Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import thinned
from musclefit.pipeline.chosen_settings import bone_choices
from musclefit.pipeline.kept_bones import bone_limits, kept_choices
from musclefit.progress import Progress
from musclefit.rig.handles import BonePath, Handles, JoinedPath
from musclefit.rig.job import Job
from musclefit.rig.settings import DeformerSettings
from musclefit.vocabulary import BackendKind, StepKind, TestedAt

HANDLE_STEPS: Mapping[StepKind, HandleStep] = MappingProxyType(
    {StepKind.EXPLICIT: explicit_step, StepKind.CAYLEY: cayley_step}
)


CONTACT_SAMPLED = 0.8
"""Longest edge of the bones' surfaces where the field is held to them in and around the contact zones, in units of the
finest lattice: between coarser samples the field, which is steep there, would leak through the bone."""

BASE_LATTICE = 4.0
"""Spacing of the narrowest lattice of a free-form deformation that rigid bones are held in, in units of the widest of
the lattices that hold them."""


@dataclass(frozen=True, eq=False, slots=True)
class Deformed:
    """A deformation and the bones it was brought to agree with: groups that joints move, and single ones that are kept.

    Both are empty where bones are not held.
    """

    deformation: Deformation
    groups: tuple[RigidGroup, ...]
    kept: tuple[KeptBone, ...] = ()


def backend_for(settings: DeformerSettings) -> Backend:
    """The backend that the settings name."""
    builders: Mapping[BackendKind, Callable[[], Backend]] = {
        BackendKind.RBF: lambda: RadialBackend(
            settings.kernel, scale=settings.kernel_scale_mm or 1.0, smoothing=settings.smoothing
        ),
        BackendKind.FFD: lambda: FfdBackend(settings.lattice_spacing_mm, settings.lattice_levels),
        BackendKind.MULTILEVEL: lambda: MultilevelBackend(settings.kernel, scale=settings.kernel_scale_mm or 1.0),
    }
    return builders[settings.backend]()


def deform(job: Job, points: Points, *, progress: Progress) -> Deformed:
    """March the job's handles to their destinations.

    Parameters
    ----------
    job : Job
    points : (N, 3) float64, mm
        The anatomy's vertices at rest, which the rule is tested at.
    """
    if locks_kept(job):
        march, kept = locked_march_of(job, points, progress=progress)
        return Deformed(march if isinstance(march, Deformation) else march.deformation, (), kept)
    made, groups = march_of(job, points, progress=progress)
    free = made if isinstance(made, Deformation) else made.deformation
    return keep_bones(job, free, points, progress=progress) if bone_limits(job) else Deformed(free, groups)


def march_of(job: Job, points: Points, *, progress: Progress) -> tuple[Marching | Deformation, tuple[RigidGroup, ...]]:
    """March the handles to their destinations, whatever single bones are kept from.

    Parameters
    ----------
    job : Job
    points : (N, 3) float64, mm
        At rest: the rule is tested there.

    Returns
    -------
    Marching or Deformation
        A march at its end, which can be taken back, with ``points`` as the first that it was tested at; the map alone
        where it was not tested there: the rule was to be tested at the landmarks, or is that of a lattice.
    tuple of RigidGroup
        The bones that joints move; none where they are not held.
    """
    settings = job.rig.deformer
    rule = rule_for(settings.step, settings.step_rule)
    pace = Pace(settings.max_steps, least_steps(job), settings.share, job.stops)
    if job.rig.bones.rigid:
        stepper = _bone_stepper(job, progress)
        held = stepper.held_points()
        march = Marching.begun(stepper, rule=rule, tested=np.vstack([points, held]), pace=pace, held=len(held))
        return march.marched(progress), tuple(stepper.groups)
    everywhere = settings.tested_at is TestedAt.ALL_POINTS
    tested = points if everywhere else points_beside(job.handles.source)
    if settings.backend is BackendKind.LATTICE:
        lattice, displacements = _control_points(job)
        return march_lattice(lattice, displacements, tested=tested, max_steps=settings.max_steps), ()
    plain = HandleStepper(job.path, backend_for(settings), HANDLE_STEPS[settings.step])
    march = Marching.begun(plain, rule=rule, tested=tested, pace=pace).marched(progress)
    return (march if everywhere else march.deformation), ()


def keep_bones(job: Job, free: Deformation, points: Points, *, progress: Progress) -> Deformed:
    """The map corrected until single bones move as the rig keeps them.

    Parameters
    ----------
    job : Job
    free : Deformation
    points : (N, 3) float64, mm
        At rest: the rule is tested there.
    """
    bones, settings, limits = job.rig.bones, job.rig.deformer, bone_limits(job)
    kept = kept_bones(job.anatomy, free, limits=limits, zones_mm=kept_choices(job).zones_mm)
    held = keeping_bones(
        free,
        kept,
        handles=job.handles.source,
        tested=points,
        lattices_mm=bones.kept_lattices_mm,
        pace=Pace(settings.max_steps, 1, settings.cayley_share),
        progress=progress,
    )
    return Deformed(held, (), kept)


def locks_kept(job: Job) -> bool:
    """True where kept bones are locked: they are part of the march then."""
    return bool(kept_choices(job).locked)


def locked_march_of(
    job: Job, points: Points, *, progress: Progress
) -> tuple[Marching | Deformation, tuple[KeptBone, ...]]:
    """March twice: free, which tells where the bones go, then with the bones locked.

    Parameters
    ----------
    job : Job
    points : (N, 3) float64, mm
        At rest: the rule is tested there.

    Returns
    -------
    Marching or Deformation
        As `march_of` gives it; the free map where that does not come to its end.
    tuple of KeptBone
    """
    settings, limits = job.rig.deformer, bone_limits(job)
    chosen = kept_choices(job)
    pace = Pace(settings.max_steps, least_steps(job), settings.share, job.stops)
    rule, backend = rule_for(settings.step, settings.step_rule), backend_for(settings)
    tested = np.concatenate([points_beside(job.handles.source), *kept_samples(job.anatomy, limits)])
    stepper = HandleStepper(job.path, backend, HANDLE_STEPS[settings.step])
    free = Marching.begun(stepper, rule=rule, tested=tested, pace=pace).marched(progress).deformation
    kept = kept_bones(job.anatomy, free, limits=limits, zones_mm=chosen.zones_mm)
    if free.status is not Status.CONVERGED:
        return free, kept
    locking = _locked_stepper(job, kept, progress)
    held = locking.held_points()
    march = Marching.begun(locking, rule=rule, tested=np.vstack([points, held]), pace=pace, held=len(held))
    return march.marched(progress), kept


def _locked_stepper(job: Job, kept: tuple[KeptBone, ...], progress: Progress) -> LockedBoneStepper:
    """The stepper that follows the handles and carries the bones."""
    chosen = kept_choices(job)
    surfaces = [job.anatomy[bone.name].surface for bone in kept]
    settings = [chosen.locks[k] for k in chosen.locked]
    return LockedBoneStepper.of(
        job.path,
        backend_for(job.rig.deformer),
        kept,
        surfaces=surfaces,
        fades=[lock.fade for lock in chosen.locks],
        locked=chosen.locked,
        locks=BoneLocks.around([surfaces[k] for k in chosen.locked], settings, progress=progress),
        lattices_mm=job.rig.bones.kept_lattices_mm,
    )


def least_steps(job: Job) -> int:
    """Stretches that the path is cut into at least."""
    settings = job.rig.deformer
    turn = 0.0
    if job.joints is not None:
        turn = max((abs(angle) for _, angle in job.pose), default=0.0)
    elif job.motions is not None:
        turn = max((motion.turn_deg for motion in job.motions.at(1.0).values()), default=0.0)
    # 1e-9: what rounding adds to a whole number of steps.
    return max(settings.min_steps, math.ceil(turn / settings.degrees_per_step - 1e-9))


def deform_in_one_shot(job: Job, points: Points) -> Deformation:
    """The baseline: the rig's handles in one explicit step that is held to no rule, as other tools warp landmarks."""
    settings = _baseline_settings(job)
    rule = rule_for(StepKind.EXPLICIT, settings.step_rule)
    if settings.backend is BackendKind.LATTICE:
        lattice, displacements = _control_points(job)
        return Deformation((ExplicitStep(lattice.field(displacements)),), (), Status.ONE_SHOT)
    return one_shot(job.path, backend_for(settings), rule=rule, tested=points)


def _control_points(job: Job) -> tuple[Lattice, Points]:
    """The lattice that drives, and its displacements."""
    drive = job.lattice
    assert drive is not None  # a rig whose backend is its own lattice is driven by one
    return Lattice.around(drive.low, drive.high, shape=drive.shape), drive.displacements


def baseline_in_words(job: Job) -> str:
    """The baseline, for reports."""
    return f"one-shot {field_in_words(_baseline_settings(job))}"


def method_in_words(job: Job) -> str:
    """The method, for reports."""
    settings = job.rig.deformer
    name = "iterative {} (Yu et al. 2014)" if settings.step is StepKind.EXPLICIT else "implicit midpoint {}"
    bones = ", rigid bones" if job.rig.bones.rigid else ""
    if job.rig.bones.keep_rigid or job.rig.bones.keep_similar:
        bones = ", bones kept and locked" if job.rig.bones.lock else ", bones kept"
    splines = job.rig.bones.rigid and settings.backend is BackendKind.FFD
    field = "isochoric FFD" if splines else field_in_words(settings)
    return f"{name.format(field)}{bones}, {rule_in_words(settings)}, {_path_in_words(job)}"


def _path_in_words(job: Job) -> str:
    kind = job.rig.drive.way or job.rig.deformer.path.value
    keyframes = f" through {len(job.stops)} keyframes" if job.stops else ""
    return f"{kind} paths{keyframes}"


def field_in_words(settings: DeformerSettings) -> str:
    """The backend and its own settings, for reports."""
    if settings.backend is BackendKind.FFD:
        return f"FFD, lattice {settings.lattice_spacing_mm:g} mm"
    if settings.backend is BackendKind.LATTICE:
        return "FFD by its own control points"
    smoothed = f", smoothing {settings.smoothing:g}" if settings.smoothing else ""
    scaled = f" of {settings.kernel_scale_mm:g} mm" if settings.kernel_scale_mm is not None else ""
    if settings.backend is BackendKind.MULTILEVEL:
        return f"RBF, kernel {settings.kernel}{scaled}, refined by compact levels"
    return f"RBF, kernel {settings.kernel}{scaled}{smoothed}"


def rule_in_words(settings: DeformerSettings) -> str:
    """The step rule and where it was tested, for reports."""
    rule = "eigenvalues of the symmetric gradient" if settings.step is StepKind.CAYLEY else settings.step_rule.value
    where = "all points" if settings.tested_at is TestedAt.ALL_POINTS else "landmarks only"
    return f"{rule} at {where}"


def _baseline_settings(job: Job) -> DeformerSettings:
    """The rig's own field, but the thin-plate spline for isochoric ones, which nobody else warps with."""
    settings = job.rig.deformer
    isochoric = settings.backend is BackendKind.RBF and KERNELS[settings.kernel].isochoric
    return replace(settings, kernel="r2logr", kernel_scale_mm=None, smoothing=0.0) if isochoric else settings


def _bone_stepper(job: Job, progress: Progress) -> BoneStepper:
    """The stepper that follows the bones."""
    assert job.motions is not None  # a rig with rigid bones says how they move
    bones, chosen = job.rig.bones, bone_choices(job)
    groups = rigid_groups(
        job.anatomy,
        job.motions,
        zones_mm=chosen.zones_mm,
        sampled_mm=chosen.sampled_mm,
        contact_sampled_mm=CONTACT_SAMPLED * min(chosen.lattices_mm),
    )
    spread = _spread_handles(job.handles, groups, spacing_mm=chosen.handle_spacing_mm)
    path = job.path if spread is None else JoinedPath(job.path, BonePath(spread, job.motions))
    settings = job.rig.deformer
    backend = backend_for(settings)
    if settings.backend is BackendKind.FFD:
        backend = IsochoricFfdBackend(BASE_LATTICE * max(chosen.lattices_mm))
    return BoneStepper(
        HandleStepper(path, backend, HANDLE_STEPS[settings.step]),
        groups=groups,
        motions=job.motions,
        exact=len(job.handles),
        lattices_mm=chosen.lattices_mm,
        iterations=chosen.iterations,
        locks=_locks(job.anatomy, groups, chosen.locks, progress) if bones.lock else None,
        gaps_mm=tuple(lock.fade.apart_mm for lock in chosen.locks),
    )


def _locks(
    anatomy: Anatomy, groups: Sequence[RigidGroup], settings: Sequence[LockSettings], progress: Progress
) -> BoneLocks:
    """What locks the field to groups of bones."""
    return _locks_once(anatomy, tuple(group.bones for group in groups), tuple(settings), _Told(progress))


@dataclass(frozen=True, slots=True)
class _Told:
    """Progress that makes no difference to what is found: it is not part of what is remembered."""

    progress: Progress = field(compare=False)


@lru_cache(maxsize=2)
def _locks_once(
    anatomy: Anatomy, groups: tuple[tuple[str, ...], ...], settings: tuple[LockSettings, ...], told: _Told
) -> BoneLocks:
    """The locks at rest, for every pose that the same anatomy is sent to."""
    surfaces = [TriMesh.together([anatomy[bone].surface for bone in bones]) for bones in groups]
    return BoneLocks.around(surfaces, settings, progress=told.progress)


def _spread_handles(handles: Handles, groups: tuple[RigidGroup, ...], *, spacing_mm: float) -> Handles | None:
    """Handles on the exposed bones, none closer than the spacing to another or to one of the rig's; None for none."""
    exposed = [group.exposed for group in groups]
    owner = np.concatenate([[group.bones[0]] * len(part) for group, part in zip(groups, exposed, strict=True)])
    candidates = np.vstack([handles.source, *exposed])
    chosen = thinned(candidates, spacing_mm=spacing_mm)
    more = chosen[chosen >= len(handles)]
    if not len(more):
        return None
    names, owners = (f"spread_{k}" for k in range(len(more))), (str(owner[k - len(handles)]) for k in more)
    return Handles(tuple(names), candidates[more], tuple(owners))
