"""Surface files and folders -> an `Anatomy` and what was found in it; knows paths, endings and how files are named."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from hashlib import sha256
from pathlib import Path
from types import MappingProxyType

from musclefit.anatomy.cleaning import require_plausible_size, take_in
from musclefit.anatomy.findings import Finding, some_of
from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError, MeshError
from musclefit.geometry.arrays import Faces, Points, frozen
from musclefit.geometry.meshes import TriMesh
from musclefit.io.formats.ply import read_ply
from musclefit.io.formats.surfaces import Polygons, read_obj, read_stl
from musclefit.io.formats.texts import in_mm, read_bytes
from musclefit.io.formats.vtk_xml import read_vtp
from musclefit.io.named_files import is_there
from musclefit.progress import Progress, Silent
from musclefit.vocabulary import Unit

_READERS: Mapping[str, Callable[[bytes, str], Polygons]] = MappingProxyType(
    {".stl": read_stl, ".obj": read_obj, ".ply": read_ply, ".vtp": read_vtp}
)
_ENDINGS = ", ".join(_READERS)
_KIND_WORDS: Mapping[str, TissueKind] = MappingProxyType(
    {
        **dict.fromkeys(("skin", "skins"), TissueKind.SKIN),
        **dict.fromkeys(("muscle", "muscles"), TissueKind.MUSCLE),
        **dict.fromkeys(("bone", "bones"), TissueKind.BONE),
        **dict.fromkeys(("other", "others"), TissueKind.OTHER),
    }
)
"""Words in file names and names of folders that say a kind."""


_UNWATCHED = Silent()

_REPAIR = "overlaps_resolved"
"""A key that the report of a repair has, and no other file is likely to."""


@dataclass(frozen=True, eq=False, slots=True)
class RawSurface:
    """One surface file as it stands.

    Parameters
    ----------
    path : Path
    vertices : (n, 3) float64, mm
    faces : (f, 3) int64
        Polygons cut into triangles; not checked to be closed, nor to refer to vertices that are there.
    sha256 : str
        Of the bytes that were read.
    findings : tuple of Finding
    """

    path: Path
    vertices: Points
    faces: Faces
    sha256: str
    findings: tuple[Finding, ...]

    def mesh(self) -> TriMesh:
        """The surface as a mesh; MeshError where a face uses a vertex that is not there, or one is not finite."""
        return TriMesh(self.vertices, self.faces)


@dataclass(frozen=True, eq=False, slots=True)
class ReadAnatomy:
    """An anatomy, what was found in it, and each file's SHA-256 by its path (within the folder, if one was read).

    ``unusable`` names the surfaces that were left out, which only who asks for that gets.
    """

    anatomy: Anatomy
    findings: tuple[Finding, ...]
    hashes: Mapping[str, str]
    unusable: tuple[Finding, ...] = ()


def read_surface(path: Path, *, units: Unit = Unit.MILLIMETRE) -> RawSurface:
    """Read one STL, OBJ, PLY or VTP file.

    Parameters
    ----------
    path : Path
    units : Unit
        Length unit of the file.

    Raises
    ------
    InputError
        No such file, or an ending that is not read.
    MeshError
        Empty, cut short, damaged, or not of the format that its ending says.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(
            f"{path}: surfaces are read from {_ENDINGS} files, not {path.suffix or 'files without ending'}"
        )
    data = read_bytes(path)
    if not data.strip():
        raise MeshError(f"{path}: an empty file; export the surface again")
    polygons = reader(data, str(path))
    findings = []
    if polygons.cut:
        said = f"{path.stem}: {polygons.cut} faces with more than three corners were cut into triangles"
        findings.append(Finding(path.stem, "cut-polygons", said))
    vertices = frozen(in_mm(polygons.vertices, units, source=str(path), error=MeshError))
    return RawSurface(path, vertices, frozen(polygons.faces, int), sha256(data).hexdigest(), tuple(findings))


def read_anatomy(
    source: str | Path | Sequence[str | Path],
    *,
    units: Unit = Unit.MILLIMETRE,
    kinds: Sequence[tuple[str, TissueKind]] = (),
    frame: str = "as in the files",
    progress: Progress = _UNWATCHED,
    leave_out: bool = False,
) -> ReadAnatomy:
    """Read every tissue of an anatomy and check it.

    Parameters
    ----------
    source : path or sequence of paths
        A folder: its own surface files and those of its subfolders ``bones``, ``muscles``, ``skin`` and ``other`` (also
        in the singular), and nothing deeper; what else lies there is a finding. Or files, and shell-style patterns for
        them (``muscles/*.ply``).
    units : Unit
        Length unit of the files.
    kinds : sequence of (pattern, TissueKind)
        Kinds by tissue name (a file's name without its ending) or shell-style pattern, ahead of what names say; the
        first pattern that fits counts. Without one the kind comes from the start of the file name (``bone_``,
        ``muscle_``, ``skin``, ``other_``), else from the folder's name (``bones``), else from such a word anywhere in
        the file name; where nothing says it, the tissue is of kind other, with a finding.
    frame : str
        The coordinate frame in words.
    progress : Progress
    leave_out : bool
        Whether surfaces that cannot be used are left out and named in ``unusable``, as long as one can be used.

    Returns
    -------
    ReadAnatomy
        The tissues in mm, what was found in their files, and the SHA-256 of each file.

    Raises
    ------
    InputError
        Nothing to read, two files of one name, a pattern that fits nothing, or an anatomy of implausible size.
    MeshError
        A file that cannot be read whole, or a surface that is not closed; the message names the file.
    """
    folder: Path | None = None
    findings: list[Finding] = []
    if isinstance(source, str | Path):
        folder = Path(source)
        paths, findings = _folder(folder)
    else:
        paths = _expanded([Path(path) for path in source])
    named = _by_name(paths)
    tissues: list[Tissue] = []
    unusable: list[Finding] = []
    hashes: dict[str, str] = {}
    with progress.stage("read and check the surfaces") as tick:
        for done, (name, path) in enumerate(named.items(), start=1):
            kind, notes = _kind(name, path, kinds)
            try:
                raw = read_surface(path, units=units)
                tissue, found = take_in(name, kind, vertices=raw.vertices, faces=raw.faces, source=str(path))
            except MeshError as error:
                if not leave_out:
                    raise
                unusable.append(Finding(name, "unusable", str(error)))
            else:
                tissues.append(tissue)
                findings += [*notes, *raw.findings, *found]
                hashes[(path.relative_to(folder) if folder else path).as_posix()] = raw.sha256
            tick(done / len(named))
    if not tissues:
        raise _none_usable(unusable)
    _require_used(kinds, tuple(named))
    require_plausible_size(tissues, units={unit.value: unit.in_mm for unit in Unit}, read_in=units.value)
    anatomy = Anatomy(tuple(tissues), frame)
    return ReadAnatomy(anatomy, tuple(findings), MappingProxyType(hashes), tuple(unusable))


def _none_usable(unusable: Sequence[Finding]) -> MeshError:
    if len(unusable) == 1:
        return MeshError(unusable[0].message)
    some = "; ".join(finding.message for finding in unusable[:6]) + ("; ..." if len(unusable) > 6 else "")
    return MeshError(f"none of {len(unusable)} surfaces can be used: {some}")


def surface_files(source: Path) -> tuple[dict[str, Path], tuple[Finding, ...]]:
    """The surface files that a file or a folder stands for, by tissue name, and what was passed over.

    Raises
    ------
    InputError
        Nothing is there, nothing there is a surface, or two files have one name.
    """
    if source.is_file():
        return _by_name([source]), ()
    paths, findings = _folder(source)
    return _by_name(paths), tuple(findings)


def kind_of(name: str, path: Path, kinds: Sequence[tuple[str, TissueKind]]) -> tuple[TissueKind, tuple[Finding, ...]]:
    """The kind of a tissue, by patterns, its file's name or its folder's; see `read_anatomy`."""
    return _kind(name, path, kinds)


def _folder(folder: Path) -> tuple[list[Path], list[Finding]]:
    if not is_there(folder) or not folder.is_dir():
        reason = (
            "is a file, not a folder: name it under files" if is_there(folder) else "is not there; correct the path"
        )
        raise InputError(f"the anatomy's folder {folder} {reason}")
    inside = [path for path in sorted(folder.iterdir()) if not path.name.startswith(".")]
    read_into = [path for path in inside if path.is_dir() and path.name.lower() in _KIND_WORDS]
    inside += [path for sub in read_into for path in sorted(sub.iterdir()) if not path.name.startswith(".")]
    paths = [path for path in inside if path.is_file() and path.suffix.lower() in _READERS]
    if not paths:
        raise InputError(f"the anatomy's folder {folder} has no surface file; read are {_ENDINGS}")
    left = [path for path in inside if path not in paths and path not in read_into and not is_repair_report(path)]
    if not left:
        return paths, []
    said = ", ".join(path.relative_to(folder).as_posix() + ("/" if path.is_dir() else "") for path in left[:6])
    message = f"{folder.name}: {len(left)} files and folders were not read: {said}{', ...' if len(left) > 6 else ''}"
    return paths, [Finding(folder.name, "not-read", message)]


def is_repair_report(path: Path) -> bool:
    """Whether a file is the report that a repair wrote beside its surfaces."""
    if path.suffix.lower() != ".json" or not path.is_file():
        return False
    try:
        return _REPAIR in json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError):
        return False


def _expanded(patterns: Sequence[Path]) -> list[Path]:
    paths: dict[Path, None] = {}
    for pattern in patterns:
        fits = (
            [pattern]
            if is_there(pattern)
            else sorted(Path(pattern.anchor).glob(str(pattern.relative_to(pattern.anchor))))
        )
        if not fits:
            raise InputError(f"no file fits {pattern}; correct the path or the pattern")
        folders = [path for path in fits if path.is_dir()]
        if folders:
            raise InputError(f"{folders[0]} is a folder; name the files in it, for example {folders[0] / '*.ply'}")
        paths.update(dict.fromkeys(fits))
    if not paths:
        raise InputError("the anatomy names no file; give at least one surface file")
    return list(paths)


def _by_name(paths: Sequence[Path]) -> dict[str, Path]:
    named: dict[str, Path] = {}
    for path in paths:
        if not _is_text(path.name):
            raise InputError(f"{path.parent}: the name of the file {path.name!r} is not UTF-8 text; rename the file")
        if path.stem in named:
            raise InputError(
                f"{named[path.stem]} and {path} would both be the tissue {path.stem!r}; rename one, or name only one"
            )
        named[path.stem] = path
    return named


def _is_text(name: str) -> bool:
    """Whether a file's name is what it seems, and not bytes that stand for no characters."""
    return not any("\udc80" <= character <= "\udcff" for character in name)


def _kind(name: str, path: Path, kinds: Sequence[tuple[str, TissueKind]]) -> tuple[TissueKind, tuple[Finding, ...]]:
    for pattern, kind in kinds:
        if fnmatchcase(name, pattern):
            return kind, ()
    words = [word for word in re.split(r"[^a-z]+", name.lower()) if word]
    said = {_KIND_WORDS[word] for word in words if word in _KIND_WORDS}
    if words and words[0] in _KIND_WORDS:
        return _KIND_WORDS[words[0]], ()
    if path.parent.name.lower() in _KIND_WORDS:
        return _KIND_WORDS[path.parent.name.lower()], ()
    if len(said) == 1:
        return said.pop(), ()
    reason = f"both {' and '.join(sorted(said))}" if said else "no kind"
    message = (
        f"{name}: its name says {reason}, so it is of kind other; start the file name with bone_, muscle_, skin or "
        "other_, or set its kind in [anatomy.kinds]"
    )
    return TissueKind.OTHER, (Finding(name, "unknown-kind", message),)


def _require_used(kinds: Sequence[tuple[str, TissueKind]], names: Sequence[str]) -> None:
    for pattern, kind in kinds:
        if not any(fnmatchcase(name, pattern) for name in names):
            some = some_of(sorted(names), most=6)
            raise InputError(f"kind {kind.value} is set for {pattern!r}, which no tissue is named; there are: {some}")
