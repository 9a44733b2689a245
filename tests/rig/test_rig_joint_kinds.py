"""Kinds of joints: products of rotations composed by hand, screw pitch, coupled coordinates, refused tables."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from musclefit.errors import RigError
from musclefit.rig.joints import JointSystem, parse_joints

ANGLES = st.floats(-170.0, 170.0)
CENTRE = np.array([10.0, -20.0, 30.0])
BALL_AXES = [[1.0, 0.0, 0.0], [0.0, 2.0, 1.0], [0.3, 0.0, 1.0]]


def joint(**keys: Any) -> dict[str, Any]:
    return {"centre_mm": CENTRE.tolist(), "fixed": ["pelvis"], "moving": ["femur"], **keys}


def system(**joints: dict[str, Any]) -> JointSystem:
    return parse_joints({"units": "mm, degrees", **joints}, source="j.toml")


def hip() -> dict[str, Any]:
    return joint(kind="ball", axes=BALL_AXES, coordinates=["flexion", "adduction", "rotation"])


def about(axis: list[float], degrees: float) -> np.ndarray:
    unit = np.asarray(axis) / np.linalg.norm(axis)
    return Rotation.from_rotvec(np.radians(degrees) * unit).as_matrix()


@given(a=ANGLES, b=ANGLES, c=ANGLES)
def test_a_ball_is_a_product_of_rotations_about_its_centre(a: float, b: float, c: float) -> None:
    motion = system(hip=hip()).motions({"flexion": a, "rotation": c, "adduction": b})["femur"]
    turn = about(BALL_AXES[0], a) @ about(BALL_AXES[1], b) @ about(BALL_AXES[2], c)
    np.testing.assert_allclose(motion.rotation, turn, rtol=0, atol=1e-12)
    np.testing.assert_allclose(motion(CENTRE[None])[0], CENTRE, rtol=0, atol=1e-11)


@given(a=ANGLES, b=ANGLES)
def test_a_universal_joint_has_two_axes(a: float, b: float) -> None:
    axes = [[0.0, 1.0, 0.0], [1.0, 0.2, 0.0]]
    ankle = system(ankle=joint(kind="universal", axes=axes, coordinates=["pitch", "roll"]))
    motion = ankle.motions({"pitch": a, "roll": b})["femur"]
    np.testing.assert_allclose(motion.rotation, about(axes[0], a) @ about(axes[1], b), rtol=0, atol=1e-12)
    assert ankle.coordinates == ("pitch", "roll")


@given(degrees=ANGLES)
def test_a_screw_moves_along_its_axis_by_its_pitch(degrees: float) -> None:
    axis = [0.0, 3.0, 4.0]
    motion = system(twist=joint(kind="screw", axis=axis, pitch_mm_per_turn=18.0)).motions({"twist": degrees})["femur"]
    along = np.asarray(axis) / 5.0
    np.testing.assert_allclose(motion(CENTRE[None])[0], CENTRE + 18.0 * degrees / 360.0 * along, rtol=0, atol=1e-11)
    np.testing.assert_allclose(motion.rotation, about(axis, degrees), rtol=0, atol=1e-12)


def test_pitch_is_in_the_units_of_the_file() -> None:
    twist = joint(kind="screw", axis=[0, 0, 1], pitch_cm_per_turn=1.8)
    twist["centre_cm"] = twist.pop("centre_mm")
    table = {"units": "cm", "twist": twist}
    motion = parse_joints(table, source="j.toml").motions({"twist": 360.0})["femur"]
    np.testing.assert_allclose(motion.translation, [0, 0, 18.0], rtol=0, atol=1e-9)


def knee_with_patella(couple: dict[str, Any]) -> JointSystem:
    knee = joint(axis=[1, 0, 0], fixed=["femur"], moving=["tibia"])
    patella = joint(axis=[1, 0, 0], centre_mm=[0, 0, 0], fixed=["femur"], moving=["patella"], couple=couple)
    return system(knee=knee, patella=patella)


@given(degrees=st.floats(0.0, 120.0))
def test_a_coupled_coordinate_follows_by_a_fraction(degrees: float) -> None:
    motions = knee_with_patella({"to": "knee", "fraction": 0.6}).motions({"knee": degrees})
    np.testing.assert_allclose(motions["patella"].rotation, about([1, 0, 0], 0.6 * degrees), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(motions["patella"].translation, [0, 0, 0])


def test_a_coupled_coordinate_meets_its_points_and_stays_beyond() -> None:
    coupled = knee_with_patella({"to": "knee", "points_deg": [[-10, -4], [0, 0], [60, 40], [120, 70]]})
    for knee, patella in ((-40, -4), (-10, -4), (0, 0), (60, 40), (120, 70), (150, 70)):
        turn = coupled.motions({"knee": knee})["patella"].rotation
        np.testing.assert_allclose(turn, about([1, 0, 0], patella), rtol=0, atol=1e-12)
    between = [coupled.motions({"knee": k})["patella"].rotation[2, 1] for k in np.linspace(0, 70, 15)]
    assert np.all(np.diff(between) > 0.0)


def test_on_the_way_the_coupled_angle_follows_the_angle_there() -> None:
    way = knee_with_patella({"to": "knee", "points_deg": [[0, 0], [45, 40], [90, 50]]}).along({"knee": 90.0})
    np.testing.assert_allclose(way.at(0.5)["patella"].rotation, about([1, 0, 0], 40.0), rtol=0, atol=1e-12)


def test_a_bone_follows_one_coordinate_of_a_ball() -> None:
    table = {"hip": hip(), "sesamoid": {"follows": "adduction", "fraction": 0.5, "bone": "sesamoid"}}
    motion = system(**table).motions({"flexion": 30.0, "adduction": 20.0})["sesamoid"]
    np.testing.assert_allclose(motion.rotation, about(BALL_AXES[1], 10.0), rtol=0, atol=1e-12)


def test_rest_is_exactly_rest() -> None:
    for motion in system(hip=hip()).motions({}).values():
        np.testing.assert_array_equal(motion.rotation, np.eye(3))
        np.testing.assert_array_equal(motion.translation, np.zeros(3))


REFUSED = {
    "an unknown kind": (joint(kind="bal", axes=BALL_AXES), r"hip.kind: found 'bal'; did you mean 'ball'\?"),
    "two axes of a ball": (
        {**hip(), "axes": BALL_AXES[:2]},
        "hip.axes: expected a list of 3 axes",
    ),
    "axes in a plane": (
        {**hip(), "axes": [[1, 0, 0], [0, 1, 0], [1, 1, 0]]},
        "hip.axes: the 3 axes lie in a plane",
    ),
    "parallel axes": (
        joint(kind="universal", axes=[[1, 0, 0], [2, 0, 0]], coordinates=["a", "b"]),
        "hip.axes: the 2 axes are parallel",
    ),
    "too few coordinates": ({**hip(), "coordinates": ["a", "b"]}, "hip.coordinates: found 2; a ball joint has 3"),
    "a hinge with axes": (joint(axes=BALL_AXES), "hip.axes: unknown key"),
    "a screw without pitch": (joint(kind="screw", axis=[1, 0, 0]), "hip.pitch_mm_per_turn: is missing"),
    "a pitch in other units": (
        joint(kind="screw", axis=[1, 0, 0], pitch_m_per_turn=0.1),
        'hip.pitch_m_per_turn: the file\'s units are "mm": write pitch_mm_per_turn',
    ),
    "one limit of three": ({**hip(), "limits_deg": [[-10, 10]]}, "hip.limits_deg: found 1 ranges"),
    "limits without rest": (
        {**hip(), "limits_deg": [[-10, 10], [5, 10], [-1, 1]]},
        r"hip.limits_deg: found \[5, 10\]; .*rest pose",
    ),
    "coupled to nothing": (
        joint(axis=[1, 0, 0], couple={"to": "kne", "fraction": 1.0}),
        "hip.couple.to: no pose sets a coordinate 'kne'",
    ),
    "coupled twice": (
        joint(axis=[1, 0, 0], couple={"to": "knee", "fraction": 1.0, "points_deg": [[0, 0], [1, 1]]}),
        "hip.couple.fraction: give one of",
    ),
    "coupling that leaves rest": (
        joint(axis=[1, 0, 0], couple={"to": "knee", "points_deg": [[0, 1], [1, 2]]}),
        r"hip.couple.points_deg: leaves out the rest pose; add \[0, 0\]",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_wrong_tables_are_refused_by_key(name: str) -> None:
    table, message = REFUSED[name]
    with pytest.raises(RigError, match=f"^j.toml: {message}"):
        system(hip=table)


def test_two_joints_may_not_share_a_coordinate() -> None:
    other = {**hip(), "moving": ["tibia"]}
    with pytest.raises(RigError, match=r"joint 'hip' has a coordinate 'flexion' too"):
        system(hip=hip(), knee=other)


def test_limits_hold_for_each_coordinate_and_for_coupled_ones() -> None:
    limited = system(hip={**hip(), "limits_deg": [[-20, 120], [-30, 30], [-45, 45]]})
    limited.check_pose({"flexion": 110.0})
    with pytest.raises(RigError, match=r"pose of 'adduction': found 40 degrees, but limits_deg .* is \[-30, 30\]"):
        limited.check_pose({"adduction": 40.0})
    coupled = knee_with_patella({"to": "knee", "fraction": 1.0})
    with pytest.raises(RigError, match="pose of 'patella': it follows joint 'knee'"):
        coupled.check_pose({"patella": 10.0})


def test_the_way_of_a_ball_is_its_coordinates_multiplied() -> None:
    way = system(hip=hip()).along({"flexion": 60.0, "rotation": -30.0})
    for t in (0.0, 0.25, 1.0):
        expected = about(BALL_AXES[0], 60.0 * t) @ about(BALL_AXES[2], -30.0 * t)
        np.testing.assert_allclose(way.at(t)["femur"].rotation, expected, rtol=0, atol=1e-12)
        assert math.isclose(np.linalg.det(way.at(t)["femur"].rotation), 1.0, abs_tol=1e-12)
