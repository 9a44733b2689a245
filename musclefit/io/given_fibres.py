"""Files of fibres that a user has -> `FibreSamples` in the anatomy's frame, mm; knows formats, no tetrahedra.

Streamlines: .tck and .trk, whose format says RAS+ and mm; lines of .vtk and .vtp. Directions: arrays of vectors at
points or cells of .vtk, .vtp and .vtu. VTK's formats state neither unit nor frame, but for programs that write
``SPACE=RAS`` or ``SPACE=LPS`` into the title of a .vtk.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.images.grids import Frame, in_frame, stated_frame
from musclefit.io.formats.texts import in_mm, read_bytes
from musclefit.io.formats.tractograms import ENDINGS as TRACTOGRAMS
from musclefit.io.formats.tractograms import read_tractogram
from musclefit.io.formats.vtk_legacy import read_legacy_vtk
from musclefit.io.formats.vtk_xml import Cells, VtkFile
from musclefit.muscles.given_fibres import FibreSamples
from musclefit.vocabulary import Unit

ENDINGS = (*TRACTOGRAMS, ".vtk", ".vtp", ".vtu")

KNOWN_NAMES = ("fibres", "fibers", "fibre", "fiber", "directions", "direction")
"""Arrays of vectors that are taken without asking, in this order."""


@dataclass(frozen=True, slots=True)
class FibreFiles:
    """Files of fibres, and what they do not say themselves.

    Parameters
    ----------
    path : path
        A file, or a folder of files. A file that is named as a muscle (``biceps.tck``) is of that muscle alone.
    frame : Frame or None
        Which way the coordinates of .vtk, .vtp and .vtu run; None: as the anatomy's.
    units : Unit or None
        Their unit of length; None: mm.
    array : str
        The array of vectors; empty: the only one, or the first of ``fibres``, ``fibers``, ``fibre``, ``fiber``,
        ``directions`` and ``direction`` that is there.
    reach_mm : float or None
        How far from a sample its direction holds; None: a quarter of the side of a square as large as the muscle's
        median section.
    """

    path: str | Path
    frame: Frame | None = None
    units: Unit | None = None
    array: str = ""
    reach_mm: float | None = None


def read_given_fibres(
    files: FibreFiles, *, anatomy_frame: str, muscles: Collection[str]
) -> tuple[tuple[FibreSamples, ...], tuple[str, ...]]:
    """Read all files.

    Parameters
    ----------
    files : FibreFiles
    anatomy_frame : str
        The anatomy's frame in words.
    muscles : collection of str
        Names that a file may have.

    Returns
    -------
    tuple of FibreSamples
    tuple of str
        What had to be taken for granted.

    Raises
    ------
    InputError
        Nothing to read, a file that is damaged or holds neither streamlines nor vectors, several arrays of vectors none
        of which is chosen, or frames that contradict each other.
    """
    if files.reach_mm is not None and not 0.0 < files.reach_mm < np.inf:
        raise InputError(f"fibres: found a reach of {files.reach_mm}; expected a finite length above 0, mm")
    own = stated_frame(anatomy_frame)
    found, notes = [], []
    for path in _paths(Path(files.path)):
        content = _read(path, files)
        if content.frame is not None and own is None:
            notes.append(
                f"{path.name}: is in {content.frame.value.upper()}, the anatomy's frame is {anatomy_frame!r}; they are "
                "taken to be one: state anatomy.frame"
            )
        if content.empty:
            notes.append(f"{path.name}: {content.empty} streamlines of one place, or vectors of length 0, are left out")
        muscle = path.stem if path.stem in muscles else ""
        found.append(_in(content, path, muscle=muscle, to=own))
    return tuple(found), tuple(notes)


@dataclass(frozen=True, eq=False, slots=True)
class _Content:
    """Of one file, mm, in its own frame (None: none is known)."""

    lines: tuple[Points, ...]
    places: Points
    vectors: Points
    frame: Frame | None
    empty: int = 0


def _paths(path: Path) -> list[Path]:
    try:
        found = sorted(p for p in path.iterdir() if p.suffix.lower() in ENDINGS) if path.is_dir() else [path]
    except OSError as error:
        raise InputError(f"{path}: the fibres cannot be read: {error.strerror or error}") from None
    if not found:
        raise InputError(f"{path}: holds no file of fibres; read are {', '.join(ENDINGS)}")
    return found


def _read(path: Path, files: FibreFiles) -> _Content:
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise InputError(f"{path}: fibres are read from {', '.join(ENDINGS)} files; convert it into one of them")
    data = read_bytes(path)
    if ending in TRACTOGRAMS:
        if files.frame not in (None, Frame.RAS) or files.units not in (None, Unit.MILLIMETRE):
            raise InputError(f"{path}: {ending} files are in RAS and mm; leave frame and units out")
        lines = read_tractogram(data, str(path), ending=ending)
        return _checked(path, _Content(lines, *_no_vectors(), Frame.RAS), Unit.MILLIMETRE)
    found = _vtk(data, path)
    said = stated_frame(found.title.replace("=", " "))
    if files.frame is not None and said not in (None, files.frame):
        raise InputError(f"{path}: its title says {said}, but {files.frame} was given; leave the frame out")
    units, frame = files.units or Unit.MILLIMETRE, files.frame or said
    if len(found.lines.sizes) and not files.array:
        return _checked(path, _Content(_polylines(found.points, found.lines), *_no_vectors(), frame), units)
    name, at_points = _chosen(path, files.array, found)
    places = found.points if at_points else _middles(found.points, found.cells)
    vectors = (found.at_points if at_points else found.at_cells)[name]
    return _checked(path, _Content((), places, np.asarray(vectors, dtype=np.float64), frame), units)


@dataclass(frozen=True, eq=False, slots=True)
class _Vtk:
    """Of a VTK file what may be fibres: lines, and arrays of vectors at points and at cells."""

    title: str
    points: Points
    lines: Cells
    cells: Cells
    at_points: Mapping[str, Any]
    at_cells: Mapping[str, Any]


def _vtk(data: bytes, path: Path) -> _Vtk:
    nothing = Cells(np.zeros(0, np.int64), np.zeros(0, np.int64))
    if path.suffix.lower() == ".vtk":
        found = read_legacy_vtk(data, str(path))
        lines = found.cells.get("LINES", nothing)
        vectors = _wide(found.point_data), _wide(found.cell_data)
        return _Vtk(found.title, found.points, lines, found.all_cells, *vectors)
    polygonal = path.suffix.lower() == ".vtp"
    file = VtkFile(data, str(path), kind="PolyData" if polygonal else "UnstructuredGrid")
    file.check()
    at_points = file.vectors("PointData", count="NumberOfPoints")
    if polygonal:
        lines = file.cells("Lines", count="NumberOfLines")
        return _Vtk("", file.points(), lines, nothing, at_points, {})
    cells = file.cells("Cells", count="NumberOfCells")
    return _Vtk("", file.points(), nothing, cells, at_points, file.vectors("CellData", count="NumberOfCells"))


def _no_vectors() -> tuple[Points, Points]:
    return np.zeros((0, 3)), np.zeros((0, 3))


def _wide(data: Mapping[str, Any]) -> dict[str, Any]:
    return {name: values for name, values in data.items() if values.shape[1] == 3 and values.dtype.kind == "f"}


def _chosen(path: Path, array: str, found: _Vtk) -> tuple[str, bool]:
    """The array of vectors that is meant, and whether it is at points."""
    names = [*found.at_cells, *found.at_points]
    if not names:
        raise InputError(f"{path}: holds neither lines nor an array of three real components at points or cells")
    wanted = [array] if array else [name for name in KNOWN_NAMES if name in names][:1] or (names * (len(names) == 1))
    if len(wanted) != 1 or names.count(wanted[0]) != 1:
        what = f"has no array {array!r}, or two" if array else "does not say which of its arrays the fibres are"
        raise InputError(f"{path}: {what}; name one of {', '.join(names)} (--fibre-array)")
    return wanted[0], wanted[0] in found.at_points


def _polylines(points: Points, cells: Cells) -> tuple[Points, ...]:
    return tuple(points[part] for part in np.split(cells.corners, np.cumsum(cells.sizes)[:-1]))


def _middles(points: Points, cells: Cells) -> Points:
    """Means of the corners of cells; not a number for a cell without any."""
    owner = np.repeat(np.arange(len(cells.sizes)), cells.sizes)
    sums = [np.bincount(owner, points[cells.corners, k], minlength=len(cells.sizes)) for k in range(3)]
    with np.errstate(invalid="ignore", divide="ignore"):
        found: Points = np.stack(sums, axis=1) / cells.sizes[:, None]
    return found


def _checked(path: Path, content: _Content, units: Unit) -> _Content:
    """The same in mm, without what has no direction: lines of one place, vectors of length 0."""
    lines = tuple(in_mm(line, units, source=str(path)) for line in content.lines)
    places = in_mm(content.places, units, source=str(path))
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused below
        lengths: Float = np.linalg.norm(content.vectors, axis=1)
    if not all(np.isfinite(part).all() for part in (*lines, places, content.vectors, lengths)):
        raise InputError(f"{path}: has points or vectors that are not finite; export it again")
    long = tuple(line for line in lines if len(line) > 1 and np.ptp(line, axis=0).any())
    there = lengths > 0.0
    empty = len(lines) - len(long) + int((~there).sum())
    if not long and not there.any():
        raise InputError(f"{path}: has no streamline of two points and no vector above 0; correct the path")
    return _Content(long, places[there], content.vectors[there] / lengths[there, None], content.frame, empty)


def _in(content: _Content, path: Path, *, muscle: str, to: Frame | None) -> FibreSamples:
    of = content.frame
    if of is None or to is None:
        of = to = Frame.RAS
    return FibreSamples(
        path.name,
        tuple(in_frame(line, of=of, to=to) for line in content.lines),
        in_frame(content.places, of=of, to=to),
        in_frame(content.vectors, of=of, to=to),
        muscle,
    )
