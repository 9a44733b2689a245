"""psi = (r² + scale²)^(3/2): isochoric-r3 made smooth at the centres."""

from __future__ import annotations

import numpy as np

from musclefit.compiling import njit
from musclefit.fields.enclosures.majorants import CELLS, Enclosed, falling_constants, isochoric_norms, times
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
from musclefit.fields.evaluation.radial_sums import INNER
from musclefit.fields.kernels.isochoric_r3 import values_in_lanes
from musclefit.fields.kernels.model import Enclosure, Lanes, RadialKernel
from musclefit.geometry.arrays import Float


@njit(**INNER)
def _formula(scale, r2):
    e2 = scale * scale
    r = np.sqrt(r2 + e2)
    inverse = 1.0 / r
    cube = 3.0 * inverse * inverse * inverse
    return -6.0 * r - 3.0 * r2 * inverse, -9.0 * inverse - e2 * cube, 3.0 * inverse, -cube


@njit(**INNER_LANES)
def _gradients(soft, sources, block):
    """Values and gradients, whatever R, as in `isochoric_r3`.

    With n = x / R, s = n.w and A = (3 + q) w + s n, a third of the displacement is R (A - 6 w), and a third of the
    gradient n w^T - A n^T + s I, one source's weight being w.
    """
    x, y, z = load(block, 0), load(block, 1), load(block, 2)
    u, v, w, diagonal = zero(), zero(), zero(), zero()
    ux, uy, uz, vx, vy, vz, wx, wy, wz = zero(), zero(), zero(), zero(), zero(), zero(), zero(), zero(), zero()
    for j in range(sources.shape[0]):
        dx, dy, dz = x - sources[j, 0], y - sources[j, 1], z - sources[j, 2]
        a, b, c = sources[j, 3], sources[j, 4], sources[j, 5]
        square = dx * dx + dy * dy + dz * dz + soft
        inverse = shared_inverse_root(square) * (1.0 / SHARE)
        long = square * inverse
        share = 3.0 + inverse * (inverse * soft)
        nx, ny, nz = dx * inverse, dy * inverse, dz * inverse
        s = nx * a + ny * b + nz * c
        ax, ay, az = share * a + s * nx, share * b + s * ny, share * c + s * nz
        u = u + long * (ax - sources[j, 6] - sources[j, 6])
        v = v + long * (ay - sources[j, 7] - sources[j, 7])
        w = w + long * (az - sources[j, 8] - sources[j, 8])
        diagonal = diagonal + s
        ux = ux + nx * a - ax * nx
        uy = uy + nx * b - ax * ny
        uz = uz + nx * c - ax * nz
        vx = vx + ny * a - ay * nx
        vy = vy + ny * b - ay * ny
        vz = vz + ny * c - ay * nz
        wx = wx + nz * a - az * nx
        wy = wy + nz * b - az * ny
        wz = wz + nz * c - az * nz
    store_three(block, 3, 3.0, u, v, w)
    store_three(block, 6, 3.0, ux + diagonal, uy, uz)
    store_three(block, 9, 3.0, vx, vy + diagonal, vz)
    store_three(block, 12, 3.0, wx, wy, wz + diagonal)


@njit(**PROOF)
def _terms(scale, extent, table, block):
    """The order with the smaller remainder, or the sup of the term."""
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
    isochoric_sizes(block)


@njit(**PROOF)
def _value(scale, r):
    rho = np.sqrt(r * r + scale * scale)
    return -6.0 * rho - 3.0 * r * r / rho, 3.0 / rho, 12.0 * rho


def _norms() -> Float:
    """In units of rho = sqrt(r² + scale²): the chain is that of r³ at rho, and r / rho is in [0, 1]."""
    edges = np.linspace(0.0, 1.0, CELLS + 1)
    r: Enclosed = (edges[:-1], edges[1:])
    r2 = times(r, r)
    r4 = times(r2, r2)
    return isochoric_norms(
        (
            (times(r, by=3.0), times(r2, r, by=-3.0)),
            ((np.full(CELLS, 3.0), np.full(CELLS, 3.0)), times(r2, by=-3.0), times(r4, by=9.0)),
            (times(r, by=-3.0), times(r2, r, by=9.0), times(r4, r, by=-45.0)),
            (
                (np.full(CELLS, -3.0), np.full(CELLS, -3.0)),
                times(r2, by=9.0),
                times(r4, by=-45.0),
                times(r4, r2, by=315.0),
            ),
        )
    )


KERNEL = RadialKernel(
    "isochoric-r3-mollified",
    _formula,
    polynomial_degree=0,
    isochoric=True,
    scaled=True,
    enclosure=Enclosure(table=lambda: falling_constants(_norms()), terms=_terms, values=_value, second_order=True),
    lanes=Lanes(values_in_lanes, _gradients),
)
