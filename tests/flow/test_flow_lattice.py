"""The paper's loop over control points: Eq. 8, that it ends where one shot does, and that it stalls before a fold."""

from __future__ import annotations

import numpy as np
from oracles import row_norm_fraction

from musclefit.fields.ffd import Lattice
from musclefit.fields.fitting.ffd import FfdBackend
from musclefit.flow.control_lattice import lattice_row_norm_fractions, march_lattice
from musclefit.flow.deformation import Status
from musclefit.flow.march import Pace, march
from musclefit.flow.rules import row_norm_fractions
from musclefit.flow.steppers import HandleStepper, explicit_step
from musclefit.rig.handles import StraightPath

LATTICE = Lattice.around(np.zeros(2), np.array([90.0, 90.0]), shape=(10, 10))
GRID = np.stack(np.meshgrid(*[np.linspace(0.0, 90.0, 61)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)


def pulled(size: float) -> np.ndarray:
    """One control point in the middle pulled along the diagonal."""
    displacements = np.zeros((100, 2))
    displacements[44] = size
    return displacements


def test_a_mild_deformation_ends_where_one_shot_does():
    displacements = pulled(16.0)
    loop = march_lattice(LATTICE, displacements, tested=GRID, max_steps=50).require()
    np.testing.assert_allclose(loop(GRID), GRID + LATTICE.field(displacements).displacement(GRID), rtol=0, atol=1e-12)
    assert len(loop.records) > 1


def test_each_step_is_as_long_as_eq_8_allows():
    field = LATTICE.field(pulled(16.0))
    slopes, done = field.gradient(GRID), 0.0
    for record in march_lattice(LATTICE, pulled(16.0), tested=GRID, max_steps=50).records:
        present = np.array([(1.0 - done) * g @ np.linalg.inv(np.eye(2) + done * g) for g in slopes])
        fraction = min(1.0, row_norm_fraction(present))
        np.testing.assert_allclose(record.end, done + fraction * (1.0 - done), rtol=1e-9, atol=0)
        done = record.end
    assert done == 1.0


def test_a_fold_stalls_the_paper_and_not_a_lattice_that_is_fitted_anew():
    displacements = pulled(36.0)
    shot = np.linalg.det(np.eye(2) + LATTICE.field(displacements).gradient(GRID))
    assert shot.min() < 0.0
    stalled = march_lattice(LATTICE, displacements, tested=GRID, max_steps=500)
    assert stalled.status in (Status.STALLED, Status.OUT_OF_STEPS)
    assert np.linalg.det(stalled.jacobian(GRID)).min() > 0.0
    nodes = LATTICE.control_points()
    goal = nodes + LATTICE.field(0.5 * displacements).displacement(nodes)
    stepper = HandleStepper(StraightPath(nodes, goal), FfdBackend(10.0), explicit_step)
    loop = march(stepper, rule=row_norm_fractions, tested=GRID, pace=Pace(200)).require()
    assert np.linalg.det(loop.jacobian(GRID)).min() > 0.0
    np.testing.assert_allclose(loop(nodes), goal, rtol=0, atol=1e-9)


def test_a_singular_place_leaves_no_safe_step():
    slopes = np.array([np.eye(2), np.diag([1.0, 0.0])])
    fractions = lattice_row_norm_fractions(0.5 * np.stack([np.eye(2)] * 2), slopes)
    np.testing.assert_allclose(fractions, [np.sqrt(2.0), 0.0], rtol=1e-12)


def test_the_budget_of_steps_is_kept():
    assert march_lattice(LATTICE, pulled(16.0), tested=GRID, max_steps=1).status is Status.OUT_OF_STEPS
