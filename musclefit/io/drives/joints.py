"""Joints move bones, and the landmarks on them: a table of axes and a pose."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.errors import RigError
from musclefit.io.drives.bone_landmarks import handles_of, read_bone_landmarks, refuse_two_ways
from musclefit.io.formats.tables import parse_table
from musclefit.rig.drive import Drive, Driver, Files, JobParts, at_least_one, found_if_named, register_drive
from musclefit.rig.handles import BoneMotions, Handles
from musclefit.rig.handles import Path as HandlePath
from musclefit.rig.job import joint_findings, path_by_joints, require_bones
from musclefit.rig.joints import JointSystem, parse_joints
from musclefit.rig.keyframes import PoseKey, require_moments
from musclefit.rig.motion import Interpolation, Pose
from musclefit.rig.paths import motions_of
from musclefit.rig.spread import bone_landmarks
from musclefit.rig.table_reader import Section
from musclefit.vocabulary import PathKind, Unit


@register_drive
@dataclass(frozen=True, slots=True)
class JointDrive(Drive):
    """Bone landmarks moved by joints: from a file, or ("") ``landmarks_per_bone`` spread over each bone.

    ``pose`` holds joint names with their angles in degrees; joints that it leaves out stay at rest. ``units`` is the
    length unit of a landmark file that states none; the file of joints states its own. ``motion`` is a file of
    keyframes that a sequence follows in ``frames`` poses, evenly spaced in time, by ``interpolation``.

    Raises
    ------
    RigError
        A pose without a joint or with an angle that is not finite, or fewer than one landmark per bone.
    """

    kind: ClassVar[str] = "joints"
    paths: ClassVar[frozenset[PathKind]] = frozenset({PathKind.STRAIGHT, PathKind.JOINTS, PathKind.SCREWS})
    through: ClassVar[PathKind] = PathKind.JOINTS
    turns_bones: ClassVar[bool] = True
    can_hold_bones: ClassVar[bool] = True
    poses_because: ClassVar[str] = "joints move the bones"
    drives: ClassVar[str] = "joints drive"

    joints: str
    pose: tuple[tuple[str, float], ...]
    landmarks: str = ""
    landmarks_per_bone: int = 8
    units: Unit = Unit.MILLIMETRE
    motion: str = ""
    interpolation: Interpolation = Interpolation.CUBIC
    frames: int = 30
    keyframes: tuple[PoseKey, ...] = ()

    def __post_init__(self) -> None:
        require_moments(self.keyframes)
        if self.frames < 2:
            raise RigError(f"drive.frames: found {self.frames}; expected at least 2, the first and the last pose")
        if not self.pose:
            raise RigError("drive.pose: names no joint; give at least one, for example pose = { elbow_deg = 75 }")
        for joint, degrees in self.pose:
            if not math.isfinite(degrees):
                raise RigError(f"drive.pose.{joint}_deg: found {degrees}; expected a finite angle in degrees")
        at_least_one("drive.landmarks_per_bone", self.landmarks_per_bone)

    @classmethod
    def check_table(cls, section: Section) -> None:
        """Raise RigError at two ways to landmarks, and units of none."""
        refuse_two_ways(section)
        if "units" in section and "landmarks" not in section:
            raise section.error(
                "units", "is the unit of drive.landmarks, which is not given (the joints state theirs); remove it"
            )

    def at_pose(self, pose: Pose) -> JointDrive:
        """At its angles; keyframes on the way to the rig's own pose are left out."""
        return replace(self, pose=pose.degrees, keyframes=())

    def plain(self) -> JointDrive:
        """Without keyframes."""
        return replace(self, keyframes=())

    def resolved(self, files: Files) -> JointDrive:
        """With absolute paths."""
        joints = files.find(self.joints, key="drive.joints")
        landmarks = found_if_named(self.landmarks, files, key="drive.landmarks")
        motion = found_if_named(self.motion, files, key="drive.motion")
        return replace(self, joints=joints, landmarks=landmarks, motion=motion)

    def read(self, files: Files, *, path: PathKind, rigid_bones: bool) -> OnJoints:
        """The joints, their motions to the pose, and the landmarks."""
        data = files.read(Path(self.joints), key="drive.joints")
        joints = parse_joints(parse_table(data, source=self.joints), source=self.joints)
        try:
            joints.check_pose(dict(self.pose))
        except RigError as error:
            raise files.named("drive.pose", error) from None
        try:
            motions = motions_of(self.pose, joints, kind=path, keyframes=self.keyframes)
        except RigError as error:
            raise files.named("drive.keyframes", error) from None
        if not self.landmarks:
            return OnJoints(self, motions, joints, None, path, rigid_bones)
        table = read_bone_landmarks(self.landmarks, files, units=self.units, movers="the joints")
        return OnJoints(
            self, motions, joints, handles_of(table), path, rigid_bones, table.findings, table.coordinate_system
        )


@dataclass(frozen=True, eq=False)
class OnJoints(Driver):
    """Joints with landmarks from a file, or None to spread the drive's ``landmarks_per_bone`` over each bone."""

    drive: JointDrive
    motions: BoneMotions
    joints: JointSystem
    landmarks: Handles | None
    path: PathKind
    rigid_bones: bool
    findings: tuple[Finding, ...] = ()
    frame: str = ""

    def parts(self) -> JobParts:
        """The joints and the motions to the pose."""
        return JobParts(motions=self.motions, joints=self.joints)

    def on_anatomy(self, anatomy: Anatomy, files: Files) -> OnJoints:  # noqa: ARG002
        """Where bones are rigid, those that no joint knows stay where they are."""
        if not self.rigid_bones:
            return self
        joints = self.joints.with_still(tissue.name for tissue in anatomy.of_kind(TissueKind.BONE))
        motions = motions_of(self.drive.pose, joints, kind=self.path, keyframes=self.drive.keyframes)
        return replace(self, joints=joints, motions=motions)

    def bone_findings(self, anatomy: Anatomy, files: Files) -> tuple[Finding, ...]:
        """Bones that no joint fixes or moves."""
        try:
            require_bones(anatomy, self.joints)
        except RigError as error:
            raise files.named("drive.joints", error) from None
        return joint_findings(anatomy, self.joints, subject=files.rig.name)

    def handles_on_path(self, anatomy: Anatomy) -> tuple[Handles, HandlePath]:
        """The landmarks on their bones."""
        handles = self.landmarks or bone_landmarks(
            anatomy, self.joints.bones(), per_bone=self.drive.landmarks_per_bone, motions=self.motions
        )
        return handles, path_by_joints(handles, self.motions, kind=self.path)
