"""Points that join a map whose single bones are kept: the corrections are made anew where they fail, and only there."""

from __future__ import annotations

import numpy as np

from musclefit.fields.radial import RadialBackend
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.rules import cayley_fractions
from musclefit.flow.steps import CayleyStep
from musclefit.flow.tracked_points import PlainRiders
from musclefit.pipeline.deformers import Deformed
from musclefit.pipeline.refining import KeptRiders, _kept

CORNERS = 100.0 * np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
STEEP = 30.0
NEAR = np.array([[50.0, 50.0, 50.0], [54.0, 50.0, 50.0], [46.0, 50.0, 50.0]])


def bump(size: float) -> CayleyStep:
    """A push of a point in the middle by some mm, corners held: steep close by when it is large."""
    at = np.vstack([CORNERS, [[50.0, 50.0, 50.0], [58.0, 50.0, 50.0]]])
    moves = np.zeros((10, 3))
    moves[8, 0] = size
    return CayleyStep(RadialBackend("r3").fit(at, moves))


def riders(sizes: list[float]) -> tuple[KeptRiders, list[int]]:
    """A map that moves nothing, and corrections of given sizes, one after the other each time they are made anew."""
    made: list[int] = []

    def keep(free: Deformation, points: np.ndarray) -> Deformed:
        made.append(len(points))
        step = bump(sizes[len(made) - 1])
        return Deformed(Deformation((*free.steps, step), (), Status.CONVERGED), ())

    free = PlainRiders.of(Deformation((), (), Status.CONVERGED), CORNERS)
    return _kept(free, keep, CORNERS, 0), made


def test_points_that_a_correction_forbids_have_it_made_anew_with_them() -> None:
    assert cayley_fractions(bump(STEEP).field.gradient(NEAR)).min() <= 1.0
    first, made = riders([STEEP, 1.0])
    joined = first.joined(NEAR)
    assert joined is not None
    assert made == [len(CORNERS), len(CORNERS) + len(NEAR)]
    assert (first.returns, joined.returns) == (0, 1)
    rest = np.vstack([CORNERS, NEAR])
    np.testing.assert_allclose(joined.moved, joined.deformation(rest), rtol=0, atol=1e-9)
    np.testing.assert_allclose(joined.jacobians, joined.deformation.jacobian(rest), rtol=0, atol=1e-9)


def test_points_that_the_corrections_allow_join_them_as_they_are() -> None:
    first, made = riders([1.0])
    joined = first.joined(NEAR)
    assert joined is not None
    assert made == [len(CORNERS)]
    assert joined.returns == 0
    np.testing.assert_allclose(joined.moved, joined.deformation(np.vstack([CORNERS, NEAR])), rtol=0, atol=1e-9)
