"""Sums over all sources, box by box, of what a kernel's terms give: gradients, derivatives, and bounds beside.

Nothing is reassociated or contracted; see `radial_sums` for what that is worth.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from musclefit.compiling import njit
from musclefit.fields.enclosures.source_terms import (
    LANES,
    R2,
    STRAIN,
    SUMS,
    WHOLE,
    B,
    C,
    D,
    F,
    G,
    H,
    T,
    X,
    Y,
    Z,
)

PARTS = 63
"""Rows of the sums of a box: the gradient (9), its derivatives (3 x 6), remainders of strain and of the whole, first,
second and third sizes, jumps, and the gradient's second derivatives (3 x 10)."""


@njit(cache=True, error_model="numpy")
def _add_scalar(u, v, w, block):
    """Add one source's gradient w (g d)^T and its derivatives w_i (f delta_kl + t d_k d_l) to the rows of ``sums``."""
    for i in range(LANES):
        x, y, z = block[X + i], block[Y + i], block[Z + i]
        gx, gy, gz = block[G + i] * x, block[G + i] * y, block[G + i] * z
        tx, ty = block[T + i] * x, block[T + i] * y
        xx, xy, xz = block[F + i] + tx * x, tx * y, tx * z
        yy, yz, zz = block[F + i] + ty * y, ty * z, block[F + i] + block[T + i] * z * z
        block[SUMS + 0 * LANES + i] += u * gx
        block[SUMS + 1 * LANES + i] += u * gy
        block[SUMS + 2 * LANES + i] += u * gz
        block[SUMS + 9 * LANES + i] += u * xx
        block[SUMS + 10 * LANES + i] += u * xy
        block[SUMS + 11 * LANES + i] += u * xz
        block[SUMS + 12 * LANES + i] += u * yy
        block[SUMS + 13 * LANES + i] += u * yz
        block[SUMS + 14 * LANES + i] += u * zz
        block[SUMS + 3 * LANES + i] += v * gx
        block[SUMS + 4 * LANES + i] += v * gy
        block[SUMS + 5 * LANES + i] += v * gz
        block[SUMS + 15 * LANES + i] += v * xx
        block[SUMS + 16 * LANES + i] += v * xy
        block[SUMS + 17 * LANES + i] += v * xz
        block[SUMS + 18 * LANES + i] += v * yy
        block[SUMS + 19 * LANES + i] += v * yz
        block[SUMS + 20 * LANES + i] += v * zz
        block[SUMS + 6 * LANES + i] += w * gx
        block[SUMS + 7 * LANES + i] += w * gy
        block[SUMS + 8 * LANES + i] += w * gz
        block[SUMS + 21 * LANES + i] += w * xx
        block[SUMS + 22 * LANES + i] += w * xy
        block[SUMS + 23 * LANES + i] += w * xz
        block[SUMS + 24 * LANES + i] += w * yy
        block[SUMS + 25 * LANES + i] += w * yz
        block[SUMS + 26 * LANES + i] += w * zz


@njit(cache=True, error_model="numpy")
def _add_scalar_third(u, v, w, block):
    """Add w_i (b (x_k delta_lm + x_l delta_km + x_m delta_kl) + c x_k x_l x_m), k <= l <= m in order."""
    for i in range(LANES):
        x, y, z = block[X + i], block[Y + i], block[Z + i]
        bx, by, bz = block[B + i] * x, block[B + i] * y, block[B + i] * z
        cx, cy, cz = block[C + i] * x * x, block[C + i] * y * y, block[C + i] * z * z
        xxx, xxy, xxz = 3.0 * bx + cx * x, by + cx * y, bz + cx * z
        xyy, xyz, xzz = bx + cy * x, block[C + i] * x * y * z, bx + cz * x
        yyy, yyz, yzz, zzz = 3.0 * by + cy * y, bz + cy * z, by + cz * y, 3.0 * bz + cz * z
        block[SUMS + 33 * LANES + i] += u * xxx
        block[SUMS + 34 * LANES + i] += u * xxy
        block[SUMS + 35 * LANES + i] += u * xxz
        block[SUMS + 36 * LANES + i] += u * xyy
        block[SUMS + 37 * LANES + i] += u * xyz
        block[SUMS + 38 * LANES + i] += u * xzz
        block[SUMS + 39 * LANES + i] += u * yyy
        block[SUMS + 40 * LANES + i] += u * yyz
        block[SUMS + 41 * LANES + i] += u * yzz
        block[SUMS + 42 * LANES + i] += u * zzz
        block[SUMS + 43 * LANES + i] += v * xxx
        block[SUMS + 44 * LANES + i] += v * xxy
        block[SUMS + 45 * LANES + i] += v * xxz
        block[SUMS + 46 * LANES + i] += v * xyy
        block[SUMS + 47 * LANES + i] += v * xyz
        block[SUMS + 48 * LANES + i] += v * xzz
        block[SUMS + 49 * LANES + i] += v * yyy
        block[SUMS + 50 * LANES + i] += v * yyz
        block[SUMS + 51 * LANES + i] += v * yzz
        block[SUMS + 52 * LANES + i] += v * zzz
        block[SUMS + 53 * LANES + i] += w * xxx
        block[SUMS + 54 * LANES + i] += w * xxy
        block[SUMS + 55 * LANES + i] += w * xxz
        block[SUMS + 56 * LANES + i] += w * xyy
        block[SUMS + 57 * LANES + i] += w * xyz
        block[SUMS + 58 * LANES + i] += w * xzz
        block[SUMS + 59 * LANES + i] += w * yyy
        block[SUMS + 60 * LANES + i] += w * yyz
        block[SUMS + 61 * LANES + i] += w * yzz
        block[SUMS + 62 * LANES + i] += w * zzz


@njit(cache=True, error_model="numpy")
def _add_isochoric(a, b, c, block):
    """The same for D = -omega w + (grad d_w psi).

    d_k D_i = A w_i x_k + f_3 s x_i x_k + f_2 (w_k x_i + s delta_ik), s = x . w, A = -(4 f_2 + r² f_3);
    d_l d_k D_i = w_i P_kl + x_i Q_kl + delta_il z_k + delta_ik z_l with P = A' x x^T + A I, A' = -(6 f_3 + r² f_4),
    Q = f_4 s x x^T + f_3 (w x^T + x w^T) + f_3 s I, z = f_3 s x + f_2 w.
    """
    for i in range(LANES):
        x, y, z = block[X + i], block[Y + i], block[Z + i]
        s = x * a + y * b + z * c
        A = -(4.0 * block[G + i] + block[R2 + i] * block[F + i])
        slope = -(6.0 * block[F + i] + block[R2 + i] * block[T + i])
        curl = block[F + i] * s
        along = block[G + i] * s
        ux, uy, uz = A * a + curl * x, A * b + curl * y, A * c + curl * z
        vx, vy, vz = block[G + i] * x, block[G + i] * y, block[G + i] * z
        block[SUMS + 0 * LANES + i] += ux * x + vx * a + along
        block[SUMS + 1 * LANES + i] += ux * y + vx * b
        block[SUMS + 2 * LANES + i] += ux * z + vx * c
        block[SUMS + 3 * LANES + i] += uy * x + vy * a
        block[SUMS + 4 * LANES + i] += uy * y + vy * b + along
        block[SUMS + 5 * LANES + i] += uy * z + vy * c
        block[SUMS + 6 * LANES + i] += uz * x + vz * a
        block[SUMS + 7 * LANES + i] += uz * y + vz * b
        block[SUMS + 8 * LANES + i] += uz * z + vz * c + along
        fa, fb, fc = block[F + i] * a, block[F + i] * b, block[F + i] * c
        qx, qy, qz = block[T + i] * s * x, block[T + i] * s * y, block[T + i] * s * z
        Qxx, Qxy, Qxz = qx * x + 2.0 * fa * x + curl, qx * y + fa * y + fb * x, qx * z + fa * z + fc * x
        Qyy, Qyz, Qzz = qy * y + 2.0 * fb * y + curl, qy * z + fb * z + fc * y, qz * z + 2.0 * fc * z + curl
        px, py, pz = slope * x, slope * y, slope * z
        Pxx, Pxy, Pxz, Pyy, Pyz, Pzz = px * x + A, px * y, px * z, py * y + A, py * z, pz * z + A
        zx, zy, zz = curl * x + block[G + i] * a, curl * y + block[G + i] * b, curl * z + block[G + i] * c
        block[SUMS + 9 * LANES + i] += a * Pxx + x * Qxx + 2.0 * zx
        block[SUMS + 10 * LANES + i] += a * Pxy + x * Qxy + zy
        block[SUMS + 11 * LANES + i] += a * Pxz + x * Qxz + zz
        block[SUMS + 12 * LANES + i] += a * Pyy + x * Qyy
        block[SUMS + 13 * LANES + i] += a * Pyz + x * Qyz
        block[SUMS + 14 * LANES + i] += a * Pzz + x * Qzz
        block[SUMS + 15 * LANES + i] += b * Pxx + y * Qxx
        block[SUMS + 16 * LANES + i] += b * Pxy + y * Qxy + zx
        block[SUMS + 17 * LANES + i] += b * Pxz + y * Qxz
        block[SUMS + 18 * LANES + i] += b * Pyy + y * Qyy + 2.0 * zy
        block[SUMS + 19 * LANES + i] += b * Pyz + y * Qyz + zz
        block[SUMS + 20 * LANES + i] += b * Pzz + y * Qzz
        block[SUMS + 21 * LANES + i] += c * Pxx + z * Qxx
        block[SUMS + 22 * LANES + i] += c * Pxy + z * Qxy
        block[SUMS + 23 * LANES + i] += c * Pxz + z * Qxz + zx
        block[SUMS + 24 * LANES + i] += c * Pyy + z * Qyy
        block[SUMS + 25 * LANES + i] += c * Pyz + z * Qyz + zy
        block[SUMS + 26 * LANES + i] += c * Pzz + z * Qzz + 2.0 * zz


@njit(cache=True, error_model="numpy")
def _add_isochoric_third(a, b, c, block):
    """Add d_k d_l d_m D_i = V_iklm - w_i W_klm, k <= l <= m in order.

    V is the fourth derivative of d_w psi; with any vector n four times f_5 s (x.n)⁴ + f_4 (6 s (x.n)² n² + 4 (w.n)
    (x.n)³) + f_3 (3 s n⁴ + 12 (w.n) (x.n) n²), s = x . w. W is that of omega: omega_3 (x.n)³ + 3 omega_2 (x.n) n².
    """
    for i in range(LANES):
        x, y, z, p, q, r = block[X + i], block[Y + i], block[Z + i], block[B + i], block[C + i], block[D + i]
        s = x * a + y * b + z * c
        xx, yy, zz = x * x, y * y, z * z
        xy, xz, yz = x * y, x * z, y * z
        # f_5 s x_k x_l x_m x_n + f_4 (...) + f_3 (...), by index
        rs, qs, ps = r * s, q * s, p * s
        Vxxxx = rs * xx * xx + 6.0 * qs * xx + 4.0 * q * a * x * xx + 3.0 * ps + 12.0 * p * a * x
        Vyyyy = rs * yy * yy + 6.0 * qs * yy + 4.0 * q * b * y * yy + 3.0 * ps + 12.0 * p * b * y
        Vzzzz = rs * zz * zz + 6.0 * qs * zz + 4.0 * q * c * z * zz + 3.0 * ps + 12.0 * p * c * z
        ay, az, bx, bz, cx, cy = a * y, a * z, b * x, b * z, c * x, c * y
        Vxxxy = rs * xx * xy + 3.0 * qs * xy + q * xx * (3.0 * ay + bx) + 3.0 * p * (ay + bx)
        Vxxxz = rs * xx * xz + 3.0 * qs * xz + q * xx * (3.0 * az + cx) + 3.0 * p * (az + cx)
        Vxyyy = rs * yy * xy + 3.0 * qs * xy + q * yy * (3.0 * bx + ay) + 3.0 * p * (ay + bx)
        Vyyyz = rs * yy * yz + 3.0 * qs * yz + q * yy * (3.0 * bz + cy) + 3.0 * p * (bz + cy)
        Vxzzz = rs * zz * xz + 3.0 * qs * xz + q * zz * (3.0 * cx + az) + 3.0 * p * (az + cx)
        Vyzzz = rs * zz * yz + 3.0 * qs * yz + q * zz * (3.0 * cy + bz) + 3.0 * p * (bz + cy)
        Vxxyy = rs * xx * yy + qs * (xx + yy) + 2.0 * q * xy * (ay + bx) + ps + 2.0 * p * (a * x + b * y)
        Vxxzz = rs * xx * zz + qs * (xx + zz) + 2.0 * q * xz * (az + cx) + ps + 2.0 * p * (a * x + c * z)
        Vyyzz = rs * yy * zz + qs * (yy + zz) + 2.0 * q * yz * (bz + cy) + ps + 2.0 * p * (b * y + c * z)
        Vxxyz = rs * xx * yz + qs * yz + q * (2.0 * a * x * yz + xx * (bz + cy)) + p * (bz + cy)
        Vxyyz = rs * yy * xz + qs * xz + q * (2.0 * b * y * xz + yy * (az + cx)) + p * (az + cx)
        Vxyzz = rs * zz * xy + qs * xy + q * (2.0 * c * z * xy + zz * (ay + bx)) + p * (ay + bx)
        two, three = 7.0 * p + block[R2 + i] * q, 9.0 * q + block[R2 + i] * r
        Wxxx, Wyyy, Wzzz = x * (three * xx + 3.0 * two), y * (three * yy + 3.0 * two), z * (three * zz + 3.0 * two)
        Wxxy, Wxxz = y * (three * xx + two), z * (three * xx + two)
        Wxyy, Wyyz = x * (three * yy + two), z * (three * yy + two)
        Wxzz, Wyzz = x * (three * zz + two), y * (three * zz + two)
        Wxyz = three * x * yz
        block[SUMS + 33 * LANES + i] += Vxxxx - a * Wxxx
        block[SUMS + 34 * LANES + i] += Vxxxy - a * Wxxy
        block[SUMS + 35 * LANES + i] += Vxxxz - a * Wxxz
        block[SUMS + 36 * LANES + i] += Vxxyy - a * Wxyy
        block[SUMS + 37 * LANES + i] += Vxxyz - a * Wxyz
        block[SUMS + 38 * LANES + i] += Vxxzz - a * Wxzz
        block[SUMS + 39 * LANES + i] += Vxyyy - a * Wyyy
        block[SUMS + 40 * LANES + i] += Vxyyz - a * Wyyz
        block[SUMS + 41 * LANES + i] += Vxyzz - a * Wyzz
        block[SUMS + 42 * LANES + i] += Vxzzz - a * Wzzz
        block[SUMS + 43 * LANES + i] += Vxxxy - b * Wxxx
        block[SUMS + 44 * LANES + i] += Vxxyy - b * Wxxy
        block[SUMS + 45 * LANES + i] += Vxxyz - b * Wxxz
        block[SUMS + 46 * LANES + i] += Vxyyy - b * Wxyy
        block[SUMS + 47 * LANES + i] += Vxyyz - b * Wxyz
        block[SUMS + 48 * LANES + i] += Vxyzz - b * Wxzz
        block[SUMS + 49 * LANES + i] += Vyyyy - b * Wyyy
        block[SUMS + 50 * LANES + i] += Vyyyz - b * Wyyz
        block[SUMS + 51 * LANES + i] += Vyyzz - b * Wyzz
        block[SUMS + 52 * LANES + i] += Vyzzz - b * Wzzz
        block[SUMS + 53 * LANES + i] += Vxxxz - c * Wxxx
        block[SUMS + 54 * LANES + i] += Vxxyz - c * Wxxy
        block[SUMS + 55 * LANES + i] += Vxxzz - c * Wxxz
        block[SUMS + 56 * LANES + i] += Vxyyz - c * Wxyy
        block[SUMS + 57 * LANES + i] += Vxyzz - c * Wxyz
        block[SUMS + 58 * LANES + i] += Vxzzz - c * Wxzz
        block[SUMS + 59 * LANES + i] += Vyyyz - c * Wyyy
        block[SUMS + 60 * LANES + i] += Vyyzz - c * Wyyz
        block[SUMS + 61 * LANES + i] += Vyzzz - c * Wyzz
        block[SUMS + 62 * LANES + i] += Vzzzz - c * Wzzz


@njit(cache=True, error_model="numpy")
def _add_remainders(size, block):
    """Add a source's share of remainders, sizes and jump: six rows."""
    for k in range(6):
        for i in range(LANES):
            block[SUMS + (27 + k) * LANES + i] += size * block[STRAIN + k * LANES + i]


@njit(cache=True, error_model="numpy")
def _offsets(x, y, z, places, block):
    """From a source to the boxes' centres."""
    for i in range(LANES):
        dx, dy, dz = places[i] - x, places[LANES + i] - y, places[2 * LANES + i] - z
        block[X + i], block[Y + i], block[Z + i] = dx, dy, dz
        block[R2 + i] = dx * dx + dy * dy + dz * dz


@njit(cache=True, error_model="numpy")
def _whole_is_strain(block):
    """A scalar kernel's gradient is a product of two vectors: its whole remainder is that of the strain."""
    for i in range(LANES):
        block[WHOLE + i] = block[STRAIN + i]


def block_sums(terms: Any, *, isochoric: bool, second_order: bool) -> Any:
    """A kernel's sums (PARTS, LANES) over the sources; see `musclefit.fields.kernels.model.Enclosure`.

    They take ``boxes`` (3, LANES), local centres, and ``h``, half diagonals with blur.
    """
    if isochoric:

        @njit(error_model="numpy")
        def add(u, v, w, block):
            _add_isochoric(u, v, w, block)
            _add_isochoric_third(u, v, w, block)
    elif second_order:

        @njit(error_model="numpy")
        def add(u, v, w, block):
            _whole_is_strain(block)
            _add_scalar(u, v, w, block)
            _add_scalar_third(u, v, w, block)
    else:

        @njit(error_model="numpy")
        def add(u, v, w, block):
            _whole_is_strain(block)
            _add_scalar(u, v, w, block)

    @njit(error_model="numpy")
    def sum_block(scale, extent, table, reach, sources, weights, sizes, linear, boxes, h):
        block = np.zeros(SUMS + PARTS * LANES)
        places = np.empty(3 * LANES)
        for i in range(LANES):  # assigning slices takes seconds to compile
            block[H + i] = h[i]
            places[i], places[LANES + i], places[2 * LANES + i] = boxes[0, i], boxes[1, i], boxes[2, i]
        middle, radius = _enclosing_ball(boxes, h)
        for j in range(sizes.size):
            x, y, z = sources[0, j], sources[1, j], sources[2, j]
            if reach < np.inf:  # compact: no box of the block within the support
                away = (x - middle[0]) ** 2 + (y - middle[1]) ** 2 + (z - middle[2]) ** 2
                if away * (1.0 - 1e-12) > (radius + reach) ** 2:
                    continue
            _offsets(x, y, z, places, block)
            terms(scale, extent, table, block)
            add(weights[0, j], weights[1, j], weights[2, j], block)
            _add_remainders(sizes[j], block)
        sums, parts = np.empty((PARTS, LANES)), 0.0
        for k in range(PARTS):
            for i in range(LANES):
                sums[k, i] = block[SUMS + k * LANES + i]
        for k in range(9):
            parts += abs(linear[k // 3, k % 3])
        for i in range(LANES):
            sums[29, i] += parts
            for k in range(9):
                sums[k, i] += linear[k // 3, k % 3]
        return sums

    return sum_block


@njit(cache=True, error_model="numpy")
def _enclosing_ball(boxes, h):
    """A ball around all boxes of a block."""
    middle = np.empty(3)
    for k in range(3):
        low, high = boxes[k, 0], boxes[k, 0]
        for i in range(1, h.size):
            low, high = min(low, boxes[k, i]), max(high, boxes[k, i])
        middle[k] = 0.5 * (low + high)
    radius = 0.0
    for i in range(h.size):
        x, y, z = boxes[0, i] - middle[0], boxes[1, i] - middle[1], boxes[2, i] - middle[2]
        radius = max(radius, np.sqrt(x * x + y * y + z * z) + h[i])
    return middle, radius * (1.0 + 1e-12)
