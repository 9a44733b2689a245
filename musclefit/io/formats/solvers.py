"""Tetrahedra as solvers read them: FEBio, Abaqus, Gmsh, VTU.

One element set per tissue, shared nodes, no boundary conditions. Tetrahedra are linear, or have a node in the middle of
each edge too (`with_middle_nodes`).

Lengths are mm, so that consistent units are N, MPa and tonnes. Materials are placeholders, which every header says.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Float, Int, Points, Tets, frozen
from musclefit.io.atomic import partial_file

UNITS = "lengths in mm; with N that gives MPa, with tonnes tonne/mm3"
PLACEHOLDER = "materials are placeholders: neo-Hookean or linear elastic, E 1 MPa, Poisson's ratio 0.3, 1e-9 tonne/mm3"

_YOUNG_MPA, _POISSON, _DENSITY = "1", "0.3", "1e-09"
_LABEL_CHARACTERS = 60
"""Abaqus takes labels of 80, of which a material's ending needs some."""


@dataclass(frozen=True, eq=False, slots=True)
class LabelledTets:
    """Tetrahedra with a tissue each.

    Parameters
    ----------
    title : str
    vertices : (n, 3) float64, mm
    tets : (k, 4) int64, right-handed; or (k, 10), the middles of the edges of `MIDDLES` last
    tissue_of_tet : (k,) int64, index into ``names``
    names : tuple of str
    fibres : (k, 3) float64 or None
        Along the fibre of each tet, its length the fibre's stretch; 0 where a tet has none.

    Raises
    ------
    InputError
        No tet, a tissue number without name, or not one fibre for each tet.
    """

    title: str
    vertices: Points
    tets: Tets
    tissue_of_tet: Int
    names: tuple[str, ...]
    fibres: Points | None = None

    def __post_init__(self) -> None:
        if not len(self.tets):
            raise InputError("there is no tetrahedron to write")
        if self.tissue_of_tet.min() < 0 or self.tissue_of_tet.max() >= len(self.names):
            raise InputError(
                f"tets are labelled {self.tissue_of_tet.min()} to {self.tissue_of_tet.max()}, but {len(self.names)} "
                "tissues are named"
            )
        if self.fibres is not None and self.fibres.shape != (len(self.tets), 3):
            raise InputError(f"{len(self.tets)} tets were given fibres of shape {self.fibres.shape}")
        used = np.unique(self.tets)  # a node that no element uses makes a solver's system singular
        object.__setattr__(self, "tets", frozen(np.searchsorted(used, self.tets), np.int64))
        object.__setattr__(self, "vertices", frozen(self.vertices[used]))
        object.__setattr__(self, "tissue_of_tet", frozen(self.tissue_of_tet, np.int64))

    @property
    def fibre_axes(self) -> tuple[Points, Float]:
        """(k, 3) directions of the fibres, of length 1 or 0, and (k,) their stretch."""
        if self.fibres is None:
            return np.zeros((len(self.tets), 3)), np.zeros(len(self.tets))
        stretch = np.linalg.norm(self.fibres, axis=1)
        return self.fibres / np.where(stretch > 0.0, stretch, 1.0)[:, None], stretch

    @property
    def sets(self) -> dict[str, Int]:
        """The numbers of the tets of each tissue that has any, by its label in solver files."""
        order = np.argsort(self.tissue_of_tet, kind="stable")
        bounds = np.searchsorted(self.tissue_of_tet[order], np.arange(len(self.names) + 1))
        labels = solver_labels(self.names)
        return {label: order[a:b] for label, a, b in zip(labels, bounds, bounds[1:], strict=False) if b > a}


MIDDLES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))
"""Corners of the edges whose middles are the nodes 5 to 10 of a quadratic tetrahedron, in FEBio, Abaqus and VTK."""

_GMSH_ORDER = (0, 1, 2, 3, 4, 5, 6, 7, 9, 8)
"""Gmsh has the last two the other way round."""


def with_middle_nodes(tets: LabelledTets) -> LabelledTets:
    """Quadratic tetrahedra of the same shape: a node in the middle of each straight edge, shared by all around it."""
    corners = np.asarray(tets.tets)
    edges = np.sort(np.stack([corners[:, edge] for edge in MIDDLES], axis=1), axis=2)
    met, number = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
    middles = 0.5 * (tets.vertices[met[:, 0]] + tets.vertices[met[:, 1]])
    return LabelledTets(
        title=tets.title,
        vertices=np.vstack([tets.vertices, middles]),
        tets=np.hstack([corners, len(tets.vertices) + number.reshape(-1, len(MIDDLES))]),
        tissue_of_tet=tets.tissue_of_tet,
        names=tets.names,
        fibres=tets.fibres,
    )


def solver_labels(names: tuple[str, ...]) -> list[str]:
    """A label for each name that every format takes: ASCII letters, digits and ``_``, a letter first, all different.

    Solvers do not tell upper from lower case, so neither do these.
    """
    taken: set[str] = set()
    labels = []
    for name in names:
        plain = "".join(c if c.isascii() and c.isalnum() else "_" for c in name)[:_LABEL_CHARACTERS].strip("_")
        plain = plain if plain[:1].isalpha() else f"tissue_{plain}"
        label, count = plain, 1
        while label.casefold() in taken:
            count += 1
            label = f"{plain}_{count}"
        taken.add(label.casefold())
        labels.append(label)
    return labels


class MshVersion(StrEnum):
    """Of Gmsh's format: FEBio Studio and older readers know 2.2 best."""

    V4 = "4.1"
    V2 = "2.2"


def write_solver_file(path: Path, tets: LabelledTets, *, msh: MshVersion = MshVersion.V4) -> None:
    """Write tetrahedra in the format that the ending names, whole or not at all.

    Parameters
    ----------
    path : Path
    tets : LabelledTets
    msh : MshVersion
        Of a .msh file.

    Raises
    ------
    InputError
        An ending that is none of ``FORMATS``, or the path is a folder.
    """
    check_solver_path(path)
    ending = path.suffix.lower()
    write = _write_gmsh_2 if (ending, msh) == (".msh", MshVersion.V2) else FORMATS[ending]
    with partial_file(path, ending=path.suffix) as partial:
        write(partial, tets)


def check_solver_path(path: Path) -> None:
    """Refuse, before reading, a path that nothing could be written to: InputError."""
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: the ending {path.suffix!r} is not a known format; use one of {', '.join(FORMATS)}")
    if path.is_dir():
        raise InputError(f"{path} is a folder; name a file")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}; make it first")


def _write_febio(path: Path, tets: LabelledTets) -> None:
    """FEBio's XML, format version 4.0."""

    def lines() -> Iterator[str]:
        yield '<?xml version="1.0" encoding="ISO-8859-1"?>'
        yield f"<!-- {_comment(tets.title)} -->"
        yield f"<!-- {UNITS}; {PLACEHOLDER}; add boundary conditions and loads -->"
        yield '<febio_spec version="4.0">'
        yield '\t<Module type="solid"/>'
        yield "\t<Globals>\n\t\t<Constants>\n\t\t\t<T>0</T>\n\t\t\t<P>0</P>\n\t\t\t<R>0</R>\n\t\t\t<Fc>0</Fc>"
        yield "\t\t</Constants>\n\t</Globals>\n\t<Material>"
        for number, label in enumerate(tets.sets, start=1):
            yield f'\t\t<material id="{number}" name={quoteattr(label)} type="neo-Hookean">'
            yield f"\t\t\t<density>{_DENSITY}</density>\n\t\t\t<E>{_YOUNG_MPA}</E>"
            yield f"\t\t\t<v>{_POISSON}</v>\n\t\t</material>"
        yield '\t</Material>\n\t<Mesh>\n\t\t<Nodes name="all_nodes">'
        for number, (x, y, z) in enumerate(tets.vertices.tolist(), start=1):
            yield f'\t\t\t<node id="{number}">{x!r},{y!r},{z!r}</node>'
        yield "\t\t</Nodes>"
        for label, own in tets.sets.items():
            yield f'\t\t<Elements type="tet{tets.tets.shape[1]}" name={quoteattr(label)}>'
            for number, nodes in zip((own + 1).tolist(), (tets.tets[own] + 1).tolist(), strict=True):
                yield f'\t\t\t<elem id="{number}">{",".join(map(str, nodes))}</elem>'
            yield "\t\t</Elements>"
        yield "\t</Mesh>\n\t<MeshDomains>"
        for label in tets.sets:
            yield f"\t\t<SolidDomain name={quoteattr(label)} mat={quoteattr(label)}/>"
        yield '\t</MeshDomains>\n\t<Output>\n\t\t<plotfile type="febio">\n\t\t\t<var type="displacement"/>'
        yield '\t\t\t<var type="stress"/>\n\t\t</plotfile>\n\t</Output>\n</febio_spec>'

    _write_lines(path, lines(), encoding="iso-8859-1")


def _write_abaqus(path: Path, tets: LabelledTets) -> None:
    """Abaqus' input file: nodes once, one ELSET, solid section and material per tissue."""

    def lines() -> Iterator[str]:
        yield "*HEADING"
        yield _comment(tets.title)
        yield f"** {UNITS}"
        yield f"** {PLACEHOLDER}; add steps, boundary conditions and loads"
        yield "*NODE, NSET=ALL_NODES"
        for number, (x, y, z) in enumerate(tets.vertices.tolist(), start=1):
            yield f"{number}, {x!r}, {y!r}, {z!r}"
        for label, own in tets.sets.items():
            yield f"*ELEMENT, TYPE=C3D{tets.tets.shape[1]}, ELSET={label}"
            for number, nodes in zip((own + 1).tolist(), (tets.tets[own] + 1).tolist(), strict=True):
                yield ", ".join(map(str, (number, *nodes)))
        oriented = _fibred(tets)
        if oriented:
            yield "** the first axis of an element's own runs along its fibre\n*DISTRIBUTION TABLE, NAME=FIBRE_AXES"
            yield "COORD3D, COORD3D"
        for label in oriented:
            yield f"*DISTRIBUTION, NAME={label}_FIBRES, LOCATION=ELEMENT, TABLE=FIBRE_AXES\n, 1., 0., 0., 0., 1., 0."
            own = tets.sets[label]
            axes = np.hstack([tets.fibre_axes[0][own], across(tets.fibre_axes[0][own])])
            for number, row in zip((own + 1).tolist(), axes.tolist(), strict=True):
                yield ", ".join((str(number), *(repr(x) for x in row)))
            yield f"*ORIENTATION, NAME={label}_ORIENTATION, SYSTEM=RECTANGULAR\n{label}_FIBRES\n3, 0."
        for label in tets.sets:
            along = f", ORIENTATION={label}_ORIENTATION" if label in oriented else ""
            yield f"*SOLID SECTION, ELSET={label}, MATERIAL={label}_MATERIAL{along}"
        for label in tets.sets:
            yield f"*MATERIAL, NAME={label}_MATERIAL\n*DENSITY\n{_DENSITY}\n*ELASTIC\n{_YOUNG_MPA}., {_POISSON}"

    _write_lines(path, lines(), encoding="ascii")


def _write_gmsh(path: Path, tets: LabelledTets) -> None:
    """Gmsh's MSH 4.1, ASCII: one volume and one physical group per tissue."""
    sets = tets.sets
    entity = np.full(len(tets.vertices), len(sets), dtype=np.int64)
    for number, own in reversed(list(enumerate(sets.values()))):
        entity[tets.tets[own].ravel()] = number  # a shared node belongs to the first of its tissues

    def lines() -> Iterator[str]:
        yield "$MeshFormat\n4.1 0 8\n$EndMeshFormat"
        yield f"$Comments\n{_comment(tets.title)}\n{UNITS}\n$EndComments"
        yield f"$PhysicalNames\n{len(sets)}"
        for number, label in enumerate(sets, start=1):
            yield f'3 {number} "{label}"'
        yield f"$EndPhysicalNames\n$Entities\n0 0 0 {len(sets)}"
        for number, own in enumerate(sets.values(), start=1):
            corners = tets.vertices[tets.tets[own]].reshape(-1, 3)
            box = " ".join(repr(x) for x in (*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist()))
            yield f"{number} {box} 1 {number} 0"
        yield "$EndEntities\n$Nodes"
        blocks = [(number, np.flatnonzero(entity == number)) for number in range(len(sets))]
        blocks = [(number, own) for number, own in blocks if len(own)]
        yield f"{len(blocks)} {len(tets.vertices)} 1 {len(tets.vertices)}"
        for number, own in blocks:
            yield f"3 {number + 1} 0 {len(own)}"
            yield "\n".join(map(str, (own + 1).tolist()))
            yield "\n".join(f"{x!r} {y!r} {z!r}" for x, y, z in tets.vertices[own].tolist())
        yield f"$EndNodes\n$Elements\n{len(sets)} {len(tets.tets)} 1 {len(tets.tets)}"
        for number, own in enumerate(sets.values(), start=1):
            yield f"3 {number} {_gmsh_type(tets)} {len(own)}"
            for tet, nodes in zip((own + 1).tolist(), _gmsh_nodes(tets)[own].tolist(), strict=True):
                yield " ".join(map(str, (tet, *nodes)))
        yield "$EndElements"
        yield from _gmsh_fibres(tets)

    _write_lines(path, lines(), encoding="ascii")


def _write_gmsh_2(path: Path, tets: LabelledTets) -> None:
    """Gmsh's MSH 2.2, ASCII: one physical group per tissue, its number twice at each element."""

    def lines() -> Iterator[str]:
        yield "$MeshFormat\n2.2 0 8\n$EndMeshFormat"
        yield f"$Comments\n{_comment(tets.title)}\n{UNITS}\n$EndComments"
        yield f"$PhysicalNames\n{len(tets.sets)}"
        for number, label in enumerate(tets.sets, start=1):
            yield f'3 {number} "{label}"'
        yield f"$EndPhysicalNames\n$Nodes\n{len(tets.vertices)}"
        for number, (x, y, z) in enumerate(tets.vertices.tolist(), start=1):
            yield f"{number} {x!r} {y!r} {z!r}"
        yield f"$EndNodes\n$Elements\n{len(tets.tets)}"
        for number, own in enumerate(tets.sets.values(), start=1):
            for tet, nodes in zip((own + 1).tolist(), _gmsh_nodes(tets)[own].tolist(), strict=True):
                yield " ".join(map(str, (tet, _gmsh_type(tets), 2, number, number, *nodes)))
        yield "$EndElements"
        yield from _gmsh_fibres(tets)

    _write_lines(path, lines(), encoding="ascii")


def _gmsh_fibres(tets: LabelledTets) -> Iterator[str]:
    """A view of directions of length 1, of the elements that have a fibre."""
    if tets.fibres is None:
        return
    directions, stretch = tets.fibre_axes
    numbers = np.flatnonzero(stretch > 0.0)
    yield f'$ElementData\n1\n"fibre"\n1\n0.0\n3\n0\n3\n{len(numbers)}'
    for number, row in zip((numbers + 1).tolist(), directions[numbers].tolist(), strict=True):
        yield " ".join((str(number), *(repr(x) for x in row)))
    yield "$EndElementData"


def _fibred(tets: LabelledTets) -> list[str]:
    """Labels of the tissues all of whose tets have a fibre."""
    stretch = tets.fibre_axes[1]
    return [label for label, own in tets.sets.items() if (stretch[own] > 0.0).all()]


def across(directions: Points) -> Points:
    """(k, 3) directions at right angles to directions of length 1, of length 1 too."""
    axes = np.eye(3)[np.abs(directions).argmin(axis=1)]
    found = axes - np.einsum("ki,ki->k", axes, directions)[:, None] * directions
    beside: Points = found / np.linalg.norm(found, axis=1, keepdims=True)
    return beside


def _gmsh_type(tets: LabelledTets) -> int:
    return {4: 4, 10: 11}[tets.tets.shape[1]]


def _gmsh_nodes(tets: LabelledTets) -> Int:
    nodes: Int = tets.tets[:, list(_GMSH_ORDER[: tets.tets.shape[1]])] + 1
    return nodes


def _write_vtu(path: Path, tets: LabelledTets) -> None:
    """VTK's unstructured grid: cell data ``tissue`` and fibres; for each label a field array, number and dimension."""
    import pyvista as pv

    kind = {4: pv.CellType.TETRA, 10: pv.CellType.QUADRATIC_TETRA}[tets.tets.shape[1]]
    grid = pv.UnstructuredGrid({kind: np.array(tets.tets)}, np.array(tets.vertices))
    tissue = np.empty(len(tets.tets), dtype=np.int64)
    for number, (label, own) in enumerate(tets.sets.items()):
        tissue[own] = number
        grid.field_data[label] = np.array([number, 3], dtype=np.int64)
    grid.cell_data["tissue"] = tissue
    if tets.fibres is not None:
        grid.cell_data["fibre"], grid.cell_data["fibre_stretch"] = tets.fibre_axes
    grid.save(path, binary=True)
    if not path.read_bytes()[-32:].rstrip().endswith(b"</VTKFile>"):
        raise OSError(f"{path.name} was not written whole; is the disk full?")


def _write_lines(path: Path, lines: Iterator[str], *, encoding: str) -> None:
    with path.open("w", encoding=encoding, newline="\n") as file:
        file.writelines(f"{line}\n" for line in lines)


def _comment(text: str) -> str:
    """One line of ASCII that ends no comment and begins no keyword."""
    plain = " ".join(text.encode("ascii", "backslashreplace").decode("ascii").split())
    return escape(plain).replace("--", "- -").replace("*", "").replace("$", "") or "musclefit"


FORMATS: Mapping[str, Callable[[Path, LabelledTets], None]] = MappingProxyType(
    {".feb": _write_febio, ".inp": _write_abaqus, ".msh": _write_gmsh, ".vtu": _write_vtu}
)
"""Ending of the file to what writes it."""
