"""Fused, threaded sums over all pairs of point and centre, for every kernel.

Points are (N, 3) and centres (3, m); a plane is embedded in space by a zero third coordinate. Sources are sorted into
cells as wide as the support of a compact kernel, so that a point sees its own 27 only; other kernels have one cell.
A kernel is a formula of the squared distance. Each loop over the centres is compiled for each formula that is used, its
results in registers, so that it runs in vector instructions: hence the forced inlining, and no call, branch or division
check inside. Sums are
reassociated for speed; certificates use their own loops, which are not.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from musclefit.compiling import njit, threaded
from musclefit.fields.evaluation.neighbours import runs_around

FAST = {"reassoc", "contract", "arcp", "nsz"}
"""LLVM flags: reorder sums; NaN and infinity keep their meaning."""

INNER = {"fastmath": FAST, "error_model": "numpy", "forceinline": True}
OUTER: dict[str, Any] = {"fastmath": FAST, "error_model": "numpy"}

TINY = 1e-180
"""Added to squared distances (mm²) where a profile divides by r, so that a centre itself gives 0, not NaN."""

BLOCK = 64
"""Points of one task."""


@njit(inline="always")
def _add(total, first, u, v, w):
    total[first] += u
    total[first + 1] += v
    total[first + 2] += w


@njit(inline="always")
def _part(of, start, stop):
    """Three rows, from start to stop."""
    return of[0, start:stop], of[1, start:stop], of[2, start:stop]


Rows: TypeAlias = tuple[Any, Any, Any]
"""Compiled: values and gradients of all sources at a point, and the kernel matrix."""


def _scalar_rows(formula: Any) -> Rows:
    """From a formula of phi(r) and phi'(r)/r by squared distances."""

    @njit(**INNER)
    def _scalar_row(scale, where, centres, weights, total):
        """Add all of the sources to total = (value 3)."""
        x, y, z = where
        cx, cy, cz = centres
        wa, wb, wc = weights
        u, v, w = 0.0, 0.0, 0.0
        for j in range(cx.size):
            dx, dy, dz = x - cx[j], y - cy[j], z - cz[j]
            f, _ = formula(scale, dx * dx + dy * dy + dz * dz)
            u += f * wa[j]
            v += f * wb[j]
            w += f * wc[j]
        _add(total, 0, u, v, w)

    @njit(**INNER)
    def _scalar_gradient_row(scale, where, centres, weights, total):
        """Add all of the sources to total = (value 3, gradient 9)."""
        x, y, z = where
        cx, cy, cz = centres
        wa, wb, wc = weights
        u, v, w = 0.0, 0.0, 0.0
        ux, uy, uz, vx, vy, vz, wx, wy, wz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(cx.size):
            dx, dy, dz = x - cx[j], y - cy[j], z - cz[j]
            f, slope = formula(scale, dx * dx + dy * dy + dz * dz)
            a, b, c = wa[j], wb[j], wc[j]
            u += f * a
            v += f * b
            w += f * c
            dx, dy, dz = slope * dx, slope * dy, slope * dz
            ux += a * dx
            uy += a * dy
            uz += a * dz
            vx += b * dx
            vy += b * dy
            vz += b * dz
            wx += c * dx
            wy += c * dy
            wz += c * dz
        _add(total, 0, u, v, w)
        _add(total, 3, ux, uy, uz)
        _add(total, 6, vx, vy, vz)
        _add(total, 9, wx, wy, wz)

    @njit(**INNER)
    def _fill_row(scale, where, centres, row):
        x, y, z = where
        cx, cy, cz = centres
        for j in range(cx.size):
            dx, dy, dz = x - cx[j], y - cy[j], z - cz[j]
            row[j], _ = formula(scale, dx * dx + dy * dy + dz * dz)

    @threaded(over="points", least=16, **OUTER)
    def scalar_matrix(begin, end, scale, points, centres, out):
        """Kernel matrix (N, m) between points (N, 3) and centres (3, m)."""
        for i in range(begin, end):
            where, row = (points[i, 0], points[i, 1], points[i, 2]), out[i]
            sources = _part(centres, 0, centres.shape[1])
            _fill_row(scale, where, sources, row)

    return _scalar_row, _scalar_gradient_row, scalar_matrix


def _isochoric_rows(formula: Any) -> Rows:
    """From a formula of a(r), a'(r)/r, b(r), b'(r)/r by squared distances."""

    @njit(**INNER)
    def _isochoric_row(scale, where, centres, weights, total):
        """Add all of the sources to total = (value 3)."""
        x, y, z = where
        cx, cy, cz = centres
        wa, wb, wc = weights
        u, v, w = 0.0, 0.0, 0.0
        for j in range(cx.size):
            dx, dy, dz = x - cx[j], y - cy[j], z - cz[j]
            f, _, g, _ = formula(scale, dx * dx + dy * dy + dz * dz)
            a, b, c = wa[j], wb[j], wc[j]
            along = g * (dx * a + dy * b + dz * c)
            u += f * a + along * dx
            v += f * b + along * dy
            w += f * c + along * dz
        _add(total, 0, u, v, w)

    @njit(**INNER)
    def _isochoric_gradient_row(scale, where, centres, weights, total):
        """Add all of the sources to total = (value 3, gradient 9).

        d_k D_i = (a'/r) w_i x_k + (b'/r) (x.w) x_i x_k + b (w_k x_i + (x.w) delta_ik) for each source.
        """
        x, y, z = where
        cx, cy, cz = centres
        wa, wb, wc = weights
        u, v, w, diagonal = 0.0, 0.0, 0.0, 0.0
        ux, uy, uz, vx, vy, vz, wx, wy, wz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(cx.size):
            dx, dy, dz = x - cx[j], y - cy[j], z - cz[j]
            f, slope, g, g_slope = formula(scale, dx * dx + dy * dy + dz * dz)
            a, b, c = wa[j], wb[j], wc[j]
            dot = dx * a + dy * b + dz * c
            along = g * dot
            u += f * a + along * dx
            v += f * b + along * dy
            w += f * c + along * dz
            diagonal += along
            curl = g_slope * dot
            ax, ay, az = slope * a + curl * dx, slope * b + curl * dy, slope * c + curl * dz
            gx, gy, gz = g * dx, g * dy, g * dz
            ux += ax * dx + gx * a
            uy += ax * dy + gx * b
            uz += ax * dz + gx * c
            vx += ay * dx + gy * a
            vy += ay * dy + gy * b
            vz += ay * dz + gy * c
            wx += az * dx + gz * a
            wy += az * dy + gz * b
            wz += az * dz + gz * c
        _add(total, 0, u, v, w)
        _add(total, 3, ux + diagonal, uy, uz)
        _add(total, 6, vx, vy + diagonal, vz)
        _add(total, 9, wx, wy, wz + diagonal)

    @threaded(over="points", least=16, **OUTER)
    def isochoric_matrix(begin, end, scale, points, centres, out):
        """Kernel matrix (3 N, 3 m): the block of point i and centre j stands at [3i:3i+3, 3j:3j+3]."""
        for i in range(begin, end):
            for j in range(centres.shape[1]):
                dx, dy, dz = points[i, 0] - centres[0, j], points[i, 1] - centres[1, j], points[i, 2] - centres[2, j]
                f, _, g, _ = formula(scale, dx * dx + dy * dy + dz * dz)
                apart = (dx, dy, dz)
                for k in range(3):
                    for n in range(3):
                        outer = g * apart[k] * apart[n]
                        out[3 * i + k, 3 * j + n] = outer + f if k == n else outer

    return _isochoric_row, _isochoric_gradient_row, isochoric_matrix


class RadialSums(NamedTuple):
    """A kernel's compiled sums over points and centres, and its matrix."""

    values: Callable[..., None]
    gradients: Callable[..., None]
    matrix: Callable[..., None]


@cache
def radial_sums(formula: Any, *, isochoric: bool) -> RadialSums:
    """The sums of a kernel's formula; see `musclefit.fields.kernels.model.RadialKernel`."""
    value_row, gradient_row, matrix = _isochoric_rows(formula) if isochoric else _scalar_rows(formula)

    @threaded(over="points", each=BLOCK, **OUTER)
    def radial_sum(begin, end, scale, points, centres, weights, low, width, counts, starts, out):
        """Add sum_j K(x_i - c_j) w_j to ``out`` (N, 3); centres and weights are (3, m), in the order of their cells."""
        n = points.shape[0]
        for block in range(begin, end):
            runs = np.empty((9, 2), np.int64)
            for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
                where = (points[i, 0], points[i, 1], points[i, 2])
                for run in range(runs_around(where[0], where[1], where[2], low, width, counts, starts, runs)):
                    start, stop = runs[run, 0], runs[run, 1]
                    value_row(scale, where, _part(centres, start, stop), _part(weights, start, stop), out[i])

    @threaded(over="points", each=BLOCK, **OUTER)
    def radial_sum_with_gradient(begin, end, scale, points, centres, weights, low, width, counts, starts, out):
        """Add the sum and its gradient to ``out`` (N, 12): 3 values, then 9 derivatives row by row."""
        n = points.shape[0]
        for block in range(begin, end):
            runs = np.empty((9, 2), np.int64)
            for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
                where = (points[i, 0], points[i, 1], points[i, 2])
                for run in range(runs_around(where[0], where[1], where[2], low, width, counts, starts, runs)):
                    start, stop = runs[run, 0], runs[run, 1]
                    gradient_row(scale, where, _part(centres, start, stop), _part(weights, start, stop), out[i])

    return RadialSums(radial_sum, radial_sum_with_gradient, matrix)
