"""The built-in limb's frames and joints: where the elbow and the forearm turn; it knows no surface.

World frame: x lateral, y anterior, z proximal, origin on the elbow's hinge in the middle of the trochlea and capitulum.
Forearm frame (u, v, w): u lateral, v anterior, w distal along the forearm, tilted laterally by the carrying angle.
"""

from __future__ import annotations

import numpy as np

from musclefit.geometry.arrays import Float, Points, frozen
from musclefit.geometry.rigid import RigidMotion

CARRYING_ANGLE_DEG = 7.0
"""Angle between the hinge's normal plane and the forearm, opening laterally."""

ELBOW_CENTRE: Points = frozen([0.0, 0.0, 0.0])
ELBOW_AXIS: Points = frozen([1.0, 0.0, 0.0])
"""Positive turns flex: they bring the hand forward (anterior) and up."""

MAX_FLEXION_DEG = 140.0
"""From rest (extended, supinated) up to this no bone meets another."""

ELBOW_LIMITS_DEG = (-5.0, 150.0)
FOREARM_LIMITS_DEG = (-90.0, 90.0)
"""A pose beyond these is refused; they are those of people, and the bones' own are wider (-8 to 151, -123 to 154)."""

CAPITULUM_CENTRE: Points = frozen([17.0, 0.0, 0.0])

_CARRY = np.deg2rad(CARRYING_ANGLE_DEG)
FOREARM_FRAME: Float = frozen(
    [[np.cos(_CARRY), 0.0, np.sin(_CARRY)], [0.0, 1.0, 0.0], [np.sin(_CARRY), 0.0, -np.cos(_CARRY)]]
)
"""Rows are the directions u, v, w in world coordinates (u, v, w is left-handed: w points distally)."""


def from_forearm(uvw: Points) -> Points:
    """World positions of (N, 3) or (3,) forearm coordinates, mm."""
    world: Points = np.asarray(uvw, dtype=np.float64) @ FOREARM_FRAME
    return world


ULNA_HEAD_CENTRE: Points = frozen(from_forearm(np.array([-2.0, -3.0, 236.0])))

FOREARM_CENTRE: Points = CAPITULUM_CENTRE
FOREARM_AXIS: Points = frozen(
    (CAPITULUM_CENTRE - ULNA_HEAD_CENTRE) / np.linalg.norm(CAPITULUM_CENTRE - ULNA_HEAD_CENTRE)
)
"""From the distal ulna head through the radial head to the capitulum's centre; positive turns pronate."""


def along_forearm_axis(distance_mm: float) -> Points:
    """The point of the forearm axis that far distal of the capitulum's centre."""
    point: Points = FOREARM_CENTRE - distance_mm * FOREARM_AXIS
    return point


def flexion(angle_deg: float) -> RigidMotion:
    """The elbow's motion by an angle."""
    return RigidMotion.about_axis(centre=ELBOW_CENTRE, axis=ELBOW_AXIS, angle_deg=angle_deg)


def pronation(angle_deg: float) -> RigidMotion:
    """The forearm's motion by an angle."""
    return RigidMotion.about_axis(centre=FOREARM_CENTRE, axis=FOREARM_AXIS, angle_deg=angle_deg)
