"""Do bones run into each other on the way to a pose? Rest anatomy and rigid motions -> the first collision."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.geometry.distances import nearest_places
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.solids import Solid, overlap_mesh, overlap_volume, solid_of

COLLISION_MM3 = 1.0
"""Bones collide when they share this much more volume than at rest."""


@dataclass(frozen=True, slots=True)
class BoneCollision:
    """Two bones in one place.

    ``at`` is the fraction of the way to the pose where they were first seen so; ``depth_mm`` is how deep the shared
    volume reaches from the surface of one bone into the other.
    """

    a: str
    b: str
    at: float
    volume_mm3: float
    depth_mm: float


def first_collision(anatomy: Anatomy, poses: Sequence[tuple[float, Mapping[str, RigidMotion]]]) -> BoneCollision | None:
    """The first pose at which bones that move differently share more volume than at rest, and its worst pair.

    Parameters
    ----------
    anatomy : Anatomy
        At rest.
    poses : sequence of (fraction of the way, motion of each bone)
        In order; between them nothing is tested.

    Returns
    -------
    BoneCollision or None
    """
    bones = [tissue for tissue in anatomy.of_kind(TissueKind.BONE) if all(tissue.name in m for _, m in poses)]
    rest = {bone.name: solid_of(bone.surface) for bone in bones}
    known: dict[tuple[str, str], float] = {}
    for at, motions in poses:
        solids = {bone.name: _moved(bone, motions) for bone in bones}
        found = [
            BoneCollision(
                a.name, b.name, at, volume, _depth(solids[a.name], solids[b.name], _moved_surface(b, motions))
            )
            for a, b in combinations(bones, 2)
            if not _together(motions[a.name], motions[b.name])
            and (volume := overlap_volume(solids[a.name], solids[b.name])) > COLLISION_MM3
            and volume > COLLISION_MM3 + _at_rest(rest, known, a.name, b.name)
        ]
        if found:
            return max(found, key=lambda collision: collision.volume_mm3)
    return None


def _at_rest(rest: Mapping[str, Solid], known: dict[tuple[str, str], float], a: str, b: str) -> float:
    if (a, b) not in known:
        known[a, b] = overlap_volume(rest[a], rest[b])
    return known[a, b]


def _moved_surface(bone: Tissue, motions: Mapping[str, RigidMotion]) -> Tissue:
    return bone.with_vertices(motions[bone.name](bone.surface.vertices))


def _moved(bone: Tissue, motions: Mapping[str, RigidMotion]) -> Solid:
    return solid_of(_moved_surface(bone, motions).surface)


def _depth(a: Solid, b: Solid, other: Tissue) -> float:
    """How far the shared volume reaches into ``other`` from its surface."""
    shared = overlap_mesh(a, b)
    return float(nearest_places(shared.vertices, other.surface).distances.max())


def _together(a: RigidMotion, b: RigidMotion) -> bool:
    return bool(np.abs(a.rotation - b.rotation).max() < 1e-9 and np.abs(a.translation - b.translation).max() < 1e-9)
