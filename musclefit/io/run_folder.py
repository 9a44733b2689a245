"""Writes the folder of a run or an inspection, whole or not at all; decides nothing about what is in it."""

from __future__ import annotations

import json
import os
import re
import shutil
import unicodedata
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError
from musclefit.figures.colours import tissue_colours
from musclefit.geometry.arrays import Points
from musclefit.geometry.images.grids import Frame, stated_frame
from musclefit.geometry.measures import signed_volumes
from musclefit.geometry.meshes import TriMesh
from musclefit.io.folder_locks import held
from musclefit.io.formats.mrml import SceneModel, scene_text
from musclefit.report.html import render_html, render_inspection
from musclefit.report.junit import junit_xml
from musclefit.report.methods import methods_of, methods_text
from musclefit.report.model import MeshReport, Report
from musclefit.report.scene import Scene
from musclefit.report.schema import Json, to_json

if TYPE_CHECKING:
    from musclefit.anatomy.tetrahedra import TetAnatomy
    from musclefit.pipeline.intermediate_states import State

REPORT_JSON, REPORT_HTML, SCENE = "report.json", "report.html", "scene.mrml"
REPORT_JUNIT, METHODS = "report.junit.xml", "methods.md"
SURFACES, PICTURES, TETS, POINTS, INTERMEDIATE = "surfaces", "pictures", "tets.vtu", "points", "intermediate"

_NO_POINTS: Mapping[str, Callable[[Path], None]] = MappingProxyType({})
_NAME_BYTES = 100
"""Longest file name made of a tissue's, without its ending; file systems end at 255 bytes."""
_SKIN_OPACITY = 0.35
_SOLID = 3
"""Dimension of a tissue made of tetrahedra."""
_RESERVED = {"CON", "PRN", "AUX", "NUL", *(f"{port}{k}" for port in ("COM", "LPT") for k in range(1, 10))}


@dataclass(frozen=True, eq=False, slots=True)
class DeformedTets:
    """Labelled tetrahedra at rest, and where their vertices (n, 3) went, mm."""

    rest: TetAnatomy
    vertices: Points


class Maker(StrEnum):
    """The command that a folder is of."""

    RUN = "run"
    CHECK = "check"
    REPAIR = "repair"
    ARCHITECTURE = "architecture"


_TOLD_BY = {"overlaps_resolved": Maker.REPAIR, "without_fibres": Maker.ARCHITECTURE, "baseline": Maker.RUN}
"""A key that only the reports of one command have."""


@contextmanager
def claimed(folder: Path | None, *, by: Maker) -> Iterator[None]:
    """Hold a folder for a command until the block ends; what a killed one left beside it is cleared away first.

    Parameters
    ----------
    folder : Path or None
        None where nothing will be written.
    by : Maker

    Raises
    ------
    InputError
        As `check_writable`; or another process writes into it.
    """
    if folder is None:
        yield
        return
    check_writable(folder, by=by)
    with held(folder):
        with suppress(OSError):  # what cannot be cleared away is in nobody's way
            _clear_left_over(_resolved(folder))
        check_writable(folder, by=by)
        yield


def check_writable(folder: Path, *, by: Maker) -> None:
    """Refuse, before long work, a folder that a command could not write to.

    A folder is taken when it does not exist, is empty, or holds a former result of the same command, which will be
    replaced; files in it that the former one did not write are kept.

    Raises
    ------
    InputError
        Something else is there, or nothing can be created beside it.
    """
    try:
        _require_free(_resolved(folder), folder, by=by)
    except OSError as error:
        raise InputError(
            f"the output folder {folder} cannot be written ({error.strerror}: {error.filename}); name another"
        ) from error


def _require_free(target: Path, folder: Path, *, by: Maker) -> None:
    """``check_writable`` for the folder that ``folder`` stands for; what the system refuses is an OSError."""
    if target.exists():
        if not target.is_dir():
            raise InputError(f"the output folder {folder} is a file; name a folder that does not exist yet")
        if os.path.ismount(target) or Path.cwd().is_relative_to(target):
            which = "a mount point" if os.path.ismount(target) else "the current folder, or holds it"
            raise InputError(
                f"the output folder {folder} is {which} and cannot be replaced whole; name a folder inside it"
            )
        if any(target.iterdir()):
            made_by = _maker(_former_report(target, folder))
            if made_by is not by:
                raise InputError(
                    f"the output folder {folder} holds the results of musclefit {made_by}, which {by} does not "
                    "replace; name another folder"
                )
    trial = _existing_parent(target) / f".{target.name}.trial-{uuid.uuid4().hex}"
    trial.mkdir()
    trial.rmdir()


def write_run(
    folder: Path,
    report: Report,
    *,
    rest: Anatomy,
    deformed: Anatomy,
    tets: DeformedTets | None,
    pictures: Mapping[str, bytes],
    pictures_problem: str = "",
    scene: Scene | None = None,
    points: Mapping[str, Callable[[Path], None]] = _NO_POINTS,
    states: Iterable[State] = (),
) -> tuple[Path, ...]:
    """Write one run: report, page, deformed surfaces, tetrahedra, pictures, attached points.

    Everything is made in a folder beside the target, which then takes its place; a failure leaves what was there.

    Parameters
    ----------
    folder : Path
    report : Report
    rest, deformed : Anatomy
        The same tissues before and after.
    tets : DeformedTets or None
        None where no tetrahedra were made.
    pictures : mapping of caption to PNG bytes
    pictures_problem : str
        Why there are no pictures.
    scene : Scene or None
        What the page shows in 3-D.
    points : mapping of file name to callable
        Further files, each written to the path that it is given.
    states : iterable of State
        Intermediate states, whose surfaces are written one folder each.

    Returns
    -------
    tuple of Path
        Every file written, the report first.

    Raises
    ------
    InputError
        The folder holds something else than a former run.
    """
    names = file_names([tissue.name for tissue in deformed])
    surfaces = [
        {"name": name, "ply": f"{SURFACES}/{safe}.ply", "vtp": f"{SURFACES}/{safe}.vtp"} for name, safe in names.items()
    ]
    captions = file_names([caption.split(":")[0] for caption in pictures], numbered=True)

    def fill(build: Path) -> None:
        (build / SURFACES).mkdir()
        for tissue, files in zip(deformed, surfaces, strict=True):
            (build / files["ply"]).write_bytes(ply_bytes(tissue.surface, space=stated_frame(deformed.frame)))
            save_whole(
                surface_with_displacements(rest[tissue.name], tissue, frame=deformed.frame), build / files["vtp"]
            )
        methods = methods_text(methods_of(report, pictures=bool(pictures)))
        (build / METHODS).write_text(methods, encoding="utf-8", errors="backslashreplace")
        (build / SCENE).write_text(_scene(deformed, surfaces), encoding="utf-8", errors="backslashreplace")
        if tets is not None:
            save_whole(labelled_tets(tets), build / TETS)
        if pictures:
            (build / PICTURES).mkdir()
        for safe, png in zip(captions.values(), pictures.values(), strict=True):
            (build / PICTURES / f"{safe}.png").write_bytes(png)
        if points:
            (build / POINTS).mkdir()
        for name, write in points.items():
            write(build / POINTS / name)
        _write_states(build / INTERMEDIATE, states, names=names)
        page = render_html(report, pictures=pictures, pictures_problem=pictures_problem, scene=scene)
        (build / REPORT_HTML).write_text(page, encoding="utf-8", errors="backslashreplace")

    return _write_folder(folder, fill, {**to_json(report), "surfaces": surfaces}, by=Maker.RUN)


def write_inspection(folder: Path, report: MeshReport) -> tuple[Path, ...]:
    """Write the report of an anatomy as it is, as JSON, JUnit XML and a page; whole or not at all, as ``write_run``."""

    def fill(build: Path) -> None:
        (build / REPORT_JUNIT).write_text(junit_xml(report), encoding="utf-8", errors="backslashreplace")
        page = render_inspection(report)
        (build / REPORT_HTML).write_text(page, encoding="utf-8", errors="backslashreplace")

    return _write_folder(folder, fill, to_json(report), by=Maker.CHECK)


def write_surfaces(folder: Path, surfaces: Mapping[str, bytes], *, report: Json, by: Maker) -> tuple[Path, ...]:
    """Write surface files, by their paths below the folder, and a report on them; whole or not at all."""

    def fill(build: Path) -> None:
        for name, data in surfaces.items():
            (build / name).parent.mkdir(parents=True, exist_ok=True)
            (build / name).write_bytes(data)

    return _write_folder(folder, fill, report, by=by)


def file_names(names: Sequence[str], *, numbered: bool = False) -> dict[str, str]:
    """A file name for each name, without ending: readable, inside its folder on every system, all different.

    Letters, digits, ``-``, ``_`` and ``.`` stay; every other run of characters becomes one ``_``. Names that then
    differ by case alone, or not at all, get a number.

    Parameters
    ----------
    names : sequence of str
        All different; or ``numbered``, which puts each one's number in front and keys the result by number and name.
    """
    taken: set[str] = set()
    safe: dict[str, str] = {}
    for position, name in enumerate(names, start=1):
        plain = f"{position:02d}-{_plain_name(name)}" if numbered else _plain_name(name)
        candidate, count = plain, 1
        while candidate.casefold() in taken:
            count += 1
            candidate = f"{plain}-{count}"
        taken.add(candidate.casefold())
        safe[f"{position} {name}" if numbered else name] = candidate
    return safe


def _scene(anatomy: Anatomy, surfaces: Sequence[Mapping[str, str]]) -> str:
    """A scene of the tissues for 3D Slicer, the skin translucent; in LPS where the anatomy states no frame."""
    colours = tissue_colours(anatomy)
    models = [
        SceneModel(t.name, files["vtp"], colours[t.name], _SKIN_OPACITY if t.kind is TissueKind.SKIN else 1.0)
        for t, files in zip(anatomy, surfaces, strict=True)
    ]
    return scene_text(models, frame=stated_frame(anatomy.frame) or Frame.LPS)


def ply_bytes(mesh: TriMesh, *, space: Frame | None = None) -> bytes:
    """Binary little-endian PLY with double positions, so that what is read back is what was written.

    ``space`` is the frame that 3D Slicer is told; without it, Slicer takes a file to be LPS.
    """
    comment = "" if space is None else f"comment SPACE={space.value.upper()}\n"
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment lengths in mm\n{comment}"
        f"element vertex {len(mesh.vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    return header.encode("ascii") + mesh.vertices.astype("<f8").tobytes() + faces.tobytes()


def surface_with_displacements(rest: Tissue, deformed: Tissue, *, frame: str) -> Any:
    r"""The deformed surface as PolyData, with ``displacement_mm`` and ``rest_position_mm`` at its points.

    ``name``, ``kind`` and ``frame`` are field data, and so is ``SPACE``, LPS or RAS, where the frame states it, because
    3D Slicer looks for that; VTK's text is ASCII, so anything else stands as ``\u8171``.
    """
    import pyvista as pv  # slow to import, and not needed to refuse a folder

    surface = pv.PolyData.from_regular_faces(np.array(deformed.surface.vertices), np.array(deformed.surface.faces))
    surface.point_data["displacement_mm"] = deformed.surface.vertices - rest.surface.vertices
    surface.point_data["rest_position_mm"] = np.array(rest.surface.vertices)
    for key, text in (("name", deformed.name), ("kind", deformed.kind.value), ("frame", frame)):
        surface.field_data[key] = [_escaped(text)]
    space = stated_frame(frame)
    if space is not None:
        surface.field_data["SPACE"] = [space.value.upper()]
    return surface


def labelled_tets(tets: DeformedTets) -> Any:
    """The deformed tetrahedra as UnstructuredGrid.

    Cells carry ``tissue`` (an index) and ``volume_ratio`` (deformed over rest; zero or below where inverted); points
    carry ``displacement_mm`` and ``rest_position_mm``. For each tissue a field array, named as its surface files are,
    holds its index and the dimension 3. So do Gmsh and meshio name numbers; text would keep meshio from reading the
    file, and VTK escapes no name.
    """
    import pyvista as pv

    mesh = tets.rest.mesh
    grid = pv.UnstructuredGrid({pv.CellType.TETRA: np.array(mesh.tets)}, np.array(tets.vertices))
    grid.cell_data["tissue"] = np.array(tets.rest.tissue_of_tet)
    grid.cell_data["volume_ratio"] = signed_volumes(tets.vertices, mesh.tets) / signed_volumes(mesh.vertices, mesh.tets)
    grid.point_data["displacement_mm"] = tets.vertices - mesh.vertices
    grid.point_data["rest_position_mm"] = np.array(mesh.vertices)
    for index, safe in enumerate(file_names(tets.rest.names).values()):
        grid.field_data[_escaped(safe)] = np.array([index, _SOLID], dtype=np.int64)
    return grid


def _write_states(folder: Path, states: Iterable[State], *, names: Mapping[str, str]) -> None:
    """A folder of surfaces for each state, numbered from 01, and a table of the share of the way at which each is."""
    lines = ["state,share_of_the_way"]
    for number, state in enumerate(states, start=1):
        place = folder / f"{number:02d}"
        place.mkdir(parents=True)
        for tissue in state.anatomy:
            (place / f"{names[tissue.name]}.ply").write_bytes(ply_bytes(tissue.surface))
        lines.append(f"{number:02d},{state.at!r}")
    if len(lines) > 1:
        (folder / "states.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def require_new_folder(folder: Path) -> None:
    """Raise InputError, before long work, unless a folder is new or empty: nothing there is replaced or mixed in."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: is not an empty folder, and new files would mix with those in it; choose another")


def write_new_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files into a folder that is new or empty, all of them or none.

    Parameters
    ----------
    folder : Path
    files : mapping of path below the folder, with /, to bytes
    """
    with _replacing(_resolved(folder)) as build:
        for name, data in files.items():
            (build / name).parent.mkdir(parents=True, exist_ok=True)
            (build / name).write_bytes(data)


def _write_folder(folder: Path, fill: Callable[[Path], None], report: Json, *, by: Maker) -> tuple[Path, ...]:
    """Fill a new folder, add the report that lists its files, and put it in place."""
    check_writable(folder, by=by)
    with _replacing(_resolved(folder)) as build:
        fill(build)
        others = sorted(path.relative_to(build).as_posix() for path in build.rglob("*") if path.is_file())
        files = [REPORT_JSON, *others]
        text = json.dumps({**report, "files": files}, indent=2, allow_nan=False, ensure_ascii=False)
        # a path that is not text is escaped, as JSON does
        (build / REPORT_JSON).write_text(text + "\n", encoding="utf-8", errors="backslashreplace")
    return tuple(folder / name for name in files)


@contextmanager
def _replacing(target: Path) -> Iterator[Path]:
    """A new folder beside the target that takes its place when all went well, and vanishes when not."""
    home = _existing_parent(target)
    build = home / f".{target.name}.partial-{uuid.uuid4().hex}"
    build.mkdir()
    try:
        yield build
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists():
            _swap(build, target)
        else:
            build.rename(target)
    except BaseException:
        shutil.rmtree(build, ignore_errors=True)
        raise


def _swap(build: Path, target: Path) -> None:
    """Put a new folder in the place of a former run, carrying over what that run did not write."""
    ours = _former_files(target, target) if any(target.iterdir()) else frozenset()
    former = target.with_name(f".{target.name}.former-{uuid.uuid4().hex}")
    target.rename(former)
    try:
        build.rename(target)
    except BaseException:
        former.rename(target)
        raise
    _carry_over(former, target, ours=ours)


def _carry_over(former: Path, target: Path, *, ours: frozenset[str]) -> None:
    """Move what a former run did not write into the new folder, and remove the rest of the former one."""
    for path in sorted(former.rglob("*")):
        name = path.relative_to(former)
        kept = target / name
        if path.is_dir() and not path.is_symlink():
            if not any(path.iterdir()) and not kept.exists():
                kept.mkdir(parents=True)
        elif name.as_posix() not in ours and not kept.exists():
            kept.parent.mkdir(parents=True, exist_ok=True)
            path.rename(kept)
    shutil.rmtree(former)


def _clear_left_over(target: Path) -> None:
    """Bring to its end what a killed process began: a former run put aside comes back, half-written folders go."""
    for home in dict.fromkeys((_existing_parent(target), target.parent)):
        for path in sorted(home.iterdir()) if home.is_dir() else ():
            kind = re.fullmatch(rf"\.{re.escape(target.name)}\.(partial|trial|former)-[0-9a-f]{{32}}", path.name)
            if kind is None or not path.is_dir():
                continue
            if kind[1] == "former" and not target.exists():
                path.rename(target)
            elif kind[1] == "former" and (path / REPORT_JSON).is_file():
                _carry_over(path, target, ours=_former_files(path, path))
            else:
                shutil.rmtree(path, ignore_errors=True)


def _maker(report: Mapping[str, Any]) -> Maker:
    """Which command wrote a report."""
    for key, maker in _TOLD_BY.items():
        if key in report:
            return maker
    return Maker.CHECK


def _former_report(target: Path, folder: Path) -> Mapping[str, Any]:
    """The report of a former run in a folder that is not empty."""
    try:
        former = json.loads((target / REPORT_JSON).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        former = None
    if not isinstance(former, dict) or "schema_version" not in former or not isinstance(former.get("files"), list):
        raise InputError(
            f"the output folder {folder} is not empty and holds no {REPORT_JSON} of a former run; name another "
            "folder, or empty this one"
        )
    return former


def _former_files(target: Path, folder: Path) -> frozenset[str]:
    """The files that a former run wrote into a folder that is not empty."""
    files = _former_report(target, folder)["files"]
    return frozenset(str(name) for name in files if not PurePosixPath(str(name)).is_absolute())


def _existing_parent(target: Path) -> Path:
    """The nearest folder above that exists; a file in its place is refused by whoever creates beneath it."""
    return next((parent for parent in target.parents if parent.exists()), Path(target.anchor))


def _resolved(folder: Path) -> Path:
    return Path(os.path.realpath(folder))


def _escaped(text: str) -> str:
    """The text in ASCII, as VTK needs it; ``unicode_escape`` brings it back."""
    return text.encode("unicode_escape").decode("ascii")


def _plain_name(name: str) -> str:
    """Letters, digits, "-", "_" and "." only, no dots in front or behind, not too long, no device of Windows."""
    normal = unicodedata.normalize("NFC", name)
    kept = "".join(c if c.isalnum() or c in "-_." else " " for c in normal)
    plain = "_".join(kept.split()).strip(".")
    plain = plain.encode("utf-8")[:_NAME_BYTES].decode("utf-8", "ignore").strip(".") or "unnamed"
    return f"_{plain}" if plain.split(".")[0].upper() in _RESERVED else plain


def save_whole(dataset: Any, path: Path) -> None:
    """Save a VTK dataset, or raise OSError where its file is not whole.

    VTK reports a full disk on the screen alone, so the end of the file is looked at.
    """
    dataset.save(path, binary=True)
    whole = path.is_file() and path.read_bytes()[-32:].rstrip().endswith(b"</VTKFile>")
    if not whole:
        raise OSError(f"{path.name} was not written whole; is the disk full?")
