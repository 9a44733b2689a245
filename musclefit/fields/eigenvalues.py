"""Proved bounds of the eigenvalues of symmetric 3 x 3 matrices."""

from __future__ import annotations

import numpy as np
from numba import njit

SMALL = 1e-280


@njit(cache=True, error_model="numpy")
def _smallest_eigenvalue(a, b, c, d, e, f):
    """Approximate smallest eigenvalue of [[a, d, e], [d, b, f], [e, f, c]] (Smith 1961)."""
    q = (a + b + c) / 3.0
    x, y, z = a - q, b - q, c - q
    p2 = (x * x + y * y + z * z + 2.0 * (d * d + e * e + f * f)) / 6.0
    if p2 <= 1e-300:
        return q
    p = np.sqrt(p2)
    half = 0.5 * (x * (y * z - f * f) - d * (d * z - f * e) + e * (d * f - y * e)) / (p2 * p)
    angle = np.arccos(min(max(half, -1.0), 1.0)) / 3.0
    return q + 2.0 * p * np.cos(angle + 2.0943951023931953)


@njit(cache=True, error_model="numpy")
def eigenvalue_floor(a, b, c, d, e, f):
    """A number that no eigenvalue of [[a, d, e], [d, b, f], [e, f, c]] is below, close to the smallest.

    A shift is accepted when elimination finds the shifted matrix positive definite; the rounding of that elimination
    is at most 16 units times the trace of the shifted matrix (Higham 2002, theorem 10.3, with n = 3), whose
    entries are at most 4 times the norm taken here.
    """
    norm = abs(a) + abs(b) + abs(c) + 2.0 * (abs(d) + abs(e) + abs(f))
    guess = _smallest_eigenvalue(a, b, c, d, e, f)
    slack = 1e-13 * norm + SMALL
    for _ in range(60):
        shift = guess - slack
        first = a - shift
        if first > 0.0:
            second = b - shift - d * d / first
            if second > 0.0:
                g = f - d * e / first
                if c - shift - e * e / first - g * g / second > 0.0:
                    return shift - 4e-14 * (norm + slack) - SMALL
        slack *= 4.0
    return -np.inf
