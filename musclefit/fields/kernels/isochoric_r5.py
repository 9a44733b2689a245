"""psi = -r⁵: smoother at the centres than isochoric-r3; K = 25 r³ I - 15 r x x^T."""

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
from musclefit.fields.evaluation.radial_sums import INNER, TINY
from musclefit.fields.kernels.model import Enclosure, RadialKernel


@njit(**INNER)
def _formula(scale, r2):
    r = np.sqrt(r2 + TINY)
    return 25.0 * r2 * r, 75.0 * r, -15.0 * r, -15.0 / r


@njit(**PROOF)
def _terms(scale, extent, table, block):
    """Second order while the box stays away from the source, else first order.

    N4 <= C / r leaves at most C h² q (2 + q) / 12.
    """
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
    isochoric_sizes(block)


@njit(**PROOF)
def _value(scale, r):
    return 25.0 * r * r * r, -15.0 * r, 40.0 * r * r * r


@njit(**PROOF)
def _steepest(slope, r):
    return slope * r * r


KERNEL = RadialKernel(
    "isochoric-r5",
    _formula,
    polynomial_degree=1,
    isochoric=True,
    enclosure=Enclosure(
        table=lambda: isochoric_constants(-15.0, -15.0, 15.0, -45.0, 225.0),  # f_2 to f_6 at r = 1
        terms=_terms,
        values=_value,
        steepest=_steepest,
        second_order=True,
    ),
)
