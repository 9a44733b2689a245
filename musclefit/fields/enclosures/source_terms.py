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

from musclefit.compiling import njit

NEAR_R = 0.4
"""h / r above which a source of kernel r counts as near: its term is then the ball around the cone of directions."""
NEAR_LOG = 0.7
NEAR_R3 = 0.4
"""The same for r² log r and for isochoric-r3."""

SMALL = 1e-280
"""Added to bounds that underflow could make 0."""

LANES = 32
"""Boxes that are treated side by side, in vector instructions. All numbers of such a block stand in one flat array of
rows of this length, at places known when the loops are compiled."""

X, Y, Z, R2, H, G, F, T, B, C, D, STRAIN, WHOLE, FIRST, SECOND, THIRD, JUMP = (k * LANES for k in range(17))
"""Rows: from a source to the boxes' centres, its square, half diagonals with blur, a term's coefficients, remainders of
strain and whole gradient, sizes, and what the gradient at the centre may be off."""

SUMS = 17 * LANES
"""The first row after those of one source."""


@njit(cache=True, error_model="numpy")
def rounding_share(m):
    """GAMMA(m): relative rounding of a sum of m terms, generously."""
    return (m + 400.0) * 2.3e-16


@njit(inline="always")
def _cell(low, scale, extent, cells):
    """Cell of a majorant table for a distance that is at least ``low``."""
    if low <= 0.0:
        return 0
    return int(min(low / scale * (1.0 - 1e-12) / extent, 1.0) * cells)


@njit(cache=True, error_model="numpy")
def scalar_terms(kernel, scale, extent, table, block):
    """Per box: gradient w (g x)^T, its derivatives, remainder, sizes of the rounded parts, and what its centre misses.

    From squared distances R2 and half diagonals H (blur included). A table's units are turned into mm here. The
    derivative along e is w (f e + t (x . e) x)^T; the second is w (2 b (x . e) e + b |e|² x + c (x . e)² x)^T, where it
    is used. ``JUMP`` bounds how far the gradient at the centre is from the true one there.
    """
    if kernel == 0:
        _terms_of_r(block)
    elif kernel == 1:
        _terms_of_r2logr(block)
    elif kernel == 2:
        _terms_of_r3(table[2, 0], block)
    else:
        _tabulated_terms(kernel, scale, extent, table, block)
    for i in range(LANES):
        block[WHOLE + i] = block[STRAIN + i]


# The loops below compute all values before they choose, for vector instructions; what is not chosen may be no number.


@njit(cache=True, error_model="numpy")
def _terms_of_r(block):
    """-r: second order, or the ball of radius sin a around cos a times the unit vector: it holds a cone of angle a."""
    for i in range(LANES):
        r2, h = block[R2 + i], block[H + i]
        r = np.sqrt(r2)
        q, inverse = h / r, 1.0 / r
        square = inverse * inverse
        far, cone = h < NEAR_R * r, h < r
        shrunk = np.sqrt(max(1.0 - q * q, 0.0)) * inverse
        by_order = 0.5 * q * q * q / (1.0 - q)
        t, c = inverse * square, -3.0 * inverse * square * square
        near_g = -shrunk if cone else 0.0
        near_remainder = q if cone else 1.0
        block[G + i] = -inverse if far else near_g
        block[F + i] = -inverse if far else 0.0
        block[T + i] = t if far else 0.0
        block[B + i] = t if far else 0.0
        block[C + i] = c if far else 0.0
        block[STRAIN + i] = by_order if far else near_remainder
        block[FIRST + i] = 1.0
        block[SECOND + i] = 2.0 * inverse if far else 0.0
        block[THIRD + i] = 6.0 * square if far else 0.0
        block[JUMP + i] = 0.0 if far else near_remainder


@njit(cache=True, error_model="numpy")
def _terms_of_r2logr(block):
    """r² log r: second order, or, with y = r / L <= 1, r (2 log r + 1) = r (2 log L + 0.44) + L y (2 log y + 0.56).

    The last part is at most 0.57 L in size: 0.56 L at y = 1, and -2 L exp(-1.28) where its derivative vanishes.
    """
    for i in range(LANES):
        r2, h = block[R2 + i], block[H + i]
        r = np.sqrt(r2)
        longest = max(r + h, 1e-150)
        block[G + i] = r2 if h < NEAR_LOG * r else longest * longest
    for i in range(LANES):
        block[G + i] = np.log(block[G + i])
    for i in range(LANES):
        r2, h, log = block[R2 + i], block[H + i], block[G + i]
        r = np.sqrt(r2)
        longest = max(r + h, 1e-150)
        q, inverse2 = h / r, 1.0 / r2
        far = h < NEAR_LOG * r
        by_order, near_remainder = h * q * q * (1.0 + 2.0 * q), 0.57 * longest
        t, c, third = 2.0 * inverse2, -4.0 * inverse2 * inverse2, 10.0 / r
        slope = log + 1.0 if far else log + 0.44
        block[G + i] = slope
        block[F + i] = slope
        block[T + i] = t if far else 0.0
        block[B + i] = t if far else 0.0
        block[C + i] = c if far else 0.0
        block[STRAIN + i] = by_order if far else near_remainder
        block[FIRST + i] = longest * (abs(log) + 4.0)
        block[SECOND + i] = abs(log) + 8.0
        block[THIRD + i] = third if far else 0.0
        block[JUMP + i] = 0.0 if far else near_remainder


@njit(cache=True, error_model="numpy")
def _terms_of_r3(n3, block):
    """r³: second order while the box stays away from the source, else first order."""
    for i in range(LANES):
        r2, h = block[R2 + i], block[H + i]
        r = np.sqrt(r2)
        far = h < r
        q, safe = h / r, max(r, 1e-100)
        t, c = 3.0 / safe, -3.0 / (safe * safe * safe)
        by_order, near_remainder = h * h * q * (1.5 + 0.75 * q), 0.5 * n3 * h * h
        block[G + i] = 3.0 * r
        block[F + i] = 3.0 * r
        block[T + i] = t
        block[B + i] = t if far else 0.0
        block[C + i] = c if far else 0.0
        block[STRAIN + i] = by_order if far else near_remainder
        block[FIRST + i] = 3.0 * r2
        block[SECOND + i] = 6.0 * r
        block[THIRD + i] = 12.0 if far else 0.0
        block[JUMP + i] = 0.0


@njit(cache=True, error_model="numpy")
def _tabulated_terms(kernel, scale, extent, table, block):
    """Kernels with a table: first order, or by the sup of the term where that is less."""
    n1, n3 = table[0], table[2]
    cells = n1.size - 1
    s = 1.0 / scale
    for i in range(LANES):
        h = block[H + i]
        r = np.sqrt(block[R2 + i])
        low = r - h
        k = _cell(low, scale, extent, cells)
        by_value = n1[k] * s
        q = r * s
        g, t, first, second, jump = 0.0, 0.0, 0.0, 0.0, 0.0
        remainder = 0.5 * h * h * n3[k] * s * s * s
        if remainder > by_value or (kernel == 3 and q > extent):
            remainder = by_value
            jump = by_value
        elif kernel == 3:  # Gaussian
            e = np.exp(-q * q)
            g = -2.0 * s * s * e
            t = 4.0 * s * s * s * s * e
            first = 2.0 * s * q * (1.0 + q * q) * e
            second = s * s * (2.0 + 4.0 * q * q) * (1.0 + q * q) * e
        elif kernel == 4:  # inverse multiquadric
            e = 1.0 / np.sqrt(1.0 + q * q)
            e3 = e * e * e
            g = -s * s * e3
            t = 3.0 * s * s * s * s * e3 * e * e
            first = s * q * e3
            second = s * s * e3 * (1.0 + 3.0 * q * q * e * e)
        elif low <= scale:  # compact: 1 - q cancels, so the sizes are those at its largest
            u = max(1.0 - q, 0.0)
            if kernel == 5:
                g = -20.0 * s * s * u * u * u
                t = 60.0 * s * s * s * s * u * u / max(q, 1e-100)
                first = 20.0 * s
                second = 80.0 * s * s
            else:
                u4 = u * u * u * u
                g = -56.0 / 3.0 * s * s * u4 * u * (5.0 * q + 1.0)
                t = 560.0 * s * s * s * s * u4
                first = 112.0 * s
                second = 672.0 * s * s
        block[G + i], block[F + i], block[T + i] = g, g, t
        block[STRAIN + i], block[FIRST + i], block[SECOND + i], block[JUMP + i] = remainder, first, second, jump


@njit(cache=True, error_model="numpy")
def isochoric_terms(kernel, scale, extent, table, block):
    """Per box: the potential's chain, remainders of strain and whole, sizes, ``JUMP`` as above.

    f_2, f_3, f_4 in G, F, T give the gradient and its first derivative; B, C, D are f_3, f_4, f_5 where the second
    derivative is used, else 0.
    """
    if kernel == 20:
        _terms_of_isochoric_r3(table, block)
    elif kernel == 21:
        _terms_of_mollified(scale, table, block)
    elif kernel == 22:
        _terms_of_isochoric_r5(table, block)
    else:
        _terms_of_wendland_c6(scale, extent, table, block)
        return
    for i in range(LANES):
        r2 = block[R2 + i]
        r = np.sqrt(r2)
        f2, f3, f4 = abs(block[G + i]), abs(block[F + i]), abs(block[T + i])
        block[FIRST + i] = (6.0 * f2 + 2.0 * f3 * r2) * r
        block[SECOND + i] = 6.0 * f2 + (12.0 * f3 + 2.0 * f4 * r2) * r2
        block[THIRD + i] = (
            36.0 * abs(block[B + i]) + (22.0 * abs(block[C + i]) + 2.0 * abs(block[D + i]) * r2) * r2
        ) * r


@njit(cache=True, error_model="numpy")
def _terms_of_isochoric_r3(table, block):
    """psi = r³: second order, or the sup of the term."""
    s1, s4, w1, w4 = table[0, 0], table[3, 0], table[4, 0], table[7, 0]
    for i in range(LANES):
        r2, h = block[R2 + i], block[H + i]
        r = np.sqrt(r2)
        far = h < NEAR_R3 * r
        q, inverse = h / r, 1.0 / r
        share = q * q * q / (6.0 * (1.0 - q))
        square = inverse * inverse
        f2, f3 = 3.0 * inverse, -3.0 * inverse * square
        f4 = 9.0 * inverse * square * square
        f5 = -45.0 * inverse * square * square * square
        block[G + i] = f2 if far else 0.0
        block[F + i] = f3 if far else 0.0
        block[T + i] = f4 if far else 0.0
        block[B + i] = f3 if far else 0.0
        block[C + i] = f4 if far else 0.0
        block[D + i] = f5 if far else 0.0
        block[STRAIN + i] = s4 * share if far else s1
        block[WHOLE + i] = w4 * share if far else w1
        block[JUMP + i] = 0.0 if far else s1


@njit(cache=True, error_model="numpy")
def _terms_of_mollified(scale, table, block):
    """psi = (r² + scale²)^(3/2): the order with the smaller remainder, or the sup of the term."""
    s1, s3, s4, w1, w3, w4 = table[0, 0], table[2, 0], table[3, 0], table[4, 0], table[6, 0], table[7, 0]
    for i in range(LANES):
        r2, h = block[R2 + i], block[H + i]
        low = max(np.sqrt(r2) - h, 0.0)
        q = h / np.sqrt(low * low + scale * scale)
        by_first, by_second = 0.5 * q * q, q * q * q / 6.0
        second = s4 * by_second < s3 * by_first
        strain = s4 * by_second if second else s3 * by_first
        whole = w4 * by_second if second else w3 * by_first
        far = strain <= s1
        inverse = 1.0 / np.sqrt(r2 + scale * scale)
        square = inverse * inverse
        f2, f3 = 3.0 * inverse, -3.0 * inverse * square
        f4 = 9.0 * inverse * square * square
        f5 = -45.0 * inverse * square * square * square
        used = far and second
        block[G + i] = f2 if far else 0.0
        block[F + i] = f3 if far else 0.0
        block[T + i] = f4 if far else 0.0
        block[B + i] = f3 if used else 0.0
        block[C + i] = f4 if used else 0.0
        block[D + i] = f5 if used else 0.0
        block[STRAIN + i] = strain if far else s1
        block[WHOLE + i] = whole if far else w1
        block[JUMP + i] = 0.0 if far else s1


@njit(cache=True, error_model="numpy")
def _terms_of_isochoric_r5(table, block):
    """psi = -r⁵: second order while the box stays away from the source, else first order."""
    s3, s4, w3, w4 = table[2, 0], table[3, 0], table[6, 0], table[7, 0]
    for i in range(LANES):
        r2, h = block[R2 + i], block[H + i]
        r = np.sqrt(r2)
        far = h < r
        q, safe = h / r, max(r, 1e-40)
        inverse = 1.0 / safe
        f3, f4 = -15.0 * inverse, 15.0 * inverse * inverse * inverse
        f5 = -45.0 * inverse * inverse * inverse * inverse * inverse
        by_first, by_second = 0.5 * h * h, h * h * q * (2.0 + q) / 12.0
        block[G + i] = -15.0 * r
        block[F + i] = f3
        block[T + i] = f4
        block[B + i] = f3 if far else 0.0
        block[C + i] = f4 if far else 0.0
        block[D + i] = f5 if far else 0.0
        block[STRAIN + i] = s4 * by_second if far else s3 * by_first
        block[WHOLE + i] = w4 * by_second if far else w3 * by_first
        block[JUMP + i] = 0.0


@njit(cache=True, error_model="numpy")
def _terms_of_wendland_c6(scale, extent, table, block):
    """Compact: the order with the smaller remainder, or the sup of the term. Sizes are those at 1 - q = 1."""
    s1, s3, s4, w1, w3, w4 = table[0], table[2], table[3], table[4], table[6], table[7]
    cells = s1.size - 1
    s = 1.0 / scale
    s2 = s * s
    for i in range(LANES):
        r, h = np.sqrt(block[R2 + i]), block[H + i]
        low = r - h
        k = _cell(low, scale, extent, cells)
        q, t = r * s, h * s
        by_first, by_second = 0.5 * s3[k] * t * t * s, s4[k] * t * t * t * s / 6.0
        second = by_second < by_first and q > 0.0
        strain = by_second if second else by_first
        whole = w4[k] * t * t * t * s / 6.0 if second else 0.5 * w3[k] * t * t * s
        f2, f3, f4, f5, jump = 0.0, 0.0, 0.0, 0.0, 0.0
        if strain > s1[k] * s:
            strain, whole, jump = s1[k] * s, w1[k] * s, s1[k] * s
            second = False
        elif low <= scale:
            u, safe = max(1.0 - q, 0.0), max(q, 1e-40)
            u3 = u * u * u
            f2 = 528.0 * s2 * u3 * u3 * (6.0 * q + 1.0)
            f3 = -22176.0 * s2 * s2 * u3 * u * u
            f4 = 110880.0 * s2 * s2 * s2 * u3 * u / safe
            f5 = -110880.0 * s2 * s2 * s2 * s2 * u3 * (1.0 + 3.0 * q) / (safe * safe * safe)
        inside = 1.0 if low <= scale else 0.0
        block[G + i], block[F + i], block[T + i] = f2, f3, f4
        block[B + i], block[C + i], block[D + i] = (f3, f4, f5) if second else (0.0, 0.0, 0.0)
        block[STRAIN + i], block[WHOLE + i], block[JUMP + i] = strain, whole, jump
        block[FIRST + i], block[SECOND + i] = inside * 1e5 * s, inside * 6e5 * s2
        block[THIRD + i] = inside * 5e6 * s2 * s
