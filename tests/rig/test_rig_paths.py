"""Paths through keyframes, along screws and through poses, against motions that formulas give."""

from __future__ import annotations

import numpy as np
import pytest

from musclefit.errors import LandmarkError, RigError
from musclefit.geometry.rigid import RigidMotion
from musclefit.rig.handles import Handles
from musclefit.rig.joints import parse_joints
from musclefit.rig.paths import KeyframeMotions, KeyframePath, ScrewMotions, ScrewPath, motions_of
from musclefit.vocabulary import PathKind

HINGES = parse_joints(
    {
        "units": "mm, degrees",
        "elbow": {"centre_mm": [10, 0, 0], "axis": [0, 0, 1], "fixed": ["upper"], "moving": ["lower", "hand"]},
        "wrist": {"centre_mm": [20, 0, 0], "axis": [0, 0, 1], "fixed": ["lower"], "moving": ["hand"]},
    },
    source="hinges.toml",
)


def about_z(degrees: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> RigidMotion:
    return RigidMotion.about_axis(centre=np.array(centre), axis=np.array([0.0, 0.0, 1.0]), angle_deg=degrees)


def test_keyframes_are_met_exactly_and_joined_by_straight_lines():
    rng = np.random.default_rng(0)
    places = rng.normal(size=(3, 5, 3))
    path = KeyframePath((0.0, 0.3, 1.0), places)
    for at, expected in zip((0.0, 0.3, 1.0), places, strict=True):
        np.testing.assert_array_equal(path.position(at), expected)
    np.testing.assert_allclose(path.position(0.65), 0.5 * (places[1] + places[2]), rtol=0, atol=1e-15)


@pytest.mark.parametrize("moments", [(0.0, 0.5), (0.0, 0.5, 0.5, 1.0), (0.1, 1.0)])
def test_moments_that_do_not_rise_from_0_to_1_are_refused(moments):
    with pytest.raises(LandmarkError, match=r"give moments that rise from 0 to 1"):
        KeyframePath(moments, np.zeros((len(moments), 2, 3)))


def test_a_bone_of_landmarks_turns_on_a_circle_and_not_on_the_chord():
    rng = np.random.default_rng(1)
    source = rng.uniform(-30.0, 30.0, (9, 3))
    handles = Handles(tuple("abcdefghi"), source, ("bone",) * 6 + ("",) * 3)
    target = source + np.array([1.0, 2.0, 3.0])
    target[:6] = about_z(120.0, (5.0, -4.0, 0.0))(source[:6])
    path = ScrewPath(handles, target)
    np.testing.assert_allclose(path.position(0.5)[:6], about_z(60.0, (5.0, -4.0, 0.0))(source[:6]), rtol=0, atol=1e-12)
    np.testing.assert_allclose(path.position(0.5)[6:], source[6:] + np.array([0.5, 1.0, 1.5]), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(path.position(0.0), source)
    np.testing.assert_array_equal(path.position(1.0), target)


def test_what_a_rigid_motion_misses_of_the_destinations_grows_evenly():
    rng = np.random.default_rng(2)
    source = rng.uniform(-30.0, 30.0, (6, 3))
    noise = rng.normal(scale=0.1, size=(6, 3))
    motion = about_z(90.0)
    path = ScrewPath(Handles(tuple("abcdef"), source, ("bone",) * 6), motion(source) + noise)
    fitted = path.motions()["bone"]
    left = np.linalg.norm(path.target - fitted(source), axis=1)
    halfway = np.linalg.norm(path.position(0.5) - fitted.fraction(0.5)(source), axis=1)
    np.testing.assert_allclose(halfway, 0.5 * left, rtol=0, atol=1e-12)


def test_landmarks_on_a_line_have_no_screw():
    line = np.arange(4.0)[:, None] * [1.0, 2.0, 3.0]
    with pytest.raises(LandmarkError, match=r"the 4 landmarks of bone 'rib' leave its turn free.*straight"):
        ScrewPath(Handles(tuple("abcd"), line, ("rib",) * 4), line + 1.0)


def test_a_screw_goes_to_the_same_pose_as_the_joints_by_the_shorter_way():
    pose = (("elbow", 90.0), ("wrist", -90.0))  # the hand ends where it is parallel to its rest: it is only shifted
    by_joints = motions_of(pose, HINGES, kind=PathKind.JOINTS)
    on_screws = motions_of(pose, HINGES, kind=PathKind.SCREWS)
    assert isinstance(on_screws, ScrewMotions)
    final = by_joints.at(1.0)["hand"]
    np.testing.assert_allclose(on_screws.at(1.0)["hand"].translation, final.translation, rtol=0, atol=1e-14)
    halfway = on_screws.at(0.5)["hand"]
    np.testing.assert_allclose(halfway.rotation, np.eye(3), rtol=0, atol=1e-12)
    np.testing.assert_allclose(halfway.translation, 0.5 * final.translation, rtol=0, atol=1e-12)
    np.testing.assert_allclose(on_screws.at(0.5)["lower"](np.eye(3)), about_z(45.0, (10, 0, 0))(np.eye(3)), atol=1e-12)


def test_joints_go_through_the_poses_that_name_them():
    motions = KeyframeMotions(HINGES, ((0.25, (("elbow", 80.0),)), (1.0, (("elbow", 40.0), ("wrist", 20.0)))))
    for at, elbow, wrist in ((0.125, 40.0, 2.5), (0.25, 80.0, 5.0), (0.625, 60.0, 12.5), (1.0, 40.0, 20.0)):
        expected = HINGES.motions({"elbow": elbow, "wrist": wrist})
        for bone, motion in motions.at(at).items():
            np.testing.assert_allclose(motion.translation, expected[bone].translation, rtol=0, atol=1e-12)
            np.testing.assert_allclose(motion.rotation, expected[bone].rotation, rtol=0, atol=1e-12)


def test_a_joint_that_the_pose_leaves_out_comes_back():
    motions = KeyframeMotions(HINGES, ((0.5, (("wrist", 30.0),)), (1.0, (("elbow", 40.0),))))
    np.testing.assert_allclose(motions.at(1.0)["hand"].rotation, about_z(40.0).rotation, rtol=0, atol=1e-12)
    np.testing.assert_allclose(motions.at(0.5)["hand"].rotation, about_z(50.0).rotation, rtol=0, atol=1e-12)


def test_a_keyframe_of_an_unknown_joint_is_refused():
    with pytest.raises(RigError, match=r"no such joint.*elbow"):
        KeyframeMotions(HINGES, ((0.5, (("elbo", 1.0),)), (1.0, (("elbow", 1.0),))))
