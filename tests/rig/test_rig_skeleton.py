"""Skeletons: frames, sections, and paths through bent and twisted curves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from musclefit.errors import LandmarkError
from musclefit.geometry.rigid import RigidMotion
from musclefit.rig.skeleton import (
    Skeleton,
    SkeletonPath,
    SkeletonPose,
    ring,
    rotation_minimising_frames,
    smallest_rotation,
    tangents,
)

LENGTH = 40.0
X = np.array([1.0, 0.0, 0.0])
NO_TWIST = np.zeros(5)


def arc(angle_deg: float, at: np.ndarray) -> np.ndarray:
    """Points at the given arc lengths of a curve from the origin along z that bends towards x."""
    if angle_deg == 0.0:
        return np.stack([0.0 * at, 0.0 * at, at], axis=1)
    curvature = np.deg2rad(angle_deg) / LENGTH
    return np.stack([1.0 - np.cos(curvature * at), 0.0 * at, np.sin(curvature * at)], axis=1) / curvature


EVEN = np.linspace(0.0, LENGTH, 5)
UNEVEN = np.array([0.0, 6.0, 9.0, 27.0, LENGTH])


def bar(section: np.ndarray | None = None) -> Skeleton:
    return Skeleton(arc(0.0, EVEN), X, ring(4, radius_mm=3.0) if section is None else section)


@pytest.mark.parametrize("at", [EVEN, UNEVEN])
@pytest.mark.parametrize("angle", [0.0, 20.0, 150.0])
def test_tangents_are_exact_on_lines_and_circles(angle: float, at: np.ndarray) -> None:
    turned = np.deg2rad(angle) * at / LENGTH
    expected = np.stack([np.sin(turned), 0.0 * at, np.cos(turned)], axis=1)
    np.testing.assert_allclose(tangents(arc(angle, at)), expected, rtol=0, atol=1e-12)


def test_two_landmarks_have_the_direction_of_their_chord() -> None:
    np.testing.assert_allclose(tangents(np.array([[0.0, 0, 0], [0, 3, 4]])), [[0, 0.6, 0.8]] * 2, rtol=0, atol=1e-15)


def test_frames_on_a_planar_curve_keep_its_plane() -> None:
    frames = rotation_minimising_frames(arc(150.0, UNEVEN), normal=np.array([0.0, 2.0, 0.5]))
    np.testing.assert_allclose(frames[:, :, 0], np.tile([0.0, 1.0, 0.0], (5, 1)), rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, rtol=0, atol=1e-12)


def test_frames_on_a_helix_turn_back_by_the_integral_of_its_torsion() -> None:
    a, b = 2.0, 1.0
    s = np.linspace(0.0, 6.0, 400)
    helix = np.stack([a * np.cos(s), a * np.sin(s), b * s], axis=1)
    speed = np.hypot(a, b)
    inward = np.stack([-np.cos(s), -np.sin(s), 0 * s], axis=1)
    frames = rotation_minimising_frames(helix, normal=inward[0])
    angle = np.arctan2((frames[-1, :, 1] @ inward[-1]), (frames[-1, :, 0] @ inward[-1]))
    torsion_integral = b / speed**2 * speed * s[-1]
    np.testing.assert_allclose(angle, torsion_integral, rtol=0, atol=2e-3)


@given(seed=st.integers(0, 10_000))
def test_frames_ride_along_with_rigid_motions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    curve = np.cumsum(rng.normal([0.0, 0.0, 2.0], 0.5, (6, 3)), axis=0)
    motion = RigidMotion(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
    plain = rotation_minimising_frames(curve, normal=X)
    moved = rotation_minimising_frames(motion(curve), normal=motion.rotation @ X)
    np.testing.assert_allclose(moved, motion.rotation @ plain, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.swapaxes(plain, 1, 2) @ plain, np.tile(np.eye(3), (6, 1, 1)), rtol=0, atol=1e-12)


@given(seed=st.integers(0, 10_000))
def test_smallest_rotation_takes_one_direction_to_the_other(seed: int) -> None:
    a, b = (v / np.linalg.norm(v) for v in np.random.default_rng(seed).normal(size=(2, 3)))
    rotation = smallest_rotation(a, b)
    np.testing.assert_allclose(rotation @ a, b, rtol=0, atol=1e-6)
    across = np.cross(a, b)
    np.testing.assert_allclose(rotation @ across, across, rtol=0, atol=1e-6)


def test_handles_are_the_landmarks_and_their_sections() -> None:
    handles = bar().handles("spine")
    assert len(handles) == 5 + 5 * 4
    assert handles.names[:2] == ("spine_0", "spine_1")
    assert handles.names[5:7] == ("spine_0_section_0", "spine_0_section_1")
    np.testing.assert_array_equal(handles.source[:5], arc(0.0, EVEN))
    expected = np.array([[3.0, 0, 0], [0, 3, 0], [-3, 0, 0], [0, -3, 0]])
    np.testing.assert_allclose(handles.source[5:9], expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(handles.source[21:], expected + np.array([0.0, 0.0, LENGTH]), rtol=0, atol=1e-12)


@pytest.mark.parametrize("t", [0.0, 0.1, 0.5, 0.8, 1.0])
def test_a_bar_bends_through_circular_arcs(t: float) -> None:
    path = SkeletonPath(bar(), (SkeletonPose(1.0, arc(150.0, EVEN), NO_TWIST),))
    np.testing.assert_allclose(path.position(t)[:5], arc(150.0 * t, EVEN), rtol=0, atol=1e-10)


def test_the_path_starts_at_the_handles_and_ends_exactly_at_the_stated_landmarks() -> None:
    curve = arc(150.0, UNEVEN)
    path = SkeletonPath(bar(), (SkeletonPose(0.5, arc(33.0, EVEN), NO_TWIST), SkeletonPose(1.0, curve, NO_TWIST)))
    np.testing.assert_array_equal(path.position(0.0), bar().handles("a").source)
    np.testing.assert_array_equal(path.position(0.5)[:5], arc(33.0, EVEN))
    np.testing.assert_array_equal(path.position(1.0)[:5], curve)


@pytest.mark.parametrize("turns", [0.5, 1.0, -2.5])
def test_twist_grows_with_the_path_beyond_half_a_turn(turns: float) -> None:
    twist = np.linspace(0.0, 360.0 * turns, 5)
    path = SkeletonPath(bar(), (SkeletonPose(1.0, arc(0.0, EVEN), twist),))
    for t in np.linspace(0.0, 1.0, 9):
        angles = np.deg2rad(t * twist)
        first = path.position(float(t))[5::4] - arc(0.0, EVEN)
        expected = 3.0 * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
        np.testing.assert_allclose(first, expected, rtol=0, atol=1e-10)


def test_twist_and_bend_in_stages_keep_sections_rigid_and_across_the_curve() -> None:
    twist = np.linspace(0.0, 360.0, 5)
    poses = SkeletonPose(0.6, arc(0.0, EVEN), twist), SkeletonPose(1.0, arc(150.0, EVEN), twist)
    path = SkeletonPath(bar(), poses)
    for t in np.linspace(0.0, 1.0, 21):
        moved = path.position(float(t))
        offsets = moved[5:].reshape(5, 4, 3) - moved[:5, None]
        np.testing.assert_allclose(np.linalg.norm(offsets, axis=2), 3.0, rtol=0, atol=1e-10)
        np.testing.assert_allclose(np.einsum("kqi,ki->kq", offsets, tangents(moved[:5])), 0.0, rtol=0, atol=1e-8)


@given(seed=st.integers(0, 10_000), t=st.floats(0.0, 1.0))
def test_a_rigid_motion_of_the_curve_moves_the_sections_rigidly_all_the_way(seed: int, t: float) -> None:
    rng = np.random.default_rng(seed)
    skeleton = bar()
    source = skeleton.handles("a").source
    # The smallest rotation of the beginning has no part about the curve.
    motion = RigidMotion(smallest_rotation(np.array([0.0, 0.0, 1.0]), _direction(rng)), rng.normal(scale=9.0, size=3))
    path = SkeletonPath(skeleton, (SkeletonPose(1.0, motion(skeleton.curve), NO_TWIST),))
    np.testing.assert_allclose(path.position(1.0), motion(source), rtol=0, atol=1e-8)
    fitted = RigidMotion.fitted(source, path.position(t))
    np.testing.assert_allclose(path.position(t), fitted(source), rtol=0, atol=1e-8)


def test_the_path_moves_steadily() -> None:
    path = SkeletonPath(
        bar(),
        (
            SkeletonPose(0.4, arc(70.0, UNEVEN), np.linspace(0.0, 400.0, 5)),
            SkeletonPose(1.0, arc(-150.0, EVEN), NO_TWIST),
        ),
    )
    places = np.array([path.position(float(t)) for t in np.linspace(0.0, 1.0, 401)])
    assert np.linalg.norm(np.diff(places, axis=0), axis=2).max() < 1.0


def _direction(rng: np.random.Generator) -> np.ndarray:
    """A unit direction that is not close to straight down."""
    vector = rng.normal(size=3)
    vector[2] = abs(vector[2])
    return vector / np.linalg.norm(vector)


def test_bad_skeletons_are_refused() -> None:
    section = ring(4, radius_mm=1.0)
    with pytest.raises(LandmarkError, match="at least 2"):
        Skeleton(np.zeros((1, 3)), X, section)
    with pytest.raises(LandmarkError, match="landmarks 1 and 2 of the curve are at one place"):
        Skeleton(arc(0.0, EVEN)[[0, 1, 1, 2]], X, section)
    with pytest.raises(LandmarkError, match="landmark 2 of the curve is not finite"):
        Skeleton(arc(0.0, np.array([0.0, 1.0, np.nan])), X, section)
    with pytest.raises(LandmarkError, match=r"normal .* is along the curve"):
        Skeleton(arc(0.0, EVEN), np.array([0.0, 0.0, 1.0]), section)
    with pytest.raises(LandmarkError, match=r"normal .* is along the curve"):
        Skeleton(arc(0.0, EVEN), np.zeros(3), section)
    with pytest.raises(LandmarkError, match="does not fix the rotation"):
        Skeleton(arc(0.0, EVEN), X, np.array([[1.0, 0.0], [-2.0, 0.0]]))
    with pytest.raises(LandmarkError, match="turns straight back"):
        Skeleton(arc(0.0, np.array([0.0, 3.0, 0.0, 3.0])), X, section)
    with pytest.raises(LandmarkError, match="a ring of 2 points"):
        ring(2, radius_mm=1.0)
    with pytest.raises(LandmarkError, match="radius"):
        ring(4, radius_mm=0.0)


def test_bad_poses_are_refused() -> None:
    straight = arc(0.0, EVEN)
    with pytest.raises(LandmarkError, match="one finite angle for each of the 5 stations"):
        SkeletonPose(1.0, straight, np.zeros(4))
    with pytest.raises(LandmarkError, match="rising from above 0 to exactly 1"):
        SkeletonPath(bar(), (SkeletonPose(0.5, straight, NO_TWIST),))
    with pytest.raises(LandmarkError, match="rising from above 0 to exactly 1"):
        SkeletonPath(bar(), ())
    with pytest.raises(LandmarkError, match="has 4 stations, the skeleton 5"):
        SkeletonPath(bar(), (SkeletonPose(1.0, straight[:4], np.zeros(4)),))
    with pytest.raises(LandmarkError, match="state a pose between them"):
        SkeletonPath(bar(), (SkeletonPose(1.0, -straight, NO_TWIST),))
