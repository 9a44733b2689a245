"""Closed surfaces as solids: how much of one lies inside or outside another; knows no tissue.

The booleans are manifold3d's. It says "no error" of inside-out and of self-crossing input, so orientation is judged
here before a volume is believed; whether a surface crosses itself is another module's question.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import manifold3d
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from musclefit.errors import MeshError
from musclefit.geometry.arrays import Float, Int, Points, frozen
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.winding import winding_numbers
from musclefit.geometry.rigid import RigidMotion

ROUNDING_MM3 = 1e-6
"""Volumes below this are rounding, mm³.

Measured: two halves of a cut sphere, of radius 1 to 500 mm, meshed apart and turned, "overlap" by at most 2.4e-8 mm³
(cut faces up to 8e5 mm²); a true overlap of 1e-10 mm depth over 1e4 mm² comes out as 7e-7 mm³.
"""

_NOTHING = TriMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))


@dataclass(frozen=True, eq=False, slots=True)
class Solid:
    """A closed, outward oriented surface, prepared for booleans; made by `solid_of`.

    Parameters
    ----------
    manifold : manifold3d.Manifold
    box : (2, 3) float64, mm
        Lowest and highest corner of its bounding box.
    volume : float, mm³, positive
    """

    manifold: Any
    box: Float
    volume: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "box", frozen(self.box))


def solid_of(mesh: TriMesh) -> Solid:
    """Prepare a closed surface for booleans, in double precision.

    Raises
    ------
    MeshError
        The surface is empty, not closed, not an oriented 2-manifold, encloses no positive volume, has an inside-out
        piece that is no cavity, or a piece wholly inside another that would count twice.

    Notes
    -----
    A surface that crosses itself is *not* refused: where its parts overlap, volumes count twice, and where it is
    locally turned inside out they count negative.
    """
    if not len(mesh.faces):
        raise MeshError("the surface has no triangle, so it encloses nothing; give a closed surface")
    vertices = np.array(mesh.vertices, dtype=np.float64, order="C")
    faces = np.array(mesh.faces, dtype=np.uint64, order="C")
    manifold = manifold3d.Manifold(manifold3d.Mesh64(vertices, faces))
    if manifold.status() != manifold3d.Error.NoError:
        raise MeshError(
            f"the surface of {len(faces)} triangles is not a closed oriented 2-manifold ({manifold.status().name}): "
            "close its holes, merge doubled vertices and orient its triangles outward"
        )
    volume = float(manifold.volume())
    if volume <= 0.0:
        raise MeshError(
            f"the surface encloses {volume:.6g} mm³, so it is inside-out or flat; "
            "reverse its triangles so that they turn counter-clockwise seen from outside"
        )
    _refuse_misplaced_pieces(mesh)
    used = mesh.vertices[np.unique(mesh.faces)]
    return Solid(manifold=manifold, box=np.stack([used.min(axis=0), used.max(axis=0)]), volume=volume)


def overlap_volume(a: Solid, b: Solid) -> float:
    """Volume that two solids share, mm³; 0 at once where their boxes are apart.

    Raises
    ------
    MeshError
        The volume is negative, or larger than the smaller solid: a surface crosses itself or is locally inside out.
    """
    if _boxes_apart(a.box, b.box):
        return 0.0
    return _believable(float((a.manifold ^ b.manifold).volume()), at_most=min(a.volume, b.volume), what="overlap")


def overlap_part(a: Solid, b: Solid) -> tuple[float, TriMesh]:
    """Volume, mm³, and surface of what two solids share; MeshError as for `overlap_volume`."""
    if _boxes_apart(a.box, b.box):
        return 0.0, _NOTHING
    shared = a.manifold ^ b.manifold
    volume = _believable(float(shared.volume()), at_most=min(a.volume, b.volume), what="overlap")
    return volume, _tri_mesh(shared) if volume > 0.0 else _NOTHING


def outside_part(a: Solid, skin: Solid) -> tuple[float, TriMesh]:
    """Volume, mm³, and surface of the part of ``a`` outside ``skin``; MeshError as for `volume_outside`."""
    left = a.manifold if _boxes_apart(a.box, skin.box) else a.manifold - skin.manifold
    volume = _believable(float(left.volume()), at_most=a.volume, what="volume outside")
    return volume, _tri_mesh(left) if volume > 0.0 else _NOTHING


def overlap_mesh(a: Solid, b: Solid) -> TriMesh:
    """Surface of what two solids share; without triangles where they share nothing."""
    if _boxes_apart(a.box, b.box):
        return TriMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    return _tri_mesh(a.manifold ^ b.manifold)


def volume_outside(a: Solid, skin: Solid) -> float:
    """Volume of ``a`` that is outside ``skin``, mm³.

    Raises
    ------
    MeshError
        The volume is negative, or larger than ``a``: a surface crosses itself or is locally inside out.
    """
    if _boxes_apart(a.box, skin.box):
        return a.volume
    return _believable(float((a.manifold - skin.manifold).volume()), at_most=a.volume, what="volume outside")


def outside_mesh(a: Solid, skin: Solid) -> TriMesh:
    """Surface of the part of ``a`` that is outside ``skin``; without triangles where all of it is inside."""
    return _tri_mesh(a.manifold - skin.manifold)


def moved_solid(solid: Solid, motion: RigidMotion) -> Solid:
    """The solid after a rigid motion, without preparing it anew."""
    moved = solid.manifold.transform(np.hstack([motion.rotation, motion.translation[:, None]]))
    return Solid(manifold=moved, box=_box(moved), volume=solid.volume)


def shared_solid(a: Solid, b: Solid) -> Solid | None:
    """What two solids share, or None where that is nothing beyond rounding; MeshError as for `overlap_volume`."""
    if _boxes_apart(a.box, b.box):
        return None
    return _part(a.manifold ^ b.manifold, at_most=min(a.volume, b.volume), what="overlap")


def solid_outside(a: Solid, b: Solid) -> Solid | None:
    """The part of ``a`` outside ``b``, or None if it is only rounding; MeshError as for `volume_outside`."""
    if _boxes_apart(a.box, b.box):
        return a
    return _part(a.manifold - b.manifold, at_most=a.volume, what="volume outside")


def surface_of(solid: Solid) -> TriMesh:
    """The solid's surface."""
    return _tri_mesh(solid.manifold)


def samples_of(solid: Solid, *, spacing_mm: float, most: int) -> Points:
    """Places of a solid: its surface at a spacing, and a lattice of places inside.

    Parameters
    ----------
    solid : Solid
    spacing_mm : float
        Edges of the surface longer than this are split.
    most : int
        The spacing is widened until the surface takes about this many places; the lattice takes a quarter of it.

    Returns
    -------
    (n, 3) float64, mm
    """
    spacing = max(spacing_mm, float(np.sqrt(2.0 * solid.manifold.surface_area() / most)))
    on_surface = _tri_mesh(solid.manifold.refine_to_length(spacing)).vertices
    size = solid.box[1] - solid.box[0]
    step = max(spacing, float(np.cbrt(4.0 * np.prod(size) / most)))
    axes = [low + step * (np.arange(int(edge / step)) + 0.5) for low, edge in zip(solid.box[0], size, strict=True)]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = winding_numbers(_tri_mesh(solid.manifold), lattice) > 0.5
    return np.concatenate([on_surface, lattice[inside]])


def refined_to(mesh: TriMesh, *, edge_length_mm: float) -> TriMesh:
    """The same closed surface with edges split into pieces of about ``edge_length_mm``; no vertex leaves its triangle.

    Raises
    ------
    MeshError
        The surface is not closed.
    """
    vertices = np.array(mesh.vertices, dtype=np.float64, order="C")
    manifold = manifold3d.Manifold(manifold3d.Mesh64(vertices, np.array(mesh.faces, dtype=np.uint64, order="C")))
    if manifold.status() != manifold3d.Error.NoError:
        raise MeshError(f"the surface to refine is not a closed oriented 2-manifold ({manifold.status().name})")
    return _tri_mesh(manifold.refine_to_length(edge_length_mm))


def candidate_pairs(boxes: Sequence[Float]) -> Int:
    """Pairs of boxes that touch or overlap, by sweeping along the first axis.

    Parameters
    ----------
    boxes : sequence of (2, 3) float64, mm
        Lowest and highest corner of each.

    Returns
    -------
    (p, 2) int64
        Indices i < j, in lexicographic order.
    """
    if len(boxes) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    corners = np.stack(boxes)
    order = np.argsort(corners[:, 0, 0], kind="stable")
    low, high = corners[order, 0], corners[order, 1]
    ends = np.searchsorted(low[:, 0], high[:, 0], side="right")
    found = []
    for i, end in enumerate(ends):
        rest = np.arange(i + 1, end)
        touching = rest[((low[rest] <= high[i]) & (low[i] <= high[rest])).all(axis=1)]
        found.append(np.stack([np.full(len(touching), order[i]), order[touching]], axis=1))
    pairs = np.sort(np.concatenate(found), axis=1)
    sorted_pairs: Int = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].astype(np.int64)
    return sorted_pairs


def pieces(mesh: TriMesh) -> tuple[TriMesh, ...]:
    """The connected pieces of a surface, in order of their first triangle; unused vertices are left out."""
    n = len(mesh.vertices)
    starts, ends = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    _, label = connected_components(coo_array((np.ones(len(starts)), (starts, ends)), shape=(n, n)), directed=False)
    of_face = label[mesh.faces[:, 0]]
    _, first = np.unique(of_face, return_index=True)
    return tuple(_compacted(mesh, of_face == of_face[face]) for face in np.sort(first))


def _compacted(mesh: TriMesh, kept: Any) -> TriMesh:
    used, faces = np.unique(mesh.faces[kept], return_inverse=True)
    return TriMesh(mesh.vertices[used], faces.reshape(-1, 3))


def _refuse_misplaced_pieces(mesh: TriMesh) -> None:
    """Raise where a piece is inside out without being a cavity, or lies wholly inside another piece."""
    parts = pieces(mesh)
    if len(parts) < 2:
        return
    boxes = [np.stack([part.vertices.min(axis=0), part.vertices.max(axis=0)]) for part in parts]
    for number, part in enumerate(parts):
        depth = sum(
            (winding_numbers(parts[other], part.vertices) for other in _touching(boxes, number)),
            start=np.zeros(len(part.vertices)),
        )
        volume = enclosed_volume(part)
        if volume < -ROUNDING_MM3 and depth.max() < 0.5:
            raise MeshError(
                f"piece {number + 1} of {len(parts)} ({len(part.faces)} triangles, near {part.vertices[0].round(2)}) "
                f"encloses {volume:.6g} mm³, so it is inside-out and no cavity of another; reverse its triangles"
            )
        if volume > ROUNDING_MM3 and depth.min() > 0.5:
            raise MeshError(
                f"piece {number + 1} of {len(parts)} ({len(part.faces)} triangles, near {part.vertices[0].round(2)}) "
                "lies wholly inside another piece and would count twice; remove it, or reverse it if it is a cavity"
            )


def _touching(boxes: Sequence[Float], number: int) -> Iterator[int]:
    return (i for i, box in enumerate(boxes) if i != number and not _boxes_apart(box, boxes[number]))


def _part(manifold: Any, *, at_most: float, what: str) -> Solid | None:
    volume = _believable(float(manifold.volume()), at_most=at_most, what=what)
    return None if volume <= ROUNDING_MM3 else Solid(manifold=manifold, box=_box(manifold), volume=volume)


def _box(manifold: Any) -> Float:
    corners: Float = np.array(manifold.bounding_box(), dtype=np.float64).reshape(2, 3)
    return corners


def _boxes_apart(a: Float, b: Float) -> bool:
    return bool((a[0] > b[1]).any() or (b[0] > a[1]).any())


def _believable(volume: float, *, at_most: float, what: str) -> float:
    """The volume, 0 where rounding made it just negative.

    Raises
    ------
    MeshError
        It is negative or too large beyond rounding.
    """
    if volume < -ROUNDING_MM3 or volume > at_most * (1.0 + 1e-9) + ROUNDING_MM3:
        raise MeshError(
            f"the {what} comes out as {volume:.6g} mm³, outside 0 to {at_most:.6g} mm³: a surface crosses itself or is "
            "locally inside out; repair it first"
        )
    return max(volume, 0.0)


def _tri_mesh(manifold: Any) -> TriMesh:
    mesh = manifold.to_mesh64()
    vertices = np.array(np.asarray(mesh.vert_properties)[:, :3], dtype=np.float64)
    faces = np.array(np.asarray(mesh.tri_verts), dtype=np.int64).reshape(-1, 3)
    merged = np.arange(len(vertices))
    merged[np.asarray(mesh.merge_from_vert, dtype=np.int64)] = np.asarray(mesh.merge_to_vert, dtype=np.int64)
    return TriMesh(vertices, merged[faces])
