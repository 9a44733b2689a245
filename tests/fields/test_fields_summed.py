"""Sums of a radial field and splines: values, derivatives, proved bounds."""

from __future__ import annotations

import numpy as np
import pytest

from musclefit.fields.lattice_fit import LatticeBackend
from musclefit.fields.rbf import RadialBackend
from musclefit.fields.summed import SummedField


@pytest.fixture(scope="module", params=["r", "r3"])
def field(request: pytest.FixtureRequest) -> SummedField:
    rng = np.random.default_rng(8)
    at = rng.uniform(-60.0, 60.0, (40, 3))
    radial = RadialBackend(request.param).fit(at, rng.normal(0.0, 2.0, at.shape))
    data = rng.uniform(-25.0, 25.0, (500, 3))
    moves = 0.04 * data * np.sin(data / 9.0)
    return SummedField(radial, LatticeBackend((20.0, 10.0, 5.0), 0.0, 20).fit(data, moves, around=data))


def test_it_is_the_sum(field: SummedField) -> None:
    points = np.random.default_rng(1).uniform(-50.0, 50.0, (500, 3))
    both = field.first.displacement(points) + field.splines.displacement(points)
    np.testing.assert_array_equal(field.displacement(points), both)
    np.testing.assert_allclose(field.scaled(-2.0).displacement(points), -2.0 * both, rtol=1e-12, atol=1e-12)
    h = 1e-4
    gradients = field.gradient(points)
    for axis in range(3):
        step = h * np.eye(3)[axis]
        slope = (field.displacement(points + step) - field.displacement(points - step)) / (2.0 * h)
        np.testing.assert_allclose(gradients[:, :, axis], slope, rtol=0, atol=1e-4)


@pytest.mark.parametrize("half", [0.1, 1.0, 6.0, 40.0])
def test_bounds_hold_at_every_place_tried(field: SummedField, half: float) -> None:
    rng = np.random.default_rng(int(10 * half))
    centres = np.concatenate([rng.uniform(-40.0, 40.0, (150, 3)), field.first.centres[:10]])
    halves = half * rng.uniform(0.2, 1.0, centres.shape)
    gradients, radii = field.gradient_bounds(centres, halves)
    ranges, _ = field.strain_bounds(centres, halves, enough=(-0.05, 0.05))
    values, reach = field.displacement_bounds(centres, halves)
    for _ in range(60):
        inner = centres + halves * np.clip(rng.uniform(-1.15, 1.15, centres.shape), -1.0, 1.0)
        there, steep = field.displacement_and_gradient(inner)
        known = np.isfinite(gradients).all(axis=(1, 2))
        off = np.linalg.norm(steep[known] - gradients[known], ord=2, axis=(1, 2))
        assert (off <= radii[known] + 1e-12).all()
        eigenvalues = np.linalg.eigvalsh(0.5 * (steep + steep.transpose(0, 2, 1)))
        assert (eigenvalues[:, 0] >= ranges[:, 0] - 1e-12).all()
        assert (eigenvalues[:, -1] <= ranges[:, 1] + 1e-12).all()
        assert (np.abs(there - values) <= reach + 1e-12).all()


def test_bounds_close_in(field: SummedField) -> None:
    centres = np.random.default_rng(3).uniform(-20.0, 20.0, (100, 3))
    ranges, middles = field.strain_bounds(centres, np.full_like(centres, 1e-6), enough=(-1e-3, 1e-3))
    np.testing.assert_allclose(ranges, middles, rtol=0, atol=1e-4)
