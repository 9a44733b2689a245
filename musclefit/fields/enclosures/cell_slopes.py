r"""Takes compact radial sums of ever shorter support, gives proved bounds of the length of their gradients over boxes.

A box that is wide for a sum's support is enclosed badly by a value and a derivative at its centre: every source in it
counts. Here space is cut into cells once. On a cell the gradient of a sum is at most

.. math:: \sum_j |w_j| \, N_1(d_j)

with d_j the distance of source j from the cell and N_1 a falling majorant (see `majorants`); over a box it is at most
the largest of the cells that the box meets, which a pyramid of maxima finds at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from musclefit.compiling import njit
from musclefit.fields.enclosures.radial import RadialSum
from musclefit.fields.enclosures.source_terms import table_cell
from musclefit.fields.kernels import kernel_named
from musclefit.geometry.arrays import Float, Int, Points

CELLS_PER_SOURCE, FEWEST_CELLS, MOST_CELLS = 20, 20_000, 1_000_000
"""About so many cells fill the box around all supports."""

ROUNDING = 1.0 + 1e-9
"""Bounds are enlarged by this, far more than the rounding of sums of a million terms that are not negative."""

BLUR = 1e-12
"""Of the largest coordinates: so much nearer every source is taken to be than computed, and wider every box."""

WIDE = 4
"""Cells along each axis that a box meets at most on the level of the pyramid at which it is looked up."""


@dataclass(frozen=True, eq=False, slots=True)
class CellSlopes:
    """Proved bounds of |sum of gradients| of the last of several compact sums, cell by cell.

    Parameters
    ----------
    low : (3,) float64, mm
        Corner of the first cell; beyond the cells all sums are 0.
    width : float, mm
    levels : tuple of (n, x, y, z) float64
        Entry [k, cell] of the first bounds the spectral norm of the gradient of the sums from the k-th on, added; each
        further level holds the largest of 2 x 2 x 2 cells of the one before. The last has one cell.
    blur : float, mm
    """

    low: Points
    width: float
    levels: tuple[Float, ...]
    blur: float

    @classmethod
    def of(cls, sums: Sequence[RadialSum]) -> Self:
        """Bounds of compact sums in two or three dimensions, at least one of them with a centre."""
        centres = [_in_space(one.centres) for one in sums]
        widest = max(one.scale for one in sums)
        everywhere = np.concatenate(centres)
        low, high = everywhere.min(axis=0) - widest, everywhere.max(axis=0) + widest
        cells = min(max(CELLS_PER_SOURCE * len(everywhere), FEWEST_CELLS), MOST_CELLS)
        width = float(np.cbrt((high - low).prod() / cells))
        counts = np.ceil((high - low) / width * ROUNDING).astype(np.int64) + 1
        blur = BLUR * float(np.abs([low, high]).max())
        total = np.zeros((len(sums), *counts))
        for k in range(len(sums) - 1, -1, -1):
            if k + 1 < len(sums):
                total[k] = total[k + 1]
            known = kernel_named(sums[k].kernel).proved()
            sizes = np.linalg.norm(sums[k].weights, axis=1)
            extent = 1.0 if known.extent is None else known.extent
            _add(centres[k], sizes, sums[k].scale, extent, known.majorants[4], low, width, blur, total[k])
        levels = [total * ROUNDING]
        while max(levels[-1].shape[1:]) > 1:
            levels.append(_halved(levels[-1]))
        return cls(low, width, tuple(levels), blur)

    def over(self, centres: Points, half_widths: Float, first: Int) -> Float:
        """(B,) bounds over boxes (B, n) of the gradient of the sums from ``first`` (B,) on; 0 past the last of them."""
        centre, half = _in_space(centres), _in_space(np.asarray(half_widths, dtype=np.float64)) + self.blur
        found, shape = np.zeros(len(centre)), np.array(self.levels[0].shape[1:])
        inside = np.clip(np.stack([centre - half, centre + half]) - self.low, 0.0, self.width * shape)
        ends = np.minimum(
            np.floor(inside / self.width * np.array([1.0 - 1e-12, 1.0 + 1e-12])[:, None, None]), shape - 1
        )
        known = np.isfinite(ends).all(axis=(0, 2))
        found[~known] = np.inf
        cells = np.where(known[:, None], ends, 0.0).astype(np.int64)
        level = np.zeros(len(centre), dtype=np.int64)
        while True:
            spans = (cells[1] >> level[:, None]) - (cells[0] >> level[:, None])
            wide = (spans >= WIDE).any(axis=1)
            if not wide.any():
                break
            level[wide] += 1
        for number, bounds in enumerate(self.levels):
            rows = np.flatnonzero(known & (level == number) & (first < len(bounds)))
            from_, to, of = cells[0, rows] >> number, cells[1, rows] >> number, first[rows]
            for step in np.ndindex(WIDE, WIDE, WIDE):
                x, y, z = np.minimum(from_ + np.array(step), to).T
                found[rows] = np.maximum(found[rows], bounds[of, x, y, z])
        return found


def _in_space(points: Points) -> Points:
    return np.pad(points, ((0, 0), (0, 3 - points.shape[1])))


def _halved(bounds: Float) -> Float:
    """The largest of 2 x 2 x 2 cells; bounds are not negative."""
    odd = np.pad(bounds, [(0, 0), *((0, n % 2) for n in bounds.shape[1:])])
    k, x, y, z = odd.shape
    largest: Float = odd.reshape(k, x // 2, 2, y // 2, 2, z // 2, 2).max(axis=(2, 4, 6))
    return largest


@njit(cache=True, error_model="numpy")
def _add(
    centres: Points,
    sizes: Float,
    scale: float,
    extent: float,
    majorant: Float,
    low: Points,
    width: float,
    blur: float,
    total: Float,
) -> None:
    """Add the sources' bounds to every cell that their supports meet."""
    most = majorant.size - 1
    half = 0.5 * width
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    for j in range(sizes.size):
        for k in range(3):
            place = centres[j, k] - low[k]
            first[k] = max(int(np.floor((place - scale) / width)) - 1, 0)
            last[k] = min(int(np.floor((place + scale) / width)) + 1, total.shape[k] - 1)
        for x in range(first[0], last[0] + 1):
            dx = max(abs(low[0] + (x + 0.5) * width - centres[j, 0]) - half - 2.0 * blur, 0.0)
            for y in range(first[1], last[1] + 1):
                dy = max(abs(low[1] + (y + 0.5) * width - centres[j, 1]) - half - 2.0 * blur, 0.0)
                for z in range(first[2], last[2] + 1):
                    dz = max(abs(low[2] + (z + 0.5) * width - centres[j, 2]) - half - 2.0 * blur, 0.0)
                    away = np.sqrt(dx * dx + dy * dy + dz * dz) * (1.0 - 1e-12)
                    if away < scale:
                        total[x, y, z] += sizes[j] * majorant[table_cell(away, scale, extent, most)] / scale
