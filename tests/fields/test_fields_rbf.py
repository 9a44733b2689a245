"""Radial fields against textbook formulas, SciPy, and what they promise of divergence and polynomials."""

from __future__ import annotations

import numpy as np
import pytest
from oracles import difference_jacobian, isochoric_matrix, scalar_profile
from scipy.interpolate import RBFInterpolator

from musclefit.errors import FieldError
from musclefit.fields.kernels import KERNELS
from musclefit.fields.radial import RadialBackend, RadialField

SCALE = 30.0
SCALAR = [k.name for k in KERNELS.values() if not k.isochoric]
ISOCHORIC = [k.name for k in KERNELS.values() if k.isochoric]
WITH_AFFINE_PART = [k.name for k in KERNELS.values() if k.polynomial_degree >= 0]


def fitted(kernel: str, *, m: int = 40, n: int = 3, seed: int = 0) -> tuple[RadialField, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    at, moved = rng.uniform(-50.0, 50.0, (m, n)) + 300.0, rng.normal(size=(m, n))
    return RadialBackend(kernel, scale=SCALE).fit(at, moved), at, moved


def single(kernel: str, weight: np.ndarray) -> RadialField:
    """One source at the origin and no polynomial part."""
    zero = np.zeros(3)
    return RadialField(kernel, SCALE, zero[None], weight[None], zero, np.zeros((3, 3)), zero, 0, 0)


@pytest.mark.parametrize("kernel", list(KERNELS))
def test_a_field_takes_every_handle_where_it_must_go(kernel):
    field, at, moved = fitted(kernel)
    np.testing.assert_allclose(field.displacement(at), moved, rtol=0, atol=1e-10)


@pytest.mark.parametrize("kernel", SCALAR)
def test_one_scalar_source_is_the_textbook_kernel(kernel):
    weight = np.array([1.0, -2.0, 0.5])
    points = np.random.default_rng(1).uniform(-40.0, 40.0, (50, 3))
    expected = [scalar_profile(kernel, float(np.linalg.norm(x)), SCALE) * weight for x in points]
    np.testing.assert_allclose(single(kernel, weight).displacement(points), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kernel", ISOCHORIC)
def test_one_isochoric_source_is_the_curl_of_the_curl_of_its_potential(kernel):
    weight = np.array([1.0, -2.0, 0.5])
    points = np.random.default_rng(1).uniform(-12.0, 12.0, (20, 3))
    expected = np.array([isochoric_matrix(kernel, x, SCALE, step=1e-2) @ weight for x in points])
    size = np.abs(expected).max()
    np.testing.assert_allclose(single(kernel, weight).displacement(points), expected, rtol=0, atol=2e-5 * size)


@pytest.mark.parametrize(("kernel", "theirs"), [("r", "linear"), ("r2logr", "thin_plate_spline"), ("r3", "cubic")])
@pytest.mark.parametrize("n", [2, 3])
def test_a_field_equals_scipys_interpolant(kernel, theirs, n):
    field, at, moved = fitted(kernel, n=n)
    points = np.random.default_rng(2).uniform(240.0, 360.0, (200, n))
    expected = RBFInterpolator(at - 300.0, moved, kernel=theirs, degree=1)(points - 300.0)
    np.testing.assert_allclose(field.displacement(points), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kernel", list(KERNELS))
def test_the_gradient_is_the_derivative(kernel):
    field, _, _ = fitted(kernel)
    points = np.random.default_rng(3).uniform(250.0, 350.0, (100, 3))
    expected = difference_jacobian(field.displacement, points, step=1e-4)
    np.testing.assert_allclose(field.gradient(points), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("kernel", ["r", "r2logr", "r3", "gaussian"])
def test_the_gradient_is_the_derivative_in_the_plane(kernel):
    field, _, _ = fitted(kernel, n=2)
    points = np.random.default_rng(3).uniform(250.0, 350.0, (100, 2))
    expected = difference_jacobian(field.displacement, points, step=1e-4)
    np.testing.assert_allclose(field.gradient(points), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("kernel", ISOCHORIC)
def test_isochoric_fields_have_no_divergence(kernel):
    field, at, _ = fitted(kernel)
    points = np.vstack([np.random.default_rng(3).uniform(200.0, 400.0, (300, 3)), at])
    gradient = field.gradient(points)
    np.testing.assert_allclose(np.trace(gradient, axis1=1, axis2=2), 0.0, rtol=0, atol=1e-12 * np.abs(gradient).max())


def test_scalar_fields_do_have_divergence():
    field, _, _ = fitted("r3")
    assert np.abs(np.trace(field.gradient(np.full((1, 3), 300.0)), axis1=1, axis2=2)).max() > 1e-4


@pytest.mark.parametrize("kernel", WITH_AFFINE_PART)
def test_affine_motions_are_reproduced_everywhere(kernel):
    rng = np.random.default_rng(4)
    at = rng.uniform(-50.0, 50.0, (30, 3))
    linear = rng.normal(size=(3, 3))
    if KERNELS[kernel].isochoric:
        linear -= np.trace(linear) / 3.0 * np.eye(3)
    field = RadialBackend(kernel, scale=SCALE).fit(at, at @ linear.T + 7.0)
    points = rng.uniform(-200.0, 200.0, (100, 3))
    np.testing.assert_allclose(field.displacement(points), points @ linear.T + 7.0, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kernel", WITH_AFFINE_PART)
@pytest.mark.parametrize("shape", ["point", "line", "plane"])
def test_landmarks_that_do_not_span_space_still_give_a_tame_field(kernel, shape):
    rng = np.random.default_rng(5)
    spread = {"point": np.zeros((1, 3)), "line": rng.normal(size=(6, 1)) @ [[1.0, 0.3, -0.2]]}.get(shape)
    at = 40.0 * (spread if spread is not None else rng.normal(size=(9, 2)) @ [[1.0, 0.3, -0.2], [0.0, 1.0, 0.5]])
    moved = rng.normal(size=at.shape)
    field = RadialBackend(kernel, scale=SCALE).fit(at, moved)
    np.testing.assert_allclose(field.displacement(at), moved, rtol=0, atol=1e-9)
    assert field.polynomial_rank < field.polynomial_terms
    assert np.abs(field.displacement(at.mean(axis=0) + rng.uniform(-40.0, 40.0, (200, 3)))).max() < 50.0


def test_landmarks_that_span_space_use_the_whole_polynomial_part():
    field, _, _ = fitted("r3")
    assert (field.polynomial_rank, field.polynomial_terms) == (4, 4)


def test_smoothing_lets_the_field_miss_its_handles():
    rng = np.random.default_rng(6)
    at, moved = rng.uniform(-50.0, 50.0, (40, 3)), rng.normal(size=(40, 3))
    field = RadialBackend("r", smoothing=100.0).fit(at, moved)
    missed = np.abs(field.displacement(at) - moved).max()
    assert 1e-3 < missed < np.abs(moved).max() + 1.0


def test_a_factor_serves_many_displacements():
    rng = np.random.default_rng(7)
    at = rng.uniform(-50.0, 50.0, (40, 3))
    backend = RadialBackend("isochoric-r3")
    factor = backend.factor(at)
    for _ in range(3):
        moved = rng.normal(size=(40, 3))
        expected = backend.fit(at, moved).displacement(at + 1.0)
        np.testing.assert_allclose(factor.field(moved).displacement(at + 1.0), expected, rtol=0, atol=1e-12)


def test_scaled_fields_scale():
    field, at, moved = fitted("isochoric-r5")
    np.testing.assert_allclose(field.scaled(-0.5).displacement(at), -0.5 * moved, rtol=0, atol=1e-10)


def test_coinciding_handles_are_an_error_that_says_so():
    at = np.zeros((5, 3))
    with pytest.raises(FieldError, match="not positive definite: handles"):
        RadialBackend("gaussian", scale=SCALE).fit(at, at)


def test_unknown_kernels_and_scales_are_errors():
    with pytest.raises(FieldError, match="no kernel is named 'tps'; there are: r, r2logr"):
        RadialBackend("tps")
    with pytest.raises(FieldError, match=r"scale is -1\.0 mm"):
        RadialBackend("gaussian", scale=-1.0)
    with pytest.raises(FieldError, match="needs points in space"):
        RadialBackend("isochoric-r3").fit(np.zeros((3, 2)), np.zeros((3, 2)))
