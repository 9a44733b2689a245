"""Radial sums at points with a proved bound of their own rounding; see `bounds` for how it is reckoned."""

from __future__ import annotations

import numpy as np

from musclefit.compiling import njit, threaded
from musclefit.fields.enclosures.source_terms import SMALL, rounding_share


@njit(cache=True, error_model="numpy")
def slope_bound(code, slope, r):
    """Sup of |grad D| per unit of weight over distances up to r, from the constant or the table's largest value."""
    if code == 1:
        return r * (2.0 * abs(np.log(max(r, 1e-100))) + 1.0) + 1.0
    if code == 2 or code == 22:
        return slope * r * r
    return slope


@njit(cache=True, error_model="numpy")
def value_terms(code, scale, r):
    """f and g of K(x) w = f w + g (x . w) x, and a bound of the sum of the absolute values of their rounded parts."""
    q = r / scale
    u = max(1.0 - q, 0.0)
    inside = 1.0 if q < 1.0 + 1e-12 else 0.0
    if code == 0:
        return -r, 0.0, r
    if code == 1:
        if r < 1e-150:
            return 0.0, 0.0, SMALL
        log = np.log(r)
        return r * r * log, 0.0, r * r * (abs(log) + 1.0)
    if code == 2:
        return r * r * r, 0.0, r * r * r
    if code == 3:
        return np.exp(-q * q), 0.0, 1.0
    if code == 4:
        return 1.0 / np.sqrt(1.0 + q * q), 0.0, 1.0
    if code == 5:
        return u * u * u * u * (4.0 * q + 1.0), 0.0, 5.0 * inside
    if code == 6:
        return u * u * u * u * u * u * (35.0 * q * q + 18.0 * q + 3.0) / 3.0, 0.0, 19.0 * inside
    if code == 20:
        return -9.0 * r, 3.0 / max(r, 1e-100), 12.0 * r
    if code == 21:
        rho = np.sqrt(r * r + scale * scale)
        return -6.0 * rho - 3.0 * r * r / rho, 3.0 / rho, 12.0 * rho
    if code == 22:
        return 25.0 * r * r * r, -15.0 * r, 40.0 * r * r * r
    u6 = u * u * u * u * u * u
    return (
        44.0 * u6 * (1.0 + q * (6.0 - q * (3.0 + 88.0 * q))),
        528.0 * u6 * (6.0 * q + 1.0) / (scale * scale),
        8100.0 * inside,
    )


@threaded(over="points", least=16, error_model="numpy")
def values(begin, end, code, isochoric, scale, slope, sources, weights, sizes, points, blur, out, errors):
    """Write the radial sum at points (N, 3) local to the origin to ``out``, and its rounding error to ``errors`` (N,).

    ``slope``: the constant of the kernel's sup |grad D| per unit of weight (see `slope_bound`).
    """
    m = sizes.size
    for i in range(begin, end):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        u, v, w, parts, steep = 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(m):
            dx, dy, dz = x - sources[0, j], y - sources[1, j], z - sources[2, j]
            r = np.sqrt(dx * dx + dy * dy + dz * dz)
            a, b, c = weights[0, j], weights[1, j], weights[2, j]
            f, g, size = value_terms(code, scale, r)
            if isochoric:
                s = g * (dx * a + dy * b + dz * c)
                u += f * a + s * dx
                v += f * b + s * dy
                w += f * c + s * dz
            else:
                u += f * a
                v += f * b
                w += f * c
            parts += sizes[j] * size
            steep += sizes[j] * slope_bound(code, slope, r + 2.0 * blur)
        out[i, 0], out[i, 1], out[i, 2] = u, v, w
        errors[i] = (4.0 * rounding_share(m) * parts + blur * steep) * (1.0 + rounding_share(m)) + SMALL
