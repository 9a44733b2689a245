"""A model with every kind of joint, point and wrap object that is read: bodies stand where OpenSim has them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from tiny_osim import COUPLER, KNEE, body, coordinate, joint, opensim_places

from musclefit.io.formats.osim import OpenSimModel, parse_osim

KINDS = {
    "FreeJoint": ("fa", "fb", "fc", "fx", "fy", "fz"),
    "PinJoint": ("pin",),
    "UniversalJoint": ("ua", "ub"),
    "GimbalJoint": ("ga", "gb", "gc"),
    "BallJoint": ("ba", "bb", "bc"),
    "PlanarJoint": ("turn", "px", "py"),
    "SliderJoint": ("slide",),
    "WeldJoint": (),
    "CustomJoint": ("knee",),
}
WRAPS = (
    '<WrapCylinder name="w1">{at}<radius>0.01</radius><length>0.05</length></WrapCylinder>'
    '<WrapSphere name="w2">{at}<radius>0.02</radius></WrapSphere>'
    '<WrapEllipsoid name="w3">{at}<dimensions>0.01 0.02 0.03</dimensions></WrapEllipsoid>'
    '<WrapTorus name="w4">{at}<inner_radius>0.01</inner_radius><outer_radius>0.03</outer_radius></WrapTorus>'
).replace("{at}", "<xyz_body_rotation>0.1 -0.2 0.3</xyz_body_rotation><translation>0 0.01 0.02</translation>")
SECOND = COUPLER.replace('name="cap"', 'name="second"').replace("cap_angle", "pin").replace(">knee<", ">slide<")
THIRD = SECOND.replace('name="second"', 'name="third"').replace(">pin<", ">ua<").replace(">slide<", ">pin<")


def points() -> str:
    place = "<socket_parent_frame>/bodyset/{0}</socket_parent_frame><location>0.01 0.02 0</location>"
    line = '<SimmSpline name="{0}"><x>-1 0 1</x><y>0.01 0.02 0.01</y></SimmSpline>'
    moving = "".join(
        f"<socket_{axis}_coordinate>/jointset/customjoint/knee</socket_{axis}_coordinate><{axis}_location>"
        f"{line.format(axis)}</{axis}_location>"
        for axis in "xyz"
    )
    return (
        f'<PathPoint name="a">{place.format("b0")}</PathPoint>'
        f'<ConditionalPathPoint name="b">{place.format("b7")}<socket_coordinate>/jointset/customjoint/knee'
        "</socket_coordinate><range>-1 1</range></ConditionalPathPoint>"
        f'<MovingPathPoint name="c">{place.format("b7")}{moving}</MovingPathPoint>'
        f'<PathPoint name="d">{place.format("b8")}</PathPoint>'
    )


def every_kind() -> str:
    joints = ""
    for k, (kind, names) in enumerate(KINDS.items()):
        parent = f"b{k - 1}" if k else "ground"
        inner = KNEE if kind == "CustomJoint" else ""
        listed = "".join(coordinate(name, 0.05 * n, -2, 2) for n, name in enumerate(names))
        joints += joint(kind, kind.lower(), parent, f"b{k}", "0.02 -0.1 0.01", listed, inner)
    bodies = "".join(body(f"b{k}") for k in range(len(KINDS)))
    head, mark, tail = bodies.partition("<mass>")
    bodies = f'{head}<WrapObjectSet name="wrapobjectset"><objects>{WRAPS}</objects></WrapObjectSet>{mark}{tail}'
    return (
        f'<OpenSimDocument Version="40000"><Model name="all"><BodySet name="bodyset"><objects>{bodies}</objects>'
        f'</BodySet><JointSet name="jointset"><objects>{joints}</objects></JointSet>'
        f'<ConstraintSet name="constraintset"><objects>{THIRD}{SECOND}</objects></ConstraintSet>'
        '<ForceSet name="forceset"><objects>'
        '<Millard2012EquilibriumMuscle name="puller"><GeometryPath name="geometrypath"><PathPointSet><objects>'
        f"{points()}</objects></PathPointSet></GeometryPath></Millard2012EquilibriumMuscle></objects></ForceSet></Model>"
        "</OpenSimDocument>"
    )


def read() -> OpenSimModel:
    return parse_osim(every_kind().encode(), source="all.osim")


def test_every_joint_stands_where_opensim_has_it(tmp_path: Path) -> None:
    model = read()
    (tmp_path / "all.osim").write_text(every_kind())
    given = dict(zip(model.multibody.coordinates, np.random.default_rng(1).uniform(-1.5, 1.5, 40), strict=False))
    values = model.multibody.values(given)
    expected = opensim_places(tmp_path / "all.osim", values)
    places = model.multibody.places(given)
    assert len(expected) == len(KINDS)
    for name, (rotation, translation) in expected.items():
        np.testing.assert_allclose(places[name].rotation, rotation, atol=1e-12)
        np.testing.assert_allclose(places[name].translation, translation, atol=1e-9)


def test_couplers_follow_one_another_in_any_order() -> None:
    """The third follows the second, which stands after it in the file."""
    values = read().multibody.values({"slide": 0.7})
    assert values["pin"] != 0.0
    assert values["ua"] == read().multibody.couplers[0].function(values["pin"])


def test_every_point_and_wrap_object_is_read() -> None:
    model = read()
    assert [(p.name, p.kind) for p in model.points if p.of] == [
        ("a", "PathPoint"),
        ("b", "ConditionalPathPoint"),
        ("c", "MovingPathPoint"),
        ("d", "PathPoint"),
    ]
    assert {wrap.kind: wrap.sizes_mm.tolist() for wrap in model.wraps} == {
        "WrapCylinder": [10.0, 50.0],
        "WrapSphere": [20.0],
        "WrapEllipsoid": [10.0, 20.0, 30.0],
        "WrapTorus": [10.0, 30.0],
    }


def test_moving_points_are_read_in_the_spelling_of_older_files() -> None:
    text = every_kind()
    socket = r"<socket_([xyz])_coordinate>/jointset/customjoint/knee</socket_._coordinate>"
    older = re.sub(socket, r"<\1_coordinate>knee</\1_coordinate>", text)
    assert older != text
    new, old = (next(p for p in parse_osim(t.encode(), source="m").points if p.name == "c") for t in (text, older))
    assert old.curve is not None
    assert new.curve is not None
    for angle in (-1.0, 0.3, 2.0):
        np.testing.assert_array_equal(old.curve.at({"knee": angle}), new.curve.at({"knee": angle}))
