"""Free-form deformations against direct sums, subdivision and SciPy; fits that meet their landmarks."""

from __future__ import annotations

import numpy as np
import pytest
from oracles import bspline_displacement, difference_jacobian
from scipy.interpolate import BSpline

from musclefit.errors import FieldError
from musclefit.fields.ffd import FfdField, Lattice, SplineLevel
from musclefit.fields.fitting.ffd import _GRAMS, FfdBackend, LevelSystem, nearest_distance
from musclefit.fields.radial import RadialBackend

SHAPES = {2: (7, 6), 3: (7, 6, 8)}


def random_lattice_field(n: int, *, seed: int = 0) -> FfdField:
    shape = SHAPES[n]
    lattice = Lattice(np.array([1.0, 2.0, 3.0])[:n], np.array([5.0, 6.0, 4.0])[:n], shape)
    return lattice.field(np.random.default_rng(seed).normal(size=(int(np.prod(shape)), n)))


def around(n: int, count: int, *, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-15.0, 50.0, (count, n))


def landmarks(m: int, n: int, *, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-50.0, 50.0, (m, n)) + 300.0, rng.normal(scale=5.0, size=(m, n))


@pytest.mark.parametrize("n", [2, 3])
def test_a_lattice_field_is_the_sum_of_textbook_splines(n):
    field = random_lattice_field(n)
    points = around(n, 200)
    expected = [bspline_displacement(field.levels[0], x) for x in points]
    np.testing.assert_allclose(field.displacement(points), expected, rtol=0, atol=1e-13)


def test_one_coefficient_is_scipys_basis_function():
    lattice = Lattice(np.zeros(2), np.array([10.0, 10.0]), (1, 1))
    x = np.linspace(-25.0, 25.0, 101)
    found = lattice.field(np.array([[6.0, 0.0]])).displacement(np.column_stack([x, np.zeros_like(x)]))[:, 0]
    basis = BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)
    np.testing.assert_allclose(found, 6.0 * np.nan_to_num(basis(x / 10.0)) * basis(0.0), rtol=0, atol=1e-14)


@pytest.mark.parametrize("n", [2, 3])
def test_the_gradient_is_the_derivative(n):
    field, points = random_lattice_field(n), around(n, 300)
    expected = difference_jacobian(field.displacement, points, step=1e-5)
    values, gradients = field.displacement_and_gradient(points)
    np.testing.assert_allclose(gradients, expected, rtol=0, atol=1e-8)
    np.testing.assert_allclose(values, field.displacement(points), rtol=0, atol=1e-13)


@pytest.mark.parametrize("n", [2, 3])
def test_subdivision_keeps_the_field(n):
    field, points = random_lattice_field(n), around(n, 300)
    finer = FfdField((field.levels[0].subdivided().subdivided(),), field.origin, field.linear, field.translation)
    np.testing.assert_allclose(finer.displacement(points), field.displacement(points), rtol=0, atol=1e-13)
    np.testing.assert_allclose(finer.gradient(points), field.gradient(points), rtol=0, atol=1e-13)


@pytest.mark.parametrize("n", [2, 3])
def test_beyond_its_lattice_a_field_fades_without_a_tear(n):
    """Across the lattice's edge value, slope and curvature are continuous; two cells out nothing is left."""
    field = random_lattice_field(n)
    lattice = field.levels[0].lattice
    low = lattice.low - 2.0 * lattice.spacing
    high = lattice.low + lattice.spacing * (np.array(lattice.shape) + 1.0)
    line = np.linspace(-0.2, 1.2, 4001)[:, None]
    along = low + line * (high - low)
    values, slopes = field.displacement_and_gradient(along)
    outside = (line[:, 0] < 0.0) | (line[:, 0] > 1.0)
    np.testing.assert_array_equal(values[outside], 0.0)
    np.testing.assert_array_equal(slopes[outside], 0.0)
    assert np.abs(np.diff(values, axis=0)).max() < 0.02
    assert np.abs(np.diff(slopes, axis=0)).max() < 0.02


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("m", [1, 2, 4, 40, 300])
def test_a_fit_meets_its_landmarks_exactly(n, m):
    at, moved = landmarks(m, n)
    np.testing.assert_allclose(FfdBackend().fit(at, moved).displacement(at), moved, rtol=0, atol=1e-10)


@pytest.mark.parametrize("n", [2, 3])
def test_a_fit_reproduces_affine_motions_in_all_of_space(n):
    rng = np.random.default_rng(4)
    at, _ = landmarks(30, n)
    linear, far = rng.normal(size=(n, n)), rng.uniform(-500.0, 900.0, (200, n))
    field = FfdBackend().fit(at, at @ linear.T + 7.0)
    np.testing.assert_allclose(field.displacement(far), far @ linear.T + 7.0, rtol=0, atol=1e-8)


def test_landmarks_closer_than_the_lattice_refine_it():
    at, moved = landmarks(40, 3)
    close = np.concatenate([at, at[:1] + np.array([0.9, 0.0, 0.0])])
    pulled = np.concatenate([moved, moved[:1] + np.array([0.5, 0.2, 0.0])])
    coarse, fine = FfdBackend().fit(at, moved), FfdBackend().fit(close, pulled)
    assert len(fine.levels) > len(coarse.levels)
    spacings = [float(level.lattice.spacing[0]) for level in fine.levels]
    assert spacings == [20.0 * 0.5**k for k in range(len(spacings))]
    np.testing.assert_allclose(fine.displacement(close), pulled, rtol=0, atol=1e-10)


def test_the_integrals_of_the_bending_energy_are_those_of_the_splines():
    nodes, weights = np.polynomial.legendre.leggauss(5)
    basis = BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)
    for order, gram in enumerate(_GRAMS):
        slope = basis.derivative(order) if order else basis
        for apart in range(4):
            cells = np.arange(-2, 2) + apart
            x = (cells[:, None] + 0.5 + 0.5 * nodes).ravel()
            product = np.nan_to_num(slope(x)) * np.nan_to_num(slope(x - apart))
            assert gram[apart] == pytest.approx(product @ np.tile(0.5 * weights, 4), abs=1e-14)


def test_multipliers_become_coefficients_that_their_gram_matrix_foretells():
    at, moved = landmarks(12, 2)
    system = LevelSystem.coarsest(at, 20.0)
    saddle = system.factor(np.hstack([np.ones((12, 1)), at - at.mean(axis=0)]), exact=True)
    weights, _ = saddle.solve(moved)
    coefficients = system.coefficients(weights)
    gram = system.gram()
    expected = FfdField((SplineLevel(system.lattice, coefficients),), np.zeros(2), np.zeros((2, 2)), np.zeros(2))
    np.testing.assert_allclose(expected.displacement(at), gram @ weights, rtol=0, atol=1e-9)


def test_a_smooth_motion_is_followed_as_well_as_by_radial_sums():
    rng = np.random.default_rng(5)

    def motion(x):
        return np.stack([6 * np.sin(x[:, 1] / 25), 5 * np.cos(x[:, 2] / 30), 4 * np.sin(x[:, 0] / 28)], axis=1)

    at, points = rng.uniform(-50.0, 50.0, (200, 3)), rng.uniform(-45.0, 45.0, (2000, 3))
    ours = np.abs(FfdBackend().fit(at, motion(at)).displacement(points) - motion(points)).mean()
    radial = np.abs(RadialBackend("r").fit(at, motion(at)).displacement(points) - motion(points)).mean()
    assert ours < 1.2 * radial


@pytest.mark.parametrize("shape", ["point", "line", "plane"])
def test_landmarks_that_do_not_span_space_still_give_a_tame_field(shape):
    rng = np.random.default_rng(5)
    spread = {"point": np.zeros((1, 3)), "line": rng.normal(size=(6, 1)) @ [[1.0, 0.3, -0.2]]}.get(shape)
    at = 40.0 * (spread if spread is not None else rng.normal(size=(9, 2)) @ [[1.0, 0.3, -0.2], [0.0, 1.0, 0.5]])
    moved = rng.normal(size=at.shape)
    field = FfdBackend().fit(at, moved)
    np.testing.assert_allclose(field.displacement(at), moved, rtol=0, atol=1e-9)
    assert np.abs(field.displacement(at.mean(axis=0) + rng.uniform(-40.0, 40.0, (200, 3)))).max() < 50.0


def test_scaled_fields_scale():
    at, moved = landmarks(20, 3)
    field = FfdBackend().fit(at, moved)
    np.testing.assert_allclose(field.scaled(-0.5).displacement(at), -0.5 * moved, rtol=0, atol=1e-10)


def test_control_points_lie_on_the_box_that_the_lattice_spans():
    lattice = Lattice.around(np.zeros(3), np.array([60.0, 90.0, 40.0]), shape=(7, 10, 5))
    points = lattice.control_points()
    assert len(points) == 350
    np.testing.assert_allclose(points.min(axis=0), 0.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(points.max(axis=0), [60.0, 90.0, 40.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(points[1] - points[0], [0.0, 0.0, 10.0], rtol=0, atol=1e-12)


def test_nearest_distance_is_the_smallest_of_all():
    at, _ = landmarks(30, 3)
    pairs = np.linalg.norm(at[:, None] - at, axis=2)[~np.eye(30, dtype=bool)]
    assert nearest_distance(at) == pytest.approx(pairs.min(), rel=1e-12)
    assert nearest_distance(at[:1]) == np.inf


def test_errors_name_the_value_and_the_way_out():
    at, moved = landmarks(10, 3)
    with pytest.raises(FieldError, match="two handles are 0 mm apart"):
        FfdBackend().fit(np.vstack([at, at[:1]]), np.vstack([moved, moved[:1] + 1.0]))
    with pytest.raises(FieldError, match=r"spacing is 0\.0 mm"):
        FfdBackend(0.0)
    with pytest.raises(FieldError, match="levels is 0"):
        FfdBackend(10.0, 0)
    with pytest.raises(FieldError, match="widen the spacing or allow fewer levels"):
        FfdBackend(0.2).fit(at, moved)
    with pytest.raises(FieldError, match=r"this field needs \(N, 3\)"):
        FfdBackend().fit(at, moved).displacement(np.zeros((2, 2)))
    with pytest.raises(FieldError, match="every axis needs at least one point and a positive"):
        Lattice(np.zeros(2), np.array([1.0, -1.0]), (3, 3))
    with pytest.raises(FieldError, match=r"give \(9, 2\), one for each control point"):
        Lattice(np.zeros(2), np.ones(2), (3, 3)).field(np.zeros((4, 2)))
    with pytest.raises(FieldError, match="cannot span a box"):
        Lattice.around(np.zeros(2), np.ones(2), shape=(1, 3))
