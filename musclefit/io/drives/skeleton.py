"""A curve of landmarks that bends and twists with the sections it carries."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy
from musclefit.errors import LandmarkError, RigError
from musclefit.io.drives.landmark_pairs import read_keyframes, read_pairs
from musclefit.rig.drive import Drive, Driver, Files, found_if_named, found_keyframes, register_drive
from musclefit.rig.handles import Handles
from musclefit.rig.handles import Path as HandlePath
from musclefit.rig.keyframes import PlaceKey, require_moments
from musclefit.rig.skeleton import Skeleton, SkeletonPath, SkeletonPose, ring
from musclefit.vocabulary import PathKind, Unit


@register_drive
@dataclass(frozen=True, slots=True)
class SkeletonDrive(Drive):
    """A curve of landmarks that bends and twists with the sections it carries (`musclefit.rig.skeleton`).

    ``source`` and ``target`` are as in `LandmarkDrive`, the landmarks in order along the curve. ``ring_points`` stand
    around each of them in a circle of ``ring_mm``, the first along ``normal``. ``twist_deg`` is the turn of each
    station about the curve at the destination; none is no twist.

    Raises
    ------
    RigError
        Fewer than three points in a ring, a radius that is not positive, or keyframes out of order.
    """

    kind: ClassVar[str] = "skeleton"
    poses_because: ClassVar[str] = "a skeleton drives"
    drives: ClassVar[str] = "a skeleton drives"
    way: ClassVar[str] = "skeleton"
    twisted: ClassVar[bool] = True

    source: str
    ring_mm: float
    normal: tuple[float, ...]
    target: str = ""
    units: Unit = Unit.MILLIMETRE
    ring_points: int = 4
    twist_deg: tuple[float, ...] = ()
    keyframes: tuple[PlaceKey, ...] = ()

    def __post_init__(self) -> None:
        require_moments(self.keyframes)
        if self.ring_points < 3:
            raise RigError(f"drive.ring_points: found {self.ring_points}; expected at least 3")
        if not 0.0 < self.ring_mm < math.inf:
            raise RigError(f"drive.ring_mm: found {self.ring_mm}; expected a finite length above 0, in mm")
        if len(self.normal) != 3:
            raise RigError(f"drive.normal: has {len(self.normal)} entries; expected a list of 3 numbers")

    def resolved(self, files: Files) -> SkeletonDrive:
        """With absolute paths."""
        return replace(
            self,
            source=files.find(self.source, key="drive.source"),
            target=found_if_named(self.target, files, key="drive.target"),
            keyframes=found_keyframes(self.keyframes, files),
        )

    def read(self, files: Files, *, path: PathKind, rigid_bones: bool) -> OnSkeleton:  # noqa: ARG002
        """The curve at rest, at its destination and at keyframes, with its sections."""
        table, targets = read_pairs(self.source, self.target, files, units=self.units)
        keys = read_keyframes(self.keyframes, files, names=table.names, units=self.units)
        try:
            skeleton = Skeleton(table.positions, np.array(self.normal), ring(self.ring_points, radius_mm=self.ring_mm))
            still = (0.0,) * len(table.positions)
            places = [*keys, (1.0, targets)]
            twists = [*(key.twist_deg for key in self.keyframes), self.twist_deg]
            poses = tuple(
                SkeletonPose(at, curve, np.array(twist or still))
                for (at, curve), twist in zip(places, twists, strict=True)
            )
            handles, way = skeleton.handles(Path(self.source).stem), SkeletonPath(skeleton, poses)
        except LandmarkError as error:
            raise files.named("drive", error) from None
        return OnSkeleton(handles, way, table.findings, table.coordinate_system)


@dataclass(frozen=True, eq=False)
class OnSkeleton(Driver):
    """A curve's landmarks with their sections, and their way."""

    handles: Handles
    way: SkeletonPath
    findings: tuple[Finding, ...]
    frame: str = ""

    def handles_on_path(self, anatomy: Anatomy) -> tuple[Handles, HandlePath]:  # noqa: ARG002
        """They bend with the curve."""
        return self.handles, self.way
