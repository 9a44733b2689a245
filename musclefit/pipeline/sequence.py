"""A motion frame by frame: a job and poses in, frames out; every frame is made from rest, none from another frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from musclefit.anatomy.model import Anatomy
from musclefit.errors import InputError, MusclefitError
from musclefit.geometry.surfaces.sections import Sections
from musclefit.pipeline.poses import bones_of, collision_in_words, collision_on_the_way, shared_in_the_pose
from musclefit.pipeline.retarget import outcome_of
from musclefit.progress import Progress, Silent
from musclefit.report.model import Side
from musclefit.rig.handles import BoneMotions
from musclefit.rig.job import Job, path_by_joints
from musclefit.rig.motion import Pose
from musclefit.rig.paths import motions_of
from musclefit.validate.bones import BoneCollision, RigidBones
from musclefit.validate.muscles import MuscleMeasures, measure_muscles, muscle_sections
from musclefit.validate.overlaps import SolidAnatomy, solid_anatomy


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
        The bones that collide on the way to the pose, which is refused.
    problem : str
        Why there is no frame, in words; "" where there is one.
    surfaces : two Anatomies or None
        At rest and in the pose, on the triangles that were measured: the given ones, split where the map bends them.
    """

    pose: Pose
    anatomy: Anatomy | None
    side: Side | None
    muscles: tuple[MuscleMeasures, ...]
    collision: BoneCollision | None = None
    problem: str = ""
    surfaces: tuple[Anatomy, Anatomy] | None = None


@dataclass(frozen=True, eq=False, slots=True)
class Stage:
    """What all frames of a job share, prepared once.

    Parameters
    ----------
    job : Job
        Driven by joints or transforms; its own pose plays no part.
    rest : SolidAnatomy
    sections : mapping of muscle name to Sections
    bones : RigidBones
    """

    job: Job
    rest: SolidAnatomy
    sections: Mapping[str, Sections]
    bones: RigidBones

    @classmethod
    def of(cls, job: Job, *, progress: Progress | None = None) -> Stage:
        """Prepare a job for its frames.

        Raises
        ------
        InputError
            Neither joints nor transforms drive it.
        MeshError
            A bone that is not a solid, so that it cannot be tested for running into others.
        """
        require_motion(job)
        progress = progress or Silent()
        rest = solid_anatomy(job.anatomy, progress=progress)
        return cls(job, rest, muscle_sections(job.anatomy), bones_of(job))

    def frame(self, pose: Pose, *, progress: Progress | None = None) -> Frame:
        """The anatomy in a pose, made from rest along the joints, or each bone's screw, alone.

        A pose that the bones cannot take, and one that the method cannot reach, is a frame without anatomy that says
        why; so the other frames of a motion go on.
        """
        posed = posed_job(self.job, pose)
        try:
            collision = collision_on_the_way(posed, self.bones)
            if collision is not None:
                refused = f"frame {pose.number} at {pose.said} is refused: {collision_in_words(posed, collision)}"
                return Frame(pose, None, None, (), collision, refused)
            shared = shared_in_the_pose(posed, self.bones) if posed.rig.bones.rigid else ()
            outcome = outcome_of(posed, rest=self.rest, shared=shared, progress=progress or Silent())
        except MusclefitError as error:
            return Frame(pose, None, None, (), None, str(error))
        muscles = measure_muscles(outcome.solid, sections=self.sections)
        given = given_triangles(self.job.anatomy, outcome.deformed)
        return Frame(pose, given, outcome.side, muscles, surfaces=(outcome.rest, outcome.deformed))


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
            f'{job.source}: a motion turns joints or follows transforms; give the rig a [drive] of kind "joints", '
            '"transforms" or "opensim"'
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
    kind = job.rig.deformer.path
    motions: BoneMotions
    if job.transforms is not None:
        motions = job.transforms.motions(pose.time_s, kind=kind)
    else:
        assert job.joints is not None
        motions = motions_of(pose.degrees, job.joints, kind=kind)
    return replace(
        job,
        rig=replace(job.rig, drive=job.rig.drive.at_pose(pose)),
        motions=motions,
        pose=pose.degrees,
        path=path_by_joints(job.handles, motions, kind=job.rig.deformer.path),
        stops=(),
    )


def at_rest(job: Job, pose: Pose) -> bool:
    """Whether a pose is the one that the anatomy rests in."""
    if pose.degrees or job.transforms is None:
        return not any(angle for _, angle in pose.degrees)
    motions = job.transforms.at(pose.time_s).values()
    return all((m.rotation == np.eye(3)).all() and not m.translation.any() for m in motions)


def given_triangles(rest: Anatomy, deformed: Anatomy) -> Anatomy:
    """The tissues of ``deformed`` on the triangles of ``rest``: given vertices come first where surfaces were split."""
    return rest.with_vertices(
        np.concatenate([deformed[t.name].surface.vertices[: len(t.surface.vertices)] for t in rest])
    )
