"""How long the edges of a surface may be from place to place: short near given places, longer farther away."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.spatial import cKDTree

from musclefit.geometry.arrays import Float, Points

ENDLESS = 1e9
"""Distance from nothing, mm."""


@dataclass(frozen=True, eq=False)
class EdgeLengths:
    """The longest edge allowed at a place: ``near_mm``, and more by ``growth`` per mm of distance from given places.

    Parameters
    ----------
    near_mm : float
    places : (k, 3) float64, mm
        None: the length is the same everywhere, ``near_mm``.
    growth : float
    most_mm : float
        Nowhere longer.
    """

    near_mm: float
    places: Points
    growth: float
    most_mm: float

    @classmethod
    def even(cls, length_mm: float) -> Self:
        """The same everywhere."""
        return cls(length_mm, np.zeros((0, 3)), 0.0, length_mm)

    def at(self, points: Points) -> Float:
        """(N,) lengths at (N, 3) points, mm."""
        if not len(self.places):
            return np.full(len(points), self.near_mm)
        reach = (self.most_mm - self.near_mm) / self.growth if self.growth > 0.0 else 0.0
        apart = np.minimum(self._tree.query(points, distance_upper_bound=reach)[0], ENDLESS)
        return np.minimum(self.near_mm + self.growth * apart, self.most_mm)

    def scaled(self, factor: float) -> Self:
        """With all lengths ``factor`` times as long."""
        return replace(self, near_mm=factor * self.near_mm, growth=factor * self.growth, most_mm=factor * self.most_mm)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.places)
