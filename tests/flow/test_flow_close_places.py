"""Places taken through a map together go where each goes alone, for fewer evaluations of its fields."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from musclefit.errors import NotConvergedError
from musclefit.fields.radial import RadialBackend, RadialField
from musclefit.flow.close_places import FEW, moved_together, with_jacobian_together
from musclefit.flow.deformation import Deformation, Ridden, Status
from musclefit.flow.steps import CayleyStep, ExplicitStep


@dataclass
class Counted:
    """A field that counts the points at which it is asked."""

    field: RadialField
    asked: int = 0

    def displacement_and_gradient(self, points):
        self.asked += len(points)
        return self.field.displacement_and_gradient(points)

    def displacement(self, points):
        self.asked += len(points)
        return self.field.displacement(points)


def field(kernel: str, dimension: int, strain: float, *, seed: int = 0) -> RadialField:
    """Random, with a symmetric gradient of that size at most, on a grid around it."""
    rng = np.random.default_rng(seed)
    handles = rng.uniform(-50.0, 50.0, (12, dimension))
    found = RadialBackend(kernel).fit(handles, rng.normal(size=handles.shape))
    gradients = found.gradient(rng.uniform(-60.0, 60.0, (4000, dimension)))
    largest = np.abs(np.linalg.eigvalsh(0.5 * (gradients + gradients.swapaxes(1, 2)))).max()
    return found.scaled(strain / largest)


def lines(dimension: int, *, count: int = 40, each: int = 60) -> np.ndarray:
    """Points along straight lines side by side, mm."""
    rng = np.random.default_rng(1)
    starts, ends = rng.uniform(-45.0, 45.0, dimension), rng.uniform(-45.0, 45.0, dimension)
    beside = rng.uniform(-4.0, 4.0, (count, 1, dimension))
    return (starts + beside + np.linspace(0.0, 1.0, each)[:, None] * (ends - starts)).reshape(-1, dimension)


def a_map(*steps) -> Deformation:
    return Deformation(steps, (), Status.CONVERGED)


@pytest.mark.parametrize(("kernel", "dimension"), [("isochoric-r3", 3), ("r3", 3), ("r2logr", 2)])
def test_places_go_where_they_go_alone(kernel, dimension):
    fields = [field(kernel, dimension, 0.8, seed=seed) for seed in range(3)]
    deformation = a_map(CayleyStep(fields[0]), ExplicitStep(fields[1].scaled(0.3)), CayleyStep(fields[2]))
    points = lines(dimension)
    alone, derivatives = deformation.with_jacobian(points)
    np.testing.assert_allclose(moved_together(deformation, points), alone, rtol=0, atol=1e-9)
    moved, jacobians = with_jacobian_together(deformation, points)
    np.testing.assert_allclose(moved, alone, rtol=0, atol=1e-9)
    np.testing.assert_allclose(jacobians, derivatives, rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_steps_close_to_their_limit_are_solved_too(seed):
    rng = np.random.default_rng(seed)
    handles = rng.uniform(-50.0, 50.0, (11, 2))
    steep = RadialBackend("wendland-c2", 90.0).fit(handles, rng.normal(size=(11, 2)))
    points = rng.uniform(-50.0, 50.0, (6000, 2))
    gradients = steep.gradient(points)
    strain = np.linalg.eigvalsh(0.5 * (gradients + gradients.swapaxes(1, 2)))
    steep = steep.scaled(1.99 / np.abs(strain).max())
    targets = points - 0.5 * steep.displacement(points)
    there = moved_together(a_map(CayleyStep(steep)), targets)
    np.testing.assert_allclose(there - targets, steep.displacement(0.5 * (there + targets)), rtol=0, atol=1e-9)


def test_a_third_of_the_evaluations_is_saved():
    asked = []
    for how in (Deformation.__call__, moved_together):
        counted = Counted(field("isochoric-r3", 3, 0.8))
        how(a_map(CayleyStep(counted)), lines(3))
        asked.append(counted.asked)
    assert asked[1] < 2 / 3 * asked[0]


def test_an_update_from_a_guess_is_checked_before_any_is_trusted():
    """How fast residuals fall is known from an update before: a first one, however close the guess, is not sure."""
    counted = Counted(field("isochoric-r3", 3, 0.8))
    step, points = CayleyStep(counted), lines(3)
    middles = 0.5 * (points + step(points))
    before = counted.asked
    moved = step.moved_from(points, middles + 1e-6)
    assert counted.asked - before >= 2 * len(points)
    np.testing.assert_allclose(moved, step(points), rtol=0, atol=1e-10)


def test_places_that_fall_together_and_single_ones_are_taken_too():
    deformation = a_map(CayleyStep(field("isochoric-r3", 3, 0.8)))
    same = np.tile([1.0, 2.0, 3.0], (FEW + 1, 1))
    flat = lines(3) * [1.0, 1.0, 0.0]
    for points in (same, flat, lines(3)[:5], np.zeros((0, 3))):
        np.testing.assert_allclose(moved_together(deformation, points), deformation(points), rtol=0, atol=1e-9)
        moved, jacobians = with_jacobian_together(deformation, points)
        np.testing.assert_allclose(jacobians, deformation.jacobian(points), rtol=0, atol=1e-9)
        assert moved.shape == points.shape


def test_what_rode_along_is_taken_as_it_is():
    points = lines(3)
    known = Ridden(points, points + 1.0, np.broadcast_to(np.eye(3), (len(points), 3, 3)))
    moved, _ = with_jacobian_together(
        Deformation((CayleyStep(field("r3", 3, 0.5)),), (), Status.CONVERGED, known), points
    )
    np.testing.assert_array_equal(moved, points + 1.0)


def test_a_step_without_a_solution_says_where():
    # D halves what lies before it, so that x - D(x) / 2 is flat: no midpoint but where the target is 0.
    flat = RadialField("r3", 1.0, *(np.zeros((1, 3)),) * 2, np.zeros(3), 2.0 * np.eye(3), np.zeros(3), 0, 0)
    with pytest.raises(NotConvergedError, match="no solution"):
        moved_together(a_map(CayleyStep(flat)), lines(3))
