"""Raw surfaces -> tissues that are closed and turned outwards, and what was found on the way; knows no files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from musclefit.anatomy.findings import Finding, some_of
from musclefit.anatomy.model import Tissue, TissueKind
from musclefit.errors import InputError, MeshError
from musclefit.geometry.arrays import Bool, Faces, Int, Points
from musclefit.geometry.measures import area_vectors, enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.geometry.surfaces.topology import (
    Merged,
    chains,
    consistent_orientation,
    edges_of,
    has_no_area,
    merge_duplicate_vertices,
    nested_pieces,
    repeats_a_face,
    repeats_a_vertex,
    turn,
)

FEWEST_FACES = 4
"""Faces of the smallest closed surface, a tetrahedron."""
LARGEST_COORDINATE_MM = 1e9
"""A coordinate beyond this is damage, not anatomy, mm."""
SMALLEST_ANATOMY_MM = 5.0
"""Diagonal of the bounding box below which files were taken for millimetres that are in a larger unit, mm."""
LEAST_COMPACTNESS = 1e-9
"""Enclosed volume over area^1.5 at or below which a surface encloses nothing (sphere: 0.094), no unit."""
LARGEST_ANATOMY_MM = 5000.0
"""Diagonal of the bounding box above which files are in a smaller unit than the one stated, mm."""


@dataclass(frozen=True, slots=True)
class _Notes:
    """Collects what is found about one surface."""

    name: str
    found: list[Finding]

    def add(self, code: str, message: str) -> None:
        self.found.append(Finding(self.name, code, f"{self.name}: {message}"))


def take_in(
    name: str, kind: TissueKind, *, vertices: Points, faces: Faces, source: str
) -> tuple[Tissue, tuple[Finding, ...]]:
    """Make a tissue of a raw surface, or say why it cannot be one.

    Parameters
    ----------
    name : str
    kind : TissueKind
    vertices : (n, 3) float64, mm
    faces : (f, 3) int64
    source : str
        Where the surface comes from, for error messages; a file name, or the tissue's own name.

    Returns
    -------
    Tissue
        Its surface is closed (every edge has an even number of faces) and consistently oriented, and its outermost
        pieces enclose positive volume. Vertices keep their numbers unless they had to be merged.
    tuple of Finding
        Everything that was changed ("merged-vertices", "repeated-vertices", "repeated-faces", "turned-faces",
        "inside-out") and everything odd that was left as it is ("zero-area", "non-manifold", "self-touching",
        "self-crossing", "pieces", "cavities", "nested", "unused-vertices").

    Raises
    ------
    MeshError
        Empty, not finite or absurdly far, not closed, not orientable, or without volume.
    """
    _require_numbers(vertices, faces, source)
    notes = _Notes(name, [])
    if _n_odd(faces):
        vertices, faces = _merged(vertices, faces, notes)
    faces = _without_idle_faces(faces, notes)
    if len(faces) < FEWEST_FACES:
        raise MeshError(
            f"{source}: tissue {name!r} has {len(faces)} faces; a closed surface has at least {FEWEST_FACES}. "
            "Export the whole surface, or leave the tissue out"
        )
    _require_closed(vertices, faces, name=name, source=source)
    faces = _consistent(vertices, faces, notes, source=source)
    surface = _outwards(TriMesh(vertices, faces), notes)
    _require_volume(surface, name=name, source=source)
    _note_oddities(surface, notes)
    return Tissue(name, kind, surface), tuple(notes.found)


def require_plausible_size(tissues: Iterable[Tissue], *, units: Mapping[str, float], read_in: str) -> None:
    """Raise where the whole anatomy is too small or too large for the unit that its files were read in.

    Parameters
    ----------
    tissues : iterable of Tissue, mm
    units : mapping
        The mm in one of each unit a file can have, by the unit's name.
    read_in : str
        The unit that the files were read in.

    Raises
    ------
    InputError
        The bounding box has a diagonal below ``SMALLEST_ANATOMY_MM`` or above ``LARGEST_ANATOMY_MM``; the message names
        the unit that would put it between. Centimetres taken for millimetres mostly stay between and pass.
    """
    vertices = np.concatenate([t.surface.vertices for t in tissues])
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if SMALLEST_ANATOMY_MM <= diagonal <= LARGEST_ANATOMY_MM:
        return
    in_file_units = diagonal / units[read_in]
    too_small = diagonal < SMALLEST_ANATOMY_MM
    fitting = sorted(
        (unit for unit, mm in units.items() if SMALLEST_ANATOMY_MM <= in_file_units * mm <= LARGEST_ANATOMY_MM),
        key=lambda unit: units[unit],
        reverse=too_small,
    )
    words = {"mm": "millimetres", "cm": "centimetres", "m": "metres"}
    if fitting:
        way_out = f'the files look like {words.get(fitting[0], fitting[0])}, set units = "{fitting[0]}"'
    else:
        way_out = (
            f"no unit musclefit reads ({', '.join(units)}) puts it between {SMALLEST_ANATOMY_MM:g} and "
            f"{LARGEST_ANATOMY_MM:g} mm: correct the files, or a tissue that is far from the others"
        )
    said = f"{diagonal:.3g}" if too_small else f"{diagonal:.0f}"
    raise InputError(f'the anatomy is {said} mm across; {way_out} (they were read in "{read_in}")')


def _require_numbers(vertices: Points, faces: Faces, source: str) -> None:
    if not len(vertices) or not len(faces):
        raise MeshError(
            f"{source}: an empty surface ({len(vertices)} vertices, {len(faces)} faces); export it again, or leave "
            "it out"
        )
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if bad.size:
        x, y, z = vertices[bad[0]]
        raise MeshError(
            f"{source}: {bad.size} of {len(vertices)} vertices are not finite, the first is number {bad[0]} "
            f"(0-based): ({x:g}, {y:g}, {z:g}); export the surface again"
        )
    largest = int(np.argmax(np.abs(vertices).max(axis=1)))
    if np.abs(vertices[largest]).max() > LARGEST_COORDINATE_MM:
        x, y, z = vertices[largest]
        raise MeshError(
            f"{source}: vertex {largest} (0-based) is at ({x:.3g}, {y:.3g}, {z:.3g}) mm, farther than "
            f"{LARGEST_COORDINATE_MM:g} mm from the origin; the file is damaged or its units are wrong"
        )
    outside = np.flatnonzero((faces < 0) | (faces >= len(vertices)))
    if outside.size:
        face, vertex = outside[0] // 3, faces.ravel()[outside[0]]
        raise MeshError(
            f"{source}: face {face} (0-based) uses vertex {vertex}, but there are {len(vertices)}, numbered from 0; "
            "the file is damaged, export it again"
        )


def _n_odd(faces: Faces) -> int:
    return len(edges_of(faces[~repeats_a_vertex(faces)]).odd)


def _merged(vertices: Points, faces: Faces, notes: _Notes) -> tuple[Points, Faces]:
    """Merge exact duplicates where that leaves fewer boundary edges; a closed surface is never touched."""
    before = _n_odd(faces)
    merged: Merged = merge_duplicate_vertices(vertices, faces)
    after = _n_odd(merged.faces)
    if not merged.removed or after >= before:
        return vertices, faces
    notes.add(
        "merged-vertices",
        f"merged {merged.removed} of {len(vertices)} vertices that stood exactly on another one, which took the open "
        f"edges from {before} to {after}",
    )
    return merged.vertices, merged.faces


def _without_idle_faces(faces: Faces, notes: _Notes) -> Faces:
    """Leave out faces that bound nothing: those with one vertex twice, and second copies."""
    repeated = repeats_a_vertex(faces)
    if repeated.any():
        faces = faces[~repeated]
        idle = _count(int(repeated.sum()), "face")
        notes.add("repeated-vertices", f"left out {idle} that used one vertex twice and bounded nothing")
    copies = repeats_a_face(faces)
    if copies.any():
        faces = faces[~copies]
        notes.add("repeated-faces", f"left out {_count(int(copies.sum()), 'face')} that stood there a second time")
    return faces


def _require_closed(vertices: Points, faces: Faces, *, name: str, source: str) -> None:
    edges = edges_of(faces)
    odd = edges.odd
    if not len(odd):
        return
    boundary = edges.boundary
    way_out = (
        "Close it with musclefit repair IN OUT, which fills holes and joins edges that nearly coincide, or leave the "
        "tissue out: an open surface has neither volume nor overlaps"
    )
    if not len(boundary):
        raise MeshError(
            f"{source}: tissue {name!r} is not closed: {_count(len(odd), 'edge')} with three or another odd number of "
            f"faces, one near {_place(vertices[odd[0]])}. {way_out}"
        )
    holes = chains(boundary)
    raise MeshError(
        f"{source}: tissue {name!r} is not closed: {_count(len(boundary), 'boundary edge')} around "
        f"{_count(len(holes), 'hole')}, the largest with {_count(len(holes[0]), 'edge')} near "
        f"{_place(vertices[np.unique(holes[0])])}. {way_out}"
    )


def _consistent(vertices: Points, faces: Faces, notes: _Notes, *, source: str) -> Faces:
    if not len(edges_of(faces).unbalanced):
        return faces
    oriented = consistent_orientation(faces)
    if oriented.one_sided.any():
        n_faces = int(oriented.one_sided.sum())
        raise MeshError(
            f"{source}: tissue {notes.name!r} has no inside: {n_faces} of its {len(faces)} faces form a one-sided "
            f"surface near {_place(vertices[faces[oriented.one_sided][0]])}. No repair can give it one: "
            "cut it open in a mesh editor and close the parts, or leave the tissue out"
        )
    unbalanced = edges_of(oriented.faces).unbalanced
    if len(unbalanced):
        raise MeshError(
            f"{source}: tissue {notes.name!r} has {_count(len(unbalanced), 'edge')} where more than two faces meet and "
            f"do not bound an inside, one near {_place(vertices[unbalanced[0]])}. "
            "Rebuild the surface with musclefit repair IN OUT"
        )
    first = int(np.flatnonzero(oriented.turned)[0])
    notes.add(
        "turned-faces",
        f"turned {int(oriented.turned.sum())} of {len(faces)} faces to agree with their neighbours, the first near "
        f"{_place(vertices[faces[first]])}",
    )
    return oriented.faces


def _outwards(surface: TriMesh, notes: _Notes) -> TriMesh:
    """Turn outermost pieces that enclose negative volume, and with them what lies inside them."""
    pieces = nested_pieces(surface)
    inside_out = pieces.volumes[pieces.outermost] < 0
    volumes = np.where(inside_out, -pieces.volumes, pieces.volumes)
    if inside_out.any():
        which: Bool = inside_out[pieces.of_face]
        surface = TriMesh(surface.vertices, turn(surface.faces, which))
        what = "the surface was" if inside_out.all() else f"{int(inside_out.sum())} of {len(volumes)} pieces were"
        enclosed = float(pieces.volumes[inside_out].sum())
        notes.add("inside-out", f"{what} inside-out (enclosing {enclosed:.6g} mm³) and now faces outwards")
    outer = pieces.depth == 0
    if outer.sum() > 1:
        notes.add("pieces", f"{int(outer.sum())} separate pieces, of {_listed(volumes[outer])} mm³")
    cavities = (pieces.depth > 0) & (volumes < 0)
    if cavities.any():
        hollow = _count(int(cavities.sum()), "cavity", "cavities")
        notes.add("cavities", f"{hollow} inside, of {_listed(-volumes[cavities])} mm³")
    nested = (pieces.depth % 2 == 1) & (volumes > 0)
    if nested.any():
        first = surface.vertices[surface.faces[pieces.of_face == np.flatnonzero(nested)[0]]]
        notes.add(
            "nested",
            f"{_count(int(nested.sum()), 'piece')} of {_listed(volumes[nested])} mm³ inside another piece and turned "
            f"outwards too, so that their volume counts twice, the first near {_place(first)}; kept",
        )
    return surface


def _require_volume(surface: TriMesh, *, name: str, source: str) -> None:
    volume, area = enclosed_volume(surface), float(np.linalg.norm(area_vectors(surface), axis=1).sum())
    if volume <= LEAST_COMPACTNESS * area**1.5:
        raise MeshError(
            f"{source}: tissue {name!r} encloses no volume ({volume:.3g} mm³ within {area:.3g} mm²): its two sides lie "
            "on each other. Delete one side in a mesh editor and give the other a thickness with musclefit repair "
            "IN OUT --thicken-mm 0.5, or leave the tissue out"
        )


def _note_oddities(surface: TriMesh, notes: _Notes) -> None:
    vertices, faces = surface.vertices, surface.faces
    flat = has_no_area(surface)
    if flat.any():
        where = _place(vertices[faces[np.flatnonzero(flat)[0]]])
        notes.add("zero-area", f"{_count(int(flat.sum()), 'face')} without area, the first near {where}; kept")
    crowded = edges_of(faces).non_manifold
    if len(crowded):
        where = _place(vertices[crowded[0]])
        notes.add(
            "non-manifold", f"{_count(len(crowded), 'edge')} with more than two faces, the first near {where}; kept"
        )
    used = np.unique(faces)
    if len(used) < len(vertices):
        notes.add("unused-vertices", f"{len(vertices) - len(used)} vertices belong to no face; kept")
    touching = _coincident(vertices[used])
    if touching.size:
        notes.add(
            "self-touching",
            f"{_count(touching.size, 'vertex', 'vertices')} at the position of another, where the surface touches "
            f"itself, the first near {_place(vertices[used][touching[:1]])}; kept",
        )
    crossings = self_crossings(surface)
    if len(crossings):
        notes.add(
            "self-crossing",
            f"{_count(len(crossings), 'pair')} of triangles of this surface cross, the first near "
            f"{_place(crossings.places[:1])}; overlaps with it cannot be measured exactly",
        )


def _coincident(vertices: Points) -> Int:
    kept_as = merge_duplicate_vertices(vertices, np.zeros((0, 3), np.int64)).kept_as
    _, first = np.unique(kept_as, return_index=True)
    return np.setdiff1d(np.arange(len(vertices)), first)


def _place(points: Points) -> str:
    x, y, z = np.reshape(points, (-1, 3)).mean(axis=0)
    return f"({x:.2f}, {y:.2f}, {z:.2f}) mm"


def _count(n: int, one: str, many: str = "") -> str:
    return f"{n} {one if n == 1 else many or one + 's'}"


def _listed(volumes: Points) -> str:
    largest = np.sort(volumes)[::-1]
    return some_of((f"{volume:.4g}" for volume in largest), most=4)
