"""Sums of a radial field and splines: values, derivatives, proved bounds."""

from __future__ import annotations

import numpy as np
import pytest
from attacks import attack_boxes
from oracles import difference_jacobian

from musclefit.fields.fitting.lattices import LatticeBackend
from musclefit.fields.radial import RadialBackend, RadialField
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
    differences = difference_jacobian(field.displacement, points, step=1e-4)
    np.testing.assert_allclose(field.gradient(points), differences, rtol=0, atol=1e-4)


@pytest.mark.parametrize("half", [0.1, 1.0, 6.0, 40.0])
def test_bounds_hold_at_every_place_tried(field: SummedField, half: float) -> None:
    rng = np.random.default_rng(int(10 * half))
    assert isinstance(field.first, RadialField)
    centres = np.concatenate([rng.uniform(-40.0, 40.0, (150, 3)), field.first.centres[:10]])
    halves = half * rng.uniform(0.2, 1.0, centres.shape)
    attack_boxes(field, centres, halves, rng, enough=(-0.05, 0.05), tries=60)


def test_bounds_close_in(field: SummedField) -> None:
    centres = np.random.default_rng(3).uniform(-20.0, 20.0, (100, 3))
    ranges, middles = field.strain_bounds(centres, np.full_like(centres, 1e-6), enough=(-1e-3, 1e-3))
    np.testing.assert_allclose(ranges, middles, rtol=0, atol=1e-4)
