"""Rig files: takes the path of a rig, reads every file it names, gives the `Job` that a run needs."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path

import musclefit
from musclefit.anatomy.builtin import BUILTIN
from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy
from musclefit.errors import InputError, LandmarkError, MeshError, RigError
from musclefit.geometry.arrays import Points
from musclefit.geometry.meshes import TriMesh
from musclefit.io.landmarks import LandmarkTable, paired, read_landmarks
from musclefit.io.surfaces import read_anatomy, read_surface
from musclefit.io.tables import parse_table, parse_toml
from musclefit.progress import Progress, Silent
from musclefit.rig.handles import Handles
from musclefit.rig.handles import Path as HandlePath
from musclefit.rig.job import (
    Job,
    cage_handles,
    check_handles,
    joint_findings,
    path_by_joints,
    path_by_pairs,
    require_bones,
)
from musclefit.rig.joints import JointMotions, parse_joints
from musclefit.rig.model import CageDrive, Drive, JointDrive, LandmarkDrive, Rig, Unit
from musclefit.rig.section import suggestion
from musclefit.rig.spread import bone_landmarks
from musclefit.rig.table import apply_overrides, parse_rig

DATA_VARIABLE = "MUSCLEFIT_DATA"
"""The environment variable that `${MUSCLEFIT_DATA}` in a rig file stands for."""

DATA_DEFAULT = "../../shared/data"
"""Where the data folder is looked for when the variable is not set, from the rig's folder."""

_SILENT = Silent()
_PLACEHOLDER = "${" + DATA_VARIABLE + "}"


def read_rig(path: str | Path, *, overrides: Sequence[str] = (), progress: Progress = _SILENT) -> Job:
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
    where = _Where(rig_path)
    table = parse_toml(where.read(rig_path, key=""), source=str(rig_path))
    if overrides:
        table = apply_overrides(table, overrides, source=str(rig_path))
    rig = _resolved(parse_rig(table, source=str(rig_path)), where)
    driver = _read_driver(rig, where)
    anatomy, findings = _read_anatomy(rig, where, progress=progress)
    motions = None
    if isinstance(driver, _OnBones):
        motions = driver.motions
        _require_bones(anatomy, driver, where)
        findings += joint_findings(anatomy, motions.joints, subject=rig_path.name)
    else:
        findings += driver.findings
    handles, handle_path = _driven(rig, anatomy, driver=driver, where=where)
    return Job(
        rig=rig,
        anatomy=anatomy,
        findings=findings,
        handles=handles,
        path=handle_path,
        motions=motions,
        hashes=where.hashes,
        name=rig_path.stem,
        source=str(rig_path),
        joints=motions.joints if motions else None,
        overrides=tuple(overrides),
    )


def builtin_rigs() -> tuple[str, ...]:
    """The names of the rigs that come with musclefit, sorted."""
    return tuple(sorted(path.stem for path in _rigs_folder().glob("*.toml")))


def builtin_rig_path(name: str) -> Path:
    """The file of a rig that comes with musclefit.

    Raises
    ------
    RigError
        No rig of that name; the message lists those that exist.
    """
    if name not in builtin_rigs():
        raise RigError(f"no rig is named {name!r}; {suggestion(name, builtin_rigs())}")
    return _rigs_folder() / f"{name}.toml"


def _rigs_folder() -> Path:
    """The folder of the built-in rigs: inside the installed package, or beside it in a checkout."""
    package = Path(musclefit.__file__).resolve().parent
    packed = package / "rigs"
    return packed if packed.is_dir() else package.parent / "rigs"


def find_rig(name_or_path: str | Path) -> Path:
    """The rig file that a user means: a path (with a folder or the suffix .toml), or the name of a built-in rig.

    Raises
    ------
    RigError
        No such file, or no such name; the message lists the rigs that exist.
    """
    path = Path(name_or_path)
    if isinstance(name_or_path, str) and path.suffix != ".toml" and path.name == name_or_path:
        return builtin_rig_path(name_or_path)
    if not path.is_file():
        built_in = ", ".join(builtin_rigs())
        raise RigError(f"{path}: no such rig file; give a path, or the name of a built-in rig: {built_in}")
    return path


def resolve_data(text: str, *, folder: Path, source: str, key: str) -> Path:
    """The absolute path that a rig file means by ``text``.

    Parameters
    ----------
    text : str
        As written; relative paths start at ``folder``. ``${MUSCLEFIT_DATA}`` at its start stands for the environment
        variable of that name, or ``../../shared/data`` from ``folder``; nothing else is expanded.
    folder : Path
        The rig's.
    source, key : str
        The rig file and the dotted key, for messages.

    Raises
    ------
    RigError
        Nothing is there (a last part with one of ``*?[`` is a pattern, and left to who reads it), or the text holds another variable.
    """
    expanded = text
    hint = "correct the path; relative ones start at the rig's folder"
    if text.startswith(_PLACEHOLDER):
        value = os.environ.get(DATA_VARIABLE, "")
        data = Path(value).absolute() if value else folder.absolute() / DATA_DEFAULT
        said = "is set to" if value else "is not set, so the data folder is looked for in"
        if not data.is_dir():
            raise RigError(
                f"{source}: {key}: no data folder: the environment variable {DATA_VARIABLE} {said} "
                f"{os.path.normpath(data)}, which is no folder; set {DATA_VARIABLE} to the folder of the data"
            )
        hint = f"{DATA_VARIABLE} {said} {os.path.normpath(data)}"
        expanded = str(data) + text.removeprefix(_PLACEHOLDER)
    if "${" in expanded:
        raise RigError(
            f"{source}: {key}: found {text!r}; only {_PLACEHOLDER} at the start of a path is expanded, "
            "write the rest out"
        )
    resolved = Path(os.path.normpath(folder.absolute() / expanded))
    if not resolved.exists() and not set("*?[") & set(resolved.name):
        raise RigError(f"{source}: {key}: {resolved} does not exist (written as {text!r}; {hint})")
    return resolved


@dataclass(slots=True)
class _Where:
    """The rig file while it is read: resolves what it names, and keeps each file's hash under its written name."""

    rig: Path
    hashes: dict[str, str] = field(default_factory=dict)
    written: dict[str, str] = field(default_factory=dict)

    def find(self, text: str, *, key: str) -> str:
        """The absolute path of what is written under ``key``."""
        found = str(resolve_data(text, folder=self.rig.parent, source=str(self.rig), key=key))
        self.written[found] = text
        return found

    def read(self, path: Path, *, key: str) -> bytes:
        """The bytes of a file; its hash is kept."""
        place = f"{self.rig}: {key}" if key else str(self.rig)
        try:
            data = path.read_bytes()
        except OSError as error:
            raise RigError(f"{place}: {path} cannot be read: {error.strerror or error}") from None
        self.keep(path, sha256(data).hexdigest())
        return data

    def keep(self, path: Path, digest: str) -> None:
        """Keep the hash of a file that was read."""
        self.hashes[self.written.get(str(path), path.name)] = digest

    def named(self, key: str, error: InputError) -> InputError:
        """The same error with the rig file and the key in front."""
        return type(error)(f"{self.rig}: {key}: {error}")


def _resolved(rig: Rig, where: _Where) -> Rig:
    """The rig with absolute paths; what they name is there."""
    anatomy = rig.anatomy
    if anatomy.folder:
        anatomy = replace(anatomy, folder=where.find(anatomy.folder, key="anatomy.folder"))
    files = tuple(where.find(file, key="anatomy.files") for file in anatomy.files)
    return replace(rig, anatomy=replace(anatomy, files=files), drive=_resolved_drive(rig.drive, where))


def _resolved_drive(drive: Drive, where: _Where) -> Drive:
    match drive:
        case JointDrive():
            joints = where.find(drive.joints, key="drive.joints")
            landmarks = where.find(drive.landmarks, key="drive.landmarks") if drive.landmarks else ""
            return replace(drive, joints=joints, landmarks=landmarks)
        case LandmarkDrive() | CageDrive():
            source = where.find(drive.source, key="drive.source")
            target = where.find(drive.target, key="drive.target") if drive.target else ""
            return replace(drive, source=source, target=target)


@dataclass(frozen=True, eq=False, slots=True)
class _Pairs:
    """A drive of pairs: handles and where they go, (m, 3) mm."""

    handles: Handles
    target: Points
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class _OnBones:
    """A drive of joints: landmarks from a file, or None to spread ``per_bone`` over each bone."""

    motions: JointMotions
    landmarks: Handles | None
    per_bone: int


def _read_driver(rig: Rig, where: _Where) -> _Pairs | _OnBones:
    match rig.drive:
        case LandmarkDrive():
            return _read_landmark_pairs(rig.drive, where)
        case CageDrive():
            return _read_cages(rig.drive, where)
        case JointDrive():
            return _read_joint_drive(rig.drive, where)


def _read_joint_drive(drive: JointDrive, where: _Where) -> _OnBones:
    data = where.read(Path(drive.joints), key="drive.joints")
    joints = parse_joints(parse_table(data, source=drive.joints), source=drive.joints)
    try:
        motions = joints.along(dict(drive.pose))
    except RigError as error:
        raise where.named("drive.pose", error) from None
    landmarks = _read_bone_landmarks(drive, where) if drive.landmarks else None
    return _OnBones(motions, landmarks, drive.landmarks_per_bone)


def _read_landmark_pairs(drive: LandmarkDrive, where: _Where) -> _Pairs:
    table = _landmarks(drive.source, where, key="drive.source", units=drive.units)
    if drive.target:
        table = paired(table, _landmarks(drive.target, where, key="drive.target", units=drive.units))
    if table.targets is None:
        raise LandmarkError(
            f"{where.rig}: drive.source: {drive.source} has no target columns; add them, or name a second file in "
            "drive.target"
        )
    return _Pairs(_handles(table), table.targets)


def _read_bone_landmarks(drive: JointDrive, where: _Where) -> Handles:
    table = _landmarks(drive.landmarks, where, key="drive.landmarks", units=drive.units)
    if table.targets is not None:
        raise LandmarkError(
            f"{where.rig}: drive.landmarks: {drive.landmarks} has target columns, but the joints say where landmarks "
            'go; remove the columns, or use a drive of kind "landmarks"'
        )
    return _handles(table)


def _read_cages(drive: CageDrive, where: _Where) -> _Pairs:
    source, source_findings = _cage(drive.source, where, key="drive.source", units=drive.units)
    target, target_findings = _cage(drive.target, where, key="drive.target", units=drive.units)
    try:
        return _Pairs(*cage_handles(source, target), (*source_findings, *target_findings))
    except MeshError as error:
        raise where.named("drive.target", error) from None


def _landmarks(path: str, where: _Where, *, key: str, units: Unit) -> LandmarkTable:
    where.read(Path(path), key=key)
    try:
        return read_landmarks(Path(path), units=units)
    except InputError as error:
        raise where.named(key, error) from None


def _handles(table: LandmarkTable) -> Handles:
    return Handles(table.names, table.positions, table.bones)


def _cage(path: str, where: _Where, *, key: str, units: Unit) -> tuple[TriMesh, tuple[Finding, ...]]:
    try:
        raw = read_surface(Path(path), units=units)
        if raw.path.suffix.lower() == ".stl":
            raise MeshError(f"{path}: in STL every triangle has its own vertices; give the cage as PLY or OBJ")
        where.keep(raw.path, raw.sha256)
        return TriMesh(raw.vertices, raw.faces), raw.findings
    except InputError as error:
        raise where.named(key, error) from None


def _read_anatomy(rig: Rig, where: _Where, *, progress: Progress) -> tuple[Anatomy, tuple[Finding, ...]]:
    source = rig.anatomy
    if source.builtin:
        if source.builtin not in BUILTIN:
            raise RigError(
                f"{where.rig}: anatomy.builtin: found {source.builtin!r}; {suggestion(source.builtin, BUILTIN)}"
            )
        return BUILTIN[source.builtin](), ()
    place: Path | tuple[Path, ...] = Path(source.folder) if source.folder else tuple(Path(f) for f in source.files)
    try:
        read = read_anatomy(place, units=source.units, kinds=source.kinds, frame=source.frame, progress=progress)
    except InputError as error:
        raise where.named("anatomy", error) from None
    where.hashes.update(read.hashes)
    return read.anatomy, read.findings


def _require_bones(anatomy: Anatomy, driver: _OnBones, where: _Where) -> None:
    try:
        require_bones(anatomy, driver.motions.joints)
    except RigError as error:
        raise where.named("drive.joints", error) from None


def _driven(rig: Rig, anatomy: Anatomy, *, driver: _Pairs | _OnBones, where: _Where) -> tuple[Handles, HandlePath]:
    """The handles and their path, checked."""
    path: HandlePath
    try:
        match driver:
            case _Pairs(handles, target, _):
                path = path_by_pairs(handles, target)
            case _OnBones(motions, landmarks, per_bone):
                handles = landmarks or bone_landmarks(anatomy, motions.joints.bones(), per_bone=per_bone)
                path = path_by_joints(handles, motions, kind=rig.deformer.path)
        check_handles(handles, path, anatomy)
    except LandmarkError as error:
        raise where.named("drive", error) from None
    return handles, path
