"""phi = exp(-q²), q = r / scale."""

from __future__ import annotations

import numpy as np

from musclefit.compiling import njit
from musclefit.fields.enclosures.majorants import Chain, falling_factor, scalar_table, times
from musclefit.fields.enclosures.source_terms import PROOF, tabulated_terms
from musclefit.fields.evaluation.radial_sums import INNER
from musclefit.fields.kernels.model import Enclosure, RadialKernel
from musclefit.geometry.arrays import Float

EXTENT = 8.0

TAIL = (16.0 * np.exp(-64.0), 258.0 * np.exp(-64.0), 4192.0 * np.exp(-64.0))
"""All of 2 q E, (2 + 4 q²) E and (12 q + 8 q³) E, E = exp(-q²), fall from q = 8 on."""


@njit(**INNER)
def _formula(scale, r2):
    s = 1.0 / scale
    f = np.exp(-r2 * s * s)
    return f, -2.0 * s * s * f


@njit(**PROOF)
def _derivatives(q):
    e = np.exp(-q * q)
    return -2.0 * e, 4.0 * e, 2.0 * q * (1.0 + q * q) * e, (2.0 + 4.0 * q * q) * (1.0 + q * q) * e


@njit(**PROOF)
def _value(scale, r):
    q = r / scale
    return np.exp(-q * q), 0.0, 1.0


def _chain(q: Float) -> Chain:
    e, r = falling_factor(np.exp(-(q**2))), (q[:-1], q[1:])
    return (
        times(e, by=-2.0),
        times(e, r, by=-2.0),
        times(e, r, by=4.0),
        times(e, r, r, by=4.0),
        times(e, r, r, r, by=-8.0),
    )


KERNEL = RadialKernel(
    "gaussian",
    _formula,
    scaled=True,
    enclosure=Enclosure(
        table=lambda: scalar_table(_chain, extent=EXTENT, tail=TAIL),
        terms=tabulated_terms(_derivatives, ends=True, compact=False),
        values=_value,
        extent=EXTENT,
    ),
)
