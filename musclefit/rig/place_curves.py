"""Places that coordinates move within a frame, and where a map takes them, knot by knot; knows no file.

In OpenSim a moving path point is such a place, and so is a joint's frame in that of its parent where splines move it,
as in most knees: three functions of coordinates, each along an axis. Between the knots, what carries the place exactly
at them is a spline again, so that no other function has to take its place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from musclefit.geometry.arrays import Float, Points
from musclefit.rig.multibody import CoordinateFunction, JointAxis, Linear, Multiple, PiecewiseLinear, SimmSpline, slide


@dataclass(frozen=True, eq=False, slots=True)
class PlaceCurve:
    """A place by coordinates: how far it is along each axis, in lengths of ``length_mm``."""

    axes: tuple[JointAxis, ...]
    length_mm: float

    def at(self, values: Mapping[str, float]) -> Points:
        """(3,) the place at coordinates' values, mm."""
        return self.length_mm * slide(self.axes, values)

    def carried(
        self, move: Callable[[Points], Points], values: Mapping[str, float], *, editable: Sequence[bool]
    ) -> CarriedCurve:
        """The curve whose knots are where a map takes those of this one.

        A constant takes its value at the default; linear functions and polynomials stay.

        Parameters
        ----------
        move : callable
            (n, 3) places in this curve's frame to those in the frame where they go, mm.
        values : mapping of coordinate to value
            The default, at which a function's other coordinates are held.
        editable : sequence of bool
            Of each axis: whether its function may change.
        """
        directions = np.array([axis.direction / np.linalg.norm(axis.direction) for axis in self.axes]).T
        if directions.shape != (3, 3) or abs(np.linalg.det(directions)) < 1e-6:
            editable = [False] * len(self.axes)  # a place that goes off these axes cannot be stated along them
        asked = [
            [dict(values) | ({axis.coordinate: float(x)} if axis.coordinate else {}) for x in knots_of(axis, values)]
            if free
            else []
            for axis, free in zip(self.axes, editable, strict=True)
        ]
        poses = [pose for of_axis in asked for pose in of_axis]
        if not poses:
            return CarriedCurve(self, (False,) * len(self.axes), 0.0)
        meant = move(np.array([self.at(pose) for pose in poses]))
        along = np.linalg.solve(directions, meant.T).T / self.length_mm
        starts = np.cumsum([0, *map(len, asked)])
        axes = tuple(
            replace(axis, function=_through(axis.function, along[starts[k] : starts[k + 1], k])) if asked[k] else axis
            for k, axis in enumerate(self.axes)
        )
        made = replace(self, axes=axes)
        off = max(float(np.linalg.norm(made.at(pose) - place)) for pose, place in zip(poses, meant, strict=True))
        return CarriedCurve(made, tuple(bool(own) for own in asked), off)


@dataclass(frozen=True, eq=False, slots=True)
class CarriedCurve:
    """A curve that was carried, which of its functions changed, and how far it is from the map at all knots, mm."""

    curve: PlaceCurve
    changed: tuple[bool, ...]
    off_mm: float


def knots_of(axis: JointAxis, values: Mapping[str, float]) -> Float:
    """(k,) the coordinate's values between which a function interpolates; of a constant the default; else none."""
    function = axis.function
    while isinstance(function, Multiple) and function.factor:
        function = function.of
    if isinstance(function, (SimmSpline, PiecewiseLinear)) and axis.coordinate:
        return function.x
    if isinstance(function, Linear) and not function.slope:
        return np.array([values.get(axis.coordinate, 0.0)])
    return np.empty(0)


def stated_values(function: CoordinateFunction) -> Float:
    """(k,) what a function's own numbers are at its knots, within its factors."""
    if isinstance(function, Multiple):
        return stated_values(function.of)
    return function.y if isinstance(function, (SimmSpline, PiecewiseLinear)) else np.array([function(0.0)])


def _through(function: CoordinateFunction, y: Float) -> CoordinateFunction:
    """A function of the same kind, knots and factors with other values."""
    if isinstance(function, Multiple):
        return Multiple(function.factor, _through(function.of, y / function.factor))
    if isinstance(function, SimmSpline):
        return SimmSpline.through(function.x, y)
    return PiecewiseLinear(function.x, y) if isinstance(function, PiecewiseLinear) else Linear(0.0, float(y[0]))
