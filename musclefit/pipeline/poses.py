"""What a job's bones can do: on the way to its pose, in it, and joint by joint; a job in, refusals or records out."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.rigid import RigidMotion
from musclefit.rig.handles import BoneMotions
from musclefit.rig.job import Job
from musclefit.rig.joints import JointMotions
from musclefit.rig.paths import KeyframeMotions
from musclefit.validate.bones import (
    BoneCollision,
    RigidBones,
    first_collision,
    rigid_bones,
    shared_by_bones,
)
from musclefit.validate.joint_ranges import JointRange, joint_ranges
from musclefit.validate.model import BoneOverlap

PACES = 16
"""Places at which the pace of a way is taken."""

SAID = 0.01
"""Angles in degrees, and percent of a way, are said as multiples of this; feasible ones are rounded toward rest."""


def bones_of(job: Job) -> RigidBones:
    """The job's bones, ready to be tested in any pose.

    Raises
    ------
    InputError
        No joint drives it.
    MeshError
        A bone that is not a solid.
    """
    if job.motions is None:
        raise InputError(f"{job.source}: only bones that joints move can be tested for running into each other")
    bones = rigid_bones(job.anatomy, job.motions.at(0.0))
    bones.require_all()
    return bones


def collision_on_the_way(job: Job, bones: RigidBones) -> BoneCollision | None:
    """The first collision on the way to the job's pose, and how far the bones can go."""
    assert job.motions is not None  # bones_of has seen to it
    return first_collision(bones, job.motions.at, turn_deg=fastest_turn(job.motions))


def shared_in_the_pose(job: Job, bones: RigidBones) -> tuple[BoneOverlap, ...]:
    """What the job's bones share where their motions put them, the nearest to its limits first."""
    assert job.motions is not None
    return shared_by_bones(bones, job.motions.at(1.0))


def refuse_collision(job: Job, bones: RigidBones) -> None:
    """Raise InputError when bones collide on the way to the pose; it names them and the feasible pose."""
    found = collision_on_the_way(job, bones)
    if found is None:
        return
    raise InputError(
        f"{collision_in_words(job, found)}; {_left_out(job, found)}{_remedy(job)}, or let the bones deform "
        "(bones.rigid = false)"
    )


def _left_out(job: Job, found: BoneCollision) -> str:
    """The likely cause where one of the two is a bone that no joint knows."""
    still = () if job.joints is None else job.joints.still
    names = [name for name in (found.found.a, found.found.b) if name in still]
    return (
        f"no joint fixes or moves {names[0]!r}, so it stays where it is: name it there if it moves; " if names else ""
    )


def _remedy(job: Job) -> str:
    if job.joints is not None:
        return (
            "set drive.pose to that or to less, correct the joints (musclefit joint-range says how far each can turn)"
        )
    return "correct where the bones are sent, or the surfaces of these two"


def collision_in_words(job: Job, found: BoneCollision) -> str:
    """Bones, place on the way, true depth, and the largest feasible pose."""
    first, there = found.found, found.there
    words = (
        f"bones {first.a!r} and {first.b!r} collide at {pose_in_words(job, found.at)}: "
        f"{_overlap_in_words(first)} (allowed: {first.depth_limit_mm:.3g} mm and {first.beyond_limit_mm3:.3g} mm³)"
    )
    if there is None or not there.collides:
        words += "; in the pose itself they are clear of each other again"
    elif found.at < 1.0:
        same = {there.a, there.b} == {first.a, first.b}
        who = "they are" if same else f"{there.a!r} and {there.b!r} are"
        words += f"; in the pose itself {who} {_overlap_in_words(there)}"
    return f"{words}; the largest feasible pose on this way is {pose_in_words(job, found.feasible, toward_rest=True)}"


def pose_in_words(job: Job, at: float, *, toward_rest: bool = False) -> str:
    """The pose at a fraction of the way: joint by joint where joints turn evenly, else the fraction."""
    motions = job.motions
    if not isinstance(motions, JointMotions | KeyframeMotions):
        return f"{_said(100.0 * at, toward_rest)} % of the way"
    return ", ".join(f"{name} {_said(angle, toward_rest)} deg" for name, angle in motions.pose_at(at).items())


def _said(value: float, toward_rest: bool) -> str:
    """A number to ``SAID`` of a unit, never beyond itself where it is said toward rest."""
    steps = value / SAID
    return f"{(math.trunc(steps) if toward_rest else round(steps)) * SAID:.2f}".rstrip("0").rstrip(".")


def ranges_of(job: Job, *, posed_only: bool = False) -> tuple[JointRange, ...]:
    """How far each joint of a job can turn; of none where no joint drives it.

    Parameters
    ----------
    job : Job
    posed_only : bool
        Leave out joints that the job's pose does not turn.
    """
    if job.joints is None:
        return ()
    only = None
    if posed_only:
        only = tuple(name for name, degrees in job.pose if degrees)
    return joint_ranges(rigid_bones(job.anatomy, job.joints.bones()), job.joints, only=only)


def fastest_turn(motions: BoneMotions) -> float:
    """By how many degrees the bone that turns fastest would turn on the whole way at its pace."""
    poses = [motions.at(k / PACES) for k in range(PACES + 1)]
    return PACES * max((_angle_deg(b[name], a[name]) for a, b in pairwise(poses) for name in a), default=0.0)


def _overlap_in_words(overlap: BoneOverlap) -> str:
    return f"{overlap.depth_mm:.3g} mm deep, sharing {overlap.beyond_mm3:.3g} mm³" + (
        f" beyond the {overlap.rest_mm3:.3g} mm³ at rest" if overlap.rest_mm3 else ""
    )


def _angle_deg(a: RigidMotion, b: RigidMotion) -> float:
    """The angle between two rotations, well conditioned near none."""
    chord = float(np.linalg.norm(a.rotation - b.rotation)) / math.sqrt(8.0)
    return math.degrees(2.0 * math.asin(min(chord, 1.0)))
