"""psi = r³: the isochoric kernel of least third derivatives; K = -9 r I + 3 x x^T / r."""

from __future__ import annotations

import numpy as np

from musclefit.compiling import njit
from musclefit.fields.enclosures.majorants import isochoric_constants
from musclefit.fields.enclosures.source_terms import (
    JUMP,
    LANES,
    PROOF,
    R2,
    STRAIN,
    WHOLE,
    B,
    C,
    D,
    F,
    G,
    H,
    T,
    isochoric_sizes,
)
from musclefit.fields.evaluation.lane_sums import store_three
from musclefit.fields.evaluation.lanes import INNER as INNER_LANES
from musclefit.fields.evaluation.lanes import SHARE, load, shared_inverse_root, zero
from musclefit.fields.evaluation.radial_sums import INNER, TINY
from musclefit.fields.kernels.model import Enclosure, Lanes, RadialKernel

NEAR = 0.4
"""h / r above which a source counts as near."""


@njit(**INNER)
def _formula(scale, r2):
    r = np.sqrt(r2 + TINY)
    inverse = 1.0 / r
    return -9.0 * r, -9.0 * inverse, 3.0 * inverse, -3.0 * inverse * inverse * inverse


@njit(**INNER_LANES)
def values_in_lanes(soft, sources, block):
    """Kernel / 3 = (q - 3) R I + x x^T / R, R² = r² + soft, q = soft / R²: psi = R³."""
    x, y, z = load(block, 0), load(block, 1), load(block, 2)
    u, v, w = zero(), zero(), zero()
    for j in range(sources.shape[0]):
        dx, dy, dz = x - sources[j, 0], y - sources[j, 1], z - sources[j, 2]
        a, b, c = sources[j, 3], sources[j, 4], sources[j, 5]
        square = dx * dx + dy * dy + dz * dz + soft
        inverse = shared_inverse_root(square) * (1.0 / SHARE)
        f = inverse * soft - 3.0 * (square * inverse)
        along = inverse * (dx * a + dy * b + dz * c)
        u = u + f * a + along * dx
        v = v + f * b + along * dy
        w = w + f * c + along * dz
    store_three(block, 3, 3.0, u, v, w)


@njit(**INNER_LANES)
def _gradients(soft, sources, block):
    """Values and gradients for R = r.

    With n = x / r and s = n.w a third of the displacement is r (s n - 3 w), and a third of the gradient is
    n w^T - 3 w n^T - s n n^T + s I, so that the sums H of n w^T and S of s n n^T give it: H - 3 H^T - S + tr(H) I.
    """
    x, y, z = load(block, 0), load(block, 1), load(block, 2)
    u, v, w = zero(), zero(), zero()
    xx, xy, xz, yy, yz, zz = zero(), zero(), zero(), zero(), zero(), zero()
    ux, uy, uz, vx, vy, vz, wx, wy, wz = zero(), zero(), zero(), zero(), zero(), zero(), zero(), zero(), zero()
    for j in range(sources.shape[0]):
        dx, dy, dz = x - sources[j, 0], y - sources[j, 1], z - sources[j, 2]
        square = dx * dx + dy * dy + dz * dz + TINY
        inverse = shared_inverse_root(square) * (1.0 / SHARE)
        long = square * inverse
        nx, ny, nz = dx * inverse, dy * inverse, dz * inverse
        a, b, c = sources[j, 3], sources[j, 4], sources[j, 5]
        s = nx * a + ny * b + nz * c
        px, py, pz = s * nx, s * ny, s * nz
        ux = ux + nx * a
        uy = uy + nx * b
        uz = uz + nx * c
        vx = vx + ny * a
        vy = vy + ny * b
        vz = vz + ny * c
        wx = wx + nz * a
        wy = wy + nz * b
        wz = wz + nz * c
        xx = xx + px * nx
        xy = xy + px * ny
        xz = xz + px * nz
        yy = yy + py * ny
        yz = yz + py * nz
        zz = zz + pz * nz
        u = u + long * (px - sources[j, 6])
        v = v + long * (py - sources[j, 7])
        w = w + long * (pz - sources[j, 8])
    trace = ux + vy + wz
    store_three(block, 3, 3.0, u, v, w)
    store_three(block, 6, 3.0, trace - 2.0 * ux - xx, uy - 3.0 * vx - xy, uz - 3.0 * wx - xz)
    store_three(block, 9, 3.0, vx - 3.0 * uy - xy, trace - 2.0 * vy - yy, vz - 3.0 * wy - yz)
    store_three(block, 12, 3.0, wx - 3.0 * uz - xz, wy - 3.0 * vz - yz, trace - 2.0 * wz - zz)


@njit(**PROOF)
def _terms(scale, extent, table, block):
    """Second order, or the sup of the term; N4 <= C / r³ leaves at most C q³ / (6 (1 - q))."""
    s1, s4, w1, w4 = table[0, 0], table[3, 0], table[4, 0], table[7, 0]
    for i in range(LANES):
        r2, h = block[R2 + i], block[H + i]
        r = np.sqrt(r2)
        far = h < NEAR * r
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
    isochoric_sizes(block)


@njit(**PROOF)
def _value(scale, r):
    return -9.0 * r, 3.0 / max(r, 1e-100), 12.0 * r


KERNEL = RadialKernel(
    "isochoric-r3",
    _formula,
    polynomial_degree=0,
    isochoric=True,
    enclosure=Enclosure(
        table=lambda: isochoric_constants(3.0, -3.0, 9.0, -45.0, 315.0),  # f_2 to f_6 at r = 1
        terms=_terms,
        values=_value,
        second_order=True,
    ),
    lanes=Lanes(values_in_lanes, _gradients),
)
