"""Drives: a rig and the files that its drive names in, handles and their way or bones' motions out."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy
from musclefit.errors import InputError, LandmarkError, MeshError, RigError
from musclefit.geometry.arrays import Points
from musclefit.geometry.meshes import TriMesh
from musclefit.io.anatomy import read_surface
from musclefit.io.formats.control_points import read_displacements
from musclefit.io.formats.landmarks import LandmarkTable, paired, positions_of, read_landmarks
from musclefit.io.formats.tables import parse_table
from musclefit.io.formats.transforms import parse_transforms
from musclefit.io.named_files import NamedFiles
from musclefit.rig.bone_fits import RigidPath, fit_bones, fit_findings, motions_of_fits
from musclefit.rig.carried import carriers
from musclefit.rig.chain import ChainMotions, carriers_of
from musclefit.rig.handles import BoneMotions, Handles
from musclefit.rig.job import cage_crossings, cage_handles, check_owners
from musclefit.rig.joints import JointSystem, parse_joints
from musclefit.rig.lattice import ControlLattice
from musclefit.rig.paths import ScrewMotions, motions_of, skeleton_of
from musclefit.rig.settings import (
    CageDrive,
    JointDrive,
    LandmarkDrive,
    LatticeDrive,
    Rig,
    SkeletonDrive,
    TransformDrive,
)
from musclefit.rig.skeleton import SkeletonPath
from musclefit.rig.transforms import BoneTransforms
from musclefit.vocabulary import CageCrossings, PathKind, Unit


@dataclass(frozen=True, eq=False, slots=True)
class Pairs:
    """A drive of pairs: handles and where they go, (m, 3) mm; ``frame`` is LPS or RAS where the file says so."""

    handles: Handles
    target: Points
    findings: tuple[Finding, ...]
    frame: str = ""
    lattice: ControlLattice | None = None
    keyframes: tuple[tuple[float, Points], ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class OnSkeleton:
    """A drive of a curve: its landmarks with their sections, and their way."""

    handles: Handles
    path: SkeletonPath
    findings: tuple[Finding, ...]
    frame: str = ""


@dataclass(frozen=True, eq=False, slots=True)
class OnBones:
    """A drive of joints: landmarks from a file, or None to spread ``per_bone`` over each bone."""

    motions: BoneMotions
    joints: JointSystem
    landmarks: Handles | None
    per_bone: int
    findings: tuple[Finding, ...] = ()
    frame: str = ""


@dataclass(frozen=True, eq=False, slots=True)
class OnTransforms:
    """A drive of transforms: landmarks from a file, or None to spread ``per_bone`` over each bone."""

    motions: ScrewMotions | ChainMotions
    transforms: BoneTransforms
    landmarks: Handles | None
    per_bone: int
    findings: tuple[Finding, ...] = ()
    frame: str = ""


@dataclass(frozen=True, eq=False, slots=True)
class OnFits:
    """A drive of landmarks that move their bones rigidly: by the motions that fit best."""

    handles: Handles
    motions: ScrewMotions | ChainMotions
    path: RigidPath
    findings: tuple[Finding, ...]
    frame: str = ""


Driver = Pairs | OnFits | OnBones | OnTransforms | OnSkeleton
"""What a drive becomes before the anatomy is known."""


def read_driver(rig: Rig, files: NamedFiles) -> Driver:
    """Read what the rig's drive names.

    Raises
    ------
    RigError, LandmarkError, MeshError
        A file that is missing or cannot be used; the message starts with the rig and the key.
    """
    match rig.drive:
        case LandmarkDrive():
            pairs = _read_landmark_pairs(rig.drive, files)
            return _on_fits(pairs, files) if rig.bones.rigid else pairs
        case TransformDrive():
            return _read_transforms(rig.drive, files, kind=rig.deformer.path)
        case SkeletonDrive():
            return _read_skeleton(rig.drive, files)
        case CageDrive():
            return _read_cages(rig.drive, files)
        case LatticeDrive():
            return _read_lattice(rig.drive, files)
        case JointDrive():
            return _read_joint_drive(rig.drive, files, kind=rig.deformer.path)


def _read_joint_drive(drive: JointDrive, files: NamedFiles, *, kind: PathKind) -> OnBones:
    data = files.read(Path(drive.joints), key="drive.joints")
    joints = parse_joints(parse_table(data, source=drive.joints), source=drive.joints)
    try:
        joints.check_pose(dict(drive.pose))
    except RigError as error:
        raise files.named("drive.pose", error) from None
    try:
        motions = motions_of(drive, joints, kind=kind)
    except RigError as error:
        raise files.named("drive.keyframes", error) from None
    if not drive.landmarks:
        return OnBones(motions, joints, None, drive.landmarks_per_bone)
    table = _read_bone_landmarks(drive, files)
    landmarks = _handles(table)
    return OnBones(motions, joints, landmarks, drive.landmarks_per_bone, table.findings, table.coordinate_system)


def _read_transforms(drive: TransformDrive, files: NamedFiles, *, kind: PathKind) -> OnTransforms:
    data = files.read(Path(drive.transforms), key="drive.transforms")
    key = "drive.transforms"
    try:
        transforms = parse_transforms(data, source=drive.transforms, units=drive.units)
        key = "drive.reference_time_s"
        if drive.reference_time_s is not None:
            transforms = transforms.relative_to(drive.reference_time_s)
        key = "drive.time_s"
        motions = transforms.motions(drive, kind=kind)
    except InputError as error:
        raise files.named(key, error) from None
    if not drive.landmarks:
        return OnTransforms(motions, transforms, None, drive.landmarks_per_bone, transforms.findings, transforms.frame)
    table = _read_bone_landmarks(drive, files)
    frames = {frame for frame in (table.coordinate_system, transforms.frame) if frame}
    if len(frames) == 2:
        raise LandmarkError(
            f"{files.rig}: drive.landmarks: {drive.landmarks} is in {table.coordinate_system}, but "
            f"{drive.transforms} in {transforms.frame}: x and y have opposite signs; export both in one system"
        )
    findings = (*transforms.findings, *table.findings)
    return OnTransforms(motions, transforms, _handles(table), drive.landmarks_per_bone, findings, "".join(frames))


def on_anatomy(driver: Driver, rig: Rig, anatomy: Anatomy, files: NamedFiles) -> Driver:
    """The driver with what only the anatomy tells: the bones that others carry, and which go along with which.

    Raises
    ------
    InputError
        What `carriers` and `BoneTransforms.check_bones` refuse.
    """
    drive, kind = rig.drive, rig.deformer.path
    if isinstance(driver, OnTransforms) and isinstance(drive, TransformDrive):
        transforms = driver.transforms
        try:
            transforms.check_bones(anatomy)
        except InputError as error:
            raise files.named("drive.transforms", error) from None
        transforms = transforms.carrying(_carried(drive, anatomy, files, moving=transforms.bones()))
        if kind is PathKind.CHAIN:
            transforms = transforms.chained(anatomy)
        return replace(driver, transforms=transforms, motions=transforms.motions(drive, kind=kind))
    if isinstance(driver, OnFits) and isinstance(drive, LandmarkDrive):
        try:
            check_owners(driver.handles, anatomy)
        except LandmarkError as error:
            raise files.named("drive", error) from None
        carried = _carried(drive, anatomy, files, moving=driver.motions.final)
        final = {**driver.motions.final, **{bone: driver.motions.final[by] for bone, by in carried.items()}}
        motions: ScrewMotions | ChainMotions = ScrewMotions(final)
        if kind is PathKind.CHAIN:
            motions = ChainMotions(final, carriers_of(anatomy, [final]))
        return replace(driver, motions=motions, path=replace(driver.path, motions=motions))
    return driver


def _carried(
    drive: LandmarkDrive | TransformDrive, anatomy: Anatomy, files: NamedFiles, *, moving: Collection[str]
) -> Mapping[str, str]:
    try:
        return carriers(anatomy, drive.carried, moving=moving)
    except RigError as error:
        raise files.named("drive.carried", error) from None


def _on_fits(pairs: Pairs, files: NamedFiles) -> OnFits:
    """Pairs whose bones move rigidly, as their landmarks fit best."""
    try:
        fits = fit_bones(pairs.handles, pairs.target)
    except LandmarkError as error:
        raise files.named("drive", error) from None
    motions = motions_of_fits(fits)
    path = RigidPath(pairs.handles, pairs.target, motions)
    return OnFits(pairs.handles, motions, path, (*pairs.findings, *fit_findings(fits)), pairs.frame)


def _read_landmark_pairs(drive: LandmarkDrive, files: NamedFiles) -> Pairs:
    table, targets = _with_targets(drive, files)
    keys = _landmark_keyframes(drive, files, names=table.names)
    return Pairs(_handles(table), targets, table.findings, table.coordinate_system, keyframes=keys)


def _read_skeleton(drive: SkeletonDrive, files: NamedFiles) -> OnSkeleton:
    table, targets = _with_targets(drive, files)
    keys = _landmark_keyframes(drive, files, names=table.names)
    try:
        skeleton = skeleton_of(drive, table.positions, targets, keyframes=keys, name=Path(drive.source).stem)
    except LandmarkError as error:
        raise files.named("drive", error) from None
    return OnSkeleton(*skeleton, table.findings, table.coordinate_system)


def _landmark_keyframes(
    drive: LandmarkDrive | SkeletonDrive, files: NamedFiles, *, names: Sequence[str]
) -> tuple[tuple[float, Points], ...]:
    """Moments and (m, 3) places, in the order of the names, mm."""
    found = []
    for key in drive.keyframes:
        table = _landmarks(key.file, files, key="drive.keyframes", drive=drive)
        try:
            found.append((key.at, positions_of(table, names)))
        except LandmarkError as error:
            raise files.named("drive.keyframes", error) from None
    return tuple(found)


def _with_targets(drive: LandmarkDrive | SkeletonDrive, files: NamedFiles) -> tuple[LandmarkTable, Points]:
    """The landmarks and where they go."""
    table = _landmarks(drive.source, files, key="drive.source", drive=drive)
    if drive.target:
        target = _landmarks(drive.target, files, key="drive.target", drive=drive)
        try:
            table = paired(table, target)
        except InputError as error:
            raise files.named("drive.target", error) from None
    if table.targets is None:
        raise LandmarkError(
            f"{files.rig}: drive.source: {drive.source} has no target columns ({_prefixes(drive)[1]}x_mm, ...); add "
            "them, say how they start in drive.target_prefix, or name a second file in drive.target"
        )
    return table, table.targets


def _prefixes(drive: LandmarkDrive | SkeletonDrive) -> tuple[str, str]:
    """What columns of positions and of targets start with."""
    return (drive.source_prefix, drive.target_prefix) if isinstance(drive, LandmarkDrive) else ("", "target_")


def _read_bone_landmarks(drive: JointDrive | TransformDrive, files: NamedFiles) -> LandmarkTable:
    table = _landmarks(drive.landmarks, files, key="drive.landmarks", drive=drive)
    if table.targets is not None:
        said = "the joints" if isinstance(drive, JointDrive) else "the transforms"
        raise LandmarkError(
            f"{files.rig}: drive.landmarks: {drive.landmarks} has target columns, but {said} say where landmarks "
            'go; remove the columns, or use a drive of kind "landmarks"'
        )
    return table


def _read_cages(drive: CageDrive, files: NamedFiles) -> Pairs:
    source, findings = _cage(drive.source, files, key="drive.source", units=drive.units)
    target, more = _cage(drive.target, files, key="drive.target", units=drive.units)
    try:
        pairs = cage_handles(source, target)
    except MeshError as error:
        raise files.named("drive.target", error) from None
    crossings = [
        found
        for path, cage in ((drive.source, source), (drive.target, target))
        for found in cage_crossings(cage, name=Path(path).stem)
    ]
    if crossings and drive.crossings is CageCrossings.REFUSE:
        raise MeshError(
            f"{files.rig}: drive: {len(crossings)} pairs of triangles of the cages cross (numbers from 0): "
            f"{'; '.join(found.message for found in crossings)}. Correct the cages, or go on all the same with "
            f'drive.crossings = "{CageCrossings.ACCEPT}"'
        )
    keys = []
    for key in drive.keyframes:
        cage, found = _cage(key.file, files, key="drive.keyframes", units=drive.units)
        try:
            keys.append((key.at, cage_handles(source, cage)[1]))
        except MeshError as error:
            raise files.named("drive.keyframes", error) from None
        findings = (*findings, *found)
    return Pairs(*pairs, (*findings, *more, *crossings), keyframes=tuple(keys))


def _read_lattice(drive: LatticeDrive, files: NamedFiles) -> Pairs:
    path, shape = Path(drive.displacements), (drive.shape[0], drive.shape[1], drive.shape[2])
    files.read(path, key="drive.displacements")
    try:
        moved = read_displacements(path, shape=shape, units=drive.units)
        lattice = ControlLattice(np.array(drive.low_mm), np.array(drive.high_mm), shape, moved)
    except InputError as error:
        raise files.named("drive.displacements" if isinstance(error, LandmarkError) else "drive", error) from None
    return Pairs(lattice.handles(), lattice.arrivals(), (), lattice=lattice)


def _landmarks(
    path: str, files: NamedFiles, *, key: str, drive: LandmarkDrive | JointDrive | TransformDrive | SkeletonDrive
) -> LandmarkTable:
    files.read(Path(path), key=key)
    try:
        if isinstance(drive, JointDrive | TransformDrive):
            return read_landmarks(Path(path), units=drive.units)
        prefixes = _prefixes(drive)
        return read_landmarks(Path(path), units=drive.units, source_prefix=prefixes[0], target_prefix=prefixes[1])
    except InputError as error:
        raise files.named(key, error) from None


def _handles(table: LandmarkTable) -> Handles:
    return Handles(table.names, table.positions, table.bones)


def _cage(path: str, files: NamedFiles, *, key: str, units: Unit) -> tuple[TriMesh, tuple[Finding, ...]]:
    try:
        raw = read_surface(Path(path), units=units)
        if raw.path.suffix.lower() == ".stl":
            raise MeshError(f"{path}: in STL every triangle has its own vertices; give the cage as PLY or OBJ")
        files.keep(raw.path, raw.sha256)
        return TriMesh(raw.vertices, raw.faces), raw.findings
    except InputError as error:
        raise files.named(key, error) from None
