"""phi = -r: the biharmonic spline of space, smooth away from the centres and as gentle as a kernel can be."""

from __future__ import annotations

import numpy as np

from musclefit.compiling import njit
from musclefit.fields.enclosures.majorants import constants
from musclefit.fields.enclosures.source_terms import (
    FIRST,
    JUMP,
    LANES,
    PROOF,
    R2,
    SECOND,
    STRAIN,
    THIRD,
    B,
    C,
    F,
    G,
    H,
    T,
)
from musclefit.fields.evaluation.lane_sums import store_three
from musclefit.fields.evaluation.lanes import INNER as INNER_LANES
from musclefit.fields.evaluation.lanes import SHARE, load, shared_inverse_root, shared_root, zero
from musclefit.fields.evaluation.radial_sums import INNER, TINY
from musclefit.fields.kernels.model import Enclosure, Lanes, RadialKernel

NEAR = 0.4
"""h / r above which a source counts as near: its term is then the ball around the cone of directions."""


@njit(**INNER)
def _formula(scale, r2):
    r = np.sqrt(r2 + TINY)
    return -r, -1.0 / r


@njit(**INNER_LANES)
def _values(soft, sources, block):
    x, y, z = load(block, 0), load(block, 1), load(block, 2)
    u, v, w = zero(), zero(), zero()
    for j in range(sources.shape[0]):
        dx, dy, dz = x - sources[j, 0], y - sources[j, 1], z - sources[j, 2]
        r = shared_root(dx * dx + dy * dy + dz * dz + TINY)
        u = u + r * sources[j, 3]
        v = v + r * sources[j, 4]
        w = w + r * sources[j, 5]
    store_three(block, 3, -1.0 / SHARE, u, v, w)


@njit(**INNER_LANES)
def _gradients(soft, sources, block):
    """With s = w / r the sums are those of s r² and of s (x - c)^T."""
    x, y, z = load(block, 0), load(block, 1), load(block, 2)
    u, v, w = zero(), zero(), zero()
    ux, uy, uz, vx, vy, vz, wx, wy, wz = zero(), zero(), zero(), zero(), zero(), zero(), zero(), zero(), zero()
    for j in range(sources.shape[0]):
        dx, dy, dz = x - sources[j, 0], y - sources[j, 1], z - sources[j, 2]
        r2 = dx * dx + dy * dy + dz * dz + TINY
        inverse = shared_inverse_root(r2)
        a, b, c = inverse * sources[j, 3], inverse * sources[j, 4], inverse * sources[j, 5]
        u = u + r2 * a
        v = v + r2 * b
        w = w + r2 * c
        ux = ux + dx * a
        uy = uy + dy * a
        uz = uz + dz * a
        vx = vx + dx * b
        vy = vy + dy * b
        vz = vz + dz * b
        wx = wx + dx * c
        wy = wy + dy * c
        wz = wz + dz * c
    store_three(block, 3, -1.0 / SHARE, u, v, w)
    store_three(block, 6, -1.0 / SHARE, ux, uy, uz)
    store_three(block, 9, -1.0 / SHARE, vx, vy, vz)
    store_three(block, 12, -1.0 / SHARE, wx, wy, wz)


@njit(**PROOF)
def _terms(scale, extent, table, block):
    """Second order, or the ball of radius sin a around cos a times the unit vector: it holds a cone of angle a.

    d_e⁴ phi = (15 c⁴ - 18 c² + 3) / r³ is at most 3 / r³: the remainder 3/2 q³ (sum of q^k / (k+3)) is at most
    q³ / (2 (1 - q)).
    """
    for i in range(LANES):
        r2, h = block[R2 + i], block[H + i]
        r = np.sqrt(r2)
        q, inverse = h / r, 1.0 / r
        square = inverse * inverse
        far, cone = h < NEAR * r, h < r
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


@njit(**PROOF)
def _value(scale, r):
    return -r, 0.0, r


KERNEL = RadialKernel(
    "r",
    _formula,
    polynomial_degree=0,
    enclosure=Enclosure(
        # N3 is the largest |3 c - 3 c³|, N4 the largest |3 - 18 c² + 15 c⁴|.
        table=lambda: constants(1.0, 1.0, 2.0 / np.sqrt(3.0), 3.0),
        terms=_terms,
        values=_value,
        second_order=True,
    ),
    lanes=Lanes(_values, _gradients),
)
