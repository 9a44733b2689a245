"""Free ranges of joints: ends where the geometry says, stated limits respected, what was not met is told."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.geometry.meshes import TriMesh
from musclefit.rig.joints import JointSystem, parse_joints
from musclefit.validate.bones import RESOLUTION_DEG, rigid_bones
from musclefit.validate.joint_ranges import JointRange, joint_ranges


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> TriMesh:
    mesh = trimesh.creation.box(bounds=[low, high])
    return TriMesh(np.array(mesh.vertices), np.array(mesh.faces))


def anatomy() -> Anatomy:
    """A bar that turns about z at the origin, and a stop whose edge it meets with its side."""
    shapes = {"bar": box((5, -2, -5), (80, 2, 5)), "stop": box((-80, 20, -5), (30, 60, 5))}
    return Anatomy(tuple(Tissue(name, TissueKind.BONE, shape) for name, shape in shapes.items()), "test")


def hinge(**more: Any) -> JointSystem:
    joint = {"centre_mm": [0, 0, 0], "axis": [0, 0, 1], "fixed": ["stop"], "moving": ["bar"], **more}
    return parse_joints({"units": "mm", "knee": joint}, source="joints.toml")


def the_range(joints: JointSystem) -> JointRange:
    (found,) = joint_ranges(rigid_bones(anatomy(), joints.bones()), joints)
    return found


def test_a_range_ends_where_the_bones_meet():
    """The bar's upper side meets the stop's corner (30, 20) when asin(2 / r) below its direction; then 0.6 mm more."""
    found = the_range(hinge())
    corner = math.hypot(30.0, 20.0)
    touches = math.degrees(math.atan2(20.0, 30.0) - math.asin(2.0 / corner))
    assert touches - RESOLUTION_DEG < found.high.degrees < touches + 1.5
    assert found.high.ended_by == "bones"
    assert found.high.beyond is not None
    assert {found.high.beyond.a, found.high.beyond.b} == {"bar", "stop"}
    assert found.high.beyond.depth_mm > 1.0
    assert (found.low.degrees, found.low.ended_by) == (-180.0, "not met"), "below the stop there is nothing"


def test_stated_limits_end_a_range_that_is_free_up_to_them():
    found = the_range(hinge(limits_deg=[0, 15]))
    assert (found.low.degrees, found.low.ended_by) == (0.0, "limit")
    assert (found.high.degrees, found.high.ended_by, found.high.beyond) == (15.0, "limit", None)
    assert found.limits_deg == (0.0, 15.0)


def test_bones_may_end_a_range_before_its_limit():
    found = the_range(hinge(limits_deg=[-10, 90]))
    assert found.low.degrees == -10.0
    assert found.high.ended_by == "bones"
    assert found.high.degrees < 40.0


def test_what_nothing_ends_is_not_met():
    joints = hinge(centre_mm=[60, -200, 0], axis=[1, 0, 0])
    prepared = rigid_bones(Anatomy((anatomy()["bar"],), "test"), joints.bones())
    (found,) = joint_ranges(prepared, joints)
    assert (found.low.degrees, found.low.ended_by) == (-180.0, "not met")
    assert (found.high.degrees, found.high.ended_by) == (180.0, "not met")


def test_a_joint_that_follows_ends_a_range_by_its_own_limit():
    table = {
        "units": "mm",
        "knee": {"centre_mm": [0, 0, 0], "axis": [0, 0, 1], "fixed": ["stop"], "moving": ["bar", "tip"]},
        "toe": {
            "centre_mm": [90, 0, 0],
            "axis": [0, 0, 1],
            "fixed": ["bar"],
            "moving": ["tip"],
            "limits_deg": [-5, 5],
            "couple": {"to": "knee", "fraction": 0.5},
        },
    }
    joints = parse_joints(table, source="joints.toml")
    tissues = (*anatomy(), Tissue("tip", TissueKind.BONE, box((95, -2, -5), (110, 2, 5))))
    (found,) = joint_ranges(rigid_bones(Anatomy(tissues, "test"), joints.bones()), joints)
    assert found.high.degrees == pytest.approx(10.0, abs=RESOLUTION_DEG)
    assert found.high.ended_by == "limit"


def test_only_the_asked_joints_are_tried():
    joints = hinge()
    assert joint_ranges(rigid_bones(anatomy(), joints.bones()), joints, only=()) == ()
