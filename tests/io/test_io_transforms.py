"""Files of transforms: both layouts, units, round trips, the README's examples, and every way to get one wrong."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tiny_rigs import drive_by, egg, write_tiny_rig

from musclefit.errors import InputError, LandmarkError, RigError
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.formats.transforms import parse_transforms, transforms_text
from musclefit.io.rigs import read_rig
from musclefit.io.run_folder import ply_bytes
from musclefit.rig.bone_fits import RigidPath
from musclefit.rig.handles import BonePath, StraightPath
from musclefit.rig.transforms import BoneTransforms
from musclefit.vocabulary import PathKind, Unit

README = Path(__file__).resolve().parents[2] / "rigs" / "README.md"
POINTS = np.random.default_rng(0).uniform(-100.0, 100.0, (20, 3))
TURN = RigidMotion.about_axis(centre=np.array([10.0, 20.0, -5.0]), axis=np.array([0.0, 0.0, 1.0]), angle_deg=60.0)
HALF = np.deg2rad(30.0)
WXYZ = [float(np.cos(HALF)), 0.0, 0.0, float(np.sin(HALF))]
MATRIX = [[*map(float, row), float(x)] for row, x in zip(TURN.rotation, TURN.translation, strict=True)]
MATRIX.append([0.0, 0.0, 0.0, 1.0])
MATRIX_HEADINGS = ",".join(f"m{i}{j}" for i in range(4) for j in range(4))


def read(text: str, name: str = "f.csv", units: Unit = Unit.MILLIMETRE) -> BoneTransforms:
    return parse_transforms(text.encode(), source=name, units=units)


def of_json(*entries: dict[str, Any], **more: Any) -> BoneTransforms:
    return read(json.dumps({"transforms": list(entries)} | more), "f.json")


def csv_matrix(bone: str = "radius", matrix: list[list[float]] = MATRIX, time: str = "") -> str:
    headings = f"bone,{'time_s,' if time else ''}{MATRIX_HEADINGS}"
    return f"{headings}\n{bone},{f'{time},' if time else ''}{','.join(repr(x) for row in matrix for x in row)}\n"


def same(found: RigidMotion, expected: RigidMotion = TURN) -> None:
    np.testing.assert_allclose(found(POINTS), expected(POINTS), rtol=0, atol=1e-12)


# --- layouts


def test_all_layouts_say_the_same() -> None:
    x, y, z = (repr(float(c)) for c in TURN.translation)
    quaternion = ",".join(map(repr, WXYZ))
    moved = TURN.translation.tolist()
    for found in (
        read(csv_matrix()),
        read(csv_matrix().replace(",", ";")),
        read(csv_matrix().replace("\n", ",remark\n", 1).rstrip() + ",words for the reader\n"),
        read(f"bone,qw,qx,qy,qz,x_mm,y_mm,z_mm\nradius,{quaternion},{x},{y},{z}\n"),
        read(f"x,y,z,qz,qw,qx,qy,bone\n{x},{y},{z},{WXYZ[3]!r},{WXYZ[0]!r},0,0,radius\n"),
        of_json({"bone": "radius", "matrix": MATRIX}),
        of_json({"bone": "radius", "matrix": [v for row in MATRIX for v in row]}),
        of_json({"bone": "radius", "quaternion_wxyz": WXYZ, "translation_mm": moved}),
        of_json({"bone": "radius", "quaternion_xyzw": [*WXYZ[1:], WXYZ[0]], "translation": moved}),
        of_json({"bone": "radius", "quaternion_wxyz": [-w for w in WXYZ], "translation": moved}),
    ):
        assert found.bones() == ("radius",)
        assert not found.timed
        assert found.findings == ()
        same(found.motions(None, kind=PathKind.CHAIN).at(1.0)["radius"])


def test_lengths_are_in_the_units_that_are_stated() -> None:
    x, y, z = (repr(float(c) / 1000.0) for c in TURN.translation)
    quaternion, metres = ",".join(map(repr, WXYZ)), (TURN.translation / 1000.0).tolist()
    in_metres = [[*row[:3], row[3] / 1000.0] for row in MATRIX[:3]] + [MATRIX[3]]
    for found in (
        read(csv_matrix(matrix=in_metres), units=Unit.METRE),
        read(f"bone,qw,qx,qy,qz,x_m,y_m,z_m\nradius,{quaternion},{x},{y},{z}\n"),
        read(f"bone,qw,qx,qy,qz,x,y,z\nradius,{quaternion},{x},{y},{z}\n", units=Unit.METRE),
        of_json({"bone": "radius", "matrix": in_metres}, units="m"),
        of_json({"bone": "radius", "quaternion_wxyz": WXYZ, "translation": metres}, units="m"),
        of_json({"bone": "radius", "quaternion_wxyz": WXYZ, "translation_m": metres}, units="cm"),
    ):
        same(found.motions(None, kind=PathKind.CHAIN).at(1.0)["radius"])


def test_the_frame_of_a_file_is_known() -> None:
    entry = {"bone": "radius", "matrix": MATRIX}
    assert of_json(entry, frame="patient (LPS)", source="4-D CT").frame == "LPS"
    assert of_json(entry, frame="the laboratory's").frame == ""


@given(
    seed=st.integers(0, 999),
    times=st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=4, unique=True),
)
def test_what_is_written_is_read_back_to_the_last_digit_of_a_place(seed: int, times: list[float]) -> None:
    rng = np.random.default_rng(seed)
    motions = {
        time: {
            bone: RigidMotion.about_axis(
                centre=rng.normal(scale=300.0, size=3), axis=rng.normal(size=3), angle_deg=rng.uniform(-180, 180)
            )
            for bone in ("radius", "ulna, left")
        }
        for time in times
    }
    found = read(transforms_text(motions), "f.json")
    assert found.findings == ()
    for time in times:
        for bone, motion in motions[time].items():
            same(found.at(time)[bone], motion)
    still = read(transforms_text(motions[times[0]]), "f.json")
    same(still.motions(None, kind=PathKind.CHAIN).at(1.0)["radius"], motions[times[0]]["radius"])


def test_the_examples_of_the_readme_are_read_as_they_stand() -> None:
    section = README.read_text(encoding="utf-8").split("## Transforms")[1].split("\n## ")[0]
    table, written = re.findall(r"```(?:json)?\n(.*?)```", section, flags=re.DOTALL)
    by_csv, by_json = read(table), read(written, "f.json")
    assert by_csv.last_s == by_json.last_s == 0.1
    for bone in ("radius", "ulna"):
        np.testing.assert_allclose(by_csv.at(0.1)[bone](POINTS), by_json.at(0.1)[bone](POINTS), rtol=0, atol=1e-4)
    assert by_csv.at(0.1)["radius"].turn_deg == pytest.approx(10.0, abs=1e-4)
    assert by_json.frame == "LPS"


# --- files that are wrong

CSV_ERRORS = {
    "empty": ("", r"is empty; expected the columns bone"),
    "no bone": ("name,qw\na,1\n", r"no column bone; found are: name, qw"),
    "nothing but names": ("bone\nradius\n", r"expected the columns m00 to m33 \(a 4x4 matrix, row by row\), or qw"),
    "headings alone": (csv_matrix().splitlines()[0], r"holds no transform"),
    "both": ("bone,m00,qw\nradius,1,1\n", r"expected the columns m00 to m33.*both are there"),
    "matrix cut short": (csv_matrix().replace(",m33", "").replace(",1.0\n", "\n"), r"no column m33"),
    "no translation": ("bone,qw,qx,qy,qz\nradius,1,0,0,0\n", r"no columns x_mm, y_mm, z_mm beside the quaternion"),
    "no y": ("bone,qw,qx,qy,qz,x_mm,z_mm\nradius,1,0,0,0,1,1\n", r"no column y_mm beside x_mm"),
    "two units": ("bone,qw,qx,qy,qz,x_mm,y_m,z_m\nradius,1,0,0,0,1,1,1\n", r"are in different units"),
    "unknown unit": ("bone,qw,qx,qy,qz,x_in,y_in,z_in\nradius,1,0,0,0,1,1,1\n", r"'in', an unknown unit"),
    "slip in a heading": (
        csv_matrix(time="0").replace("time_s", "times_s"),
        r"'times_s' is unknown; did you mean 'time_s'",
    ),
    "a column twice": (csv_matrix().replace("m01", "m00"), r"(two columns are named m00|no column m01)"),
    "words": (csv_matrix(time="now"), r"line 2: time_s is 'now', which is not a number"),
    "nan": (csv_matrix(time="nan"), r"line 2: time_s is nan, not finite"),
    "infinite": (csv_matrix().replace("1.0\n", "inf\n"), r"line 2: m33 is inf, not finite"),
    "overflow": (csv_matrix().replace("1.0\n", "1e999\n"), r"line 2: m33 is 1e999, not finite"),
    "nameless": (csv_matrix(bone=" "), r"line 2 names no bone"),
    "too few values": (csv_matrix().rstrip() + "\nulna,1\n", r"line 3 has 2 values for 17 columns"),
    "twice": (
        csv_matrix() + csv_matrix().splitlines()[1],
        r"bone 'radius' stands twice, at line 2 and line 3; give each",
    ),
    "mirror": (
        csv_matrix(matrix=np.diag([-1.0, 1.0, 1.0, 1.0]).tolist(), time="0.2"),
        r"line 2: bone 'radius' at 0.2 s: determinant -1: a mirror",
    ),
    "length": ("bone,qw,qx,qy,qz,x,y,z\nulna,2,0,0,0,1,1,1\n", r"line 2: bone 'ulna': the quaternion's length is 2"),
}


@pytest.mark.parametrize("name", CSV_ERRORS)
def test_a_wrong_table_is_refused_by_line_and_column(name: str) -> None:
    text, words = CSV_ERRORS[name]
    with pytest.raises(InputError, match=rf"^f.csv: .*{words}"):
        read(text)


ENTRY = {"bone": "radius", "matrix": MATRIX}
JSON_ERRORS: dict[str, tuple[Any, str]] = {
    "no transforms": ({}, r"transforms: is missing"),
    "no list": ({"transforms": {"radius": MATRIX}}, r"transforms: found a table; expected a list of tables"),
    "none": ({"transforms": []}, r"holds no transform"),
    "unknown key": ({"transforms": [], "unit": "mm"}, r"unit: unknown key; did you mean 'units'"),
    "unknown unit": ({"transforms": [ENTRY], "units": "inch"}, r"units: found 'inch'; known: cm, m, mm"),
    "no bone": ({"transforms": [{"matrix": MATRIX}]}, r"transforms\[0\].bone: is missing"),
    "order not said": (
        {"transforms": [ENTRY, {"bone": "u", "quaternion": WXYZ}]},
        r"transforms\[1\].quaternion: does not say its order; write quaternion_wxyz or quaternion_xyzw",
    ),
    "slip": ({"transforms": [ENTRY | {"times_s": 0}]}, r"transforms\[0\].times_s: unknown key; did you mean 'time_s'"),
    "both": (
        {"transforms": [ENTRY | {"quaternion_wxyz": WXYZ}]},
        r"transforms\[0\]: bone 'radius': has matrix, quaternion_wxyz; expected matrix alone, or one",
    ),
    "nothing": ({"transforms": [{"bone": "u", "time_s": 1}]}, r"bone 'u' at 1 s: has no transform; expected"),
    "no translation": (
        {"transforms": [{"bone": "u", "quaternion_wxyz": WXYZ}]},
        r"has quaternion_wxyz; expected matrix alone, or one quaternion and one translation",
    ),
    "two translations": (
        {"transforms": [{"bone": "u", "quaternion_wxyz": WXYZ, "translation": [0, 0, 0], "translation_m": [0, 0, 0]}]},
        r"has quaternion_wxyz, translation, translation_m; expected",
    ),
    "three rows": ({"transforms": [{"bone": "u", "matrix": MATRIX[:3]}]}, r"matrix: expected four rows of four"),
    "words": ({"transforms": [{"bone": "u", "matrix": ["a"] * 16}]}, r"matrix: holds the text 'a'"),
    "not finite": (
        {"transforms": [{"bone": "u", "matrix": [float("nan")] * 16}]},
        r"matrix: holds nan; expected 16 fin",
    ),
    "many digits": (
        {"transforms": [{"bone": "u", "matrix": [10**400] * 16}]},
        r"holds a number of more than 20 digits",
    ),
    "yes": ({"transforms": [{"bone": "u", "matrix": [True] * 16}]}, r"holds the boolean true"),
    "time": ({"transforms": [ENTRY | {"time_s": "0"}]}, r"transforms\[0\].time_s: found the text '0'"),
    "time to come": ({"transforms": [ENTRY | {"time_s": float("inf")}]}, r"time_s: found inf; expected a finite"),
    "twice": (
        {"transforms": [ENTRY | {"time_s": 0.5}, ENTRY | {"time_s": 0.5}]},
        r"bone 'radius' at 0.5 s stands twice, at transforms\[0\] and transforms\[1\]; remove one",
    ),
}


@pytest.mark.parametrize("name", JSON_ERRORS)
def test_a_wrong_object_is_refused_by_its_key(name: str) -> None:
    table, words = JSON_ERRORS[name]
    with pytest.raises(InputError, match=rf"^f.json: .*{words}"):
        read(json.dumps(table), "f.json")


def test_files_that_cannot_be_read_are_refused() -> None:
    with pytest.raises(InputError, match=r"^f.tfm: has suffix '.tfm'; expected .json or .csv"):
        read("", "f.tfm")
    with pytest.raises(InputError, match=r"^f.csv: is not UTF-8 text \(byte 5"):
        parse_transforms(b"bone,\xff", source="f.csv", units=Unit.METRE)
    with pytest.raises(InputError, match=r"^f.json: is not valid JSON"):
        read("{", "f.json")


leaves = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3)


@settings(suppress_health_check=[HealthCheck.too_slow])  # drawing is slow on a busy machine, and that is no fault
@given(
    entries=st.lists(
        st.dictionaries(
            st.sampled_from(["bone", "time_s", "matrix", "quaternion_wxyz", "translation_mm"]),
            leaves | st.lists(leaves, min_size=3, max_size=4) | st.just(MATRIX) | st.just(WXYZ),
        ),
        max_size=3,
    )
)
def test_whatever_stands_in_a_file_gives_transforms_or_an_error_that_names_it(entries: list[Any]) -> None:
    message = "f.json: "
    try:
        read(json.dumps({"transforms": entries}), "f.json")
    except InputError as error:
        message = str(error)
    assert message.startswith("f.json: ")


# --- rigs


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    path = write_tiny_rig(tmp_path / "rig")
    drive_by(path, 'kind = "transforms"\ntransforms = "moved.json"\nlandmarks_per_bone = 6')
    identity = RigidMotion.identity()
    poses = {0.0: {"bone_proximal": identity, "bone_distal": identity}}
    poses[1.0] = {"bone_proximal": identity, "bone_distal": about_z(40.0)}
    path.with_name("moved.json").write_text(transforms_text(poses), encoding="utf-8")
    return path


def about_z(degrees: float) -> RigidMotion:
    return RigidMotion.about_axis(centre=np.zeros(3), axis=np.array([0.0, 0.0, 1.0]), angle_deg=degrees)


def test_a_rig_of_transforms_becomes_a_job(rig: Path) -> None:
    job = read_rig(rig)
    assert job.rig.deformer.path is PathKind.CHAIN
    assert job.joints is None
    assert job.findings == ()
    assert isinstance(job.path, BonePath)
    assert job.motions is not None
    assert set(job.hashes) >= {"moved.json"}
    assert job.handles.owner == ("bone_proximal",) * 6 + ("bone_distal",) * 6
    same(job.motions.at(0.5)["bone_distal"], about_z(20.0))
    np.testing.assert_allclose(job.path.position(0.25)[6:], about_z(10.0)(job.handles.source[6:]), rtol=0, atol=1e-12)
    straight = read_rig(rig, overrides=["deformer.path=straight"])
    assert isinstance(straight.path, StraightPath)
    np.testing.assert_allclose(straight.path.position(1.0), job.path.position(1.0), rtol=0, atol=1e-12)


def test_a_run_takes_the_last_time_or_another_and_its_reference(rig: Path) -> None:
    for overrides, degrees in (
        ((), 40.0),
        (("drive.time_s=0.5",), 20.0),
        (("drive.reference_time_s=1", "drive.time_s=0"), -40.0),
        (("drive.reference_time_s=0.25",), 30.0),
    ):
        job = read_rig(rig, overrides=overrides)
        assert job.motions is not None
        same(job.motions.at(1.0)["bone_distal"], about_z(degrees))


def test_landmarks_of_a_file_are_carried_by_their_bones(rig: Path) -> None:
    text = "name,bone,x,y,z\na,bone_distal,1,0,0\nb,bone_distal,2,0,0\n"
    rig.with_name("marks.csv").write_text(text, encoding="utf-8")
    drive_by(rig, 'kind = "transforms"\ntransforms = "moved.json"\nlandmarks = "marks.csv"\nunits = "cm"')
    job = read_rig(rig)
    np.testing.assert_allclose(job.path.position(1.0), about_z(40.0)(np.array([[10.0, 0, 0], [20, 0, 0]])), atol=1e-12)
    rig.with_name("marks.csv").write_text(text.replace("bone_distal", "bone_dital"), encoding="utf-8")
    with pytest.raises(LandmarkError, match=r"'bone_dital', which no transform moves or fixes; did you mean 'bone_dis"):
        read_rig(rig)
    rig.with_name("marks.csv").write_text("name,x,y,z\na,1,0,0\n", encoding="utf-8")
    with pytest.raises(LandmarkError, match=r"'a' names no bone; transforms move bones, so give it one"):
        read_rig(rig)


def test_bones_without_a_transform_are_named(rig: Path) -> None:
    rig.with_name("moved.json").write_text(transforms_text({"bone_distal": about_z(5.0)}), encoding="utf-8")
    (finding,) = read_rig(rig).findings
    assert finding.code == "bone-without-transform"
    assert finding.message == "1 bones have no transform and follow the soft tissue: bone_proximal"


def test_frames_of_transforms_and_anatomy_must_agree(rig: Path) -> None:
    moved = rig.with_name("moved.json")
    moved.write_text(json.dumps({"frame": "RAS"} | json.loads(moved.read_text())), encoding="utf-8")
    assert [f.code for f in read_rig(rig).findings] == ["frame-not-stated"]
    assert read_rig(rig, overrides=['anatomy.frame="RAS"']).findings == ()
    with pytest.raises(LandmarkError, match=r"drive: the transforms are in RAS, but the anatomy's frame is 'LPS'"):
        read_rig(rig, overrides=['anatomy.frame="LPS"'])


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("drive.time_s=2", r"drive.time_s: .*moved.json: asked for 2 s; its bones are known from 0 to 1 s"),
        ("drive.reference_time_s=-1", r"drive.reference_time_s: .*moved.json: asked for -1 s"),
        ("drive.time_s=nan", r"drive.time_s: found nan; expected a finite"),
        ("drive.frames=1", r"drive.frames: found 1; expected at least 2, or 0 for the file's own times"),
        ("drive.landmarks_per_bone=0", r"drive.landmarks_per_bone: found 0"),
        ("drive.landmarks_per_bone=2147483648", r"2147483648 landmarks do not fit on a surface with \d+ vertices"),
        ("drive.carried.bone_distal=[]", r"drive.carried.bone_distal: is an empty list"),
        ("deformer.path=joints", r'deformer.path: found "joints", but no joint drives this rig'),
        ("drive.pose.elbow_deg=3", r'drive.pose: belongs to kind "joints", but the kind is "transforms"'),
        ("bones.rigid=true", r'bones.rigid: bones move rigidly: write deformer.path = "chain", step = "cayley"'),
    ],
)
def test_settings_that_do_not_fit_are_refused(rig: Path, override: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        read_rig(rig, overrides=[override])


CARRIED = 'kind = "transforms"\ntransforms = "moved.json"\ncarried = { bone_distal = ["bone_*"] }\ntime_s = 0.5'


def test_bones_that_are_carried_move_with_their_carrier(rig: Path) -> None:
    (rig.parent / "anatomy" / "bone_hand.ply").write_bytes(ply_bytes(egg((50, 0, 0), (4, 4, 4))))
    drive_by(rig, CARRIED)
    job = read_rig(rig)
    assert job.findings == ()
    assert job.motions is not None
    assert job.transforms is not None
    for bone in ("bone_distal", "bone_hand"):
        same(job.motions.at(1.0)[bone], about_z(20.0))
        same(job.transforms.at(1.0)[bone], about_z(40.0))
    same(job.motions.at(1.0)["bone_proximal"], RigidMotion.identity())
    assert set(job.handles.owner) == {"bone_proximal", "bone_distal", "bone_hand"}
    for table, words in (
        ('{ bone_dital = ["bone_hand"] }', r"'bone_dital' has no motion of its own .*did you mean 'bone_distal'"),
        ('{ bone_distal = ["hand*"] }', r"bone_distal: 'hand\*' fits no bone; .*known: bone_distal, bone_hand"),
        (
            '{ bone_distal = ["bone_hand"], bone_proximal = ["*hand"] }',
            r"bone 'bone_hand' moves with 'bone_distal' and with 'bone_proximal'; name one carrier",
        ),
        ("{ bone_distal = [] }", r"drive.carried.bone_distal: is an empty list"),
        ('{ bone_distal = "bone_hand" }', r"drive.carried.bone_distal: found the text 'bone_hand'"),
    ):
        drive_by(rig, CARRIED.replace('{ bone_distal = ["bone_*"] }', table))
        with pytest.raises(RigError, match=rf"tiny.toml: drive.carried.*{words}|tiny.toml: {words}"):
            read_rig(rig)


# --- rigid bones from landmarks

RIGID = ("bones.rigid=true", "deformer.step=cayley", "deformer.kernel=isochoric-r3")


def test_landmarks_of_rigid_bones_become_motions(tmp_path: Path) -> None:
    path = write_tiny_rig(tmp_path / "rig")
    marks = path.with_name("landmarks.csv")
    rows = marks.read_text(encoding="utf-8").splitlines()
    cells = rows[1].split(",")
    cells[5] = repr(float(cells[5]) + 0.6)  # one landmark of six is sent 0.6 mm off
    marks.write_text("\n".join([rows[0], ",".join(cells), *rows[2:], "free,,0,13,0,0,14,0"]) + "\n", encoding="utf-8")
    job = read_rig(path, overrides=RIGID)
    assert job.rig.deformer.path is PathKind.CHAIN
    assert isinstance(job.path, RigidPath)
    assert job.motions is not None
    same(job.motions.at(1.0)["bone_distal"], about_z(25.0))
    assert [f.code for f in job.findings] == ["bone-fit", "bone-fit"]
    moved = job.path.position(1.0)
    np.testing.assert_array_equal(moved[-1], [0.0, 14.0, 0.0])
    motion = job.motions.at(1.0)["bone_proximal"]
    np.testing.assert_allclose(moved[:6], motion(job.handles.source[:6]), rtol=0, atol=1e-12)
    target = np.array([[float(x) for x in row.split(",")[5:]] for row in [",".join(cells), *rows[2:7]]])
    missed = np.linalg.norm(moved[:6] - target, axis=1)
    assert 0.1 < missed.max() < 0.6
    assert f"{missed.max():.3g} mm at most (bone_proximal_0)" in job.findings[0].message
    plain = read_rig(path)
    assert plain.motions is None
    assert isinstance(plain.path, StraightPath)


def test_pairs_of_a_rig_that_are_a_mirror_image_are_refused_by_its_name(tmp_path: Path) -> None:
    path = write_tiny_rig(tmp_path / "rig")
    marks = path.with_name("landmarks.csv")
    head = marks.read_text(encoding="utf-8").splitlines()[0]
    places = np.random.default_rng(2).uniform(-9.0, 9.0, (8, 3)).tolist()
    rows = [f"p{k},,{x},{y},{z},{x + 1.0},{-y},{z}" for k, (x, y, z) in enumerate(places)]
    marks.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    with pytest.raises(LandmarkError, match=r"tiny.toml: drive: the targets are a mirror image of the landmarks"):
        read_rig(path)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (["bone_distal_0", "bone_distal_1"], r"the 2 landmarks of bone 'bone_distal' .*leave its turn free"),
        (["bone_distal_0", "bone_distal_3"], r"the 2 landmarks of bone 'bone_distal'"),
        ([], r"bones.rigid: no landmark names its bone"),
    ],
)
def test_landmarks_that_fix_no_rigid_bone_are_refused(tmp_path: Path, rows: list[str], words: str) -> None:
    path = write_tiny_rig(tmp_path / "rig")
    marks = path.with_name("landmarks.csv")
    lines = marks.read_text(encoding="utf-8").splitlines()
    kept = [line for line in lines[1:] if line.split(",")[0] in rows]
    kept = kept or [re.sub(r",bone_\w+,", ",,", line) for line in lines[1:]]
    marks.write_text("\n".join([lines[0], *kept]) + "\n", encoding="utf-8")
    with pytest.raises(LandmarkError, match=rf"tiny.toml: drive: .*{words}"):
        read_rig(path, overrides=RIGID)


def test_bones_that_own_no_landmark_are_named(tmp_path: Path) -> None:
    path = write_tiny_rig(tmp_path / "rig")
    marks = path.with_name("landmarks.csv")
    lines = marks.read_text(encoding="utf-8").splitlines()
    marks.write_text("\n".join(line for line in lines if "bone_proximal_" not in line) + "\n", encoding="utf-8")
    messages = [f.message for f in read_rig(path, overrides=RIGID).findings]
    assert "1 bones own no landmark and follow the soft tissue: bone_proximal" in messages


def test_landmarks_carry_other_bones_too(tmp_path: Path) -> None:
    path = write_tiny_rig(tmp_path / "rig")
    (path.parent / "anatomy" / "bone_hand.ply").write_bytes(ply_bytes(egg((50, 0, 0), (4, 4, 4))))
    override = 'drive.carried.bone_distal=["bone_hand"]'
    job = read_rig(path, overrides=[*RIGID, override])
    assert job.motions is not None
    same(job.motions.at(1.0)["bone_hand"], about_z(25.0))
    assert [finding.code for finding in job.findings] == ["bone-fit", "bone-fit"]
    with pytest.raises(RigError, match=r"drive.carried: has no effect where landmarks move no rigid bone"):
        read_rig(path, overrides=[override])


def test_other_drives_say_no_rigid_motion(tmp_path: Path) -> None:
    path = write_tiny_rig(tmp_path / "rig")
    drive_by(path, 'kind = "cage"\nsource = "anatomy/skin.ply"\ntarget = "anatomy/skin.ply"')
    with pytest.raises(
        RigError, match=r"bones.rigid: nothing says how bones move rigidly; use a \[drive\] of joints, of"
    ):
        read_rig(path, overrides=RIGID)
