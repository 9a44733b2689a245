"""How far can each joint turn before bones collide? Bones and joints -> a range for each coordinate."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from musclefit.errors import RigError
from musclefit.rig.joints import JointSystem
from musclefit.validate.bones import RESOLUTION_DEG, STEP_DEG, RigidBones, first_collision, shared_by_bones
from musclefit.validate.model import BoneOverlap

FULL_TURN_DEG = 180.0
"""How far a coordinate without a limit is tried either way."""


@dataclass(frozen=True, slots=True)
class RangeEnd:
    """Where a coordinate's range ends to one side.

    Parameters
    ----------
    degrees : float
    ended_by : str
        "bones" that collide, the "limit" stated for it, or "not met" as far as it was tried.
    beyond : BoneOverlap or None
        What ends it, ``STEP_DEG`` beyond; None where no bones do.
    """

    degrees: float
    ended_by: str
    beyond: BoneOverlap | None = None


@dataclass(frozen=True, slots=True)
class JointRange:
    """The free range of one coordinate, all others at rest.

    ``limits_deg`` are those stated for it, infinite where there are none; ``untested`` are bones that are not solids.
    """

    coordinate: str
    low: RangeEnd
    high: RangeEnd
    limits_deg: tuple[float, float]
    untested: tuple[str, ...] = ()


def joint_ranges(
    bones: RigidBones, joints: JointSystem, *, only: Collection[str] | None = None
) -> tuple[JointRange, ...]:
    """The free range of each coordinate that a pose may set, or of those in ``only``.

    Both ways from rest, the other coordinates at rest, up to the limits stated for it and at most ``FULL_TURN_DEG``;
    ends are found to ``RESOLUTION_DEG``, and at most short of the true end.

    Raises
    ------
    MeshError
        A shared volume that cannot be: the surface of a bone crosses itself or is locally inside out.
    """
    limits = {
        name: ends for joint in joints.joints for name, ends in zip(joint.coordinates, joint.limits_deg, strict=True)
    }
    return tuple(
        JointRange(
            name,
            _end(bones, joints, name, limits[name][0]),
            _end(bones, joints, name, limits[name][1]),
            limits[name],
            tuple(bones.refused),
        )
        for name in joints.coordinates
        if only is None or name in only
    )


def _end(bones: RigidBones, joints: JointSystem, coordinate: str, limit: float) -> RangeEnd:
    """Where the range ends on the side of a limit, which may be infinite; its sign tells the side."""
    if limit == 0.0:
        return RangeEnd(0.0, "limit")
    side = math.copysign(1.0, limit)
    target = _allowed(joints, coordinate, side * min(abs(limit), FULL_TURN_DEG))
    found = first_collision(bones, lambda t: joints.motions({coordinate: t * target}), turn_deg=abs(target))
    if found is None:
        untried = abs(limit) > FULL_TURN_DEG and abs(target) == FULL_TURN_DEG
        return RangeEnd(target, "not met" if untried else "limit")
    free = found.feasible * target
    past = free + side * min(STEP_DEG, abs(target - free))
    there = shared_by_bones(bones, joints.motions({coordinate: past}))
    return RangeEnd(free, "bones", there[0] if there and there[0].collides else found.found)


def _allowed(joints: JointSystem, coordinate: str, target: float) -> float:
    """How far toward ``target`` the joints let a coordinate go: a joint that follows it may have limits of its own."""
    if _is_allowed(joints, {coordinate: target}):
        return target
    free, refused = 0.0, target
    while abs(refused - free) > RESOLUTION_DEG:
        middle = 0.5 * (free + refused)
        if _is_allowed(joints, {coordinate: middle}):
            free = middle
        else:
            refused = middle
    return free


def _is_allowed(joints: JointSystem, pose: Mapping[str, float]) -> bool:
    try:
        joints.check_pose(pose)
    except RigError:
        return False
    return True
