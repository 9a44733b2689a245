r"""Proved bounds of sums of cubic B-splines and their gradients over boxes, by the convex hull property.

On one cell the derivative along an axis is a tensor-product polynomial, quadratic along that axis and cubic along the
others, whose B-spline coefficients are differences of neighbours over the spacing. A box is cut at the knots of all
lattices. Inserting knots at the faces of such a part (the blossom; de Casteljau's algorithm) and raising the quadratic
degree to cubic gives all columns and all lattices in one Bernstein basis,
:math:`\nabla D(x) = \sum_{ijk} b_i b_j b_k M_{ijk}` with :math:`b \ge 0, \sum b = 1`, so that

.. math:: \|\nabla D(x) - G\|_2 \le \max_{ijk} \|M_{ijk} - G\|_2, \qquad
          \min_{ijk} \lambda_{\min}(\mathrm{sym}\, M_{ijk}) \le \lambda(\mathrm{sym}\, \nabla D(x))
          \le \max_{ijk} \lambda_{\max}(\mathrm{sym}\, M_{ijk}),

since norms and largest eigenvalues are convex. Boxes with more than `MAX_PARTS` parts are bounded column by
column by the differences themselves, which is coarser. The spectral norm is bounded by
:math:`\|M\|_2 \le (\mathrm{tr}\,(M^T M)^4)^{1/8}`, at most 15 % above it.

Every weight is a convex combination of its predecessors, so rounding is a small multiple of the largest coefficient
over the smallest spacing; it is added outwards, and so is what the gradient can change by over the rounding of places.

References
----------
L. Piegl, W. Tiller, The NURBS Book, 2nd ed. (1997), sections 3.3 and 5.2; L. Ramshaw, Blossoming (1987).
"""

from __future__ import annotations

import numpy as np

from musclefit.compiling import njit, threaded
from musclefit.fields.enclosures.bernstein import (
    MAX_KNOTS,
    along_first,
    along_second,
    along_third,
    derivative_matrix,
    knots_between,
    value_matrix,
)
from musclefit.fields.enclosures.eigenvalues import NORM_ROUNDING, floor_of, norm_ceiling, widen_by_hull
from musclefit.geometry.arrays import Float

MAX_PARTS = 125
"""A box that is cut into more parts than this by the knots gets the coarse bound."""

MAX_CELLS = 4096
"""Of a lattice: boxes that touch more are bounded by its steepest cell anywhere, so that none takes long."""

ROUNDING = 1e-13
"""Proved rounding, in units of the largest coefficient over the smallest spacing, of one entry of a derivative (fewer
than 200 operations of 1.2e-16 each); and, times coordinates over the spacing, of its places (8 operations, each of
which moves a second derivative of at most 4 such units per spacing), with a wide margin."""


@njit(cache=True)
def _block(lattices, level, n, cell, block):
    """Copy the coefficients that a cell sees to ``block``, 0 outside the lattice; gives the largest."""
    shape, start, coefficients = lattices[2][level], lattices[3][level], lattices[4]
    n0, n1, n2, depth = shape[0], shape[1], shape[2], 1 if n == 2 else 4
    largest = 0.0
    for i in range(4):
        for j in range(4):
            for k in range(depth):
                p, q, r = cell[0] - 1 + i, cell[1] - 1 + j, cell[2] - 1 + k
                if 0 <= p < n0 and 0 <= q < n1 and 0 <= r < n2:
                    place = start + ((p * n1 + q) * n2 + r) * n
                    for c in range(n):
                        value = coefficients[place + c]
                        block[c, i, j, k] = value
                        largest = max(largest, abs(value))
                else:
                    for c in range(n):
                        block[c, i, j, k] = 0.0
    return largest


@njit(cache=True)
def _cell_at(lattices, level, n, middle, cell):
    """Write the cell that holds a place to ``cell``; False beyond the lattice's reach."""
    cell[2] = 1
    for axis in range(n):
        u = (middle[axis] - lattices[0][level, axis]) / lattices[1][level, axis]
        if not -2.5 < u < lattices[2][level, axis] + 1.5:
            return False
        cell[axis] = int(np.floor(u))
    return True


@njit(cache=True)
def _gradient_at(lattices, linear, n, place, work, gradient):
    """Write the gradient at a place; gives its rounding."""
    block, weights, slopes, cell = work[0], work[1], work[2], work[3]
    depth, rounding, reach = 1 if n == 2 else 4, 0.0, 0.0
    for axis in range(n):
        reach = max(reach, abs(place[axis]))
    for c in range(n):
        for axis in range(n):
            gradient[c, axis] = linear[c, axis]
            rounding = max(rounding, 1e-15 * abs(linear[c, axis]))
    for level in range(len(lattices[3])):
        if not _cell_at(lattices, level, n, place, cell):
            continue
        largest = _block(lattices, level, n, cell, block)
        if largest == 0.0:
            continue
        weights[2, 0, 0], slopes[2, 0, 0] = 1.0, 0.0
        for axis in range(n):
            h = lattices[1][level, axis]
            t = min(max((place[axis] - lattices[0][level, axis]) / h - cell[axis], 0.0), 1.0)
            s = 1.0 - t
            w, d = weights[axis, 0], slopes[axis, 0]
            w[0], w[1] = s * s * s / 6.0, (4.0 + t * t * (3.0 * t - 6.0)) / 6.0
            w[2], w[3] = (4.0 + s * s * (3.0 * s - 6.0)) / 6.0, t * t * t / 6.0
            d[0], d[1], d[2], d[3] = -0.5 * s * s / h, t * (1.5 * t - 2.0) / h, s * (2.0 - 1.5 * s) / h, 0.5 * t * t / h
        for c in range(n):
            x, y, z = 0.0, 0.0, 0.0
            for i in range(4):
                for j in range(4):
                    row, slope = 0.0, 0.0
                    for k in range(depth):
                        row += weights[2, 0, k] * block[c, i, j, k]
                        slope += slopes[2, 0, k] * block[c, i, j, k]
                    x += slopes[0, 0, i] * weights[1, 0, j] * row
                    y += weights[0, 0, i] * slopes[1, 0, j] * row
                    z += weights[0, 0, i] * weights[1, 0, j] * slope
            gradient[c, 0] += x
            gradient[c, 1] += y
            if n == 3:
                gradient[c, 2] += z
        finest, corner = _scale(lattices, level, n)
        rounding += ROUNDING * largest / finest * (1.0 + (reach + corner) / finest)
    return n * rounding


@njit(cache=True)
def _scale(lattices, level, n):
    """Smallest spacing of a level, and the largest coordinate of its corner."""
    finest, corner = np.inf, 0.0
    for axis in range(n):
        finest = min(finest, lattices[1][level, axis])
        corner = max(corner, abs(lattices[0][level, axis]))
    return finest, corner


@njit(cache=True)
def _add_level(lattices, level, n, low, high, hull, work):
    """Add one level over low..high, mm, within one of its cells; gives the largest coefficient."""
    block, slopes, values, cell, lanes = work[0], work[1], work[2], work[3], work[4]
    corner, spacing = lattices[0][level], lattices[1][level]
    if not _cell_at(lattices, level, n, 0.5 * (low + high), cell):
        return 0.0
    largest = _block(lattices, level, n, cell, block)
    if largest == 0.0:
        return 0.0
    for axis in range(n):
        t0 = min(max((low[axis] - corner[axis]) / spacing[axis] - cell[axis], 0.0), 1.0)
        t1 = min(max((high[axis] - corner[axis]) / spacing[axis] - cell[axis], t0), 1.0)
        value_matrix(t0, t1, values[axis])
        derivative_matrix(t0, t1, spacing[axis], slopes[axis])
    third, third_slope, both, out = lanes[0], lanes[1], lanes[2], lanes[3]
    for c in range(n):
        coefficients = block[c].reshape(64)
        if n == 3:
            along_third(values[2], coefficients, third)
            along_third(slopes[2], coefficients, third_slope)
            along_second(values[1], third_slope, both)
            along_first(values[0], both, out)
            hull[3 * c + 2] += out
        else:  # one layer: every place along the third axis alike
            for r in range(64):
                third[r] = coefficients[r - r % 4]
        along_second(values[1], third, both)
        along_first(slopes[0], both, out)
        hull[3 * c] += out
        along_second(slopes[1], third, both)
        along_first(values[0], both, out)
        hull[3 * c + 1] += out
    return largest


@njit(cache=True)
def _hull(lattices, linear, n, low, high, hull, work):
    """Gradient coefficients (9, 64) of the whole field over a part that no knot cuts; gives its rounding."""
    rounding = 0.0
    for c in range(n):
        for axis in range(n):
            hull[3 * c + axis] = linear[c, axis]
            rounding = max(rounding, 1e-15 * abs(linear[c, axis]))
    reach = 0.0
    for axis in range(n):
        reach = max(reach, abs(low[axis]), abs(high[axis]))
    for level in range(len(lattices[3])):
        largest = _add_level(lattices, level, n, low, high, hull, work)
        if largest > 0.0:
            finest, corner = _scale(lattices, level, n)
            rounding += ROUNDING * largest / finest * (1.0 + (reach + corner) / finest)
    return n * rounding


def steepest_cells(coefficients: Float, spacing: Float) -> Float:
    """Squared lengths of differences of neighbouring coefficients over the spacing.

    Parameters
    ----------
    coefficients : (i, j, k, n) float64, mm
        One in the plane along the third axis.
    spacing : (3,) float64, mm

    Returns
    -------
    (3, i + 1, j + 1, k + 1) float64
        Along each axis, from the zeros ahead of the first coefficient on to those behind the last.
    """
    padded = np.pad(coefficients, ((1, 1), (1, 1), (1, 1), (0, 0)))
    found = []
    for axis in range(3):
        ahead = np.diff(padded, axis=axis) / spacing[axis]
        kept = tuple(slice(None) if k == axis else slice(-1) for k in range(3))
        found.append((ahead**2).sum(axis=3)[kept])
    return np.array(found)


@njit(cache=True)
def _steepest_of(squares, start, numbers, ranges):
    """The largest of the squares of a level (see `steepest_cells`) along one axis, over a range of cells."""
    worst = 0.0
    for i in range(ranges[0, 0], ranges[0, 1]):
        for j in range(ranges[1, 0], ranges[1, 1]):
            row = start + (i * numbers[1] + j) * numbers[2]
            for k in range(row + ranges[2, 0], row + ranges[2, 1]):
                worst = max(worst, squares[k])
    return worst


@njit(cache=True)
def _coarse_radius(lattices, coarse, n, low, high, centre):
    """Bound of the gradient's distance from ``centre``'s part of every level, from differences over whole cells."""
    squares, wholes, starts, sizes = coarse
    total, ranges, numbers = 0.0, np.zeros((3, 2), np.int64), np.zeros(3, np.int64)
    if len(wholes) != len(lattices[3]):  # no box was said to be wide
        return np.inf
    for level in range(len(lattices[3])):
        corner, spacing, shape = lattices[0][level], lattices[1][level], lattices[2][level]
        numbers[:] = shape + 1
        ranges[2, 0], ranges[2, 1] = 1, 2  # the only layer in the plane
        finest, square = np.inf, 0.0
        for axis in range(n):
            # One cell more on both sides than the box touches, so that no rounding of its place matters.
            first, last = (low[axis] - corner[axis]) / spacing[axis], (high[axis] - corner[axis]) / spacing[axis]
            reach = shape[axis] + 9.0
            ranges[axis, 0] = max(int(np.floor(min(max(first, -9.0), reach))) - 1, 0)
            ranges[axis, 1] = min(int(np.floor(min(max(last, -9.0), reach))) + 5, shape[axis] + 1)
            finest = min(finest, spacing[axis])
        cells = 1
        for axis in range(3):
            cells *= max(ranges[axis, 1] - ranges[axis, 0], 0)
        if cells == 0:
            continue
        each = numbers[0] * numbers[1] * numbers[2]
        for axis in range(n):
            worst = wholes[level, axis]
            if cells <= MAX_CELLS:
                worst = _steepest_of(squares, starts[level] + axis * each, numbers, ranges)
            square += worst
        total += np.sqrt(square) * NORM_ROUNDING + n * ROUNDING * sizes[level] / finest
    return total + norm_ceiling(centre)


@njit(cache=True)
def _work():
    return (
        np.zeros((3, 4, 4, 4)),
        np.zeros((3, 4, 4)),
        np.zeros((3, 4, 4)),
        np.zeros(3, np.int64),
        np.zeros((4, 64)),
        np.zeros(64, np.bool_),
    )


@threaded(over="centres")
def box_bounds(begin, end, lattices, coarse, linears, centres, half_widths, strain, gradients, found):
    """Bound the gradient or the strain of an affine part and all lattices over boxes.

    ``linears`` (1 or B, n, n) are the gradients of the affine part, one for all boxes or one for each; ``lattices`` are
    corners (L, 3), spacings (L, 3), shapes (L, 3), where each level's coefficients start (L,), and all coefficients one
    after the other; ``coarse`` are all levels' squared differences (`steepest_cells`) one after the other, the largest
    along each axis (L, 3), where each level's start (L,), and the levels' largest coefficients (L,), or empty arrays
    where no box is wide. Writes the gradients at the centres (B, n, n) and (B, 2): proved radius and the
    rounding of the gradient at the centre; or, for strain, minus the lowest and plus the highest eigenvalue.
    """
    n = centres.shape[1]
    for box in range(begin, end):
        work, hull = _work(), np.zeros((9, 64))
        linear = linears[min(np.int64(box), len(linears) - 1)]
        low, high, knots, counts = np.zeros(3), np.zeros(3), np.zeros((3, MAX_KNOTS)), np.ones(3, np.int64)
        centre = np.zeros((3, 3))
        own = _gradient_at(lattices, linear, n, centres[box], work, centre)
        gradients[box] = centre[:n, :n]
        parts = 1
        for axis in range(n):
            slack = 1e-15 * (abs(centres[box, axis]) + half_widths[box, axis])
            low[axis] = centres[box, axis] - half_widths[box, axis] - slack
            high[axis] = centres[box, axis] + half_widths[box, axis] + slack
            counts[axis] = (
                knots_between(
                    lattices[0][:, axis], lattices[1][:, axis], lattices[2][:, axis], low[axis], high[axis], knots[axis]
                )
                - 1
            )
            parts *= max(counts[axis], 0)
        best, rounding = np.full(2, -np.inf), own
        if parts < 1 or parts > MAX_PARTS:
            difference = np.zeros((3, 3))
            difference[:n, :n] = centre[:n, :n] - linear
            radius = _coarse_radius(lattices, coarse, n, low, high, difference)
            best[:] = radius
            if strain:
                best[0] = radius - floor_of(centre, n, 1.0)
                best[1] = radius - floor_of(centre, n, -1.0)
        else:
            a, b = np.zeros(3), np.zeros(3)
            for part in range(parts):
                rest = part
                for axis in range(n):
                    a[axis], b[axis] = knots[axis, rest % counts[axis]], knots[axis, rest % counts[axis] + 1]
                    rest //= counts[axis]
                rounding = max(rounding, own + _hull(lattices, linear, n, a, b, hull, work))
                widen_by_hull(hull, n, centre, strain, best, work[4][0], work[5])
        if strain:
            found[box, 0], found[box, 1] = best[0] + rounding, best[1] + rounding
        else:
            found[box, 0], found[box, 1] = max(best[0], 0.0) + rounding, own
