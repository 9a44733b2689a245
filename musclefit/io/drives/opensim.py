"""An OpenSim model moves bones: its own kinematics, by coordinates of a pose or motion, or by markers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import ClassVar

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.errors import InputError, RigError
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.drives.bone_landmarks import handles_of, read_bone_landmarks, refuse_two_ways
from musclefit.io.drives.carried_bones import Carried, motion_findings
from musclefit.io.formats.opensim_motion import CoordinateMotion, parse_opensim_motion
from musclefit.io.formats.osim import OpenSimModel, parse_osim
from musclefit.io.marker_motions import ENDINGS as MARKERS
from musclefit.io.marker_motions import MarkerFrame, Up, coordinates_of_markers
from musclefit.rig.chain import ChainMotions
from musclefit.rig.drive import Drive, Driver, Files, JobParts, at_least_one, finite, found_if_named, register_drive
from musclefit.rig.handles import Handles
from musclefit.rig.handles import Path as HandlePath
from musclefit.rig.job import path_by_joints
from musclefit.rig.motion import Pose
from musclefit.rig.multibody import GROUND, CoordinateKind, Multibody
from musclefit.rig.paths import ScrewMotions
from musclefit.rig.spread import bone_landmarks
from musclefit.rig.table_reader import Section, suggestion
from musclefit.rig.transforms import BoneTransforms, Track
from musclefit.vocabulary import PathKind, Unit


@register_drive
@dataclass(frozen=True, slots=True)
class OpenSimDrive(Drive):
    """Bones on the bodies of an OpenSim model; the anatomy rests where the model's default pose has its bodies.

    ``carried`` holds the bodies, each with its bones or shell-style patterns for them. A run goes to ``pose``,
    coordinates with their angles in degrees, or to the motion's ``time_s``, the last where it is None. A sequence
    follows ``motion`` in ``frames`` poses evenly spaced in time, or (0) at the file's own times. Markers of a .trc or
    .c3d become coordinates by OpenSim's inverse kinematics; before, ``markers_up`` is turned to y and
    ``markers_shift_mm`` added.

    Raises
    ------
    RigError
        Neither pose nor motion, a time beside a pose, or a number that is out of place.
    """

    kind: ClassVar[str] = "opensim"
    paths: ClassVar[frozenset[PathKind]] = frozenset({PathKind.STRAIGHT, PathKind.CHAIN, PathKind.SCREWS})
    turns_bones: ClassVar[bool] = True
    can_hold_bones: ClassVar[bool] = True
    poses_because: ClassVar[str] = "a model's coordinates move the bones"
    drives: ClassVar[str] = "an OpenSim model drives"

    model: str
    carried: Carried
    pose: tuple[tuple[str, float], ...] = ()
    motion: str = ""
    time_s: float | None = None
    landmarks: str = ""
    landmarks_per_bone: int = 8
    units: Unit = Unit.MILLIMETRE
    frames: int = 0
    markers_up: Up | None = None
    markers_shift_mm: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.pose and not self.motion:
            raise RigError("drive.pose: is missing; give a pose = { knee_angle_r_deg = 60 }, or a drive.motion")
        if self.pose and self.time_s is not None:
            raise RigError("drive.time_s: has no effect beside drive.pose; remove one of the two")
        if self.frames < 0 or self.frames == 1:
            raise RigError(f"drive.frames: found {self.frames}; expected at least 2, or 0 for the file's own times")
        for name, degrees in self.pose:
            if not math.isfinite(degrees):
                raise RigError(f"drive.pose.{name}_deg: found {degrees}; expected a finite angle in degrees")
        finite("drive.time_s", self.time_s, expected="a finite time in seconds")
        at_least_one("drive.landmarks_per_bone", self.landmarks_per_bone)
        if self.markers_shift_mm and len(self.markers_shift_mm) != 3:
            raise RigError(f"drive.markers_shift_mm: has {len(self.markers_shift_mm)} numbers; expected x, y and z, mm")
        if (self.markers_up or self.markers_shift_mm) and not self.motion.lower().endswith(MARKERS):
            key = "markers_up" if self.markers_up else "markers_shift_mm"
            raise RigError(f"drive.{key}: has no effect without markers; drive.motion must be a .trc or .c3d")

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

    def at_pose(self, pose: Pose) -> OpenSimDrive:
        """At its time."""
        return replace(self, pose=(), time_s=pose.time_s)

    def resolved(self, files: Files) -> OpenSimDrive:
        """With absolute paths."""
        return replace(
            self,
            model=files.find(self.model, key="drive.model"),
            motion=found_if_named(self.motion, files, key="drive.motion"),
            landmarks=found_if_named(self.landmarks, files, key="drive.landmarks"),
        )

    @property
    def _frame(self) -> MarkerFrame:
        return MarkerFrame(self.markers_up, self.markers_shift_mm or (0.0, 0.0, 0.0))

    def read(self, files: Files, *, path: PathKind, rigid_bones: bool) -> OnModel:  # noqa: ARG002
        """The model, the bodies' transforms, and the landmarks."""
        key = "drive.model"
        try:
            model = parse_osim(files.read(Path(self.model), key=key), source=self.model)
            findings = tuple(Finding(Path(self.model).name, "not-followed", said) for said in model.not_followed)
            posed = followed = None
            key = "drive.pose"
            if self.pose:
                moved = model.multibody.motions(pose_in_radians(self.pose, model.multibody))
                tracks = {body: Track(np.zeros(1), (motion,)) for body, motion in moved.items()}
                posed = BoneTransforms(tracks, self.model, timed=False)
            key = "drive.motion"
            if self.motion:
                data = files.read(Path(self.motion), key=key)
                followed, found = followed_motion(data, model, source=self.motion, frame=self._frame)
                findings += found
            key = "drive.time_s"
            if followed is not None and self.time_s is not None:
                followed.at(self.time_s)
        except InputError as error:
            raise files.named(key, error) from None
        landmarks = None
        if self.landmarks:
            table = read_bone_landmarks(self.landmarks, files, units=self.units, movers="the model's bodies")
            landmarks, findings = handles_of(table), findings + table.findings
        every = (followed, posed)
        whole = next(one for one in every if one is not None)
        return OnModel(self, path, posed or whole, whole, model.multibody, landmarks, findings)


def coordinate_motion(
    data: bytes, model: OpenSimModel, *, source: str, frame: MarkerFrame | None = None
) -> CoordinateMotion:
    """A model's coordinates over time, of a .mot, .sto, .trc or .c3d.

    Raises
    ------
    InputError
        See `parse_opensim_motion` and `coordinates_of_markers`.
    """
    if source.lower().endswith(MARKERS):
        return coordinates_of_markers(data, model, source=source, frame=frame)
    return parse_opensim_motion(data, model.multibody, source=source)


def followed_motion(
    data: bytes, model: OpenSimModel, *, source: str, frame: MarkerFrame | None = None
) -> tuple[BoneTransforms, tuple[Finding, ...]]:
    """The bodies' transforms from the default pose at each time of a motion, by the model's kinematics."""
    motion, multibody = coordinate_motion(data, model, source=source, frame=frame), model.multibody
    poses = [multibody.motions(motion.at(row)) for row in range(len(motion.times_s))]
    tracks = {body: Track(motion.times_s, tuple(pose[body] for pose in poses)) for body in multibody.bodies}
    return BoneTransforms(tracks, source, timed=True), motion.findings


def pose_in_radians(pose: Sequence[tuple[str, float]], multibody: Multibody) -> dict[str, float]:
    """Coordinates by the angles of a pose, degrees.

    Raises
    ------
    RigError
        A coordinate that the model does not have, that is no angle, locked, coupled, or beyond its range.
    """
    coupled = {coupler.dependent: coupler.independent for coupler in multibody.couplers}
    values = {}
    for name, degrees in pose:
        of = multibody.coordinates.get(name)
        if of is None:
            raise RigError(f"the model has no coordinate {name!r}; {suggestion(name, multibody.coordinates)}")
        if of.kind is not CoordinateKind.ROTATIONAL:
            raise RigError(f"coordinate {name!r} is {of.kind.value}, no angle; give it in a drive.motion")
        if of.locked:
            raise RigError(f"coordinate {name!r} is locked in the model; leave it out, or unlock it there")
        if name in coupled:
            raise RigError(f"coordinate {name!r} follows {coupled[name]!r} by a coupler; set that one")
        low, high = np.rad2deg([of.low, of.high]).tolist()
        if not low - 1e-6 <= degrees <= high + 1e-6:
            raise RigError(f"coordinate {name!r}: found {degrees:g} degrees; its range is {low:.4g} to {high:.4g}")
        values[name] = float(np.deg2rad(degrees))
    return values


@dataclass(frozen=True, eq=False)
class OnModel(Driver):
    """Bodies' transforms; those of bones once the anatomy is known.

    ``posed`` holds those of the run's pose, ``followed`` those of its motion; they are one where one is given alone.
    """

    drive: OpenSimDrive
    path: PathKind
    posed: BoneTransforms
    followed: BoneTransforms
    multibody: Multibody
    landmarks: Handles | None
    findings: tuple[Finding, ...]
    motions: ScrewMotions | ChainMotions | None = None
    frame: str = ""
    of: ClassVar[str] = "bodies"

    def parts(self) -> JobParts:
        """The transforms and the motions to the pose."""
        return JobParts(motions=self._motions, transforms=self.followed)

    @property
    def _motions(self) -> ScrewMotions | ChainMotions:
        assert self.motions is not None
        return self.motions

    def on_anatomy(self, anatomy: Anatomy, files: Files) -> OnModel:
        """With the bones that stand on the bodies."""
        try:
            bodies = bodies_of(anatomy, self.drive.carried, self.multibody)
        except RigError as error:
            raise files.named("drive.carried", error) from None
        posed = _of_bones(self.posed, bodies)
        followed = posed if self.followed is self.posed else _of_bones(self.followed, bodies)
        try:
            for transforms in (posed, followed):
                transforms.check_bones(anatomy)
        except InputError as error:
            raise files.named("drive.model", error) from None
        if self.path is PathKind.CHAIN:
            posed, followed = (transforms.chained(anatomy) for transforms in (posed, followed))
        motions = posed.motions(self.drive.time_s, kind=self.path)
        return replace(self, posed=posed, followed=followed, motions=motions)

    def bone_findings(self, anatomy: Anatomy, files: Files) -> tuple[Finding, ...]:
        """Bones that stand on no body."""
        return motion_findings(
            self._motions, anatomy, subject=files.rig.name, said="stand on no body", code="bone-without-body"
        )

    def handles_on_path(self, anatomy: Anatomy) -> tuple[Handles, HandlePath]:
        """The landmarks on their bones."""
        bones = self.followed.bones()
        handles = self.landmarks or bone_landmarks(
            anatomy, bones, per_bone=self.drive.landmarks_per_bone, motions=self._motions
        )
        return handles, path_by_joints(handles, self._motions, kind=self.path, by="body")


def bodies_of(anatomy: Anatomy, carried: Carried, multibody: Multibody) -> Mapping[str, str]:
    """The body of each bone that a pattern names.

    Raises
    ------
    RigError
        A body that the model does not have, a pattern that no bone fits, or a bone on two bodies.
    """
    bones = [tissue.name for tissue in anatomy.of_kind(TissueKind.BONE)]
    found: dict[str, str] = {}
    for body, patterns in carried:
        if body not in (GROUND, *multibody.bodies):
            raise RigError(f"the model has no body {body!r}; {suggestion(body, multibody.bodies)}")
        for pattern in patterns:
            fitting = [bone for bone in bones if fnmatchcase(bone, pattern)]
            if not fitting:
                raise RigError(f"{body}: no bone of the anatomy fits {pattern!r}; {suggestion(pattern, bones)}")
            for bone in fitting:
                if found.setdefault(bone, body) != body:
                    raise RigError(f"bone {bone!r} is on {found[bone]!r} and on {body!r}; name it once")
    return found


def _of_bones(transforms: BoneTransforms, bodies: Mapping[str, str]) -> BoneTransforms:
    """The transforms of bones by those of their bodies."""
    times = next(iter(transforms.tracks.values())).times_s
    still = Track(times, tuple(RigidMotion.identity() for _ in times))
    tracks = {bone: transforms.tracks.get(body, still) for bone, body in bodies.items()}
    return replace(transforms, tracks=tracks)
