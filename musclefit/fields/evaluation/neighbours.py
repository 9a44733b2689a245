"""Sources sorted into cells as wide as a kernel's support; what a compact sum looks its neighbours up in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from musclefit.compiling import njit
from musclefit.geometry.arrays import Float, Int, Points

CELLS_PER_SOURCE, FEWEST_CELLS = 4, 32_768
"""How many cells there may be: a short support in a large body would make billions."""


@dataclass(frozen=True, eq=False, slots=True)
class Cells:
    """Sources by cell.

    Parameters
    ----------
    low : (3,) float64, mm
        Corner of the first cell.
    width : float, mm
        Edge of a cell; infinite when there is only one.
    counts : (3,) int64
        Cells along each axis; the last runs fastest.
    starts : (cells + 1,) int64
        Where each cell's sources start in ``order``.
    order : (m,) int64
        The sources, cell by cell.
    """

    low: Float
    width: float
    counts: Int
    starts: Int
    order: Int

    @classmethod
    def of(cls, sources: Points, *, width: float) -> Self:
        """Sort (m, 3) sources, mm, into cells of a width, mm, or wider ones where these would be too many to keep."""
        low = sources.min(axis=0)
        most = float(np.cbrt(CELLS_PER_SOURCE * len(sources) + FEWEST_CELLS))
        width = max(width, float(np.ptp(sources, axis=0).max()) / most)
        cell = np.floor((sources - low) / width).astype(np.int64)
        counts = cell.max(axis=0) + 1
        flat = np.ravel_multi_index(tuple(cell.T), tuple(counts))
        starts = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=int(counts.prod())))])
        return cls(low, width, counts, starts.astype(np.int64), np.argsort(flat, kind="stable"))

    @classmethod
    def single(cls, count: int) -> Self:
        """All of ``count`` sources in one cell that covers space."""
        return cls(np.zeros(3), np.inf, np.ones(3, np.int64), np.array([0, count]), np.arange(count))


@njit(inline="always")
def runs_around(x: float, y: float, z: float, low: Float, width: float, counts: Int, starts: Int, runs: Int) -> int:
    """Write the runs of sources in the 27 cells around a point to ``runs``; gives how many."""
    i, j = int(np.floor((x - low[0]) / width)), int(np.floor((y - low[1]) / width))
    k = int(np.floor((z - low[2]) / width))
    first, last = max(k - 1, 0), min(k + 1, counts[2] - 1)
    found = 0
    if first <= last:
        for p in range(max(i - 1, 0), min(i + 2, counts[0])):
            for q in range(max(j - 1, 0), min(j + 2, counts[1])):
                cell = (p * counts[1] + q) * counts[2]
                start, stop = starts[cell + first], starts[cell + last + 1]
                if start < stop:
                    runs[found, 0], runs[found, 1] = start, stop
                    found += 1
    return found
