"""Laws that hold for every map; a new map adds one line to MAPS and inherits them all."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from oracles import difference_jacobian

from musclefit.fields.fitting.ffd import FfdBackend
from musclefit.fields.isochoric_ffd import IsochoricFfdBackend
from musclefit.fields.protocol import Backend
from musclefit.fields.radial import RadialBackend
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.march import Pace, march
from musclefit.flow.rules import cayley_fractions, monotone_fractions, row_norm_fractions
from musclefit.flow.steppers import HandleStepper, cayley_step, explicit_step
from musclefit.geometry.rigid import RigidMotion
from musclefit.rig.handles import StraightPath

RNG = np.random.default_rng(0)
AT = RNG.uniform(-50.0, 50.0, (25, 3))
MOVED = AT + RNG.normal(scale=6.0, size=AT.shape)
TESTED = RNG.uniform(-60.0, 60.0, (4000, 3))


def backend_of(kernel: str, *, scale: float = 40.0) -> Backend:
    splines = {"ffd": FfdBackend(20.0), "isochoric ffd": IsochoricFfdBackend(16.0)}
    return splines[kernel] if kernel in splines else RadialBackend(kernel, scale=scale)


def marched(kernel, stepper, rule, *, scale: float = 40.0) -> Deformation:
    deformation = march(
        HandleStepper(StraightPath(AT, MOVED), backend_of(kernel, scale=scale), stepper),
        rule=rule,
        tested=np.vstack([TESTED, AT]),
        pace=Pace(50),
    )
    assert deformation.status is Status.CONVERGED
    return deformation


MAPS = {
    "paper, r2logr": marched("r2logr", explicit_step, row_norm_fractions),
    "paper, r3": marched("r3", explicit_step, row_norm_fractions),
    "monotone, inverse multiquadric": marched("inverse-multiquadric", explicit_step, monotone_fractions),
    "Cayley, r3": marched("r3", cayley_step, cayley_fractions),
    "Cayley, isochoric-r5": marched("isochoric-r5", cayley_step, cayley_fractions),
    "Cayley, mollified": marched("isochoric-r3-mollified", cayley_step, cayley_fractions, scale=5.0),
    "paper, ffd": marched("ffd", explicit_step, row_norm_fractions),
    "Cayley, ffd": marched("ffd", cayley_step, cayley_fractions),
    "Cayley, isochoric ffd": marched("isochoric ffd", cayley_step, cayley_fractions),
    "nothing": Deformation((), (), Status.CONVERGED),
}
MEETS_NO_HANDLE_EXACTLY = ("Cayley, isochoric ffd", "nothing")
points = arrays(np.float64, (4, 3), elements=st.floats(-60.0, 60.0))
each_map = pytest.mark.parametrize("name", MAPS)


@each_map
@given(x=points)
@settings(max_examples=20, deadline=None)
def test_inverse_undoes_the_map(name, x):
    np.testing.assert_allclose(MAPS[name].inverse()(MAPS[name](x)), x, rtol=0, atol=1e-9)


@each_map
@given(x=points)
@settings(max_examples=20, deadline=None)
def test_jacobian_is_the_derivative(name, x):
    expected = difference_jacobian(MAPS[name], x, step=1e-4)
    np.testing.assert_allclose(MAPS[name].jacobian(x), expected, rtol=0, atol=2e-5)


@each_map
@given(x=points)
@settings(max_examples=20, deadline=None)
def test_jacobian_of_the_inverse_inverts_the_jacobian(name, x):
    there = MAPS[name](x)
    product = MAPS[name].inverse().jacobian(there) @ MAPS[name].jacobian(x)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), rtol=0, atol=1e-7)


@each_map
def test_jacobian_is_positive_where_the_rule_was_tested(name):
    assert np.linalg.det(MAPS[name].jacobian(TESTED)).min() > 0.0


@pytest.mark.parametrize("name", [n for n in MAPS if n not in MEETS_NO_HANDLE_EXACTLY])
def test_every_handle_arrives(name):
    np.testing.assert_allclose(MAPS[name](AT), MOVED, rtol=0, atol=1e-9)


@each_map
def test_points_are_moved_one_by_one(name):
    together, alone = MAPS[name](TESTED[:20]), np.vstack([MAPS[name](x[None]) for x in TESTED[:20]])
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-10)


@pytest.mark.parametrize("kernel", ["r", "r2logr", "r3", "isochoric-r3", "isochoric-r5", "ffd", "isochoric ffd"])
@pytest.mark.parametrize("angle_deg", [10.0, 120.0, 170.0])
def test_one_cayley_step_reproduces_any_rotation(kernel, angle_deg):
    centre, axis = np.array([5.0, 1.0, 2.0]), np.array([1.0, 2.0, 3.0])
    motion = RigidMotion.about_axis(centre=centre, axis=axis, angle_deg=angle_deg)
    deformation = march(
        HandleStepper(StraightPath(AT, motion(AT)), backend_of(kernel), cayley_step),
        rule=cayley_fractions,
        tested=TESTED,
        pace=Pace(1),
    ).require()
    np.testing.assert_allclose(deformation(TESTED), motion(TESTED), rtol=0, atol=1e-8)
    assert deformation.margin == pytest.approx(1.0, abs=1e-9)


@given(t=st.floats(0.0, 1.0))
def test_screw_fractions_compose(t):
    motion = RigidMotion.about_axis(centre=np.array([5.0, 1.0, 2.0]), axis=np.array([1.0, 2.0, 3.0]), angle_deg=100.0)
    whole = motion @ RigidMotion(np.eye(3), np.array([3.0, -2.0, 9.0]))
    composed = whole.fraction(1.0 - t)(whole.fraction(t)(AT))
    np.testing.assert_allclose(composed, whole(AT), rtol=0, atol=1e-9)
