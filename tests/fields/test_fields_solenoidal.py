"""Curls of spline potentials: no divergence, derivatives, fits with slip, and proved bounds that nothing escapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from oracles import difference_jacobian

from musclefit.errors import FieldError
from musclefit.fields.corrected import CorrectedField
from musclefit.fields.evaluation import potential_runs, potentials
from musclefit.fields.fitting.solenoidal import SolenoidalBackend
from musclefit.fields.radial import RadialBackend
from musclefit.fields.solenoidal import PotentialLevel, SolenoidalField


def some_field(seed: int = 0, spacings: tuple[float, ...] = (8.0, 4.0, 2.0)) -> SolenoidalField:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-10.0, 10.0, (40, 3)) * [1.0, 1.0, 0.2]
    levels = [PotentialLevel.around(points, spacing_mm=h) for h in spacings]
    return SolenoidalField(
        tuple(
            replace(level, coefficients=0.3 * level.spacing_mm * rng.normal(size=level.coefficients.shape))
            for level in levels
        )
    )


def some_sum(seed: int = 0) -> CorrectedField:
    rng = np.random.default_rng(seed)
    radial = RadialBackend("isochoric-r3").fit(rng.uniform(-30.0, 30.0, (20, 3)), rng.normal(size=(20, 3)))
    return CorrectedField(radial, some_field(seed))


def test_gradients_are_the_derivatives_and_have_no_trace():
    field = some_field()
    at = np.random.default_rng(1).uniform(-14.0, 14.0, (300, 3))
    differences = difference_jacobian(field.displacement, at, step=1e-5)
    values, gradients = field.displacement_and_gradient(at)
    np.testing.assert_allclose(gradients, differences, rtol=0, atol=1e-8)
    np.testing.assert_allclose(np.trace(gradients, axis1=1, axis2=2), 0.0, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(values, field.displacement(at))
    assert np.abs(gradients).max() > 0.1


def test_beyond_its_lattices_it_is_zero():
    away = np.array([[60.0, 0.0, 0.0], [0.0, -60.0, 0.0], [0.0, 0.0, 1e6]])
    np.testing.assert_array_equal(some_field().displacement(away), 0.0)


def test_sums_need_the_same_lattices():
    field = some_field()
    at = np.random.default_rng(1).uniform(-14.0, 14.0, (50, 3))
    np.testing.assert_allclose(
        field.plus(field.scaled(2.0)).displacement(at), 3.0 * field.displacement(at), rtol=0, atol=1e-13
    )
    with pytest.raises(FieldError, match="different lattices"):
        field.plus(some_field(1))


def test_a_fit_meets_what_a_field_without_divergence_does_on_a_surface():
    rng = np.random.default_rng(3)
    at = rng.normal(size=(1500, 3))
    at *= 15.0 / np.linalg.norm(at, axis=1, keepdims=True)
    wanted = np.cross([0.0, 0.03, 0.1], at) + np.stack(
        [np.sin(at[:, 1] / 6.0), np.cos(at[:, 2] / 7.0), 0.0 * at[:, 0]], axis=1
    )
    backend = SolenoidalBackend(1e-4)
    rest = backend.at_rest([(h, at) for h in (8.0, 4.0, 2.0)])
    errors = []
    for iterations in (5, 60):
        fit = backend.fit(at, wanted, slip_normals=np.zeros((0, 3)), on=rest.levels, iterations=iterations)
        errors.append(np.linalg.norm(fit.displacement(at) - wanted, axis=1).max())
    assert errors[1] < 0.01
    assert errors[1] < 0.2 * errors[0]


def test_between_its_data_a_fit_does_what_a_smooth_field_does():
    """No spikes at the points: lattices much finer than the data leave the gaps to the wide ones."""
    rows = np.arange(-30.0, 31.0, 6.0)
    plane = np.stack(np.meshgrid(rows, rows), axis=-1).reshape(-1, 2)
    at = np.column_stack([plane, 0.2 * np.random.default_rng(4).normal(size=len(plane))])
    between = (at + 3.0 * np.array([1.0, 1.0, 0.0]))[(np.abs(plane + 3.0) < 26.0).all(axis=1)]

    def wave(points):
        return 0.5 * np.column_stack([np.sin(points[:, 1] / 13.2), np.cos(points[:, 0] / 12.0), 0.0 * points[:, 0]])

    backend = SolenoidalBackend(1e-6)
    on = backend.at_rest([(h, np.vstack([at, between])) for h in (12.0, 6.0, 3.0, 1.5)]).levels
    fitted = backend.fit(at, wave(at), slip_normals=np.zeros((0, 3)), on=on, iterations=60)
    np.testing.assert_allclose(fitted.displacement(at), wave(at), rtol=0, atol=1e-4)
    np.testing.assert_allclose(fitted.displacement(between), wave(between), rtol=0, atol=0.02)


def test_at_slip_points_only_the_normal_part_is_held():
    rng = np.random.default_rng(4)
    at = 9.0 * np.stack(np.meshgrid(*[np.arange(5.0)] * 3), axis=-1).reshape(-1, 3)[:120] + rng.uniform(
        0.0, 2.0, (120, 3)
    )
    wanted = rng.normal(size=(120, 3))
    normals = rng.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    backend = SolenoidalBackend(1e-9)
    rest = backend.at_rest([(h, at) for h in (6.0, 3.0)])
    field = backend.fit(at, wanted, slip_normals=normals, on=rest.levels, iterations=200)
    missed = field.displacement(at) - wanted
    np.testing.assert_allclose(missed[:80], 0.0, rtol=0, atol=1e-3)
    np.testing.assert_allclose(np.einsum("si,si->s", missed[80:], normals), 0.0, rtol=0, atol=1e-3)
    assert np.abs(missed[80:]).max() > 0.3


@pytest.mark.parametrize("scale", [1e-3, 0.5, 3.0, 8.0])
def test_nothing_escapes_the_bounds_over_boxes(scale):
    field = some_sum()
    rng = np.random.default_rng(int(scale * 1000))
    centres, halves = rng.uniform(-20.0, 20.0, (150, 3)), scale * rng.uniform(0.1, 1.0, (150, 3))
    gradients, radii = field.gradient_bounds(centres, halves)
    sums, spread, strained = field.gradient_and_spreads(centres, halves)
    ranges, _ = field.strain_bounds(centres, halves, enough=(np.inf, -np.inf))
    quick, _ = field.strain_bounds(centres, halves, enough=(-np.inf, np.inf))
    values, off = field.displacement_bounds(centres, halves)
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(8, 3)
    tight = []
    for box in range(len(centres)):
        inside = np.vstack([corners, rng.uniform(-1.0, 1.0, (120, 3))])
        moved, slopes = field.displacement_and_gradient(centres[box] + halves[box] * inside)
        apart = np.linalg.norm(slopes - gradients[box], ord=2, axis=(1, 2)).max()
        strains = np.linalg.eigvalsh(0.5 * (slopes + slopes.transpose(0, 2, 1)))
        assert apart <= radii[box]
        assert np.linalg.norm(slopes - sums[box], axis=(1, 2)).max() <= spread[box]
        bent = slopes - sums[box]
        assert np.abs(np.linalg.eigvalsh(0.5 * (bent + bent.transpose(0, 2, 1)))).max() <= strained[box]
        assert ranges[box, 0] <= strains.min()
        assert strains.max() <= ranges[box, 1]
        assert quick[box, 0] <= strains.min()
        assert strains.max() <= quick[box, 1]
        assert (np.abs(moved - values[box]) <= off[box]).all()
        tight.append(np.ptp(strains) / np.ptp(ranges[box]))
    np.testing.assert_allclose(sums, gradients, rtol=0, atol=1e-9)
    assert np.median(spread / radii) < 6.0  # it is quick, and no more than some times as wide
    assert np.median(strained / spread) < 0.8
    assert np.mean(tight) > {1e-3: 0.9, 0.5: 0.7, 3.0: 0.3, 8.0: 0.01}[scale]


@pytest.mark.parametrize("scale", [1e-3, 0.7, 5.0, 40.0])
def test_nothing_escapes_the_ceilings(scale):
    field = some_field(3)
    rng = np.random.default_rng(int(scale * 1000))
    # On the lattices' knots, too: there a box ends on the edge of a cell.
    centres = np.vstack([rng.uniform(-25.0, 25.0, (200, 3)), 2.0 * rng.integers(-9, 9, (200, 3))])
    halves = np.vstack([scale * rng.uniform(0.1, 1.0, (200, 3)), np.full((200, 3), 2.0 * np.ceil(scale))])
    ceilings = field.ceilings(centres, halves)
    used, bent = 0.0, 0.0
    for box in range(len(centres)):
        inside = rng.uniform(-1.0, 1.0, (200, 3))
        places = centres[box] + halves[box] * np.sign(inside) * np.abs(inside) ** 0.3
        slopes = field.gradient(places)
        turned, lengths = slopes[::2] - slopes[1::2], np.linalg.norm(places[::2] - places[1::2], axis=1)
        bends = np.linalg.norm(turned, axis=(1, 2)) / lengths
        assert bends.max() <= ceilings[box, 2] + 1e-12
        strains = np.abs(np.linalg.eigvalsh(0.5 * (turned + turned.transpose(0, 2, 1)))).max(axis=1) / lengths
        assert strains.max() <= ceilings[box, 3] + 1e-12
        bent = max(bent, bends.max() / max(ceilings[box, 2], 1e-300))
        strains = np.abs(np.linalg.eigvalsh(0.5 * (slopes + slopes.transpose(0, 2, 1)))).max()
        assert np.linalg.norm(slopes, axis=(1, 2)).max() <= ceilings[box, 0]
        assert strains <= ceilings[box, 1]
        used = max(used, strains / max(ceilings[box, 1], 1e-300))
    assert used > 0.25
    assert bent > 0.1
    away = field.ceilings(np.array([[200.0, 0.0, 0.0], [0.0, 0.0, -90.0]]), np.full((2, 3), 5.0))
    np.testing.assert_array_equal(away, 0.0)


def test_nothing_escapes_the_bounds_over_balls():
    field = some_sum(1)
    rng = np.random.default_rng(5)
    centres, radii = rng.uniform(-20.0, 20.0, (100, 3)), rng.uniform(0.01, 4.0, 100)
    gradients, off = field.gradient_ball_bounds(centres, radii)
    ranges, _ = field.strain_ball_bounds(centres, radii)
    for ball in range(len(centres)):
        ways = rng.normal(size=(100, 3))
        ways *= radii[ball] / np.linalg.norm(ways, axis=1, keepdims=True)
        slopes = field.gradient(centres[ball] + ways * rng.uniform(0.0, 1.0, (100, 1)))
        strains = np.linalg.eigvalsh(0.5 * (slopes + slopes.transpose(0, 2, 1)))
        assert np.linalg.norm(slopes - gradients[ball], ord=2, axis=(1, 2)).max() <= off[ball]
        assert ranges[ball, 0] <= strains.min()
        assert strains.max() <= ranges[ball, 1]


def test_runs_of_coefficients_give_what_single_ones_give() -> None:
    """At points that see all their splines; those at a border or in a hole of the lattice are found not to."""
    rng = np.random.default_rng(7)
    level = PotentialLevel.around(rng.uniform(-12.0, 12.0, (60, 3)), spacing_mm=4.0)
    points = rng.uniform(-26.0, 26.0, (3000, 3))
    rows = np.zeros((len(points), 16), np.int32)
    potential_runs.runs_seen(level.low, level.spacing_mm, level.numbers, points, rows)
    which = np.flatnonzero(rows[:, 0] >= 0)
    assert 50 < len(which) < 2000
    coefficients = np.zeros((len(level.coefficients), 4))
    coefficients[:, :3] = rng.normal(size=level.coefficients.shape)
    expected, found = np.zeros((2, len(points), 3))
    lattice = (level.low, level.spacing_mm)
    potentials.curl_sum(*lattice, level.numbers, coefficients, points, expected)
    unseen = rows[:, 0] == potential_runs.NOT_AT_ALL
    np.testing.assert_array_equal(unseen, (expected == 0.0).all(axis=1))
    potential_runs.curl_sum_of_runs(*lattice, rows[which], which, points, coefficients, found)
    np.testing.assert_allclose(found[which], expected[which], rtol=0, atol=1e-14 * np.abs(expected).max() * 64)
    assert np.count_nonzero(found.any(axis=1)) == len(which)
    values, spread, by_runs = np.zeros_like(points), np.zeros_like(coefficients), np.zeros_like(coefficients)
    values[which] = rng.normal(size=(len(which), 3))
    potentials.curl_spread(*lattice, level.numbers, points[which], values[which], spread)
    potential_runs.curl_spread_to_runs(*lattice, rows[which], which, points, values, by_runs)
    np.testing.assert_allclose(by_runs, spread, rtol=0, atol=1e-13 * np.abs(spread).max())
    assert np.vdot(found, values) == pytest.approx(np.vdot(coefficients, by_runs), rel=1e-10)


def test_a_fit_is_the_same_wherever_its_points_stand_in_the_lattice() -> None:
    """Points away from a level, and at its border, take part in the other levels' fit."""
    rng = np.random.default_rng(9)
    at, near = rng.uniform(-10.0, 10.0, (400, 3)), rng.uniform(-3.0, 3.0, (40, 3))
    wanted = np.cross([0.1, -0.2, 0.05], at)
    backend = SolenoidalBackend(1e-12)
    on = backend.at_rest([(8.0, at), (2.0, near)]).levels
    field = backend.fit(at, wanted, slip_normals=np.zeros((0, 3)), on=on, iterations=4000)
    left = wanted - field.displacement(at)
    slope = [np.zeros_like(level.coefficients) for level in on]
    first = [np.zeros_like(level.coefficients) for level in on]
    for level, out, start in zip(on, slope, first, strict=True):
        potentials.curl_spread(level.low, level.spacing_mm, level.numbers, at, left, out)
        potentials.curl_spread(level.low, level.spacing_mm, level.numbers, at, wanted, start)
    for out, start in zip(slope, first, strict=True):
        assert np.abs(out).max() < 1e-4 * np.abs(start).max()  # the normal equations hold on every level


def test_a_fit_ends_where_iterations_gain_no_more() -> None:
    rng = np.random.default_rng(11)
    at = rng.uniform(-10.0, 10.0, (300, 3))
    wanted = at - at.mean(axis=0)  # has divergence: most of it cannot be met
    on = SolenoidalBackend(0.0).at_rest([(10.0, at), (5.0, at)]).levels
    missed = {}
    for gain in (0.0, 0.04):
        backend = SolenoidalBackend(1e-9, least_gain=gain)
        for most in (40, 400):
            field = backend.fit(at, wanted, slip_normals=np.zeros((0, 3)), on=on, iterations=most)
            missed[gain, most] = float(np.linalg.norm(field.displacement(at) - wanted))
    assert missed[0.04, 40] == missed[0.04, 400]
    assert missed[0.0, 400] < missed[0.0, 40]
    assert missed[0.0, 40] <= missed[0.04, 40] < 1.3 * missed[0.0, 40]


def test_what_a_proof_finds_goes_with_the_proof():
    """A prepared field is the same, and bounds itself anew: a field that is kept does not keep its ceilings."""
    field = some_field()
    centres, halves = np.zeros((1, 3)), np.ones((1, 3))
    proved = field.prepared()
    np.testing.assert_array_equal(proved.displacement(centres), field.displacement(centres))
    proved.ceilings(centres, halves)
    assert "_ceilings" in vars(proved)
    assert "_ceilings" not in vars(field)
    assert "_ceilings" not in vars(proved.prepared())
