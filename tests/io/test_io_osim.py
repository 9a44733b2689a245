"""OpenSim models and motions: kinematics against OpenSim's own, and every kind of file that is refused."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_osim import (
    MODEL,
    MOTION,
    offset_frame,
    opensim_markers,
    opensim_places,
    with_offset_frames,
    write_tiny_osim,
)

from musclefit.errors import InputError
from musclefit.io.formats.opensim_motion import parse_opensim_motion
from musclefit.io.formats.osim import OpenSimModel, body_fixed_xyz, parse_osim
from musclefit.io.formats.xml_in_place import parse_xml, replaced
from musclefit.io.opensim_geometry import find_geometry


def read(text: str) -> OpenSimModel:
    return parse_osim(text.encode(), source="m.osim")


@pytest.mark.parametrize("seed", range(4))
def test_bodies_stand_where_opensim_has_them(tmp_path: Path, seed: int) -> None:
    path = write_tiny_osim(tmp_path)
    model = read(MODEL)
    rng = np.random.default_rng(seed)
    given = {} if seed == 0 else {name: rng.uniform(-2.5, 2.5) for name in model.multibody.coordinates}
    values = model.multibody.values(given)
    expected = opensim_places(path, values)
    places = model.multibody.places(given)
    assert set(expected) == set(model.multibody.bodies)
    for body, (rotation, translation) in expected.items():
        np.testing.assert_allclose(places[body].rotation, rotation, atol=1e-12)
        np.testing.assert_allclose(places[body].translation, translation, atol=1e-9)


def test_frames_of_one_name_are_told_apart_by_their_paths(tmp_path: Path) -> None:
    """Markers, a wrap object and a mesh in offset frames, three of them called shank_offset, stand as in OpenSim."""
    path = write_tiny_osim(tmp_path / "model")
    path.write_text(with_offset_frames())
    model = parse_osim(path.read_bytes(), source="m")
    pose = dict.fromkeys(model.multibody.coordinates, 0.3)
    values, places = model.multibody.values(pose), model.multibody.places(pose)
    theirs = opensim_markers(path, values)
    ours = {p.name: places[p.body](p.at[None])[0] for p in model.points if p.kind == "Marker"}
    assert ours.keys() == theirs.keys()
    assert len({tuple(at.round(6)) for at in ours.values()}) == 6
    for name, at in ours.items():
        np.testing.assert_allclose(at, theirs[name], atol=1e-9)
    turn = body_fixed_xyz(np.array([0.3, 0.1, -0.2]))
    (ball,) = [wrap for wrap in model.wraps if wrap.name == "ball"]
    np.testing.assert_allclose(ball.place.translation, [10, 20, 30] + turn @ [0, 10, 0], atol=1e-12)
    toes, _ = [mesh for mesh in model.meshes if mesh.file == "foot.stl"]
    np.testing.assert_allclose(toes.place.translation, [10, 20, 30] + turn @ [0, 0, 40], atol=1e-12)
    np.testing.assert_allclose(toes.place.rotation, turn @ turn, atol=1e-12)


def test_a_mesh_on_the_frame_of_a_joint_is_read() -> None:
    mesh = '<attached_geometry><Mesh name="m"><mesh_file>hip.stl</mesh_file></Mesh></attached_geometry>'
    name = '<PhysicalOffsetFrame name="cap_offset">'
    model = parse_osim(MODEL.replace(name, name + mesh).encode(), source="m")
    (found,) = [one for one in model.meshes if one.body == "cap"]
    np.testing.assert_allclose(found.place.translation, [0, 50, 0], atol=1e-12)


def test_a_name_that_several_frames_have_is_refused() -> None:
    text = with_offset_frames().replace("/jointset/capjoint/shank_offset<", "shank_offset<")
    with pytest.raises(
        InputError, match=r"names frame 'shank_offset', and 3 frames have that name \(lines .*; state the"
    ):
        parse_osim(text.encode(), source="m")
    once = with_offset_frames().replace("/bodyset/foot/tip<", "tip<")
    assert len(parse_osim(once.encode(), source="m").points) == len(
        parse_osim(with_offset_frames().encode(), source="m").points
    )


def test_frames_on_each_other_in_a_ring_are_refused() -> None:
    ring = offset_frame("one", "/bodyset/cap/two", "0 0 0") + offset_frame("two", "/bodyset/cap/one", "0 0 0")
    text = MODEL.replace('<Body name="cap">', f'<Body name="cap"><components>{ring}</components>')
    text = text.replace("<socket_child_frame>cap_offset<", "<socket_child_frame>/bodyset/cap/one<")
    with pytest.raises(InputError, match=r"names frame '/bodyset/cap/.*', which is not there"):
        parse_osim(text.encode(), source="m")


def test_the_old_layout_says_the_same_as_the_new() -> None:
    old = """<OpenSimDocument Version="30000"><Model name="old"><BodySet><objects>
    <Body name="ground"/><Body name="arm"><mass_center>0 0 0</mass_center><Joint><PinJoint name="p">
    <parent_body>ground</parent_body><location_in_parent>0.1 0 0</location_in_parent>
    <orientation_in_parent>0 0.5 0</orientation_in_parent><location>0 0.2 0</location><orientation>0.3 0 0</orientation>
    <CoordinateSet><objects><Coordinate name="q"><default_value>0.4</default_value><range>-1 1</range></Coordinate>
    </objects></CoordinateSet></PinJoint></Joint></Body></objects></BodySet></Model></OpenSimDocument>"""
    new = """<OpenSimDocument Version="40000"><Model name="new"><BodySet><objects><Body name="arm"/></objects></BodySet>
    <JointSet><objects><PinJoint name="p"><socket_parent_frame>a</socket_parent_frame>
    <socket_child_frame>b</socket_child_frame><coordinates><Coordinate name="q"><default_value>0.4</default_value>
    <range>-1 1</range></Coordinate></coordinates><frames><PhysicalOffsetFrame name="a"><socket_parent>/ground
    </socket_parent><translation>0.1 0 0</translation><orientation>0 0.5 0</orientation></PhysicalOffsetFrame>
    <PhysicalOffsetFrame name="b"><socket_parent>/bodyset/arm</socket_parent><translation>0 0.2 0</translation>
    <orientation>0.3 0 0</orientation></PhysicalOffsetFrame></frames></PinJoint></objects></JointSet></Model>
    </OpenSimDocument>"""
    one, other = (read(text).multibody.places({"q": -0.7})["arm"] for text in (old, new))
    np.testing.assert_array_equal(one.rotation, other.rotation)
    np.testing.assert_array_equal(one.translation, other.translation)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "m.osim: an empty file"),
        (MODEL[:3000], r"m.osim: line \d+ is not valid XML .* export it again"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><a/>", "declares a document type"),
        ("<a/>", "holds <a>; expected an OpenSim model"),
        (MODEL.replace('"40000"', '"10000"'), "file version 10000; .*save it in OpenSim 4"),
        (MODEL.replace('"40000"', f'"{"9" * 5000}"'), "file version 99999999999999999999; .*save it in OpenSim 4"),
        (MODEL.replace("PinJoint", "EllipsoidJoint"), "line .*is a EllipsoidJoint; read are PinJoint"),
        (MODEL.replace("/bodyset/shank<", "/bodyset/shrank<"), "names frame '/bodyset/shrank', which is not there"),
        (MODEL.replace("<x>-2 0 2</x>", "<x>-2 2 0</x>"), "expected at least two of each, x rising"),
        (MODEL.replace("<location>0 0.01 0.02<", "<location>0 nan 0.02<"), "location of Marker 'heel' is '0 nan 0.02'"),
        (MODEL.replace("Model name=", "Model x='' name=").replace(">knee</in", ">knie</in"), "names coordinate 'knie'"),
        (MODEL.replace("<BodySet", "<length_units>mm</length_units><BodySet"), "length_units is 'mm'; expected meters"),
    ],
)
def test_models_that_cannot_be_read(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        read(text)


def test_numbers_that_are_no_lengths_are_refused() -> None:
    """They would overflow once they are millimetres."""
    large = re.sub(r"<location>[^<]*</location>", "<location>0 1e306 0</location>", MODEL, count=1)
    assert large != MODEL
    with pytest.raises(InputError, match=r"line \d+: location of .* holds 1e\+306"):
        read(large)


def test_a_mesh_file_with_an_overlong_name_is_missing() -> None:
    model = read(MODEL)
    mesh = replace(model.meshes[0], file="x" * 5000 + ".vtp")
    files, missing = find_geometry(replace(model, meshes=(mesh,)), [])
    assert files == [None]
    assert missing == [mesh.file]


def test_degrees_become_radians_and_lengths_stay_and_all_else_is_told() -> None:
    motion = parse_opensim_motion(MOTION.encode(), read(MODEL).multibody, source="walk.mot")
    np.testing.assert_allclose(motion.values["knee"], np.deg2rad([0, -30, -60]), rtol=1e-15)
    np.testing.assert_array_equal(motion.values["tx"], [0, 0.01, 0.02])
    said = {finding.code: finding.message for finding in motion.findings}
    assert said["unused-columns"] == "1 columns are not coordinates of the model: foo"
    assert "a, b, c, flex, tilt" in said["coordinates-at-default"]


def test_radians_are_kept_and_paths_are_names() -> None:
    text = MOTION.replace("inDegrees=yes", "inDegrees=no").replace("\tknee", "\t/jointset/kneejoint/knee/value")
    motion = parse_opensim_motion(text.encode(), read(MODEL).multibody, source="walk.sto")
    np.testing.assert_array_equal(motion.values["knee"], [0, -30, -60])
    assert any(finding.code == "beyond-range" for finding in motion.findings)


def test_what_a_locked_coordinate_does_is_told_and_not_followed() -> None:
    text = MOTION.replace("foo", "tilt")
    motion = parse_opensim_motion(text.encode(), read(MODEL).multibody, source="walk.mot")
    assert "tilt" not in motion.values
    assert [f.code for f in motion.findings if "tilt" in f.message] == ["locked-coordinate"]


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("endheader", "end", "no line 'endheader'"),
        ("nRows=3", "nRows=30", "the header says 30 rows, the file has 3; it is cut short"),
        ("inDegrees=yes\n", "", "does not say the unit of angles; add the line inDegrees=yes"),
        ("\t-60\t0.02\t1", "\t-60", "line 10 has 2 values for 4 columns"),
        ("0.5\t", "0\t", "line 9: time does not rise"),
        ("-60", "nan", "line 10: knee is not finite"),
        ("knee\ttx", "kne\tt", "no column is a coordinate of the model; did you mean 'knee'"),
    ],
)
def test_motions_that_cannot_be_read(before: str, after: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        parse_opensim_motion(MOTION.replace(before, after).encode(), read(MODEL).multibody, source="walk.mot")


def test_an_edit_changes_its_own_bytes_alone() -> None:
    data = '<?xml version="1.0"?>\r\n<!-- ä > " -->\r\n<a b="&gt;>"><c>1 2</c><d/><c> x </c></a>'.encode()
    root = parse_xml(data, source="x")
    first, second = (child for child in root.children if child.tag == "c")
    assert replaced(data, [(second, "7"), (first, "3 4")]) == data.replace(b"1 2", b"3 4").replace(b" x ", b"7")
