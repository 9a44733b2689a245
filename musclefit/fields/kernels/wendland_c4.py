"""phi = (1 - q)⁶ (35 q² + 18 q + 3) / 3, q = r / scale, 0 from q = 1 on (Wendland 1995)."""

from __future__ import annotations

import numpy as np

from musclefit.compiling import njit
from musclefit.fields.enclosures.majorants import Chain, falling_factor, scalar_table, times
from musclefit.fields.enclosures.source_terms import PROOF, tabulated_terms
from musclefit.fields.evaluation.radial_sums import INNER
from musclefit.fields.kernels.model import Enclosure, RadialKernel
from musclefit.geometry.arrays import Float


@njit(**INNER)
def _formula(scale, r2):
    s = 1.0 / scale
    q = np.sqrt(r2) * s
    u = 0.0 if q > 1.0 else 1.0 - q
    u5 = u * u * u * u * u
    return u5 * u * (35.0 * q * q + 18.0 * q + 3.0) / 3.0, -56.0 / 3.0 * s * s * u5 * (5.0 * q + 1.0)


@njit(**PROOF)
def _derivatives(q):
    """1 - q cancels, so the sizes are those at its largest."""
    u = max(1.0 - q, 0.0)
    u4 = u * u * u * u
    return -56.0 / 3.0 * u4 * u * (5.0 * q + 1.0), 560.0 * u4, 112.0, 672.0


@njit(**PROOF)
def _value(scale, r):
    q = r / scale
    u = max(1.0 - q, 0.0)
    return u * u * u * u * u * u * (35.0 * q * q + 18.0 * q + 3.0) / 3.0, 0.0, 19.0 if q < 1.0 + 1e-12 else 0.0


def _chain(q: Float) -> Chain:
    u, r, w = falling_factor(1.0 - q), (q[:-1], q[1:]), (5.0 * q[:-1] + 1.0, 5.0 * q[1:] + 1.0)
    u4 = times(u, u, u, u)
    return (
        times(u4, u, w, by=-56.0 / 3.0),
        times(u4, u, w, r, by=-56.0 / 3.0),
        times(u4, r, by=560.0),
        times(u4, r, r, by=560.0),
        times(u, u, u, r, r, by=-2240.0),
    )


KERNEL = RadialKernel(
    "wendland-c4",
    _formula,
    compact=True,
    scaled=True,
    enclosure=Enclosure(
        table=lambda: scalar_table(_chain, extent=1.0),
        terms=tabulated_terms(_derivatives, ends=False, compact=True),
        values=_value,
        extent=1.0,
    ),
)
