"""Bernstein coefficients of uniform B-splines over parts of a cell: knot insertion at a part's ends, axis by axis.

Every row of weights is not negative and sums to 1, so that nothing cancels (L. Ramshaw, Blossoming, 1987).
"""

from __future__ import annotations

import numpy as np

from musclefit.compiling import njit

MAX_KNOTS = 128
"""Knots along one axis that are told apart; more make the box coarse."""


@njit(cache=True)
def _bernstein(t0, t1, degree, matrix):
    """Rows: Bernstein coefficients over [t0, t1] of a cell, from those over the whole cell; by blossoming."""
    work = np.empty(degree + 1)
    for column in range(degree + 1):
        for row in range(degree + 1):
            work[:] = 0.0
            work[column] = 1.0
            for r in range(degree):
                t = t1 if r < row else t0
                for s in range(degree - r):
                    work[s] = (1.0 - t) * work[s] + t * work[s + 1]
            matrix[row, column] = work[0]


@njit(cache=True)
def value_matrix(t0, t1, out):
    """(4, 4): Bernstein coefficients over [t0, t1] from cubic B-spline coefficients."""
    whole, part = np.zeros((4, 4)), np.empty((4, 4))
    whole[0, 0], whole[0, 1], whole[0, 2] = 1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0
    whole[1, 1], whole[1, 2] = 2.0 / 3.0, 1.0 / 3.0
    whole[2, 1], whole[2, 2] = 1.0 / 3.0, 2.0 / 3.0
    whole[3, 1], whole[3, 2], whole[3, 3] = 1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0
    _bernstein(t0, t1, 3, part)
    _product(part, whole, out)


@njit(cache=True)
def slope_matrix(t0, t1, out):
    """(4, 4): cubic Bernstein coefficients over [t0, t1] from a derivative's three quadratic B-spline coefficients.

    The last column is zero.
    """
    whole, part, raised, middle = np.zeros((3, 3)), np.empty((3, 3)), np.zeros((4, 3)), np.empty((3, 3))
    out[:, 3] = 0.0
    whole[0, 0], whole[0, 1], whole[1, 1], whole[2, 1], whole[2, 2] = 0.5, 0.5, 1.0, 0.5, 0.5
    raised[0, 0], raised[3, 2] = 1.0, 1.0
    raised[1, 0], raised[1, 1], raised[2, 1], raised[2, 2] = 1.0 / 3.0, 2.0 / 3.0, 2.0 / 3.0, 1.0 / 3.0
    _bernstein(t0, t1, 2, part)
    _product(part, whole, middle)
    _product(raised, middle, out[:, :3])


@njit(cache=True)
def derivative_matrix(t0, t1, spacing, out):
    """(4, 4): cubic Bernstein coefficients over [t0, t1] of the derivative, from the spline's own coefficients.

    By their three differences; each row's absolute values sum to at most 2 / spacing.
    """
    slopes = np.empty((4, 4))
    slope_matrix(t0, t1, slopes)
    for row in range(4):
        a, b, c = slopes[row, 0] / spacing, slopes[row, 1] / spacing, slopes[row, 2] / spacing
        out[row, 0], out[row, 1], out[row, 2], out[row, 3] = -a, a - b, b - c, c


@njit(cache=True)
def _product(a, b, out):
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            total = 0.0
            for k in range(a.shape[1]):
                total += a[i, k] * b[k, j]
            out[i, j] = total


@njit(cache=True)
def along_first(matrix, values, out):
    """Apply a (4, 4) matrix along the first axis of a (4, 4, 4) array, flat as all of them here."""
    for i in range(4):
        a, b, c, d = matrix[i, 0], matrix[i, 1], matrix[i, 2], matrix[i, 3]
        for r in range(16):
            out[16 * i + r] = a * values[r] + b * values[16 + r] + c * values[32 + r] + d * values[48 + r]


@njit(cache=True)
def along_second(matrix, values, out):
    """The same along the second axis."""
    for j in range(4):
        a, b, c, d = matrix[j, 0], matrix[j, 1], matrix[j, 2], matrix[j, 3]
        for i in range(4):
            for k in range(16 * i, 16 * i + 4):
                out[4 * j + k] = a * values[k] + b * values[4 + k] + c * values[8 + k] + d * values[12 + k]


@njit(cache=True)
def along_third(matrix, values, out):
    """The same along the third axis."""
    for r in range(0, 64, 4):
        a, b, c, d = values[r], values[r + 1], values[r + 2], values[r + 3]
        for k in range(4):
            out[r + k] = matrix[k, 0] * a + matrix[k, 1] * b + matrix[k, 2] * c + matrix[k, 3] * d


@njit(cache=True)
def knots_between(corners, spacings, counts, low, high, found):
    """Write low, the knots of all levels between along one axis, and high to ``found``; gives how many.

    ``corners``, ``spacings`` and ``counts`` are the levels' (L,) first lattice points, spacings and numbers of points
    along the axis. A knot that levels share counts once. Gives -1 when there are too many.
    """
    found[0] = low
    count = 1
    for level in range(len(spacings)):
        corner, h, points = corners[level], spacings[level], counts[level]
        first = max(int(np.floor(max((low - corner) / h, -3.0))), -2)
        last = min(int(np.ceil(min((high - corner) / h, points + 3.0))), points + 1)
        if last - first > MAX_KNOTS:
            return -1
        for k in range(first, last + 1):
            place = corner + k * h
            if low < place < high:
                if count + 1 >= len(found):
                    return -1
                at = count
                while found[at - 1] > place:  # in order; compiling a sort takes a second
                    found[at] = found[at - 1]
                    at -= 1
                found[at] = place
                count += 1
    found[count] = high
    kept = 1
    for k in range(1, count + 1):
        if found[k] > found[kept - 1]:
            found[kept] = found[k]
            kept += 1
    return max(kept, 2)  # a box of no width is one part
