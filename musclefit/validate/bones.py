"""Whether bones collide on the way to a pose.

Rest anatomy and rigid motions -> what they share, and how far they can go.

A collision is judged by how deep two bones are in each other, and by how much of the smaller bone that takes, beyond
what they share at rest; both limits go by the size of the smaller bone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.errors import MeshError
from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import DistanceTree
from musclefit.geometry.queries.solids import (
    Solid,
    candidate_pairs,
    moved_solid,
    samples_of,
    shared_solid,
    solid_of,
    solid_outside,
    surface_of,
)
from musclefit.geometry.rigid import RigidMotion
from musclefit.validate.model import BoneOverlap

DEPTH_SHARE = 0.07
"""Bones collide when they are deeper in each other than this share of the smaller one's size, the edge of a cube of
its volume: 0.5 mm for a distal phalanx of 390 mm³."""

DEPTH_MOST_MM = 0.6
"""And at any size when they are deeper in each other than this, mm.

A scan's voxel is 0.5 to 1 mm and a fitted axis is off by as much, so that bones of an anatomy that is right touch a
little; but the cartilage that should be between them does not grow with the length of a bone: where two long bones
are 1 mm in each other, the joint has no gap left anywhere near.
"""

VOLUME_SHARE = 0.0025
"""Bones collide when they share more than this part of the smaller one's volume: what a broad contact of small depth
takes. 1 mm³ for that phalanx, 100 mm³ for a radius."""

STEP_DEG = 3.0
"""Bones are tested whenever a joint has turned this far on the way."""

TRAVEL_MM = 4.0
"""And oftener, where the parts of two bones that may meet go farther than this past each other."""

RESOLUTION_DEG = 0.1
"""How finely the last feasible pose is found, by joint angle."""

RESOLUTION = 1e-3
"""And as a fraction of the way."""

SAMPLES = 2000
"""Places of a shared volume at which its depth is measured, about."""

SPACING_SHARE = 0.2
"""How far apart these are, as a share of the limit of depth, as far as ``SAMPLES`` allows."""

_ARC = 1.1
"""Boxes of bones on their way grow by this, for the arc beyond its chord."""

Motions = Mapping[str, RigidMotion]
Pair = tuple[str, str]


@dataclass(frozen=True, eq=False, slots=True)
class RigidBones:
    """Bones prepared for many poses; made by `rigid_bones`.

    Parameters
    ----------
    solids : mapping of bone name to Solid
        At rest.
    hulls : mapping of bone name to (n, 3) float64, mm
        Corners of its convex hull, which tell its box in any pose.
    distances : mapping of bone name to DistanceTree
    refused : mapping of bone name to the reason why its surface is not a solid
    at_rest : dict
        What pairs share at rest, as far as it was asked.
    known : dict
        What pairs share in relative poses that were asked already.
    """

    solids: Mapping[str, Solid]
    hulls: Mapping[str, Points]
    distances: Mapping[str, DistanceTree]
    refused: Mapping[str, str] = field(default_factory=dict)
    at_rest: dict[Pair, Solid | None] = field(default_factory=dict)
    known: dict[tuple[Pair, bytes], BoneOverlap | None] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """The bones, in the anatomy's order."""
        return tuple(self.solids)

    def require_all(self) -> None:
        """Raise MeshError at the first bone that is not a solid."""
        for name, reason in self.refused.items():
            raise MeshError(f"bone {name!r} cannot be tested for running into others: {reason}")


@dataclass(frozen=True, slots=True)
class BoneCollision:
    """Two bones in one place on the way to a pose.

    Parameters
    ----------
    at : float
        The first fraction of the way, as far as it is resolved, at which bones are beyond a limit.
    feasible : float
        The largest fraction of the way before it at which none are.
    found : BoneOverlap
        The worst pair at ``at``.
    there : BoneOverlap or None
        The worst pair at the pose itself; None where bones that moved share nothing new there.
    """

    at: float
    feasible: float
    found: BoneOverlap
    there: BoneOverlap | None


def rigid_bones(anatomy: Anatomy, names: Collection[str]) -> RigidBones:
    """Prepare the bones of an anatomy that are among ``names``; one that is not a solid is kept with the reason."""
    solids, hulls, distances, refused = {}, {}, {}, {}
    for bone in anatomy.of_kind(TissueKind.BONE):
        if bone.name not in names:
            continue
        try:
            solid = solid_of(bone.surface)
        except MeshError as error:
            refused[bone.name] = str(error)
            continue
        solids[bone.name] = solid
        hulls[bone.name] = _hull(solid)
        distances[bone.name] = DistanceTree(bone.surface)
    return RigidBones(solids, hulls, distances, refused)


def shared_by_bones(bones: RigidBones, motions: Motions) -> tuple[BoneOverlap, ...]:
    """What bones that move differently share in a pose, the nearest to its limits first.

    Parameters
    ----------
    bones : RigidBones
    motions : mapping of bone name to RigidMotion

    Raises
    ------
    MeshError
        A shared volume that cannot be: the surface of a bone crosses itself or is locally inside out.
    """
    return _worst_first(_shared(bones, motions, pair) for pair in _near(bones, motions, motions))


def first_collision(
    bones: RigidBones, motions_at: Callable[[float], Motions], *, turn_deg: float
) -> BoneCollision | None:
    """The first collision on a way, and how far along it the bones can go.

    Parameters
    ----------
    bones : RigidBones
    motions_at : callable
        Motion of each bone at a fraction of the way.
    turn_deg : float
        By how much the joint that turns fastest would turn on the whole way at its pace.

    Returns
    -------
    BoneCollision or None
        Tested every ``STEP_DEG``, and wherever parts of two bones that may meet go ``TRAVEL_MM`` past each other.

    Raises
    ------
    MeshError
        As `shared_by_bones`.
    """
    count = max(1, math.ceil(turn_deg / STEP_DEG - 1e-9))
    before, motions = 0.0, motions_at(0.0)
    for number in range(1, count + 1):
        end = number / count
        after = motions_at(end)
        pairs = {pair: _substeps(bones, motions, after, pair) for pair in _near(bones, motions, after)}
        most = max(pairs.values(), default=1)
        for sub in range(1, most + 1):
            at = before + (end - before) * sub / most
            tested = pairs if sub == most else [pair for pair, steps in pairs.items() if steps > 1]
            there = after if sub == most else motions_at(at)
            found = _worst_first(_shared(bones, there, pair) for pair in tested)
            if found and found[0].collides:
                # Where all pairs were last found free: some were not tested since.
                return _narrowed(bones, motions_at, free=before, hit=(at, found[0]), turn_deg=turn_deg)
        before, motions = end, after
    return None


def _narrowed(
    bones: RigidBones,
    motions_at: Callable[[float], Motions],
    *,
    free: float,
    hit: tuple[float, BoneOverlap],
    turn_deg: float,
) -> BoneCollision:
    """The collision between a free and a colliding fraction of the way, found by bisection."""
    at, found = hit
    while (at - free) * turn_deg > RESOLUTION_DEG or at - free > RESOLUTION:
        middle = 0.5 * (free + at)
        worst = shared_by_bones(bones, motions_at(middle))
        if worst and worst[0].collides:
            at, found = middle, worst[0]
        else:
            free = middle
    there = shared_by_bones(bones, motions_at(1.0))
    return BoneCollision(at, free, found, there[0] if there else None)


def _near(bones: RigidBones, before: Motions, after: Motions) -> list[Pair]:
    """Pairs of bones that move differently and whose boxes meet on the way between two poses."""
    names = bones.names
    boxes = []
    for name in names:
        start, end = before[name](bones.hulls[name]), after[name](bones.hulls[name])
        grown = (_ARC - 1.0) * np.abs(end - start).max()
        low, high = np.minimum(start.min(axis=0), end.min(axis=0)), np.maximum(start.max(axis=0), end.max(axis=0))
        boxes.append(np.stack([low - grown, high + grown]))
    pairs = [(names[i], names[j]) for i, j in candidate_pairs(boxes)]
    return [(a, b) for a, b in pairs if not _together(after[a], after[b])]


def _substeps(bones: RigidBones, before: Motions, after: Motions, pair: Pair) -> int:
    """Into how many steps a pair's way between two poses is cut, so that nothing near goes past farther than allowed.

    What a rigid motion does to the box in which the two may meet, it does most to a corner.
    """
    a, b = pair
    start, end = (m[a].inverse() @ m[b] for m in (before, after))
    ways = np.stack([start(bones.hulls[b]), end(bones.hulls[b])]).reshape(-1, 3)
    low = np.maximum(bones.solids[a].box[0], ways.min(axis=0))
    high = np.minimum(bones.solids[a].box[1], ways.max(axis=0))
    if (low > high).any():
        return 1
    corners = np.stack(np.meshgrid(*np.stack([low, high], axis=1), indexing="ij"), axis=-1).reshape(-1, 3)
    travel = float(np.linalg.norm((end @ start.inverse())(corners) - corners, axis=1).max())
    return max(1, math.ceil(travel / TRAVEL_MM))


def _shared(bones: RigidBones, motions: Motions, pair: Pair) -> BoneOverlap | None:
    """What a pair shares, measured once for each relative pose: in the frame of the first bone."""
    a, b = pair
    relative = motions[a].inverse() @ motions[b]
    key = pair, np.round(np.hstack([relative.rotation, relative.translation[:, None]]), 9).tobytes()
    if key not in bones.known:
        try:
            bones.known[key] = _measured(bones, pair, relative)
        except MeshError as error:
            raise MeshError(f"bones {a!r} and {b!r}: {error}") from None
    return bones.known[key]


def _measured(bones: RigidBones, pair: Pair, relative: RigidMotion) -> BoneOverlap | None:
    a, b = pair
    first, second = bones.solids[a], bones.solids[b]
    shared = shared_solid(first, moved_solid(second, relative))
    if shared is None:
        return None
    if pair not in bones.at_rest:
        bones.at_rest[pair] = shared_solid(first, second)
    rest = bones.at_rest[pair]
    smaller = min(first.volume, second.volume)
    depth_limit = min(DEPTH_SHARE * float(np.cbrt(smaller)), DEPTH_MOST_MM)
    beyond, carried = _beyond(shared, rest, relative)
    depth = 0.0
    if beyond is not None:
        places = samples_of(beyond, spacing_mm=SPACING_SHARE * depth_limit, most=SAMPLES)
        below = np.maximum(bones.distances[a](places), bones.distances[b](relative.inverse()(places)))
        if carried is not None:
            below = np.minimum(below, DistanceTree(carried)(places))
        depth = float(below.max())
    return BoneOverlap(
        a,
        b,
        rest_mm3=0.0 if rest is None else rest.volume,
        posed_mm3=shared.volume,
        beyond_mm3=0.0 if beyond is None else beyond.volume,
        depth_mm=depth,
        beyond_limit_mm3=VOLUME_SHARE * smaller,
        depth_limit_mm=depth_limit,
    )


def _beyond(shared: Solid, rest: Solid | None, relative: RigidMotion) -> tuple[Solid | None, TriMesh | None]:
    """What is shared beyond the overlap at rest, and the surface of that overlap as it was carried along.

    Carried with the first bone or with the second, whichever explains more: a block that slides on while it stays as
    deep in a plank brings nothing new, and neither does a plank under a block.
    """
    if rest is None:
        return shared, None
    choices = [(solid_outside(shared, carried), carried) for carried in (rest, moved_solid(rest, relative))]
    beyond, carried = min(choices, key=lambda choice: 0.0 if choice[0] is None else choice[0].volume)
    return beyond, surface_of(carried)


def _worst_first(found: Iterable[BoneOverlap | None]) -> tuple[BoneOverlap, ...]:
    there = [overlap for overlap in found if overlap is not None]
    return tuple(sorted(there, key=lambda overlap: -overlap.share_of_limit))


def _hull(solid: Solid) -> Points:
    corners: Points = surface_of(Solid(solid.manifold.hull(), solid.box, solid.volume)).vertices
    return corners


def _together(a: RigidMotion, b: RigidMotion) -> bool:
    return bool(_off(a.rotation, b.rotation) < 1e-9 and _off(a.translation, b.translation) < 1e-9)


def _off(a: Float, b: Float) -> float:
    return float(np.abs(a - b).max())
