"""Proved ceilings of the gradients of curls of B-spline potentials: one for every cell of a lattice, and for blocks.

In one cell the gradient lies in the hull of its 64 Bernstein coefficients (`solenoidal_bounds`), so that its norm is at
most the largest of theirs. The strain of a field without divergence has no trace, so that no eigenvalue is larger than
the root of 2/3 of its Frobenius norm. Ceilings of blocks of 2, 4, 8... cells along each axis make it cheap to bound
large boxes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from musclefit.compiling import njit, threaded
from musclefit.fields.enclosures.solenoidal import add_level, level_workspace
from musclefit.geometry.arrays import Float, Int, Points

GRADIENT, STRAIN, BEND = 0, 1, 2
"""Ceilings of the gradient's Frobenius norm, of the strain's eigenvalues, and of the Frobenius norm of the gradient's
derivatives, per mm: no two gradients differ by more than that times their distance."""

KINDS = 3

LOOKED_AT = 4
"""Blocks along each axis that a box is looked up in at most; wider boxes take wider blocks."""


@dataclass(frozen=True, eq=False, slots=True)
class Ceilings:
    """Of one level's cells, and of blocks of 2, 4, 8... of them along each axis.

    The first cell along an axis is the one two before the lattice's first point: there the first spline begins.

    Parameters
    ----------
    low : (3,) float64, mm
        The lattice's first point.
    spacing_mm : float
    flat : (n,) float32
        All ceilings: the cells' (3, m0, m1, m2), then those of wider and wider blocks.
    starts : (h,) int64
        Where each of these begins.
    shapes : (h, 3) int64
        m0, m1, m2 of each.
    """

    low: Float
    spacing_mm: float
    flat: NDArray[np.float32]
    starts: Int
    shapes: Int

    @classmethod
    def of(cls, low: Float, spacing: float, *, numbers: NDArray[np.int32], coefficients: Points) -> Ceilings:
        """Of a level: see `PotentialLevel` for what it is given by."""
        sizes = tuple(n + 3 for n in numbers.shape)
        seen, cells = np.zeros(sizes, dtype=np.bool_), np.zeros((KINDS, *sizes), dtype=np.float32)
        _mark_cells(numbers, seen)
        _fill_cells(low, spacing, numbers, coefficients, seen, cells)
        pyramid = [cells]
        while max(pyramid[-1].shape[1:]) > 1:
            below = pyramid[-1]
            above = np.zeros((KINDS, *((m + 1) // 2 for m in below.shape[1:])), dtype=np.float32)
            _fill_blocks(below, above)
            pyramid.append(above)
        starts = np.cumsum([0, *(blocks.size for blocks in pyramid[:-1])])
        shapes = np.array([blocks.shape[1:] for blocks in pyramid])
        return cls(low, spacing, np.concatenate([blocks.ravel() for blocks in pyramid]), starts, shapes)

    def add_over(self, centres: Points, half_widths: Float, out: Float) -> None:
        """Add those over (B,) boxes to ``out`` (B, 3): see ``GRADIENT``, ``STRAIN`` and ``BEND``."""
        _look_up(self.low, self.spacing_mm, self.flat, self.starts, self.shapes, centres, half_widths, out)


@njit(cache=True)
def _mark_cells(numbers, seen):
    """Cells in which some spline is not zero."""
    for i in range(numbers.shape[0]):
        for j in range(numbers.shape[1]):
            for k in range(numbers.shape[2]):
                if numbers[i, j, k] >= 0:
                    seen[i : i + 4, j : j + 4, k : k + 4] = True


@threaded(over="seen")
def _fill_cells(begin, end, low, spacing, numbers, coefficients, seen, cells):
    for i in range(begin, end):
        work, hull = level_workspace(), np.zeros((9, 64))
        a, b = np.zeros(3), np.zeros(3)
        for j in range(seen.shape[1]):
            for k in range(seen.shape[2]):
                if not seen[i, j, k]:
                    continue
                hull[:, :] = 0.0
                a[0], a[1], a[2] = low[0] + (i - 2) * spacing, low[1] + (j - 2) * spacing, low[2] + (k - 2) * spacing
                for axis in range(3):
                    b[axis] = a[axis] + spacing
                rounding = add_level(low, spacing, numbers, coefficients, a, b, hull, work)
                steepest, strained = 0.0, 0.0
                for lane in range(64):
                    whole, own = 0.0, 0.0
                    for row in range(9):
                        whole += hull[row, lane] * hull[row, lane]
                    for axis in range(3):
                        own += hull[4 * axis, lane] * hull[4 * axis, lane]
                    d, e = hull[1, lane] + hull[3, lane], hull[2, lane] + hull[6, lane]
                    f = hull[5, lane] + hull[7, lane]
                    steepest = max(steepest, whole)
                    strained = max(strained, own + 0.5 * (d * d + e * e + f * f))
                # 1.000001: of the norms, and of single precision.
                cells[0, i, j, k] = (np.sqrt(steepest) + 4.0 * rounding) * 1.000001
                cells[1, i, j, k] = (np.sqrt(2.0 / 3.0 * strained) + 4.0 * rounding) * 1.000001
                bend = _largest_step(hull, 16) + _largest_step(hull, 4) + _largest_step(hull, 1)
                cells[2, i, j, k] = (3.0 * np.sqrt(bend) + 24.0 * rounding) / spacing * 1.000001


@njit(cache=True)
def _largest_step(hull, stride):
    """The largest squared norm of the difference of neighbours along the axis of a stride.

    Of Bernstein coefficients these span the derivative along it, in units of the degree, 3, over the cell.
    """
    largest = 0.0
    for lane in range(64):
        if lane // stride % 4 == 3:
            continue
        size = 0.0
        for row in range(9):
            step = hull[row, lane + stride] - hull[row, lane]
            size += step * step
        largest = max(largest, size)
    return largest


@threaded(over="above", axis=1)
def _fill_blocks(begin, end, below, above):
    for i in range(begin, end):
        for which in range(KINDS):
            for j in range(above.shape[2]):
                for k in range(above.shape[3]):
                    largest = below[which, 2 * i, 2 * j, 2 * k]
                    for p in range(2 * i, min(2 * i + 2, below.shape[1])):
                        for q in range(2 * j, min(2 * j + 2, below.shape[2])):
                            for r in range(2 * k, min(2 * k + 2, below.shape[3])):
                                largest = max(largest, below[which, p, q, r])
                    above[which, i, j, k] = largest


@threaded(over="centres", least=64)
def _look_up(begin, end, low, spacing, flat, starts, shapes, centres, half_widths, out):
    for box in range(begin, end):
        first, last, most = np.zeros(3, np.int64), np.zeros(3, np.int64), 0
        beside, total = False, 0.0
        for axis in range(3):
            total += centres[box, axis] + half_widths[box, axis]
            size = abs(centres[box, axis]) + half_widths[box, axis] + abs(low[axis])
            slack = 1e-14 * (size / spacing + 1.0)
            u = (centres[box, axis] - half_widths[box, axis] - low[axis]) / spacing - slack
            v = (centres[box, axis] + half_widths[box, axis] - low[axis]) / spacing + slack
            beside = beside or not (v >= -2.0 and u <= shapes[0, axis] - 2.0)
            first[axis] = int(np.floor(min(max(u, -2.0), shapes[0, axis] - 3.0))) + 2
            last[axis] = int(np.floor(min(max(v, -2.0), shapes[0, axis] - 3.0))) + 2
            most = max(most, last[axis] - first[axis] + 1)
        if beside and np.isfinite(total):
            continue
        height = 0
        while most > LOOKED_AT and height + 1 < len(shapes):
            height += 1
            most = 0
            for axis in range(3):
                first[axis] >>= 1
                last[axis] >>= 1
                most = max(most, last[axis] - first[axis] + 1)
        m0, m1, m2 = shapes[height]
        for which in range(KINDS):
            largest = np.float32(0.0)
            for i in range(first[0], last[0] + 1):
                for j in range(first[1], last[1] + 1):
                    row = starts[height] + ((which * m0 + i) * m1 + j) * m2
                    for k in range(first[2], last[2] + 1):
                        largest = max(largest, flat[row + k])
            out[box, which] += largest
