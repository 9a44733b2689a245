"""phi = (1 + q²)^(-1/2), q = r / scale."""

from __future__ import annotations

import numpy as np

from musclefit.compiling import njit
from musclefit.fields.enclosures.majorants import Chain, falling_factor, scalar_table, times
from musclefit.fields.enclosures.source_terms import PROOF, tabulated_terms
from musclefit.fields.evaluation.radial_sums import INNER
from musclefit.fields.kernels.model import Enclosure, RadialKernel
from musclefit.geometry.arrays import Float

EXTENT = 16.0

TAIL = (1.0 / 257.0, 2.0 / 257.0**1.5, 6.0 / 257.0**2)
"""N1 <= f², N2 <= 2 f³, N3 <= 6 f⁴ with f = (1 + q²)^(-1/2)."""


@njit(**INNER)
def _formula(scale, r2):
    s = 1.0 / scale
    f = 1.0 / np.sqrt(1.0 + r2 * s * s)
    return f, -s * s * f * f * f


@njit(**PROOF)
def _derivatives(q):
    e = 1.0 / np.sqrt(1.0 + q * q)
    e3 = e * e * e
    return -e3, 3.0 * e3 * e * e, q * e3, e3 * (1.0 + 3.0 * q * q * e * e)


@njit(**PROOF)
def _value(scale, r):
    q = r / scale
    return 1.0 / np.sqrt(1.0 + q * q), 0.0, 1.0


def _chain(q: Float) -> Chain:
    f, eta = 1.0 / np.sqrt(1.0 + q**2), q / np.sqrt(1.0 + q**2)  # eta = q f grows
    f2, f3, r = falling_factor(f**2), falling_factor(f**3), (eta[:-1], eta[1:])
    f4 = falling_factor(f**4)
    return (
        times(f3, by=-1.0),
        times(f2, r, by=-1.0),
        times(f4, r, by=3.0),
        times(f3, r, r, by=3.0),
        times(f4, r, r, r, by=-15.0),
    )


KERNEL = RadialKernel(
    "inverse-multiquadric",
    _formula,
    scaled=True,
    enclosure=Enclosure(
        table=lambda: scalar_table(_chain, extent=EXTENT, tail=TAIL),
        terms=tabulated_terms(_derivatives, ends=False, compact=False),
        values=_value,
        extent=EXTENT,
    ),
)
