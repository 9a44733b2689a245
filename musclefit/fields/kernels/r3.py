"""phi = r³: the triharmonic spline of space."""

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
from musclefit.fields.evaluation.radial_sums import INNER
from musclefit.fields.kernels.model import Enclosure, RadialKernel


@njit(**INNER)
def _formula(scale, r2):
    r = np.sqrt(r2)
    return r2 * r, 3.0 * r


@njit(**PROOF)
def _terms(scale, extent, table, block):
    """Second order while the box stays away from the source, else first order.

    d_e⁴ phi = 9 (1 - c²)² / r is at most 9 / r: the remainder 9/2 h² q (sum of 2 q^k / ((k+1) (k+2) (k+3))) is at most
    h² q (3/2 + 3/4 q).
    """
    n3 = table[2, 0]
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


@njit(**PROOF)
def _value(scale, r):
    return r * r * r, 0.0, r * r * r


@njit(**PROOF)
def _steepest(slope, r):
    return slope * r * r


KERNEL = RadialKernel(
    "r3",
    _formula,
    polynomial_degree=1,
    enclosure=Enclosure(
        # N3 is the largest |9 c - 3 c³|, N4 the largest |9 - 18 c² + 9 c⁴|.
        table=lambda: constants(3.0, 6.0, 6.0, 9.0),
        terms=_terms,
        values=_value,
        steepest=_steepest,
        second_order=True,
    ),
)
