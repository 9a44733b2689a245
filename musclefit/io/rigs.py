"""Rig files: takes the path of a rig, reads every file it names, gives the `Job` that a run needs."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy
from musclefit.errors import InputError, LandmarkError, MeshError, RigError
from musclefit.geometry.arrays import Points
from musclefit.geometry.meshes import TriMesh
from musclefit.io.landmarks import LandmarkTable, paired, positions_of, read_landmarks
from musclefit.io.lattices import read_displacements
from musclefit.io.named_files import NamedFiles
from musclefit.io.point_files import outside_findings, read_points
from musclefit.io.rig_names import builtin_rig_path, builtin_rigs, find_rig
from musclefit.io.surfaces import read_anatomy, read_surface
from musclefit.io.tables import parse_table, parse_toml
from musclefit.progress import Progress, Silent
from musclefit.rig.handles import BoneMotions, Handles
from musclefit.rig.handles import Path as HandlePath
from musclefit.rig.job import (
    FurtherPoints,
    Job,
    cage_crossings,
    cage_handles,
    check_handles,
    joint_findings,
    path_by_joints,
    path_by_pairs,
    require_bones,
)
from musclefit.rig.joints import JointSystem, parse_joints
from musclefit.rig.lattice import ControlLattice
from musclefit.rig.model import (
    CageCrossings,
    CageDrive,
    Drive,
    JointDrive,
    Keyed,
    LandmarkDrive,
    LatticeDrive,
    PathKind,
    Rig,
    SkeletonDrive,
    Unit,
)
from musclefit.rig.paths import motions_of, skeleton_of
from musclefit.rig.section import suggestion
from musclefit.rig.skeleton import SkeletonPath
from musclefit.rig.spread import bone_landmarks
from musclefit.rig.table import apply_overrides, parse_rig

__all__ = ["builtin_rig_path", "builtin_rigs", "find_rig", "read_rig"]

_SILENT = Silent()


def read_rig(
    path: str | Path,
    *,
    overrides: Sequence[str] = (),
    points: Sequence[Path] = (),
    progress: Progress = _SILENT,
) -> Job:
    """Read a rig file and every file it names.

    Cheap things are read and checked first: the rig, the joints and the pose, the landmarks; then the anatomy.

    Parameters
    ----------
    path : path of a TOML file
        See `find_rig` for rigs by name. Relative paths in it start at its folder, those of ``overrides`` too;
        ``${MUSCLEFIT_DATA}`` stands for that environment variable, or where it is not set for ``../../shared/data``
        from the rig's folder.
    overrides : sequence of str
        ``key=value`` each; see `musclefit.rig.table.apply_overrides`.
    points : sequence of path
        Further files of points to take along, beside those of the rig; they start at the current folder.
    progress : Progress
        Told of reading the anatomy.

    Returns
    -------
    Job
        Checked: the handles stand apart, near the anatomy, and belong to bones that exist.

    Raises
    ------
    RigError
        The file is missing or broken, says something that `parse_rig` or `parse_joints` refuse, or names a file that
        is not there; the message starts with the file and the key.
    LandmarkError, MeshError
        Landmarks, cages or surfaces that cannot be used.
    """
    rig_path = Path(path)
    files = NamedFiles(rig_path)
    table = parse_toml(files.read(rig_path, key=""), source=str(rig_path))
    if overrides:
        table = apply_overrides(table, overrides, source=str(rig_path))
    rig = _resolved(parse_rig(table, source=str(rig_path)), files)
    further = _read_further(rig, points, files)
    driver = _read_driver(rig, files)
    anatomy, findings = _read_anatomy(rig, files, progress=progress)
    motions, joints = None, None
    if isinstance(driver, _OnBones):
        motions, joints = driver.motions, driver.joints
        _require_bones(anatomy, driver, files)
        findings += joint_findings(anatomy, joints, subject=rig_path.name)
    findings += (*driver.findings, *_frame_findings(anatomy, driver.frame, files))
    findings += outside_findings(further, anatomy)
    handles, handle_path = _driven(rig, anatomy, driver=driver, files=files)
    return Job(
        rig=rig,
        anatomy=anatomy,
        findings=findings,
        handles=handles,
        path=handle_path,
        motions=motions,
        hashes=files.hashes,
        name=rig_path.stem,
        source=str(rig_path),
        joints=joints,
        lattice=driver.lattice if isinstance(driver, _Pairs) else None,
        overrides=tuple(overrides),
        further=further,
        stops=_stops(rig.drive),
    )


def _resolved(rig: Rig, files: NamedFiles) -> Rig:
    """The rig with absolute paths; what they name is there."""
    anatomy = rig.anatomy
    if anatomy.folder:
        anatomy = replace(anatomy, folder=files.find(anatomy.folder, key="anatomy.folder"))
    surfaces = tuple(files.find(file, key="anatomy.files") for file in anatomy.files)
    points = tuple(files.find(file, key="anatomy.points") for file in anatomy.points)
    anatomy = replace(anatomy, files=surfaces, points=points)
    return replace(rig, anatomy=anatomy, drive=_resolved_drive(rig.drive, files))


def _read_further(rig: Rig, given: Sequence[Path], files: NamedFiles) -> tuple[FurtherPoints, ...]:
    """The further points, read; the files' names must differ, since they are written side by side."""
    found: dict[str, FurtherPoints] = {}
    for path in (*(Path(written) for written in rig.anatomy.points), *given):
        try:
            files.read(path, key="anatomy.points")
            read = read_points(path, units=rig.anatomy.units)
            if read.name in found:
                raise InputError(f"{path}: two files of points are named {read.name!r}; rename one")
        except InputError as error:
            raise files.named("anatomy.points", error) from None
        found[read.name] = read
    return tuple(found.values())


def _resolved_drive(drive: Drive, files: NamedFiles) -> Drive:
    match drive:
        case JointDrive():
            joints = files.find(drive.joints, key="drive.joints")
            landmarks = files.find(drive.landmarks, key="drive.landmarks") if drive.landmarks else ""
            motion = files.find(drive.motion, key="drive.motion") if drive.motion else ""
            return replace(drive, joints=joints, landmarks=landmarks, motion=motion)
        case LatticeDrive():
            return replace(drive, displacements=files.find(drive.displacements, key="drive.displacements"))
        case LandmarkDrive() | CageDrive() | SkeletonDrive():
            source = files.find(drive.source, key="drive.source")
            target = files.find(drive.target, key="drive.target") if drive.target else ""
            keyframes = tuple(replace(k, file=files.find(k.file, key="drive.keyframes")) for k in drive.keyframes)
            return replace(drive, source=source, target=target, keyframes=keyframes)


@dataclass(frozen=True, eq=False, slots=True)
class _Pairs:
    """A drive of pairs: handles and where they go, (m, 3) mm; ``frame`` is LPS or RAS where the file says so."""

    handles: Handles
    target: Points
    findings: tuple[Finding, ...]
    frame: str = ""
    lattice: ControlLattice | None = None
    keyframes: tuple[tuple[float, Points], ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class _OnSkeleton:
    """A drive of a curve: its landmarks with their sections, and their way."""

    handles: Handles
    path: SkeletonPath
    findings: tuple[Finding, ...]
    frame: str = ""


@dataclass(frozen=True, eq=False, slots=True)
class _OnBones:
    """A drive of joints: landmarks from a file, or None to spread ``per_bone`` over each bone."""

    motions: BoneMotions
    joints: JointSystem
    landmarks: Handles | None
    per_bone: int
    findings: tuple[Finding, ...] = ()
    frame: str = ""


_Driver = _Pairs | _OnBones | _OnSkeleton


def _read_driver(rig: Rig, files: NamedFiles) -> _Driver:
    match rig.drive:
        case LandmarkDrive():
            return _read_landmark_pairs(rig.drive, files)
        case SkeletonDrive():
            return _read_skeleton(rig.drive, files)
        case CageDrive():
            return _read_cages(rig.drive, files)
        case LatticeDrive():
            return _read_lattice(rig.drive, files)
        case JointDrive():
            return _read_joint_drive(rig.drive, files, kind=rig.deformer.path)


def _read_joint_drive(drive: JointDrive, files: NamedFiles, *, kind: PathKind) -> _OnBones:
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
        return _OnBones(motions, joints, None, drive.landmarks_per_bone)
    table = _read_bone_landmarks(drive, files)
    landmarks = _handles(table)
    return _OnBones(motions, joints, landmarks, drive.landmarks_per_bone, table.findings, table.coordinate_system)


def _read_landmark_pairs(drive: LandmarkDrive, files: NamedFiles) -> _Pairs:
    table, targets = _with_targets(drive, files)
    keys = _landmark_keyframes(drive, files, names=table.names)
    return _Pairs(_handles(table), targets, table.findings, table.coordinate_system, keyframes=keys)


def _read_skeleton(drive: SkeletonDrive, files: NamedFiles) -> _OnSkeleton:
    table, targets = _with_targets(drive, files)
    keys = _landmark_keyframes(drive, files, names=table.names)
    try:
        skeleton = skeleton_of(drive, table.positions, targets, keyframes=keys, name=Path(drive.source).stem)
    except LandmarkError as error:
        raise files.named("drive", error) from None
    return _OnSkeleton(*skeleton, table.findings, table.coordinate_system)


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


def _read_bone_landmarks(drive: JointDrive, files: NamedFiles) -> LandmarkTable:
    table = _landmarks(drive.landmarks, files, key="drive.landmarks", drive=drive)
    if table.targets is not None:
        raise LandmarkError(
            f"{files.rig}: drive.landmarks: {drive.landmarks} has target columns, but the joints say where landmarks "
            'go; remove the columns, or use a drive of kind "landmarks"'
        )
    return table


def _read_cages(drive: CageDrive, files: NamedFiles) -> _Pairs:
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
    return _Pairs(*pairs, (*findings, *more, *crossings), keyframes=tuple(keys))


def _read_lattice(drive: LatticeDrive, files: NamedFiles) -> _Pairs:
    path, shape = Path(drive.displacements), (drive.shape[0], drive.shape[1], drive.shape[2])
    files.read(path, key="drive.displacements")
    try:
        moved = read_displacements(path, shape=shape, units=drive.units)
        lattice = ControlLattice(np.array(drive.low_mm), np.array(drive.high_mm), shape, moved)
    except InputError as error:
        raise files.named("drive.displacements" if isinstance(error, LandmarkError) else "drive", error) from None
    return _Pairs(lattice.handles(), lattice.arrivals(), (), lattice=lattice)


def _landmarks(
    path: str, files: NamedFiles, *, key: str, drive: LandmarkDrive | JointDrive | SkeletonDrive
) -> LandmarkTable:
    files.read(Path(path), key=key)
    try:
        if isinstance(drive, JointDrive):
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


def _read_anatomy(rig: Rig, files: NamedFiles, *, progress: Progress) -> tuple[Anatomy, tuple[Finding, ...]]:
    source = rig.anatomy
    if source.builtin:
        from musclefit.anatomy.builtin import BUILTIN  # takes longer to import than most rigs to read

        if source.builtin not in BUILTIN:
            raise RigError(
                f"{files.rig}: anatomy.builtin: found {source.builtin!r}; {suggestion(source.builtin, BUILTIN)}"
            )
        return BUILTIN[source.builtin](), ()
    place: Path | tuple[Path, ...] = Path(source.folder) if source.folder else tuple(Path(f) for f in source.files)
    try:
        read = read_anatomy(place, units=source.units, kinds=source.kinds, frame=source.frame, progress=progress)
    except InputError as error:
        raise files.named("anatomy", error) from None
    for name, digest in read.hashes.items():
        written = f"{files.written[source.folder]}/{name}" if source.folder else os.path.relpath(name, files.folder)
        files.hashes[written] = digest
    return read.anatomy, read.findings


def _frame_findings(anatomy: Anatomy, frame: str, files: NamedFiles) -> tuple[Finding, ...]:
    """Raise LandmarkError where landmarks and anatomy state different frames; a finding where only one states its."""
    stated = set(re.findall(r"\b(?:LPS|RAS)\b", anatomy.frame))
    if not frame or stated == {frame}:
        return ()
    if stated:
        raise LandmarkError(
            f"{files.rig}: drive: the landmarks are in {frame}, but the anatomy's frame is {anatomy.frame!r}: x and y "
            "have opposite signs; export both in one coordinate system"
        )
    message = (
        f"the landmarks are in {frame}, the anatomy's frame is {anatomy.frame!r}; they are taken to be one: state "
        "anatomy.frame"
    )
    return (Finding(files.rig.name, "frame-not-stated", message),)


def _stops(drive: Drive) -> tuple[float, ...]:
    """The moments of the keyframes."""
    return tuple(key.at for key in drive.keyframes) if isinstance(drive, Keyed) else ()


def _require_bones(anatomy: Anatomy, driver: _OnBones, files: NamedFiles) -> None:
    try:
        require_bones(anatomy, driver.joints)
    except RigError as error:
        raise files.named("drive.joints", error) from None


def _driven(rig: Rig, anatomy: Anatomy, *, driver: _Driver, files: NamedFiles) -> tuple[Handles, HandlePath]:
    """The handles and their path, checked."""
    path: HandlePath
    try:
        match driver:
            case _Pairs(handles=handles, target=target, keyframes=keyframes):
                path = path_by_pairs(handles, target, kind=rig.deformer.path, keyframes=keyframes)
            case _OnSkeleton(handles=handles, path=path):
                pass
            case _OnBones(motions=motions, joints=joints, landmarks=landmarks, per_bone=per_bone):
                handles = landmarks or bone_landmarks(anatomy, joints.bones(), per_bone=per_bone)
                path = path_by_joints(handles, motions, kind=rig.deformer.path)
        check_handles(handles, path, anatomy=anatomy, stops=_stops(rig.drive))
    except LandmarkError as error:
        raise files.named("drive", error) from None
    return handles, path
