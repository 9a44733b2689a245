"""Convex domains around bodies: boxes with bevelled edges and corners, and the cells that cover them."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Self

import numpy as np

from musclefit.geometry.arrays import Bool, Float, Points, frozen

SLACK = 1e-9
"""Of a domain's extent: how far its sides stand off what they must hold, so that rounding cannot cut anything off."""


@dataclass(frozen=True, eq=False, slots=True)
class Hull:
    """All x with ``directions @ x <= limits``: 26 sides in space, 8 in the plane.

    Parameters
    ----------
    directions : (k, n) float64
        Entries 0, 1 and -1.
    limits : (k,) float64, mm
    low, high : (n,) float64, mm
        Its bounding box.
    """

    directions: Float
    limits: Float
    low: Float
    high: Float

    @classmethod
    def around(cls, points: Points, radii: Float) -> Self:
        """The smallest one around (N, n) balls, a little enlarged."""
        n = points.shape[1]
        directions = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=n) if any(d)])
        lengths = np.sqrt((directions**2).sum(axis=1))
        limits = (points @ directions.T + radii[:, None] * lengths).max(axis=0)
        axes = np.eye(n)
        high = np.array([limits[(directions == axis).all(axis=1)][0] for axis in axes])
        low = -np.array([limits[(directions == -axis).all(axis=1)][0] for axis in axes])
        slack = SLACK * (1.0 + float(np.abs([low, high]).max()))
        return cls(frozen(directions), frozen(limits + n * slack), frozen(low - slack), frozen(high + slack))

    def contains(self, points: Points) -> Bool:
        """(N,) which points lie in it."""
        within: Bool = np.less_equal(points @ self.directions.T, self.limits)
        return np.logical_and.reduce(within, axis=1)  # type: ignore[no-any-return]

    def holds_balls(self, points: Points, radii: Float) -> Bool:
        """(N,) which balls lie in it as a whole."""
        lengths = np.sqrt((self.directions**2).sum(axis=1))
        farthest = points @ self.directions.T + radii[:, None] * lengths
        within: Bool = np.less_equal(farthest, self.limits)
        return np.logical_and.reduce(within, axis=1)  # type: ignore[no-any-return]

    def meets(self, centres: Points, half_widths: Float) -> Bool:
        """(B,) which boxes may have a point in it; only boxes that no single side holds out."""
        nearest = centres @ self.directions.T - half_widths @ np.abs(self.directions).T
        near: Bool = np.less_equal(nearest, self.limits)
        return np.logical_and.reduce(near, axis=1)  # type: ignore[no-any-return]

    def cells(self, count: int) -> tuple[Points, Float]:
        """About ``count`` boxes, nearly cubes, that cover it: centres and half widths."""
        centres, halves = box_cells(self.low, self.high - self.low, count)
        kept = self.meets(centres, halves)
        return centres[kept], halves[kept]


def box_cells(low: Float, extent: Float, count: int) -> tuple[Points, Float]:
    """About ``count`` boxes, nearly cubes, that an axis-aligned box is cut into: centres and half widths, mm."""
    side = (float(np.prod(extent)) / count) ** (1.0 / len(extent))
    pieces = np.maximum(np.ceil(extent / side).astype(int), 1)
    half = 0.5 * extent / pieces
    axes = [low[k] + half[k] * (2 * np.arange(pieces[k]) + 1) for k in range(len(extent))]
    centres = np.stack([g.ravel() for g in np.meshgrid(*axes, indexing="ij")], axis=1)
    return centres, np.tile(half, (len(centres), 1))
