"""The sequence, fit-joint and joint-range commands: exit codes, what is written, messages for bad input."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import jsonschema
import pytest
import trimesh
from tiny_rigs import drive_by, drive_by_joints, write_tiny_rig

from musclefit.cli import main
from musclefit.figures.rendering import rendering_problem
from musclefit.report.schema import joint_range_schema

JOINTS_PATH = ("--set", "deformer.path=joints")


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    path = write_tiny_rig(tmp_path / "rig")
    drive_by_joints(path)
    path.with_name("bend.csv").write_text("time_s,elbow_deg\n0,0\n1,20\n", encoding="utf-8")
    return path


@pytest.mark.slow
def test_a_sequence_is_written_with_all_its_outputs(
    rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if rendering_problem():
        pytest.skip(rendering_problem())
    out = tmp_path / "out"
    motion = str(rig.with_name("bend.csv"))
    ended = main(["sequence", str(rig), motion, "--frames", "2", "-o", str(out), "--workers", "1", *JOINTS_PATH])
    assert ended == 0
    said = capsys.readouterr().out
    assert "passed: Four balls, bent" in said
    assert "2 of 2 frames made, 2 certified" in said
    written = {path.name for path in out.iterdir()}
    assert written >= {
        "frames",
        "between",
        "sequence.json",
        "sequence.pvd",
        "muscles.csv",
        "report.json",
        "report.html",
        "motion.glb",
        "motion.gif",
    }
    assert (out / "motion.gif").read_bytes().startswith(b"GIF89a")


def test_bad_input_ends_with_2_and_a_message(rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sequence", str(rig), "-o", str(tmp_path / "out"), "--quiet", *JOINTS_PATH]) == 2
    assert "drive.motion names no keyframes" in capsys.readouterr().err
    rig.with_name("far.csv").write_text("time_s,elbow_deg\n0,0\n1,90\n", encoding="utf-8")
    assert main(["sequence", str(rig), str(rig.with_name("far.csv")), "-o", str(tmp_path / "out"), "--quiet"]) == 2
    assert "limits_deg" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_transforms_are_their_own_motion(rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive_by(rig, 'kind = "transforms"\ntransforms = "moved.csv"\nlandmarks_per_bone = 6')
    still = "".join(f"bone_{end},0,1,0,0,0,0,0,0\n" for end in ("proximal", "distal"))
    turned = "bone_proximal,0.4,1,0,0,0,0,0,0\nbone_distal,0.4,0.9961947,0,0,0.0871557,0,0,0\n"
    text = f"bone,time_s,qw,qx,qy,qz,x_mm,y_mm,z_mm\n{still}{turned}"
    rig.with_name("moved.csv").write_text(text, encoding="utf-8")
    out, more = tmp_path / "out", ("--set", "certificate.enabled=false", "--no-pictures")
    assert main(["sequence", str(rig), "-o", str(out), "--workers", "1", *more]) == 0
    said = capsys.readouterr().out
    assert "transforms of 2 bones at 2 times, between them each bone on the screw" in said
    assert "2 of 2 frames made" in said
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Joint coordinates" not in page
    assert main(["sequence", str(rig), str(rig.with_name("bend.csv")), "-o", str(tmp_path / "new"), "--quiet"]) == 2
    assert "has no effect: the rig follows drive.transforms" in capsys.readouterr().err
    rig.with_name("moved.csv").write_text(text.replace(",time_s", "").replace(",0,1,", ",1,").replace(turned, ""))
    assert main(["sequence", str(rig), "-o", str(tmp_path / "new"), "--quiet"]) == 2
    assert "moved.csv: states no times, so there is one pose alone" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def write_roller_and_tube(roller: Path, tube: Path) -> None:
    trimesh.creation.cylinder(radius=10.0, height=30.0, sections=64).subdivide_to_size(4.0).export(roller)
    around = trimesh.creation.annulus(r_min=11.0, r_max=14.0, height=28.0, sections=64)
    around.subdivide_to_size(4.0).export(tube)


def test_a_joint_is_fitted_and_printed_as_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_roller_and_tube(tmp_path / "ulna.ply", tmp_path / "humerus.ply")
    assert main(["fit-joint", str(tmp_path / "humerus.ply"), str(tmp_path / "ulna.ply"), "--within-mm", "2"]) == 0
    said = capsys.readouterr().out
    assert 'fixed = ["humerus"]' in said
    assert "centre_mm = [" in said
    assert re.search(
        r"# uncertain by \d\.\d deg and 0\.\d\d mm \(patches drawn anew, and what the bones disagree\)\n", said
    )
    assert "# fixed bone: " in said
    axis = tomllib.loads(said)["joint"]["axis"]
    assert abs(axis[2]) > 0.999


def test_the_names_of_bones_say_the_kind(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The two halves of a roller are one bone to the fit; without a joint in the names a kind must be given."""
    names = ("humerus", "ulna", "olecranon")
    humerus, ulna, olecranon = (tmp_path / f"{name}.ply" for name in names)
    write_roller_and_tube(ulna, humerus)
    for half, height in ((ulna, -7.6), (olecranon, 7.6)):
        roller = trimesh.creation.cylinder(radius=10.0, height=15.0, sections=64).subdivide_to_size(4.0)
        roller.apply_translation([0.0, 0.0, height]).export(half)
    given = ["fit-joint", str(humerus), str(ulna), str(olecranon), "--within-mm", "2", "--kind"]
    assert main([*given, "hinge"]) == 0
    whole = tomllib.loads(capsys.readouterr().out)["joint"]
    assert whole["moving"] == ["ulna", "olecranon"]
    assert abs(whole["axis"][2]) > 0.999
    assert main([*given, "named"]) == 0
    assert tomllib.loads(capsys.readouterr().out)["joint"] == whole
    other = tmp_path / "piece.ply"
    olecranon.rename(other)
    assert main(["fit-joint", str(other), str(ulna), "--kind", "named"]) == 2
    said = capsys.readouterr().err
    assert "the names 'piece', 'ulna' say no joint that is known" in said
    assert "hinge, universal, saddle or ball" in said


def test_bones_of_any_name_are_printed_as_valid_toml(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fixed, moving = '"left" \\ ulna\x7f', "Elle's"
    write_roller_and_tube(tmp_path / f"{moving}.ply", tmp_path / f"{fixed}.ply")
    assert main(["fit-joint", str(tmp_path / f"{fixed}.ply"), str(tmp_path / f"{moving}.ply"), "--within-mm", "2"]) == 0
    joint = tomllib.loads(capsys.readouterr().out)["joint"]
    assert (joint["fixed"], joint["moving"]) == ([fixed], [moving])


def test_joint_ranges_are_printed_or_given_as_json(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    joints = rig.with_name("joints.toml")
    joints.write_text(joints.read_text(encoding="utf-8").replace("[-5, 60]", "[-5, 175]"), encoding="utf-8")
    assert main(["joint-range", str(rig), "--quiet"]) == 0
    said = capsys.readouterr().out
    assert "elbow  from    -5.0 deg  its limit" in said
    assert re.search(
        r"to     145\.\d deg  bone_distal / bone_proximal, [\d.]+ mm deep, overlapping by [\d.]+ mm³", said
    )
    assert "ends found to 0.1 deg" in said
    assert main(["joint-range", str(rig), "--quiet", "--json"]) == 0
    (elbow,) = json.loads(capsys.readouterr().out)["joint_ranges"]
    jsonschema.Draft202012Validator(joint_range_schema()).validate(elbow)
    assert (elbow["joint"], elbow["limits_deg"], elbow["low"]["ended_by"]) == ("elbow", [-5.0, 175.0], "limit")
    assert elbow["high"]["degrees"] == pytest.approx(145.3, abs=0.2)
    assert elbow["high"]["beyond"]["depth_mm"] > elbow["high"]["beyond"]["depth_limit_mm"]


def test_ranges_of_a_rig_without_joints_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["joint-range", str(write_tiny_rig(tmp_path / "pairs")), "--quiet"]) == 2
    assert "no joint drives this rig" in capsys.readouterr().err


def test_a_pose_beyond_the_limits_of_the_built_in_limb_is_refused_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["run", "upper_limb", "--set", "drive.pose.elbow_deg=400", "--out", str(tmp_path / "out"), "--quiet"]
    assert main(arguments) == 2
    assert "found 400 degrees" in (said := capsys.readouterr().err)
    assert "[-5, 150]" in said
    assert not (tmp_path / "out").exists()
