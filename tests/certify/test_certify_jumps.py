"""Gradients that jump at handles, and implicit steps with several solutions: both are decided, and attacked."""

from __future__ import annotations

import numpy as np
import pytest
from attacks import C, E, grid, verify_fold
from scipy.spatial.transform import Rotation

from musclefit.certify.jumps import least_singular_at_jumps
from musclefit.certify.maps import certify_map
from musclefit.errors import FieldError
from musclefit.fields.radial import RadialBackend, RadialField
from musclefit.vocabulary import Claim, Proof

BODY = np.array([[-10.0, -10.0, -10.0], [10.0, 10.0, 10.0]])
TURN = Rotation.from_rotvec([0.0, 0.0, np.radians(80.0)]).as_matrix() - np.eye(3)


def cone(strength: float) -> RadialField:
    """x -> R x - w |x - c|, and a little of another centre: one-to-one while |w| < 1, though it turns by 80 degrees."""
    centres = np.array([[1.0, 2.0, 0.5], [-6.0, 3.0, -2.0]])
    weights = np.array([[0.0, strength, 0.0], [1e-3, 0.0, 0.0]])
    return RadialField("r", 1.0, centres, weights, np.zeros(3), TURN, np.zeros(3), 1, 1)


@pytest.mark.parametrize("strength", [0.5, 0.95])
def test_a_cone_within_its_limit_is_certified_by_pairs(strength: float) -> None:
    found = certify_map([(E, cone(strength))], BODY)
    assert found.claim is Claim.CERTIFIED
    assert found.steps[0].proof is Proof.PAIRS
    assert 0.0 < found.margin <= 1.0 - strength + 0.01


@pytest.mark.parametrize("strength", [1.01, 1.5])
def test_a_cone_beyond_its_limit_is_refuted_however_narrow_the_fold(strength: float) -> None:
    steps = [(E, cone(strength))]
    found = certify_map(steps, BODY)
    assert found.claim is Claim.REFUTED
    verify_fold(steps, BODY, found)


@pytest.mark.parametrize("s", [1.0, -0.5])
def test_means_of_gradients_around_a_jump_are_no_more_singular_than_proved(s: float) -> None:
    rng = np.random.default_rng(3)
    handles = rng.uniform(-10.0, 10.0, (6, 3))
    field = RadialBackend("r").fit(handles, rng.normal(0.0, 1.0, (6, 3)))
    centres = handles + rng.normal(0.0, 0.05, handles.shape)
    halves = rng.uniform(0.05, 0.5, centres.shape)
    least, off = least_singular_at_jumps(field, s, centres, halves)
    proved = least - off
    assert (proved > 0.0).sum() >= 3
    for centre, half, bound in zip(centres, halves, proved, strict=True):
        ends = centre + half * rng.uniform(-1.0, 1.0, (400, 2, 3))
        shares = rng.dirichlet(np.ones(2), 400)
        images = ends + s * field.displacement(ends.reshape(-1, 3)).reshape(ends.shape)
        stretch = np.linalg.norm(images[:, 0] - images[:, 1], axis=1) / np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
        matrices = np.eye(3) + s * field.gradient(ends.reshape(-1, 3)).reshape(-1, 2, 3, 3)
        means = np.einsum("pk,pkij->pij", shares, matrices)
        assert stretch.min() >= bound - 1e-9 or not bound > 0.0
        assert np.linalg.svd(means, compute_uv=False).min() >= bound - 1e-9 or not bound > 0.0


def test_kernels_without_jumps_say_so() -> None:
    field = RadialBackend("r3").fit(BODY, BODY)
    assert not len(field.jumps)
    with pytest.raises(FieldError, match="no jump"):
        field.jump_bounds(BODY, np.ones_like(BODY))


def test_an_implicit_step_with_two_midpoints_for_a_place_of_the_body_is_refuted_by_both() -> None:
    handles = np.concatenate([grid(-10.0 * np.ones(3), 10.0 * np.ones(3), 3), [[3.0, 0.0, 0.0], [-3.0, 0.0, 0.0]]])
    moves = np.zeros_like(handles)
    moves[-2:, 0] = 9.0, -9.0
    field = RadialBackend("gaussian", 4.0).fit(handles, moves)
    found = certify_map([(C, field)], BODY)
    assert found.claim is Claim.REFUTED
    (fold,) = found.fold
    assert fold.other_midpoint is not None
    place, middles = np.array(fold.place), np.array([fold.place_in_step, fold.other_midpoint])
    assert ((place >= BODY[0]) & (place <= BODY[1])).all()
    np.testing.assert_allclose(middles - 0.5 * field.displacement(middles), np.tile(place, (2, 1)), rtol=0, atol=1e-9)
    assert np.linalg.norm(middles[0] - middles[1]) > 0.1
    half = 0.5 * field.gradient(middles[:1])[0]
    determinant = np.linalg.det(np.eye(3) + half) * np.linalg.det(np.eye(3) - half)
    assert determinant <= fold.determinant < 0.0
