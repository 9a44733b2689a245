"""Free-form deformations without divergence: derivatives, fits that are smooth between handles, and proved bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from oracles import difference_jacobian

from musclefit.errors import FieldError
from musclefit.fields.corrected import CorrectedField
from musclefit.fields.isochoric_ffd import IsochoricFfdBackend
from musclefit.fields.radial import RadialBackend
from musclefit.fields.solenoidal import PotentialLevel, SolenoidalField

BACKEND = IsochoricFfdBackend(16.0)
RNG = np.random.default_rng(0)
ROD = np.column_stack([9.0 * np.cos(np.arange(90) * 2.4), 9.0 * np.sin(np.arange(90) * 2.4), np.linspace(-90, 90, 90)])


def bent(points: np.ndarray) -> np.ndarray:
    """What the lower half of a rod does that turns by 12 degrees about the x axis."""
    c, s = np.cos(np.radians(12.0)), np.sin(np.radians(12.0))
    turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    return np.where(points[:, 2:] < 0.0, points @ turn.T - points, 0.0)


FIELD = BACKEND.fit(ROD, bent(ROD))


def with_more(seed: int = 0) -> CorrectedField:
    """The field with a local part beside its own, as bones add one."""
    rng = np.random.default_rng(seed)
    level = PotentialLevel.around(rng.uniform(-12.0, 12.0, (40, 3)), spacing_mm=4.0)
    more = SolenoidalField((replace(level, coefficients=0.2 * rng.normal(size=level.coefficients.shape)),))
    return CorrectedField.of(FIELD, more)


def strains(gradients: np.ndarray) -> np.ndarray:
    return np.linalg.eigvalsh(0.5 * (gradients + gradients.transpose(0, 2, 1)))


@pytest.mark.parametrize("field", [FIELD, with_more()], ids=["fitted", "with a local part"])
def test_gradients_are_the_derivatives_and_have_no_trace(field):
    at = np.random.default_rng(1).uniform(-120.0, 120.0, (400, 3)) * [0.5, 0.5, 1.0]
    differences = difference_jacobian(field.displacement, at, step=1e-4)
    values, gradients = field.displacement_and_gradient(at)
    np.testing.assert_allclose(gradients, differences, rtol=0, atol=1e-8)
    np.testing.assert_allclose(np.trace(gradients, axis1=1, axis2=2), 0.0, rtol=0, atol=1e-13)
    np.testing.assert_allclose(values, field.displacement(at), rtol=0, atol=1e-12)
    assert np.abs(gradients).max() > 0.1


def test_handles_are_met_about():
    missed = np.linalg.norm(FIELD.displacement(ROD) - bent(ROD), axis=1)
    moved = np.linalg.norm(bent(ROD), axis=1).max()
    assert moved > 18.0
    assert np.sqrt((missed**2).mean()) < 0.02 * moved


def test_between_and_beside_handles_it_strains_little_more_than_the_isochoric_radial_sum():
    radial = RadialBackend("isochoric-r3").fit(ROD, bent(ROD))
    beside = np.random.default_rng(2).uniform(-1.0, 1.0, (3000, 3)) * [40.0, 40.0, 85.0]
    own, theirs = (np.abs(strains(field.gradient(beside))).max(axis=1) for field in (FIELD, radial))
    for share in (0.5, 0.99, 1.0):
        assert np.quantile(own, share) < 1.3 * np.quantile(theirs, share)


@pytest.mark.parametrize("count", [4, 40])
def test_affine_fields_without_divergence_are_met_exactly(count):
    rng = np.random.default_rng(count)
    at, matrix = rng.uniform(-80.0, 80.0, (count, 3)), rng.normal(size=(3, 3))
    matrix -= np.trace(matrix) / 3.0 * np.eye(3)
    field = BACKEND.fit(at, 0.1 * at @ matrix.T + [3.0, -2.0, 1.0])
    away = rng.uniform(-300.0, 300.0, (50, 3))
    np.testing.assert_allclose(field.displacement(away), 0.1 * away @ matrix.T + [3.0, -2.0, 1.0], rtol=0, atol=1e-10)


@pytest.mark.parametrize("at", [np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0], [40.0, 0.0, 0.0]])], ids=["one", "two"])
def test_handles_that_do_not_span_space_suffice(at):
    field = BACKEND.fit(at, np.tile([1.0, 2.0, 3.0], (len(at), 1)))
    np.testing.assert_allclose(field.displacement(at), np.tile([1.0, 2.0, 3.0], (len(at), 1)), rtol=0, atol=1e-10)


def test_lattices_go_from_half_the_handles_extent_down_by_quarters():
    assert BACKEND.spacings_mm(ROD) == (256.0, 64.0, 16.0)
    assert BACKEND.spacings_mm(ROD[:1]) == (16.0,)
    assert [level.spacing_mm for level in FIELD.local.levels] == [256.0, 64.0, 16.0]


def test_lattices_share_their_knots():
    for level in FIELD.local.levels:
        np.testing.assert_array_equal(np.remainder(level.low, level.spacing_mm), 0.0)


@pytest.mark.parametrize("scale", [1e-3, 0.5, 3.0, 15.0])
@pytest.mark.parametrize("field", [FIELD, with_more()], ids=["fitted", "with a local part"])
def test_nothing_escapes_the_bounds_over_boxes(field, scale):
    rng = np.random.default_rng(int(scale * 1000))
    centres = rng.uniform(-1.0, 1.0, (100, 3)) * [40.0, 40.0, 100.0]
    halves = scale * rng.uniform(0.1, 1.0, (100, 3))
    gradients, radii = field.gradient_bounds(centres, halves)
    ranges, _ = field.strain_bounds(centres, halves, enough=(np.inf, -np.inf))
    values, off = field.displacement_bounds(centres, halves)
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(8, 3)
    tight = []
    for box in range(len(centres)):
        inside = np.vstack([corners, rng.uniform(-1.0, 1.0, (120, 3))])
        moved, slopes = field.displacement_and_gradient(centres[box] + halves[box] * inside)
        found = strains(slopes)
        assert np.linalg.norm(slopes - gradients[box], ord=2, axis=(1, 2)).max() <= radii[box]
        assert ranges[box, 0] <= found.min()
        assert found.max() <= ranges[box, 1]
        assert (np.abs(moved - values[box]) <= off[box]).all()
        tight.append(np.ptp(found) / np.ptp(ranges[box]))
    assert np.mean(tight) > {1e-3: 0.9, 0.5: 0.7, 3.0: 0.3, 15.0: 0.1}[scale]


def test_nothing_escapes_the_bounds_over_balls():
    field, rng = with_more(1), np.random.default_rng(5)
    centres, radii = rng.uniform(-1.0, 1.0, (100, 3)) * [40.0, 40.0, 100.0], rng.uniform(0.01, 6.0, 100)
    gradients, off = field.gradient_ball_bounds(centres, radii)
    ranges, _ = field.strain_ball_bounds(centres, radii)
    for ball in range(len(centres)):
        ways = rng.normal(size=(100, 3))
        ways *= radii[ball] / np.linalg.norm(ways, axis=1, keepdims=True)
        slopes = field.gradient(centres[ball] + ways * rng.uniform(0.0, 1.0, (100, 1)))
        found = strains(slopes)
        assert np.linalg.norm(slopes - gradients[ball], ord=2, axis=(1, 2)).max() <= off[ball]
        assert ranges[ball, 0] <= found.min()
        assert found.max() <= ranges[ball, 1]


def test_scaling_scales_all_parts():
    at = np.random.default_rng(6).uniform(-60.0, 60.0, (50, 3))
    np.testing.assert_allclose(
        with_more().scaled(-2.5).displacement(at), -2.5 * with_more().displacement(at), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("spacing", [0.0, -1.0, np.nan, np.inf])
def test_a_spacing_must_be_positive(spacing):
    with pytest.raises(FieldError, match="must be a positive number"):
        IsochoricFfdBackend(spacing)


def test_handles_in_the_plane_are_refused():
    with pytest.raises(FieldError, match=r"handles have shape \(5, 2\); a field without divergence needs \(m, 3\)"):
        BACKEND.fit(np.zeros((5, 2)), np.zeros((5, 2)))


def test_handles_that_span_too_many_cells_are_refused():
    with pytest.raises(FieldError, match="would need more than 12 lattices"):
        BACKEND.fit(np.array([[0.0, 0.0, 0.0], [1e9, 0.0, 0.0]]), np.zeros((2, 3)))
