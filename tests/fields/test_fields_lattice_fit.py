"""Least squares fits on several lattices: data met where they can be, dense solutions, nothing beyond the lattices."""

from __future__ import annotations

import numpy as np
import pytest

from musclefit.errors import FieldError
from musclefit.fields.ffd import FfdField
from musclefit.fields.fitting.lattices import FLOOR, SEEN_SHARE, LatticeBackend, met_exactly
from musclefit.geometry.arrays import Points


def smooth(points: Points) -> Points:
    x, y, z = points.T
    return np.column_stack([np.sin(y / 20.0), 0.02 * x, np.cos(z / 25.0)])


def test_a_smooth_displacement_is_met_at_the_data_and_between() -> None:
    rng = np.random.default_rng(0)
    at, between = rng.uniform(0.0, 60.0, size=(4000, 3)), rng.uniform(5.0, 55.0, size=(1000, 3))
    field = LatticeBackend((16.0, 8.0, 4.0), 1e-3, 200).fit(at, smooth(at), around=at)
    assert np.sqrt(((field.displacement(at) - smooth(at)) ** 2).sum(axis=1).mean()) <= 1e-3
    np.testing.assert_allclose(field.displacement(between), smooth(between), rtol=0, atol=0.02)


def test_the_field_is_zero_two_cells_beyond_its_widest_lattice() -> None:
    at = np.array([[0.0, 0.0, 0.0], [5.0, 1.0, 2.0], [100.0, 0.0, 0.0]])
    wanted = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    field = LatticeBackend((10.0, 5.0), 1e-9, 50).fit(at, wanted, around=at[:2])
    np.testing.assert_allclose(field.displacement(at), wanted, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(field.displacement(np.array([[70.0, 0.0, 0.0], [0.0, -60.0, 0.0]])), 0.0)


def test_it_is_the_dense_solution_of_least_scaled_norm() -> None:
    rng = np.random.default_rng(1)
    at, wanted = rng.uniform(0.0, 9.0, size=(12, 3)), rng.normal(size=(12, 3))
    field = LatticeBackend((8.0, 4.0), 0.0, 400).fit(at, wanted, around=at)
    columns, scales = [], []
    for level in field.levels:
        shape = level.lattice.shape
        own = np.empty((len(at), int(np.prod(shape))))
        for number in range(own.shape[1]):
            unit = np.zeros((own.shape[1], 3))
            unit[number, 0] = 1.0
            own[:, number] = level.lattice.field(unit).displacement(at)[:, 0]
        seen = own.sum(axis=0)
        whole = np.quantile(seen[seen > 0.0], SEEN_SHARE)
        columns.append(own)
        scales.append(1.0 / np.sqrt(level.lattice.spacing[0] * (seen / whole + FLOOR)))
    scale = np.concatenate(scales)
    dense = scale[:, None] * np.linalg.lstsq(np.hstack(columns) * scale, wanted, rcond=None)[0]
    found = np.concatenate([level.coefficients.reshape(-1, 3) for level in field.levels])
    np.testing.assert_allclose(found, dense, rtol=0, atol=1e-7)
    assert isinstance(field, FfdField)


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (((), 0.1, 5), "spacings are"),
        (((5.0, -1.0), 0.1, 5), "each positive"),
        (((5.0,), np.nan, 5), "tolerance is nan"),
        (((5.0,), 0.1, 0), "iterations 0"),
    ],
)
def test_settings_that_fit_nothing_are_refused(settings: tuple[tuple[float, ...], float, int], told: str) -> None:
    with pytest.raises(FieldError, match=told):
        LatticeBackend(*settings)


def test_a_lattice_too_large_is_refused() -> None:
    at = np.array([[0.0, 0.0, 0.0], [900.0, 900.0, 900.0]])
    with pytest.raises(FieldError, match="widen the spacing"):
        LatticeBackend((1.0,), 0.1, 5).fit(at, at, around=at)


def test_a_few_points_are_met_exactly_and_nothing_changes_far_from_them() -> None:
    rng = np.random.default_rng(2)
    data = rng.uniform(-40.0, 40.0, (300, 3))
    field = LatticeBackend((16.0, 8.0, 4.0), 0.0, 5).fit(data, rng.normal(size=(300, 3)), around=data)
    at = np.concatenate([rng.uniform(-35.0, 35.0, (20, 3)), [[1.0, 2.0, 3.0], [1.0, 2.0, 3.5]]])
    wanted = rng.normal(size=at.shape)
    met = met_exactly(field, at, wanted)
    np.testing.assert_allclose(met.displacement(at), field.displacement(at) + wanted, rtol=0, atol=1e-10)
    far = np.array([[0.0, 0.0, 120.0]])
    np.testing.assert_array_equal(met.displacement(far), field.displacement(far))


def test_a_point_beside_a_fine_lattice_is_met_by_the_wide_ones() -> None:
    data = np.random.default_rng(3).uniform(-10.0, 10.0, (200, 3))
    field = LatticeBackend((16.0, 2.0), 0.0, 5).fit(data, data, around=data)
    at, wanted = np.array([[22.0, 0.0, 0.0]]), np.array([[0.1, -0.2, 0.3]])
    assert (field.levels[1].lattice.control_points().max(axis=0) < at).any()
    met = met_exactly(field, at, wanted)
    np.testing.assert_allclose(met.displacement(at), field.displacement(at) + wanted, rtol=0, atol=1e-12)


def test_a_level_that_no_point_sees_stays_zero() -> None:
    around = np.random.default_rng(4).uniform(-10.0, 10.0, (200, 3))
    field = LatticeBackend((16.0, 2.0), 0.0, 5).fit(np.array([[22.0, 0.0, 0.0]]), np.ones((1, 3)), around=around)
    assert not field.levels[1].coefficients.any()
    np.testing.assert_allclose(field.displacement(np.array([[22.0, 0.0, 0.0]])), 1.0, rtol=0, atol=1e-9)
