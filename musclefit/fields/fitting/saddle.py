"""Solves for the weights of a radial sum with a polynomial part, by one Cholesky factorisation that can be reused."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack

from musclefit.errors import FieldError
from musclefit.geometry.arrays import Float

RANK_TOLERANCE = 1e-10
"""Polynomial directions whose singular value is below this fraction of the largest count as not spanned."""

ROUGH_FROM = 1500
"""Equations from which on a factor in single precision is tried, to be refined by residuals in double precision."""

ROUGH_GAIN = 0.01
"""It is kept if it brings a residual down by this at least."""

REFINEMENTS, REFINED, SLOW = 12, 1e-14, 0.25
"""Solutions are refined so often at most, until the residual is this share of the data, or falls by less than SLOW."""


@dataclass(frozen=True, eq=False, slots=True)
class SaddleFactor:
    r"""Factorisation of the saddle system.

    .. math:: \begin{pmatrix} A & P \\ P^T & 0 \end{pmatrix}
              \begin{pmatrix} w \\ c \end{pmatrix} = \begin{pmatrix} d \\ 0 \end{pmatrix}

    with A (N, N) symmetric and positive definite on the null space of :math:`P^T`. P may be rank deficient: then only
    the directions that the rows of P span are used and ``c`` is the solution of least norm. Reflectors that span
    the range of P turn A into a positive definite block (the null-space method), which Cholesky factors; a large one in
    single precision where residuals in double precision then refine the solutions as far as a factor in double would.

    References
    ----------
    M. Benzi, G. Golub, J. Liesen, "Numerical solution of saddle point problems", Acta Numerica 14 (2005), section 6.
    """

    polynomials: Float
    rank: int
    _columns: Float
    """A above the diagonal."""
    _factor: NDArray[np.float32] | Float
    """Cholesky's, lower triangle; in double precision it is below A."""
    _diagonal: Float
    """A's own."""
    _basis: Float
    _range_inverse: Float
    _reflectors: tuple[Float, Float]

    @classmethod
    def of(cls, matrix: Float, polynomials: Float) -> SaddleFactor:
        """Factor; ``matrix`` is (N, N) and is used up, ``polynomials`` (N, q), q may be 0.

        Raises
        ------
        FieldError
            The matrix is not positive definite where it should be: landmarks (nearly) coincide, or the kernel is too
            wide for their spacing.
        """
        if polynomials.shape[1]:
            _, singular, vt = np.linalg.svd(polynomials, full_matrices=False)
            rank = int(np.sum(singular > RANK_TOLERANCE * singular[0]))
            basis = vt[:rank].T
        else:
            rank, basis = 0, np.zeros((0, 0))
        spanned = np.asfortranarray(polynomials @ basis)
        if rank:
            reflectors, tau, _, _ = lapack.dgeqrf(spanned)
            range_inverse = np.linalg.inv(np.triu(reflectors[:rank]))
        else:
            reflectors, tau, range_inverse = spanned, np.zeros(0), np.zeros((0, 0))
        diagonal = matrix.diagonal().copy()
        columns = _projected(matrix, reflectors, tau)
        if len(matrix) >= ROUGH_FROM:
            with np.errstate(over="ignore"):
                rough, info = lapack.spotrf(columns.astype(np.float32), lower=1, clean=0, overwrite_a=1)
            found = cls(polynomials, rank, columns, rough, diagonal, basis, range_inverse, (reflectors, tau))
            if not info and found._gain() <= ROUGH_GAIN:
                return found
        factor, info = lapack.dpotrf(columns, lower=1, clean=0, overwrite_a=1)
        if info:
            raise FieldError(
                f"the system of {len(matrix)} handle equations is not positive definite: handles (nearly) coincide, or "
                "the kernel is too wide for their spacing; remove close handles, narrow the kernel or add smoothing"
            )
        return cls(polynomials, rank, factor, factor, diagonal, basis, range_inverse, (reflectors, tau))

    def solve(self, data: Float) -> tuple[Float, Float]:
        """Weights (N, k) and polynomial coefficients (q, k) for data (N, k), refined once at least."""
        weights, coefficients, left = self._solve_once(data)
        size = float(np.abs(left).max(initial=0.0))
        enough = REFINED * float(np.abs(data).max(initial=0.0))
        for _ in range(REFINEMENTS):
            more_weights, more_coefficients, left = self._solve_once(left)
            weights, coefficients = weights + more_weights, coefficients + more_coefficients
            before, size = size, float(np.abs(left).max(initial=0.0))
            if size <= enough or size > SLOW * before:
                break
        return weights, coefficients

    def _gain(self) -> float:
        """What is left of some data after one solution; infinite when that is not a number."""
        data = np.cos(np.arange(len(self._columns)) ** 2.0)[:, None]
        left = float(np.abs(self._solve_once(data)[2]).max())
        return left if np.isfinite(left) else np.inf

    def _solve_once(self, data: Float) -> tuple[Float, Float, Float]:
        """Weights, coefficients, and what they leave of the data."""
        reflectors, tau = self._reflectors
        rank = self.rank
        inner = self._inner(_reflect(reflectors, tau, data) if rank else data.copy(order="F"))
        weights = _unreflect(reflectors, tau, inner) if rank else inner
        left = data - self._product(weights)
        if not rank:
            return weights, np.zeros((0, data.shape[1])), left
        coefficients = self._basis @ (self._range_inverse @ _reflect(reflectors, tau, left)[:rank])
        return weights, coefficients, left - self.polynomials @ coefficients

    def _inner(self, data: Float) -> Float:
        """Solution of the definite system; the data are used up."""
        data[: self.rank] = 0.0
        if self._factor.dtype == np.float64:
            solution: Float = lapack.dpotrs(self._factor, data, lower=1, overwrite_b=1)[0]
            return solution
        size = float(np.abs(data).max(initial=0.0)) or 1.0
        rough = lapack.spotrs(self._factor, (data / size).astype(np.float32), lower=1, overwrite_b=1)[0]
        refined: Float = size * rough.astype(np.float64)
        return refined

    def _product(self, values: Float) -> Float:
        """A times values, from A's triangle."""
        product = (self._diagonal - self._columns.diagonal())[:, None] * values
        for k in range(values.shape[1]):
            product[:, k] += blas.dsymv(1.0, self._columns, np.ascontiguousarray(values[:, k]), lower=0)
        return product


def _projected(matrix: Float, reflectors: Float, tau: Float) -> Float:
    """Lower triangle of Q^T A Q by columns in A's own memory, its first rows and columns, one a reflector, those of I.

    With Q = I - V T V^T, X = A V T and W = X - V (T^T V^T X) / 2 it is A - V W^T - W V^T, for q reflectors an update of
    rank 2 q. What is above the diagonal stays A's own, and Cholesky never looks at it.
    """
    rank = len(tau)
    columns = np.ascontiguousarray(matrix).T  # symmetric, so this is A by columns, as LAPACK wants it
    if not rank:
        return columns
    v = np.tril(reflectors, -1)
    v[np.diag_indices(rank)] = 1.0
    t = np.zeros((rank, rank))
    for i in range(rank):
        t[:i, i] = -tau[i] * (t[:i, :i] @ (v[:, :i].T @ v[:, i]))
        t[i, i] = tau[i]
    x = matrix @ (v @ t)
    w = x - 0.5 * (v @ (t.T @ (v.T @ x)))
    updated: Float = blas.dsyr2k(-1.0, v, w, beta=1.0, c=columns, lower=1, overwrite_c=1)
    for k in range(rank):
        updated[k, k], updated[k + 1 :, k] = 1.0, 0.0
    return updated


def _reflect(reflectors: Float, tau: Float, values: Float) -> Float:
    """Q^T values, Q the orthogonal factor held as reflectors."""
    return _apply(reflectors, tau, values, "T")


def _unreflect(reflectors: Float, tau: Float, values: Float) -> Float:
    """Q values."""
    return _apply(reflectors, tau, values, "N")


def _apply(reflectors: Float, tau: Float, values: Float, transpose: str) -> Float:
    columns = np.asfortranarray(values)
    _, work, _ = lapack.dormqr("L", transpose, reflectors, tau, columns, -1)
    product, _, info = lapack.dormqr("L", transpose, reflectors, tau, columns, int(work[0]))
    if info != 0:
        raise FieldError(f"applying the reflectors failed (LAPACK dormqr info {info})")
    return product  # type: ignore[no-any-return]
