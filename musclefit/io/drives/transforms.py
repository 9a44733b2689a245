"""One rigid transform per bone and time moves bones, and the landmarks on them: 4-D CT, fluoroscopy, motion capture."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy
from musclefit.errors import InputError, LandmarkError, RigError
from musclefit.io.drives.bone_landmarks import handles_of, read_bone_landmarks, refuse_two_ways
from musclefit.io.drives.carried_bones import Carried, carriers_named, motion_findings
from musclefit.io.formats.transforms import parse_transforms
from musclefit.rig.chain import ChainMotions
from musclefit.rig.drive import Drive, Driver, Files, JobParts, at_least_one, finite, found_if_named, register_drive
from musclefit.rig.handles import Handles
from musclefit.rig.handles import Path as HandlePath
from musclefit.rig.job import path_by_joints
from musclefit.rig.motion import Pose
from musclefit.rig.paths import ScrewMotions
from musclefit.rig.spread import bone_landmarks
from musclefit.rig.table_reader import Section
from musclefit.rig.transforms import BoneTransforms
from musclefit.vocabulary import PathKind, Unit


@register_drive
@dataclass(frozen=True, slots=True)
class TransformDrive(Drive):
    """One rigid transform per bone and time, from rest to the pose (`musclefit.rig.transforms`).

    ``time_s`` is the time of the pose, the last where it is None. With ``reference_time_s`` the anatomy rests where
    the bones are at that time, and the motions start from there. ``units`` is the length unit of files that state none.
    ``carried`` holds bones with those (or shell-style patterns for them) that move with them. Handles are the
    ``landmarks`` of a file, or ("") ``landmarks_per_bone`` spread over each bone. A sequence has ``frames`` poses
    evenly spaced in time, or (0) those of the file.

    Raises
    ------
    RigError
        One frame or fewer than none, a time that is not finite, or fewer than one landmark per bone.
    """

    kind: ClassVar[str] = "transforms"
    paths: ClassVar[frozenset[PathKind]] = frozenset({PathKind.STRAIGHT, PathKind.CHAIN, PathKind.SCREWS})
    turns_bones: ClassVar[bool] = True
    can_hold_bones: ClassVar[bool] = True
    poses_because: ClassVar[str] = "transforms move the bones"
    drives: ClassVar[str] = "transforms drive"

    transforms: str
    time_s: float | None = None
    reference_time_s: float | None = None
    units: Unit = Unit.MILLIMETRE
    carried: Carried = ()
    landmarks: str = ""
    landmarks_per_bone: int = 8
    frames: int = 0

    def __post_init__(self) -> None:
        if self.frames < 0 or self.frames == 1:
            raise RigError(f"drive.frames: found {self.frames}; expected at least 2, or 0 for the file's own times")
        for key in ("time_s", "reference_time_s"):
            finite(f"drive.{key}", getattr(self, key), expected="a finite time in seconds")
        at_least_one("drive.landmarks_per_bone", self.landmarks_per_bone)

    @classmethod
    def check_table(cls, section: Section) -> None:
        """Raise RigError at two ways to landmarks."""
        refuse_two_ways(section)

    def default_path(self, *, rigid_bones: bool) -> PathKind:  # noqa: ARG002
        """On chains."""
        return PathKind.CHAIN

    def chains(self, *, rigid_bones: bool) -> bool:  # noqa: ARG002
        """Always."""
        return True

    def at_pose(self, pose: Pose) -> TransformDrive:
        """At its time."""
        return replace(self, time_s=pose.time_s)

    def resolved(self, files: Files) -> TransformDrive:
        """With absolute paths."""
        transforms = files.find(self.transforms, key="drive.transforms")
        landmarks = found_if_named(self.landmarks, files, key="drive.landmarks")
        return replace(self, transforms=transforms, landmarks=landmarks)

    def read(self, files: Files, *, path: PathKind, rigid_bones: bool) -> OnTransforms:  # noqa: ARG002
        """The transforms, the motions to the pose, and the landmarks.

        Raises
        ------
        LandmarkError
            Landmarks and transforms are in different coordinate systems.
        """
        data = files.read(Path(self.transforms), key="drive.transforms")
        key = "drive.transforms"
        try:
            transforms = parse_transforms(data, source=self.transforms, units=self.units)
            key = "drive.reference_time_s"
            if self.reference_time_s is not None:
                transforms = transforms.relative_to(self.reference_time_s)
            key = "drive.time_s"
            motions = transforms.motions(self.time_s, kind=path)
        except InputError as error:
            raise files.named(key, error) from None
        if not self.landmarks:
            return OnTransforms(self, path, motions, transforms, None, transforms.findings, transforms.frame)
        table = read_bone_landmarks(self.landmarks, files, units=self.units, movers="the transforms")
        frames = {frame for frame in (table.coordinate_system, transforms.frame) if frame}
        if len(frames) == 2:
            raise LandmarkError(
                f"{files.rig}: drive.landmarks: {self.landmarks} is in {table.coordinate_system}, but "
                f"{self.transforms} in {transforms.frame}: x and y have opposite signs; export both in one system"
            )
        findings = (*transforms.findings, *table.findings)
        return OnTransforms(self, path, motions, transforms, handles_of(table), findings, "".join(frames))


@dataclass(frozen=True, eq=False)
class OnTransforms(Driver):
    """Transforms with landmarks from a file, or None to spread some over each bone."""

    drive: TransformDrive
    path: PathKind
    motions: ScrewMotions | ChainMotions
    transforms: BoneTransforms
    landmarks: Handles | None
    findings: tuple[Finding, ...] = ()
    frame: str = ""
    of: ClassVar[str] = "transforms"

    def parts(self) -> JobParts:
        """The transforms and the motions to the pose."""
        return JobParts(motions=self.motions, transforms=self.transforms)

    def on_anatomy(self, anatomy: Anatomy, files: Files) -> OnTransforms:
        """With the bones that others carry, and on chains which hang on which."""
        transforms = self.transforms
        try:
            transforms.check_bones(anatomy)
        except InputError as error:
            raise files.named("drive.transforms", error) from None
        moving = transforms.bones()
        transforms = transforms.carrying(carriers_named(self.drive.carried, anatomy, files, moving=moving))
        if self.path is PathKind.CHAIN:
            transforms = transforms.chained(anatomy)
        return replace(self, transforms=transforms, motions=transforms.motions(self.drive.time_s, kind=self.path))

    def bone_findings(self, anatomy: Anatomy, files: Files) -> tuple[Finding, ...]:
        """Bones without a transform."""
        return motion_findings(
            self.motions, anatomy, subject=files.rig.name, said="have no transform", code="bone-without-transform"
        )

    def handles_on_path(self, anatomy: Anatomy) -> tuple[Handles, HandlePath]:
        """The landmarks on their bones."""
        per_bone = self.drive.landmarks_per_bone
        handles = self.landmarks or bone_landmarks(
            anatomy, self.transforms.bones(), per_bone=per_bone, motions=self.motions
        )
        return handles, path_by_joints(handles, self.motions, kind=self.path, by="transform")
