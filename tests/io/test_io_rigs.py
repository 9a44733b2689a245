"""Reading rigs: what a job holds, and that every wrong file or value is refused early, by name."""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from musclefit.anatomy.model import TissueKind
from musclefit.errors import InputError, LandmarkError, MeshError, RigError
from musclefit.io.drives import JointDrive
from musclefit.io.named_files import resolve_data
from musclefit.io.rigs import builtin_rig_path, builtin_rigs, find_rig, read_rig
from musclefit.rig import settings as model
from musclefit.rig.drive import DRIVES
from musclefit.rig.handles import BonePath, StraightPath
from musclefit.rig.joints import parse_joints
from musclefit.rig.rig_table import known_keys, parse_rig

RIGS = Path(__file__).resolve().parents[2] / "rigs"

JOINT_RIG = """
title = "Two bones"
[anatomy]
folder = "tissues"
[drive]
kind = "joints"
joints = "joints.json"
pose = { hinge_deg = 90 }
landmarks_per_bone = 4
[deformer]
path = "joints"
"""
PAIR_RIG = """
title = "Pairs"
[anatomy]
folder = "tissues"
[drive]
kind = "landmarks"
source = "pairs.csv"
"""
CAGE_RIG = """
title = "Cage"
[anatomy]
folder = "tissues"
[drive]
kind = "cage"
source = "cage.ply"
target = "cage2.ply"
"""
JOINTS = {
    "units": "mm, degrees",
    "hinge": {"centre_mm": [50, 0, 0], "axis": [0, 0, 1], "fixed": ["bone_a"], "moving": ["bone_b"]},
}
PAIRS = """name,x_mm,y_mm,z_mm,target_x_mm,target_y_mm,target_z_mm
p1,0,0,0,0,0,10
p2,40,0,0,40,0,10
p3,0,20,0,0,20,10
p4,60,0,20,60,0,30
"""
BONES = """name,bone,x_mm,y_mm,z_mm
a1,bone_a,0,0,0
a2,bone_a,40,0,0
b1,bone_b,60,0,0
b2,bone_b,100,20,0
"""


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (8, 3) and outward faces (12, 3) of a box."""
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    return np.asarray(low) + corners * (np.asarray(high) - np.asarray(low)), faces


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    lines = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(vertices)}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        *(" ".join(repr(float(x)) for x in vertex) for vertex in vertices),
        *("3 " + " ".join(map(str, face)) for face in faces),
    ]
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two bones end to end and a muscle above them, joints, landmarks, cages and three rigs."""
    tissues = tmp_path / "tissues"
    tissues.mkdir()
    write_ply(tissues / "bone_a.ply", *box((0, 0, 0), (40, 20, 20)))
    write_ply(tissues / "bone_b.ply", *box((60, 0, 0), (100, 20, 20)))
    write_ply(tissues / "muscle_c.ply", *box((10, 0, 25), (90, 20, 35)))
    vertices, faces = box((-20, -20, -20), (120, 40, 60))
    write_ply(tmp_path / "cage.ply", vertices, faces)
    write_ply(tmp_path / "cage2.ply", 1.1 * vertices, faces)
    (tmp_path / "joints.json").write_text(json.dumps(JOINTS))
    (tmp_path / "pairs.csv").write_text(PAIRS)
    (tmp_path / "bones.csv").write_text(BONES)
    for name, text in {"joint": JOINT_RIG, "pair": PAIR_RIG, "cage": CAGE_RIG}.items():
        (tmp_path / f"{name}.toml").write_text(text)
    return tmp_path


def test_a_joint_rig_becomes_a_job(folder: Path) -> None:
    job = read_rig(folder / "joint.toml")
    assert job.name == "joint"
    assert job.source == str(folder / "joint.toml")
    assert [t.name for t in job.anatomy] == ["muscle_c", "bone_a", "bone_b"]
    assert job.handles.names == tuple(f"bone_{b}_{k}" for b in "ab" for k in (1, 2, 3, 4))
    assert job.handles.owner == ("bone_a",) * 4 + ("bone_b",) * 4
    for owner, place in zip(job.handles.owner, job.handles.source, strict=True):
        assert (job.anatomy[owner].surface.vertices == place).all(axis=1).any()
    assert isinstance(job.path, BonePath)
    assert job.motions is not None
    assert job.joints is not None
    np.testing.assert_array_equal(job.path.position(0.0), job.handles.source)
    x, y, z = job.handles.source[4:].T
    moved = np.stack([50.0 - y, x - 50.0, z], axis=1)  # a quarter turn about (50, 0)
    np.testing.assert_allclose(job.path.position(1.0)[4:], moved, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(job.path.position(1.0)[:4], job.handles.source[:4])
    assert isinstance(job.rig.drive, JointDrive)
    assert job.rig.drive.joints == str(folder / "joints.json")
    assert job.rig.anatomy.folder == str(folder / "tissues")


def test_straight_paths_of_joints_end_where_the_bones_do(folder: Path) -> None:
    carried = read_rig(folder / "joint.toml")
    straight = read_rig(folder / "joint.toml", overrides=["deformer.path=straight"])
    assert isinstance(straight.path, StraightPath)
    assert straight.motions is not None
    np.testing.assert_array_equal(straight.path.position(1.0), carried.path.position(1.0))
    middle = 0.5 * (straight.handles.source + straight.path.position(1.0))
    np.testing.assert_allclose(straight.path.position(0.5), middle, rtol=0, atol=1e-12)


def test_every_file_that_was_read_is_hashed(folder: Path) -> None:
    job = read_rig(folder / "joint.toml")
    expected = {"joint.toml": folder / "joint.toml", "joints.json": folder / "joints.json"}
    expected |= {path.name: path for path in (folder / "tissues").iterdir()}
    expected = {f"tissues/{name}" if name.endswith(".ply") else name: path for name, path in expected.items()}
    assert job.hashes == {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in expected.items()}
    assert set(read_rig(folder / "pair.toml").hashes) > {"pair.toml", "pairs.csv"}
    assert set(read_rig(folder / "cage.toml").hashes) > {"cage.toml", "cage.ply", "cage2.ply"}


def test_overrides_change_the_rig_and_are_kept(folder: Path) -> None:
    overrides = ("deformer.kernel=r3", "drive.pose.hinge_deg=45")
    job = read_rig(folder / "joint.toml", overrides=overrides)
    assert job.rig.deformer.kernel == "r3"
    assert isinstance(job.rig.drive, JointDrive)
    assert job.rig.drive.pose == (("hinge", 45.0),)
    assert job.overrides == overrides


def test_landmarks_on_bones_are_read(folder: Path) -> None:
    text = JOINT_RIG.replace("landmarks_per_bone = 4", 'landmarks = "bones.csv"')
    (folder / "joint.toml").write_text(text)
    job = read_rig(folder / "joint.toml")
    assert job.handles.names == ("a1", "a2", "b1", "b2")
    np.testing.assert_allclose(job.path.position(1.0)[2], [50, 10, 0], rtol=0, atol=1e-10)


def test_landmark_pairs_become_straight_lines(folder: Path) -> None:
    job = read_rig(folder / "pair.toml")
    assert isinstance(job.path, StraightPath)
    assert job.motions is None
    assert job.joints is None
    np.testing.assert_array_equal(job.path.position(1.0) - job.handles.source, [[0, 0, 10]] * 4)


def test_a_cage_becomes_handles(folder: Path) -> None:
    job = read_rig(folder / "cage.toml")
    assert len(job.handles) == 8
    assert job.handles.names[3] == "cage_3"
    np.testing.assert_allclose(job.path.position(1.0), 1.1 * job.handles.source, rtol=1e-15, atol=0)


def test_files_may_be_named_one_by_one_and_kinds_set(folder: Path) -> None:
    text = PAIR_RIG.replace(
        'folder = "tissues"', 'files = ["tissues/bone_*.ply", "tissues/muscle_c.ply"]\nkinds = { muscle_c = "other" }'
    )
    (folder / "pair.toml").write_text(text)
    assert read_rig(folder / "pair.toml").anatomy["muscle_c"].kind is TissueKind.OTHER


def test_units_of_landmarks_and_anatomy_are_converted(folder: Path) -> None:
    vertices, faces = box((-0.02, -0.02, -0.02), (0.12, 0.04, 0.06))
    write_ply(folder / "cage.ply", vertices, faces)
    write_ply(folder / "cage2.ply", vertices, faces)
    job = read_rig(folder / "cage.toml", overrides=["drive.units=m"])
    np.testing.assert_allclose(job.handles.source, 1000.0 * vertices, rtol=1e-12, atol=0)


def test_a_bone_that_no_joint_knows_is_a_finding(folder: Path) -> None:
    write_ply(folder / "tissues" / "bone_loose.ply", *box((0, 0, 50), (5, 5, 55)))
    overrides = ["deformer.method=yu2014"]
    found = [f for f in read_rig(folder / "joint.toml", overrides=overrides).findings if f.code == "bone-without-joint"]
    assert len(found) == 1
    assert "1 bones are neither fixed nor moved by a joint" in found[0].message
    assert "follow the soft tissue: bone_loose" in found[0].message


def test_a_rigid_bone_that_no_joint_knows_stays_where_it_is(folder: Path) -> None:
    write_ply(folder / "tissues" / "bone_loose.ply", *box((0, 0, 50), (5, 5, 55)))
    rigid = ("deformer.path=joints", "deformer.kernel=isochoric-r3", "deformer.step=cayley", "bones.rigid=true")
    job = read_rig(folder / "joint.toml", overrides=rigid)
    (found,) = [f for f in job.findings if f.code == "bone-without-joint"]
    assert found.message.endswith("stay where they are: bone_loose")
    assert job.motions is not None
    assert job.joints is not None
    for motion in (job.motions.at(0.5)["bone_loose"], job.joints.motions({})["bone_loose"]):
        np.testing.assert_array_equal(motion(np.eye(3)), np.eye(3))
    assert "bone_loose" in job.handles.owner


def test_frames_that_landmarks_and_anatomy_state_must_agree(folder: Path) -> None:
    for name, shift in (("rest", 0.0), ("bent", 5.0)):
        points = [{"label": f"p{k}", "position": [20.0 * k, 5.0 * k * k, 10.0 + shift]} for k in range(4)]
        markup = {"type": "Fiducial", "coordinateSystem": "RAS", "controlPoints": points}
        (folder / f"{name}.mrk.json").write_text(json.dumps({"markups": [markup]}))
    overrides = ["drive.source=rest.mrk.json", "drive.target=bent.mrk.json"]
    job = read_rig(folder / "pair.toml", overrides=overrides)
    assert [f.code for f in job.findings] == ["frame-not-stated"]
    assert "the landmarks are in RAS, the anatomy's frame is 'as in the files'" in job.findings[0].message
    agreed = read_rig(folder / "pair.toml", overrides=[*overrides, "anatomy.frame=patient (RAS)"])
    assert agreed.findings == ()
    np.testing.assert_array_equal(agreed.path.position(1.0) - agreed.handles.source, [[0.0, 0.0, 5.0]] * 4)
    with pytest.raises(
        LandmarkError, match=r"the landmarks are in RAS, but the anatomy's frame is 'patient \(LPS\)': x and y have opp"
    ):
        read_rig(folder / "pair.toml", overrides=[*overrides, "anatomy.frame=patient (LPS)"])


def _edit(name: str, old: str, new: str) -> Any:
    def apply(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new))

    return apply


def _write(name: str, data: str | bytes) -> Any:
    def apply(folder: Path) -> None:
        (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())

    return apply


def _joints(**hinge: Any) -> Any:
    return _write("joints.json", json.dumps(JOINTS | {"hinge": JOINTS["hinge"] | hinge}))  # type: ignore[operator]


def _with_bone_landmarks(text: str) -> Any:
    def apply(folder: Path) -> None:
        (folder / "bones.csv").write_text(text)
        _edit("joint.toml", "landmarks_per_bone = 4", 'landmarks = "bones.csv"')(folder)

    return apply


def _cage2(vertices: np.ndarray, faces: np.ndarray) -> Any:
    return lambda folder: write_ply(folder / "cage2.ply", vertices, faces)


CAGE = box((-20, -20, -20), (120, 40, 60))
TURNED = CAGE[1].copy()
TURNED[3] = TURNED[3][[1, 2, 0]]
SHORTER = CAGE[1][:-1]

BAD: dict[str, tuple[str, Any, type[InputError], str]] = {
    "broken TOML": ("joint", _write("joint.toml", "title = \n"), RigError, r"joint.toml: is not valid TOML: .*line 1"),
    "a key twice": (
        "joint",
        _edit("joint.toml", "[deformer]", '[deformer]\nkernel = "r"\nkernel = "r3"'),
        RigError,
        r"joint.toml: is not valid TOML: .*line 12",
    ),
    "no text": ("joint", _write("joint.toml", b"title = '\xff'"), RigError, r"joint.toml: is not UTF-8 text \(byte 9"),
    "too deep": (
        "joint",
        _write("joint.toml", "title = " + "[" * 100_000),
        RigError,
        r"joint.toml: is nested too deeply|joint.toml: is not valid TOML",
    ),
    "too many digits": (
        "joint",
        _write("joint.toml", "title = " + "1" * 9_999),
        RigError,
        "joint.toml: cannot be read",
    ),
    "unknown key": (
        "joint",
        _edit("joint.toml", "landmarks_per_bone", "landmarks_pro_bone"),
        RigError,
        r"joint.toml: drive.landmarks_pro_bone: unknown key; did you mean 'landmarks_per_bone'\?",
    ),
    "no folder": (
        "joint",
        _edit("joint.toml", '"tissues"', '"tissue"'),
        RigError,
        r"joint.toml: anatomy.folder: .*/tissue does not exist \(written as 'tissue'; correct the path; relative ones",
    ),
    "no joints": (
        "joint",
        _edit("joint.toml", "joints.json", "../joints.json"),
        RigError,
        r"joint.toml: drive.joints: .*/joints.json does not exist \(written as '../joints.json'",
    ),
    "no landmarks": (
        "pair",
        _edit("pair.toml", "pairs.csv", "pears.csv"),
        RigError,
        r"pair.toml: drive.source: .*pears.csv does not exist",
    ),
    "no cage": ("cage", _edit("cage.toml", "cage2", "cage3"), RigError, r"cage.toml: drive.target: .*does not exist"),
    "joints are a folder": (
        "joint",
        _edit("joint.toml", "joints.json", "tissues"),
        RigError,
        r"joint.toml: drive.joints: .*tissues cannot be read",
    ),
    "another variable": (
        "joint",
        _edit("joint.toml", '"tissues"', '"${HOME}/tissues"'),
        RigError,
        r"joint.toml: anatomy.folder: found '\$\{HOME\}/tissues'; only \$\{MUSCLEFIT_DATA\} at the start",
    ),
    "no such built-in": (
        "joint",
        _edit("joint.toml", 'folder = "tissues"', 'builtin = "uper_limb"'),
        RigError,
        r"joint.toml: anatomy.builtin: found 'uper_limb'; did you mean 'upper_limb'\? known: upper_limb",
    ),
    "no kind of file": (
        "joint",
        _edit("joint.toml", "joints.json", "bones.csv"),
        RigError,
        r"bones.csv: has suffix '.csv'; expected .json or .toml",
    ),
    "broken JSON": (
        "joint",
        _write("joints.json", '{"units": "mm",\n}'),
        RigError,
        r"joints.json: is not valid JSON: .*\(at line 2, column 1\)|joints.json: is not valid JSON",
    ),
    "JSON key twice": (
        "joint",
        _write("joints.json", '{"units": "mm", "units": "m"}'),
        RigError,
        r"joints.json: units: stands twice in one object; remove one",
    ),
    "JSON list": (
        "joint",
        _write("joints.json", "[]"),
        RigError,
        r"joints.json: holds list at its top; expected an obj",
    ),
    "JSON nan": (
        "joint",
        _joints(centre_mm=[float("nan"), 0, 0]),
        RigError,
        r"joints.json: hinge.centre_mm: holds nan",
    ),
    "zero axis": ("joint", _joints(axis=[0, 0, 0]), RigError, r"joints.json: hinge.axis: found \[0.0, 0.0, 0.0\]"),
    "unknown bone": (
        "joint",
        _joints(moving=["bone_bb"]),
        RigError,
        r"joint.toml: drive.joints: .*hinge.moving: the anatomy has no bone 'bone_bb'; did you mean 'bone_b'\?",
    ),
    "a muscle is not a bone": (
        "joint",
        _joints(moving=["muscle_c"]),
        RigError,
        r"the anatomy has no bone 'muscle_c'; known: bone_a, bone_b",
    ),
    "unknown joint": (
        "joint",
        _edit("joint.toml", "hinge_deg", "hinges_deg"),
        RigError,
        r"joint.toml: drive.pose: pose of 'hinges': no such joint in .*joints.json; did you mean 'hinge'\?",
    ),
    "beyond the limits": (
        "joint",
        _joints(limits_deg=[0, 80]),
        RigError,
        r"joint.toml: drive.pose: pose of 'hinge': found 90 degrees, but limits_deg in .* is \[0, 80\]",
    ),
    "joints' path of pairs": (
        "pair",
        lambda folder: (folder / "pair.toml").write_text(PAIR_RIG + '[deformer]\npath = "joints"'),
        RigError,
        r'pair.toml: deformer.path: found "joints", but no joint drives this rig',
    ),
    "two at one place": (
        "pair",
        _edit("pairs.csv", "p2,40,0,0", "p2,0,0,1e-7"),
        LandmarkError,
        r"pair.toml: .*landmarks 'p1' and 'p2' stand at one place, \(0, 0, 0\) mm, 1e-07 mm apart; remove or correct",
    ),
    "two sent to one place": (
        "pair",
        _edit("pairs.csv", "40,0,10", "0,0,10"),
        LandmarkError,
        r"pair.toml: drive.source: .*landmarks 'p1' and 'p2' are sent to one place, \(0, 0, 10\) mm",
    ),
    "far away": (
        "pair",
        _edit("pairs.csv", "p4,60,0,20", "p4,60,0,2000"),
        LandmarkError,
        r"pair.toml: drive: landmark 'p4' at \(60, 0, 2000\) mm is 1965 mm outside .*likely wrong units",
    ),
    "metres": (
        "pair",
        _write(
            "pairs.csv",
            PAIRS.splitlines()[0] + "\np1,0,0,0,0,0,0\np2,0.04,0,0,0.04,0,0\np3,0,0.02,0,0,0.02,0\n",
        ),
        LandmarkError,
        r"pair.toml: drive: the 3 landmarks span 0.04472 mm of an anatomy with a diagonal of 107.8 mm; likely",
    ),
    "no targets": (
        "pair",
        _edit("pair.toml", "pairs.csv", "bones.csv"),
        LandmarkError,
        r"pair.toml: .*bones.csv has no target columns .*; add them, .*or name a second file in drive.target",
    ),
    "targets of bones": (
        "joint",
        _with_bone_landmarks(PAIRS),
        LandmarkError,
        r"joint.toml: drive.landmarks: .*bones.csv has target columns, but the joints say where landmarks go",
    ),
    "no bone": (
        "joint",
        _with_bone_landmarks("name,x_mm,y_mm,z_mm\nq,0,0,0\n"),
        LandmarkError,
        r"joint.toml: drive: landmark 'q' names no bone; joints move bones, so give it one",
    ),
    "bone of no joint": (
        "joint",
        _with_bone_landmarks(BONES.replace("a2,bone_a", "a2,bone_A")),
        LandmarkError,
        r"joint.toml: drive: landmark 'a2' belongs to bone 'bone_A', which no joint moves or fixes; did you mean",
    ),
    "too many per bone": (
        "joint",
        _edit("joint.toml", "per_bone = 4", "per_bone = 9"),
        LandmarkError,
        r"joint.toml: drive: bone 'bone_a': 9 landmarks do not fit on a surface with 8 vertices; ask",
    ),
    "cages of other counts": (
        "cage",
        _cage2(np.vstack([CAGE[0], [[0, 0, 0]]]), CAGE[1]),
        MeshError,
        r"cage.toml: drive.target: the source cage has 8 vertices, the target cage 9; both must have the same",
    ),
    "cages of fewer triangles": (
        "cage",
        _cage2(CAGE[0], SHORTER),
        MeshError,
        r"cage.toml: drive.target: the source cage has 12 triangles, the target cage 11",
    ),
    "cages of other triangles": (
        "cage",
        _cage2(CAGE[0], TURNED),
        MeshError,
        r"cage.toml: drive.target: 1 of 12 triangles of the two cages differ; the first is number 3: \[",
    ),
    "a collapsed cage": (
        "cage",
        _cage2(0.0 * CAGE[0], CAGE[1]),
        LandmarkError,
        r"cage.toml: drive: landmarks 'cage_0' and 'cage_\d' are sent to one place",
    ),
    "an STL cage": (
        "cage",
        lambda folder: (
            (folder / "cage.stl").write_bytes(bytes(80) + (1).to_bytes(4, "little") + bytes(50)),
            _edit("cage.toml", "cage.ply", "cage.stl")(folder),
        ),
        MeshError,
        r"cage.toml: drive.source: .*cage.stl: in STL every triangle has its own vertices; give the cage as PLY or OBJ",
    ),
    "a torn tissue": (
        "joint",
        lambda folder: write_ply(folder / "tissues" / "bone_b.ply", CAGE[0], SHORTER),
        MeshError,
        r"joint.toml: anatomy: .*bone_b",
    ),
    "no bones at all": (
        "joint",
        _edit("joint.toml", "[drive]", '[anatomy.kinds]\n"*" = "other"\n[drive]'),
        RigError,
        r"joint.toml: drive.joints: .*joints move bones, but the anatomy has none; set kinds in \[anatomy.kinds\]",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_refused_by_name(folder: Path, case: str) -> None:
    rig, spoil, error, message = BAD[case]
    spoil(folder)
    with pytest.raises(error, match=message) as caught:
        read_rig(folder / f"{rig}.toml")
    assert type(caught.value) is error
    assert str(caught.value).startswith(str(folder))


def test_a_rig_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(RigError, match=r"none.toml: no such rig file; give a path"):
        read_rig(tmp_path / "none.toml")


def test_the_pose_is_refused_before_the_anatomy_is_read(folder: Path) -> None:
    (folder / "tissues" / "bone_a.ply").write_text("no surface")
    _edit("joint.toml", "hinge_deg", "hip_deg")(folder)
    with pytest.raises(RigError, match=r"drive.pose: pose of 'hip'"):
        read_rig(folder / "joint.toml")


def test_the_data_variable_is_expanded(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = "${MUSCLEFIT_DATA}/tissues"
    monkeypatch.setenv("MUSCLEFIT_DATA", str(folder))
    assert resolve_data(text, folder=folder / "deep", source="r.toml", key="k") == folder / "tissues"
    monkeypatch.setenv("MUSCLEFIT_DATA", str(folder / "nowhere"))
    with pytest.raises(
        RigError,
        match=r"r.toml: k: no data folder: the environment variable MUSCLEFIT_DATA is set to .*/nowhere, which",
    ):
        resolve_data(text, folder=folder, source="r.toml", key="k")
    monkeypatch.setenv("MUSCLEFIT_DATA", str(folder))
    with pytest.raises(RigError, match=r"r.toml: k: .*/leg does not exist .*MUSCLEFIT_DATA is set to"):
        resolve_data("${MUSCLEFIT_DATA}/leg", folder=folder, source="r.toml", key="k")
    with pytest.raises(RigError, match=r"only \$\{MUSCLEFIT_DATA\} at the start"):
        resolve_data("x/${MUSCLEFIT_DATA}", folder=folder, source="r.toml", key="k")


def test_without_the_variable_the_data_folder_lies_beside_the_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MUSCLEFIT_DATA", raising=False)
    rigs = tmp_path / "project" / "rigs"
    rigs.mkdir(parents=True)
    with pytest.raises(RigError, match=rf"MUSCLEFIT_DATA is not set, so .* in {re.escape(str(tmp_path))}/shared/data,"):
        resolve_data("${MUSCLEFIT_DATA}", folder=rigs, source="r.toml", key="k")
    (tmp_path / "shared" / "data").mkdir(parents=True)
    found = resolve_data("${MUSCLEFIT_DATA}", folder=rigs, source="r.toml", key="k")
    assert found == tmp_path / "shared" / "data"


def test_rigs_are_found_by_name_and_by_path(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert {"upper_limb", "forearm"} <= set(builtin_rigs())
    assert find_rig("forearm") == builtin_rig_path("forearm")
    assert find_rig("forearm").is_file()
    assert find_rig(str(folder / "joint.toml")) == folder / "joint.toml"
    monkeypatch.chdir(folder)
    assert find_rig("joint.toml") == Path("joint.toml")
    with pytest.raises(RigError, match=r"^no rig is named 'forarm'; did you mean 'forearm'\? known: .*upper_limb"):
        find_rig("forarm")
    with pytest.raises(RigError, match=r"^here/rig.toml: no such rig file; .*built-in rig: .*forearm, .*upper_limb"):
        find_rig("here/rig.toml")


def test_a_built_in_rig_is_read_by_its_name() -> None:
    named = read_rig("upper_limb")
    assert (named.name, named.source) == ("upper_limb", str(builtin_rig_path("upper_limb")))
    assert named.hashes == read_rig(builtin_rig_path("upper_limb")).hashes
    with pytest.raises(RigError, match=r"^no rig is named 'upper_lim'; did you mean 'upper_limb'"):
        read_rig("upper_lim")


@pytest.mark.parametrize("path", sorted(RIGS.glob("*.toml")), ids=lambda path: path.stem)
def test_every_rig_that_comes_along_is_valid(path: Path) -> None:
    rig = parse_rig(tomllib.loads(path.read_text()), source=path.name)
    assert rig.title


def test_a_job_is_titled_by_its_rig_and_its_pose() -> None:
    assert read_rig(builtin_rig_path("upper_limb")).title == "Built-in upper limb: elbow 75°, forearm 70°"
    other = read_rig(builtin_rig_path("upper_limb"), overrides=["drive.pose={ elbow_deg = 12.5 }"])
    assert other.title == "Built-in upper limb: elbow 12.5°"


@pytest.mark.parametrize("key", known_keys())
def test_every_key_has_a_line_in_the_readme_with_its_default(key: str) -> None:
    section, _, name = key.rpartition(".")
    records: dict[str, list[Any]] = {
        "anatomy": [model.AnatomySource],
        "drive": list(DRIVES.values()),
        "deformer": [model.DeformerSettings],
        "bones": [model.BoneSettings],
        "surfaces": [model.SurfaceSettings],
        "certificate": [model.CertificateSettings],
        "tets": [model.TetSettings],
        "mesh": [model.MeshSettings],
        "compare": [model.CompareSettings],
        "limits": [model.Limits],
    }
    rows = [line for line in (RIGS / "README.md").read_text().splitlines() if line.startswith(f"| `{key}` |")]
    owners = [f for record in records.get(section, []) for f in fields(record) if f.name == name]
    assert len(rows) == max(1, len(owners))
    stated = sorted(row.split("|")[3].strip(" `") for row in rows)
    defaults = sorted("" if f.default is MISSING else _as_toml(f.name, f.default) for f in owners) or [""]
    assert stated == defaults
    for row in rows:
        assert len(row.split("|")[4]) > 10


def _as_toml(name: str, value: Any) -> str:
    if value == ():
        return "{}" if name in ("kinds", "edge_length_mm", "envelope_mm", "carried", "pose") else "[]"
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return json.dumps(list(value))
    return f'"{value}"' if isinstance(value, str) else repr(value)


def test_the_joints_in_the_readme_are_read_as_they_stand() -> None:
    blocks = re.findall(r"```toml\n(.*?)```", (RIGS / "README.md").read_text(), flags=re.DOTALL)
    (example,) = [block for block in blocks if "centre_mm" in block]
    system = parse_joints(tomllib.loads(example), source="README.md")
    assert set(system.motions({"elbow": 75.0, "forearm": 70.0})) == {"humerus", "ulna", "radius", "hand", "sesamoid"}


@pytest.mark.anatomy
def test_the_real_forearm_is_read(anatomy_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUSCLEFIT_DATA", str(anatomy_data))
    job = read_rig(find_rig("forearm"))
    assert len(job.handles) == 35
    assert len(job.anatomy) == 70
    assert len(job.hashes) == 70 + 3
    assert not [f for f in job.findings if f.code == "bone-without-joint"]
    assert job.motions is not None
    moved = job.motions.at(1.0)
    for k, owner in enumerate(job.handles.owner):
        np.testing.assert_allclose(
            job.path.position(1.0)[k], moved[owner](job.handles.source[k : k + 1])[0], rtol=0, atol=1e-9
        )


@pytest.mark.anatomy
def test_real_landmarks_in_other_units_are_refused(
    anatomy_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUSCLEFIT_DATA", str(anatomy_data))
    text = (anatomy_data / "arm" / "landmarks_35.csv").read_text()
    (tmp_path / "landmarks.csv").write_text(text.replace("_mm", "_m"))
    overrides = [f'drive.landmarks="{tmp_path}/landmarks.csv"', "anatomy.kinds.skin=skin"]
    with pytest.raises(LandmarkError, match=r"forearm.toml: drive: landmark .* mm outside .*likely wrong units"):
        read_rig(find_rig("forearm"), overrides=overrides)


@pytest.mark.anatomy
def test_real_pairs_with_columns_of_their_own_are_read(anatomy_data: Path, tmp_path: Path) -> None:
    rig = tmp_path / "brain.toml"
    rig.write_text(
        f"""
title = "Child to adult"
[anatomy]
files = ["{anatomy_data}/brain/adult_white_matter.ply"]
[drive]
kind = "landmarks"
source = "{anatomy_data}/brain/landmarks_40.csv"
source_prefix = "adult_"
target_prefix = "child_"
"""
    )
    job = read_rig(rig)
    assert len(job.handles) == 40
    np.testing.assert_allclose(job.handles.source[0], [11.371, -36.05, 79.348], rtol=0, atol=1e-12)
    np.testing.assert_allclose(job.path.position(1.0)[0], [9.637, -28.895, 59.39], rtol=0, atol=1e-12)
