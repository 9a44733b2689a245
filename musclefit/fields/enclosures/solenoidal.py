r"""Proved bounds of the gradients of curls of B-spline potentials over boxes, by the convex hull property.

D_i = eps_iab d_a Q_b, so the gradient's entry (i, k) is a signed sum of second derivatives of the potential, whose
B-spline coefficients are second differences over the spacing squared. As in `ffd_bounds` a box is cut at the knots of
all levels; inserting knots at the faces of such a part and raising degrees brings all entries and all levels into one
cubic Bernstein basis, and norms and largest eigenvalues, being convex, are largest at its coefficients. Each box comes
with a matrix that is added to the gradient everywhere: that of another field, whose own radius the caller adds.

Boxes with more than `MAX_PARTS` parts are bounded by given ceilings (`ceilings`), which are coarser.
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
from musclefit.fields.enclosures.eigenvalues import floor_of, norm_ceiling, widen_by_hull

MAX_PARTS = 27
"""A box that is cut into more parts than this by the knots is bounded by its ceiling."""

ROUNDING = 1e-12
"""Proved rounding of one entry of a gradient, in units of the largest coefficient over the spacing squared (fewer than
500 operations of 1.2e-16 each on second differences of at most 4 such units, twice); and, times coordinates over the
spacing, of its places (8 operations, each of which moves a third derivative of at most 8 such units per spacing,
twice).
"""


@njit(cache=True)
def _level(shapes, numbers_of, coefficients_of, level):
    """One level's numbers (n0, n1, n2), and the coefficients that they count in."""
    start = 0
    for before in range(level):
        start += shapes[before, 0] * shapes[before, 1] * shapes[before, 2]
    n0, n1, n2 = shapes[level]
    return numbers_of[start : start + n0 * n1 * n2].reshape(n0, n1, n2), coefficients_of


@njit(cache=True)
def curvature_matrix(t0, t1, h, out):
    """(4, 4): cubic Bernstein coefficients over [t0, t1] of the second derivative, from the spline's coefficients."""
    for row in range(4):
        t = t0 + (t1 - t0) * row / 3.0
        s = 1.0 - t
        out[row, 0], out[row, 1] = s / (h * h), (t - 2.0 * s) / (h * h)
        out[row, 2], out[row, 3] = (s - 2.0 * t) / (h * h), t / (h * h)


@njit(cache=True)
def _block(numbers, coefficients, cell, block):
    """Copy the coefficients that a cell sees to ``block`` (3, 64), 0 where there are none; gives the largest."""
    largest = 0.0
    block[:, :] = 0.0
    for i in range(4):
        for j in range(4):
            for k in range(4):
                p, q, r = cell[0] - 1 + i, cell[1] - 1 + j, cell[2] - 1 + k
                if 0 <= p < numbers.shape[0] and 0 <= q < numbers.shape[1] and 0 <= r < numbers.shape[2]:
                    row = numbers[p, q, r]
                    if row >= 0:
                        for c in range(3):
                            block[c, 16 * i + 4 * j + k] = coefficients[row, c]
                            largest = max(largest, abs(coefficients[row, c]))
    return largest


@njit(cache=True)
def _add_curl(b, x, y, z, column, hull):
    """Add the derivative x, y, z times along the axes of the potential's component b to the curl's gradient."""
    orders = (x, y, z)
    for turn in range(2):
        a = (b + 2 + 2 * turn) % 3  # the derivative that the curl takes
        i = (b + 1 + turn) % 3  # the curl's component
        sign = 1.0 - 2.0 * turn
        if orders[a] == 0:
            continue
        k = a  # the gradient's axis: what is left
        for axis in range(3):
            if orders[axis] - int(axis == a) > 0:
                k = axis
        for lane in range(64):
            hull[3 * i + k, lane] += sign * column[lane]


@njit(cache=True)
def _level_workspace():
    """What `_add_level` works in."""
    return (
        np.zeros((3, 64)),
        np.zeros(64),
        np.zeros(64),
        np.zeros(64),
        np.zeros((3, 3, 4, 4)),
        np.zeros(3, np.int64),
    )


@njit(cache=True)
def _add_level(low, h, numbers, coefficients, a0, a1, hull, work):
    """Add one level over a0..a1, mm, within one of its cells, to the Bernstein coefficients; gives its rounding."""
    block, once, twice, column, matrices, cell = work
    reach = 0.0
    for axis in range(3):
        u = (0.5 * (a0[axis] + a1[axis]) - low[axis]) / h
        if not -2.5 < u < numbers.shape[axis] + 1.5:
            return 0.0
        cell[axis] = int(np.floor(u))
        reach = max(reach, abs(a0[axis]), abs(a1[axis]), abs(low[axis]))
    largest = _block(numbers, coefficients, cell, block)
    if largest == 0.0:
        return 0.0
    for axis in range(3):
        t0 = min(max((a0[axis] - low[axis]) / h - cell[axis], 0.0), 1.0)
        t1 = min(max((a1[axis] - low[axis]) / h - cell[axis], t0), 1.0)
        value_matrix(t0, t1, matrices[0, axis])
        derivative_matrix(t0, t1, h, matrices[1, axis])
        curvature_matrix(t0, t1, h, matrices[2, axis])
    for b in range(3):
        for x in range(3):
            along_first(matrices[x, 0], block[b], once)
            for y in range(3 - x):
                z = 2 - x - y
                along_second(matrices[y, 1], once, twice)
                along_third(matrices[z, 2], twice, column)
                _add_curl(b, x, y, z, column, hull)
    return ROUNDING * largest / (h * h) * (1.0 + 2.0 * reach / h)


@njit(cache=True)
def _fill(hull, matrix):
    for row in range(9):
        hull[row, :] = matrix[row // 3, row % 3]


@njit(cache=True)
def _bound_box(
    lows, spacings, shapes, numbers_of, coefficients_of, added, centre, half, ceiling, strain, gradient, found
):
    """One box: writes the gradient at its centre, and the radius or the range of eigenvalues."""
    work = _level_workspace()
    low, high, knots, counts = np.zeros(3), np.zeros(3), np.zeros((3, MAX_KNOTS)), np.ones(3, np.int64)
    hull, parts, size = np.zeros((9, 64)), 1, 0.0
    for axis in range(3):
        slack = 1e-15 * (abs(centre[axis]) + half[axis])
        low[axis], high[axis] = centre[axis] - half[axis] - slack, centre[axis] + half[axis] + slack
        counts[axis] = knots_between(lows[:, axis], spacings, shapes[:, axis], low[axis], high[axis], knots[axis]) - 1
        parts *= max(counts[axis], 0)
        for k in range(3):
            size = max(size, abs(added[axis, k]))
    coarse = parts < 1 or parts > MAX_PARTS
    best, clear = np.full(2, -np.inf), np.zeros(64, np.bool_)
    a, b, own, worst = np.zeros(3), np.zeros(3), 0.0, 0.0
    # The gradient at the centre: a part of no size, all of whose coefficients are its value. It comes first in the same
    # loop, so that what adds the levels is compiled into this once.
    for part in range(-1, 0 if coarse else parts):
        rest = part
        for axis in range(3):
            if part < 0:
                a[axis], b[axis] = centre[axis], centre[axis]
            else:
                a[axis], b[axis] = knots[axis, rest % counts[axis]], knots[axis, rest % counts[axis] + 1]
                rest //= counts[axis]
        _fill(hull, added)
        rounding = 1e-15 * size
        for level in range(len(spacings)):
            numbers, coefficients = _level(shapes, numbers_of, coefficients_of, level)
            rounding += _add_level(lows[level], spacings[level], numbers, coefficients, a, b, hull, work)
        if part < 0:
            for row in range(9):
                gradient[row // 3, row % 3] = hull[row, 0]
            own = 3.0 * rounding
            worst = own
        else:
            worst = max(worst, own + 3.0 * rounding)
            widen_by_hull(hull, 3, gradient, strain, best, work[3], clear)
    if coarse:
        best[:] = norm_ceiling(gradient - added) + ceiling
        for side in range(2 if strain else 0):
            best[side] = ceiling - floor_of(added, 3, 1.0 - 2.0 * side)
    if strain:
        found[0], found[1] = best[0] + worst, best[1] + worst
    else:
        found[0], found[1] = max(best[0], 0.0) + worst, own


@threaded(over="centres")
def box_bounds(
    begin,
    end,
    lows,
    spacings,
    shapes,
    numbers_of,
    coefficients_of,
    added,
    centres,
    half_widths,
    ceilings,
    strain,
    gradients,
    found,
):
    """Bound the gradient or the strain of all levels, plus a matrix for each box, over boxes.

    ``numbers_of`` and ``coefficients_of`` hold all levels one after the other, the numbers counted through; ``added``
    is (B, 3, 3); ``ceilings`` (B,) are proved ones of all levels together, for large boxes. Writes the gradients at the
    centres (B, 3, 3), and (B, 2): proved radius and the rounding at the centre, or minus the lowest and plus the
    highest eigenvalue.
    """
    for box in range(begin, end):
        _bound_box(
            lows,
            spacings,
            shapes,
            numbers_of,
            coefficients_of,
            added[box],
            centres[box],
            half_widths[box],
            ceilings[box],
            strain,
            gradients[box],
            found[box],
        )
