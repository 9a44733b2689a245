"""Fits of compact kernels to very many points: sparse, without a matrix, by conjugate gradients."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

from musclefit.errors import FieldError
from musclefit.fields.kernels import KERNELS
from musclefit.fields.radial import RadialField
from musclefit.geometry.arrays import Float, Points


@dataclass(frozen=True, slots=True)
class CompactBackend:
    """Fits a compact radial field; what a point does not see within the support costs nothing.

    Parameters
    ----------
    kernel : str
        A compact one of `musclefit.fields.kernels.KERNELS`.
    support_mm : float
        Where the kernel ends.
    tolerance : float
        The residual's norm over the displacements' at which the iteration ends.
    max_iterations : int
        Ends the iteration too: the residual that is left shows in the displacements.

    Raises
    ------
    FieldError
        The kernel is not compact, or the support not a positive number.

    References
    ----------
    M. Floater and A. Iske, "Multistep scattered data interpolation using compactly supported radial basis functions",
    J. Comput. Appl. Math. 73 (1996) 65.
    """

    kernel: str
    support_mm: float
    tolerance: float = 1e-12
    max_iterations: int = 2000

    def __post_init__(self) -> None:
        if self.kernel not in KERNELS or not KERNELS[self.kernel].compact:
            compact = ", ".join(k.name for k in KERNELS.values() if k.compact)
            raise FieldError(f"kernel {self.kernel!r} is not compact; compact ones are: {compact}")
        if not 0.0 < self.support_mm < np.inf:
            raise FieldError(f"the support is {self.support_mm} mm; it must be a positive number")

    def fit(self, at: Points, displacements: Points) -> RadialField:
        """The field that takes the (m, n) displacements at the (m, n) points."""
        n = at.shape[1]
        zero = RadialField(
            kernel=self.kernel,
            scale=self.support_mm,
            centres=at,
            weights=np.zeros_like(at),
            origin=at.mean(axis=0),
            linear=np.zeros((n, n)),
            translation=np.zeros(n),
            polynomial_rank=0,
            polynomial_terms=0,
        )

        def applied(weights: Float) -> Float:
            return replace(zero, weights=weights.reshape(-1, n)).displacement(at).ravel()

        operator = LinearOperator((at.size, at.size), matvec=applied, dtype=np.float64)
        weights, _ = cg(operator, displacements.ravel(), rtol=self.tolerance, atol=0.0, maxiter=self.max_iterations)
        return replace(zero, weights=weights.reshape(-1, n))
