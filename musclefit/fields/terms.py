"""Enclosures of one source's term over boxes, kernel by kernel: everything in the rigorous sums that knows the kernel.

For a box with centre p and a source at distance r from it, the source's term of the gradient is enclosed by its value
and first derivative at p and a remainder (*second order*), or, where the source is so near that this is worse, by a
fixed matrix and the sup of the term (*jump*). Writing the box as p + e, |e| <= h, the remainder of the first is

    integral over t in [0, 1] of (1 - t) h² N3(r - t h) dt

with N3 a falling majorant of the second derivative of the gradient (see `majorants`): with q = h / r

* N3 = C / r²: C (-log(1 - q) - q) <= C q² / (2 (1 - q));
* else: h² N3(r - h) / 2.

The homogeneous scalar kernels are taken one order further where q <= 1: by the second derivative at p too, and

    integral over t in [0, 1] of (1 - t)² / 2 h³ N4(r - t h) dt,  N4 = sup |w (grad d_e³ phi)^T| = sup |d_e⁴ phi|

(the symmetric form takes its norm at four equal directions). With c the cosine between e and x,
d_e⁴ phi = f_4 r⁴ c⁴ + 6 f_3 r² c² + 3 f_2 is

* -r:       (15 c⁴ - 18 c² + 3) / r³, at most 3 / r³: 3/2 q³ (sum of q^k / (k+3)) <= q³ / (2 (1 - q));
* r² log r: (16 c⁴ - 24 c² + 6) / r², at most 6 / r²: 3 h q² (sum of 2 q^k / ((k+2) (k+3))) <= h q² (1 + 2 q);
* r³:       9 (1 - c²)² / r, at most 9 / r: 9/2 h² q (sum of 2 q^k / ((k+1) (k+2) (k+3))) <= h² q (3/2 + 3/4 q),

sums over k >= 0. So are the isochoric kernels: with C / r³ the same sum is at most C q³ / (6 (1 - q)), with C / r at
most C h² q (2 + q) / 12, and a bounded N4 leaves h³ N4(r - h) / 6.

Beside it stand the *sizes*: sums of the absolute values of the parts that a term and its derivative along a unit
direction are computed from, which their rounding is proportional to; the second bounds that derivative too.
"""

from __future__ import annotations

import numpy as np
from numba import njit

NEAR_R = 0.4
"""h / r above which a source of kernel r counts as near: its term is then the ball around the cone of directions."""
NEAR_LOG = 0.7
NEAR_R3 = 0.4
"""The same for r² log r and for isochoric-r3."""

SMALL = 1e-280
"""Added to bounds that underflow could make 0."""


@njit(inline="always")
def _cell(low, scale, extent, cells):
    """Cell of a majorant table for a distance that is at least ``low``."""
    if low <= 0.0:
        return 0
    return int(min(low / scale * (1.0 - 1e-12) / extent, 1.0) * cells)


@njit(cache=True, error_model="numpy")
def scalar_terms(kernel, scale, extent, table, r2, h, g, f, t, b, c, remainder, first, second, third, jump):
    """Per box: gradient w (g x)^T, its derivatives, remainder, sizes of the rounded parts, and what its centre misses.

    From squared distances r2 and radii h (blur included). A table's units are turned into mm here. The derivative along
    e is w (f e + t (x . e) x)^T; the second is w (2 b (x . e) e + b |e|² x + c (x . e)² x)^T, where it is used.
    ``jump`` bounds how far the gradient at the centre is from the true one there.
    """
    n1, n3 = table[0], table[2]
    cells = n1.size - 1
    for i in range(r2.size):
        r = np.sqrt(r2[i])
        g[i], f[i], t[i], b[i], c[i] = 0.0, 0.0, 0.0, 0.0, 0.0
        first[i], second[i], third[i], jump[i] = 0.0, 0.0, 0.0, 0.0
        if kernel == 0:  # -r: the unit vector
            if h[i] < NEAR_R * r:
                q = h[i] / r
                g[i] = -1.0 / r
                f[i] = g[i]
                t[i] = 1.0 / (r2[i] * r)
                b[i] = t[i]
                c[i] = -3.0 * t[i] / r2[i]
                remainder[i] = 0.5 * q * q * q / (1.0 - q)
                second[i] = 2.0 / r
                third[i] = 6.0 / r2[i]
            elif h[i] < r:  # the ball with radius sin a around cos a times the unit vector holds the cone of angle a
                q = h[i] / r
                g[i] = -np.sqrt(1.0 - q * q) / r
                remainder[i] = q
                jump[i] = q
            else:
                remainder[i] = 1.0
                jump[i] = 1.0
            first[i] = 1.0
        elif kernel == 1:  # r² log r
            if h[i] < NEAR_LOG * r:
                q = h[i] / r
                log = np.log(r2[i])
                g[i] = log + 1.0
                t[i] = 2.0 / r2[i]
                b[i] = t[i]
                c[i] = -4.0 / (r2[i] * r2[i])
                remainder[i] = h[i] * q * q * (1.0 + 2.0 * q)
                first[i] = r * (abs(log) + 4.0)
                second[i] = abs(log) + 8.0
                third[i] = 10.0 / r
            else:  # with y = r / L <= 1: r (2 log r + 1) = r (2 log L + 1 - 0.56) + L y (2 log y + 0.56), |.| <= 0.57 L
                longest = max(r + h[i], 1e-150)
                log = 2.0 * np.log(longest)
                g[i] = log + 0.44
                remainder[i] = 0.57 * longest
                jump[i] = remainder[i]
                first[i] = longest * (abs(log) + 4.0)
                second[i] = abs(log) + 4.0
            f[i] = g[i]
        elif kernel == 2:  # r³
            g[i] = 3.0 * r
            f[i] = g[i]
            t[i] = 3.0 / max(r, 1e-100)
            first[i] = 3.0 * r2[i]
            second[i] = 6.0 * r
            if h[i] < r:
                q = h[i] / r
                b[i] = t[i]
                c[i] = -3.0 / (r2[i] * r)
                remainder[i] = h[i] * h[i] * q * (1.5 + 0.75 * q)
                third[i] = 12.0
            else:
                remainder[i] = 0.5 * n3[0] * h[i] * h[i]
        else:
            low = r - h[i]
            k = _cell(low, scale, extent, cells)
            s = 1.0 / scale
            by_value = n1[k] * s
            q = r * s
            remainder[i] = 0.5 * h[i] * h[i] * n3[k] * s * s * s
            if remainder[i] > by_value or (kernel == 3 and q > extent):
                remainder[i] = by_value
                jump[i] = by_value
            elif kernel == 3:  # Gaussian
                e = np.exp(-q * q)
                g[i] = -2.0 * s * s * e
                f[i] = g[i]
                t[i] = 4.0 * s * s * s * s * e
                first[i] = 2.0 * s * q * (1.0 + q * q) * e
                second[i] = s * s * (2.0 + 4.0 * q * q) * (1.0 + q * q) * e
            elif kernel == 4:  # inverse multiquadric
                e = 1.0 / np.sqrt(1.0 + q * q)
                e3 = e * e * e
                g[i] = -s * s * e3
                f[i] = g[i]
                t[i] = 3.0 * s * s * s * s * e3 * e * e
                first[i] = s * q * e3
                second[i] = s * s * e3 * (1.0 + 3.0 * q * q * e * e)
            elif low <= scale:  # compact: 1 - q cancels, so the sizes are those at its largest
                u = max(1.0 - q, 0.0)
                if kernel == 5:
                    g[i] = -20.0 * s * s * u * u * u
                    t[i] = 60.0 * s * s * s * s * u * u / max(q, 1e-100)
                    first[i] = 20.0 * s
                    second[i] = 80.0 * s * s
                else:
                    u4 = u * u * u * u
                    g[i] = -56.0 / 3.0 * s * s * u4 * u * (5.0 * q + 1.0)
                    t[i] = 560.0 * s * s * s * s * u4
                    first[i] = 112.0 * s
                    second[i] = 672.0 * s * s
                f[i] = g[i]


@njit(cache=True, error_model="numpy")
def isochoric_terms(
    kernel, scale, extent, table, r2, h, f2, f3, f4, b3, b4, b5, strain, whole, first, second, third, jump
):
    """Per box: the potential's chain, remainders of strain and whole, sizes, and ``jump`` as above.

    f_2, f_3, f_4 give the gradient and its first derivative; b_3, b_4, b_5 are f_3, f_4, f_5 where the second
    derivative is used, else 0.
    """
    s1, s3, s4, w1, w3, w4 = table[0], table[2], table[3], table[4], table[6], table[7]
    cells = s1.size - 1
    for i in range(r2.size):
        r = np.sqrt(r2[i])
        f2[i], f3[i], f4[i], b3[i], b4[i], b5[i] = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        jump[i], low, fifth = 0.0, 0.0, 0.0
        if kernel == 20:  # psi = r³
            if h[i] < NEAR_R3 * r:
                q = h[i] / r
                share = q * q * q / (6.0 * (1.0 - q))
                inverse = 1.0 / r
                square = inverse * inverse
                f2[i] = 3.0 * inverse
                f3[i] = -3.0 * inverse * square
                f4[i] = 9.0 * inverse * square * square
                fifth = -45.0 * inverse * square * square * square
                strain[i], whole[i] = s4[0] * share, w4[0] * share
            else:
                strain[i], whole[i] = s1[0], w1[0]
                jump[i] = s1[0]
        elif kernel == 21:  # psi = (r² + scale²)^(3/2)
            low = max(r - h[i], 0.0)
            q = h[i] / np.sqrt(low * low + scale * scale)
            by_value = s3[0] * q * q * 0.5 > s1[0] and s4[0] * q * q * q / 6.0 > s1[0]
            if by_value:
                strain[i], whole[i] = s1[0], w1[0]
                jump[i] = s1[0]
            else:
                inverse = 1.0 / np.sqrt(r2[i] + scale * scale)
                square = inverse * inverse
                f2[i] = 3.0 * inverse
                f3[i] = -3.0 * inverse * square
                f4[i] = 9.0 * inverse * square * square
                if s4[0] * q < 3.0 * s3[0]:
                    fifth = -45.0 * inverse * square * square * square
                    strain[i], whole[i] = s4[0] * q * q * q / 6.0, w4[0] * q * q * q / 6.0
                else:
                    strain[i], whole[i] = s3[0] * q * q * 0.5, w3[0] * q * q * 0.5
        elif kernel == 22:  # psi = -r⁵
            safe = max(r, 1e-40)
            f2[i] = -15.0 * r
            f3[i] = -15.0 / safe
            f4[i] = 15.0 / (safe * safe * safe)
            if h[i] < r:
                q = h[i] / r
                share = h[i] * h[i] * q * (2.0 + q) / 12.0
                fifth = -45.0 / (safe * safe * safe * safe * safe)
                strain[i], whole[i] = s4[0] * share, w4[0] * share
            else:
                strain[i], whole[i] = 0.5 * s3[0] * h[i] * h[i], 0.5 * w3[0] * h[i] * h[i]
        else:  # Wendland C6
            low = r - h[i]
            k = _cell(low, scale, extent, cells)
            s = 1.0 / scale
            q, t = r * s, h[i] * s
            by_third, by_second = s4[k] * t * t * t * s / 6.0, s3[k] * t * t * s * 0.5
            if min(by_third, by_second) > s1[k] * s:
                strain[i], whole[i] = s1[k] * s, w1[k] * s
                jump[i] = strain[i]
            elif low <= scale:
                u = max(1.0 - q, 0.0)
                u4 = u * u * u * u
                s2 = s * s
                safe = max(q, 1e-40)
                f2[i] = 528.0 * s2 * u4 * u * u * (6.0 * q + 1.0)
                f3[i] = -22176.0 * s2 * s2 * u4 * u
                f4[i] = 110880.0 * s2 * s2 * s2 * u4 / safe
                if by_third < by_second and q > 0.0:
                    fifth = -110880.0 * s2 * s2 * s2 * s2 * u * u * u * (1.0 + 3.0 * q) / (safe * safe * safe)
                    strain[i], whole[i] = by_third, w4[k] * t * t * t * s / 6.0
                else:
                    strain[i], whole[i] = by_second, w3[k] * t * t * s * 0.5
            else:
                strain[i], whole[i] = by_second, w3[k] * t * t * s * 0.5
        if fifth != 0.0:
            b3[i], b4[i], b5[i] = f3[i], f4[i], fifth
        if kernel == 23:
            inside = 1.0 if low <= scale else 0.0
            first[i], second[i] = inside * 1e5 / scale, inside * 6e5 / (scale * scale)
            third[i] = inside * 5e6 / (scale * scale * scale)
        else:
            first[i] = 6.0 * abs(f2[i]) * r + 2.0 * abs(f3[i]) * r2[i] * r
            second[i] = 6.0 * abs(f2[i]) + 12.0 * abs(f3[i]) * r2[i] + 2.0 * abs(f4[i]) * r2[i] * r2[i]
            third[i] = (36.0 * abs(b3[i]) + (22.0 * abs(b4[i]) + 2.0 * abs(b5[i]) * r2[i]) * r2[i]) * r


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
