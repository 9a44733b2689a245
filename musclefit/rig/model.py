"""A rig as a value: anatomy, driver, deformer, tetrahedra, limits; every setting has its unit and default here."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from musclefit.anatomy.model import TissueKind


class Unit(StrEnum):
    """Length unit of files."""

    MILLIMETRE = "mm"
    CENTIMETRE = "cm"
    METRE = "m"

    @property
    def in_mm(self) -> float:
        """How many mm one of this unit is."""
        return {Unit.MILLIMETRE: 1.0, Unit.CENTIMETRE: 10.0, Unit.METRE: 1000.0}[self]


class Kernel(StrEnum):
    """Radial kernel of the displacement field."""

    R = "r"
    R2_LOG_R = "r2logr"
    R3 = "r3"


class StepKind(StrEnum):
    """How one step is made from a field."""

    EXPLICIT = "explicit"


class StepRule(StrEnum):
    """The sufficient condition for a step to be one-to-one."""

    ROW_NORM = "row-norm"
    GERSHGORIN = "gershgorin"
    MONOTONE = "monotone"


class TestedAt(StrEnum):
    """Where the step rule is tested."""

    ALL_POINTS = "all-points"
    LANDMARKS = "landmarks"


class PathKind(StrEnum):
    """How handles travel from rest to their destinations."""

    STRAIGHT = "straight"
    JOINTS = "joints"


@dataclass(frozen=True, slots=True)
class AnatomySource:
    """Where the tissues come from: ``builtin`` names a generated anatomy, else a folder or files.

    ``kinds`` maps tissue names (or shell-style patterns) to kinds, ahead of what the file names say.
    """

    builtin: str = ""
    folder: str = ""
    files: tuple[str, ...] = ()
    units: Unit = Unit.MILLIMETRE
    frame: str = "as in the files"
    kinds: tuple[tuple[str, TissueKind], ...] = ()


@dataclass(frozen=True, slots=True)
class LandmarkDrive:
    """Landmark pairs. ``source`` alone: a CSV with target columns; with ``target``: two files matched by name."""

    source: str
    target: str = ""
    units: Unit = Unit.MILLIMETRE


@dataclass(frozen=True, slots=True)
class JointDrive:
    """Bone landmarks moved by joints: from a file, or ("") ``landmarks_per_bone`` spread over each bone."""

    joints: str
    pose: tuple[tuple[str, float], ...]
    landmarks: str = ""
    landmarks_per_bone: int = 8
    units: Unit = Unit.MILLIMETRE


@dataclass(frozen=True, slots=True)
class CageDrive:
    """Vertex pairs of two meshes with the same triangles."""

    source: str
    target: str
    units: Unit = Unit.MILLIMETRE


Drive = LandmarkDrive | JointDrive | CageDrive


@dataclass(frozen=True, slots=True)
class DeformerSettings:
    """Which field, which steps, how many."""

    backend: str = "rbf"
    kernel: Kernel = Kernel.R2_LOG_R
    step: StepKind = StepKind.EXPLICIT
    step_rule: StepRule = StepRule.ROW_NORM
    tested_at: TestedAt = TestedAt.ALL_POINTS
    path: PathKind = PathKind.STRAIGHT
    max_steps: int = 200


@dataclass(frozen=True, slots=True)
class TetSettings:
    """Tetrahedralisation; lengths as fractions of the bounding-box diagonal, as pytetwild takes them."""

    enabled: bool = True
    edge_length_fraction: float = 0.05
    envelope_fraction: float = 1e-3


@dataclass(frozen=True, slots=True)
class Limits:
    """What a run must keep to pass."""

    landmark_mm: float = 1e-6
    bone_rigidity_mm: float = 0.01
    muscle_volume_percent: float = 1.0
    introduced_overlap_mm3: float = 1.0
    introduced_outside_skin_mm3: float = 1.0
    inverted_tets: int = 0


@dataclass(frozen=True, slots=True)
class Rig:
    """Everything one run needs, as written in a rig file; paths are as resolved by the reader."""

    title: str
    anatomy: AnatomySource
    drive: Drive
    deformer: DeformerSettings = field(default_factory=DeformerSettings)
    tets: TetSettings = field(default_factory=TetSettings)
    limits: Limits = field(default_factory=Limits)
