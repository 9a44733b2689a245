"""Sums over all sources, box by box, of what `terms` gives for each: gradients and derivatives, and bounds beside.

Nothing is reassociated or contracted; see `bounds` for what that is worth.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from musclefit.fields.terms import isochoric_terms, scalar_terms

PARTS = 63
"""Rows of the sums of a box: the gradient (9), its derivatives (3 x 6), remainders of strain and of the whole, first,
second and third sizes, jumps, and the gradient's second derivatives (3 x 10)."""


@njit(cache=True, error_model="numpy")
def _add_scalar(w, dx, dy, dz, g, f, t, sums):
    """Add one source's gradient w (g d)^T and its derivatives w_i (f delta_kl + t d_k d_l) to the rows of ``sums``."""
    for i in range(dx.size):
        x, y, z = dx[i], dy[i], dz[i]
        gx, gy, gz = g[i] * x, g[i] * y, g[i] * z
        tx, ty = t[i] * x, t[i] * y
        xx, xy, xz = f[i] + tx * x, tx * y, tx * z
        yy, yz, zz = f[i] + ty * y, ty * z, f[i] + t[i] * z * z
        for k in range(3):
            a = w[k]
            sums[3 * k, i] += a * gx
            sums[3 * k + 1, i] += a * gy
            sums[3 * k + 2, i] += a * gz
            sums[9 + 6 * k, i] += a * xx
            sums[10 + 6 * k, i] += a * xy
            sums[11 + 6 * k, i] += a * xz
            sums[12 + 6 * k, i] += a * yy
            sums[13 + 6 * k, i] += a * yz
            sums[14 + 6 * k, i] += a * zz


@njit(cache=True, error_model="numpy")
def _add_third(w, dx, dy, dz, b, c, sums):
    """Add w_i (b (x_k delta_lm + x_l delta_km + x_m delta_kl) + c x_k x_l x_m), k <= l <= m in order."""
    for i in range(dx.size):
        x, y, z = dx[i], dy[i], dz[i]
        bx, by, bz = b[i] * x, b[i] * y, b[i] * z
        cx, cy, cz = c[i] * x * x, c[i] * y * y, c[i] * z * z
        xxx, xxy, xxz = 3.0 * bx + cx * x, by + cx * y, bz + cx * z
        xyy, xyz, xzz = bx + cy * x, c[i] * x * y * z, bx + cz * x
        yyy, yyz, yzz, zzz = 3.0 * by + cy * y, bz + cy * z, by + cz * y, 3.0 * bz + cz * z
        for k in range(3):
            a = w[k]
            sums[33 + 10 * k, i] += a * xxx
            sums[34 + 10 * k, i] += a * xxy
            sums[35 + 10 * k, i] += a * xxz
            sums[36 + 10 * k, i] += a * xyy
            sums[37 + 10 * k, i] += a * xyz
            sums[38 + 10 * k, i] += a * xzz
            sums[39 + 10 * k, i] += a * yyy
            sums[40 + 10 * k, i] += a * yyz
            sums[41 + 10 * k, i] += a * yzz
            sums[42 + 10 * k, i] += a * zzz


@njit(cache=True, error_model="numpy")
def _add_isochoric(a, b, c, dx, dy, dz, r2, f2, f3, f4, sums):
    """The same for D = -omega w + (grad d_w psi).

    d_k D_i = A w_i x_k + f_3 s x_i x_k + f_2 (w_k x_i + s delta_ik), s = x . w, A = -(4 f_2 + r² f_3);
    d_l d_k D_i = w_i P_kl + x_i Q_kl + delta_il z_k + delta_ik z_l with P = A' x x^T + A I, A' = -(6 f_3 + r² f_4),
    Q = f_4 s x x^T + f_3 (w x^T + x w^T) + f_3 s I, z = f_3 s x + f_2 w.
    """
    for i in range(dx.size):
        x, y, z = dx[i], dy[i], dz[i]
        s = x * a + y * b + z * c
        A = -(4.0 * f2[i] + r2[i] * f3[i])
        slope = -(6.0 * f3[i] + r2[i] * f4[i])
        curl = f3[i] * s
        along = f2[i] * s
        ux, uy, uz = A * a + curl * x, A * b + curl * y, A * c + curl * z
        vx, vy, vz = f2[i] * x, f2[i] * y, f2[i] * z
        sums[0, i] += ux * x + vx * a + along
        sums[1, i] += ux * y + vx * b
        sums[2, i] += ux * z + vx * c
        sums[3, i] += uy * x + vy * a
        sums[4, i] += uy * y + vy * b + along
        sums[5, i] += uy * z + vy * c
        sums[6, i] += uz * x + vz * a
        sums[7, i] += uz * y + vz * b
        sums[8, i] += uz * z + vz * c + along
        fa, fb, fc = f3[i] * a, f3[i] * b, f3[i] * c
        qx, qy, qz = f4[i] * s * x, f4[i] * s * y, f4[i] * s * z
        Qxx, Qxy, Qxz = qx * x + 2.0 * fa * x + curl, qx * y + fa * y + fb * x, qx * z + fa * z + fc * x
        Qyy, Qyz, Qzz = qy * y + 2.0 * fb * y + curl, qy * z + fb * z + fc * y, qz * z + 2.0 * fc * z + curl
        px, py, pz = slope * x, slope * y, slope * z
        Pxx, Pxy, Pxz, Pyy, Pyz, Pzz = px * x + A, px * y, px * z, py * y + A, py * z, pz * z + A
        zx, zy, zz = curl * x + f2[i] * a, curl * y + f2[i] * b, curl * z + f2[i] * c
        sums[9, i] += a * Pxx + x * Qxx + 2.0 * zx
        sums[10, i] += a * Pxy + x * Qxy + zy
        sums[11, i] += a * Pxz + x * Qxz + zz
        sums[12, i] += a * Pyy + x * Qyy
        sums[13, i] += a * Pyz + x * Qyz
        sums[14, i] += a * Pzz + x * Qzz
        sums[15, i] += b * Pxx + y * Qxx
        sums[16, i] += b * Pxy + y * Qxy + zx
        sums[17, i] += b * Pxz + y * Qxz
        sums[18, i] += b * Pyy + y * Qyy + 2.0 * zy
        sums[19, i] += b * Pyz + y * Qyz + zz
        sums[20, i] += b * Pzz + y * Qzz
        sums[21, i] += c * Pxx + z * Qxx
        sums[22, i] += c * Pxy + z * Qxy
        sums[23, i] += c * Pxz + z * Qxz + zx
        sums[24, i] += c * Pyy + z * Qyy
        sums[25, i] += c * Pyz + z * Qyz + zy
        sums[26, i] += c * Pzz + z * Qzz + 2.0 * zz


@njit(cache=True, error_model="numpy")
def _add_isochoric_third(a, b, c, dx, dy, dz, r2, f3, f4, f5, sums):
    """Add d_k d_l d_m D_i = V_iklm - w_i W_klm, k <= l <= m in order.

    V is the fourth derivative of d_w psi; with any vector n four times f_5 s (x.n)⁴ + f_4 (6 s (x.n)² n² + 4 (w.n)
    (x.n)³) + f_3 (3 s n⁴ + 12 (w.n) (x.n) n²), s = x . w. W is that of omega: omega_3 (x.n)³ + 3 omega_2 (x.n) n².
    """
    for i in range(dx.size):
        x, y, z, p, q, r = dx[i], dy[i], dz[i], f3[i], f4[i], f5[i]
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
        two, three = 7.0 * p + r2[i] * q, 9.0 * q + r2[i] * r
        Wxxx, Wyyy, Wzzz = x * (three * xx + 3.0 * two), y * (three * yy + 3.0 * two), z * (three * zz + 3.0 * two)
        Wxxy, Wxxz = y * (three * xx + two), z * (three * xx + two)
        Wxyy, Wyyz = x * (three * yy + two), z * (three * yy + two)
        Wxzz, Wyzz = x * (three * zz + two), y * (three * zz + two)
        Wxyz = three * x * yz
        sums[33, i] += Vxxxx - a * Wxxx
        sums[34, i] += Vxxxy - a * Wxxy
        sums[35, i] += Vxxxz - a * Wxxz
        sums[36, i] += Vxxyy - a * Wxyy
        sums[37, i] += Vxxyz - a * Wxyz
        sums[38, i] += Vxxzz - a * Wxzz
        sums[39, i] += Vxyyy - a * Wyyy
        sums[40, i] += Vxyyz - a * Wyyz
        sums[41, i] += Vxyzz - a * Wyzz
        sums[42, i] += Vxzzz - a * Wzzz
        sums[43, i] += Vxxxy - b * Wxxx
        sums[44, i] += Vxxyy - b * Wxxy
        sums[45, i] += Vxxyz - b * Wxxz
        sums[46, i] += Vxyyy - b * Wxyy
        sums[47, i] += Vxyyz - b * Wxyz
        sums[48, i] += Vxyzz - b * Wxzz
        sums[49, i] += Vyyyy - b * Wyyy
        sums[50, i] += Vyyyz - b * Wyyz
        sums[51, i] += Vyyzz - b * Wyzz
        sums[52, i] += Vyzzz - b * Wzzz
        sums[53, i] += Vxxxz - c * Wxxx
        sums[54, i] += Vxxyz - c * Wxxy
        sums[55, i] += Vxxzz - c * Wxxz
        sums[56, i] += Vxyyz - c * Wxyy
        sums[57, i] += Vxyzz - c * Wxyz
        sums[58, i] += Vxzzz - c * Wxzz
        sums[59, i] += Vyyyz - c * Wyyy
        sums[60, i] += Vyyzz - c * Wyyz
        sums[61, i] += Vyzzz - c * Wyzz
        sums[62, i] += Vzzzz - c * Wzzz


@njit(cache=True, error_model="numpy")
def sum_block(code, isochoric, scale, extent, table, reach, sources, weights, sizes, linear, boxes, h, sums):
    """Sums of a block of boxes: ``boxes`` (3, L) centres local to the origin, ``h`` (L,) half diagonals with blur."""
    lanes = h.size
    dx, dy, dz, r2 = np.empty(lanes), np.empty(lanes), np.empty(lanes), np.empty(lanes)
    g, f, t = np.empty(lanes), np.empty(lanes), np.empty(lanes)
    b, c, d = np.empty(lanes), np.empty(lanes), np.empty(lanes)
    strain, whole, jump = np.empty(lanes), np.empty(lanes), np.empty(lanes)
    first, second, third = np.empty(lanes), np.empty(lanes), np.empty(lanes)
    sums[:, :] = 0.0
    middle, block = _enclosing_ball(boxes, h)
    for j in range(sizes.size):
        x, y, z = sources[0, j], sources[1, j], sources[2, j]
        if reach < np.inf:  # compact: no box of the block within the support
            away = (x - middle[0]) ** 2 + (y - middle[1]) ** 2 + (z - middle[2]) ** 2
            if away * (1.0 - 1e-12) > (block + reach) ** 2:
                continue
        for i in range(lanes):
            dx[i], dy[i], dz[i] = boxes[0, i] - x, boxes[1, i] - y, boxes[2, i] - z
            r2[i] = dx[i] * dx[i] + dy[i] * dy[i] + dz[i] * dz[i]
        size = sizes[j]
        if isochoric:
            isochoric_terms(
                code, scale, extent, table, r2, h, g, f, t, b, c, d, strain, whole, first, second, third, jump
            )
            u, v, w = weights[0, j], weights[1, j], weights[2, j]
            _add_isochoric(u, v, w, dx, dy, dz, r2, g, f, t, sums)
            _add_isochoric_third(u, v, w, dx, dy, dz, r2, b, c, d, sums)
        else:
            scalar_terms(code, scale, extent, table, r2, h, g, f, t, b, c, strain, first, second, third, jump)
            _add_scalar(weights[:, j], dx, dy, dz, g, f, t, sums)
            if code <= 2:
                _add_third(weights[:, j], dx, dy, dz, b, c, sums)
            whole[:] = strain
        for i in range(lanes):
            sums[27, i] += size * strain[i]
            sums[28, i] += size * whole[i]
            sums[29, i] += size * first[i]
            sums[30, i] += size * second[i]
            sums[31, i] += size * third[i]
            sums[32, i] += size * jump[i]
    parts = np.abs(linear).sum()
    for i in range(lanes):
        sums[29, i] += parts
        for k in range(9):
            sums[k, i] += linear[k // 3, k % 3]


@njit(cache=True, error_model="numpy")
def _enclosing_ball(boxes, h):
    """A ball around all boxes of a block."""
    middle = np.empty(3)
    for k in range(3):
        middle[k] = 0.5 * (boxes[k].min() + boxes[k].max())
    radius = 0.0
    for i in range(h.size):
        x, y, z = boxes[0, i] - middle[0], boxes[1, i] - middle[1], boxes[2, i] - middle[2]
        radius = max(radius, np.sqrt(x * x + y * y + z * z) + h[i])
    return middle, radius * (1.0 + 1e-12)
