"""Joint space between bones that slide past each other: filler there is no tissue, so the mesh leaves it out.

Two bones a gap apart that slide over a distance shear whatever is meshed between them by distance over gap, which no
tissue undergoes. What is left is a void whose walls are the bones' own faces; whether the bones meet is tested on them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.geometry.arrays import Bool, Float, Points, Tets
from musclefit.geometry.measures import signed_volumes
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.rigid import RigidMotion


@dataclass(frozen=True, slots=True)
class SlidingBones:
    """Which bones move as one, and where they stand on the way.

    Parameters
    ----------
    groups : sequence of sequences of str
        Names of bones; those of one group keep their places to each other.
    poses : sequence of mapping of bone to RigidMotion
        From the rest pose to poses on the way, the rest pose included if it counts.
    """

    groups: Sequence[Sequence[str]]
    poses: Sequence[Mapping[str, RigidMotion]]


def without_joint_space(tets: TetAnatomy, sliding: SlidingBones, *, zone_mm: float) -> TetAnatomy:
    """The same mesh without the filler between bones that slide past each other.

    Parameters
    ----------
    tets : TetAnatomy
    sliding : SlidingBones
    zone_mm : float
        A tet of filler is joint space when, in one of the poses, a corner or its barycentre is so close to two bones
        of different groups that the two distances add up to at most this. On the way it is taken to ride on the first
        of the two. So is one with corners on bones of two groups, of any size: nothing in it could give way.

    Returns
    -------
    TetAnatomy
        With the number and volume of the tets left out added to ``joint_space_tets`` and ``joint_space_mm3``. The same
        object where there is no filler or nothing slides.
    """
    skin = next((k for k, t in enumerate(tets.anatomy) if t.kind is TissueKind.SKIN), None)
    if skin is None or len(sliding.groups) < 2:
        return tets
    filler = np.flatnonzero(tets.tissue_of_tet == skin)
    corners = tets.mesh.tets[filler]
    near = np.zeros(len(tets.mesh.vertices), dtype=bool)
    used = np.unique(corners)
    near[used] = _between(tets.mesh.vertices[used], tets.anatomy, sliding, zone_mm=zone_mm)
    chosen = near[corners].any(axis=1) | _bridging(tets, corners, sliding)
    barycentres = tets.mesh.vertices[corners[~chosen]].mean(axis=1)
    chosen[~chosen] = _between(barycentres, tets.anatomy, sliding, zone_mm=zone_mm)
    between = filler[chosen]
    if not len(between):
        return tets
    volumes = signed_volumes(tets.mesh.vertices, tets.mesh.tets[between])
    kept = np.ones(len(tets.mesh.tets), dtype=bool)
    kept[between] = False
    used = np.unique(tets.mesh.tets[kept])
    return replace(
        tets,
        mesh=TetMesh(tets.mesh.vertices[used], np.searchsorted(used, tets.mesh.tets[kept])),
        tissue_of_tet=tets.tissue_of_tet[kept],
        joint_space_tets=tets.joint_space_tets + len(between),
        joint_space_mm3=tets.joint_space_mm3 + float(volumes.sum()),
    )


def _bridging(tets: TetAnatomy, corners: Tets, sliding: SlidingBones) -> Bool:
    """Which tets have corners on bones of more than one group."""
    groups = np.zeros(len(corners), dtype=np.int64)
    for bones in sliding.groups:
        labels = [k for k, tissue in enumerate(tets.anatomy) if tissue.name in bones]
        on_bone = np.zeros(len(tets.mesh.vertices), dtype=bool)
        on_bone[tets.mesh.tets[np.isin(tets.tissue_of_tet, labels)]] = True
        groups += on_bone[corners].any(axis=1)
    return groups > 1


def _between(points: Points, anatomy: Anatomy, sliding: SlidingBones, *, zone_mm: float) -> Bool:
    """Which points, riding on one group, come between it and another group in one of the poses."""
    surfaces = [_joined(anatomy, bones) for bones in sliding.groups]
    found = np.zeros(len(points), dtype=bool)
    for k, own in enumerate(surfaces):
        close = _distances(points, own, up_to_mm=zone_mm)
        riding = np.flatnonzero(np.isfinite(close) & ~found)
        for pose in sliding.poses:
            carried = pose[sliding.groups[k][0]](points[riding])
            for j, other in enumerate(surfaces):
                if j != k:
                    back = pose[sliding.groups[j][0]].inverse()(carried)
                    found[riding] |= close[riding] + _distances(back, other, up_to_mm=zone_mm) <= zone_mm
    return found


def _joined(anatomy: Anatomy, bones: Sequence[str]) -> TriMesh:
    surfaces = [anatomy[bone].surface for bone in bones]
    offsets = np.cumsum([0, *(len(s.vertices) for s in surfaces[:-1])])
    return TriMesh(
        np.concatenate([s.vertices for s in surfaces]),
        np.concatenate([s.faces + offset for s, offset in zip(surfaces, offsets, strict=True)]),
    )


def _distances(points: Points, surface: TriMesh, *, up_to_mm: float) -> Float:
    """Distances from a surface, mm; infinite for points outside its box by more than ``up_to_mm``."""
    low, high = surface.vertices.min(axis=0) - up_to_mm, surface.vertices.max(axis=0) + up_to_mm
    near = ((points >= low) & (points <= high)).all(axis=1)
    distances = np.full(len(points), np.inf)
    if near.any():
        distances[near] = nearest_places(points[near], surface).distances
    return np.where(distances <= up_to_mm, distances, np.inf)
