"""Joints: the order of composition against matrices composed by hand, laws of the way, and refused tables."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from musclefit.errors import RigError
from musclefit.rig.handles import BonePath, Handles
from musclefit.rig.joints import JointSystem, parse_joints

ANGLES = st.floats(-170.0, 170.0)


def finger_table() -> dict[str, Any]:
    """A shoulder, an elbow and a wrist in a chain, a thumb beside the wrist's fingers, and a sesamoid."""
    return {
        "units": "mm, degrees",
        "shoulder": {"centre_mm": [0, 0, 0], "axis": [0, 0, 2], "fixed": ["trunk"], "moving": list("ufht")},
        "elbow": {"centre_mm": [100, 0, 0], "axis": [0, 1, 0], "fixed": ["u"], "moving": ["f", "h", "t"]},
        "wrist": {"centre_mm": [200, 0, 0], "axis": [1, 1, 0], "fixed": ["f"], "moving": ["h"]},
        "thumb": {"centre_mm": [205, 5, 0], "axis": [1, 0, 0], "fixed": ["f"], "moving": ["t"]},
        "sesamoid": {"follows": "elbow", "fraction": 0.5, "bone": "s"},
    }


def turned(centre: list[float], axis: list[float], degrees: float) -> np.ndarray:
    """(4, 4) rotation about an axis by Rodrigues' formula, written out."""
    a = np.asarray(axis, dtype=float) / math.sqrt(sum(x * x for x in axis))
    k = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    angle = math.radians(degrees)
    r = np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * (k @ k)
    matrix = np.eye(4)
    matrix[:3, :3] = r
    matrix[:3, 3] = np.asarray(centre) - r @ np.asarray(centre)
    return matrix


def as_matrices(motions: Mapping[str, Any]) -> dict[str, np.ndarray]:
    matrices = {}
    for bone, motion in motions.items():
        matrices[bone] = np.eye(4)
        matrices[bone][:3, :3], matrices[bone][:3, 3] = motion.rotation, motion.translation
    return matrices


@given(shoulder=ANGLES, elbow=ANGLES, wrist=ANGLES, thumb=ANGLES)
def test_the_proximal_joint_is_applied_last_about_rest_axes(
    shoulder: float, elbow: float, wrist: float, thumb: float
) -> None:
    system = parse_joints(finger_table(), source="f.json")
    pose = {"wrist": wrist, "thumb": thumb, "shoulder": shoulder, "elbow": elbow}
    found = as_matrices(system.motions(pose))
    s = turned([0, 0, 0], [0, 0, 2], shoulder)
    e = turned([100, 0, 0], [0, 1, 0], elbow)
    expected = {
        "trunk": np.eye(4),
        "u": s,
        "f": s @ e,
        "h": s @ e @ turned([200, 0, 0], [1, 1, 0], wrist),
        "t": s @ e @ turned([205, 5, 0], [1, 0, 0], thumb),
        "s": s @ turned([100, 0, 0], [0, 1, 0], 0.5 * elbow),
    }
    assert found.keys() == expected.keys()
    for bone, matrix in expected.items():
        np.testing.assert_allclose(found[bone], matrix, rtol=0, atol=1e-10, err_msg=bone)


def test_the_order_in_the_table_does_not_matter() -> None:
    table = finger_table()
    backwards = dict(reversed(list(table.items())))
    pose = {"shoulder": 20.0, "elbow": 75.0, "wrist": -40.0, "thumb": 30.0}
    first = as_matrices(parse_joints(table, source="f.json").motions(pose))
    second = as_matrices(parse_joints(backwards, source="f.json").motions(pose))
    for bone in first:
        np.testing.assert_array_equal(first[bone], second[bone])


def test_what_carries_a_joint_keeps_touching_it() -> None:
    """The point of a distal joint's axis moves with the bones that carry the axis, whatever the pose."""
    system = parse_joints(finger_table(), source="f.json")
    motions = system.motions({"shoulder": 33.0, "elbow": -71.0, "wrist": 50.0, "thumb": -12.0})
    wrist = np.array([[200.0, 0.0, 0.0], [207.0, 7.0, 0.0]])
    np.testing.assert_allclose(motions["f"](wrist), motions["h"](wrist), rtol=0, atol=1e-10)
    elbow = np.array([[100.0, -3.0, 0.0]])
    for bone in ("f", "s"):
        np.testing.assert_allclose(motions["u"](elbow), motions[bone](elbow), rtol=0, atol=1e-10)


@given(t=st.floats(0.0, 1.0), elbow=ANGLES, wrist=ANGLES)
def test_the_way_is_the_pose_scaled_and_starts_at_rest(t: float, elbow: float, wrist: float) -> None:
    system = parse_joints(finger_table(), source="f.json")
    way = system.along({"elbow": elbow, "wrist": wrist})
    for bone, matrix in as_matrices(way.at(0.0)).items():
        np.testing.assert_array_equal(matrix, np.eye(4), err_msg=bone)
    there = as_matrices(system.motions({"elbow": t * elbow, "wrist": t * wrist}))
    for bone, matrix in as_matrices(way.at(t)).items():
        np.testing.assert_array_equal(matrix, there[bone], err_msg=bone)


def test_rest_is_rest() -> None:
    for matrix in as_matrices(parse_joints(finger_table(), source="f.json").motions({})).values():
        np.testing.assert_array_equal(matrix, np.eye(4))


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1.0), ("cm", 10.0), ("m", 1000.0)])
def test_units_are_read(unit: str, factor: float) -> None:
    table = {
        "units": unit,
        "knee": {f"centre_{unit}": [1, 2, 3], "axis": [0, 0, -4], "fixed": [], "moving": ["tibia"]},
    }
    (knee,) = parse_joints(table, source="k.json").joints
    np.testing.assert_allclose(knee.centre, factor * np.array([1.0, 2.0, 3.0]), rtol=1e-15, atol=0)
    np.testing.assert_array_equal(knee.axis, [0.0, 0.0, -1.0])
    assert not knee.centre.flags.writeable


def _changed(joint: str, **changes: Any) -> dict[str, Any]:
    table = finger_table()
    table[joint] = {key: value for key, value in (table[joint] | changes).items() if value is not None}
    return table


WRONG_TABLES = {
    "no units": ({k: v for k, v in finger_table().items() if k != "units"}, "f.json: units: is missing"),
    "inches": (
        finger_table() | {"units": "inch"},
        r"f.json: units: found 'inch'; expected a length unit \(mm, cm, m\)",
    ),
    "radians": (finger_table() | {"units": "mm, radians"}, "f.json: units: found 'mm, radians'"),
    "units is a list": (finger_table() | {"units": ["mm"]}, "f.json: units: found the list .*expected text"),
    "no joint": ({"units": "mm"}, "f.json: holds no joint"),
    "stray key": (finger_table() | {"note": "x"}, "f.json: note: unknown key; known: units, source, order"),
    "unit of the centre": (
        _changed("elbow", centre_mm=None, centre_cm=[0, 0, 0]),
        'f.json: elbow.centre_cm: the file\'s units are "mm": write centre_mm',
    ),
    "no centre": (_changed("elbow", centre_mm=None), "f.json: elbow.centre_mm: is missing"),
    "flat centre": (
        _changed("elbow", centre_mm=[0, 0]),
        "f.json: elbow.centre_mm: has 2 entries; expected a list of 3",
    ),
    "nested centre": (_changed("elbow", centre_mm=[[0, 0, 0]]), "f.json: elbow.centre_mm: has 1 entries"),
    "centre of texts": (_changed("elbow", centre_mm=["0", 0, 0]), "f.json: elbow.centre_mm: holds the text '0'"),
    "centre is a number": (
        _changed("elbow", centre_mm=3),
        "f.json: elbow.centre_mm: found the number 3; expected a list",
    ),
    "nan centre": (_changed("elbow", centre_mm=[math.nan, 0, 0]), "f.json: elbow.centre_mm: holds nan; expected 3 fin"),
    "boolean axis": (_changed("elbow", axis=[True, 0, 0]), "f.json: elbow.axis: holds the boolean true"),
    "zero axis": (_changed("elbow", axis=[0, 0, 0]), "f.json: elbow.axis: found .*, which is too short or too long"),
    "huge axis": (_changed("elbow", axis=[1e200, 0, 0]), "f.json: elbow.axis: found .*too long"),
    "unknown key": (_changed("elbow", axes=[1]), "f.json: elbow.axes: unknown key; did you mean 'axis'"),
    "bones is a text": (_changed("elbow", moving="f"), "f.json: elbow.moving: found the text 'f'; expected a list"),
    "no moving": (_changed("wrist", moving=[]), "f.json: wrist.moving: is empty"),
    "twice": (_changed("wrist", moving=["h", "h"]), "f.json: wrist.moving: lists 'h' twice"),
    "fixed and moving": (_changed("wrist", moving=["h", "f"]), "f.json: wrist.moving: 'f' is listed in fixed too"),
    "limits without rest": (
        _changed("wrist", limits_deg=[10, 40]),
        r"f.json: wrist.limits_deg: found \[10, 40\]; .*0 deg",
    ),
    "limits upside down": (_changed("wrist", limits_deg=[40, -10]), "f.json: wrist.limits_deg"),
    "one limit": (_changed("wrist", limits_deg=[40]), "f.json: wrist.limits_deg: has 1 entries; expected a list of 2"),
    "same bones": (
        _changed("thumb", fixed=["f"], moving=["h"]),
        "f.json: thumb: moves the same bones as joint 'wrist', so their order is ambiguous",
    ),
    "left behind": (
        _changed("elbow", moving=["f", "t"]),
        "f.json: elbow.moving: moves 'f', which carries joint 'wrist', but leaves 'h' behind",
    ),
    "torn": (
        _changed("wrist", fixed=["f", "x"]),
        "f.json: (shoulder|elbow).moving: moves 'f' but not 'x', and both carry joint 'wrist'",
    ),
    "cycle": (
        {
            "units": "mm",
            "a": {"centre_mm": [0, 0, 0], "axis": [1, 0, 0], "fixed": ["q"], "moving": ["p"]},
            "b": {"centre_mm": [0, 0, 0], "axis": [1, 0, 0], "fixed": ["p"], "moving": ["q"]},
        },
        "f.json: b: the order is cyclic: joint 'a' moves 'p', which 'b' fixes, and 'b' moves 'q', which 'a' fixes",
    ),
    "follows nothing": (
        _changed("sesamoid", follows="knee"),
        "f.json: sesamoid.follows: no joint is named 'knee'; known: elbow, shoulder, thumb, wrist",
    ),
    "follows a follower": (_changed("sesamoid", follows="sesamoid"), "f.json: sesamoid.follows: no joint is named"),
    "moved twice": (_changed("sesamoid", bone="h"), "f.json: sesamoid.bone: joint '(elbow|wrist)' moves 'h' already"),
    "carries a joint": (_changed("sesamoid", bone="trunk"), "f.json: sesamoid.bone: 'trunk' also carries joint 'shou"),
    "follows twice": (
        finger_table() | {"other": finger_table()["sesamoid"]},
        "f.json: other.bone: 's' follows 'sesamoid' already",
    ),
    "fraction is text": (_changed("sesamoid", fraction="half"), "f.json: sesamoid.fraction: found the text 'half'"),
    "no fraction": (_changed("sesamoid", fraction=None), "f.json: sesamoid.fraction: is missing"),
    "axis of a follower": (_changed("sesamoid", axis=[1, 0, 0]), "f.json: sesamoid.axis: unknown key"),
}


@pytest.mark.parametrize("slip", WRONG_TABLES)
def test_every_slip_is_named(slip: str) -> None:
    table, message = WRONG_TABLES[slip]
    with pytest.raises(RigError, match=f"^{message}"):
        parse_joints(table, source="f.json")


def test_overlap_without_nesting_is_ambiguous() -> None:
    hinge = {"centre_mm": [0, 0, 0], "axis": [1, 0, 0], "fixed": ["base"]}
    table = {"units": "mm", "a": hinge | {"moving": ["p", "q"]}, "b": hinge | {"moving": ["q", "r"]}}
    with pytest.raises(RigError, match=r"^f.json: b: the order is ambiguous: joints 'a' and 'b' both move 'q'"):
        parse_joints(table, source="f.json")


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (
            {"elbwo": 3.0},
            r"pose of 'elbwo': no such joint in f.json; did you mean 'elbow'\? known: elbow, shoulder, th",
        ),
        ({"sesamoid": 3.0}, "pose of 'sesamoid': it follows joint 'elbow' .*pose that joint"),
        ({"elbow": math.nan}, "pose of 'elbow': found nan; expected a finite angle"),
        ({"wrist": 41.0}, r"pose of 'wrist': found 41 degrees, but limits_deg in f.json is \[-60, 40\]"),
        ({"wrist": -60.5}, "pose of 'wrist': found -60.5 degrees"),
        ({"elbow": 400.0}, "pose of 'elbow': found 400 degrees, and f.json gives it no limits_deg; .*at most 360"),
    ],
)
def test_poses_that_cannot_be_taken_are_refused_at_once(pose: dict[str, float], message: str) -> None:
    system = parse_joints(_changed("wrist", limits_deg=[-60, 40]), source="f.json")
    system.motions({"wrist": 40.0})
    for take in (system.motions, system.along, system.check_pose):
        with pytest.raises(RigError, match=f"^{message}"):
            take(pose)


def test_bones_unknown_to_the_anatomy_are_named() -> None:
    system = parse_joints(finger_table(), source="f.json")
    everything = ["trunk", *"ufhts"]
    system.check_bones(everything)
    with pytest.raises(
        RigError, match=r"^f.json: wrist.moving: the anatomy has no bone 'h'; did you mean 'h2'\? known: f, h2, t"
    ) as caught:
        JointSystem(system.joints[2:], (), "f.json").check_bones(["f", "t", "h2"])
    assert "wrist" in str(caught.value)
    with pytest.raises(RigError, match=r"^f.json: sesamoid.bone: the anatomy has no bone 's'"):
        system.check_bones(everything[:-1])


@pytest.mark.anatomy
def test_the_arm_turns_first_and_flexes_last(anatomy_data: Path) -> None:
    table = json.loads((anatomy_data / "arm" / "joints.json").read_text())
    system = parse_joints(table, source="joints.json")
    system.check_bones([p.stem for p in (anatomy_data / "arm" / "disjoint").glob("bone_*.ply")])
    elbow = turned(table["elbow"]["centre_mm"], table["elbow"]["axis"], 75.0)
    forearm = turned(table["forearm"]["centre_mm"], table["forearm"]["axis"], 70.0)
    found = as_matrices(system.motions({"elbow": 75.0, "forearm": 70.0}))
    for bone, matrix in {
        "bone_right_humerus_FMA23130": np.eye(4),
        "bone_right_ulna_FMA23467": elbow,
        "bone_right_radius_FMA23464": elbow @ forearm,
        "bone_right_capitate_FMA24446": elbow @ forearm,
    }.items():
        np.testing.assert_allclose(found[bone], matrix, rtol=0, atol=1e-9)
    assert len(found) == 30


@pytest.mark.anatomy
def test_the_leg_carries_its_foot_and_patella(anatomy_data: Path) -> None:
    table = json.loads((anatomy_data / "leg" / "joints.json").read_text())
    system = parse_joints(table, source="joints.json")
    system.check_bones([p.stem for p in (anatomy_data / "leg" / "disjoint").glob("bone_*.ply")])
    found = as_matrices(system.motions({"knee": 60.0, "ankle": 20.0}))
    knee = turned(table["knee"]["centre_mm"], table["knee"]["axis"], 60.0)
    ankle = turned(table["ankle"]["centre_mm"], table["ankle"]["axis"], 20.0)
    follower = turned(table["knee"]["centre_mm"], table["knee"]["axis"], 36.0)
    np.testing.assert_allclose(found["bone_left_tibia_FMA24478"], knee, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found["bone_left_talus_FMA24483"], knee @ ankle, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found["bone_left_patella_FMA24487"], follower, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(found["bone_left_femur_FMA24475"], np.eye(4))


def test_landmarks_ride_on_their_bones() -> None:
    system = parse_joints(finger_table(), source="f.json")
    handles = Handles(("a", "b"), np.array([[50.0, 0, 0], [150.0, 0, 0]]), ("u", "f"))
    path = BonePath(handles, system.along({"elbow": 90.0}))
    np.testing.assert_array_equal(path.position(0.0), handles.source)
    np.testing.assert_allclose(path.position(1.0), [[50, 0, 0], [100, 0, -50]], rtol=0, atol=1e-10)
