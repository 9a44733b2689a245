"""Joints as values: hinge, universal, ball, screw and what follows them; knows neither tables nor their order."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.interpolate import PchipInterpolator

from musclefit.geometry.arrays import Float, Points, frozen
from musclefit.geometry.rigid import RigidMotion

DEGREES_PER_TURN = 360.0


class JointKind(StrEnum):
    """What a joint can do; the value is how tables name it."""

    HINGE = "hinge"
    UNIVERSAL = "universal"
    BALL = "ball"
    SCREW = "screw"


AXES: Mapping[JointKind, int] = {
    JointKind.HINGE: 1,
    JointKind.UNIVERSAL: 2,
    JointKind.BALL: 3,
    JointKind.SCREW: 1,
}
"""Axes, and so coordinates, of each kind."""


@dataclass(frozen=True, eq=False, slots=True)
class CoordinateCoupling:
    """A coordinate that another one sets: a ``fraction`` of it, or ``points_deg`` (k, 2) joined by monotone cubics.

    The points hold the angle of the other coordinate and the own one, rising in the first, with (0, 0) among them;
    beyond the ends the own angle stays what it is there.
    """

    to: str
    fraction: float
    points_deg: Float

    def angle(self, degrees: float) -> float:
        """The own angle where the other coordinate has this one, degrees."""
        if not len(self.points_deg):
            return self.fraction * degrees
        low, high = self.points_deg[0, 0], self.points_deg[-1, 0]
        return float(PchipInterpolator(*self.points_deg.T)(np.clip(degrees, low, high)))


@dataclass(frozen=True, eq=False, slots=True)
class Joint:
    r"""A joint, stated in the rest pose.

    Its motion is the product of the rotations about its axes by its coordinates,
    :math:`R_1(\theta_1) R_2(\theta_2) R_3(\theta_3)`, the last axis turned first, all through one centre; a screw also
    moves along its axis, by its pitch for each turn.

    Parameters
    ----------
    name : str
    kind : JointKind
    centre : (3,) float64, mm
        Any point of the axis; where the axes meet.
    axes : (n, 3) float64
        Directions; positive angles turn by the right-hand rule. Kept with length 1.
    coordinates : (n,) tuple of str
        What a pose calls them; a hinge's and a screw's is the joint's name.
    fixed : tuple of str
        The bones that carry the axes.
    moving : tuple of str
        Every bone that the joint moves, also those beyond the next joint.
    limits_deg : (n,) tuple of (low, high), degrees
        Infinite where a coordinate has none.
    pitch_mm_per_turn : float
    coupled : CoordinateCoupling or None
        What sets its coordinate in place of the pose.
    """

    name: str
    kind: JointKind
    centre: Points
    axes: Float
    coordinates: tuple[str, ...]
    fixed: tuple[str, ...]
    moving: tuple[str, ...]
    limits_deg: tuple[tuple[float, float], ...]
    pitch_mm_per_turn: float = 0.0
    coupled: CoordinateCoupling | None = None

    def __post_init__(self) -> None:
        axes = np.asarray(self.axes, dtype=np.float64).reshape(-1, 3)
        object.__setattr__(self, "centre", frozen(self.centre))
        object.__setattr__(self, "axes", frozen(axes / np.linalg.norm(axes, axis=1, keepdims=True)))

    @property
    def axis(self) -> Float:
        """The first axis."""
        direction: Float = self.axes[0]
        return direction

    def motion(self, degrees: Mapping[str, float]) -> RigidMotion:
        """The motion from rest by its coordinates, degrees; those left out are 0."""
        whole = RigidMotion.identity()
        for axis, coordinate in zip(self.axes, self.coordinates, strict=True):
            angle = float(degrees.get(coordinate, 0.0))
            turn = RigidMotion.about_axis(centre=self.centre, axis=axis, angle_deg=angle)
            along = self.pitch_mm_per_turn * angle / DEGREES_PER_TURN * axis
            whole = whole @ RigidMotion(turn.rotation, turn.translation + along)
        return whole


@dataclass(frozen=True, slots=True)
class Coupling:
    """A bone that turns by a fraction of a coordinate about its axis, as the patella follows the knee.

    The bone rides on whatever carries that axis. ``follows`` is a coordinate.
    """

    name: str
    follows: str
    fraction: float
    bone: str
