"""Solves for the weights of a radial sum with a polynomial part, by one Cholesky factorisation that can be reused."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import blas, cho_factor, cho_solve, lapack

from musclefit.errors import FieldError
from musclefit.geometry.arrays import Float

RANK_TOLERANCE = 1e-10
"""Polynomial directions whose singular value is below this fraction of the largest count as not spanned."""


@dataclass(frozen=True, eq=False, slots=True)
class SaddleFactor:
    r"""Factorisation of

    .. math:: \begin{pmatrix} A & P \\ P^T & 0 \end{pmatrix}
              \begin{pmatrix} w \\ c \end{pmatrix} = \begin{pmatrix} d \\ 0 \end{pmatrix}

    with A (N, N) symmetric and positive definite on the null space of :math:`P^T`. P may be rank deficient: then only
    the directions that the rows of P span are used and ``c`` is the solution of least norm. Reflectors that span
    the range of P turn A into a positive definite block (the null-space method), which Cholesky factors.

    References
    ----------
    M. Benzi, G. Golub, J. Liesen, "Numerical solution of saddle point problems", Acta Numerica 14 (2005), section 6.
    """

    matrix: Float
    polynomials: Float
    rank: int
    _basis: Float
    _range_inverse: Float
    _reflectors: tuple[Float, Float]
    _cholesky: tuple[Float, bool]

    @classmethod
    def of(cls, matrix: Float, polynomials: Float) -> SaddleFactor:
        """Factor; ``matrix`` is (N, N), ``polynomials`` (N, q), q may be 0.

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
        try:
            block = _projected(matrix, reflectors, tau)
            cholesky = cho_factor(block, lower=True, overwrite_a=True, check_finite=False)
        except np.linalg.LinAlgError as error:
            raise FieldError(
                f"the system of {len(matrix)} handle equations is not positive definite: handles (nearly) coincide, or "
                "the kernel is too wide for their spacing; remove close handles, narrow the kernel or add smoothing"
            ) from error
        return cls(matrix, polynomials, rank, basis, range_inverse, (reflectors, tau), cholesky)

    def solve(self, data: Float) -> tuple[Float, Float]:
        """Weights (N, k) and polynomial coefficients (q, k) for data (N, k), refined once."""
        weights, coefficients = self._solve_once(data)
        residual = data - self.matrix @ weights - self.polynomials @ coefficients
        more_weights, more_coefficients = self._solve_once(residual)
        return weights + more_weights, coefficients + more_coefficients

    def _solve_once(self, data: Float) -> tuple[Float, Float]:
        reflectors, tau = self._reflectors
        rank = self.rank
        if not rank:
            return cho_solve(self._cholesky, data, check_finite=False), np.zeros((0, data.shape[1]))
        rotated = _reflect(reflectors, tau, data)
        inner = np.zeros_like(data)
        inner[rank:] = cho_solve(self._cholesky, rotated[rank:], check_finite=False)
        weights = _unreflect(reflectors, tau, inner)
        rest = _reflect(reflectors, tau, data - self.matrix @ weights)[:rank]
        return weights, self._basis @ (self._range_inverse @ rest)


def _projected(matrix: Float, reflectors: Float, tau: Float) -> Float:
    """Lower triangle of Q^T A Q without its first rows and columns, as many as reflectors, in one new array.

    With Q = I - V T V^T, X = A V T and W = X - V (T^T V^T X) / 2 it is A - V W^T - W V^T, for q reflectors an update of
    rank 2 q. What is above the diagonal is A's own, and Cholesky never looks at it.
    """
    rank = len(tau)
    block = matrix[rank:, rank:].copy().T  # symmetric, so this is A by columns, as LAPACK wants it
    if not rank or not block.size:
        return block
    v = np.tril(reflectors, -1)
    v[np.diag_indices(rank)] = 1.0
    t = np.zeros((rank, rank))
    for i in range(rank):
        t[:i, i] = -tau[i] * (t[:i, :i] @ (v[:, :i].T @ v[:, i]))
        t[i, i] = tau[i]
    x = matrix @ (v @ t)
    w = x - 0.5 * (v @ (t.T @ (v.T @ x)))
    updated: Float = blas.dsyr2k(-1.0, v[rank:], w[rank:], beta=1.0, c=block, lower=1, overwrite_c=1)
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
