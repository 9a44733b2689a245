"""The saddle system: large ones in mixed precision are solved as well as in double, or in double."""

from __future__ import annotations

import numpy as np
import pytest

from musclefit.fields.fitting import saddle as solve
from musclefit.fields.fitting.saddle import ROUGH_FROM, SaddleFactor


def system(n: int, eigenvalues: np.ndarray, n_polynomials: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A symmetric matrix of known eigenvalues, polynomials and data."""
    rng = np.random.default_rng(n)
    basis = np.eye(n)
    for _ in range(3):  # reflections turn the axes; no decomposition is needed
        normal = rng.normal(size=n)
        normal /= np.linalg.norm(normal)
        basis -= 2.0 * np.outer(basis @ normal, normal)
    matrix = (basis * eigenvalues) @ basis.T
    return 0.5 * (matrix + matrix.T), rng.normal(size=(n, n_polynomials)), rng.normal(size=(n, 2))


@pytest.mark.parametrize("n_polynomials", [0, 4])
@pytest.mark.parametrize(("condition", "kind"), [(1e4, np.float32), (1e9, np.float64)])
def test_a_large_system_is_solved_whatever_the_precision_of_its_factor(condition, kind, n_polynomials):
    n = ROUGH_FROM
    matrix, polynomials, data = system(n, np.geomspace(1.0, condition, n), n_polynomials)
    saddle = SaddleFactor.of(matrix.copy(), polynomials)
    assert saddle._factor.dtype == kind
    weights, coefficients = saddle.solve(data)
    residual = data - matrix @ weights - polynomials @ coefficients
    assert np.abs(residual).max() < 1e-15 * condition + 1e-13
    assert np.abs(polynomials.T @ weights).max(initial=0.0) < 1e-11


def test_mixed_precision_gives_what_double_gives(monkeypatch):
    matrix, polynomials, data = system(ROUGH_FROM, np.geomspace(1.0, 1e5, ROUGH_FROM), 4)
    mixed = SaddleFactor.of(matrix.copy(), polynomials).solve(data)
    monkeypatch.setattr(solve, "ROUGH_FROM", ROUGH_FROM + 1)
    double = SaddleFactor.of(matrix.copy(), polynomials).solve(data)
    for found, expected in zip(mixed, double, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_numbers_beyond_single_precision_are_factored_in_double():
    matrix, polynomials, data = system(ROUGH_FROM, np.geomspace(1.0, 1e4, ROUGH_FROM), 0)
    weights, _ = SaddleFactor.of(1e60 * matrix, polynomials).solve(data)
    np.testing.assert_allclose(1e60 * matrix @ weights, data, rtol=0, atol=1e-10)
