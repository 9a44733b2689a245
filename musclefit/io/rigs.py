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
from musclefit.geometry.images.grids import stated_frame
from musclefit.io.anatomy import read_anatomy
from musclefit.io.formats.points import in_anatomy_frame, outside_findings, points_frame, read_points
from musclefit.io.formats.tables import parse_toml
from musclefit.io.named_files import NamedFiles
from musclefit.io.rig_names import RigGiven, builtin_rig_path, builtin_rigs, find_rig
from musclefit.progress import Progress, Silent
from musclefit.rig.drive import Driver
from musclefit.rig.job import (
    AttachedPoints,
    Job,
    check_handles,
)
from musclefit.rig.off_bones import off_bone_findings
from musclefit.rig.rig_table import apply_overrides, parse_rig
from musclefit.rig.settings import (
    Rig,
)
from musclefit.rig.table_reader import suggestion

__all__ = ["builtin_rig_path", "builtin_rigs", "find_rig", "read_rig"]

_SILENT = Silent()


def read_rig(
    rig: RigGiven,
    *,
    overrides: Sequence[str] = (),
    points: Sequence[Path] = (),
    progress: Progress = _SILENT,
) -> Job:
    """Read a rig and every file it names.

    Cheap things are read and checked first: the rig, the joints and the pose, the landmarks; then the anatomy.

    Parameters
    ----------
    rig : name of a built-in rig, path of a TOML file, or mapping
        See `find_rig` for names and paths. A mapping holds what such a file would hold, with paths that start at the
        current folder. Relative paths in a file start at its folder, those of ``overrides`` too; ``${MUSCLEFIT_DATA}``
        stands for that environment variable or, where it is not set, for ``../../shared/data`` from the rig's folder.
    overrides : sequence of str
        ``key=value`` each; see `musclefit.rig.rig_table.apply_overrides`.
    points : sequence of path
        Files of attached points to deform too, in addition to the rig's own; relative paths start at the current
        folder.
    progress : Progress
        Receives the progress of reading the anatomy.

    Returns
    -------
    Job
        Checked: the handles stand apart, near the anatomy, and belong to bones that exist.

    Raises
    ------
    RigError
        No built-in rig has the name; or the file is missing or broken, says something that `parse_rig` or
        `parse_joints` refuse, or names a file that is not there: the message starts with the file and the key.
    LandmarkError, MeshError
        Landmarks, cages or surfaces that cannot be used.
    """
    rig_path = Path("rig") if isinstance(rig, Mapping) else find_rig(rig)
    files = NamedFiles(rig_path)
    if isinstance(rig, Mapping):
        table = _plain_table(rig)
        files.keep(rig_path, sha256(json.dumps(table, sort_keys=True).encode()).hexdigest())
    else:
        table = parse_toml(files.read(rig_path, key=""), source=str(rig_path))
    if overrides:
        table = apply_overrides(table, overrides, source=str(rig_path))
    parsed = _resolved(parse_rig(table, source=str(rig_path)), files)
    further = _read_further(parsed, points, files)
    driver = parsed.drive.read(files, path=parsed.deformer.path, rigid_bones=parsed.bones.rigid)
    anatomy, findings = _read_anatomy(parsed, files, progress=progress)
    driver = driver.on_anatomy(anatomy, files)
    findings += driver.bone_findings(anatomy, files)
    findings += (*driver.findings, *_frame_findings(anatomy, driver, files))
    findings += outside_findings(further, anatomy)
    parts = driver.parts()
    try:
        handles, handle_path = driver.handles_on_path(anatomy)
        check_handles(handles, handle_path, anatomy=anatomy, stops=parsed.drive.moments)
    except LandmarkError as error:
        raise files.named("drive", error) from None
    findings += off_bone_findings(handles, anatomy, subject=rig_path.name)
    return Job(
        rig=parsed,
        anatomy=anatomy,
        findings=findings,
        handles=handles,
        path=handle_path,
        motions=parts.motions,
        hashes=files.hashes,
        name=rig_path.stem,
        source=str(rig_path),
        joints=parts.joints,
        lattice=parts.lattice,
        overrides=tuple(overrides),
        further=further,
        stops=parsed.drive.moments,
        transforms=parts.transforms,
        pose=getattr(parsed.drive, "pose", ()),
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
    return replace(rig, anatomy=anatomy, drive=rig.drive.resolved(files))


def _read_further(rig: Rig, given: Sequence[Path], files: NamedFiles) -> tuple[AttachedPoints, ...]:
    """The attached points, read; the files' names must differ, since they are written side by side."""
    found: dict[str, AttachedPoints] = {}
    for path in (*(Path(written) for written in rig.anatomy.points), *given):
        try:
            files.read(path, key="anatomy.points")
            read = in_anatomy_frame(
                read_points(path, units=rig.anatomy.units),
                own=points_frame(path, units=rig.anatomy.units),
                anatomy=stated_frame(rig.anatomy.frame),
            )
            if read.name in found:
                raise InputError(f"{path}: two files of points are named {read.name!r}; rename one")
        except InputError as error:
            raise files.named("anatomy.points", error) from None
        found[read.name] = read
    return tuple(found.values())


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
    frame, what = driver.frame, driver.of
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
