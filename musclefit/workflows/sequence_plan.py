"""Which frames a sequence has: the rig's own motion, or another one, at how many times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from musclefit.errors import InputError
from musclefit.io.drives import JointDrive, OpenSimDrive, TransformDrive
from musclefit.io.formats.motions import read_motion
from musclefit.io.formats.opensim_motion import ENDINGS
from musclefit.io.formats.tables import toml_string
from musclefit.io.marker_motions import ENDINGS as MARKERS
from musclefit.pipeline.sequence import check_pose, require_motion
from musclefit.rig.job import Job
from musclefit.rig.motion import Interpolation, Motion, Pose
from musclefit.rig.transforms import BoneTransforms


@dataclass(frozen=True, eq=False, slots=True)
class SequencePlan:
    """What a sequence is to be.

    Parameters
    ----------
    job : Job
        Driven by joints or transforms.
    motion : Motion or BoneTransforms
        Keyframes of the joints, or the job's own transforms.
    frames : int
        0 for transforms at their file's own times.
    interpolation : Interpolation
        Of keyframes; transforms are joined by screws.
    """

    job: Job
    motion: Motion | BoneTransforms
    frames: int
    interpolation: Interpolation = Interpolation.CUBIC

    @property
    def poses(self) -> tuple[Pose, ...]:
        """The frames' poses.

        Raises
        ------
        InputError
            Fewer than two frames, or neither joints nor transforms drive the job.
        RigError
            A coordinate that no joint has, or an angle beyond its limits.
        """
        require_motion(self.job)
        if isinstance(self.motion, BoneTransforms):
            return self.motion.frames(self.frames)
        poses = self.motion.frames(self.frames, interpolation=self.interpolation)
        for pose in poses:
            check_pose(self.job, pose)
        return poses

    @property
    def resampling(self) -> str:
        """How frames are made of the keyframes, in words."""
        if isinstance(self.motion, BoneTransforms):
            return self.motion.resampling_in_words(self.frames)
        return self.motion.resampling_in_words(self.frames, interpolation=self.interpolation)


def planned(
    job: Job, *, motion: str | Path | None = None, frames: int = 0, interpolation: Interpolation | None = None
) -> SequencePlan:
    """The sequence that a rig describes, with another motion, other frames or another interpolation where given.

    Parameters
    ----------
    job : Job
        Driven by joints, transforms or an OpenSim model.
    motion : path, optional
        CSV of joints' keyframes; without it ``drive.motion`` of the rig.
    frames : int
        How many, evenly spaced in time; 0 for ``drive.frames`` of the rig.
    interpolation : Interpolation, optional
        Between keyframes; without it ``drive.interpolation`` of the rig.

    Returns
    -------
    SequencePlan

    Raises
    ------
    InputError
        Neither joints nor transforms drive the rig; joints whose motion neither it nor the caller names, or transforms
        and another motion or interpolation; or as `read_motion`.
    """
    require_motion(job)
    drive = job.rig.drive
    if job.transforms is not None and isinstance(drive, TransformDrive):
        if motion or interpolation:
            what = f"the motion {motion}" if motion else f"the interpolation {interpolation}"
            raise InputError(
                f"{job.source}: {what} has no effect: the rig follows drive.transforms, along screws between their "
                "times; leave it out, or set drive.transforms"
            )
        return SequencePlan(job, job.transforms, frames or drive.frames)
    if job.transforms is not None and isinstance(drive, OpenSimDrive):
        return _planned_on_model(job, job.transforms, drive, motion=motion, frames=frames, interpolation=interpolation)
    assert isinstance(drive, JointDrive)
    keyframes = motion or drive.motion
    if not keyframes:
        raise InputError(f"{job.source}: drive.motion names no keyframes; add it, or give a CSV after the rig")
    return SequencePlan(job, read_motion(keyframes), frames or drive.frames, interpolation or drive.interpolation)


def _planned_on_model(
    job: Job,
    transforms: BoneTransforms,
    drive: OpenSimDrive,
    *,
    motion: str | Path | None,
    frames: int,
    interpolation: Interpolation | None,
) -> SequencePlan:
    """The sequence of a job that an OpenSim model drives; its motion was read with the rig."""
    if motion and Path(motion).resolve() != Path(drive.motion).resolve():
        raise InputError(f"{job.source}: is read without {motion}; read the rig with drive.motion set to it")
    if interpolation:
        raise InputError(
            f"{job.source}: an OpenSim model's bodies follow screws between times; leave interpolation out"
        )
    if not drive.motion:
        raise InputError(
            f"{job.source}: drive.motion names no motion; add it, or give a .mot, .sto, .trc or .c3d after the rig"
        )
    return SequencePlan(job, transforms, frames or drive.frames)


def with_motion(motion: str | Path | None, overrides: Sequence[str]) -> tuple[str, ...]:
    """The overrides, and drive.motion where a motion of OpenSim is given, which only the rig's model can read.

    Raises
    ------
    InputError
        There is no such file.
    """
    if motion is None or Path(motion).suffix.lower() not in (*ENDINGS, *MARKERS):
        return tuple(overrides)
    if not Path(motion).is_file():
        raise InputError(f"{motion}: no such file; correct the path of the motion")
    return (*overrides, f"drive.motion={toml_string(str(Path(motion).absolute()))}")
