"""`musclefit export-osim`: a model carried by a map, opened by OpenSim's library, compared with what was meant."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from tiny_osim import (
    CONSTANT,
    MODEL,
    MOTION,
    PIECES,
    POLYNOMIAL,
    SPLINE,
    TIMES,
    axis,
    opensim_markers,
    opensim_places,
    opensim_point,
    with_offset_frames,
    write_tiny_osim,
)

import musclefit as mf
from musclefit.cli import main
from musclefit.io.anatomy import read_surface
from musclefit.io.formats.osim import OpenSimModel, parse_osim
from musclefit.rig.multibody import BodyJoint
from musclefit.rig.wrap_fits import fitted_wrap, wrap_samples

LINEAR = np.array([[1.1, 0.05, 0.0], [0.0, 1.2, 0.0], [0.0, 0.1, 0.9]])
SHIFT = np.array([5.0, -3.0, 2.0])


@pytest.fixture
def carried(tmp_path: Path) -> tuple[Path, Path]:
    """A model, and the rig that takes it along by an affine map."""
    model = write_tiny_osim(tmp_path / "model")
    mf.import_osim(model, tmp_path / "rig", progress=None)
    bones = mf.read_anatomy(tmp_path / "rig" / "bones").anatomy
    low, high = bones.vertices().min(axis=0), bones.vertices().max(axis=0)
    corners = np.array(
        [[(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    )
    rows = ["name,x_mm,y_mm,z_mm,target_x_mm,target_y_mm,target_z_mm"]
    for k, corner in enumerate(corners):
        rows.append(f"p{k}," + ",".join(repr(float(x)) for x in (*corner, *(LINEAR @ corner + SHIFT))))
    (tmp_path / "rig" / "pairs.csv").write_text("\n".join(rows) + "\n")
    rig = tmp_path / "rig" / "to_subject.toml"
    rig.write_text(
        'title = "subject"\n[anatomy]\nfolder = "bones"\n[anatomy.kinds]\n"*" = "bone"\n[drive]\nkind = "landmarks"\n'
        'source = "pairs.csv"\n[deformer]\nkernel = "r3"\n[certificate]\nenabled = false\n'
    )
    return model, rig


def test_the_model_stands_where_the_map_takes_it_and_opensim_opens_it(
    carried: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, rig = carried
    assert main(["export-osim", str(rig), str(model), str(tmp_path / "out"), "--quiet", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    out = tmp_path / "out" / "tiny.osim"
    old, new = (parse_osim(path.read_bytes(), source="m") for path in (model, out))
    before, after = old.multibody.places({}), new.multibody.places({})
    opened = opensim_places(out, new.multibody.values({}))
    for one, other in zip(old.points, new.points, strict=True):
        meant = LINEAR @ before[one.body](one.at[None])[0] + SHIFT
        np.testing.assert_allclose(after[other.body](other.at[None])[0], meant, atol=1e-6)
        rotation, translation = opened[other.body]
        np.testing.assert_allclose(rotation @ other.at + translation, meant, atol=1e-6)
    (muscle,) = said["muscles"]
    ratio = muscle["length_after_mm"] / muscle["length_before_mm"]
    fibre = re.search(r"<optimal_fiber_length>(.*)</optimal", out.read_text())
    assert fibre is not None
    assert float(fibre[1]) == pytest.approx(0.05 * ratio, rel=1e-9)
    assert said["wraps"][0]["largest_mm"] < 5.0
    vertices = mf.read_anatomy(
        [tmp_path / "out" / "Geometry" / "foot__foot.obj"], units=mf.Unit.METRE
    ).anatomy.vertices()
    scaled = after["foot"](vertices * (1.0, 1.2, 1.0))
    meant = mf.read_anatomy(tmp_path / "rig" / "bones").anatomy["foot__foot"].surface.vertices @ LINEAR.T + SHIFT
    np.testing.assert_allclose(np.sort(scaled, axis=0), np.sort(meant, axis=0), atol=1e-3)


def test_all_that_is_no_place_stays_byte_for_byte(carried: tuple[Path, Path], tmp_path: Path) -> None:
    model, rig = carried
    mf.export_osim(rig, model, tmp_path / "out", progress=None)
    numbers = re.compile(
        r">[^<>]*</(translation|location|mass_center|xyz_body_rotation|radius|length|mesh_file|optimal_fiber_length|tendon_slack_length|y|value)>"
    )
    assert numbers.sub("", (tmp_path / "out" / "tiny.osim").read_text()) == numbers.sub("", MODEL)


KNOTS = (-2.0, -1.0, -0.4, 0.0, 0.5, 1.5)
SLIDING = MODEL.replace(PIECES, SPLINE.replace("0.002", "-0.31")).replace(
    axis("translation3", "0 0 1", "", CONSTANT), axis("translation3", "0 0 1", "knee", SPLINE.replace("0.006", "0.05"))
)
"""The knee slides along three splines with the same knots, as far as a thigh is long."""


def test_where_splines_move_a_joint_the_map_takes_its_way(carried: tuple[Path, Path], tmp_path: Path) -> None:
    """An affine map of splines with common knots is one of splines: the joint's frame is there at any angle."""
    model, rig = carried
    model.write_text(SLIDING)
    made = mf.export_osim(rig, model, tmp_path / "out", progress=None)
    out = tmp_path / "out" / "tiny.osim"
    old, new = (parse_osim(path.read_bytes(), source="m") for path in (model, out))
    for angle in (*KNOTS, 0.2, 0.9, -1.6, 1.9):
        before, after = (opensim_places(path, old.multibody.values({"knee": angle})) for path in (model, out))
        there, now = (
            place["shank"][0] @ joint_of(read, "kneejoint").in_child.translation + place["shank"][1]
            for place, read in ((before, old), (after, new))
        )
        np.testing.assert_allclose(now, LINEAR @ there + SHIFT, atol=1e-6)
    assert not [said for said in made.left if "kneejoint" in said]


def test_what_functions_cannot_state_of_a_joints_way_is_told(carried: tuple[Path, Path], tmp_path: Path) -> None:
    """Two functions of different knots and a constant: each is right where it is stated, and the worst is told."""
    model, rig = carried
    made = mf.export_osim(rig, model, tmp_path / "out", progress=None)
    old, new = (parse_osim(path.read_bytes(), source="m") for path in (model, tmp_path / "out" / "tiny.osim"))
    off = []
    for angle in (*KNOTS, 2.0, 0.2):
        values = old.multibody.values({"knee": angle})
        there, now = (
            (read.multibody.places(values)["shank"] @ joint_of(read, "kneejoint").in_child).translation
            for read in (old, new)
        )
        off.append(np.linalg.norm(now - (LINEAR @ there + SHIFT)))
    (said,) = [said for said in made.left if "kneejoint" in said]
    told = float(re.findall(r"up to (\S+) mm", said)[0])
    assert told == pytest.approx(max(off), rel=0.05)
    assert told < 6.0


MOVING = (
    '<MovingPathPoint name="puller-M"><socket_parent_frame>/bodyset/shank</socket_parent_frame>'
    "<socket_x_coordinate>/jointset/kneejoint/knee</socket_x_coordinate>"
    "<socket_y_coordinate>/jointset/kneejoint/knee</socket_y_coordinate>"
    "<socket_z_coordinate>/jointset/kneejoint/knee</socket_z_coordinate>"
    f"<x_location>{SPLINE}</x_location><y_location>{TIMES}</y_location>"
    "<z_location>{z}</z_location></MovingPathPoint>"
)


@pytest.mark.parametrize("z", [SPLINE, CONSTANT, POLYNOMIAL])
def test_points_that_coordinates_move_go_where_the_map_takes_them(
    carried: tuple[Path, Path], tmp_path: Path, z: str
) -> None:
    model, rig = carried
    first = '<PathPoint name="puller-P2">'
    model.write_text(MODEL.replace(first, MOVING.replace("{z}", z) + first))
    made = mf.export_osim(rig, model, tmp_path / "out", progress=None)
    out = tmp_path / "out" / "tiny.osim"
    old, new = (parse_osim(path.read_bytes(), source="m") for path in (model, out))
    said = [said for said in made.left if "puller-M" in said]
    if z is POLYNOMIAL:  # not read: as it was
        assert said == ["MovingPathPoint 'puller-M': its functions are kept"]
        return
    rest, there = old.multibody.places({})["shank"], new.multibody.places({})["shank"]
    off = []
    for angle in (*KNOTS, 0.9):
        before, after = (opensim_point(path, old.multibody.values({"knee": angle}), 1) for path in (model, out))
        off.append(np.linalg.norm(there(after[None])[0] - (LINEAR @ rest(before[None])[0] + SHIFT)))
    assert max(off) < (1e-6 if z is SPLINE else 1.5)
    assert bool(said) == (z is CONSTANT)
    (muscle,) = made.muscles
    lengths = [length(read, {}) for read in (old, new)]
    np.testing.assert_allclose(made.muscles[muscle], lengths, rtol=1e-2 if z is CONSTANT else 1e-9)


def joint_of(read: OpenSimModel, name: str) -> BodyJoint:
    return next(joint for joint in read.multibody.joints if joint.name == name)


def test_a_rig_elsewhere_is_refused(carried: tuple[Path, Path], tmp_path: Path) -> None:
    model, rig = carried
    model.write_text(MODEL.replace("<translation>0 0 0</translation>", "<translation>90 0 0</translation>"))
    with pytest.raises(
        mf.InputError, match=r"mm from the rig's anatomy; the rig must stand in the model's ground frame"
    ):
        mf.export_osim(rig, model, tmp_path / "out", progress=None)


@pytest.mark.parametrize(
    ("kind", "sizes"),
    [("WrapCylinder", (10, 60)), ("WrapSphere", (10,)), ("WrapEllipsoid", (10, 20, 30)), ("WrapTorus", (5, 20))],
)
def test_wraps_follow_turns_and_even_scaling_exactly(kind: str, sizes: tuple[float, ...]) -> None:
    samples = wrap_samples(kind, np.array(sizes, dtype=float))
    turn = mf.RigidMotion.about_axis(centre=np.array([1.0, 2.0, 3.0]), axis=np.array([1.0, 1.0, 0.0]), angle_deg=40.0)
    fit = fitted_wrap(kind, np.array(sizes, dtype=float), samples=samples, moved=turn(samples * 1.3))
    np.testing.assert_allclose(fit.sizes_mm, 1.3 * np.array(sizes), rtol=1e-12)
    np.testing.assert_allclose(fit.place.rotation, turn.rotation, atol=1e-12)
    assert fit.largest_mm < 1e-9


def test_muscles_over_a_motion_before_and_after(
    carried: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Lengths and moment arms are those of the straight line, by differences of our own kinematics."""
    model, rig = carried
    walk = tmp_path / "walk.mot"
    walk.write_text(MOTION.replace("0\t0\t0\t1", "0\t10\t0\t1"))  # at 0 a function of the knee has a kink
    command = ["export-osim", str(rig), str(model), str(tmp_path / "out"), "--motion", str(walk), "--json", "--quiet"]
    assert main(command) == 0
    said = json.loads(capsys.readouterr().out)
    (muscle,) = said["muscles_over_motion"]
    (arm,) = said["moment_arms"]
    assert (arm["muscle"], arm["coordinate"]) == ("puller", "knee")
    poses = [{"knee": np.deg2rad(d), "tx": x} for d, x in ((10, 0), (-30, 0.01), (-60, 0.02))]
    for path, when in ((model, "before"), (tmp_path / "out" / "tiny.osim", "after")):
        read = parse_osim(path.read_bytes(), source="m")
        lengths = [length(read, pose) for pose in poses]
        step = 1e-4
        arms = [
            (length(read, {**p, "knee": p["knee"] - step}) - length(read, {**p, "knee": p["knee"] + step})) / (2 * step)
            for p in poses
        ]
        assert muscle[f"shortest_{when}_mm"] == pytest.approx(min(lengths), rel=1e-9)
        assert muscle[f"longest_{when}_mm"] == pytest.approx(max(lengths), rel=1e-9)
        assert arm[f"least_{when}_mm"] == pytest.approx(min(arms), rel=1e-5)
        assert arm[f"most_{when}_mm"] == pytest.approx(max(arms), rel=1e-5)
        assert muscle[f"in_bone_{when}_mm"] > 0.0  # the path ends 20 mm from the middle of a bone of 25 x 30 mm
        assert muscle[f"bone_{when}"] in ("thigh__thigh", "shank__shank")
    rows = (tmp_path / "out" / "muscles.csv").read_text().splitlines()
    assert len(rows) == 1 + 3
    assert (tmp_path / "out" / "moment_arms.csv").read_text().splitlines()[
        0
    ] == "time_s,muscle,coordinate,before_mm,after_mm"
    assert any("foo" in left for left in said["left_as_it_is"])


def length(model: OpenSimModel, pose: dict[str, float]) -> float:
    places = model.multibody.places(pose)
    line = np.array([places[point.body](point.at[None])[0] for point in model.points if point.of])
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def test_a_motion_that_cannot_be_read_ends_before_the_work(
    carried: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, rig = carried
    bad = tmp_path / "bad.mot"
    bad.write_text("endheader\ntime foo\n0 1\n")
    assert main(["export-osim", str(rig), str(model), str(tmp_path / "out"), "--motion", str(bad), "--quiet"]) == 2
    assert "no column is a coordinate of the model" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_listed_bodies_are_scaled_along_their_own_axes(
    carried: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Thigh and foot by factors, all that is fixed to them too; hip and shank as the map says; OpenSim agrees."""
    model, rig = carried
    command = ["export-osim", str(rig), str(model), str(tmp_path / "out"), "--quiet", "--json", "--linear"]
    assert main([*command, "thigh", "foot"]) == 0
    said = json.loads(capsys.readouterr().out)
    out = tmp_path / "out" / "tiny.osim"
    old, new = (parse_osim(path.read_bytes(), source="m") for path in (model, out))
    before, after = old.multibody.places({}), new.multibody.places({})
    factors = {one["body"]: np.array([one["x"], one["y"], one["z"]]) for one in said["linear_bodies"]}
    assert list(factors) == ["thigh", "foot"]
    for body, found in factors.items():  # a ball with the scale factors of its mesh: its axes are the body's
        along = before[body].rotation.T @ LINEAR @ before[body].rotation
        np.testing.assert_allclose(found, np.diag(along), rtol=1e-3)
    for one, other in zip(old.points, new.points, strict=True):
        meant = after[one.body].inverse()((LINEAR @ before[one.body](one.at[None])[0] + SHIFT)[None])[0]
        if one.body in factors:
            meant = factors[one.body] * one.at
        np.testing.assert_allclose(other.at, meant, atol=1e-6)
    for was, now in zip(old.multibody.joints, new.multibody.joints, strict=True):
        if was.parent in factors:
            meant = factors[was.parent] * was.in_parent.translation
            np.testing.assert_allclose(now.in_parent.translation, meant, atol=1e-9)
        if was.child in factors:
            meant = factors[was.child] * was.in_child.translation
            np.testing.assert_allclose(now.in_child.translation, meant, atol=1e-9)
    opened = opensim_places(out, new.multibody.values({}))
    for body, (rotation, translation) in opened.items():
        np.testing.assert_allclose(rotation, before[body].rotation, atol=1e-9)
        np.testing.assert_allclose(translation, after[body].translation, atol=1e-6)
    vertices = surface_of(tmp_path / "out" / "Geometry" / "thigh__thigh.obj")
    np.testing.assert_allclose(
        vertices, factors["thigh"] * surface_of(model.parent / "Geometry" / "thigh.stl"), atol=1e-4
    )
    rest = before["thigh"](surface_of(model.parent / "Geometry" / "thigh.stl") * (1.0, 1.2, 1.0))
    off = np.linalg.norm(after["thigh"](vertices * (1.0, 1.2, 1.0)) - (rest @ LINEAR.T + SHIFT), axis=1)
    assert said["linear_bodies"][0]["rms_mm"] == pytest.approx(np.sqrt((off**2).mean()), rel=1e-3)
    assert said["linear_bodies"][0]["largest_mm"] == pytest.approx(off.max(), rel=1e-3)


def surface_of(path: Path) -> np.ndarray:
    """Sorted vertices of a surface in metres, mm."""
    found = np.unique(read_surface(path, units=mf.Unit.METRE).vertices.round(5), axis=0)
    return np.asarray(found)


def test_a_linear_body_on_the_ground_stands_where_it_fits_best(carried: tuple[Path, Path], tmp_path: Path) -> None:
    model, rig = carried
    made = mf.export_osim(rig, model, tmp_path / "out", linear=["hip"], progress=None)
    new = parse_osim((tmp_path / "out" / "tiny.osim").read_bytes(), source="m").multibody.places({})
    old = parse_osim(model.read_bytes(), source="m").multibody.places({})
    middle = old["hip"].translation  # of a ball around the body's origin
    np.testing.assert_allclose(new["hip"].translation, LINEAR @ middle + SHIFT, atol=1e-3)
    assert made.linear["hip"].largest_mm < 0.15 * 36.0  # what shears of 5 and 10 % do to a ball of 30 to 36 mm


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("femur", r"body 'femur', which is to be scaled linearly, is not in the model; it has hip, thigh"),
        ("ground", r"body 'ground', which is to be scaled linearly, is not in the model"),
        ("cap", r"body 'cap' has no mesh that was found, and linear factors are fitted to meshes"),
    ],
)
def test_bodies_that_cannot_be_scaled_are_refused_before_the_work(
    carried: tuple[Path, Path], tmp_path: Path, body: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    model, rig = carried
    assert main(["export-osim", str(rig), str(model), str(tmp_path / "out"), "--linear", body, "--quiet"]) == 2
    assert re.search(said, " ".join(capsys.readouterr().err.split()))
    assert not (tmp_path / "out").exists()


def test_factors_are_printed(carried: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model, rig = carried
    assert main(["export-osim", str(rig), str(model), str(tmp_path / "out"), "--linear", "thigh"]) == 0
    printed = capsys.readouterr().out
    assert re.search(
        r"body thigh: scaled by 1\.\d+ 1\.\d+ 0\.9\d+ along x y z, .* mm rms from where the map takes it", printed
    )


def test_a_joint_in_a_frame_of_its_body_keeps_the_frame(carried: tuple[Path, Path], tmp_path: Path) -> None:
    """Offset frames among a body's components are no joint's own: they stay, and the bodies beyond stand by them."""
    model, rig = carried
    text = MODEL
    moved = re.search(r'<PhysicalOffsetFrame name="cap_offset">.*?</PhysicalOffsetFrame>', text, re.DOTALL)
    assert moved is not None
    text = text.replace(moved[0], "").replace(
        '<Body name="cap">', f'<Body name="cap"><components>{moved[0]}</components>'
    )
    text = text.replace("<socket_child_frame>cap_offset<", "<socket_child_frame>/bodyset/cap/cap_offset<")
    model.write_text(text)
    made = mf.export_osim(rig, model, tmp_path / "out", progress=None)
    old, new = (parse_osim(path.read_bytes(), source="m") for path in (model, tmp_path / "out" / "tiny.osim"))
    before, after = old.multibody.places({}), new.multibody.places({})
    (one,) = [point for point in old.points if point.body == "cap"]
    (other,) = [point for point in new.points if point.body == "cap"]
    meant = LINEAR @ before["cap"](one.at[None])[0] + SHIFT
    np.testing.assert_allclose(after["cap"](other.at[None])[0], meant, atol=1e-6)
    assert "joint 'capjoint': its frame on 'cap' is none of its own, and stays in the body" in made.left


def test_what_stands_in_offset_frames_is_carried_like_the_rest(carried: tuple[Path, Path], tmp_path: Path) -> None:
    """Markers, a wrap object, a mesh and a joint in frames that joints move, of one name, or on each other."""
    model, rig = carried
    model.write_text(with_offset_frames())
    made = mf.export_osim(rig, model, tmp_path / "out", progress=None)
    out = tmp_path / "out" / "tiny.osim"
    old, new = (parse_osim(path.read_bytes(), source="m") for path in (model, out))
    before, after = old.multibody.places({}), new.multibody.places({})
    opened = opensim_places(out, new.multibody.values({}))
    for body, (rotation, translation) in opened.items():
        np.testing.assert_allclose(translation, after[body].translation, atol=1e-9)
        np.testing.assert_allclose(rotation, after[body].rotation, atol=1e-12)
        meant = LINEAR @ before[body].translation + SHIFT
        np.testing.assert_allclose(translation, meant, atol=1e-6)
    markers = opensim_markers(out, new.multibody.values({}))
    assert len(markers) == 6
    for one in old.points:
        if one.kind == "Marker":
            meant = LINEAR @ before[one.body](one.at[None])[0] + SHIFT
            np.testing.assert_allclose(markers[one.name], meant, atol=1e-6)
    ball, moved = (next(wrap for wrap in read.wraps if wrap.name == "ball") for read in (old, new))
    samples = before["foot"](ball.place(wrap_samples(ball.kind, ball.sizes_mm)))
    there = after["foot"](moved.place(wrap_samples(moved.kind, moved.sizes_mm)))
    np.testing.assert_allclose(there.mean(axis=0), LINEAR @ samples.mean(axis=0) + SHIFT, atol=1e-3)
    rest, toes = next(both for both in zip(old.meshes, new.meshes, strict=True) if both[0].place.translation.any())
    vertices = surface_of(tmp_path / "out" / "Geometry" / toes.file)
    meant = before["foot"](rest.place(surface_of(model.parent / "Geometry" / "foot.stl"))) @ LINEAR.T + SHIFT
    found = after["foot"](toes.place(vertices))
    np.testing.assert_allclose(np.sort(found, axis=0), np.sort(meant, axis=0), atol=1e-3)
    assert not any("none of its own" in said for said in made.left)


def test_two_joints_on_one_frame_must_agree_on_it(carried: tuple[Path, Path], tmp_path: Path) -> None:
    """As parents they do; as child of one and parent of another they would take it to two places."""
    model, rig = carried
    shared = MODEL.replace(
        "<socket_parent_frame>shank_offset</socket_parent_frame><socket_child_frame>cap_offset<",
        "<socket_parent_frame>/jointset/ankle/shank_offset</socket_parent_frame><socket_child_frame>cap_offset<",
    )
    assert shared != MODEL
    model.write_text(shared)
    mf.export_osim(rig, model, tmp_path / "out", progress=None)
    old, new = (parse_osim(path.read_bytes(), source="m") for path in (model, tmp_path / "out" / "tiny.osim"))
    meant = LINEAR @ old.multibody.places({})["cap"].translation + SHIFT
    np.testing.assert_allclose(new.multibody.places({})["cap"].translation, meant, atol=1e-6)
    model.write_text(shared.replace("/jointset/ankle/shank_offset<", "/jointset/kneejoint/shank_offset<"))
    with pytest.raises(mf.InputError, match=r"joint 'capjoint' shares this place of a frame with another joint, and"):
        mf.export_osim(rig, model, tmp_path / "again", progress=None)
    assert not (tmp_path / "again").exists()


def test_a_joint_in_a_frame_that_another_moves_is_refused(carried: tuple[Path, Path], tmp_path: Path) -> None:
    model, rig = carried
    model.write_text(
        re.sub(
            r"(capjoint.*?<socket_parent>)/bodyset/shank<", r"\1/jointset/ankle/shank_offset<", MODEL, flags=re.DOTALL
        )
    )
    with pytest.raises(mf.InputError, match=r"body 'cap' would stand .* mm from where it is meant to"):
        mf.export_osim(rig, model, tmp_path / "out", progress=None)


def test_what_stands_on_the_ground_is_told(carried: tuple[Path, Path], tmp_path: Path) -> None:
    model, rig = carried
    wrap = (
        '<Ground name="ground"><WrapObjectSet name="w"><objects><WrapSphere name="stone"><translation>0 0 0'
        "</translation><xyz_body_rotation>0 0 0</xyz_body_rotation><radius>0.1</radius></WrapSphere></objects>"
        "</WrapObjectSet></Ground>"
    )
    model.write_text(MODEL.replace('<BodySet name="bodyset">', f'{wrap}<BodySet name="bodyset">'))
    made = mf.export_osim(rig, model, tmp_path / "out", progress=None)
    assert "WrapSphere 'stone': stands on the ground" in made.left
