"""phi = (1 - q)⁴ (4 q + 1), q = r / scale, 0 from q = 1 on (Wendland 1995)."""

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
    u3 = u * u * u
    return u3 * u * (4.0 * q + 1.0), -20.0 * s * s * u3


@njit(**PROOF)
def _derivatives(q):
    """1 - q cancels, so the sizes are those at its largest."""
    u = max(1.0 - q, 0.0)
    return -20.0 * u * u * u, 60.0 * u * u / max(q, 1e-100), 20.0, 80.0


@njit(**PROOF)
def _value(scale, r):
    q = r / scale
    u = max(1.0 - q, 0.0)
    return u * u * u * u * (4.0 * q + 1.0), 0.0, 5.0 if q < 1.0 + 1e-12 else 0.0


def _chain(q: Float) -> Chain:
    u, r, w = falling_factor(1.0 - q), (q[:-1], q[1:]), falling_factor(1.0 - q**2)
    return (
        times(u, u, u, by=-20.0),
        times(u, u, u, r, by=-20.0),
        times(u, u, by=60.0),
        times(u, u, r, by=60.0),
        times(w, by=-60.0),
    )


KERNEL = RadialKernel(
    "wendland-c2",
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
