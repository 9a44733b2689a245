"""Fused, threaded sums of uniform cubic B-splines over a lattice; a plane is a lattice of one layer without depth.

Coefficients are (n0, n1, n2, components) and belong to the lattice points low + i spacing; what is outside the array is
zero, so that a sum is twice continuously differentiable in all of space. A point sees its 64 nearest coefficients
(16 in the plane). Sums are reassociated for speed; certificates use their own loops, which are not.
"""

from __future__ import annotations

import numpy as np

from musclefit.compiling import njit, threaded

FAST = {"reassoc", "contract", "arcp", "nsz"}
"""LLVM flags: reorder sums; NaN and infinity keep their meaning."""

BLOCK = 256


@njit(inline="always")
def _weights(t, w, d):
    """Values and derivatives (per lattice cell) of the four cubic B-splines over a cell at t in [0, 1]."""
    s = 1.0 - t
    w[0] = s * s * s / 6.0
    w[1] = (4.0 + t * t * (3.0 * t - 6.0)) / 6.0
    w[2] = (4.0 + s * s * (3.0 * s - 6.0)) / 6.0
    w[3] = t * t * t / 6.0
    d[0] = -0.5 * s * s
    d[1] = t * (1.5 * t - 2.0)
    d[2] = s * (2.0 - 1.5 * s)
    d[3] = 0.5 * t * t


@njit(inline="always")
def _place(x, low, spacing, count, flat, w, d):
    """Write the weights along one axis; gives the first coefficient (may be outside), and how many weights."""
    if flat:
        w[0], d[0] = 1.0, 0.0
        return 0, 1
    u = (x - low) / spacing
    if not (-2.0 <= u <= count + 1.0):
        return count, 4
    base = int(np.floor(u))
    _weights(u - base, w, d)
    return base - 1, 4


@njit(inline="always")
def _box(point, low, spacing, counts, flat, weights, slopes, box):
    """Weights along all axes and what a point sees: box[axis] = first, last + 1; False where it sees none."""
    for axis in range(3):
        if axis == 2 and flat:
            weights[2, 0], slopes[2, 0], box[2, 0], box[2, 1], box[2, 2] = 1.0, 0.0, 0, 1, 0
            continue
        u = (point[axis] - low[axis]) / spacing[axis]
        if not (-2.0 < u < counts[axis] + 1.0):
            return False
        base = int(np.floor(u))
        _weights(u - base, weights[axis], slopes[axis])
        box[axis, 2] = base - 1
        box[axis, 0], box[axis, 1] = max(base - 1, 0), min(base + 3, counts[axis])
    return True


@njit(inline="always")
def _is_inside(box):
    return box[0, 1] - box[0, 0] == 4 and box[1, 1] - box[1, 0] == 4 and box[2, 1] - box[2, 0] == 4


@njit(fastmath=FAST, cache=True)
def _rows_inside(flat_coefficients, box, weights, rows):
    """rows[0, 12] of a point that sees 64 coefficients of three components; of constant size, for the vector units."""
    start = 3 * box[2, 0]
    row = rows[0]
    for q in range(12):
        row[q] = 0.0
    for a in range(4):
        for b in range(4):
            weight = weights[0, a] * weights[1, b]
            line = flat_coefficients[box[0, 0] + a, box[1, 0] + b, start : start + 12]
            for q in range(12):
                row[q] += weight * line[q]


@njit(fastmath=FAST, cache=True)
def _rows_inside_with_slopes(flat_coefficients, box, weights, slopes, rows):
    """rows[0..2, 12]: the sum over two axes, and its derivatives along them."""
    start = 3 * box[2, 0]
    row, row_x, row_y = rows[0], rows[1], rows[2]
    for q in range(12):
        row[q] = 0.0
        row_x[q] = 0.0
        row_y[q] = 0.0
    for a in range(4):
        for b in range(4):
            weight = weights[0, a] * weights[1, b]
            along_x, along_y = slopes[0, a] * weights[1, b], weights[0, a] * slopes[1, b]
            line = flat_coefficients[box[0, 0] + a, box[1, 0] + b, start : start + 12]
            for q in range(12):
                value = line[q]
                row[q] += weight * value
                row_x[q] += along_x * value
                row_y[q] += along_y * value


@njit(fastmath=FAST, cache=True)
def _rows(coefficients, box, weights, slopes, rows):
    """The same for any number of components and at the lattice's edge; what a point does not see stays zero."""
    components = coefficients.shape[3]
    rows[:, :] = 0.0
    for i in range(box[0, 0], box[0, 1]):
        for j in range(box[1, 0], box[1, 1]):
            a, b = i - box[0, 2], j - box[1, 2]
            for k in range(box[2, 0], box[2, 1]):
                for c in range(components):
                    value, q = coefficients[i, j, k, c], (k - box[2, 2]) * components + c
                    rows[0, q] += weights[0, a] * weights[1, b] * value
                    rows[1, q] += slopes[0, a] * weights[1, b] * value
                    rows[2, q] += weights[0, a] * slopes[1, b] * value


@threaded(over="points", each=BLOCK, fastmath=FAST)
def spline_sum(begin, end, low, spacing, coefficients, points, out):
    """Add the sum at points (N, 2 or 3) to ``out`` (N, components)."""
    n, components = points.shape[0], coefficients.shape[3]
    flat, counts = points.shape[1] == 2, coefficients.shape[:3]
    lines = coefficients.reshape(counts[0], counts[1], counts[2] * components)
    for block in range(begin, end):
        weights, slopes, box = np.zeros((3, 4)), np.zeros((3, 4)), np.zeros((3, 3), np.int64)
        rows = np.zeros((3, 4 * components))
        for p in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            if not _box(points[p], low, spacing, counts, flat, weights, slopes, box):
                continue
            if components == 3 and _is_inside(box):
                _rows_inside(lines, box, weights, rows)
            else:
                _rows(coefficients, box, weights, slopes, rows)
            for c in range(components):
                total = 0.0
                for k in range(4):
                    total += weights[2, k] * rows[0, k * components + c]
                out[p, c] += total


@threaded(over="points", each=BLOCK, fastmath=FAST)
def spline_sum_with_gradient(begin, end, low, spacing, coefficients, points, out, gradients):
    """Add the sum to ``out`` (N, components) and its derivatives to ``gradients`` (N, components, 2 or 3)."""
    n, components = points.shape[0], coefficients.shape[3]
    flat, counts = points.shape[1] == 2, coefficients.shape[:3]
    lines = coefficients.reshape(counts[0], counts[1], counts[2] * components)
    for block in range(begin, end):
        weights, slopes, box = np.zeros((3, 4)), np.zeros((3, 4)), np.zeros((3, 3), np.int64)
        rows = np.zeros((3, 4 * components))
        for p in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            if not _box(points[p], low, spacing, counts, flat, weights, slopes, box):
                continue
            if components == 3 and _is_inside(box):
                _rows_inside_with_slopes(lines, box, weights, slopes, rows)
            else:
                _rows(coefficients, box, weights, slopes, rows)
            for c in range(components):
                value, x, y, z = 0.0, 0.0, 0.0, 0.0
                for k in range(4):
                    q = k * components + c
                    value += weights[2, k] * rows[0, q]
                    x += weights[2, k] * rows[1, q]
                    y += weights[2, k] * rows[2, q]
                    z += slopes[2, k] * rows[0, q]
                out[p, c] += value
                gradients[p, c, 0] += x / spacing[0]
                gradients[p, c, 1] += y / spacing[1]
                if not flat:
                    gradients[p, c, 2] += z / spacing[2]


@njit(cache=True)
def _pair_weights(x, y, low, spacing, window, flat, a, b, d, along):
    """Weights of the offsets -3..3 between the coefficients that two points see along one axis; gives their shift."""
    if flat:
        along[0] = 1.0
        return 0, 1
    count = window.size
    i, _ = _place(x, low, spacing, count, False, a, d)
    j, _ = _place(y, low, spacing, count, False, b, d)
    along[:] = 0.0
    for p in range(4):
        for q in range(4):
            if 0 <= i + p < count and 0 <= j + q < count:
                along[p - q + 3] += a[p] * window[i + p] * b[q] * window[j + q]
    return i - j - 3, 7


@threaded(over="points", least=16, fastmath=FAST)
def spline_gram(begin, end, low, spacing, window0, window1, window2, covariance, points, out):
    """Gram matrix (m, m) of the splines' values at (m, 2 or 3) points under a stationary covariance of coefficients.

    ``covariance`` is the table over offsets, with offset zero in its middle; offsets outside it have none. Every
    coefficient carries the product of its windows. The offsets of two points' coefficients collapse to 7 per axis.
    """
    flat = points.shape[1] == 2
    r0, r1, r2 = covariance.shape[0] // 2, covariance.shape[1] // 2, covariance.shape[2] // 2
    for p in range(begin, end):
        a, b, d = np.empty(4), np.empty(4), np.empty(4)
        along0, along1, along2 = np.empty(7), np.empty(7), np.empty(7)
        for q in range(p + 1):
            zp, zq = (0.0, 0.0) if flat else (points[p, 2], points[q, 2])
            s0, n0 = _pair_weights(points[p, 0], points[q, 0], low[0], spacing[0], window0, False, a, b, d, along0)
            s1, n1 = _pair_weights(points[p, 1], points[q, 1], low[1], spacing[1], window1, False, a, b, d, along1)
            s2, n2 = _pair_weights(zp, zq, low[2], spacing[2], window2, flat, a, b, d, along2)
            total = 0.0
            for i in range(max(0, -r0 - s0), min(n0, r0 - s0 + 1)):
                for j in range(max(0, -r1 - s1), min(n1, r1 - s1 + 1)):
                    inner = 0.0
                    for k in range(max(0, -r2 - s2), min(n2, r2 - s2 + 1)):
                        inner += along2[k] * covariance[i + s0 + r0, j + s1 + r1, k + s2 + r2]
                    total += along0[i] * along1[j] * inner
            out[p, q] = total
            out[q, p] = total


@njit(cache=True)
def spread(low, spacing, points, values, out):
    """Add every point's values (N, components) to the coefficients it sees, by their weights: the sum's transpose."""
    flat = points.shape[1] == 2
    n0, n1, n2 = out.shape[:3]
    wx, wy, wz, d = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    for p in range(points.shape[0]):
        i0, ni = _place(points[p, 0], low[0], spacing[0], n0, False, wx, d)
        j0, nj = _place(points[p, 1], low[1], spacing[1], n1, False, wy, d)
        k0, nk = _place(0.0 if flat else points[p, 2], low[2], spacing[2], n2, flat, wz, d)
        for i in range(max(i0, 0), min(i0 + ni, n0)):
            for j in range(max(j0, 0), min(j0 + nj, n1)):
                for k in range(max(k0, 0), min(k0 + nk, n2)):
                    for c in range(values.shape[1]):
                        out[i, j, k, c] += wx[i - i0] * wy[j - j0] * wz[k - k0] * values[p, c]
