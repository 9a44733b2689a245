"""Poses: what collides is refused with the largest feasible pose, and that one is accepted; joint by joint, how far."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import trimesh
from tiny_rigs import drive_by_joints, write_tiny_rig

import musclefit
from musclefit.errors import InputError
from musclefit.pipeline.poses import (
    bones_of,
    collision_on_the_way,
    fastest_turn,
    pose_in_words,
    ranges_of,
    refuse_collision,
    shared_in_the_pose,
)
from musclefit.report.schema import to_json
from musclefit.rig.job import Job

RIGID = ("deformer.path=joints", "deformer.kernel=isochoric-r3", "deformer.step=cayley", "bones.rigid=true")
COARSE = ("bones.lattices_mm=[20, 10]", "bones.iterations=3", "bones.handle_spacing_mm=20", "certificate.enabled=false")
"""Not exact, but quick."""


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """Two eggs on a hinge, which meet end to end when it is folded up."""
    path = write_tiny_rig(tmp_path / "rig")
    drive_by_joints(path)
    joints = path.with_name("joints.toml")
    joints.write_text(joints.read_text(encoding="utf-8").replace("[-5, 60]", "[-175, 175]"), encoding="utf-8")
    return path


def posed(rig: Path, degrees: float, *more: str) -> Job:
    return musclefit.read_rig(rig, overrides=(*RIGID, f"drive.pose.elbow_deg={degrees}", *more))


def test_a_forbidden_pose_is_refused_before_the_soft_tissue_is_touched(rig: Path) -> None:
    with pytest.raises(InputError, match=r"'bone_distal' and 'bone_proximal' collide at elbow 145") as told:
        musclefit.retarget(posed(rig, 170), tets=None)
    said = str(told.value)
    assert re.search(
        r"at elbow 145\.\d+ deg: 0\.\d+ mm deep, sharing [\d.]+ mm³ \(allowed: 0\.6 mm and 6\.56 mm³\)", said
    )
    assert re.search(r"in the pose itself they are 5\.\d+ mm deep", said)
    assert re.search(r"the largest feasible pose on this way is elbow 145\.\d+ deg; set drive\.pose", said)


def test_a_bone_in_the_way_that_no_joint_knows_is_told_apart(rig: Path) -> None:
    """It stays where it is, and what it most likely lacks is a place in a joint."""
    there = musclefit.read_rig(rig, overrides=("drive.pose.elbow_deg=120",))
    assert there.motions is not None
    distal = there.anatomy["bone_distal"].surface
    moved = there.motions.at(1.0)["bone_distal"](distal.vertices)
    loose = trimesh.Trimesh(0.3 * (moved - moved.mean(axis=0)) + moved.mean(axis=0), distal.faces, process=False)
    loose.export(rig.parent / "anatomy" / "bone_loose.ply")
    job = posed(rig, 120)
    with pytest.raises(InputError, match=r"no joint fixes or moves 'bone_loose', so it stays where it is: name it"):
        refuse_collision(job, bones_of(job))


@pytest.mark.parametrize("degrees", [170.0, -170.0])
def test_the_feasible_pose_that_is_named_is_accepted_and_a_little_more_is_not(rig: Path, degrees: float) -> None:
    job = posed(rig, degrees)
    with pytest.raises(InputError) as told:
        refuse_collision(job, bones_of(job))
    named = float(re.search(r"feasible pose on this way is elbow (\S+) deg", str(told.value)).group(1))
    for factor, refused in ((1.0, False), (1.003, True)):
        again = posed(rig, factor * named)
        found = collision_on_the_way(again, bones_of(again))
        assert (found is not None) == refused


def test_a_pose_behind_a_collision_is_refused_though_it_is_free_itself(rig: Path) -> None:
    """A full turn ends at rest."""
    joints = rig.with_name("joints.toml")
    joints.write_text(joints.read_text(encoding="utf-8").replace("[-175, 175]", "[-400, 400]"), encoding="utf-8")
    job = posed(rig, 360)
    with pytest.raises(InputError, match="in the pose itself they are clear of each other again; the largest feasible"):
        refuse_collision(job, bones_of(job))


def test_poses_through_keyframes_are_named_where_the_joints_are_then(rig: Path) -> None:
    job = posed(rig, 20, "drive.keyframes=[{ at = 0.5, elbow_deg = 160 }]")
    assert job.motions is not None
    assert fastest_turn(job.motions) == pytest.approx(320.0, rel=1e-6)
    found = collision_on_the_way(job, bones_of(job))
    assert found is not None
    assert pose_in_words(job, found.feasible, toward_rest=True).startswith("elbow 145.")
    assert found.feasible < 0.5


def test_words_for_a_feasible_pose_never_go_beyond_it(rig: Path) -> None:
    job = posed(rig, -160)
    assert pose_in_words(job, 0.99999, toward_rest=True) == "elbow -159.99 deg"
    assert pose_in_words(job, 0.99999) == "elbow -160 deg"
    screws = musclefit.read_rig(rig, overrides=("drive.pose.elbow_deg=160", "deformer.path=screws"))
    assert pose_in_words(screws, 0.99999, toward_rest=True) == "99.99 % of the way"


def test_what_bones_share_by_their_motions_is_told_and_no_part_of_what_the_run_introduces(rig: Path) -> None:
    job = posed(rig, 145, *COARSE)
    (known,) = shared_in_the_pose(job, bones_of(job))
    assert known.posed_mm3 > 1.0 == job.rig.limits.introduced_overlap_mm3
    result = musclefit.retarget(job, tets=None)
    side = result.result.side
    assert side.overlaps.bones == (known,)
    pair = next(p for p in side.overlaps.pairs if {p.a, p.b} == {known.a, known.b})
    assert pair.deformed_mm3 == pytest.approx(known.posed_mm3, rel=1e-9)
    assert pair.introduced_mm3 == 0.0
    check = next(check for check in result.report.checks if check.name == "introduced overlap")
    assert check.value == pytest.approx(sum(p.introduced_mm3 for p in side.overlaps.pairs if p is not pair))
    assert to_json(result.report)["bone_overlaps"][0]["posed_mm3"] == pytest.approx(known.posed_mm3)
    assert result.baseline.side.overlaps.bones == ()
    (elbow,) = result.report.joint_ranges
    assert elbow.high.degrees == pytest.approx(145.3, abs=0.2)


def test_ranges_are_those_of_the_posed_joints_or_of_all(rig: Path) -> None:
    assert [found.coordinate for found in ranges_of(posed(rig, 0))] == ["elbow"]
    assert ranges_of(posed(rig, 0), posed_only=True) == ()
    landmarks = write_tiny_rig(rig.parent / "pairs")
    assert ranges_of(musclefit.read_rig(landmarks)) == ()


# --- real bones


@pytest.fixture
def real(anatomy_data: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MUSCLEFIT_DATA", str(anatomy_data))
    return anatomy_data


@pytest.mark.parametrize("name", ["left_arm", "finger"])
def test_poses_that_are_stated_free_are_not_refused(real: Path, name: str) -> None:
    job = musclefit.read_rig(real / "untuned" / f"{name}.toml")
    bones = bones_of(job)
    assert collision_on_the_way(job, bones) is None
    assert [overlap for overlap in shared_in_the_pose(job, bones) if overlap.collides] == []


@pytest.mark.parametrize(
    ("rig", "override", "feasible"),
    [
        ("forearm_rigid", "drive.pose.elbow_deg=130", {"elbow": 81.0, "forearm": 43.6}),
        ("leg_jump", "drive.pose={ ankle_deg = -35 }", {"ankle": -19.9}),
    ],
)
def test_deep_poses_are_refused_with_a_feasible_one(
    real: Path, rig: str, override: str, feasible: dict[str, float]
) -> None:
    job = musclefit.read_rig(musclefit.find_rig(rig), overrides=[override])
    found = collision_on_the_way(job, bones_of(job))
    assert found is not None
    named = dict(re.findall(r"(\w+) (\S+) deg", pose_in_words(job, found.feasible, toward_rest=True)))
    assert {name: float(degrees) for name, degrees in named.items()} == pytest.approx(feasible, abs=0.5)
    assert found.there is not None
    assert found.there.depth_mm > 2.0
