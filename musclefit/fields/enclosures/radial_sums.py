"""Rigorous sums over boxes and sources: enclosures of a radial field's gradient and strain, rounded outward.

The terms come from a kernel. Nothing here is reassociated or contracted, so every operation is correctly rounded. Sums
of m terms, each of fewer than 100 operations on parts whose absolute values add to at most ``first`` (of the gradient)
and ``second`` (of its derivative along a unit direction), are off by at most `rounding_share` times these in each
entry, hence 3 times that in norm; 4 is used. Coordinates local to the field's origin are off by ``blur`` (mm), which is
added to the half diagonals and, times ``second``, to the radius.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from musclefit.compiling import njit, threaded
from musclefit.fields.enclosures.box_sums import block_sums
from musclefit.fields.enclosures.eigenvalues import eigenvalue_floor
from musclefit.fields.enclosures.source_terms import LANES, SMALL, rounding_share

UNRESOLVED = 0.01
"""Jumps at a centre above which nothing is said of the strain there."""


@njit(cache=True, error_model="numpy")
def _half_diagonals(half_widths, balls, start, stop, blur):
    """The farthest that a point of a box is from its centre, where it stays within the ball around it."""
    h = np.empty(LANES)
    for lane in range(LANES):
        i = min(start + lane, stop - 1)
        x, y, z = half_widths[i, 0], half_widths[i, 1], half_widths[i, 2]
        h[lane] = min(np.sqrt(x * x + y * y + z * z), balls[i]) * (1.0 + 1e-15) + blur
    return h


@njit(cache=True, error_model="numpy")
def _block(boxes, start):
    """(3, LANES) centres of the boxes from ``start`` on; the last one again where there are no more."""
    where = np.empty((3, LANES))
    for lane in range(LANES):
        for k in range(3):
            where[k, lane] = boxes[min(start + lane, boxes.shape[0] - 1), k]
    return where


@njit(cache=True, error_model="numpy")
def _slack(sums, i, h, m, blur):
    """Rounding of the matrix and of its derivatives over the box, and the blur of coordinates."""
    rounded = 4.0 * rounding_share(m) * (sums[29, i] + h * (sums[30, i] + h * sums[31, i]))
    return rounded + blur * (sums[30, i] + 2.0 * h * sums[31, i]) + SMALL


@njit(cache=True, error_model="numpy")
def _total(sums, i):
    total = 0.0
    for row in range(sums.shape[0]):
        total += sums[row, i]
    return total


@njit(cache=True, error_model="numpy")
def _quadratic(sums, i, half, h, symmetric):
    """Bound of the second-derivative term over the box: half of the sup of |sum of e_k e_m M_km| (Frobenius).

    By |e_k| <= half_k, or, since the squares of the e_k e_m sum to |e|⁴ <= h⁴, by Cauchy-Schwarz. Of the matrices'
    symmetric parts when ``symmetric``.
    """
    by_sides, squares = 0.0, 0.0
    for n in range(6):
        # (k, m) = xx, xy, xz, yy, yz, zz: the rows of (x, k, m), (y, k, m) and (z, k, m)
        if n == 0:
            k, m, x, y, z = 0, 0, 0, 1, 2
        elif n == 1:
            k, m, x, y, z = 0, 1, 1, 3, 4
        elif n == 2:
            k, m, x, y, z = 0, 2, 2, 4, 5
        elif n == 3:
            k, m, x, y, z = 1, 1, 3, 6, 7
        elif n == 4:
            k, m, x, y, z = 1, 2, 4, 7, 8
        else:
            k, m, x, y, z = 2, 2, 5, 8, 9
        xx, xy, xz = sums[33 + x, i], sums[33 + y, i], sums[33 + z, i]
        yx, yy, yz = sums[43 + x, i], sums[43 + y, i], sums[43 + z, i]
        zx, zy, zz = sums[53 + x, i], sums[53 + y, i], sums[53 + z, i]
        if symmetric:
            xy, xz, yz = 0.5 * (xy + yx), 0.5 * (xz + zx), 0.5 * (yz + zy)
            yx, zx, zy = xy, xz, yz
        square = xx * xx + xy * xy + xz * xz + yx * yx + yy * yy + yz * yz + zx * zx + zy * zy + zz * zz
        times = 1.0 if k == m else 2.0
        by_sides += times * half[k] * half[m] * np.sqrt(square)
        squares += times * square
    return 0.5 * min(by_sides, h * h * np.sqrt(squares)) * (1.0 + 1e-13)


@njit(cache=True, error_model="numpy")
def _derivative_square(sums, i):
    """Sup over unit e of the squared Frobenius norm of the gradient's derivative along e: an eigenvalue of its Gram."""
    gram = np.zeros(6)  # xx, yy, zz, xy, xz, yz
    for k in range(3):
        r = 9 + 6 * k
        a, b, c, d, e, f = sums[r, i], sums[r + 1, i], sums[r + 2, i], sums[r + 3, i], sums[r + 4, i], sums[r + 5, i]
        gram[0] += a * a + b * b + c * c
        gram[1] += b * b + d * d + e * e
        gram[2] += c * c + e * e + f * f
        gram[3] += a * b + b * d + c * e
        gram[4] += a * c + b * e + c * f
        gram[5] += b * c + d * e + e * f
    return -eigenvalue_floor(-gram[0], -gram[1], -gram[2], -gram[3], -gram[4], -gram[5])


@njit(cache=True, error_model="numpy")
def _strain(sums, i, row, planar, out):
    """The strain of the whole gradient (row 0) or of its derivative along axis row - 1: (xx, yy, zz, xy, xz, yz).

    In the plane the third eigenvalue is set to the mean of the other two, so that it is never the smallest or largest.
    """
    if row == 0:
        out[0], out[1], out[2] = sums[0, i], sums[4, i], sums[8, i]
        out[3] = 0.5 * (sums[1, i] + sums[3, i])
        out[4] = 0.5 * (sums[2, i] + sums[6, i])
        out[5] = 0.5 * (sums[5, i] + sums[7, i])
    else:
        # entry (k, l) of component n stands in row 9 + 6 n + PLACE[k, l]
        x, y, z = 0, 1, 2
        if row == 2:
            x, y, z = 1, 3, 4
        elif row == 3:
            x, y, z = 2, 4, 5
        out[0], out[1], out[2] = sums[9 + x, i], sums[15 + y, i], sums[21 + z, i]
        out[3] = 0.5 * (sums[9 + y, i] + sums[15 + x, i])
        out[4] = 0.5 * (sums[9 + z, i] + sums[21 + x, i])
        out[5] = 0.5 * (sums[15 + z, i] + sums[21 + y, i])
    if planar:
        out[2], out[4], out[5] = 0.5 * (out[0] + out[1]), 0.0, 0.0


@njit(cache=True, error_model="numpy")
def _strain_square(parts):
    """Sup over unit e of the squared Frobenius norm of the strain's derivative along e."""
    gram = np.empty((3, 3))
    for k in range(3):
        for n in range(k + 1):
            a, b = parts[k + 1], parts[n + 1]
            gram[k, n] = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + 2.0 * (a[3] * b[3] + a[4] * b[4] + a[5] * b[5])
    return -eigenvalue_floor(-gram[0, 0], -gram[1, 1], -gram[2, 2], -gram[1, 0], -gram[2, 0], -gram[2, 1])


@njit(cache=True, error_model="numpy")
def _corner_floor(parts, half, ball, sign, quick):
    """Floor of sign times the eigenvalues of parts[0] + sum of e_k parts[k + 1] over |e_k| <= half_k, and at e = 0.

    The smallest eigenvalue is concave in the matrix, hence smallest at a corner of the box. The corners are left out
    when a bound by Frobenius norms already gives ``quick``; so they are where only the ball |e| <= ``ball`` counts.
    """
    m = sign * parts[0]
    middle = eigenvalue_floor(m[0], m[1], m[2], m[3], m[4], m[5])
    deviation = 0.0
    for corner in range(4):
        d = half[0] * parts[1]
        d = d + half[1] * (1 - 2 * (corner & 1)) * parts[2] + half[2] * (1 - (corner & 2)) * parts[3]
        square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2] + 2.0 * (d[3] * d[3] + d[4] * d[4] + d[5] * d[5])
        deviation = max(deviation, square)
    deviation = np.sqrt(deviation) * (1.0 + 1e-14)
    if ball < np.inf:
        deviation = min(deviation, ball * np.sqrt(_strain_square(parts)) * (1.0 + 1e-14))
    if deviation == 0.0 or middle - deviation >= quick or ball < np.inf:
        return middle, middle - deviation
    lowest = np.inf
    for corner in range(8):
        d = half[0] * (1 - 2 * (corner & 1)) * parts[1] + half[1] * (1 - (corner & 2)) * parts[2]
        d = m + sign * (d + half[2] * (1 - (corner & 4) // 2) * parts[3])
        lowest = min(lowest, eigenvalue_floor(d[0], d[1], d[2], d[3], d[4], d[5]))
    return middle, max(lowest, middle - deviation)


@njit(cache=True, error_model="numpy")
def _gradient(sums, i, half, ball, h, m, blur, second_order, out):
    """Write the gradient at a box's centre (3, 3); gives how far from it that of any place of the box is at most."""
    longest = 0.0  # Frobenius norm of the linear part, convex in the corner: largest at one of them
    for corner in range(4):
        sy, sz = half[1] * (1 - 2 * (corner & 1)), half[2] * (1 - (corner & 2))
        square = 0.0
        for k in range(3):
            r = 9 + 6 * k
            ux = half[0] * sums[r, i] + sy * sums[r + 1, i] + sz * sums[r + 2, i]
            uy = half[0] * sums[r + 1, i] + sy * sums[r + 3, i] + sz * sums[r + 4, i]
            uz = half[0] * sums[r + 2, i] + sy * sums[r + 4, i] + sz * sums[r + 5, i]
            square += ux * ux + uy * uy + uz * uz
        longest = max(longest, square)
    if ball < np.inf:
        longest = min(longest, ball**2 * _derivative_square(sums, i))
    for k in range(9):
        out[k // 3, k % 3] = sums[k, i]
    if not np.isfinite(_total(sums, i)):  # an overflow proves nothing
        return np.inf
    quadratic = _quadratic(sums, i, half, h, False) if second_order else 0.0
    return (np.sqrt(longest) + quadratic + sums[28, i] + _slack(sums, i, h, m, blur)) * (1.0 + rounding_share(m))


class BoxSums(NamedTuple):
    """A kernel's compiled enclosures over boxes."""

    gradients: Callable[..., None]
    strains: Callable[..., None]


@cache
def box_sums(terms: Any, *, isochoric: bool, second_order: bool) -> BoxSums:
    """A kernel's enclosures over boxes; see `musclefit.fields.kernels.model.Enclosure`."""
    sum_block = block_sums(terms, isochoric=isochoric, second_order=second_order)

    @threaded(over="boxes", each=LANES, error_model="numpy")
    def gradient_boxes(
        begin,
        end,
        scale,
        extent,
        table,
        reach,
        sources,
        weights,
        sizes,
        linear,
        boxes,
        half_widths,
        balls,
        blur,
        gradients,
        radii,
    ):
        """Enclose the gradient over boxes: ``gradients`` (B, 3, 3) and ``radii`` (B,) are written.

        ``boxes`` (B, 3) centres and ``sources`` (3, m) are local to the field's origin; ``sizes`` (m,) are at least the
        lengths of the ``weights`` (3, m); ``reach`` is the support of a compact kernel, else infinite. ``balls`` (B,):
        only points of a box that are within this distance of its centre count; infinite for all.
        """
        count, m = boxes.shape[0], sizes.size
        for block in range(begin, end):
            start, stop = block * LANES, min(count, (block + 1) * LANES)
            h = _half_diagonals(half_widths, balls, start, stop, blur)
            sums = sum_block(scale, extent, table, reach, sources, weights, sizes, linear, _block(boxes, start), h)
            for i in range(stop - start):
                half, ball = half_widths[start + i], balls[start + i]
                radii[start + i] = _gradient(sums, i, half, ball, h[i], m, blur, second_order, gradients[start + i])

    @threaded(over="boxes", each=LANES, error_model="numpy")
    def strain_boxes(
        begin,
        end,
        scale, extent, table, reach, sources, weights, sizes, linear, boxes, half_widths, balls, blur,
        planar, enough, gradients, radii, bounds, middles,
    ):  # fmt: skip
        """As ``gradient_boxes``, and bound the strain's eigenvalues: ``bounds`` and ``middles`` (B, 2) are written.

        Every eigenvalue anywhere in box b is within ``bounds[b]``. ``middles[b]`` is about the range at its centre, NaN
        where sources are too near for the box to tell. ``enough`` (2,): bounds at least that good need no tightening.
        """
        count, m = boxes.shape[0], sizes.size
        for block in range(begin, end):
            start, stop = block * LANES, min(count, (block + 1) * LANES)
            h = _half_diagonals(half_widths, balls, start, stop, blur)
            sums = sum_block(scale, extent, table, reach, sources, weights, sizes, linear, _block(boxes, start), h)
            parts = np.empty((4, 6))
            for i in range(stop - start):
                for row in range(4):
                    _strain(sums, i, row, planar, parts[row])
                half, ball = half_widths[start + i], balls[start + i]
                radii[start + i] = _gradient(sums, i, half, ball, h[i], m, blur, second_order, gradients[start + i])
                quadratic = _quadratic(sums, i, half, h[i], True) if second_order else 0.0
                loss = (quadratic + sums[27, i] + _slack(sums, i, h[i], m, blur)) * (1.0 + rounding_share(m))
                for side in range(2):  # one call, so that it is compiled into this once
                    sign = 1.0 - 2.0 * side
                    middle, low = _corner_floor(parts, half, ball, sign, sign * enough[side] + loss)
                    bounds[start + i, side], middles[start + i, side] = sign * (low - loss), sign * middle
                if sums[32, i] > UNRESOLVED:
                    middles[start + i, 0], middles[start + i, 1] = np.nan, np.nan
                if not np.isfinite(_total(sums, i)):  # an overflow proves nothing
                    bounds[start + i, 0], bounds[start + i, 1] = -np.inf, np.inf

    return BoxSums(gradient_boxes, strain_boxes)
