"""Fused, threaded sums of the curls of cubic B-spline vector potentials on sparse lattices.

A potential Q has coefficients (K, 3) at some points of a lattice; ``numbers`` holds each lattice point's row of them,
or -1 where there is none. Its curl D = (Qz_y - Qy_z, Qx_z - Qz_x, Qy_x - Qx_y) has no divergence by construction and is
continuously differentiable in all of space. Sums are reassociated for speed; certificates use their own loops.
"""

from __future__ import annotations

import numpy as np

from musclefit.compiling import njit, threaded

FAST = {"reassoc", "contract", "arcp", "nsz"}
"""LLVM flags: reorder sums; NaN and infinity keep their meaning."""

BLOCK = 256


@njit(inline="always")
def two_weights(t, h, w, d):
    """Values and first derivatives (per mm) of four cubic B-splines over a cell of width h at t in [0, 1]."""
    s = 1.0 - t
    w[0] = s * s * s / 6.0
    w[1] = (4.0 + t * t * (3.0 * t - 6.0)) / 6.0
    w[2] = (4.0 + s * s * (3.0 * s - 6.0)) / 6.0
    w[3] = t * t * t / 6.0
    d[0] = -0.5 * s * s / h
    d[1] = t * (1.5 * t - 2.0) / h
    d[2] = s * (2.0 - 1.5 * s) / h
    d[3] = 0.5 * t * t / h


@njit(inline="always")
def _weights(t, h, w, d, e):
    """As `two_weights`, and second derivatives."""
    two_weights(t, h, w, d)
    s = 1.0 - t
    e[0] = s / (h * h)
    e[1] = (3.0 * t - 2.0) / (h * h)
    e[2] = (3.0 * s - 2.0) / (h * h)
    e[3] = t / (h * h)


@njit(inline="always")
def _box(point, low, h, shape, w, d, e, box):
    """Weights along all axes, and first and last + 1 of the lattice points seen; False where there are none."""
    for axis in range(3):
        u = (point[axis] - low[axis]) / h
        if not (-2.0 < u < shape[axis] + 1.0):
            return False
        base = int(np.floor(u))
        _weights(u - base, h, w[axis], d[axis], e[axis])
        box[axis, 2] = base - 1
        box[axis, 0], box[axis, 1] = max(base - 1, 0), min(base + 3, shape[axis])
    return True


@threaded(over="points", each=BLOCK, fastmath=FAST)
def curl_sum(begin, end, low, h, numbers, coefficients, points, out):
    """Add the curl at points (N, 3) to ``out`` (N, 3)."""
    n, shape = points.shape[0], numbers.shape
    for block in range(begin, end):
        w, d, e, box = np.zeros((3, 4)), np.zeros((3, 4)), np.zeros((3, 4)), np.zeros((3, 3), np.int64)
        for p in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            if not _box(points[p], low, h, shape, w, d, e, box):
                continue
            xy, xz, yx, yz, zx, zy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(box[0, 0], box[0, 1]):
                wi, di = w[0, i - box[0, 2]], d[0, i - box[0, 2]]
                for j in range(box[1, 0], box[1, 1]):
                    wj, dj = w[1, j - box[1, 2]], d[1, j - box[1, 2]]
                    x, y, z, sx, sy = 0.0, 0.0, 0.0, 0.0, 0.0
                    for k in range(box[2, 0], box[2, 1]):
                        row = numbers[i, j, k]
                        if row >= 0:
                            wk, dk = w[2, k - box[2, 2]], d[2, k - box[2, 2]]
                            x += wk * coefficients[row, 0]
                            y += wk * coefficients[row, 1]
                            z += wk * coefficients[row, 2]
                            sx += dk * coefficients[row, 0]
                            sy += dk * coefficients[row, 1]
                    xy += wi * dj * x
                    zy += wi * dj * z
                    yx += di * wj * y
                    zx += di * wj * z
                    xz += wi * wj * sx
                    yz += wi * wj * sy
            out[p, 0] += zy - yz
            out[p, 1] += xz - zx
            out[p, 2] += yx - xy


@threaded(over="points", each=BLOCK, fastmath=FAST)
def curl_sum_with_gradient(begin, end, low, h, numbers, coefficients, points, out, gradients):
    """Add the curl to ``out`` (N, 3) and its derivatives to ``gradients`` (N, 3, 3)."""
    n, shape = points.shape[0], numbers.shape
    for block in range(begin, end):
        w, d, e, box = np.zeros((3, 4)), np.zeros((3, 4)), np.zeros((3, 4)), np.zeros((3, 3), np.int64)
        for p in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            if not _box(points[p], low, h, shape, w, d, e, box):
                continue
            xy, xz, yx, yz, zx, zy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            xxy, xxz, xyy, xyz, xzz = 0.0, 0.0, 0.0, 0.0, 0.0  # second derivatives of Qx along xy, xz, yy, yz, zz
            yxx, yxy, yxz, yyz, yzz = 0.0, 0.0, 0.0, 0.0, 0.0
            zxx, zxy, zxz, zyy, zyz = 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(box[0, 0], box[0, 1]):
                wi, di, ei = w[0, i - box[0, 2]], d[0, i - box[0, 2]], e[0, i - box[0, 2]]
                for j in range(box[1, 0], box[1, 1]):
                    wj, dj, ej = w[1, j - box[1, 2]], d[1, j - box[1, 2]], e[1, j - box[1, 2]]
                    x, y, z, sx, sy, sz, tx, ty = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                    for k in range(box[2, 0], box[2, 1]):
                        row = numbers[i, j, k]
                        if row >= 0:
                            wk, dk, ek = w[2, k - box[2, 2]], d[2, k - box[2, 2]], e[2, k - box[2, 2]]
                            a, b, c = coefficients[row, 0], coefficients[row, 1], coefficients[row, 2]
                            x += wk * a
                            y += wk * b
                            z += wk * c
                            sx += dk * a
                            sy += dk * b
                            sz += dk * c
                            tx += ek * a
                            ty += ek * b
                    ww, dw, wd = wi * wj, di * wj, wi * dj
                    xy += wd * x
                    zy += wd * z
                    yx += dw * y
                    zx += dw * z
                    xz += ww * sx
                    yz += ww * sy
                    dd, ew, we = di * dj, ei * wj, wi * ej
                    xxy += dd * x
                    xxz += dw * sx
                    xyy += we * x
                    xyz += wd * sx
                    xzz += ww * tx
                    yxx += ew * y
                    yxy += dd * y
                    yxz += dw * sy
                    yyz += wd * sy
                    yzz += ww * ty
                    zxx += ew * z
                    zxy += dd * z
                    zxz += dw * sz
                    zyy += we * z
                    zyz += wd * sz
            out[p, 0] += zy - yz
            out[p, 1] += xz - zx
            out[p, 2] += yx - xy
            gradients[p, 0, 0] += zxy - yxz
            gradients[p, 0, 1] += zyy - yyz
            gradients[p, 0, 2] += zyz - yzz
            gradients[p, 1, 0] += xxz - zxx
            gradients[p, 1, 1] += xyz - zxy
            gradients[p, 1, 2] += xzz - zxz
            gradients[p, 2, 0] += yxx - xxy
            gradients[p, 2, 1] += yxy - xyy
            gradients[p, 2, 2] += yxz - xyz


@njit(fastmath=FAST, cache=True)
def curl_spread(low, h, numbers, points, values, out):
    """Add every point's (N, 3) values to the coefficients (K, 3) it sees: the transpose of ``curl_sum``."""
    shape = numbers.shape
    w, d, e, box = np.zeros((3, 4)), np.zeros((3, 4)), np.zeros((3, 4)), np.zeros((3, 3), np.int64)
    for p in range(points.shape[0]):
        if not _box(points[p], low, h, shape, w, d, e, box):
            continue
        a, b, c = values[p]
        for i in range(box[0, 0], box[0, 1]):
            wi, di = w[0, i - box[0, 2]], d[0, i - box[0, 2]]
            for j in range(box[1, 0], box[1, 1]):
                wj, dj = w[1, j - box[1, 2]], d[1, j - box[1, 2]]
                ww, dw, wd = wi * wj, di * wj, wi * dj
                x, y = wd * c, dw * c
                u, v = dw * b, wd * a
                for k in range(box[2, 0], box[2, 1]):
                    row = numbers[i, j, k]
                    if row >= 0:
                        wk, dk = w[2, k - box[2, 2]], d[2, k - box[2, 2]]
                        out[row, 0] += ww * dk * b - x * wk
                        out[row, 1] += y * wk - ww * dk * a
                        out[row, 2] += (v - u) * wk


@njit(cache=True)
def mark_seen(low, h, points, seen):
    """Set ``seen`` (n0, n1, n2) bool at the lattice points whose splines are not zero at some point."""
    w, d, e, box = np.zeros((3, 4)), np.zeros((3, 4)), np.zeros((3, 4)), np.zeros((3, 3), np.int64)
    for p in range(points.shape[0]):
        if _box(points[p], low, h, seen.shape, w, d, e, box):
            seen[box[0, 0] : box[0, 1], box[1, 0] : box[1, 1], box[2, 0] : box[2, 1]] = True


@njit(cache=True)
def spread_squares(low, h, numbers, points, out):
    """Add to ``out`` (K,) the mean square, over its three components, of what each coefficient gives at the points."""
    w, d, e, box = np.zeros((3, 4)), np.zeros((3, 4)), np.zeros((3, 4)), np.zeros((3, 3), np.int64)
    for p in range(points.shape[0]):
        if not _box(points[p], low, h, numbers.shape, w, d, e, box):
            continue
        for i in range(box[0, 0], box[0, 1]):
            wi, di = w[0, i - box[0, 2]], d[0, i - box[0, 2]]
            for j in range(box[1, 0], box[1, 1]):
                wj, dj = w[1, j - box[1, 2]], d[1, j - box[1, 2]]
                for k in range(box[2, 0], box[2, 1]):
                    row = numbers[i, j, k]
                    if row >= 0:
                        wk, dk = w[2, k - box[2, 2]], d[2, k - box[2, 2]]
                        x, y, z = di * wj * wk, wi * dj * wk, wi * wj * dk
                        out[row] += 2.0 / 3.0 * (x * x + y * y + z * z)
