"""The marching loop: Eq. 6, its shortcut and what that costs, stalls, budgets, and steps that are rejected."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from oracles import row_norm_fraction

from musclefit.errors import NotConvergedError
from musclefit.fields.radial import RadialBackend
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.march import Marching, Pace, march, one_shot, points_beside
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


# --- what joins later


SPARSE = np.array([[x, y] for x in (0.0, 100.0) for y in (0.0, 50.0, 100.0)])
DENSE = np.stack(np.meshgrid(*[np.linspace(30.0, 70.0, 81)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
FLOOR = 0.2


def sparse_march(distance: float = 20.0, *, min_steps: int = 4) -> Marching:
    """Tested so far from where the field is steep that it sees next to nothing."""
    stepper = HandleStepper(squeeze(distance), RadialBackend("r3"), cayley_step)
    pace = Pace(100, min_steps, 1.0 - FLOOR)
    return Marching.begun(stepper, rule=cayley_fractions, tested=SPARSE, pace=pace).marched()


def margins_at(march: Marching, points: np.ndarray) -> list[float]:
    """The margin of every step at points, by the rule's own definition, or -1 where a step has no solution there."""
    found, here = [], points
    for step in march.deformation.steps:
        try:
            trial = step.trial(here)
        except NotConvergedError:
            return [*found, -1.0]
        found.append(1.0 - 1.0 / float(cayley_fractions(trial.gradients).min()))
        here = trial.moved
    return found


def test_a_march_that_coarse_points_let_through_is_taken_back_by_the_points_between() -> None:
    first = sparse_march()
    assert first.status is Status.CONVERGED
    assert min(margins_at(first, DENSE)) < FLOOR, "the coarse points hide it"
    taken_back = first.joined(DENSE)
    assert taken_back.status is None
    assert taken_back.returns == 1
    again = taken_back.marched()
    assert again.status is Status.CONVERGED
    assert min(margins_at(again, DENSE)) >= FLOOR
    assert again.deformation.margin == pytest.approx(min(margins_at(again, np.vstack([SPARSE, DENSE]))), abs=1e-9)
    for known, found in zip(
        (again.moved, again.jacobians),
        Deformation(again.deformation.steps, (), Status.CONVERGED).with_jacobian(np.vstack([SPARSE, DENSE])),
        strict=True,
    ):
        np.testing.assert_allclose(known, found, rtol=0, atol=1e-9)
    np.testing.assert_allclose(again.deformation(squeeze(20.0).source), squeeze(20.0).target, rtol=0, atol=1e-9)


def test_the_steps_before_the_one_that_offends_stay() -> None:
    """In the second of the steps the coarse points hide too much: the first is the same object as before."""
    first = sparse_march(24.0, min_steps=6)
    margins, late = margins_at(first, DENSE), DENSE
    offending = next(k for k, margin in enumerate(margins) if margin < FLOOR)
    taken_back = first.joined(late)
    assert len(taken_back.stretches) == offending > 0
    for before, after in zip(first.stretches, taken_back.stretches, strict=False):
        assert all(a is b for a, b in zip(before.steps, after.steps, strict=True))
    start, end = first.stretches[offending].start, first.stretches[offending].end
    again = taken_back.marched()
    shorter = again.stretches[offending]
    assert shorter.start == start
    assert shorter.end < end
    assert end in shorter.records[0].rejected
    alone = Deformation(again.deformation.steps, (), Status.CONVERGED).with_jacobian(np.vstack([SPARSE, late]))
    np.testing.assert_allclose(again.moved, alone[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(again.jacobians, alone[1], rtol=0, atol=1e-9)


def test_points_that_nothing_forbids_join_without_a_step_back() -> None:
    first = sparse_march()
    far = np.array([[5.0, 95.0], [95.0, 5.0]])
    joined = first.joined(far)
    assert joined.status is Status.CONVERGED
    assert joined.returns == 0
    assert joined.deformation.steps == first.deformation.steps
    np.testing.assert_array_equal(joined.moved[: len(SPARSE)], first.moved)
    np.testing.assert_allclose(joined.moved[len(SPARSE) :], first.deformation(far), rtol=0, atol=1e-12)


def test_the_steppers_own_points_stay_last() -> None:
    stepper = HandleStepper(squeeze(20.0), RadialBackend("r3"), cayley_step)
    pace = Pace(100, 4, 1.0 - FLOOR)
    march = Marching.begun(stepper, rule=cayley_fractions, tested=SPARSE, pace=pace, held=2).marched()
    for found in (march.joined(np.array([[5.0, 95.0]])), march.joined(DENSE), march.joined(DENSE).marched()):
        np.testing.assert_array_equal(found.tested[-2:], SPARSE[-2:])
        np.testing.assert_array_equal(found.tested[:4], SPARSE[:4])


def test_a_step_with_no_solution_for_a_point_that_joins_is_made_shorter() -> None:
    """With no floor and a single long step, points near the handles have no solution at all."""
    stepper = HandleStepper(squeeze(30.0), RadialBackend("r3"), cayley_step)
    first = Marching.begun(stepper, rule=cayley_fractions, tested=SPARSE, pace=Pace(300)).marched()
    assert margins_at(first, DENSE)[-1] <= 0.0
    again = first.joined(DENSE).marched()
    assert min(margins_at(again, DENSE)) > 0.0
    assert len(again.stretches) > len(first.stretches)


def test_explicit_steps_that_points_between_forbid_are_made_anew_as_eq_6_allows() -> None:
    stepper = HandleStepper(squeeze(20.0), RadialBackend("r3"), explicit_step)
    first = Marching.begun(stepper, rule=row_norm_fractions, tested=SPARSE, pace=Pace(60)).marched()
    again = first.joined(DENSE)
    assert again.status is None
    whole = march(stepper, rule=row_norm_fractions, tested=np.vstack([SPARSE, DENSE]), pace=Pace(60))
    assert [r.end for r in again.marched().deformation.records] == pytest.approx([r.end for r in whole.records])


def test_a_share_below_one_is_a_margin_that_every_step_keeps() -> None:
    stepper = HandleStepper(squeeze(20.0), RadialBackend("r3"), cayley_step)
    free, kept = (
        march(stepper, rule=cayley_fractions, tested=GRID, pace=Pace(200, share=share)) for share in (1.0, 1.0 - FLOOR)
    )
    assert free.margin < FLOOR <= kept.margin
    assert kept.status is Status.CONVERGED


def test_a_march_that_was_slowed_goes_faster_again_where_it_may() -> None:
    """A rule that is strict once: the short stretch it forces is followed by longer ones, each by half at most."""
    calls = []

    def strict_once(gradients):
        calls.append(None)
        return cayley_fractions(gradients) * (0.05 if len(calls) == 1 else 1.0)

    stepper = HandleStepper(squeeze(6.0), RadialBackend("r3"), cayley_step)
    found = march(stepper, rule=strict_once, tested=GRID, pace=Pace(200, 2, 1.0 - FLOOR))
    lengths = [record.end - record.start for record in found.records]
    assert len(found.records[0].rejected) == 1
    assert max(lengths) > 1.4 * lengths[0]
    assert all(b < 1.5 * a + 1e-9 for a, b in pairwise(lengths))


def test_what_is_left_of_a_path_is_cut_into_equal_parts() -> None:
    """No last crumb of a stretch after a rejection made the reach an odd one."""
    found = sparse_march().joined(DENSE).marched()
    lengths = [stretch.end - stretch.start for stretch in found.stretches]
    assert min(lengths) > 0.3 * max(lengths)
