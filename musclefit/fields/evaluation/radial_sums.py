"""Fused, threaded sums over all pairs of point and centre, for every kernel.

Points are (N, 3) and centres (3, m); a plane is embedded in space by a zero third coordinate. Sources are sorted into
cells as wide as the support of a compact kernel, so that a point sees its own 27 only; other kernels have one cell.
The kernels are formulas of the squared distance in ``_scalar`` and ``_isochoric``; everything else does not know them.
Each loop over the centres is compiled once for each kernel, its code constant and its results in registers, so that it
runs in vector instructions: hence the forced inlining, and no call, branch or division check inside. Sums are
reassociated for speed; certificates use their own loops, which are not.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from musclefit.compiling import njit, threaded

FAST = {"reassoc", "contract", "arcp", "nsz"}
"""LLVM flags: reorder sums; NaN and infinity keep their meaning."""

INNER = {"fastmath": FAST, "error_model": "numpy", "forceinline": True}
OUTER: dict[str, Any] = {"fastmath": FAST, "error_model": "numpy"}

TINY = 1e-180
"""Added to squared distances (mm²) where a profile divides by r, so that a centre itself gives 0, not NaN."""

BLOCK = 64
"""Points of one task."""


@intrinsic
def _bits(_context, value):
    """The 64 bits of a number: float64 as int64, int64 as float64."""
    floats = value == types.float64
    made, target = (types.int64, ir.IntType(64)) if floats else (types.float64, ir.DoubleType())

    def generate(_context, builder, _signature, arguments):
        return builder.bitcast(arguments[0], target)

    return made(value), generate


@njit(**{**INNER, "fastmath": {"contract"}})  # reassociating the conversion of k would lose all digits
def _log(x):
    """Natural logarithm of a positive normal number to 3e-16 of max(1, |log x|), in vector instructions.

    x = 2^k y with y in [sqrt(1/2), sqrt(2)) and log y = 2 artanh(s), s = (y - 1) / (y + 1), by FDLIBM's polynomial.
    """
    bits = _bits(x)
    above = bits - 0x3FE6A09E667F3BCD  # sqrt(1/2)
    y = _bits(bits - (above & -0x10000000000000))
    k = _bits((above >> 52) + 0x4338000000000000) - 6755399441055744.0  # 1.5 * 2^52: an integer in the last bits
    s = (y - 1.0) / (y + 1.0)
    z = s * s
    high = 0.2222219843214978396 + z * (0.1818357216161805012 + z * (0.1531383769920937332 + z * 0.1479819860511658591))
    series = z * (0.6666666666666735130 + z * (0.3999999999940941908 + z * (0.2857142874366239149 + z * high)))
    return k * 0.6931471805599453094 + (2.0 * s + s * series)


@njit(**INNER)
def _scalar(kernel, scale, r2):
    """From a squared distance: phi(r) and phi'(r)/r."""
    if kernel == 0:  # -r
        r = np.sqrt(r2 + TINY)
        return -r, -1.0 / r
    if kernel == 1:  # r² log r
        log = _log(r2 + TINY)
        return 0.5 * r2 * log, log + 1.0
    if kernel == 2:  # r³
        r = np.sqrt(r2)
        return r2 * r, 3.0 * r
    s = 1.0 / scale
    if kernel == 3:  # Gaussian
        f = np.exp(-r2 * s * s)
        return f, -2.0 * s * s * f
    if kernel == 4:  # inverse multiquadric
        f = 1.0 / np.sqrt(1.0 + r2 * s * s)
        return f, -s * s * f * f * f
    q = np.sqrt(r2) * s
    u = 0.0 if q > 1.0 else 1.0 - q
    u3 = u * u * u
    if kernel == 5:  # Wendland C2
        return u3 * u * (4.0 * q + 1.0), -20.0 * s * s * u3
    u5 = u3 * u * u  # Wendland C4
    return u5 * u * (35.0 * q * q + 18.0 * q + 3.0) / 3.0, -56.0 / 3.0 * s * s * u5 * (5.0 * q + 1.0)


@njit(**INNER)
def _isochoric(kernel, scale, r2):
    """From a squared distance: a(r), a'(r)/r, b(r), b'(r)/r."""
    if kernel == 20:  # psi = r³
        r = np.sqrt(r2 + TINY)
        inverse = 1.0 / r
        return -9.0 * r, -9.0 * inverse, 3.0 * inverse, -3.0 * inverse * inverse * inverse
    if kernel == 21:  # psi = (r² + scale²)^(3/2)
        e2 = scale * scale
        r = np.sqrt(r2 + e2)
        inverse = 1.0 / r
        cube = 3.0 * inverse * inverse * inverse
        return -6.0 * r - 3.0 * r2 * inverse, -9.0 * inverse - e2 * cube, 3.0 * inverse, -cube
    if kernel == 22:  # psi = -r⁵
        r = np.sqrt(r2 + TINY)
        return 25.0 * r2 * r, 75.0 * r, -15.0 * r, -15.0 / r
    # Wendland C6: psi = (1-q)^8 (32 q³ + 25 q² + 8 q + 1), q = r / scale, times scale²
    s = 1.0 / scale
    s2 = s * s
    q = np.sqrt(r2) * s
    u = 0.0 if q > 1.0 else 1.0 - q
    u2 = u * u
    u5 = u2 * u2 * u
    return (
        44.0 * u5 * u * (1.0 + q * (6.0 - q * (3.0 + 88.0 * q))),
        1056.0 * s2 * u5 * (q * (33.0 * q - 10.0) - 2.0),
        528.0 * s2 * u5 * u * (6.0 * q + 1.0),
        -22176.0 * s2 * s2 * u5,
    )


@njit(**INNER)
def _scalar_row(kernel, scale, where, centres, weights, total):
    """Add all of the sources to total = (value 3)."""
    x, y, z = where
    cx, cy, cz = centres
    wa, wb, wc = weights
    u, v, w = 0.0, 0.0, 0.0
    for j in range(cx.size):
        dx, dy, dz = x - cx[j], y - cy[j], z - cz[j]
        f, _ = _scalar(kernel, scale, dx * dx + dy * dy + dz * dz)
        u += f * wa[j]
        v += f * wb[j]
        w += f * wc[j]
    _add(total, 0, u, v, w)


@njit(**INNER)
def _scalar_gradient_row(kernel, scale, where, centres, weights, total):
    """Add all of the sources to total = (value 3, gradient 9)."""
    x, y, z = where
    cx, cy, cz = centres
    wa, wb, wc = weights
    u, v, w = 0.0, 0.0, 0.0
    ux, uy, uz, vx, vy, vz, wx, wy, wz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(cx.size):
        dx, dy, dz = x - cx[j], y - cy[j], z - cz[j]
        f, slope = _scalar(kernel, scale, dx * dx + dy * dy + dz * dz)
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
def _isochoric_row(kernel, scale, where, centres, weights, total):
    """Add all of the sources to total = (value 3)."""
    x, y, z = where
    cx, cy, cz = centres
    wa, wb, wc = weights
    u, v, w = 0.0, 0.0, 0.0
    for j in range(cx.size):
        dx, dy, dz = x - cx[j], y - cy[j], z - cz[j]
        f, _, g, _ = _isochoric(kernel, scale, dx * dx + dy * dy + dz * dz)
        a, b, c = wa[j], wb[j], wc[j]
        along = g * (dx * a + dy * b + dz * c)
        u += f * a + along * dx
        v += f * b + along * dy
        w += f * c + along * dz
    _add(total, 0, u, v, w)


@njit(**INNER)
def _isochoric_gradient_row(kernel, scale, where, centres, weights, total):
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
        f, slope, g, g_slope = _isochoric(kernel, scale, dx * dx + dy * dy + dz * dz)
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


@njit(inline="always")
def _add(total, first, u, v, w):
    total[first] += u
    total[first + 1] += v
    total[first + 2] += w


@njit(**INNER)
def _any_row(kernel, scale, where, centres, weights, total):
    """Values of any kernel, its code a constant of the machine code but not of the types: those are inferred once."""
    if kernel == 0:
        _scalar_row(np.int64(0), scale, where, centres, weights, total)
    elif kernel == 1:
        _scalar_row(np.int64(1), scale, where, centres, weights, total)
    elif kernel == 2:
        _scalar_row(np.int64(2), scale, where, centres, weights, total)
    elif kernel == 3:
        _scalar_row(np.int64(3), scale, where, centres, weights, total)
    elif kernel == 4:
        _scalar_row(np.int64(4), scale, where, centres, weights, total)
    elif kernel == 5:
        _scalar_row(np.int64(5), scale, where, centres, weights, total)
    elif kernel == 6:
        _scalar_row(np.int64(6), scale, where, centres, weights, total)
    elif kernel == 20:
        _isochoric_row(np.int64(20), scale, where, centres, weights, total)
    elif kernel == 21:
        _isochoric_row(np.int64(21), scale, where, centres, weights, total)
    elif kernel == 22:
        _isochoric_row(np.int64(22), scale, where, centres, weights, total)
    else:
        _isochoric_row(np.int64(23), scale, where, centres, weights, total)


@njit(**INNER)
def _any_gradient_row(kernel, scale, where, centres, weights, total):
    """Values and gradients of any kernel, as ``_any_row``."""
    if kernel == 0:
        _scalar_gradient_row(np.int64(0), scale, where, centres, weights, total)
    elif kernel == 1:
        _scalar_gradient_row(np.int64(1), scale, where, centres, weights, total)
    elif kernel == 2:
        _scalar_gradient_row(np.int64(2), scale, where, centres, weights, total)
    elif kernel == 3:
        _scalar_gradient_row(np.int64(3), scale, where, centres, weights, total)
    elif kernel == 4:
        _scalar_gradient_row(np.int64(4), scale, where, centres, weights, total)
    elif kernel == 5:
        _scalar_gradient_row(np.int64(5), scale, where, centres, weights, total)
    elif kernel == 6:
        _scalar_gradient_row(np.int64(6), scale, where, centres, weights, total)
    elif kernel == 20:
        _isochoric_gradient_row(np.int64(20), scale, where, centres, weights, total)
    elif kernel == 21:
        _isochoric_gradient_row(np.int64(21), scale, where, centres, weights, total)
    elif kernel == 22:
        _isochoric_gradient_row(np.int64(22), scale, where, centres, weights, total)
    else:
        _isochoric_gradient_row(np.int64(23), scale, where, centres, weights, total)


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


@njit(inline="always")
def _part(of, start, stop):
    """Three rows, from start to stop."""
    return of[0, start:stop], of[1, start:stop], of[2, start:stop]


@threaded(over="points", each=BLOCK, **OUTER)
def radial_sum(begin, end, kernel, scale, points, centres, weights, low, width, counts, starts, out):
    """Add sum_j K(x_i - c_j) w_j to ``out`` (N, 3); centres and weights are (3, m), in the order of their cells."""
    n = points.shape[0]
    for block in range(begin, end):
        runs = np.empty((9, 2), np.int64)
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            where = (points[i, 0], points[i, 1], points[i, 2])
            for run in range(_runs(where[0], where[1], where[2], low, width, counts, starts, runs)):
                start, stop = runs[run, 0], runs[run, 1]
                _any_row(kernel, scale, where, _part(centres, start, stop), _part(weights, start, stop), out[i])


@threaded(over="points", each=BLOCK, **OUTER)
def radial_sum_with_gradient(begin, end, kernel, scale, points, centres, weights, low, width, counts, starts, out):
    """Add the sum and its gradient to ``out`` (N, 12): 3 values, then 9 derivatives row by row."""
    n = points.shape[0]
    for block in range(begin, end):
        runs = np.empty((9, 2), np.int64)
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            where = (points[i, 0], points[i, 1], points[i, 2])
            for run in range(_runs(where[0], where[1], where[2], low, width, counts, starts, runs)):
                start, stop = runs[run, 0], runs[run, 1]
                _any_gradient_row(
                    kernel, scale, where, _part(centres, start, stop), _part(weights, start, stop), out[i]
                )


@njit(**INNER)
def _fill_row(kernel, scale, where, centres, row):
    x, y, z = where
    cx, cy, cz = centres
    for j in range(cx.size):
        dx, dy, dz = x - cx[j], y - cy[j], z - cz[j]
        row[j], _ = _scalar(kernel, scale, dx * dx + dy * dy + dz * dz)


@threaded(over="points", least=16, **OUTER)
def scalar_matrix(begin, end, kernel, scale, points, centres, out):
    """Kernel matrix (N, m) between points (N, 3) and centres (3, m)."""
    for i in range(begin, end):
        where, row = (points[i, 0], points[i, 1], points[i, 2]), out[i]
        sources = _part(centres, 0, centres.shape[1])
        if kernel == 0:
            _fill_row(np.int64(0), scale, where, sources, row)
        elif kernel == 1:
            _fill_row(np.int64(1), scale, where, sources, row)
        else:
            _fill_row(kernel, scale, where, sources, row)


@threaded(over="points", least=16, **OUTER)
def isochoric_matrix(begin, end, kernel, scale, points, centres, out):
    """Kernel matrix (3 N, 3 m): the block of point i and centre j stands at [3i:3i+3, 3j:3j+3]."""
    for i in range(begin, end):
        for j in range(centres.shape[1]):
            dx, dy, dz = points[i, 0] - centres[0, j], points[i, 1] - centres[1, j], points[i, 2] - centres[2, j]
            f, _, g, _ = _isochoric(kernel, scale, dx * dx + dy * dy + dz * dz)
            apart = (dx, dy, dz)
            for k in range(3):
                for n in range(3):
                    outer = g * apart[k] * apart[n]
                    out[3 * i + k, 3 * j + n] = outer + f if k == n else outer
