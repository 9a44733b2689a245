"""Fused, threaded sums over all pairs of point and centre, for every kernel.

Points are (N, 3) and centres (3, m); a plane is embedded in space by a zero third coordinate. Sources are sorted into
cells as wide as the support of a compact kernel, so that a point sees its own 27 only; other kernels have one cell. A
row of distances is turned into a row of kernel values by ``_scalar_profile`` or ``_isochoric_profile``; everything else
does not know the kernel. Sums are reassociated for speed; certificates use their own loops, which are not.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

FAST = {"reassoc", "contract", "arcp", "nsz"}
"""LLVM flags: reorder sums; NaN and infinity keep their meaning."""

TINY = 1e-180
"""Added to squared distances (mm²) where a profile divides by r, so that a centre itself gives 0, not NaN."""

BLOCK = 64
ROW = 256


@njit(fastmath=FAST, cache=True)
def _scalar_profile(kernel, scale, r2, f, slope):
    """From squared distances: f = phi(r), slope = phi'(r)/r."""
    if kernel == 0:  # -r
        for j in range(r2.size):
            r = np.sqrt(r2[j] + TINY)
            f[j] = -r
            slope[j] = -1.0 / r
    elif kernel == 1:  # r² log r
        for j in range(r2.size):
            log = np.log(r2[j] + TINY)
            f[j] = 0.5 * r2[j] * log
            slope[j] = log + 1.0
    elif kernel == 2:  # r³
        for j in range(r2.size):
            r = np.sqrt(r2[j])
            f[j] = r2[j] * r
            slope[j] = 3.0 * r
    elif kernel == 3:  # Gaussian
        s2 = 1.0 / (scale * scale)
        for j in range(r2.size):
            f[j] = np.exp(-r2[j] * s2)
            slope[j] = -2.0 * s2 * f[j]
    elif kernel == 4:  # inverse multiquadric
        s2 = 1.0 / (scale * scale)
        for j in range(r2.size):
            f[j] = 1.0 / np.sqrt(1.0 + r2[j] * s2)
            slope[j] = -s2 * f[j] * f[j] * f[j]
    elif kernel == 5:  # Wendland C2
        s = 1.0 / scale
        for j in range(r2.size):
            q = np.sqrt(r2[j]) * s
            u = max(1.0 - q, 0.0)
            u3 = u * u * u
            f[j] = u3 * u * (4.0 * q + 1.0)
            slope[j] = -20.0 * s * s * u3
    else:  # Wendland C4
        s = 1.0 / scale
        for j in range(r2.size):
            q = np.sqrt(r2[j]) * s
            u = max(1.0 - q, 0.0)
            u5 = u * u * u * u * u
            f[j] = u5 * u * (35.0 * q * q + 18.0 * q + 3.0) / 3.0
            slope[j] = -56.0 / 3.0 * s * s * u5 * (5.0 * q + 1.0)


@njit(fastmath=FAST, cache=True)
def _isochoric_profile(kernel, scale, r2, f, slope, g, g_slope):
    """From squared distances: f = a(r), slope = a'(r)/r, g = b(r), g_slope = b'(r)/r."""
    if kernel == 20:  # psi = r³
        for j in range(r2.size):
            r = np.sqrt(r2[j] + TINY)
            inverse = 1.0 / r
            f[j] = -9.0 * r
            slope[j] = -9.0 * inverse
            g[j] = 3.0 * inverse
            g_slope[j] = -3.0 * inverse * inverse * inverse
    elif kernel == 21:  # psi = (r² + scale²)^(3/2)
        e2 = scale * scale
        for j in range(r2.size):
            r = np.sqrt(r2[j] + e2)
            inverse = 1.0 / r
            f[j] = -6.0 * r - 3.0 * r2[j] * inverse
            slope[j] = -9.0 * inverse - 3.0 * e2 * inverse * inverse * inverse
            g[j] = 3.0 * inverse
            g_slope[j] = -3.0 * inverse * inverse * inverse
    elif kernel == 22:  # psi = -r⁵
        for j in range(r2.size):
            r = np.sqrt(r2[j] + TINY)
            f[j] = 25.0 * r2[j] * r
            slope[j] = 75.0 * r
            g[j] = -15.0 * r
            g_slope[j] = -15.0 / r
    else:  # Wendland C6: psi = (1-q)^8 (32 q³ + 25 q² + 8 q + 1), q = r / scale, times scale²
        s = 1.0 / scale
        s2 = s * s
        for j in range(r2.size):
            q = np.sqrt(r2[j]) * s
            u = max(1.0 - q, 0.0)
            u2 = u * u
            u5 = u2 * u2 * u
            f[j] = 44.0 * u5 * u * (1.0 + q * (6.0 - q * (3.0 + 88.0 * q)))
            slope[j] = 1056.0 * s2 * u5 * (q * (33.0 * q - 10.0) - 2.0)
            g[j] = 528.0 * s2 * u5 * u * (6.0 * q + 1.0)
            g_slope[j] = -22176.0 * s2 * s2 * u5


@njit(fastmath=FAST, cache=True)
def _scalar_row(kernel, scale, where, centres, weights, start, stop, rows, total):
    """Add the sources start..stop to total = (value 3)."""
    x, y, z = where
    r2, f, slope = rows[0], rows[1], rows[2]
    u, v, w = 0.0, 0.0, 0.0
    for j in range(start, stop):
        dx, dy, dz = x - centres[0, j], y - centres[1, j], z - centres[2, j]
        r2[j - start] = dx * dx + dy * dy + dz * dz
    _scalar_profile(kernel, scale, r2[: stop - start], f, slope)
    for j in range(start, stop):
        u += f[j - start] * weights[0, j]
        v += f[j - start] * weights[1, j]
        w += f[j - start] * weights[2, j]
    total[0] += u
    total[1] += v
    total[2] += w


@njit(fastmath=FAST, cache=True)
def _scalar_gradient_row(kernel, scale, where, centres, weights, start, stop, rows, total):
    """Add the sources start..stop to total = (value 3, gradient 9)."""
    x, y, z = where
    r2, f, slope = rows[0], rows[1], rows[2]
    u, v, w = 0.0, 0.0, 0.0
    ux, uy, uz, vx, vy, vz, wx, wy, wz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(start, stop):
        dx, dy, dz = x - centres[0, j], y - centres[1, j], z - centres[2, j]
        r2[j - start] = dx * dx + dy * dy + dz * dz
    _scalar_profile(kernel, scale, r2[: stop - start], f, slope)
    for j in range(start, stop):
        value, steep = f[j - start], slope[j - start]
        a, b, c = weights[0, j], weights[1, j], weights[2, j]
        u += value * a
        v += value * b
        w += value * c
        dx, dy, dz = steep * (x - centres[0, j]), steep * (y - centres[1, j]), steep * (z - centres[2, j])
        ux += a * dx
        uy += a * dy
        uz += a * dz
        vx += b * dx
        vy += b * dy
        vz += b * dz
        wx += c * dx
        wy += c * dy
        wz += c * dz
    _add_all(total, u, v, w, ux, uy, uz, vx, vy, vz, wx, wy, wz)


@njit(fastmath=FAST, cache=True)
def _isochoric_row(kernel, scale, where, centres, weights, start, stop, rows, total):
    """Add the sources start..stop to total = (value 3)."""
    x, y, z = where
    r2, f, slope, g, g_slope = rows[0], rows[1], rows[2], rows[3], rows[4]
    u, v, w = 0.0, 0.0, 0.0
    for j in range(start, stop):
        dx, dy, dz = x - centres[0, j], y - centres[1, j], z - centres[2, j]
        r2[j - start] = dx * dx + dy * dy + dz * dz
    _isochoric_profile(kernel, scale, r2[: stop - start], f, slope, g, g_slope)
    for j in range(start, stop):
        dx, dy, dz = x - centres[0, j], y - centres[1, j], z - centres[2, j]
        a, b, c = weights[0, j], weights[1, j], weights[2, j]
        along = g[j - start] * (dx * a + dy * b + dz * c)
        u += f[j - start] * a + along * dx
        v += f[j - start] * b + along * dy
        w += f[j - start] * c + along * dz
    total[0] += u
    total[1] += v
    total[2] += w


@njit(fastmath=FAST, cache=True)
def _isochoric_gradient_row(kernel, scale, where, centres, weights, start, stop, rows, total):
    """Add the sources start..stop to total = (value 3, gradient 9).

    d_k D_i = (a'/r) w_i x_k + (b'/r) (x.w) x_i x_k + b (w_k x_i + (x.w) delta_ik) for each source.
    """
    x, y, z = where
    r2, f, slope, g, g_slope = rows[0], rows[1], rows[2], rows[3], rows[4]
    u, v, w, diagonal = 0.0, 0.0, 0.0, 0.0
    ux, uy, uz, vx, vy, vz, wx, wy, wz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(start, stop):
        dx, dy, dz = x - centres[0, j], y - centres[1, j], z - centres[2, j]
        r2[j - start] = dx * dx + dy * dy + dz * dz
    _isochoric_profile(kernel, scale, r2[: stop - start], f, slope, g, g_slope)
    for j in range(start, stop):
        k = j - start
        dx, dy, dz = x - centres[0, j], y - centres[1, j], z - centres[2, j]
        a, b, c = weights[0, j], weights[1, j], weights[2, j]
        dot = dx * a + dy * b + dz * c
        along = g[k] * dot
        u += f[k] * a + along * dx
        v += f[k] * b + along * dy
        w += f[k] * c + along * dz
        diagonal += along
        curl = g_slope[k] * dot
        ax, ay, az = slope[k] * a + curl * dx, slope[k] * b + curl * dy, slope[k] * c + curl * dz
        gx, gy, gz = g[k] * dx, g[k] * dy, g[k] * dz
        ux += ax * dx + gx * a
        uy += ax * dy + gx * b
        uz += ax * dz + gx * c
        vx += ay * dx + gy * a
        vy += ay * dy + gy * b
        vz += ay * dz + gy * c
        wx += az * dx + gz * a
        wy += az * dy + gz * b
        wz += az * dz + gz * c
    _add_all(total, u, v, w, ux + diagonal, uy, uz, vx, vy + diagonal, vz, wx, wy, wz + diagonal)


@njit(inline="always")
def _add_all(total, u, v, w, ux, uy, uz, vx, vy, vz, wx, wy, wz):
    total[0] += u
    total[1] += v
    total[2] += w
    total[3] += ux
    total[4] += uy
    total[5] += uz
    total[6] += vx
    total[7] += vy
    total[8] += vz
    total[9] += wx
    total[10] += wy
    total[11] += wz


@njit(inline="always")
def _runs(x, y, z, low, width, counts, starts, runs):
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


@njit(parallel=True, fastmath=FAST, cache=True)
def radial_sum(kernel, isochoric, scale, points, centres, weights, low, width, counts, starts, out):
    """Add sum_j K(x_i - c_j) w_j to ``out`` (N, 3); centres and weights are (3, m), in the order of their cells."""
    n = points.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        rows, runs, total = np.empty((5, ROW)), np.empty((9, 2), np.int64), np.empty(3)
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            where = (points[i, 0], points[i, 1], points[i, 2])
            total[:] = 0.0
            for run in range(_runs(where[0], where[1], where[2], low, width, counts, starts, runs)):
                for start in range(runs[run, 0], runs[run, 1], ROW):
                    stop = min(start + ROW, runs[run, 1])
                    if isochoric:
                        _isochoric_row(kernel, scale, where, centres, weights, start, stop, rows, total)
                    else:
                        _scalar_row(kernel, scale, where, centres, weights, start, stop, rows, total)
            for k in range(3):
                out[i, k] += total[k]


@njit(parallel=True, fastmath=FAST, cache=True)
def radial_sum_with_gradient(
    kernel, isochoric, scale, points, centres, weights, low, width, counts, starts, out, gradients
):
    """Add the sum and its gradient to ``out`` (N, 3) and ``gradients`` (N, 3, 3)."""
    n = points.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        rows, runs, total = np.empty((5, ROW)), np.empty((9, 2), np.int64), np.empty(12)
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            where = (points[i, 0], points[i, 1], points[i, 2])
            total[:] = 0.0
            for run in range(_runs(where[0], where[1], where[2], low, width, counts, starts, runs)):
                for start in range(runs[run, 0], runs[run, 1], ROW):
                    stop = min(start + ROW, runs[run, 1])
                    if isochoric:
                        _isochoric_gradient_row(kernel, scale, where, centres, weights, start, stop, rows, total)
                    else:
                        _scalar_gradient_row(kernel, scale, where, centres, weights, start, stop, rows, total)
            for k in range(3):
                out[i, k] += total[k]
                for q in range(3):
                    gradients[i, k, q] += total[3 + 3 * k + q]


@njit(parallel=True, fastmath=FAST, cache=True)
def scalar_matrix(kernel, scale, points, centres, out):
    """Kernel matrix (N, m) between points (N, 3) and centres (3, m)."""
    m = centres.shape[1]
    for i in prange(points.shape[0]):
        r2, slope = np.empty(m), np.empty(m)
        for j in range(m):
            dx, dy, dz = points[i, 0] - centres[0, j], points[i, 1] - centres[1, j], points[i, 2] - centres[2, j]
            r2[j] = dx * dx + dy * dy + dz * dz
        _scalar_profile(kernel, scale, r2, out[i], slope)


@njit(parallel=True, fastmath=FAST, cache=True)
def isochoric_matrix(kernel, scale, points, centres, out):
    """Kernel matrix (3 N, 3 m): the block of point i and centre j stands at [3i:3i+3, 3j:3j+3]."""
    m = centres.shape[1]
    for i in prange(points.shape[0]):
        r2, f, slope, g, g_slope = np.empty(m), np.empty(m), np.empty(m), np.empty(m), np.empty(m)
        for j in range(m):
            dx, dy, dz = points[i, 0] - centres[0, j], points[i, 1] - centres[1, j], points[i, 2] - centres[2, j]
            r2[j] = dx * dx + dy * dy + dz * dz
        _isochoric_profile(kernel, scale, r2, f, slope, g, g_slope)
        for j in range(m):
            for k in range(3):
                for n in range(3):
                    outer = g[j] * (points[i, k] - centres[k, j]) * (points[i, n] - centres[n, j])
                    out[3 * i + k, 3 * j + n] = outer + f[j] if k == n else outer
