"""The marching loop: Eq. 6, its shortcut and what that costs, stalls, budgets, and steps that are rejected."""

from __future__ import annotations

import numpy as np
import pytest
from oracles import row_norm_fraction

from musclefit.errors import NotConvergedError
from musclefit.fields.rbf import RadialBackend
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.march import Pace, march, one_shot, points_beside
from musclefit.flow.rules import (
    cayley_fractions,
    gershgorin_fractions,
    monotone_fractions,
    row_norm_fractions,
)
from musclefit.flow.steppers import HandleStepper, cayley_step, explicit_step
from musclefit.geometry.rigid import RigidMotion
from musclefit.rig.handles import StraightPath

GRID = np.stack(np.meshgrid(*[np.linspace(0.0, 100.0, 41)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
CORNERS = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0], [100.0, 100.0]])


def squeeze(distance: float) -> StraightPath:
    """Two inner points of a square pushed apart sideways, corners held: Fig. 1 of the paper in spirit."""
    inner = np.array([[45.0, 50.0], [55.0, 50.0]])
    moved = inner + np.array([[distance, 8.0], [-distance, -8.0]])
    return StraightPath(np.vstack([CORNERS, inner]), np.vstack([CORNERS, moved]))


def determinants(deformation) -> np.ndarray:
    return np.linalg.det(deformation.jacobian(GRID))


@pytest.mark.parametrize("kernel", ["r2logr", "r3"])
def test_the_loop_unfolds_what_one_shot_folds(kernel):
    path, backend = squeeze(20.0), RadialBackend(kernel)
    shot = one_shot(path, backend, rule=row_norm_fractions, tested=GRID)
    loop = march(HandleStepper(path, backend, explicit_step), rule=row_norm_fractions, tested=GRID, pace=Pace(60))
    assert determinants(shot).min() < 0.0
    assert shot.margin < 0.0
    assert determinants(loop).min() > 0.0
    np.testing.assert_allclose(loop.require()(path.source), path.target, rtol=0, atol=1e-9)


@pytest.mark.parametrize("make", [explicit_step, cayley_step])
def test_points_that_ride_along_go_where_the_steps_take_them(make):
    path, rule = squeeze(12.0), cayley_fractions if make is cayley_step else row_norm_fractions
    loop = march(HandleStepper(path, RadialBackend("r3"), make), rule=rule, tested=GRID, pace=Pace(60, 2))
    alone = Deformation(loop.steps, loop.records, loop.status)
    for known, found in zip(loop.with_jacobian(GRID[:70]), alone.with_jacobian(GRID[:70]), strict=True):
        np.testing.assert_allclose(known, found, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(loop.with_jacobian(GRID[3:9])[0], alone.with_jacobian(GRID[3:9])[0])
    assert len(loop.steps) > 1


def test_each_step_is_as_long_as_eq_6_allows():
    path, backend = squeeze(20.0), RadialBackend("r3")
    loop = march(HandleStepper(path, backend, explicit_step), rule=row_norm_fractions, tested=GRID, pace=Pace(60))
    points, handles, done = GRID, path.source, 0.0
    for step, record in zip(loop.steps, loop.records, strict=True):
        field = backend.fit(handles, path.target - handles)
        fraction = min(1.0, row_norm_fraction(field.gradient(points)))
        assert record.end == pytest.approx(done + fraction * (1.0 - done), rel=2e-6)
        np.testing.assert_allclose(step(points), points + fraction * field.displacement(points), rtol=0, atol=1e-4)
        points, handles, done = step(points), step(handles), record.end
    assert len(loop.steps) > 2
    assert done == 1.0


def test_testing_at_landmarks_only_is_not_enough():
    path, backend = squeeze(20.0), RadialBackend("r3")
    shortcut = march(
        HandleStepper(path, backend, explicit_step),
        rule=row_norm_fractions,
        tested=points_beside(path.source),
        pace=Pace(60),
    )
    everywhere = march(HandleStepper(path, backend, explicit_step), rule=row_norm_fractions, tested=GRID, pace=Pace(60))
    assert len(shortcut.steps) < len(everywhere.steps)


def test_points_beside_see_the_slope_that_a_centre_hides():
    at = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 100.0], [30.0, 30.0, 30.0]])
    moved = np.zeros((5, 3))
    moved[4] = 5.0
    field = RadialBackend("r").fit(at, moved)
    at_centres = row_norm_fractions(field.gradient(at)).min()
    beside = row_norm_fractions(field.gradient(points_beside(at))).min()
    assert beside < 0.7 * at_centres


def test_no_rule_allows_a_fold_and_weaker_rules_allow_longer_steps():
    rng = np.random.default_rng(0)
    gradients = rng.normal(size=(2000, 3, 3))
    by_rule = {rule: rule(gradients) for rule in (row_norm_fractions, gershgorin_fractions, monotone_fractions)}
    for fractions in by_rule.values():
        shares = np.linspace(0.0, 0.999, 25)
        for share in shares:
            safe = np.where(np.isfinite(fractions), fractions, 10.0) * share
            assert np.linalg.det(np.eye(3) + safe[:, None, None] * gradients).min() > 0.0
    assert (by_rule[monotone_fractions] >= by_rule[row_norm_fractions]).all()


def test_the_cayley_rule_is_blind_to_rotation_and_sees_strain():
    skew = np.array([[[0.0, -9.0, 1.0], [9.0, 0.0, 2.0], [-1.0, -2.0, 0.0]]])
    np.testing.assert_array_equal(cayley_fractions(skew), [np.inf])
    np.testing.assert_allclose(cayley_fractions(skew + np.diag([0.5, 0.0, -0.25])), [4.0], rtol=1e-12)
    np.testing.assert_allclose(cayley_fractions(skew + np.diag([0.5, 0.0, -4.0])), [0.5], rtol=1e-12)


def test_a_march_without_a_safe_step_stalls_and_says_where():
    path = squeeze(20.0)
    place = 17

    def never(gradients):
        fractions = np.full(len(gradients), 2.0)
        fractions[place] = 0.0
        return fractions

    for stepper in (explicit_step, cayley_step):
        stalled = march(HandleStepper(path, RadialBackend("r3"), stepper), rule=never, tested=GRID, pace=Pace(60))
        assert stalled.status is Status.STALLED
        assert stalled.steps == ()
        assert stalled.records[-1].worst_place == tuple(GRID[place])
        with pytest.raises(NotConvergedError, match="no safe step is left"):
            stalled.require()


def test_a_march_out_of_steps_says_so_and_keeps_what_it_has():
    loop = march(
        HandleStepper(squeeze(20.0), RadialBackend("r3"), explicit_step),
        rule=row_norm_fractions,
        tested=GRID,
        pace=Pace(2),
    )
    assert loop.status is Status.OUT_OF_STEPS
    assert len(loop.steps) == 2
    with pytest.raises(NotConvergedError, match="raise max_steps") as caught:
        loop.require()
    assert caught.value.result is loop


def test_rejected_ends_are_recorded_and_the_rest_is_marched():
    path = squeeze(20.0)
    loop = march(
        HandleStepper(path, RadialBackend("r3"), cayley_step), rule=cayley_fractions, tested=GRID, pace=Pace(200)
    )
    assert loop.status is Status.CONVERGED
    assert any(record.rejected for record in loop.records)
    for record in loop.records:
        assert all(end > record.end for end in record.rejected)
        assert 0.0 < record.margin <= 1.0
    starts, ends = [r.start for r in loop.records], [r.end for r in loop.records]
    assert starts == [0.0, *ends[:-1]]
    assert ends[-1] == 1.0
    assert determinants(loop).min() > 0.0


def test_a_straight_path_that_turns_by_half_stalls_where_a_bone_path_would_not():
    rng = np.random.default_rng(1)
    at = rng.uniform(-50.0, 50.0, (20, 3))
    half_turn = RigidMotion.about_axis(centre=np.zeros(3), axis=np.array([0.0, 0.0, 1.0]), angle_deg=180.0)
    loop = march(
        HandleStepper(StraightPath(at, half_turn(at)), RadialBackend("r3"), explicit_step),
        rule=row_norm_fractions,
        tested=at,
        pace=Pace(100),
    )
    assert loop.status is not Status.CONVERGED
