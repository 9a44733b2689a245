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
from musclefit.fields.enclosures.bernstein import derivative_matrix, value_matrix
from musclefit.fields.enclosures.solenoidal import ROUNDING, curvature_matrix
from musclefit.geometry.arrays import Float, Int, Points

GRADIENT, STRAIN, BEND, STRAIN_BEND = 0, 1, 2, 3
"""Ceilings of the gradient's Frobenius norm, of the strain's eigenvalues, of the Frobenius norm of the gradient's
derivatives, per mm, and of the eigenvalues of the strain's along any direction: no two gradients, and no two strains,
differ by more than that times their distance."""

KINDS = 4

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
        All ceilings: the cells' (4, m0, m1, m2), then those of wider and wider blocks.
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
        cells = np.zeros((KINDS, *sizes), dtype=np.float32)
        _fill_cells(low, spacing, numbers, coefficients, cells)
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
        """Add those over (B,) boxes to ``out`` (B, 4): see ``GRADIENT`` and the others."""
        _look_up(self.low, self.spacing_mm, self.flat, self.starts, self.shapes, centres, half_widths, out)


@njit(cache=True)
def _slab(numbers, coefficients, i, j, k, whole, flat, once, slab):
    """What the splines of one lattice point along the third axis bring to the cells (i, j) of the first two.

    Writes, for each component b of the potential and each pair of orders x and y of derivatives along these axes, the
    16 Bernstein coefficients along them to ``slab`` (3, 3, 3, 16); gives the largest coefficient, -1 where none is.
    """
    largest = -1.0
    flat[:, :] = 0.0
    if k < numbers.shape[2]:
        for p in range(4):
            for q in range(4):
                row = -1
                if 0 <= i - 3 + p < numbers.shape[0] and 0 <= j - 3 + q < numbers.shape[1]:
                    row = numbers[i - 3 + p, j - 3 + q, k]
                if row >= 0:
                    largest = max(largest, 0.0)
                    for b in range(3):
                        flat[b, 4 * p + q] = coefficients[row, b]
                        largest = max(largest, abs(coefficients[row, b]))
    if largest < 0.0:
        slab[:] = 0.0
        return largest
    for b in range(3):
        for x in range(3):
            for p in range(4):
                for q in range(4):
                    total = 0.0
                    for r in range(4):
                        total += whole[x, p, r] * flat[b, 4 * r + q]
                    once[4 * p + q] = total
            for y in range(3 - x):
                for p in range(4):
                    for q in range(4):
                        total = 0.0
                        for r in range(4):
                            total += whole[y, q, r] * once[4 * p + r]
                        slab[b, x, y, 4 * p + q] = total
    return largest


@njit(cache=True)
def _cell_hull(whole, slabs, k, hull):
    """(9, 64) Bernstein coefficients of the curl's gradient in a cell, from the slabs of its four points."""
    hull[:, :] = 0.0
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3  # curl_i = d_a Q_b - d_b Q_a
        for axis in range(3):
            for turn in range(2):
                along, of = (a, b) if turn == 0 else (b, a)
                x, y = int(axis == 0) + int(along == 0), int(axis == 1) + int(along == 1)
                sign, matrix, row = 1.0 - 2.0 * turn, whole[2 - x - y], hull[3 * i + axis]
                s0, s1 = slabs[(k + 1) % 4, of, x, y], slabs[(k + 2) % 4, of, x, y]  # of the points k - 3 to k
                s2, s3 = slabs[(k + 3) % 4, of, x, y], slabs[k % 4, of, x, y]
                for s in range(4):
                    w0, w1 = sign * matrix[s, 0], sign * matrix[s, 1]
                    w2, w3 = sign * matrix[s, 2], sign * matrix[s, 3]
                    for lane in range(16):
                        row[16 * s + lane] += w0 * s0[lane] + w1 * s1[lane] + w2 * s2[lane] + w3 * s3[lane]


@njit(cache=True)
def _largest(size, eight):
    """The largest of 64 numbers, eight at a time."""
    eight[:] = 0.0
    for start in range(0, 64, 8):
        for lane in range(8):
            eight[lane] = max(eight[lane], size[start + lane])
    return eight.max()


@njit(cache=True)
def _norms(hull, size, strained, eight, found):
    """The largest squares of the gradient's and the strain's Frobenius norm, and of those of their derivatives.

    These in units of the spacing: along an axis differences of neighbouring Bernstein coefficients span it, times
    the degree, 3.
    """
    size[:] = 0.0
    for row in range(9):
        for lane in range(64):
            size[lane] += hull[row, lane] * hull[row, lane]
    found[0] = _largest(size, eight)
    for lane in range(64):
        own = hull[0, lane] * hull[0, lane] + hull[4, lane] * hull[4, lane] + hull[8, lane] * hull[8, lane]
        d, e, f = hull[1, lane] + hull[3, lane], hull[2, lane] + hull[6, lane], hull[5, lane] + hull[7, lane]
        size[lane] = own + 0.5 * (d * d + e * e + f * f)
    found[1] = _largest(size, eight)
    found[2], found[3] = 0.0, 0.0
    for stride in (1, 4, 16):
        size[:], strained[:] = 0.0, 0.0
        for lane in range(64 - stride):
            to = lane + stride
            xx, yy, zz = hull[0, to] - hull[0, lane], hull[4, to] - hull[4, lane], hull[8, to] - hull[8, lane]
            xy, yx = hull[1, to] - hull[1, lane], hull[3, to] - hull[3, lane]
            xz, zx = hull[2, to] - hull[2, lane], hull[6, to] - hull[6, lane]
            yz, zy = hull[5, to] - hull[5, lane], hull[7, to] - hull[7, lane]
            own = xx * xx + yy * yy + zz * zz
            size[lane] = own + xy * xy + yx * yx + xz * xz + zx * zx + yz * yz + zy * zy
            d, e, f = xy + yx, xz + zx, yz + zy
            strained[lane] = own + 0.5 * (d * d + e * e + f * f)
        for last in range(3 * stride, 64, 4 * stride):  # those have no neighbour
            size[last : last + stride] = 0.0
            strained[last : last + stride] = 0.0
        found[2] += 9.0 * _largest(size, eight)
        found[3] += 9.0 * _largest(strained, eight)


@njit(cache=True)
def _whole_cell():
    """(3, 4, 4): Bernstein coefficients over a cell of unit width of a spline and its derivatives up to the second."""
    whole = np.zeros((3, 4, 4))
    value_matrix(0.0, 1.0, whole[0])
    derivative_matrix(0.0, 1.0, 1.0, whole[1])
    curvature_matrix(0.0, 1.0, 1.0, whole[2])
    return whole


@threaded(over="cells", axis=1)
def _fill_cells(begin, end, low, spacing, numbers, coefficients, cells):
    whole, slabs, largest = _whole_cell(), np.zeros((4, 3, 3, 3, 16)), np.zeros(4)
    flat, once, hull, found = np.zeros((3, 16)), np.zeros(16), np.zeros((9, 64)), np.zeros(4)
    size, strained, eight = np.zeros(64), np.zeros(64), np.zeros(8)
    unit = 1.0 / (spacing * spacing)
    for i in range(begin, end):
        for j in range(cells.shape[2]):
            largest[:] = -1.0
            slabs[:] = 0.0
            for k in range(cells.shape[3]):
                largest[k % 4] = _slab(numbers, coefficients, i, j, k, whole, flat, once, slabs[k % 4])
                most = largest.max()
                if most <= 0.0:
                    continue
                reach = 0.0
                for axis, cell in enumerate((i, j, k)):
                    start = low[axis] + (cell - 2) * spacing
                    reach = max(reach, abs(start), abs(start + spacing), abs(low[axis]))
                rounding = ROUNDING * most * (1.0 + 2.0 * reach / spacing)
                _cell_hull(whole, slabs, k, hull)
                _norms(hull, size, strained, eight, found)
                # 1.000001: of the norms, and of single precision.
                cells[0, i, j, k] = unit * (np.sqrt(found[0]) + 4.0 * rounding) * 1.000001
                cells[1, i, j, k] = unit * (np.sqrt(2.0 / 3.0 * found[1]) + 4.0 * rounding) * 1.000001
                cells[2, i, j, k] = unit * (np.sqrt(found[2]) + 24.0 * rounding) / spacing * 1.000001
                bend = np.sqrt(2.0 / 3.0 * found[3]) + 24.0 * rounding
                cells[3, i, j, k] = unit * bend / spacing * 1.000001


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
