"""Control points of a lattice as a drive: where they rest, how they are moved, where the splines take them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musclefit.errors import RigError
from musclefit.geometry.arrays import Float, Points, frozen
from musclefit.rig.handles import Handles


@dataclass(frozen=True, eq=False, slots=True)
class ControlLattice:
    """Control points of a free-form deformation and their displacements, as the paper drives it.

    Parameters
    ----------
    low, high : (3,) float64, mm
        Corners of the box on whose faces the outermost control points lie.
    shape : three int
        Control points along each axis, at least 2.
    displacements : (K, 3) float64, mm
        Of the control points; the last axis runs fastest.

    Raises
    ------
    RigError
        A box without volume, fewer than two points along an axis, or another number of displacements.
    """

    low: Float
    high: Float
    shape: tuple[int, int, int]
    displacements: Points

    def __post_init__(self) -> None:
        low, high, moved = frozen(self.low), frozen(self.high), frozen(self.displacements)
        if not (low < high).all():
            raise RigError(
                f"drive.high_mm: found {high.tolist()}; every entry must be above that of low_mm, {low.tolist()}"
            )
        if min(self.shape) < 2:
            raise RigError(f"drive.shape: found {list(self.shape)}; give at least 2 control points along every axis")
        if moved.shape != (int(np.prod(self.shape)), 3):
            raise RigError(f"{len(moved)} displacements for a lattice of shape {list(self.shape)}")
        for name, value in (("low", low), ("high", high), ("displacements", moved)):
            object.__setattr__(self, name, value)

    def arrivals(self) -> Points:
        """(K, 3) places to which the free-form deformation takes the control points, mm.

        Not where they are moved to: cubic B-splines draw space towards a control point and do not meet it. Those of a
        point and its neighbours count 4/6 and 1/6 along each axis; beyond the lattice nothing is moved.
        """
        values = self.displacements.reshape(*self.shape, 3)
        for axis in range(3):
            padded = np.pad(values, [(1, 1) if k == axis else (0, 0) for k in range(4)])
            before, here, after = (np.take(padded, np.arange(s, s + self.shape[axis]), axis=axis) for s in range(3))
            values = (before + 4.0 * here + after) / 6.0
        return self.points() + values.reshape(-1, 3)

    def points(self) -> Points:
        """(K, 3) control points at rest, mm."""
        grid = np.indices(self.shape).reshape(3, -1).T
        return np.asarray(self.low + grid * (self.high - self.low) / (np.array(self.shape) - 1.0), dtype=np.float64)

    def handles(self) -> Handles:
        """The control points at rest as handles: ``control_0_0_0``, ``control_0_0_1``, ..."""
        names = tuple("control_{}_{}_{}".format(*index) for index in np.ndindex(self.shape))
        return Handles(names, self.points(), ("",) * len(names))
