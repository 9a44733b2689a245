"""Fused, threaded sums over all pairs of point and centre for phi = r and psi = r³ (mollified or not).

As `loops`, for the kernels that need nothing but r and 1/r; the points are in lanes. Takes points as they are given and
adds the polynomial part.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from musclefit.compiling import njit, threaded
from musclefit.fields.evaluation.lanes import (
    INNER,
    SHARE,
    WIDTH,
    load,
    shared_inverse_root,
    shared_root,
    store,
    zero,
)

OUTER: dict[str, Any] = {"fastmath": INNER["fastmath"], "error_model": "numpy"}

TINY = 1e-180
"""Added to squared distances (mm²), so that a centre itself gives 0, not NaN."""

BLOCK = 64
"""Points of one task."""


@njit(**INNER)
def _r_values(sources, block):
    """-r."""
    x, y, z = load(block, 0), load(block, 1), load(block, 2)
    u, v, w = zero(), zero(), zero()
    for j in range(sources.shape[0]):
        dx, dy, dz = x - sources[j, 0], y - sources[j, 1], z - sources[j, 2]
        r = shared_root(dx * dx + dy * dy + dz * dz + TINY)
        u = u + r * sources[j, 3]
        v = v + r * sources[j, 4]
        w = w + r * sources[j, 5]
    _store_three(block, 3, -1.0 / SHARE, u, v, w)


@njit(**INNER)
def _r_gradients(sources, block):
    """-r and its gradient: with s = w / r the sums are those of s r² and of s (x - c)^T."""
    x, y, z = load(block, 0), load(block, 1), load(block, 2)
    u, v, w = zero(), zero(), zero()
    ux, uy, uz, vx, vy, vz, wx, wy, wz = zero(), zero(), zero(), zero(), zero(), zero(), zero(), zero(), zero()
    for j in range(sources.shape[0]):
        dx, dy, dz = x - sources[j, 0], y - sources[j, 1], z - sources[j, 2]
        r2 = dx * dx + dy * dy + dz * dz + TINY
        inverse = shared_inverse_root(r2)
        a, b, c = inverse * sources[j, 3], inverse * sources[j, 4], inverse * sources[j, 5]
        u = u + r2 * a
        v = v + r2 * b
        w = w + r2 * c
        ux = ux + dx * a
        uy = uy + dy * a
        uz = uz + dz * a
        vx = vx + dx * b
        vy = vy + dy * b
        vz = vz + dz * b
        wx = wx + dx * c
        wy = wy + dy * c
        wz = wz + dz * c
    _store_three(block, 3, -1.0 / SHARE, u, v, w)
    _store_three(block, 6, -1.0 / SHARE, ux, uy, uz)
    _store_three(block, 9, -1.0 / SHARE, vx, vy, vz)
    _store_three(block, 12, -1.0 / SHARE, wx, wy, wz)


@njit(**INNER)
def _isochoric_values(soft, sources, block):
    """Kernel / 3 = (q - 3) R I + x x^T / R, R² = r² + soft, q = soft / R²: psi = R³."""
    x, y, z = load(block, 0), load(block, 1), load(block, 2)
    u, v, w = zero(), zero(), zero()
    for j in range(sources.shape[0]):
        dx, dy, dz = x - sources[j, 0], y - sources[j, 1], z - sources[j, 2]
        a, b, c = sources[j, 3], sources[j, 4], sources[j, 5]
        square = dx * dx + dy * dy + dz * dz + soft
        inverse = shared_inverse_root(square) * (1.0 / SHARE)
        f = inverse * soft - 3.0 * (square * inverse)
        along = inverse * (dx * a + dy * b + dz * c)
        u = u + f * a + along * dx
        v = v + f * b + along * dy
        w = w + f * c + along * dz
    _store_three(block, 3, 3.0, u, v, w)


@njit(**INNER)
def _isochoric_gradients(sources, block):
    """The same and its gradient for R = r.

    With n = x / r and s = n.w a third of the displacement is r (s n - 3 w), and a third of the gradient is
    n w^T - 3 w n^T - s n n^T + s I, so that the sums H of n w^T and S of s n n^T give it: H - 3 H^T - S + tr(H) I.
    """
    x, y, z = load(block, 0), load(block, 1), load(block, 2)
    u, v, w = zero(), zero(), zero()
    xx, xy, xz, yy, yz, zz = zero(), zero(), zero(), zero(), zero(), zero()
    ux, uy, uz, vx, vy, vz, wx, wy, wz = zero(), zero(), zero(), zero(), zero(), zero(), zero(), zero(), zero()
    for j in range(sources.shape[0]):
        dx, dy, dz = x - sources[j, 0], y - sources[j, 1], z - sources[j, 2]
        square = dx * dx + dy * dy + dz * dz + TINY
        inverse = shared_inverse_root(square) * (1.0 / SHARE)
        long = square * inverse
        nx, ny, nz = dx * inverse, dy * inverse, dz * inverse
        a, b, c = sources[j, 3], sources[j, 4], sources[j, 5]
        s = nx * a + ny * b + nz * c
        px, py, pz = s * nx, s * ny, s * nz
        ux = ux + nx * a
        uy = uy + nx * b
        uz = uz + nx * c
        vx = vx + ny * a
        vy = vy + ny * b
        vz = vz + ny * c
        wx = wx + nz * a
        wy = wy + nz * b
        wz = wz + nz * c
        xx = xx + px * nx
        xy = xy + px * ny
        xz = xz + px * nz
        yy = yy + py * ny
        yz = yz + py * nz
        zz = zz + pz * nz
        u = u + long * (px - sources[j, 6])
        v = v + long * (py - sources[j, 7])
        w = w + long * (pz - sources[j, 8])
    trace = ux + vy + wz
    _store_three(block, 3, 3.0, u, v, w)
    _store_three(block, 6, 3.0, trace - 2.0 * ux - xx, uy - 3.0 * vx - xy, uz - 3.0 * wx - xz)
    _store_three(block, 9, 3.0, vx - 3.0 * uy - xy, trace - 2.0 * vy - yy, vz - 3.0 * wy - yz)
    _store_three(block, 12, 3.0, wx - 3.0 * uz - xz, wy - 3.0 * vz - yz, trace - 2.0 * wz - zz)


@njit(**INNER)
def _mollified_gradients(soft, sources, block):
    """The same and its gradient, whatever R.

    With n = x / R, s = n.w and A = (3 + q) w + s n, a third of the displacement is R (A - 6 w), and a third of the
    gradient n w^T - A n^T + s I, one source's weight being w.
    """
    x, y, z = load(block, 0), load(block, 1), load(block, 2)
    u, v, w, diagonal = zero(), zero(), zero(), zero()
    ux, uy, uz, vx, vy, vz, wx, wy, wz = zero(), zero(), zero(), zero(), zero(), zero(), zero(), zero(), zero()
    for j in range(sources.shape[0]):
        dx, dy, dz = x - sources[j, 0], y - sources[j, 1], z - sources[j, 2]
        a, b, c = sources[j, 3], sources[j, 4], sources[j, 5]
        square = dx * dx + dy * dy + dz * dz + soft
        inverse = shared_inverse_root(square) * (1.0 / SHARE)
        long = square * inverse
        share = 3.0 + inverse * (inverse * soft)
        nx, ny, nz = dx * inverse, dy * inverse, dz * inverse
        s = nx * a + ny * b + nz * c
        ax, ay, az = share * a + s * nx, share * b + s * ny, share * c + s * nz
        u = u + long * (ax - sources[j, 6] - sources[j, 6])
        v = v + long * (ay - sources[j, 7] - sources[j, 7])
        w = w + long * (az - sources[j, 8] - sources[j, 8])
        diagonal = diagonal + s
        ux = ux + nx * a - ax * nx
        uy = uy + nx * b - ax * ny
        uz = uz + nx * c - ax * nz
        vx = vx + ny * a - ay * nx
        vy = vy + ny * b - ay * ny
        vz = vz + ny * c - ay * nz
        wx = wx + nz * a - az * nx
        wy = wy + nz * b - az * ny
        wz = wz + nz * c - az * nz
    _store_three(block, 3, 3.0, u, v, w)
    _store_three(block, 6, 3.0, ux + diagonal, uy, uz)
    _store_three(block, 9, 3.0, vx, vy + diagonal, vz)
    _store_three(block, 12, 3.0, wx, wy, wz + diagonal)


@njit(**INNER)
def _store_three(block, row, factor, u, v, w):
    store(block, row, factor * u)
    store(block, row + 1, factor * v)
    store(block, row + 2, factor * w)


@njit(inline="always")
def _load_points(points, origin, start, block):
    """Points from ``start`` on, local to the origin; lanes behind the last point repeat it."""
    for lane in range(WIDTH):
        i = min(start + lane, points.shape[0] - 1)
        for k in range(3):
            block[k, lane] = points[i, k] - origin[k]


@threaded(over="points", each=BLOCK, **OUTER)
def values_in_lanes(begin, end, kernel, soft, points, origin, affine, sources, values):
    """Write t + L x + sum_j K(x - c_j) w_j, x being points minus origin, to values (N, 3).

    Affine is (4, 3): t and the rows of L; sources are (m, 9): centre, local to the origin, weight w and 3 w.
    ``soft`` is the square of a mollifier's length, TINY where there is none.
    """
    n = points.shape[0]
    for task in range(begin, end):
        block = np.empty((6, WIDTH))
        for start in range(task * BLOCK, min(n, (task + 1) * BLOCK), WIDTH):
            _load_points(points, origin, start, block)
            if kernel == 0:
                _r_values(sources, block)
            else:
                _isochoric_values(soft, sources, block)
            for lane in range(min(WIDTH, n - start)):
                x, y, z = block[0, lane], block[1, lane], block[2, lane]
                for k in range(3):
                    line = affine[0, k] + affine[k + 1, 0] * x + affine[k + 1, 1] * y + affine[k + 1, 2] * z
                    values[start + lane, k] = line + block[3 + k, lane]


@threaded(over="points", each=BLOCK, **OUTER)
def gradients_in_lanes(begin, end, kernel, soft, points, origin, affine, sources, values, gradients):
    """As ``values_in_lanes``, with the derivatives (N, 3, 3)."""
    n = points.shape[0]
    for task in range(begin, end):
        block = np.empty((15, WIDTH))
        for start in range(task * BLOCK, min(n, (task + 1) * BLOCK), WIDTH):
            _load_points(points, origin, start, block)
            if kernel == 0:
                _r_gradients(sources, block)
            elif kernel == 20:
                _isochoric_gradients(sources, block)
            else:
                _mollified_gradients(soft, sources, block)
            for lane in range(min(WIDTH, n - start)):
                x, y, z = block[0, lane], block[1, lane], block[2, lane]
                for k in range(3):
                    line = affine[0, k] + affine[k + 1, 0] * x + affine[k + 1, 1] * y + affine[k + 1, 2] * z
                    values[start + lane, k] = line + block[3 + k, lane]
                    for i in range(3):
                        gradients[start + lane, k, i] = affine[k + 1, i] + block[6 + 3 * k + i, lane]
