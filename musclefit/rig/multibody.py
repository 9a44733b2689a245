"""Bodies on joints with coordinates, as in OpenSim: coordinates in, the bodies' places out; knows no file.

Kinematics follow the documentation and source of OpenSim 4: a joint puts a frame fixed to its child at a turn and a
slide from a frame fixed to its parent; turns are taken about the axes one after the other, each in the frame that the
ones before it have turned; slides are along axes of the parent's frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.linalg import solve_banded
from scipy.spatial.transform import Rotation

from musclefit.errors import InputError
from musclefit.geometry.arrays import Float, frozen
from musclefit.geometry.rigid import RigidMotion

CoordinateFunction = Callable[[float], float]
"""What an axis does by a coordinate: radians or the model's lengths."""

GROUND = "ground"


class CoordinateKind(StrEnum):
    """What a coordinate's number is: an angle, a length, or a number that splines turn into both."""

    ROTATIONAL = "rotational"
    TRANSLATIONAL = "translational"
    COUPLED = "coupled"


@dataclass(frozen=True, slots=True)
class Linear:
    """slope x + offset."""

    slope: float = 1.0
    offset: float = 0.0

    def __call__(self, x: float) -> float:
        """The value at a coordinate."""
        return self.slope * x + self.offset


@dataclass(frozen=True, slots=True)
class Polynomial:
    """Coefficients of the highest power first."""

    coefficients: tuple[float, ...]

    def __call__(self, x: float) -> float:
        """The value at a coordinate."""
        return float(np.polyval(self.coefficients, x))


@dataclass(frozen=True, slots=True)
class Multiple:
    """Another function times a number."""

    factor: float
    of: CoordinateFunction

    def __call__(self, x: float) -> float:
        """The value at a coordinate."""
        return self.factor * self.of(x)


@dataclass(frozen=True, eq=False, slots=True)
class PiecewiseLinear:
    """Straight lines through (k,) points, the first and the last going on beyond the ends."""

    x: Float
    y: Float

    def __call__(self, x: float) -> float:
        """The value at a coordinate."""
        k = int(np.clip(np.searchsorted(self.x, x, side="right") - 1, 0, len(self.x) - 2))
        slope = (self.y[k + 1] - self.y[k]) / (self.x[k + 1] - self.x[k])
        return float(self.y[k] + slope * (x - self.x[k]))


@dataclass(frozen=True, eq=False, slots=True)
class SimmSpline:
    """The cubic spline of SIMM and OpenSim through (k,) points, straight beyond the ends.

    Its end conditions are not the natural ones: the third derivatives at the ends are those of the cubics through the
    four points there.

    References
    ----------
    G. Forsythe, M. Malcolm, C. Moler, Computer Methods for Mathematical Computations (1977), subroutine SPLINE.
    """

    x: Float
    y: Float
    b: Float
    c: Float
    d: Float

    @classmethod
    def through(cls, x: Float, y: Float) -> SimmSpline:
        """Fit the spline; two points are joined by a line."""
        n, h = len(x), np.diff(x)
        slopes = np.diff(y) / h
        if n < 3:
            return cls(x, y, np.repeat(slopes, 2), np.zeros(2), np.zeros(2))
        diagonal, right = np.empty(n), np.empty(n)
        diagonal[1:-1], right[1:-1] = 2.0 * (h[:-1] + h[1:]), np.diff(slopes)
        diagonal[0], diagonal[-1] = -h[0], -h[-1]
        right[0] = right[-1] = 0.0
        if n > 3:
            second = np.diff(slopes) / (x[2:] - x[:-2])
            right[0] = (second[1] - second[0]) * h[0] ** 2 / (x[3] - x[0])
            right[-1] = -(second[-1] - second[-2]) * h[-1] ** 2 / (x[-1] - x[-4])
        upper, lower = np.concatenate([[0.0], h]), np.concatenate([h, [0.0]])
        c = solve_banded((1, 1), np.stack([upper, diagonal, lower]), right)
        b = np.append(slopes - h * (c[1:] + 2.0 * c[:-1]), slopes[-1] + h[-1] * (c[-2] + 2.0 * c[-1]))
        d = np.append(np.diff(c) / h, (c[-1] - c[-2]) / h[-1])
        return cls(x, y, b, 3.0 * c, d)

    def __call__(self, x: float) -> float:
        """The value at a coordinate."""
        if x <= self.x[0] or x >= self.x[-1]:
            end = 0 if x <= self.x[0] else -1
            return float(self.y[end] + self.b[end] * (x - self.x[end]))
        k = int(np.searchsorted(self.x, x, side="right")) - 1
        t = x - self.x[k]
        return float(self.y[k] + t * (self.b[k] + t * (self.c[k] + t * self.d[k])))


@dataclass(frozen=True, eq=False, slots=True)
class JointAxis:
    """One turn or slide of a joint: how far along or about ``direction`` (3,), by a coordinate or ("") constant."""

    direction: Float
    coordinate: str
    function: CoordinateFunction

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction", frozen(self.direction))

    def amount(self, values: Mapping[str, float]) -> float:
        """How far, radians or the model's lengths."""
        return self.function(values[self.coordinate] if self.coordinate else 0.0)


def slide(axes: Sequence[JointAxis], values: Mapping[str, float]) -> Float:
    """(3,) the sum of what axes slide at coordinates' values, in the model's lengths."""
    way = np.zeros(3)
    for axis in axes:
        way = way + axis.amount(values) * axis.direction / np.linalg.norm(axis.direction)
    return way


@dataclass(frozen=True, eq=False, slots=True)
class BodyJoint:
    """A joint between two bodies.

    Parameters
    ----------
    name, parent, child : str
    in_parent, in_child : RigidMotion
        Places of the joint's two frames in those of the bodies, mm.
    turns, slides : tuple of JointAxis
    length_mm : float
        How many mm the model's unit of length is.
    """

    name: str
    parent: str
    child: str
    in_parent: RigidMotion
    in_child: RigidMotion
    turns: tuple[JointAxis, ...]
    slides: tuple[JointAxis, ...]
    length_mm: float

    def place(self, values: Mapping[str, float]) -> RigidMotion:
        """The place of the child in its parent, mm."""
        rotation = np.eye(3)
        for axis in self.turns:
            unit = axis.direction / np.linalg.norm(axis.direction)
            rotation = rotation @ Rotation.from_rotvec(axis.amount(values) * unit).as_matrix()
        way = self.length_mm * slide(self.slides, values)
        return self.in_parent @ RigidMotion(rotation, way) @ self.in_child.inverse()


@dataclass(frozen=True, slots=True)
class Coordinate:
    """A coordinate of a joint, radians or the model's lengths."""

    name: str
    joint: str
    kind: CoordinateKind
    default: float
    low: float
    high: float
    clamped: bool
    locked: bool


@dataclass(frozen=True, eq=False, slots=True)
class Coupler:
    """A constraint that sets one coordinate by a function of another."""

    name: str
    dependent: str
    independent: str
    function: CoordinateFunction


@dataclass(frozen=True, eq=False, slots=True)
class Multibody:
    """Bodies in a tree of joints.

    Parameters
    ----------
    joints : tuple of BodyJoint
        Each after the one that moves its parent.
    coordinates : mapping of name to Coordinate
    couplers : tuple of Coupler
    """

    joints: tuple[BodyJoint, ...]
    coordinates: Mapping[str, Coordinate]
    couplers: tuple[Coupler, ...] = ()

    @classmethod
    def of(
        cls,
        joints: Sequence[BodyJoint],
        coordinates: Mapping[str, Coordinate],
        couplers: Sequence[Coupler],
        *,
        source: str,
    ) -> Multibody:
        """Put the joints in order from the ground outwards.

        Raises
        ------
        InputError
            A body with two joints, or one that no chain of joints fixes to the ground.
        """
        ordered: list[BodyJoint] = []
        placed = {GROUND}
        left = list(joints)
        while left:
            ready = [joint for joint in left if joint.parent in placed]
            if not ready:
                raise InputError(
                    f"{source}: joint {left[0].name!r} hangs on body {left[0].parent!r}, which no chain of joints "
                    "fixes to the ground (a loop, or a name that is not there); correct its parent"
                )
            for joint in ready:
                if joint.child in placed:
                    raise InputError(f"{source}: body {joint.child!r} is the child of two joints; reverse one of them")
                placed.add(joint.child)
                ordered.append(joint)
                left.remove(joint)
        return cls(tuple(ordered), coordinates, tuple(couplers))

    @property
    def bodies(self) -> tuple[str, ...]:
        """Every body, from the ground outwards."""
        return tuple(joint.child for joint in self.joints)

    def values(self, given: Mapping[str, float]) -> dict[str, float]:
        """All coordinates: those given, else their defaults; coupled ones by what they follow."""
        values = {name: coordinate.default for name, coordinate in self.coordinates.items()} | dict(given)
        for _ in self.couplers:  # a coupler may follow another one's coordinate
            for coupler in self.couplers:
                values[coupler.dependent] = coupler.function(values[coupler.independent])
        return values

    def places(self, given: Mapping[str, float]) -> dict[str, RigidMotion]:
        """The place of each body in the ground's frame, mm.

        Parameters
        ----------
        given : mapping of coordinate to radians or the model's lengths
            Those left out have their defaults.
        """
        values = self.values(given)
        places = {GROUND: RigidMotion.identity()}
        for joint in self.joints:
            places[joint.child] = places[joint.parent] @ joint.place(values)
        return places

    def motions(self, given: Mapping[str, float]) -> dict[str, RigidMotion]:
        """The motion of each body in the ground's frame, mm, from the default pose."""
        rest, now = self.places({}), self.places(given)
        return {body: now[body] @ rest[body].inverse() for body in self.bodies}
