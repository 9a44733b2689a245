"""Domains of any shape: the cells of a grid that hold the inside of a covered surface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from scipy import ndimage

from musclefit.certify.cell_counts import counts_before, counts_between
from musclefit.certify.domains import box_cells
from musclefit.geometry.arrays import Bool, Float, Int, Points

CELLS = 32
"""Along the longest side of a region."""

ROUNDING = 4e-16
"""Of the coordinates: how far a computed place may be off, and so what balls are widened by."""

EDGE_SHARE = 1e-6
"""Of a cell's edge: what lies so near a cell touches it."""


@dataclass(frozen=True, eq=False)
class Region:
    """A union of closed cells whose complement is connected: nothing in it is cut off from infinity.

    Parameters
    ----------
    low : (n,) float64, mm
        Corner of the grid.
    edge : float, mm
    inside : (i, j[, k]) bool
        The region's cells.
    """

    low: Float
    edge: float
    inside: Bool

    @classmethod
    def around(cls, points: Points, radii: Float, *, cells: int = CELLS) -> Self:
        """The cells that (N, n) balls, mm, touch, and all that those cut off from infinity.

        Whatever compact set has its boundary in the balls lies in the region: from a point of the complement a path
        leads to infinity that meets no ball.
        """
        n = points.shape[1]
        radii = radii + ROUNDING * n * np.abs(points).max(initial=0.0)
        lowest, highest = (points - radii[:, None]).min(axis=0), (points + radii[:, None]).max(axis=0)
        edge = max(float((highest - lowest).max()) / cells, 1e-300)
        low = lowest - 1.5 * edge
        counts = np.ceil((highest - low) / edge + 1.5).astype(int)
        first, last = _touched(points, radii, low, edge)
        filled = np.zeros(counts, dtype=bool)
        wide = (last - first).max(axis=1) > 2
        for a, b in zip(first[wide], last[wide], strict=True):
            filled[tuple(slice(i, j + 1) for i, j in zip(a, b, strict=True))] = True
        first, last = first[~wide], last[~wide]
        for offset in np.ndindex(*(3,) * n):
            filled[tuple(np.minimum(first + np.array(offset), last).T)] = True
        regions, _ = ndimage.label(~filled)
        return cls(low, edge, regions != regions[(0,) * n])

    def holds_balls(self, points: Points, radii: Float) -> Bool:
        """(N,) which balls lie in it as a whole: all cells that they touch are the region's."""
        held = np.isfinite(radii) & np.isfinite(points).all(axis=1)
        size = np.array(self.inside.shape)
        first, last = _touched(points[held], radii[held], self.low, self.edge)
        within = (first >= 0).all(axis=1) & (last < size).all(axis=1)
        counted = np.zeros(len(first), dtype=np.int64)
        counted[within] = self._count(first[within], last[within])
        held[held] = within & (counted == np.prod(last - first + 1, axis=1))
        return held

    def meets(self, centres: Points, halves: Float) -> Bool:
        """(B,) which boxes may have a point in it."""
        slack = EDGE_SHARE * self.edge
        first = np.floor((centres - halves - self.low - slack) / self.edge).astype(int)
        last = np.floor((centres + halves - self.low + slack) / self.edge).astype(int)
        size = np.array(self.inside.shape)
        first, last = np.clip(first, 0, size), np.clip(last, -1, size - 1)
        met: Bool = np.zeros(len(centres), dtype=bool)
        some = (first <= last).all(axis=1)
        met[some] = self._count(first[some], last[some]) > 0
        return met

    def boxes(self, count: int) -> tuple[Points, Float]:
        """About ``count`` cubes that cover its bounding box, those that meet it: centres and half widths."""
        centres, halves = box_cells(self.low, self.edge * np.array(self.inside.shape), count)
        kept = self.meets(centres, halves)
        return centres[kept], halves[kept]

    @property
    def bounds(self) -> tuple[Points, Points]:
        """Corners of the bounding box of its cells, mm."""
        cells = np.argwhere(self.inside)
        return self.low + self.edge * cells.min(axis=0), self.low + self.edge * (cells.max(axis=0) + 1)

    def _count(self, first: Int, last: Int) -> Int:
        """(N,) cells of the region between two cells, both included."""
        return counts_between(self._before, first, last)

    @cached_property
    def _before(self) -> Int:
        return counts_before(self.inside)


def _touched(points: Points, radii: Float, low: Float, edge: float) -> tuple[Int, Int]:
    slack = EDGE_SHARE * edge
    first = np.floor((points - radii[:, None] - low - slack) / edge).astype(int)
    last = np.floor((points + radii[:, None] - low + slack) / edge).astype(int)
    return first, last
