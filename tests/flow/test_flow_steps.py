"""Single steps: implicit ones are solved wherever their field is strictly monotone, however narrowly."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from musclefit.errors import NotConvergedError
from musclefit.fields.radial import RadialBackend, RadialField
from musclefit.flow.steps import CayleyStep, ExplicitStep


@pytest.mark.parametrize("seed", range(8))
def test_steps_close_to_their_limit_are_solved_everywhere(seed):
    """Newton's method overshoots where the field's slope jumps; updates that do not help must be taken back."""
    rng = np.random.default_rng(seed)
    handles, points = rng.uniform(-50.0, 50.0, (11, 2)), rng.uniform(-50.0, 50.0, (20_000, 2))
    field = RadialBackend("wendland-c2", 90.0).fit(handles, rng.normal(size=(11, 2)))
    gradients = field.gradient(points)
    strain = np.linalg.eigvalsh(0.5 * (gradients + gradients.swapaxes(1, 2)))
    cayley = field.scaled(1.99 / np.abs(strain).max())
    targets = points - 0.5 * cayley.displacement(points)
    step = CayleyStep(cayley)
    there = step(targets)
    np.testing.assert_allclose(there - targets, cayley.displacement(0.5 * (there + targets)), rtol=0, atol=1e-9)
    explicit = ExplicitStep(field.scaled(-0.995 / strain.min()))
    back = explicit.inverse()(explicit(points))
    np.testing.assert_allclose(explicit(back), explicit(points), rtol=0, atol=1e-9)


def test_a_step_that_flattens_space_cannot_be_undone_and_says_so():
    flat = RadialField("gaussian", 1.0, *(np.zeros((1, 3)),) * 2, np.zeros(3), np.diag([-1.0, 0, 0]), np.zeros(3), 0, 0)
    with pytest.raises(NotConvergedError, match="no solution at 2 of 3 points"):
        ExplicitStep(flat).inverse()(np.array([[0.0, 1.0, 2.0], [3.0, 1.0, 2.0], [-4.0, 0.0, 0.0]]))


def test_steps_of_many_handles_are_solved_far_from_the_origin():
    """Sums of r⁵ cancel; what rounding leaves of the equation grows with the coordinates, as its limit must."""
    rng = np.random.default_rng(3)
    middle = np.array([-1.6e5, 1.5e5, -1.8e5])
    handles, points = (middle + 2e4 * rng.uniform(-1.0, 1.0, (count, 3)) for count in (110, 3000))
    field = RadialBackend("isochoric-r5").fit(handles, 2000.0 * rng.normal(size=handles.shape))
    strain = np.abs(np.linalg.eigvalsh(0.5 * (lambda g: g + g.swapaxes(1, 2))(field.gradient(points)))).max()
    step = CayleyStep(field.scaled(1.5 / strain))
    there = step(points)
    np.testing.assert_allclose(there - points, step.field.displacement(0.5 * (there + points)), rtol=0, atol=1e-6)


class Noisy:
    """A field whose values are off by what large sums round away; counts the points that it is asked for."""

    def __init__(self, field, noise_mm):
        self.field, self.noise_mm, self.asked = field, noise_mm, 0

    def displacement_and_gradient(self, points):
        self.asked += len(points)
        values, gradients = self.field.displacement_and_gradient(points)
        return values + self.noise_mm * np.sin(1e12 * points), gradients


def _gentle():
    rng = np.random.default_rng(5)
    handles, points = rng.uniform(-50.0, 50.0, (30, 3)), rng.uniform(-50.0, 50.0, (2000, 3))
    field = RadialBackend("r3").fit(handles, rng.normal(size=(30, 3)))
    gradients = field.gradient(points)
    return field.scaled(1.0 / np.abs(gradients + gradients.swapaxes(1, 2)).max()), points


def test_a_step_ends_where_rounding_is_all_that_is_left_of_its_equation():
    field, points = _gentle()
    exact = Noisy(field, 0.0)
    expected = CayleyStep(exact)(points)
    noisy = Noisy(field, 3e-10)
    there = CayleyStep(noisy)(points)
    np.testing.assert_allclose(there, expected, rtol=0, atol=2e-9)
    assert noisy.asked <= exact.asked + 4 * len(points)


def test_the_error_of_an_unsolved_step_comes_whole_from_another_process():
    error = NotConvergedError("no solution at 2 points", np.array([1.0]))
    again = copy.copy(error)  # made anew as from a pickle
    assert str(again) == "no solution at 2 points"
    assert again.result is error.result
