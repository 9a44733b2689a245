"""Files of dirty surfaces -> raw tissues, and a repair -> a folder or a file, whole or not at all."""

from __future__ import annotations

import json
import os
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from glob import escape
from pathlib import Path

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import TissueKind
from musclefit.anatomy.repair.records import Way
from musclefit.errors import InputError, MeshError
from musclefit.geometry.arrays import Faces, Points, Tets
from musclefit.io.anatomy import is_repair_report, kind_of, read_surface, surface_files
from musclefit.io.folder_locks import held
from musclefit.io.run_folder import Maker, check_writable, claimed, file_names, ply_bytes, write_surfaces
from musclefit.meshing.ftetwild import fill
from musclefit.pipeline.repair import RawTissue, RepairResult
from musclefit.progress import Progress
from musclefit.report.repairs import repair_json
from musclefit.vocabulary import Unit


@dataclass(frozen=True, eq=False, slots=True)
class RawFiles:
    """Raw tissues, where each stands below the folder (its ending taken off), hashes, findings and what was given."""

    tissues: tuple[RawTissue, ...]
    places: dict[str, Path]
    hashes: dict[str, str]
    findings: tuple[Finding, ...]
    source: Path
    units: Unit


def read_raw(
    source: Path, *, units: Unit, kinds: Sequence[tuple[str, TissueKind]] = (), progress: Progress
) -> RawFiles:
    """Read a surface file, or all of a folder and its subfolders of kinds, as they stand.

    Raises
    ------
    InputError
        Nothing is there, nothing is a surface, or two files have one name.
    MeshError
        A file is damaged, or a face uses a vertex that is not there.
    """
    named, findings = surface_files(source)
    tissues, places, hashes = [], {}, {}
    with progress.stage("read") as tick:
        for done, (name, path) in enumerate(named.items(), start=1):
            raw = read_surface(path, units=units)
            kind, notes = kind_of(name, path, kinds)
            try:
                tissues.append(RawTissue(name, kind, raw.mesh(), str(path)))
            except MeshError as error:
                raise MeshError(f"{path}: {error}; export the surface again") from None
            places[name] = path.relative_to(source) if source.is_dir() else Path(path.name)
            hashes[places[name].as_posix()] = raw.sha256
            findings = (*findings, *raw.findings, *(notes if source.is_dir() else ()))
            tick(done / len(named))
    return RawFiles(tuple(tissues), places, hashes, findings, source, units)


def tetrahedra(
    vertices: Points, faces: Faces, edge_length_fraction: float, envelope_fraction: float, /
) -> tuple[Points, Tets]:
    """Tetrahedra by fTetWild in a process of its own; see `musclefit.meshing.ftetwild.fill`."""
    return fill(vertices, faces, edge_length_fraction=edge_length_fraction, envelope_fraction=envelope_fraction)


def check_target(source: Path, target: Path) -> None:
    """Refuse, before long work, a target that a repair could not be written to.

    Raises
    ------
    InputError
        It is the source, holds it, or holds something that no repair wrote.
    """
    real, given = Path(os.path.realpath(target)), Path(os.path.realpath(source))
    if real == given or given.is_relative_to(real) or (source.is_dir() and real.is_relative_to(given)):
        raise InputError(f"{target} is, holds or lies in what is to be repaired ({source}); name another place")
    if not _is_one_file(source, target):
        check_writable(target, by=Maker.REPAIR)
        return
    if target.is_dir():
        raise InputError(f"{target} is a folder; name a file that does not exist yet")
    if target.exists() and not is_repair_report(_report_path(target)):
        raise InputError(f"{target} is there already, and no repair wrote it; name another file")


@contextmanager
def claimed_target(source: Path, target: Path | None) -> Iterator[None]:
    """Hold the folder or the file that a repair writes to; see `musclefit.io.run_folder.claimed`."""
    if target is None or not _is_one_file(source, target):
        with claimed(target, by=Maker.REPAIR):
            yield
        return
    with held(target):
        for path in (target, _report_path(target)):
            for partial in path.parent.glob(f".{escape(path.name)}.partial-*"):
                partial.unlink(missing_ok=True)
        yield


def write_repair(target: Path, result: RepairResult, *, files: RawFiles) -> tuple[Path, ...]:
    """Write the surfaces as PLY in double precision and the report as JSON, whole or not at all.

    A surface in a PLY file in mm that was left as it is is written as the very bytes that were read.

    Parameters
    ----------
    target : Path
        A folder; or, for one file, a file that ends in .ply, with the report beside it.
    """
    check_target(files.source, target)
    report = repair_json(result.report)
    data = {_place(files, name): _bytes(result, files, name) for name in files.places}
    if not _is_one_file(files.source, target):
        return write_surfaces(target, data, report=report, by=Maker.REPAIR)
    written = {target: next(iter(data.values())), _report_path(target): _text(report)}
    partial = {path: path.with_name(f".{path.name}.partial-{uuid.uuid4().hex}") for path in written}
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        for path, content in written.items():
            partial[path].write_bytes(content)
        for path in written:
            partial[path].replace(path)
    finally:
        for path in partial.values():
            path.unlink(missing_ok=True)
    return tuple(written)


def _is_one_file(source: Path, target: Path) -> bool:
    return source.is_file() and target.suffix.lower() == ".ply"


def _report_path(target: Path) -> Path:
    return target.with_name(f"{target.stem}.repair.json")


def _place(files: RawFiles, name: str) -> str:
    safe = file_names([name])[name]
    return (files.places[name].parent / f"{safe}.ply").as_posix()


def _bytes(result: RepairResult, files: RawFiles, name: str) -> bytes:
    surface = result.anatomy[name].surface
    repaired = next(one for one in result.report.surfaces if one.name == name)
    given = files.source / files.places[name] if files.source.is_dir() else files.source
    same = repaired.way is Way.UNTOUCHED and surface is repaired.mesh
    if same and given.suffix.lower() == ".ply" and files.units is Unit.MILLIMETRE:
        return given.read_bytes()
    return ply_bytes(surface)


def _text(report: object) -> bytes:
    return (json.dumps(report, indent=2, allow_nan=False, ensure_ascii=False) + "\n").encode(
        "utf-8", "backslashreplace"
    )
