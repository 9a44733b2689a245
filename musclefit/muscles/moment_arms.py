"""Moment arms of muscles from the straight lines between their attachments; knows joints, but no fibre and no map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from musclefit.geometry.rigid import RigidMotion
from musclefit.muscles.attachments import MuscleEnds

STEP_DEG = 1e-3
"""Half the interval of the central difference."""


class Joints(Protocol):
    """The rigid motion of every bone by its joints' angles."""

    def motions(self, pose: Mapping[str, float], /) -> Mapping[str, RigidMotion]:
        """Rest-to-pose motion of each bone by name; angles in degrees."""
        ...


@dataclass(frozen=True, slots=True)
class MomentArm:
    """How much shorter the line between a muscle's attachments gets as a joint turns, in one pose.

    ``moment_arm_mm`` is -dL/dθ, mm per radian; ``length_mm`` is L.
    """

    muscle: str
    coordinate: str
    angle_deg: float
    length_mm: float
    moment_arm_mm: float


def moment_arms(
    ends: Sequence[MuscleEnds], joints: Joints, *, pose: Mapping[str, float], coordinates: Sequence[str]
) -> tuple[MomentArm, ...]:
    """Moment arms of all muscles whose two ends are on bones that the joints know.

    The line is straight: where a muscle wraps around bone, its true moment arm is larger.

    Parameters
    ----------
    ends : sequence of MuscleEnds
    joints : Joints
    pose : mapping of coordinate to degrees
    coordinates : sequence of str
    """
    found = []
    here = joints.motions(pose)
    for name in coordinates:
        angle = pose.get(name, 0.0)
        before, after = (joints.motions({**pose, name: angle + step}) for step in (-STEP_DEG, STEP_DEG))
        for muscle in ends:
            if muscle.origin.bone in here and muscle.insertion.bone in here:
                change = _length(muscle, after) - _length(muscle, before)
                arm = -change / np.radians(2.0 * STEP_DEG)
                found.append(MomentArm(muscle.muscle, name, angle, _length(muscle, here), float(arm)))
    return tuple(found)


def _length(ends: MuscleEnds, motions: Mapping[str, RigidMotion]) -> float:
    one, other = (motions[end.bone](end.centroid_mm[None])[0] for _, end in ends.ends)
    return float(np.linalg.norm(other - one))
