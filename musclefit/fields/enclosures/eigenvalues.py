"""Proved bounds of the eigenvalues of symmetric 3 x 3 matrices."""

from __future__ import annotations

import numpy as np

from musclefit.compiling import njit

NORM_ROUNDING = 1.0 + 1e-13
"""A norm's own rounding: powers and roots of sums of at most 9 positive terms."""

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


@njit(cache=True)
def norm_ceiling(matrix):
    """Upper bound of the spectral norm of a (3, 3) matrix."""
    hull = np.empty((9, 64))
    for row in range(9):
        hull[row] = matrix[row // 3, row % 3]
    return largest_norm(hull, np.zeros((3, 3)), np.empty(64))


@njit(cache=True)
def largest_norm(hull, centre, traces):
    """Upper bound of the largest spectral norm of 64 matrices (rows of ``hull``: their entries) minus the centre.

    By the eighth root of tr (M^T M)^4, which is at most 15 % above it.
    """
    largest = 0.0
    for row in range(9):
        for lane in range(64):
            largest = max(largest, abs(hull[row, lane] - centre[row // 3, row % 3]))
    if largest == 0.0:
        return 0.0
    if not largest < 1e300:
        return np.inf
    s = 1.0 / largest
    c0, c1, c2, c3, c4, c5 = centre[0, 0], centre[0, 1], centre[0, 2], centre[1, 0], centre[1, 1], centre[1, 2]
    c6, c7, c8 = centre[2, 0], centre[2, 1], centre[2, 2]
    for lane in range(64):
        a, b, c = s * (hull[0, lane] - c0), s * (hull[1, lane] - c1), s * (hull[2, lane] - c2)
        d, e, f = s * (hull[3, lane] - c3), s * (hull[4, lane] - c4), s * (hull[5, lane] - c5)
        g, h, i = s * (hull[6, lane] - c6), s * (hull[7, lane] - c7), s * (hull[8, lane] - c8)
        xx, yy, zz = a * a + d * d + g * g, b * b + e * e + h * h, c * c + f * f + i * i
        xy, xz, yz = a * b + d * e + g * h, a * c + d * f + g * i, b * c + e * f + h * i
        pxx, pyy, pzz = xx * xx + xy * xy + xz * xz, xy * xy + yy * yy + yz * yz, xz * xz + yz * yz + zz * zz
        pxy, pxz = xx * xy + xy * yy + xz * yz, xx * xz + xy * yz + xz * zz
        pyz = xy * xz + yy * yz + yz * zz
        traces[lane] = pxx * pxx + pyy * pyy + pzz * pzz + 2.0 * (pxy * pxy + pxz * pxz + pyz * pyz)
    steepest = 0.0
    for lane in range(64):
        if not (traces[lane] <= steepest or np.isnan(steepest)):
            steepest = traces[lane]
    return largest * steepest**0.125 * NORM_ROUNDING


@njit(cache=True)
def floor_of(m, n, sign):
    """A number that no eigenvalue of sign times the symmetric part of m is below."""
    a, b, d = sign * m[0, 0], sign * m[1, 1], 0.5 * sign * (m[0, 1] + m[1, 0])
    if n == 2:  # a third eigenvalue a, which is no smaller than the smallest
        return eigenvalue_floor(a, b, a, d, 0.0, 0.0)
    e, f = 0.5 * sign * (m[0, 2] + m[2, 0]), 0.5 * sign * (m[1, 2] + m[2, 1])
    return eigenvalue_floor(a, b, sign * m[2, 2], d, e, f)


@njit(cache=True)
def _floor_at(hull, lane, n, sign):
    """`floor_of` one of 64 matrices."""
    m = np.empty((3, 3))
    for row in range(9):
        m[row // 3, row % 3] = hull[row, lane]
    return floor_of(m, n, sign)


@njit(cache=True)
def _clear(hull, n, sign, shift, size, clear):
    """Set ``clear`` where sign times the symmetric part plus shift is proved positive definite, by leading minors.

    With entries of at most ``size``, the second and third minor are off by fewer than 4 and 20 roundings of its powers.
    """
    second, third = 1e-14 * size * size, 1e-13 * size * size * size
    for lane in range(64):
        a, b, c = sign * hull[0, lane] + shift, sign * hull[4, lane] + shift, sign * hull[8, lane] + shift
        d, e = 0.5 * sign * (hull[1, lane] + hull[3, lane]), 0.5 * sign * (hull[2, lane] + hull[6, lane])
        f = 0.5 * sign * (hull[5, lane] + hull[7, lane])
        minor = a * b - d * d
        whole = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
        clear[lane] = (a > 0.0) & (minor > second) & ((whole > third) | (n == 2))


@njit(cache=True)
def ceiling_of_hull(hull, n, sign, found, clear):
    """The larger of ``found`` and a bound that no eigenvalue of -sign times the 64 symmetric parts is above.

    At most 1e-7 of the matrices' size above the bound that `floor_of` each of them gives.
    """
    largest, first, least = 0.0, 0, np.inf
    for lane in range(64):
        size = 0.0
        for row in range(9):
            size = max(size, abs(hull[row, lane]))
        largest = max(largest, size)
        # A guess of which is worst: the trace less the size.
        guess = sign * (hull[0, lane] + hull[4, lane] + hull[8, lane]) - 3.0 * size
        if guess < least:
            least, first = guess, lane
    slack = 1e-7 * largest
    ceiling = max(found, slack - _floor_at(hull, first, n, sign))
    _clear(hull, n, sign, ceiling, largest + abs(ceiling), clear)
    for lane in range(64):
        if clear[lane]:
            continue
        same = True
        for row in range(9):
            same = same and hull[row, lane] == hull[row, first]
        if same:
            continue
        value = slack - _floor_at(hull, lane, n, sign)
        if not value <= ceiling:
            ceiling, first = value, lane
            _clear(hull, n, sign, ceiling, largest + abs(ceiling), clear)
    return ceiling


@njit(cache=True)
def widen_by_hull(hull, n, centre, strain, found, lanes, clear):
    """Widen what is found of one part by the 64 matrices whose hull holds the gradients of another.

    ``found`` is [radius] of the distance from the centre, or for strain [-lowest, highest] eigenvalue of the symmetric
    parts; ``lanes`` and ``clear`` are (64,) to work in.
    """
    total = 0.0
    for row in range(9):
        for lane in range(64):
            total += hull[row, lane]
    if not np.isfinite(total):  # proves nothing
        found[:] = np.inf
        return
    if not strain:
        found[0] = max(found[0], largest_norm(hull, centre, lanes))
        return
    for side in range(2):  # one call, so that it is compiled into this once
        found[side] = ceiling_of_hull(hull, n, 1.0 - 2.0 * side, found[side], clear)
