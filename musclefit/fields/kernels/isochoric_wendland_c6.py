"""psi = (1 - q)⁸ (32 q³ + 25 q² + 8 q + 1) scale², q = r / scale, 0 from q = 1 on: isochoric and compact."""

from __future__ import annotations

import numpy as np

from musclefit.compiling import njit
from musclefit.fields.enclosures.majorants import CELLS, falling_factor, falling_table, isochoric_norms, times
from musclefit.fields.enclosures.source_terms import (
    FIRST,
    JUMP,
    LANES,
    PROOF,
    R2,
    SECOND,
    STRAIN,
    THIRD,
    WHOLE,
    B,
    C,
    D,
    F,
    G,
    H,
    T,
    table_cell,
)
from musclefit.fields.evaluation.radial_sums import INNER
from musclefit.fields.kernels.model import Enclosure, RadialKernel
from musclefit.geometry.arrays import Float


@njit(**INNER)
def _formula(scale, r2):
    s = 1.0 / scale
    s2 = s * s
    q = np.sqrt(r2) * s
    u = 0.0 if q > 1.0 else 1.0 - q
    u2 = u * u
    u5 = u2 * u2 * u
    return (
        44.0 * u5 * u * (1.0 + q * (6.0 - q * (3.0 + 88.0 * q))),
        1056.0 * s2 * u5 * (q * (33.0 * q - 10.0) - 2.0),
        528.0 * s2 * u5 * u * (6.0 * q + 1.0),
        -22176.0 * s2 * s2 * u5,
    )


@njit(**PROOF)
def _terms(scale, extent, table, block):
    """The order with the smaller remainder, or the sup of the term. Sizes are those at 1 - q = 1."""
    s1, s3, s4, w1, w3, w4 = table[0], table[2], table[3], table[4], table[6], table[7]
    cells = s1.size - 1
    s = 1.0 / scale
    s2 = s * s
    for i in range(LANES):
        r, h = np.sqrt(block[R2 + i]), block[H + i]
        low = r - h
        k = table_cell(low, scale, extent, cells)
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


@njit(**PROOF)
def _value(scale, r):
    q = r / scale
    u = max(1.0 - q, 0.0)
    u6 = u * u * u * u * u * u
    return (
        44.0 * u6 * (1.0 + q * (6.0 - q * (3.0 + 88.0 * q))),
        528.0 * u6 * (6.0 * q + 1.0) / (scale * scale),
        8100.0 if q < 1.0 + 1e-12 else 0.0,
    )


def _norms(q: Float) -> Float:
    """From the chain, u = 1 - q.

    f_2 = 528 u⁶ (6 q + 1), f_3 = -22176 u⁵, f_4 = 110880 u⁴ / q, f_5 = -110880 u³ (1 + 3 q) / q³,
    f_6 = 332640 u² (1 + q)² / q⁵.
    """
    u, r, w, t = (
        falling_factor(1.0 - q),
        (q[:-1], q[1:]),
        (6 * q[:-1] + 1, 6 * q[1:] + 1),
        (3 * q[:-1] + 1, 3 * q[1:] + 1),
    )
    u3, r2 = times(u, u, u), times(r, r)
    u5, u6, v = times(u3, u, u), times(u3, u3), falling_factor(1.0 - q**2)
    return isochoric_norms(
        (
            (times(u6, w, r, by=528.0), times(u5, r2, r, by=-22176.0)),
            (times(u6, w, by=528.0), times(u5, r2, by=-22176.0), times(u3, u, r2, r, by=110880.0)),
            (times(u5, r, by=-22176.0), times(u3, u, r2, by=110880.0), times(u3, t, r2, by=-110880.0)),
            (
                times(u5, by=-22176.0),
                times(u3, u, r, by=110880.0),
                times(u3, t, r, by=-110880.0),
                times(v, v, r, by=332640.0),
            ),
        )
    )


KERNEL = RadialKernel(
    "isochoric-wendland-c6",
    _formula,
    isochoric=True,
    compact=True,
    scaled=True,
    enclosure=Enclosure(
        table=lambda: falling_table(_norms(np.linspace(0.0, 1.0, CELLS + 1))),
        terms=_terms,
        values=_value,
        extent=1.0,
        second_order=True,
    ),
)
