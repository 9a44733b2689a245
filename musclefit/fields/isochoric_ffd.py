r"""Free-form deformations that keep volume: a traceless affine part and curls of B-spline potentials on wide lattices.

The affine part is the one of least squares. What it leaves goes to potentials (`solenoidal_fit`) on lattices from half
as wide as the handles span down to about their own distance, each a quarter as wide as the one before. Coefficients are
scaled so that the sum of their squares is about the energy :math:`\int |\nabla^3 D|^2`, that of the isochoric kernel
r³: smooth between handles far apart, and fading out over the widest cells. No handle is met exactly: the iteration ends
early, before it strains the field between handles for the last digits of their displacements.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musclefit.errors import FieldError
from musclefit.fields.corrected import CorrectedField
from musclefit.fields.fitting.solenoidal import SolenoidalBackend
from musclefit.fields.radial import TRACELESS, RadialField
from musclefit.geometry.arrays import Float, Points

SMOOTHNESS = 2.5
"""Power of a lattice's spacing by which its coefficients are scaled: the energy of third derivatives."""

SPANNED = 0.5
"""The widest lattice is the first at least this wide, in units of the handles' longest extent."""

WIDER = 4.0
"""Spacing of a lattice in units of the next one's: a power of two, so that lattices share their knots, at which a proof
cuts its boxes. With 2 the field is no smoother, and has twice as many lattices to be summed."""

MAX_LEVELS = 12
"""Of a fit; handles that span 4^12 cells are no anatomy."""

ITERATIONS = 15
"""Of conjugate gradients at most: more meet the handles better and strain the field between them for it."""

TOLERANCE = 1e-3
"""Root mean square of what handles are missed by, in units of that of their displacements, at which a fit ends."""


@dataclass(frozen=True, slots=True)
class IsochoricFfdBackend:
    """Fits free-form deformations without divergence to handles in space.

    Parameters
    ----------
    narrowest_mm : float
        Spacing of the narrowest lattice; the others have 4, 16... times as much.

    Raises
    ------
    FieldError
        The spacing is not a positive number.
    """

    narrowest_mm: float

    def __post_init__(self) -> None:
        if not 0.0 < self.narrowest_mm < np.inf:
            raise FieldError(f"the lattice's spacing is {self.narrowest_mm} mm; it must be a positive number")

    def spacings_mm(self, at: Points) -> tuple[float, ...]:
        """Of the lattices for (m, 3) handles, mm, wide to narrow.

        Raises
        ------
        FieldError
            The handles span far more cells than any anatomy does.
        """
        widest, extent = self.narrowest_mm, float(np.ptp(at, axis=0).max(initial=0.0))
        found = [widest]
        while widest < SPANNED * extent:
            widest *= WIDER
            found.append(widest)
            if len(found) > MAX_LEVELS:
                raise FieldError(
                    f"handles that span {extent:.3g} mm would need more than {MAX_LEVELS} lattices from "
                    f"{self.narrowest_mm:.3g} mm up; widen the narrowest"
                )
        return tuple(reversed(found))

    def fit(self, at: Points, displacements: Points) -> CorrectedField:
        """The field that takes about the (m, 3) displacements at the (m, 3) handles, mm.

        Raises
        ------
        FieldError
            The handles are not in space, or span too many cells.
        """
        if at.ndim != 2 or at.shape[1] != 3:
            raise FieldError(f"handles have shape {at.shape}; a field without divergence needs (m, 3)")
        affine = _traceless(at, displacements)
        left = displacements - affine.displacement(at)
        size = float(np.sqrt((displacements**2).sum() / len(at)))
        backend = SolenoidalBackend(TOLERANCE * size, smoothness=SMOOTHNESS)
        rest = backend.at_rest([(spacing, at) for spacing in self.spacings_mm(at)])
        none = np.zeros((0, 3))
        return CorrectedField(affine, backend.fit(at, left, slip_normals=none, on=rest.levels, iterations=ITERATIONS))


def _traceless(at: Points, displacements: Points) -> RadialField:
    """The affine field without divergence that is closest to the displacements: a radial sum of no centres."""
    origin = at.mean(axis=0)
    local = at - origin
    extent = float(np.abs(local).max(initial=0.0)) or 1.0
    shifts = np.broadcast_to(np.eye(3), (len(at), 3, 3))
    terms: Float = np.concatenate([shifts, np.einsum("kij,mj->mik", TRACELESS, local / extent)], axis=2)
    solved = np.linalg.lstsq(terms.reshape(-1, 11), displacements.reshape(-1), rcond=None)[0]
    found: Float = np.asarray(solved, dtype=np.float64)
    return RadialField(
        kernel="isochoric-r3",
        scale=1.0,
        centres=np.zeros((0, 3)),
        weights=np.zeros((0, 3)),
        origin=origin,
        linear=np.tensordot(found[3:], TRACELESS, axes=1) / extent,
        translation=found[:3],
        polynomial_rank=11,
        polynomial_terms=11,
    )
