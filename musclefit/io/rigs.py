"""Rig files: takes the path of a rig, reads every file it names, gives the `Job` that a run needs."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from hashlib import sha256
from pathlib import Path
from typing import Any

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy
from musclefit.errors import InputError, LandmarkError, RigError
from musclefit.io.anatomy import read_anatomy
from musclefit.io.drives import (
    Driver,
    OnBones,
    OnFits,
    OnSkeleton,
    OnTransforms,
    Pairs,
    on_anatomy,
    read_driver,
)
from musclefit.io.formats.points import outside_findings, read_points
from musclefit.io.formats.tables import parse_toml
from musclefit.io.named_files import NamedFiles
from musclefit.io.rig_names import builtin_rig_path, builtin_rigs, find_rig
from musclefit.progress import Progress, Silent
from musclefit.rig.chain import ChainMotions, chain_findings
from musclefit.rig.handles import Handles
from musclefit.rig.handles import Path as HandlePath
from musclefit.rig.job import (
    FurtherPoints,
    Job,
    check_handles,
    joint_findings,
    path_by_joints,
    path_by_pairs,
    require_bones,
)
from musclefit.rig.rig_table import apply_overrides, parse_rig
from musclefit.rig.settings import (
    CageDrive,
    Drive,
    JointDrive,
    Keyed,
    LandmarkDrive,
    LatticeDrive,
    Rig,
    SkeletonDrive,
    TransformDrive,
)
from musclefit.rig.spread import bone_landmarks
from musclefit.rig.table_reader import suggestion
from musclefit.rig.transforms import still_findings

__all__ = ["builtin_rig_path", "builtin_rigs", "find_rig", "read_rig"]

_SILENT = Silent()


def read_rig(
    path: str | Path | Mapping[str, Any],
    *,
    overrides: Sequence[str] = (),
    points: Sequence[Path] = (),
    progress: Progress = _SILENT,
) -> Job:
    """Read a rig file and every file it names.

    Cheap things are read and checked first: the rig, the joints and the pose, the landmarks; then the anatomy.

    Parameters
    ----------
    path : path of a TOML file, or mapping
        See `find_rig` for rigs by name; or what such a file would hold, with paths that start at the current folder.
        Relative paths in a file start at its folder, those of ``overrides`` too; ``${MUSCLEFIT_DATA}`` stands for that
        environment variable, or where it is not set for ``../../shared/data`` from the rig's folder.
    overrides : sequence of str
        ``key=value`` each; see `musclefit.rig.rig_table.apply_overrides`.
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
    rig_path = Path("rig") if isinstance(path, Mapping) else Path(path)
    files = NamedFiles(rig_path)
    if isinstance(path, Mapping):
        table = _plain_table(path)
        files.keep(rig_path, sha256(json.dumps(table, sort_keys=True).encode()).hexdigest())
    else:
        table = parse_toml(files.read(rig_path, key=""), source=str(rig_path))
    if overrides:
        table = apply_overrides(table, overrides, source=str(rig_path))
    rig = _resolved(parse_rig(table, source=str(rig_path)), files)
    further = _read_further(rig, points, files)
    driver = read_driver(rig, files)
    anatomy, findings = _read_anatomy(rig, files, progress=progress)
    driver = on_anatomy(driver, rig, anatomy, files)
    findings += _bone_findings(anatomy, driver, files)
    findings += (*driver.findings, *_frame_findings(anatomy, driver, files))
    findings += outside_findings(further, anatomy)
    handles, handle_path = _driven(rig, anatomy, driver=driver, files=files)
    return Job(
        rig=rig,
        anatomy=anatomy,
        findings=findings,
        handles=handles,
        path=handle_path,
        motions=None if isinstance(driver, Pairs | OnSkeleton) else driver.motions,
        hashes=files.hashes,
        name=rig_path.stem,
        source=str(rig_path),
        joints=driver.joints if isinstance(driver, OnBones) else None,
        lattice=driver.lattice if isinstance(driver, Pairs) else None,
        overrides=tuple(overrides),
        further=further,
        stops=_stops(rig.drive),
        transforms=driver.transforms if isinstance(driver, OnTransforms) else None,
    )


def _plain_table(rig: Mapping[str, Any]) -> dict[str, Any]:
    """What a rig file would hold: paths as text, mappings as tables, sequences as lists."""

    def plain(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {str(key): plain(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [plain(item) for item in value]
        return str(value) if isinstance(value, Path | StrEnum) else value

    table: dict[str, Any] = plain(rig)
    try:
        json.dumps(table)
    except TypeError as error:
        raise RigError(f"rig: {error}; give text, numbers, booleans, lists and mappings") from None
    return table


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
        case TransformDrive():
            transforms = files.find(drive.transforms, key="drive.transforms")
            landmarks = files.find(drive.landmarks, key="drive.landmarks") if drive.landmarks else ""
            return replace(drive, transforms=transforms, landmarks=landmarks)
        case LatticeDrive():
            return replace(drive, displacements=files.find(drive.displacements, key="drive.displacements"))
        case LandmarkDrive() | CageDrive() | SkeletonDrive():
            source = files.find(drive.source, key="drive.source")
            target = files.find(drive.target, key="drive.target") if drive.target else ""
            keyframes = tuple(replace(k, file=files.find(k.file, key="drive.keyframes")) for k in drive.keyframes)
            return replace(drive, source=source, target=target, keyframes=keyframes)


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


def _frame_findings(anatomy: Anatomy, driver: Driver, files: NamedFiles) -> tuple[Finding, ...]:
    """Raise LandmarkError where drive and anatomy state different frames; a finding where only one states its."""
    frame, what = driver.frame, "transforms" if isinstance(driver, OnTransforms) else "landmarks"
    stated = set(re.findall(r"\b(?:LPS|RAS)\b", anatomy.frame))
    if not frame or stated == {frame}:
        return ()
    if stated:
        raise LandmarkError(
            f"{files.rig}: drive: the {what} are in {frame}, but the anatomy's frame is {anatomy.frame!r}: x and y "
            "have opposite signs; export both in one coordinate system"
        )
    message = (
        f"the {what} are in {frame}, the anatomy's frame is {anatomy.frame!r}; they are taken to be one: state "
        "anatomy.frame"
    )
    return (Finding(files.rig.name, "frame-not-stated", message),)


def _stops(drive: Drive) -> tuple[float, ...]:
    """The moments of the keyframes."""
    return tuple(key.at for key in drive.keyframes) if isinstance(drive, Keyed) else ()


def _bone_findings(anatomy: Anatomy, driver: Driver, files: NamedFiles) -> tuple[Finding, ...]:
    """Which bones the drive leaves to the soft tissue; raise InputError where it moves one that is not there."""
    subject = files.rig.name
    match driver:
        case OnBones(joints=joints):
            try:
                require_bones(anatomy, joints)
            except RigError as error:
                raise files.named("drive.joints", error) from None
            return joint_findings(anatomy, joints, subject=subject)
        case OnTransforms(motions=motions) | OnFits(motions=motions):
            said, code = "have no transform", "bone-without-transform"
            if isinstance(driver, OnFits):
                said, code = "own no landmark", "bone-without-landmarks"
            found = still_findings(anatomy, tuple(motions.final), subject=subject, said=said, code=code)
            if isinstance(motions, ChainMotions):
                found += chain_findings(motions, subject=subject)
            return found
        case Pairs() | OnSkeleton():
            return ()


def _driven(rig: Rig, anatomy: Anatomy, *, driver: Driver, files: NamedFiles) -> tuple[Handles, HandlePath]:
    """The handles and their path, checked."""
    path: HandlePath
    try:
        match driver:
            case Pairs(handles=handles, target=target, keyframes=keyframes):
                path = path_by_pairs(handles, target, kind=rig.deformer.path, keyframes=keyframes)
            case OnSkeleton(handles=handles, path=path) | OnFits(handles=handles, path=path):
                pass
            case OnBones(motions=motions, joints=joints, landmarks=landmarks, per_bone=per_bone):
                handles = landmarks or bone_landmarks(anatomy, joints.bones(), per_bone=per_bone)
                path = path_by_joints(handles, motions, kind=rig.deformer.path)
            case OnTransforms(motions=motions, transforms=transforms, landmarks=landmarks, per_bone=per_bone):
                handles = landmarks or bone_landmarks(anatomy, transforms.bones(), per_bone=per_bone)
                path = path_by_joints(handles, motions, kind=rig.deformer.path, by="transform")
        check_handles(handles, path, anatomy=anatomy, stops=_stops(rig.drive))
    except LandmarkError as error:
        raise files.named("drive", error) from None
    return handles, path
