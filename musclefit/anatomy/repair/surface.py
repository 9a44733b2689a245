"""One dirty surface -> one that bounds a solid, with all that was done to it; knows no files and no other tissue.

Two ways, the gentler first. *Local*: merge, drop, turn, fill, cut at non-manifold vertices, unite pieces that cross,
take out what crosses and close it again; every vertex elsewhere stays. *Resurfaced*: the border of the tets that
the surface winds around, from a tetrahedralisation that follows it within an envelope; every triangle is new.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from musclefit.anatomy.cleaning import FEWEST_FACES, LARGEST_COORDINATE_MM
from musclefit.anatomy.repair.mending import Log, area, mended, place
from musclefit.anatomy.repair.records import UNCHANGED, Change, Deviation, Repaired, RepairSettings, Way
from musclefit.errors import MeshError
from musclefit.geometry.arrays import Bool, Int, Points
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.hausdorff import reach
from musclefit.geometry.queries.solids import pieces
from musclefit.geometry.queries.winding import winding_numbers
from musclefit.geometry.surfaces.booleans import united
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.geometry.surfaces.faults import Faults, faults_of, non_manifold_vertices
from musclefit.geometry.surfaces.patches import cut_at_non_manifold_vertices
from musclefit.geometry.surfaces.resurfacing import Fill, border_of_inside
from musclefit.geometry.surfaces.topology import (
    closed_components,
    edges_of,
    has_no_area,
    merge_duplicate_vertices,
    nested_pieces,
    turn,
)
from musclefit.geometry.surfaces.uncrossing import (
    PART_MM,
    compacted,
    parted,
    relaxed,
    touching_vertices,
    uncrossed,
    without_flat_faces,
)

TOLERANCE_MM = 0.02
"""Width of the bracket that distances are known within, mm."""

COARSE_MM = 0.05
"""The same for the distance without exceptions, mm."""

SMOOTH_MM = 1e-3
"""How far a place of united pieces may move for slivers to go, mm."""


def repair_surface(name: str, mesh: TriMesh, *, settings: RepairSettings, fill: Fill | None, source: str) -> Repaired:
    """Repair one surface, or say why it cannot be.

    Parameters
    ----------
    name : str
    mesh : TriMesh
        As it stands in its file.
    settings : RepairSettings
    fill : callable or None
        What tetrahedralises when the local way fails or breaks the limit; None leaves that out.
    source : str
        Where the surface comes from, for error messages.

    Returns
    -------
    Repaired
        With the very same mesh where it has no fault and no unused vertex; else by the first way that is valid within
        the limit, else the valid one that stays closest, else the given mesh with the reason as last change.

    Raises
    ------
    MeshError
        Empty, absurdly far away, one-sided, an open sheet, or without volume.
    """
    if len(mesh.faces) == 0 or np.abs(mesh.vertices).max() > LARGEST_COORDINATE_MM:
        raise MeshError(
            f"{source}: {len(mesh.faces)} faces and coordinates up to {np.abs(mesh.vertices).max(initial=0):.3g} mm: "
            "an empty or damaged surface; export it again"
        )
    before = faults_of(mesh)
    volume = enclosed_volume(mesh)
    parts = whole_pieces(mesh, settings, with_hollows=not before.none)
    untouched = Repaired(
        name, mesh, Way.UNTOUCHED, before, before, (), UNCHANGED, volume, volume, parts, parts, settings.limit_mm
    )
    log, used = Log(), compacted(mesh)
    unused = len(mesh.vertices) - len(used.vertices)
    if unused:
        log.add("unused-vertices", unused, f"removed {unused} vertices that belong to no face")
    if before.none and not _thin_or_stray(mesh, settings).any():
        return replace(untouched, mesh=used, way=Way.LOCAL, changes=tuple(log.changes)) if unused else untouched
    unmended = Log(list(log.changes))
    soup = mended(used, log, settings=settings, source=source)
    tried = [_local(untouched, soup, log, settings=settings, source=source)]
    if fill is not None and not tried[0].passed:
        tried.append(_resurfaced(untouched, soup, log, settings=settings, fill=fill))
        if not tried[1].passed:
            tried.append(_resurfaced(untouched, used, unmended, settings=settings, fill=fill))
    for result in tried:
        if result.passed:
            return result
    valid = [result for result in tried if result.after.none]
    if valid:
        return min(valid, key=lambda result: result.deviation.largest_mm)
    reason = f"no way led to a valid surface; after the local one it still had {tried[0].after.said()}: left as it was"
    return replace(untouched, way=Way.UNREPAIRED, changes=(Change("unrepaired", 1, reason),))


def whole_pieces(mesh: TriMesh, settings: RepairSettings, *, with_hollows: bool = False) -> int:
    """Pieces of a surface that share no place of a vertex, strays left out and, unless asked for, hollows too."""
    merged = merge_duplicate_vertices(mesh.vertices, mesh.faces)
    volumes = np.array([enclosed_volume(part) for part in pieces(TriMesh(merged.vertices, merged.faces))])
    sizes = np.abs(volumes) if with_hollows else volumes
    return int((sizes > 0.01 * settings.stray_percent * sizes.max(initial=0.0)).sum())


def tidied(mesh: TriMesh, *, settings: RepairSettings, most_mm: float) -> tuple[TriMesh, tuple[Change, ...]]:
    """A closed surface that a boolean left, freed of flat faces, contacts, crossings, stray and thin pieces.

    Parameters
    ----------
    mesh : TriMesh
    settings : RepairSettings
    most_mm : float
        How far a vertex may be moved; where triangles are taken out and filled in, the surface may move farther.
    """
    log = Log()
    mesh = _without_thin_or_stray(mesh, log, settings)
    mesh = _without_crossings(_apart(mesh, log), log, most_mm=most_mm)
    mesh = _nested_by_depth(_without_thin_or_stray(mesh, log, settings), log)
    return compacted(mesh), tuple(log.changes)


def _local(given: Repaired, soup: TriMesh, log: Log, *, settings: RepairSettings, source: str) -> Repaired:
    own = Log([*log.changes], [*log.dropped], [*log.patches])
    mesh = _apart(soup, own)
    if not len(edges_of(mesh.faces).odd):
        mesh = _without_crossings(mesh, own, most_mm=0.75 * settings.limit_mm)
    mesh = _nested_by_depth(_without_thin_or_stray(mesh, own, settings), own)
    if len(mesh.faces) < FEWEST_FACES or _encloses_nothing(mesh):
        volume = enclosed_volume(mesh) if len(mesh.faces) else 0.0
        raise MeshError(
            f"{source}: {len(mesh.faces)} faces are left, which enclose {volume:.3g} mm³: it has no inside. If "
            "two sides lie on each other, delete one in a mesh editor and give the other a thickness (--thicken-mm "
            "0.5); else leave the tissue out"
        )
    return _result(given, mesh, own, settings=settings, way=Way.LOCAL)


def _resurfaced(given: Repaired, soup: TriMesh, log: Log, *, settings: RepairSettings, fill: Fill) -> Repaired:
    own = Log([*log.changes], [*log.dropped], [*log.patches])
    try:
        border = border_of_inside(soup, fill=fill)
    except MeshError as error:
        own.add("resurfacing-failed", 1, f"resurfacing failed: {error}")
        return _result(given, soup, own, settings=settings, way=Way.RESURFACED)
    own.add(
        "resurfaced",
        len(border.faces),
        f"made a new surface of {len(border.faces)} triangles: the border of the tetrahedra that the old one of "
        f"{len(soup.faces)} winds around",
        area_mm2=area(border),
    )
    mesh = _without_crossings(_apart(border, own), own, most_mm=0.75 * settings.limit_mm)
    mesh = _nested_by_depth(_without_thin_or_stray(mesh, own, settings), own)
    return _result(given, mesh, own, settings=settings, way=Way.RESURFACED)


def _apart(mesh: TriMesh, log: Log) -> TriMesh:
    """Flat faces out, cut at non-manifold vertices, touching vertices moved apart."""
    flat = int(has_no_area(mesh).sum())
    if flat:
        log.add("flat-faces", flat, f"flipped or closed {flat} faces without area")
        mesh = without_flat_faces(mesh)
    pinched = len(non_manifold_vertices(mesh.faces))
    if pinched:
        log.add(
            "cut-non-manifold-vertices",
            pinched,
            f"cut the surface at {pinched} vertices where its faces form more than one fan",
        )
        mesh = cut_at_non_manifold_vertices(mesh).mesh
    touching = touching_vertices(mesh)
    if touching:
        said = f"moved {touching} vertices off others at the same place, by up to {PART_MM} mm"
        log.add("parted-vertices", touching, said)
        mesh = parted(mesh)
    return mesh


def _without_crossings(mesh: TriMesh, log: Log, *, most_mm: float) -> TriMesh:
    """Each closed piece freed of its own crossings, then those that cross each other united."""
    found = self_crossings(mesh)
    if not len(found):
        return mesh
    piece = closed_components(mesh.faces)
    parts = [compacted(TriMesh(mesh.vertices, mesh.faces[piece == k])) for k in range(int(piece.max()) + 1)]
    within = piece[found.pairs[:, 0]] == piece[found.pairs[:, 1]]
    for k in np.unique(piece[found.pairs[within, 0]]):
        parts[k] = _free_of_crossings(parts[k], log, most_mm=most_mm)
    between = piece[found.pairs[~within]]
    if not len(between):
        return _joined(parts)
    size = len(parts)
    graph = coo_array((np.ones(len(between)), (between[:, 0], between[:, 1])), shape=(size, size))
    group: Int = np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)
    whole = []
    for number in np.unique(group):
        members = [
            _outwards(parts[k]) if (group == number).sum() > 1 else parts[k] for k in np.flatnonzero(group == number)
        ]
        whole.append(_united(members, log) if len(members) > 1 else members[0])
    joined = _joined(whole)
    again = uncrossed(parted(without_flat_faces(joined)))
    if again.pairs:
        log.add(
            "removed-crossings",
            again.pairs,
            f"took out {again.removed} triangles that crossed where pieces were united and filled in {again.filled}",
        )
    return again.mesh


def _free_of_crossings(piece: TriMesh, log: Log, *, most_mm: float) -> TriMesh:
    """A piece whose crossing triangles are moved apart as far as that goes, the others taken out and closed again."""
    found = self_crossings(piece)
    eased = relaxed(piece, most_mm=most_mm)
    one = uncrossed(eased)
    moved = int((eased.vertices != piece.vertices).any(axis=1).sum())
    parts = [f"moved {moved} vertices by up to {most_mm:.3g} mm"] if moved else []
    if one.removed:
        parts.append(f"took out {one.removed} triangles of {one.pairs} pairs and filled in {one.filled}")
    log.add(
        "removed-crossings",
        len(found),
        f"{len(found)} crossing pairs of triangles near {place(found.places[0])}: {'; '.join(parts)}",
    )
    return one.mesh


def _united(members: list[TriMesh], log: Log) -> TriMesh:
    before = sum(enclosed_volume(member) for member in members)
    try:
        one = united(members, smooth_within_mm=SMOOTH_MM)
    except MeshError:
        return _joined(members)
    shared = before - enclosed_volume(one)
    log.add(
        "united-pieces",
        len(members),
        f"united {len(members)} pieces that crossed each other and shared {shared:.4g} mm³",
        volume_mm3=shared,
    )
    return one


def _outwards(mesh: TriMesh) -> TriMesh:
    return mesh if enclosed_volume(mesh) > 0.0 else TriMesh(mesh.vertices, mesh.faces[:, ::-1])


def _joined(parts: list[TriMesh]) -> TriMesh:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)])
    return TriMesh(np.concatenate([part.vertices for part in parts]), faces)


def _thin_or_stray(mesh: TriMesh, settings: RepairSettings) -> Bool:
    """(f,) faces of closed pieces that are too small or too thin, among larger ones."""
    piece = closed_components(mesh.faces)
    count = int(piece.max(initial=-1)) + 1
    gone = np.zeros(len(mesh.faces), dtype=bool)
    if count < 2:
        return gone
    parts = [compacted(TriMesh(mesh.vertices, mesh.faces[piece == k])) for k in range(count)]
    volumes = np.array([abs(enclosed_volume(part)) for part in parts])
    thickness = 2.0 * volumes / np.maximum([area(part) for part in parts], 1e-300)
    bad = (volumes < 0.01 * settings.stray_percent * volumes.max()) | (thickness < settings.thin_mm)
    bad[int(volumes.argmax())] = False
    gone[:] = bad[piece]
    return gone


def _without_thin_or_stray(mesh: TriMesh, log: Log, settings: RepairSettings) -> TriMesh:
    gone = _thin_or_stray(mesh, settings) if len(mesh.faces) and not len(edges_of(mesh.faces).odd) else None
    if gone is None or not gone.any():
        return mesh
    what = f"faces of pieces below {settings.stray_percent:g} % of the volume or thinner than {settings.thin_mm:g} mm"
    return log.drop(mesh, gone, code="stray-pieces", what=what)


def _nested_by_depth(mesh: TriMesh, log: Log) -> TriMesh:
    """Outermost pieces turned outwards, those inside one turned inwards (hollows), and so on."""
    edges = edges_of(mesh.faces)
    if not len(mesh.faces) or len(edges.odd) or len(edges.unbalanced):
        return mesh
    found = nested_pieces(mesh)
    wrong = (found.volumes > 0) == (found.depth % 2 == 1)
    for number in np.flatnonzero(wrong):
        size = abs(float(found.volumes[number]))
        which = "a hollow inside another piece and now faces inwards" if found.depth[number] % 2 else "inside-out"
        log.add("turned-pieces", 1, f"a piece of {size:.6g} mm³ was {which}", volume_mm3=size)
    return TriMesh(mesh.vertices, turn(mesh.faces, wrong[found.of_face])) if wrong.any() else mesh


def _encloses_nothing(mesh: TriMesh) -> bool:
    return enclosed_volume(mesh) <= 1e-9 * area(mesh) ** 1.5 and not len(edges_of(mesh.faces).odd)


def _result(given: Repaired, mesh: TriMesh, log: Log, *, settings: RepairSettings, way: Way) -> Repaired:
    mesh = compacted(mesh)
    after: Faults = faults_of(mesh)
    return replace(
        given,
        mesh=mesh,
        way=way,
        after=after,
        changes=tuple(log.changes),
        deviation=deviation_of(compacted(given.mesh), mesh, log),
        volume_after_mm3=enclosed_volume(mesh),
        pieces_after=whole_pieces(mesh, settings),
    )


def deviation_of(original: TriMesh, result: TriMesh, log: Log) -> Deviation:
    """How far a result is from the original, with and without what was dropped, filled or enclosed by name."""
    kept = _without(original, log.dropped)
    known = _joined([original, *log.patches])

    def not_enclosed(points: Points) -> Bool:
        outside: Bool = winding_numbers(result, points) < 0.5
        return outside

    there = reach(kept, result, tolerance_mm=TOLERANCE_MM, where=not_enclosed)
    back = reach(result, known, tolerance_mm=TOLERANCE_MM)
    plain = max(
        reach(original, result, tolerance_mm=COARSE_MM).at_most,
        reach(result, original, tolerance_mm=COARSE_MM).at_most,
    )
    x, y, z = (there if there.at_least >= back.at_least else back).place
    return Deviation(
        there.at_least,
        back.at_least,
        max(there.at_most, back.at_most),
        plain,
        there.passed_over_mm2,
        (float(x), float(y), float(z)),
    )


def _without(original: TriMesh, dropped: list[TriMesh]) -> TriMesh:
    """The original less the faces that were dropped, recognised by their corners' positions."""
    if not dropped:
        return original
    gone = {_key(corners) for part in dropped for corners in part.corners()}
    kept = np.array([_key(corners) not in gone for corners in original.corners()], dtype=bool)
    return TriMesh(original.vertices, original.faces[kept]) if kept.any() else original


def _key(corners: Points) -> bytes:
    return (corners + 0.0)[np.lexsort(corners.T[::-1])].tobytes()
