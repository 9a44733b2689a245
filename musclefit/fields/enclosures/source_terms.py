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

from typing import Any

import numpy as np

from musclefit.compiling import njit

PROOF: dict[str, Any] = {"error_model": "numpy"}
"""Options of compiled functions that proofs rest on: nothing is reassociated or contracted."""

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
def table_cell(low, scale, extent, cells):
    """Cell of a majorant table for a distance that is at least ``low``."""
    if low <= 0.0:
        return 0
    return int(min(low / scale * (1.0 - 1e-12) / extent, 1.0) * cells)


def tabulated_terms(derivatives: Any, *, ends: bool, compact: bool) -> Any:
    """The terms of a scalar kernel with a table: first order, or by the sup of the term where that is less.

    Parameters
    ----------
    derivatives : compiled (q) -> (f_1, f_2, first, second)
        At distance q, in units of the kernel's scale: the chain, and the sizes of what the gradient's term and its
        derivative are computed from.
    ends : bool
        Only the sup counts beyond the table's extent, where the derivatives are too small to compute.
    compact : bool
        Nothing beyond q = 1.
    """

    @njit(**PROOF)
    def terms(scale, extent, table, block):
        n1, n3 = table[0], table[2]
        cells = n1.size - 1
        s = 1.0 / scale
        for i in range(LANES):
            h = block[H + i]
            r = np.sqrt(block[R2 + i])
            low = r - h
            k = table_cell(low, scale, extent, cells)
            by_value = n1[k] * s
            q = r * s
            g, t, first, second, jump = 0.0, 0.0, 0.0, 0.0, 0.0
            remainder = 0.5 * h * h * n3[k] * s * s * s
            if remainder > by_value or (ends and q > extent):
                remainder = by_value
                jump = by_value
            elif not compact or low <= scale:
                f1, f2, first, second = derivatives(q)
                g, t, first, second = s * s * f1, s * s * s * s * f2, s * first, s * s * second
            block[G + i], block[F + i], block[T + i] = g, g, t
            block[STRAIN + i], block[FIRST + i], block[SECOND + i], block[JUMP + i] = remainder, first, second, jump

    return terms


@njit(**PROOF)
def isochoric_sizes(block):
    """``FIRST``, ``SECOND`` and ``THIRD`` of an isochoric kernel from its chain f_2 ... f_5."""
    for i in range(LANES):
        r2 = block[R2 + i]
        r = np.sqrt(r2)
        f2, f3, f4 = abs(block[G + i]), abs(block[F + i]), abs(block[T + i])
        block[FIRST + i] = (6.0 * f2 + 2.0 * f3 * r2) * r
        block[SECOND + i] = 6.0 * f2 + (12.0 * f3 + 2.0 * f4 * r2) * r2
        block[THIRD + i] = (
            36.0 * abs(block[B + i]) + (22.0 * abs(block[C + i]) + 2.0 * abs(block[D + i]) * r2) * r2
        ) * r
