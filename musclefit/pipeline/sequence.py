"""A motion frame by frame: a job and poses in, frames out; every frame is made from rest, none from another frame."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from musclefit.anatomy.model import Anatomy
from musclefit.errors import InputError, MusclefitError
from musclefit.geometry.sections import Sections
from musclefit.pipeline.retarget import outcome_of
from musclefit.progress import Progress, Silent
from musclefit.report.model import Side
from musclefit.rig.handles import BoneMotions
from musclefit.rig.job import Job, path_by_joints
from musclefit.rig.model import Drive, JointDrive, TransformDrive
from musclefit.rig.motion import Pose
from musclefit.rig.paths import motions_of
from musclefit.validate.bones import BoneCollision, first_collision
from musclefit.validate.muscles import MuscleMeasures, measure_muscles, muscle_sections
from musclefit.validate.overlaps import SolidAnatomy, solid_anatomy

COLLISION_DEG = 7.5
"""Bones are tested for running into each other whenever a joint has turned this far on the way from rest to a pose."""

COLLISION_MM = 5.0
"""... and whenever a bone that a transform moves has gone this far along its screw, against another."""


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """One pose of a sequence.

    Parameters
    ----------
    pose : Pose
    anatomy : Anatomy or None
        The given triangles in the pose; None where there is no such frame.
    side : Side or None
        What was measured, as in the report of a single run.
    muscles : tuple of MuscleMeasures
    collision : BoneCollision or None
        The bones that run into each other on the way to the pose, which is refused.
    problem : str
        Why there is no frame, in words; "" where there is one.
    """

    pose: Pose
    anatomy: Anatomy | None
    side: Side | None
    muscles: tuple[MuscleMeasures, ...]
    collision: BoneCollision | None = None
    problem: str = ""


@dataclass(frozen=True, eq=False, slots=True)
class Stage:
    """What all frames of a job share, prepared once.

    Parameters
    ----------
    job : Job
        Driven by joints or transforms; its own pose plays no part.
    rest : SolidAnatomy
    sections : mapping of muscle name to Sections
    """

    job: Job
    rest: SolidAnatomy
    sections: Mapping[str, Sections]

    @classmethod
    def of(cls, job: Job, *, progress: Progress | None = None) -> Stage:
        """Prepare a job for its frames.

        Raises
        ------
        InputError
            Neither joints nor transforms drive it.
        """
        require_motion(job)
        progress = progress or Silent()
        return cls(job, solid_anatomy(job.anatomy, progress=progress), muscle_sections(job.anatomy))

    def frame(self, pose: Pose, *, progress: Progress | None = None) -> Frame:
        """The anatomy in a pose, made from rest along the joints, or each bone's screw, alone.

        A pose that the bones cannot take, and one that the method cannot reach, is a frame without anatomy that says
        why; so the other frames of a motion go on.
        """
        posed = posed_job(self.job, pose)
        collision = collision_on_the_way(posed, pose)
        if collision is not None:
            return Frame(pose, None, None, (), collision, collision_in_words(collision, pose))
        try:
            outcome = outcome_of(posed, rest=self.rest, progress=progress or Silent())
        except MusclefitError as error:
            return Frame(pose, None, None, (), None, str(error))
        muscles = measure_muscles(solid_anatomy(outcome.deformed, progress=Silent()), sections=self.sections)
        return Frame(pose, given_triangles(self.job.anatomy, outcome.deformed), outcome.side, muscles)


def frames(job: Job, poses: Sequence[Pose], *, progress: Progress | None = None) -> Iterator[Frame]:
    """The frames of a motion, one after the other, in this process.

    Raises
    ------
    InputError
        Neither joints nor transforms drive the job; or a time that the transforms do not have.
    RigError
        A pose of a joint that does not exist or beyond its limits; raised before the first frame.
    """
    stage = Stage.of(job, progress=progress)
    for pose in poses:
        check_pose(job, pose)
    return (stage.frame(pose, progress=progress) for pose in poses)


def require_motion(job: Job) -> None:
    """Raise InputError unless the job can be sent to other poses."""
    if job.joints is None and job.transforms is None:
        raise InputError(
            f'{job.source}: a motion turns joints or follows transforms; give the rig a [drive] of kind "joints" or '
            '"transforms"'
        )


def check_pose(job: Job, pose: Pose) -> None:
    """Raise RigError or InputError where the job's joints refuse the pose, or its transforms do not have its time."""
    if job.joints is not None:
        job.joints.check_pose(pose.angles)
    elif job.transforms is not None:
        job.transforms.at(pose.time_s)


def posed_job(job: Job, pose: Pose) -> Job:
    """The same job sent to another pose; keyframes on the way to the rig's own pose are left out.

    Joints go to the pose's angles, transforms to those of its time.

    Raises
    ------
    InputError
        Neither joints nor transforms drive it, or the pose is none of its joints', or the time none of its bones'.
    """
    require_motion(job)
    drive: Drive = job.rig.drive
    motions: BoneMotions
    if job.transforms is not None and isinstance(drive, TransformDrive):
        drive = replace(drive, time_s=pose.time_s)
        motions = job.transforms.motions(drive, kind=job.rig.deformer.path)
    else:
        assert job.joints is not None
        assert isinstance(drive, JointDrive)
        drive = replace(drive, pose=pose.degrees, keyframes=())
        motions = motions_of(drive, job.joints, kind=job.rig.deformer.path)
    return replace(
        job,
        rig=replace(job.rig, drive=drive),
        motions=motions,
        path=path_by_joints(job.handles, motions, kind=job.rig.deformer.path),
        stops=(),
    )


def collision_on_the_way(job: Job, pose: Pose) -> BoneCollision | None:
    """Bones that run into each other in the pose, else the first that do on the way there, every ``COLLISION_DEG``."""
    assert job.motions is not None  # a posed job says how its bones move
    count = _probes(job, pose)
    there = first_collision(job.anatomy, [(1.0, job.motions.at(1.0))])
    if there is not None or count == 1:
        return there
    return first_collision(job.anatomy, [(k / count, job.motions.at(k / count)) for k in range(1, count)])


def _probes(job: Job, pose: Pose) -> int:
    """Poses to test on the way to one: by its angles, or by how bones move against the first one."""
    assert job.motions is not None
    if pose.degrees:
        return max(1, math.ceil(max(abs(angle) for _, angle in pose.degrees) / COLLISION_DEG))
    first, *others = job.motions.at(1.0).values()
    against = [first.inverse() @ other for other in others]
    farthest = max((max(m.turn_deg / COLLISION_DEG, m.slide_mm / COLLISION_MM) for m in against), default=0.0)
    return max(1, math.ceil(farthest))


def at_rest(job: Job, pose: Pose) -> bool:
    """Whether a pose is the one that the anatomy rests in."""
    if pose.degrees or job.transforms is None:
        return not any(angle for _, angle in pose.degrees)
    motions = job.transforms.at(pose.time_s).values()
    return all((m.rotation == np.eye(3)).all() and not m.translation.any() for m in motions)


def collision_in_words(found: BoneCollision, pose: Pose) -> str:
    """Bones, time, place on the way and depth."""
    where = ", ".join(f"{name} {found.at * angle:.4g} deg" for name, angle in pose.degrees)
    where = where or f"{100.0 * found.at:.3g} % of the way from rest"
    return (
        f"frame {pose.number} at {pose.said} is refused: bones {found.a!r} and {found.b!r} run into each other at "
        f"{where}: they share {found.volume_mm3:.3g} mm³, {found.depth_mm:.2g} mm deep"
    )


def given_triangles(rest: Anatomy, deformed: Anatomy) -> Anatomy:
    """The tissues of ``deformed`` on the triangles of ``rest``: given vertices come first where surfaces were split."""
    return rest.with_vertices(
        np.concatenate([deformed[t.name].surface.vertices[: len(t.surface.vertices)] for t in rest])
    )
