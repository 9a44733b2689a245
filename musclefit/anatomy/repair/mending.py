"""A dirty surface -> a closed, oriented one that may still cross itself, and what was done; knows no files."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from musclefit.anatomy.repair.records import Change, RepairSettings
from musclefit.errors import MeshError
from musclefit.geometry.arrays import Bool, Int, Points
from musclefit.geometry.measures import area_vectors
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.booleans import vertex_normals
from musclefit.geometry.surfaces.holes import Hole, filled_holes
from musclefit.geometry.surfaces.patches import cancelled, cut_at_non_manifold_vertices, facing_outwards, superfluous
from musclefit.geometry.surfaces.topology import (
    consistent_orientation,
    edges_of,
    face_components,
    merge_duplicate_vertices,
    repeats_a_vertex,
)
from musclefit.geometry.surfaces.uncrossing import compacted

SHEET = 0.75
"""Area of the patches over a piece's holes, over the piece's area, from which on it is a sheet without an inside."""

HOLES_NAMED = 12
"""Holes that are named one by one; further ones are summed up."""


@dataclass(slots=True)
class Log:
    """Collects what is done to one surface."""

    changes: list[Change] = field(default_factory=list)
    dropped: list[TriMesh] = field(default_factory=list)
    patches: list[TriMesh] = field(default_factory=list)

    def add(self, code: str, count: int, message: str, *, area_mm2: float = 0.0, volume_mm3: float = 0.0) -> None:
        """Note a change."""
        self.changes.append(Change(code, count, message, area_mm2, volume_mm3))

    def drop(self, mesh: TriMesh, gone: Bool, *, code: str, what: str) -> TriMesh:
        """Take faces out by name; nothing where none is marked."""
        if not gone.any():
            return mesh
        out = compacted(TriMesh(mesh.vertices, mesh.faces[gone]))
        self.dropped.append(out)
        size = area(out)
        where = place(out.vertices[out.faces[0]])
        self.add(
            code, int(gone.sum()), f"took out {int(gone.sum())} {what} ({size:.4g} mm²), near {where}", area_mm2=size
        )
        return compacted(TriMesh(mesh.vertices, mesh.faces[~gone]))


def mended(mesh: TriMesh, log: Log, *, settings: RepairSettings, source: str) -> TriMesh:
    """Merge, drop what bounds nothing, turn, thicken and fill, in this order.

    Raises
    ------
    MeshError
        The surface has one side only, or is an open sheet and ``thicken_mm`` is 0.
    """
    mesh = _merged(mesh, log, settings.weld_mm)
    mesh = log.drop(mesh, repeats_a_vertex(mesh.faces), code="collapsed-faces", what="faces that used a vertex twice")
    mesh = log.drop(mesh, ~cancelled(mesh.faces), code="doubled-faces", what="faces that lay on another one")
    hanging = superfluous(mesh)
    mesh = log.drop(mesh, hanging, code="dropped-sheets", what="faces of fins, flaps and walls that bounded nothing")
    mesh = _turned(mesh, log, source)
    mesh = _sheets(mesh, log, settings=settings, source=source)
    mesh = _filled(mesh, log)
    if len(edges_of(mesh.faces).odd):
        return mesh
    faces = facing_outwards(mesh)
    count = int((faces != mesh.faces).any(axis=1).sum())
    if count:
        log.add("turned-faces", count, f"turned {count} faces so that the inside is behind them")
    return TriMesh(mesh.vertices, faces)


def _merged(mesh: TriMesh, log: Log, weld_mm: float) -> TriMesh:
    before = _odd(mesh)
    if not before:
        return mesh
    merged = merge_duplicate_vertices(mesh.vertices, mesh.faces)
    candidate = TriMesh(merged.vertices, merged.faces)
    after = _odd(candidate)
    if merged.removed and after < before:
        log.add(
            "merged-vertices",
            merged.removed,
            f"merged {merged.removed} vertices that stood exactly on another; boundary edges from {before} to {after}",
        )
        mesh, before = candidate, after
    edges = edges_of(mesh.faces[~repeats_a_vertex(mesh.faces)])
    rim = np.unique(edges.boundary)
    if not rim.size or weld_mm == 0.0:
        return mesh
    near = cKDTree(mesh.vertices[rim]).query_pairs(weld_mm, output_type="ndarray")
    onto = np.arange(len(mesh.vertices))
    for a, b in rim[near]:
        onto[onto == onto[max(a, b)]] = onto[min(a, b)]
    welded = TriMesh(mesh.vertices, onto[mesh.faces])
    if not len(near) or _odd(welded) >= before:
        return mesh
    count = int((onto != np.arange(len(onto))).sum())
    log.add(
        "welded-vertices",
        count,
        f"sewed {count} vertices of boundary edges onto others at most {weld_mm:g} mm away; boundary edges from "
        f"{before} to {_odd(welded)}",
    )
    return compacted(welded)


def _odd(mesh: TriMesh) -> int:
    return len(edges_of(mesh.faces[~repeats_a_vertex(mesh.faces)]).odd)


def _turned(mesh: TriMesh, log: Log, source: str) -> TriMesh:
    oriented = consistent_orientation(mesh.faces)
    if oriented.one_sided.any():
        at = place(mesh.vertices[mesh.faces[oriented.one_sided][0]])
        raise MeshError(
            f"{source}: {int(oriented.one_sided.sum())} of {len(mesh.faces)} faces form a one-sided surface, as a "
            f"Möbius band is, near {at}: it has no inside, so nothing was repaired. Cut it open in a mesh editor, or "
            "leave the tissue out"
        )
    count = int(oriented.turned.sum())
    if count:
        at = place(mesh.vertices[mesh.faces[oriented.turned][0]])
        log.add("turned-faces", count, f"turned {count} faces to agree with their neighbours, near {at}")
    return TriMesh(mesh.vertices, oriented.faces)


def _sheets(mesh: TriMesh, log: Log, *, settings: RepairSettings, source: str) -> TriMesh:
    """Pieces that are open sheets: thickened, taken out where they are stray, or else refused."""
    piece = face_components(mesh.faces)
    areas = np.linalg.norm(area_vectors(mesh), axis=1)
    whole = float(areas.sum())
    parts: list[TriMesh] = []
    for number in range(int(piece.max(initial=-1)) + 1):
        own = mesh.faces[piece == number]
        size = float(areas[piece == number].sum())
        part = TriMesh(mesh.vertices, own)
        patched = sum(hole.area_mm2 for hole in filled_holes(mesh.vertices, own)) if len(edges_of(own).boundary) else 0
        if patched < SHEET * size:
            continue
        at = place(part.vertices[own[0]])
        if size <= 0.01 * settings.stray_percent * whole or len(own) < 3 < len(mesh.faces) / 10:
            mesh_piece = piece == number
            log.drop(mesh, mesh_piece, code="stray-sheets", what="faces of a loose open sheet")
        elif settings.thicken_mm > 0.0:
            thick = thickened(compacted(part), thickness_mm=settings.thicken_mm)
            log.add(
                "thickened-sheets",
                len(own),
                f"gave an open sheet of {len(own)} faces near {at} a thickness of {settings.thicken_mm:g} mm",
                area_mm2=size,
            )
            parts.append(thick)
        else:
            raise MeshError(
                f"{source}: {len(own)} of {len(mesh.faces)} faces form an open sheet of {size:.4g} mm² near {at}, "
                "which bounds no volume; give it a thickness (--thicken-mm 0.5), or leave it out"
            )
        piece[piece == number] = -1
    if (piece >= 0).all():
        return mesh
    return _joined([compacted(TriMesh(mesh.vertices, mesh.faces[piece >= 0])), *parts])


def thickened(sheet: TriMesh, *, thickness_mm: float) -> TriMesh:
    """A closed surface around an oriented open sheet, half the thickness to either side of it."""
    sheet = cut_at_non_manifold_vertices(sheet).mesh
    shift = 0.5 * thickness_mm * vertex_normals(sheet)
    n = len(sheet.vertices)
    starts, ends = sheet.faces.ravel(), sheet.faces[:, [1, 2, 0]].ravel()
    open_ = (edges_of(sheet.faces).faces_at == 1)[edges_of(sheet.faces).of_face.ravel()]
    a, b = starts[open_], ends[open_]
    rim = np.concatenate([np.stack([b, a, a + n], axis=1), np.stack([b, a + n, b + n], axis=1)])
    faces = np.concatenate([sheet.faces, sheet.faces[:, ::-1] + n, rim])
    return TriMesh(np.vstack([sheet.vertices + shift, sheet.vertices - shift]), faces)


def _joined(parts: list[TriMesh]) -> TriMesh:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return TriMesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
    )


def _filled(mesh: TriMesh, log: Log) -> TriMesh:
    holes = filled_holes(mesh.vertices, mesh.faces)
    for hole in holes[:HOLES_NAMED]:
        log.add("filled-holes", 1, f"filled a hole of {said_hole(hole, mesh.vertices)}", area_mm2=hole.area_mm2)
    rest = holes[HOLES_NAMED:]
    if rest:
        size, longest = sum(hole.area_mm2 for hole in rest), rest[0].length_mm
        log.add(
            "filled-holes",
            len(rest),
            f"filled {len(rest)} further holes of up to {longest:.3g} mm round, {size:.3g} mm² in all",
            area_mm2=size,
        )
    if not holes:
        return mesh
    patch: Int = np.concatenate([hole.patch for hole in holes])
    log.patches.append(compacted(TriMesh(mesh.vertices, patch)))
    return TriMesh(mesh.vertices, np.concatenate([mesh.faces, patch]))


def said_hole(hole: Hole, vertices: Points) -> str:
    """A hole in words."""
    return (
        f"{len(hole.rim)} edges, {hole.length_mm:.3g} mm round and {hole.area_mm2:.3g} mm², near "
        f"{place(vertices[hole.rim])}"
    )


def area(mesh: TriMesh) -> float:
    """Area of a surface, mm²."""
    return float(np.linalg.norm(area_vectors(mesh), axis=1).sum())


def place(points: Points) -> str:
    """The middle of some points in words."""
    x, y, z = np.reshape(points, (-1, 3)).mean(axis=0)
    return f"({x:.2f}, {y:.2f}, {z:.2f}) mm"
