"""Curls of cubic B-spline vector potentials at the same points again and again, and their transposes, in vectors.

Four lattice points in a row along the last axis have their coefficients in a row, too: a point sees sixteen such runs.
Coefficients are (K, 4), the last of four 0, so that a run is sixteen numbers in a row, which are summed over the runs
before anything is summed along them. Points that do not see sixteen whole runs are left to `potentials`.
"""

from __future__ import annotations

import numpy as np

from musclefit.compiling import njit, threaded
from musclefit.fields.evaluation.lanes import INNER, WIDTH, load, load_from, store, store_from, zero
from musclefit.fields.evaluation.potentials import BLOCK, FAST, two_weights

PARTLY, NOT_AT_ALL = -1, -2
"""First row of a point that sees some of its 64 splines, or none."""

VECTORS = 16 // WIDTH
"""Of one run."""


@njit(cache=True)
def runs_seen(low, h, numbers, points, rows):
    """Write to ``rows`` (N, 16) int32 where each run of four coefficients begins that a point sees.

    The first of a point's rows is ``PARTLY`` or ``NOT_AT_ALL`` where it does not see all of its 64 splines.
    """
    shape = numbers.shape
    first = np.zeros(3, np.int64)
    for p in range(points.shape[0]):
        inside = True
        for axis in range(3):
            first[axis] = int(np.floor((points[p, axis] - low[axis]) / h)) - 1
            inside = inside and first[axis] >= 0 and first[axis] + 4 <= shape[axis]
        whole, some = inside, False
        for i in range(max(first[0], 0), min(first[0] + 4, shape[0])):
            for j in range(max(first[1], 0), min(first[1] + 4, shape[1])):
                for k in range(max(first[2], 0), min(first[2] + 4, shape[2])):
                    some = some or numbers[i, j, k] >= 0
                    whole = whole and numbers[i, j, k] >= 0
                if inside:
                    row = numbers[i, j, first[2]]
                    rows[p, 4 * (i - first[0]) + j - first[1]] = row
                    # Rows are numbered along the last axis.
                    whole = whole and numbers[i, j, first[2] + 3] == row + 3
        if not whole:
            rows[p, 0] = PARTLY if some else NOT_AT_ALL


@njit(inline="always")
def _products(point, low, h, w, d, across):
    """Weights w, d (3, 4) along the axes, and their products (16, 3) across the runs: w w, d w and w d."""
    for axis in range(3):
        u = (point[axis] - low[axis]) / h
        two_weights(u - np.floor(u), h, w[axis], d[axis])
    for i in range(4):
        for j in range(4):
            across[4 * i + j, 0] = w[0, i] * w[1, j]
            across[4 * i + j, 1] = d[0, i] * w[1, j]
            across[4 * i + j, 2] = w[0, i] * d[1, j]


@threaded(over="rows", each=BLOCK, fastmath=FAST, error_model=INNER["error_model"])
def curl_sum_of_runs(begin, end, low, h, rows, which, points, coefficients, out):
    """Add the curl of coefficients (K, 4) to ``out`` (N, 3) at points ``which`` (n,) of (N, 3), with rows (n, 16)."""
    w, d, across, sums = np.empty((3, 4)), np.empty((3, 4)), np.empty((16, 3)), np.empty((3 * VECTORS, WIDTH))
    by_axes = sums.reshape((3, 4, 4))
    for n in range(begin * BLOCK, min(len(rows), end * BLOCK)):
        p = which[n]
        _products(points[p], low, h, w, d, across)
        for v in range(VECTORS):
            both, first, second = zero(), zero(), zero()
            for m in range(16):
                seen = load_from(coefficients, 4 * np.intp(rows[n, m]) + v * WIDTH)
                both = both + seen * across[m, 0]
                first = first + seen * across[m, 1]
                second = second + seen * across[m, 2]
            store(sums, v, both)
            store(sums, VECTORS + v, first)
            store(sums, 2 * VECTORS + v, second)
        for k in range(4):
            wk, dk = w[2, k], d[2, k]
            out[p, 0] += wk * by_axes[2, k, 2] - dk * by_axes[0, k, 1]
            out[p, 1] += dk * by_axes[0, k, 0] - wk * by_axes[1, k, 2]
            out[p, 2] += wk * by_axes[1, k, 1] - wk * by_axes[2, k, 0]


@njit(fastmath=FAST, error_model=INNER["error_model"], cache=True)
def curl_spread_to_runs(low, h, rows, which, points, values, out):
    """Add to ``out`` (K, 4) what some points' values (N, 3) give: the transpose of `curl_sum_of_runs`."""
    w, d, across, parts = np.empty((3, 4)), np.empty((3, 4)), np.empty((16, 3)), np.zeros((3 * VECTORS, WIDTH))
    by_axes = parts.reshape((3, 4, 4))
    for n in range(len(rows)):
        p = which[n]
        _products(points[p], low, h, w, d, across)
        for k in range(4):
            wk, dk = w[2, k], d[2, k]
            by_axes[2, k, 2], by_axes[0, k, 1] = wk * values[p, 0], -dk * values[p, 0]
            by_axes[0, k, 0], by_axes[1, k, 2] = dk * values[p, 1], -wk * values[p, 1]
            by_axes[1, k, 1], by_axes[2, k, 0] = wk * values[p, 2], -wk * values[p, 2]
        for v in range(VECTORS):
            both, first, second = load(parts, v), load(parts, VECTORS + v), load(parts, 2 * VECTORS + v)
            for m in range(16):
                start = 4 * np.intp(rows[n, m]) + v * WIDTH
                given = both * across[m, 0] + first * across[m, 1] + second * across[m, 2]
                store_from(out, start, load_from(out, start) + given)


@njit(fastmath=FAST, cache=True)
def weighted_square(weights, values):
    """Sum over rows of (K, n) values of their squares, times (K,) weights."""
    total = 0.0
    for k in range(values.shape[0]):
        row = 0.0
        for i in range(values.shape[1]):
            row += values[k, i] * values[k, i]
        total += weights[k] * row
    return total


@njit(fastmath=FAST, cache=True)
def advance(values, along, length):
    """Add ``length`` times what is given along to (K, n) values."""
    for k in range(values.shape[0]):
        for i in range(values.shape[1]):
            values[k, i] += length * along[k, i]


@njit(fastmath=FAST, cache=True)
def turn(direction, weights, slope, share):
    """Make of the direction its share plus the weighted slope, all (K, n)."""
    for k in range(direction.shape[0]):
        for i in range(direction.shape[1]):
            direction[k, i] = weights[k] * slope[k, i] + share * direction[k, i]
