"""Proved bounds of free-form deformations, attacked by dense sampling, optimisation and exact rational arithmetic."""

from __future__ import annotations

import time
from fractions import Fraction

import numpy as np
import pytest
from scipy.optimize import minimize

from musclefit.errors import FieldError
from musclefit.fields.ffd import FfdField, Lattice
from musclefit.fields.fitting.ffd import FfdBackend

N_BOXES = 150


def lattice_field(n: int) -> FfdField:
    shape = (7, 6, 8)[:n]
    lattice = Lattice(np.array([1.0, 2.0, 3.0])[:n], np.array([5.0, 6.0, 4.0])[:n], shape)
    return lattice.field(np.random.default_rng(0).normal(size=(int(np.prod(shape)), n)))


def fitted(n: int, m: int) -> FfdField:
    rng = np.random.default_rng(1)
    return FfdBackend().fit(rng.uniform(-30.0, 50.0, (m, n)), rng.normal(scale=5.0, size=(m, n)))


FIELDS = {
    "lattice, plane": lattice_field(2),
    "lattice, space": lattice_field(3),
    "one level": fitted(3, 10),
    "three levels": fitted(3, 60),
    "three levels, plane": fitted(2, 30),
}
each_field = pytest.mark.parametrize("name", FIELDS)


def boxes(n: int, *, seed: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """From points to boxes that hold the whole lattice."""
    rng = np.random.default_rng(seed)
    size = rng.choice([0.0, 1e-9, 1e-3, 0.1, 1.0, 8.0, 60.0], (N_BOXES, 1))
    return rng.uniform(-25.0, 55.0, (N_BOXES, n)), size * rng.uniform(0.0, 1.0, (N_BOXES, n))


def inside(centre: np.ndarray, half: np.ndarray, count: int, rng) -> np.ndarray:
    """Points of a box: its inside, faces, edges and corners alike."""
    return centre + half * np.clip(rng.uniform(-1.4, 1.4, (count, len(centre))), -1.0, 1.0)


@each_field
def test_no_sample_leaves_the_bounds(name):
    field = FIELDS[name]
    rng = np.random.default_rng(3)
    centres, halves = boxes(len(field.origin))
    gradients, radii = field.gradient_bounds(centres, halves)
    strains, _ = field.strain_bounds(centres, halves, enough=(0.0, 0.0))
    values, reach = field.displacement_bounds(centres, halves)
    for box in range(N_BOXES):
        displacement, gradient = field.displacement_and_gradient(inside(centres[box], halves[box], 400, rng))
        eigenvalues = np.linalg.eigvalsh(0.5 * (gradient + gradient.transpose(0, 2, 1)))
        assert np.linalg.norm(gradient - gradients[box], 2, axis=(1, 2)).max() <= radii[box]
        assert eigenvalues.min() >= strains[box, 0]
        assert eigenvalues.max() <= strains[box, 1]
        assert (np.abs(displacement - values[box]) <= reach[box]).all()


@each_field
def test_no_optimiser_leaves_the_bounds(name):
    field = FIELDS[name]
    rng = np.random.default_rng(4)
    n = len(field.origin)
    centres, halves = rng.uniform(-5.0, 35.0, (6, n)), rng.uniform(0.5, 6.0, (6, n))
    gradients, radii = field.gradient_bounds(centres, halves)
    strains, _ = field.strain_bounds(centres, halves, enough=(0.0, 0.0))
    for centre, half, gradient, radius, strain in zip(centres, halves, gradients, radii, strains, strict=True):

        def lowest(u, centre=centre, half=half):
            g = field.gradient(centre + half * np.clip(np.atleast_2d(u), -1.0, 1.0))
            return np.linalg.eigvalsh(0.5 * (g + g.transpose(0, 2, 1)))[:, 0]

        def farthest(u, centre=centre, half=half, gradient=gradient):
            g = field.gradient(centre + half * np.clip(np.atleast_2d(u), -1.0, 1.0))
            return -np.linalg.norm(g - gradient, 2, axis=(1, 2))

        for function, limit in ((lowest, strain[0]), (farthest, -radius)):
            starts = rng.uniform(-1.2, 1.2, (500, n))
            start = starts[np.argmin(function(starts))]
            found = minimize(lambda u, f=function: f(u)[0], start, method="Nelder-Mead", options={"maxiter": 100})
            assert found.fun >= limit


@each_field
def test_bounds_close_in_on_the_true_range(name):
    """Within a cell and up to the cell's curvature, the bounds are what sampling finds: not merely safe, but tight."""
    field = FIELDS[name]
    rng = np.random.default_rng(5)
    n = len(field.origin)
    centres, halves = rng.uniform(5.0, 25.0, (60, n)), np.full((60, n), 0.3)
    gradients, radii = field.gradient_bounds(centres, halves)
    found = [
        np.linalg.norm(field.gradient(inside(c, h, 1500, rng)) - g, 2, axis=(1, 2)).max()
        for c, h, g in zip(centres, halves, gradients, strict=True)
    ]
    assert np.median(np.array(found) / radii) > 0.9


def test_the_gradient_at_a_centre_is_exact_up_to_its_stated_rounding():
    """Against rational arithmetic: the claim is about the field as a formula, not about what fast loops make of it."""
    field = lattice_field(2)
    level = field.levels[0]
    rng = np.random.default_rng(6)
    centres = rng.uniform(0.0, 25.0, (20, 2))
    gradients, radii = field.gradient_bounds(centres, np.zeros((20, 2)))
    for centre, gradient, radius in zip(centres, gradients, radii, strict=True):
        exact = np.array(
            [
                [float(_exact(level, centre, c, axis) - Fraction(float(gradient[c, axis]))) for axis in range(2)]
                for c in range(2)
            ]
        )
        assert np.linalg.norm(exact, 2) <= radius
        assert radius < 1e-10


def test_a_huge_box_and_one_far_away_are_bounded():
    field = FIELDS["three levels"]
    gradients, radii = field.gradient_bounds(np.zeros((1, 3)), np.full((1, 3), 1e4))
    sampled = field.gradient(np.random.default_rng(7).uniform(-100.0, 100.0, (20000, 3)))
    assert np.linalg.norm(sampled - gradients[0], 2, axis=(1, 2)).max() <= radii[0]
    gradients, radii = field.gradient_bounds(np.full((1, 3), 1e4), np.ones((1, 3)))
    np.testing.assert_allclose(gradients[0], field.linear, rtol=0, atol=1e-15)
    assert radii[0] < 1e-12


def test_wide_boxes_cost_little_more_than_narrow_ones():
    """However many cells they meet: one that met a whole lattice took as long as a thousand narrow ones."""
    lattice = Lattice(np.zeros(3), np.ones(3), (24, 24, 24))
    field = lattice.field(np.random.default_rng(0).normal(size=(24**3, 3)))
    centres = np.random.default_rng(1).uniform(8.0, 16.0, (60, 3))

    def cpu_s(half_width: float) -> float:
        began = time.process_time()
        field.gradient_bounds(centres, np.full((60, 3), half_width))
        return time.process_time() - began

    cpu_s(1.2), cpu_s(1000.0)  # compiled, if need be
    assert min(cpu_s(1000.0) for _ in range(3)) < 3.0 * min(cpu_s(1.2) for _ in range(3))
    assert min(cpu_s(7.0) for _ in range(3)) < 3.0 * min(cpu_s(1.2) for _ in range(3))


def test_negative_half_widths_are_an_error():
    with pytest.raises(FieldError, match="negative half width"):
        lattice_field(3).gradient_bounds(np.zeros((1, 3)), np.array([[1.0, -1.0, 1.0]]))


def _exact(level, x, component: int, axis: int) -> Fraction:
    """One entry of the gradient in rational arithmetic."""
    total = Fraction(0)
    for index in np.ndindex(*level.lattice.shape):
        term = Fraction(float(level.coefficients[index][component]))
        for k in range(2):
            h = Fraction(float(level.lattice.spacing[k]))
            u = (Fraction(float(x[k])) - Fraction(float(level.lattice.low[k]))) / h - index[k]
            term *= _spline_slope(u) / h if k == axis else _spline(u)
        total += term
    return total


def _spline(u: Fraction) -> Fraction:
    a = abs(u)
    if a >= 2:
        return Fraction(0)
    return Fraction(2, 3) - a**2 + a**3 / 2 if a < 1 else (2 - a) ** 3 / 6


def _spline_slope(u: Fraction) -> Fraction:
    a, sign = abs(u), 1 if u > 0 else -1
    if a >= 2:
        return Fraction(0)
    return sign * (-2 * a + Fraction(3, 2) * a**2) if a < 1 else -sign * (2 - a) ** 2 / 2
