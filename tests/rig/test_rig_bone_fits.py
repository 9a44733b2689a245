"""Rigid bones from landmarks: fits against known motions, residuals, mirrors, landmarks that fix no turn."""

from __future__ import annotations

import numpy as np
import pytest

from musclefit.errors import LandmarkError
from musclefit.geometry.rigid import RigidMotion
from musclefit.rig.bone_fits import (
    RigidPath,
    fit_bones,
    fit_findings,
    half_turn_findings,
    motions_of_fits,
    refuse_mirror_image,
)
from musclefit.rig.handles import Handles

RNG = np.random.default_rng(3)
MOTION = RigidMotion.about_axis(centre=np.array([30.0, 5.0, -7.0]), axis=np.array([0.3, -0.2, 1.0]), angle_deg=75.0)
SOURCE = RNG.uniform(-40.0, 40.0, (6, 3))


def handles(source: np.ndarray, owner: tuple[str, ...]) -> Handles:
    return Handles(tuple(f"p{k}" for k in range(len(source))), source, owner)


def test_the_motion_of_exact_landmarks_is_found() -> None:
    (fit,) = fit_bones(handles(SOURCE, ("ulna",) * 6), MOTION(SOURCE))
    np.testing.assert_allclose(fit.motion.rotation, MOTION.rotation, rtol=0, atol=1e-14)
    np.testing.assert_allclose(fit.motion.translation, MOTION.translation, rtol=0, atol=1e-12)
    assert fit.max_mm < 1e-12


def test_the_residual_is_what_the_motion_misses() -> None:
    target = MOTION(SOURCE)
    target[2] += (3.0, 0.0, 0.0)
    fits = fit_bones(handles(SOURCE, ("ulna",) * 6), target)
    missed = np.linalg.norm(fits[0].motion(SOURCE) - target, axis=1)
    np.testing.assert_allclose(fits[0].missed_mm, missed, rtol=0, atol=1e-12)
    assert fits[0].rms_mm == pytest.approx(np.sqrt(np.mean(missed**2)))
    (finding,) = fit_findings(fits)
    assert (finding.subject, finding.code) == ("ulna", "bone-fit")
    words = f"6 landmarks best misses their targets by {fits[0].rms_mm:.3g} mm rms, {missed.max():.3g} mm at most (p2)"
    assert words in finding.message


def test_landmarks_of_bones_are_carried_and_others_go_straight() -> None:
    source = np.vstack([SOURCE, RNG.uniform(-40.0, 40.0, (2, 3))])
    target = np.vstack([MOTION(SOURCE) + RNG.normal(scale=0.1, size=(6, 3)), source[6:] + np.array([1.0, 2.0, 3.0])])
    named = handles(source, (*("ulna",) * 6, "", ""))
    fits = fit_bones(named, target)
    path = RigidPath(named, target, motions_of_fits(fits))
    np.testing.assert_allclose(path.position(0.0), source, rtol=0, atol=1e-13)
    np.testing.assert_allclose(path.position(1.0)[:6], fits[0].motion(SOURCE), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(path.position(1.0)[6:], target[6:])
    halfway = path.position(0.5)
    np.testing.assert_allclose(halfway[:6], fits[0].motion.fraction(0.5)(SOURCE), rtol=0, atol=1e-12)
    np.testing.assert_allclose(halfway[6:], source[6:] + np.array([0.5, 1.0, 1.5]), rtol=0, atol=1e-13)
    apart = np.linalg.norm(halfway[:6, None] - halfway[None, :6], axis=2)
    np.testing.assert_allclose(apart, np.linalg.norm(SOURCE[:, None] - SOURCE[None], axis=2), rtol=0, atol=1e-11)


def test_each_bone_has_its_own_motion() -> None:
    more = RNG.uniform(50.0, 90.0, (3, 3))
    fits = fit_bones(
        handles(np.vstack([SOURCE, more]), (*("ulna",) * 6, *("hand",) * 3)), np.vstack([MOTION(SOURCE), more + 1.0])
    )
    assert [fit.bone for fit in fits] == ["ulna", "hand"]
    np.testing.assert_allclose(fits[1].motion.rotation, np.eye(3), rtol=0, atol=1e-13)


LINE = np.arange(4.0)[:, None] * [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("source", "target", "words"),
    [
        (SOURCE[:2], SOURCE[:2], r"the 2 landmarks of bone 'ulna' \(p0, p1\) leave its turn free; give three or more"),
        (LINE, LINE + 1.0, r"the 4 landmarks of bone 'ulna'"),
        (SOURCE[:4], LINE, r"the 4 targets of the landmarks of bone 'ulna'"),
    ],
)
def test_landmarks_that_leave_a_turn_free_are_refused(source: np.ndarray, target: np.ndarray, words: str) -> None:
    with pytest.raises(LandmarkError, match=rf"^bones.rigid: {words}"):
        fit_bones(handles(source, ("ulna",) * len(source)), target)


def test_landmarks_without_bones_are_refused() -> None:
    with pytest.raises(LandmarkError, match=r"no landmark names its bone; add a column bone"):
        fit_bones(handles(SOURCE, ("",) * 6), SOURCE)


@pytest.mark.parametrize("noise_mm", [0.0, 0.5])
def test_mirrored_targets_are_refused_with_both_residuals(noise_mm: float) -> None:
    mirrored = MOTION(SOURCE * (-1.0, 1.0, 1.0)) + RNG.normal(scale=noise_mm, size=SOURCE.shape)
    with pytest.raises(LandmarkError, match=r"of bone 'ulna' are a mirror image.*a rigid motion by .* \(LPS or RAS\)"):
        fit_bones(handles(SOURCE, ("ulna",) * 6), mirrored)


def test_lps_taken_for_ras_is_a_turn_and_no_mirror() -> None:
    """Two signs differ between the two, so nothing but the residual of other files could tell."""
    (fit,) = fit_bones(handles(SOURCE, ("ulna",) * 6), SOURCE * (-1.0, -1.0, 1.0))
    assert fit.max_mm < 1e-12
    assert fit.motion.turn_deg == pytest.approx(180.0)


@pytest.mark.parametrize("seed", range(20))
def test_flat_landmarks_with_noise_are_no_mirror(seed: int) -> None:
    """Four landmarks nearly in a plane: the sign of what noise adds across it says nothing."""
    rng = np.random.default_rng(seed)
    flat = np.column_stack([rng.uniform(-40.0, 40.0, (4, 2)), rng.uniform(-0.1, 0.1, 4)])
    (fit,) = fit_bones(handles(flat, ("ulna",) * 4), MOTION(flat) + rng.normal(scale=0.3, size=(4, 3)))
    assert fit.rms_mm < 1.0


def test_pairs_that_only_a_mirror_takes_to_each_other_are_refused() -> None:
    rng = np.random.default_rng(8)
    source = rng.uniform(-100.0, 100.0, (12, 3))
    soft = 1.3 * MOTION(source) + rng.normal(0.0, 4.0, source.shape)  # another size, another pose, soft tissue
    refuse_mirror_image(source, soft)
    with pytest.raises(
        LandmarkError, match=r"mirror image of the landmarks: a mirror \(with one scale\) misses them by"
    ):
        refuse_mirror_image(source * [-1.0, 1.0, 1.0], soft)
    flat = source * [1.0, 1.0, 0.0]  # in a plane a mirror is a turn
    refuse_mirror_image(flat, MOTION(flat * [-1.0, 1.0, 1.0]))
    pressed = source.copy()
    pressed[0] -= (0.0, 0.0, 60.0)  # one goes through the plane of others
    refuse_mirror_image(source, pressed)


@pytest.mark.parametrize("seed", range(40))
def test_random_soft_targets_are_no_mirror_images(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source = rng.uniform(-100.0, 100.0, (int(rng.integers(4, 30)), 3))
    refuse_mirror_image(source, rng.uniform(0.5, 2.0, 3) * MOTION(source) + rng.normal(0.0, 15.0, source.shape))


def test_ras_against_lps_is_a_half_turn_and_is_told() -> None:
    """Both are right-handed: x and y change their signs, which is a turn by 180 degrees about z and no mirror."""
    rng = np.random.default_rng(9)
    source = rng.uniform(-100.0, 100.0, (12, 3))
    target = 1.2 * source + rng.normal(0.0, 5.0, source.shape) + np.array([10.0, -30.0, 400.0])
    assert half_turn_findings(source, target, subject="a.csv") == ()
    (finding,) = half_turn_findings(source * [-1.0, -1.0, 1.0], target, subject="a.csv")
    assert finding.code == "half-turn"
    assert "as RAS is against LPS" in finding.message
    refuse_mirror_image(source * [-1.0, -1.0, 1.0], target)
