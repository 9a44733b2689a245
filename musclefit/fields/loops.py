"""Fused, threaded sums over all pairs of point and centre, for every kernel.

Points are (N, 3) and centres (3, m); a plane is embedded in space by a zero third coordinate. A row of distances is
turned into a row of kernel values by ``_scalar_profile`` or ``_isochoric_profile``; everything else does not know the
kernel. Sums are reassociated for speed; certificates use their own loops, which are not.
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


@njit(parallel=True, fastmath=FAST, cache=True)
def scalar_sum(kernel, scale, points, centres, weights, out):
    """Add sum_j phi(|x_i - c_j|) w_j to ``out`` (N, 3); weights are (3, m)."""
    n, m = points.shape[0], centres.shape[1]
    for block in prange((n + BLOCK - 1) // BLOCK):
        r2, f, slope = np.empty(ROW), np.empty(ROW), np.empty(ROW)
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            u, v, w = 0.0, 0.0, 0.0
            for start in range(0, m, ROW):
                length = min(ROW, m - start)
                for j in range(length):
                    dx, dy, dz = x - centres[0, start + j], y - centres[1, start + j], z - centres[2, start + j]
                    r2[j] = dx * dx + dy * dy + dz * dz
                _scalar_profile(kernel, scale, r2[:length], f, slope)
                for j in range(length):
                    u += f[j] * weights[0, start + j]
                    v += f[j] * weights[1, start + j]
                    w += f[j] * weights[2, start + j]
            out[i, 0] += u
            out[i, 1] += v
            out[i, 2] += w


@njit(parallel=True, fastmath=FAST, cache=True)
def scalar_sum_with_gradient(kernel, scale, points, centres, weights, out, gradients):
    """Add the sum and its gradient to ``out`` (N, 3) and ``gradients`` (N, 3, 3)."""
    n, m = points.shape[0], centres.shape[1]
    for block in prange((n + BLOCK - 1) // BLOCK):
        r2, f, slope = np.empty(ROW), np.empty(ROW), np.empty(ROW)
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            u, v, w = 0.0, 0.0, 0.0
            ux, uy, uz, vx, vy, vz, wx, wy, wz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for start in range(0, m, ROW):
                length = min(ROW, m - start)
                for j in range(length):
                    dx, dy, dz = x - centres[0, start + j], y - centres[1, start + j], z - centres[2, start + j]
                    r2[j] = dx * dx + dy * dy + dz * dz
                _scalar_profile(kernel, scale, r2[:length], f, slope)
                for j in range(length):
                    k = start + j
                    a, b, c = weights[0, k], weights[1, k], weights[2, k]
                    dx, dy, dz = x - centres[0, k], y - centres[1, k], z - centres[2, k]
                    u += f[j] * a
                    v += f[j] * b
                    w += f[j] * c
                    dx *= slope[j]
                    dy *= slope[j]
                    dz *= slope[j]
                    ux += a * dx
                    uy += a * dy
                    uz += a * dz
                    vx += b * dx
                    vy += b * dy
                    vz += b * dz
                    wx += c * dx
                    wy += c * dy
                    wz += c * dz
            out[i, 0] += u
            out[i, 1] += v
            out[i, 2] += w
            _add_matrix(gradients[i], ux, uy, uz, vx, vy, vz, wx, wy, wz)


@njit(parallel=True, fastmath=FAST, cache=True)
def isochoric_sum(kernel, scale, points, centres, weights, out):
    """Add sum_j K(x_i - c_j) w_j to ``out`` (N, 3); weights are (3, m)."""
    n, m = points.shape[0], centres.shape[1]
    for block in prange((n + BLOCK - 1) // BLOCK):
        r2, f, slope, g, g_slope = np.empty(ROW), np.empty(ROW), np.empty(ROW), np.empty(ROW), np.empty(ROW)
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            u, v, w = 0.0, 0.0, 0.0
            for start in range(0, m, ROW):
                length = min(ROW, m - start)
                for j in range(length):
                    dx, dy, dz = x - centres[0, start + j], y - centres[1, start + j], z - centres[2, start + j]
                    r2[j] = dx * dx + dy * dy + dz * dz
                _isochoric_profile(kernel, scale, r2[:length], f, slope, g, g_slope)
                for j in range(length):
                    k = start + j
                    dx, dy, dz = x - centres[0, k], y - centres[1, k], z - centres[2, k]
                    a, b, c = weights[0, k], weights[1, k], weights[2, k]
                    along = g[j] * (dx * a + dy * b + dz * c)
                    u += f[j] * a + along * dx
                    v += f[j] * b + along * dy
                    w += f[j] * c + along * dz
            out[i, 0] += u
            out[i, 1] += v
            out[i, 2] += w


@njit(parallel=True, fastmath=FAST, cache=True)
def isochoric_sum_with_gradient(kernel, scale, points, centres, weights, out, gradients):
    """Add the sum and its gradient to ``out`` (N, 3) and ``gradients`` (N, 3, 3).

    d_k D_i = (a'/r) w_i x_k + (b'/r) (x.w) x_i x_k + b (w_k x_i + (x.w) delta_ik) for each centre.
    """
    n, m = points.shape[0], centres.shape[1]
    for block in prange((n + BLOCK - 1) // BLOCK):
        r2, f, slope, g, g_slope = np.empty(ROW), np.empty(ROW), np.empty(ROW), np.empty(ROW), np.empty(ROW)
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            u, v, w, diagonal = 0.0, 0.0, 0.0, 0.0
            ux, uy, uz, vx, vy, vz, wx, wy, wz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for start in range(0, m, ROW):
                length = min(ROW, m - start)
                for j in range(length):
                    dx, dy, dz = x - centres[0, start + j], y - centres[1, start + j], z - centres[2, start + j]
                    r2[j] = dx * dx + dy * dy + dz * dz
                _isochoric_profile(kernel, scale, r2[:length], f, slope, g, g_slope)
                for j in range(length):
                    k = start + j
                    dx, dy, dz = x - centres[0, k], y - centres[1, k], z - centres[2, k]
                    a, b, c = weights[0, k], weights[1, k], weights[2, k]
                    dot = dx * a + dy * b + dz * c
                    along = g[j] * dot
                    u += f[j] * a + along * dx
                    v += f[j] * b + along * dy
                    w += f[j] * c + along * dz
                    diagonal += along
                    curl = g_slope[j] * dot
                    ax, ay, az = slope[j] * a + curl * dx, slope[j] * b + curl * dy, slope[j] * c + curl * dz
                    gx, gy, gz = g[j] * dx, g[j] * dy, g[j] * dz
                    ux += ax * dx + gx * a
                    uy += ax * dy + gx * b
                    uz += ax * dz + gx * c
                    vx += ay * dx + gy * a
                    vy += ay * dy + gy * b
                    vz += ay * dz + gy * c
                    wx += az * dx + gz * a
                    wy += az * dy + gz * b
                    wz += az * dz + gz * c
            out[i, 0] += u
            out[i, 1] += v
            out[i, 2] += w
            _add_matrix(gradients[i], ux + diagonal, uy, uz, vx, vy + diagonal, vz, wx, wy, wz + diagonal)


@njit(inline="always")
def _add_matrix(matrix, ux, uy, uz, vx, vy, vz, wx, wy, wz):
    matrix[0, 0] += ux
    matrix[0, 1] += uy
    matrix[0, 2] += uz
    matrix[1, 0] += vx
    matrix[1, 1] += vy
    matrix[1, 2] += vz
    matrix[2, 0] += wx
    matrix[2, 1] += wy
    matrix[2, 2] += wz


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
