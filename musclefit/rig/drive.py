"""What moves the handles of a rig: what a drive must say of itself, and the drives by kind.

Each drive is one file of `musclefit.io.drives`: the record of a [drive] section, the files that it names, and the
handles and the path that come of it. Everything else asks the record.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path as FilePath
from typing import ClassVar, Protocol, Self

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy
from musclefit.errors import InputError, RigError
from musclefit.rig.handles import BoneMotions, Handles, Path
from musclefit.rig.joints import JointSystem
from musclefit.rig.keyframes import PlaceKey, PoseKey
from musclefit.rig.lattice import ControlLattice
from musclefit.rig.motion import Pose
from musclefit.rig.table_reader import Section
from musclefit.rig.transforms import BoneTransforms
from musclefit.vocabulary import PathKind


class Files(Protocol):
    """The files that a rig names; see `musclefit.io.named_files.NamedFiles`."""

    @property
    def rig(self) -> FilePath:
        """The rig file, for messages."""
        ...

    def find(self, text: str, *, key: str) -> str:
        """The absolute path of what is written under a key."""
        ...

    def read(self, path: FilePath, *, key: str) -> bytes:
        """The bytes of a file, whose hash is kept."""
        ...

    def keep(self, path: FilePath, digest: str) -> None:
        """Keep the hash of a file that was read."""
        ...

    def named(self, key: str, error: InputError) -> InputError:
        """The same error with the rig file and the key in front."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class JobParts:
    """What a drive brings to a job beside handles and path; None where it has none.

    Parameters
    ----------
    motions : BoneMotions or None
        The rigid motion of every bone.
    joints : JointSystem or None
        For other poses of the same bones.
    transforms : BoneTransforms or None
        For other times of the same bones.
    lattice : ControlLattice or None
        The control points that drive.
    """

    motions: BoneMotions | None = None
    joints: JointSystem | None = None
    transforms: BoneTransforms | None = None
    lattice: ControlLattice | None = None


class Driver(ABC):
    """What a drive becomes once its files are read.

    It meets the anatomy in this order: ``on_anatomy``, ``bone_findings``, ``handles_on_path``.
    """

    findings: tuple[Finding, ...]
    frame: str
    """LPS or RAS where the files say so, else ""."""
    of: ClassVar[str] = "landmarks"
    """What the frame is that of, for messages."""

    def parts(self) -> JobParts:
        """What it brings to a job beside handles and path."""
        return JobParts()

    def on_anatomy(self, anatomy: Anatomy, files: Files) -> Self:  # noqa: ARG002
        """With what only the anatomy tells, such as the bones that others carry.

        Raises
        ------
        InputError
            A bone that the anatomy does not have.
        """
        return self

    def bone_findings(self, anatomy: Anatomy, files: Files) -> tuple[Finding, ...]:  # noqa: ARG002
        """Which bones the drive leaves to the soft tissue; raise InputError where it moves one that is not there."""
        return ()

    @abstractmethod
    def handles_on_path(self, anatomy: Anatomy) -> tuple[Handles, Path]:
        """The handles and their way.

        Raises
        ------
        LandmarkError
            Handles that do not suit the anatomy or the path.
        """


@dataclass(frozen=True, slots=True)
class Drive(ABC):
    """The record of a [drive] section. Its fields are the section's keys, beside ``kind``."""

    kind: ClassVar[str]
    paths: ClassVar[frozenset[PathKind]] = frozenset({PathKind.STRAIGHT})
    """Ways on which its handles can travel, beside those of rigid bones."""
    through: ClassVar[PathKind] = PathKind.STRAIGHT
    """The way that goes through its keyframes."""
    turns_bones: ClassVar[bool] = False
    """It says bones' rigid motions whatever the rig says of bones."""
    can_hold_bones: ClassVar[bool] = False
    """Bones can be rigid under it."""
    by_control_points: ClassVar[bool] = False
    poses_because: ClassVar[str] = ""
    """Why it is for another pose of the same body; "" where that depends on the field."""
    drives: ClassVar[str]
    """Subject and verb, such as "a cage drives"."""
    way: ClassVar[str] = ""
    """What its way is called in reports; "" for the name of the path."""
    twisted: ClassVar[bool] = False
    """Its keyframes have twists."""

    @classmethod  # noqa: B027
    def check_table(cls, section: Section) -> None:
        """Raise RigError at keys that are right by themselves and not beside each other."""

    @property
    def moments(self) -> tuple[float, ...]:
        """The moments of its keyframes."""
        keyframes: tuple[PlaceKey | PoseKey, ...] = getattr(self, "keyframes", ())
        return tuple(key.at for key in keyframes)

    def default_path(self, *, rigid_bones: bool) -> PathKind:  # noqa: ARG002
        """The path of a rig that names none."""
        return PathKind.STRAIGHT

    def chains(self, *, rigid_bones: bool) -> bool:  # noqa: ARG002
        """Whether its bones can hang on each other."""
        return False

    def check_bones(self, *, rigid: bool) -> None:  # noqa: B027
        """Raise RigError at what has no effect with bones that are, or are not, rigid."""

    def at_pose(self, pose: Pose) -> Self:  # noqa: ARG002
        """The same drive sent to another pose."""
        return self

    def plain(self) -> Self:
        """Without what only other methods than the paper's follow."""
        return self

    @abstractmethod
    def resolved(self, files: Files) -> Self:
        """With absolute paths; what they name is there.

        Raises
        ------
        RigError
            Nothing is there.
        """

    @abstractmethod
    def read(self, files: Files, *, path: PathKind, rigid_bones: bool) -> Driver:
        """Read what it names.

        Raises
        ------
        RigError, LandmarkError, MeshError
            A file that is missing or cannot be used; the message starts with the rig and the key.
        """


_known: dict[str, type[Drive]] = {}

_OWN_DRIVES = "musclefit.io.drives"
"""The room of the drives that come with musclefit: it stands above, and is imported once drives are asked for."""


class _Drives(Mapping[str, type[Drive]]):
    """The registered drives by kind, musclefit's own among them whatever was imported before."""

    def __getitem__(self, kind: str) -> type[Drive]:
        import_module(_OWN_DRIVES)
        return _known[kind]

    def __iter__(self) -> Iterator[str]:
        import_module(_OWN_DRIVES)
        return iter(_known)

    def __len__(self) -> int:
        import_module(_OWN_DRIVES)
        return len(_known)


DRIVES: Mapping[str, type[Drive]] = _Drives()
"""Every drive by its kind: musclefit's own, and those that `register_drive` made known."""


def register_drive(drive: type[Drive]) -> type[Drive]:
    """Make a drive known by its kind; may stand in front of the class.

    Raises
    ------
    RigError
        Another drive has that kind.
    """
    if _known.setdefault(drive.kind, drive) is not drive:
        raise RigError(f"a drive is of kind {drive.kind!r} already; give this one another")
    return drive


def found_if_named(text: str, files: Files, *, key: str) -> str:
    """The absolute path of a file that a rig may leave out; "" where it does."""
    return files.find(text, key=key) if text else ""


def found_keyframes(keyframes: Sequence[PlaceKey], files: Files) -> tuple[PlaceKey, ...]:
    """Keyframes with the absolute paths of their files."""
    return tuple(replace(key, file=files.find(key.file, key="drive.keyframes")) for key in keyframes)


def at_least_one(key: str, value: int) -> None:
    """Raise RigError at a number below 1."""
    if value < 1:
        raise RigError(f"{key}: found {value}; expected at least 1")


def finite(key: str, value: float | None, *, expected: str) -> None:
    """Raise RigError at a value that is not finite; None is none."""
    if value is not None and not math.isfinite(value):
        raise RigError(f"{key}: found {value}; expected {expected}")
