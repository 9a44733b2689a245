"""One pose said by joints, by transforms and by landmarks that name their bones: the same motions, runs and frames."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_rigs import BEND_DEG, LANDMARKS, drive_by, drive_by_joints, landmark_rows, write_landmarks, write_tiny_rig

import musclefit
from musclefit.errors import InputError
from musclefit.geometry.surfaces.samples import surface_samples
from musclefit.io.formats.transforms import transforms_text
from musclefit.pipeline.deformers import least_steps
from musclefit.pipeline.poses import bones_of, collision_on_the_way
from musclefit.pipeline.retarget import Retargeting
from musclefit.pipeline.sequence import Stage, at_rest, check_pose, posed_job
from musclefit.rig.job import Job
from musclefit.rig.motion import Pose
from musclefit.workflows.sequence import run_sequence
from musclefit.workflows.sequence_frames import read_frames
from musclefit.workflows.sequence_plan import planned

RIGID = (
    "bones.rigid=true",
    "bones.lattices_mm=[6.0, 3.0]",
    "bones.iterations=10",
    "deformer.step=cayley",
    "deformer.kernel=isochoric-r3",
    "deformer.min_steps=3",
    "certificate.enabled=false",
)
BY_TRANSFORMS = 'kind = "transforms"\ntransforms = "moved.json"\nlandmarks_per_bone = 6'


@pytest.fixture(scope="module")
def jobs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Job]:
    """The same bend of the elbow, said in three ways; transforms and landmarks are written from the joints' motions."""
    folder = tmp_path_factory.mktemp("drives")
    paths = {name: write_tiny_rig(folder / name) for name in ("joints", "transforms", "landmarks")}
    drive_by_joints(paths["joints"])
    by_joints = musclefit.read_rig(paths["joints"], overrides=("deformer.path=joints", *RIGID))
    assert by_joints.motions is not None
    moved = transforms_text(by_joints.motions.at(1.0))
    paths["transforms"].with_name("moved.json").write_text(moved, encoding="utf-8")
    drive_by(paths["transforms"], BY_TRANSFORMS)
    handles, target = by_joints.handles, by_joints.path.position(1.0)
    rows = [landmark_rows()[0]]
    for name, bone, here, there in zip(handles.names, handles.owner, handles.source, target, strict=True):
        rows.append([name, bone, *(repr(float(x)) for x in (*here, *there))])
    write_landmarks(paths["landmarks"].with_name("landmarks.csv"), rows)
    others = {name: musclefit.read_rig(paths[name], overrides=RIGID) for name in ("transforms", "landmarks")}
    return {"joints": by_joints, **others}


@pytest.fixture(scope="module")
def runs(jobs: dict[str, Job]) -> dict[str, Retargeting]:
    return {name: musclefit.retarget(job, tets=None) for name, job in jobs.items()}


@pytest.mark.parametrize("drive", ["transforms", "landmarks"])
@pytest.mark.parametrize("t", [0.0, 0.3, 1.0])
def test_the_same_pose_gives_the_same_handles_and_motions(jobs: dict[str, Job], drive: str, t: float) -> None:
    """A hinge's way is its screw's, so the whole way is the same."""
    expected, found = jobs["joints"], jobs[drive]
    assert expected.motions is not None
    assert found.motions is not None
    assert found.handles.owner == expected.handles.owner
    np.testing.assert_allclose(found.handles.source, expected.handles.source, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.path.position(t), expected.path.position(t), rtol=0, atol=1e-9)
    motions = expected.motions.at(t)
    assert set(found.motions.at(t)) == set(motions)
    for bone, motion in found.motions.at(t).items():
        np.testing.assert_allclose(motion.rotation, motions[bone].rotation, rtol=0, atol=1e-9)
        np.testing.assert_allclose(motion.translation, motions[bone].translation, rtol=0, atol=1e-9)


@pytest.mark.parametrize("drive", ["joints", "transforms", "landmarks"])
def test_rigid_bones_run_alike_by_every_drive(jobs: dict[str, Job], runs: dict[str, Retargeting], drive: str) -> None:
    result, motions = runs[drive].result, jobs["joints"].motions
    assert motions is not None
    assert runs[drive].report.verdict == "passed"
    assert result.side.landmarks.max_error_mm < 1e-9
    for bone in ("bone_proximal", "bone_distal"):
        exact = motions.at(1.0)[bone](result.rest[bone].surface.vertices)
        np.testing.assert_allclose(result.deformed[bone].surface.vertices, exact, rtol=0, atol=1e-9)
    assert {t.rigidity_reference for t in result.side.tissues if t.kind == "bone"} == {"prescribed"}
    for tissue in ("muscle_flexor", "skin"):
        expected = runs["joints"].result.deformed[tissue].surface.vertices
        np.testing.assert_allclose(result.deformed[tissue].surface.vertices, expected, rtol=0, atol=1e-4)


def test_a_method_says_its_path(runs: dict[str, Retargeting]) -> None:
    assert runs["joints"].result.side.method.endswith("joints paths")
    assert runs["transforms"].result.side.method.endswith("chain paths")


def test_what_a_rigid_bone_cannot_reach_is_the_fits_residual_and_no_error_of_the_map(tmp_path: Path) -> None:
    rig = write_tiny_rig(tmp_path / "rig")
    rows = landmark_rows()
    rows[-1][7] = repr(float(rows[-1][7]) + 1.0)  # the last landmark of the distal bone is sent 1 mm off
    rows.append(["free", "", "0", "13", "0", "0", "14", "0"])
    write_landmarks(rig.with_name("landmarks.csv"), rows)
    job = musclefit.read_rig(rig, overrides=RIGID)
    run = musclefit.retarget(job, tets=None)
    assert run.result.side.landmarks.count == LANDMARKS + 1
    assert run.result.side.landmarks.max_error_mm < 1e-9
    assert job.motions is not None
    bone = run.result.rest["bone_distal"].surface.vertices
    moved = run.result.deformed["bone_distal"].surface.vertices
    np.testing.assert_allclose(moved, job.motions.at(1.0)["bone_distal"](bone), rtol=0, atol=1e-12)
    arrived = run.result.deformation(job.handles.source)
    np.testing.assert_allclose(arrived[-1], [0.0, 14.0, 0.0], rtol=0, atol=1e-9)
    missed = np.linalg.norm(arrived[LANDMARKS - 1] - np.array(rows[LANDMARKS][5:], dtype=float))
    assert 0.2 < missed < 1.0
    assert any(f"{missed:.3g} mm at most (bone_distal_5)" in finding.message for finding in run.findings)


# --- bones in each other's way


@pytest.fixture
def colliding(tmp_path: Path) -> Path:
    """The distal bone is slid into the proximal one along the limb."""
    rig = write_tiny_rig(tmp_path / "rig")
    drive_by(rig, BY_TRANSFORMS)
    still = musclefit.RigidMotion.identity()
    slid = musclefit.RigidMotion(np.eye(3), np.array([-30.0, 0.0, 0.0]))
    poses = {
        0.0: {"bone_proximal": still, "bone_distal": still},
        1.0: {"bone_proximal": still, "bone_distal": slid},
        2.0: {"bone_proximal": still, "bone_distal": still},
    }
    rig.with_name("moved.json").write_text(transforms_text(poses), encoding="utf-8")
    return rig


def test_a_transform_into_another_bone_is_refused_by_its_place_on_the_way(colliding: Path) -> None:
    job = musclefit.read_rig(colliding, overrides=(*RIGID, "drive.time_s=1"))
    said = r"collide at [\d.]+ % of the way: .* mm deep, sharing .*feasible pose .*correct where"
    with pytest.raises(InputError, match=said):
        musclefit.retarget(job, tets=None)


def test_a_run_with_locked_bones_is_proved_and_moves_their_whole_surface(tmp_path: Path) -> None:
    rig = write_tiny_rig(tmp_path / "rig")
    drive_by_joints(rig)
    by_joints = (*RIGID, "deformer.path=joints", "certificate.enabled=true", "certificate.max_boxes=200000")
    job = musclefit.read_rig(rig, overrides=(*by_joints, "bones.lock=true"))
    result = musclefit.retarget(job, tets=None).result
    assert result.side.map.claim == "certified"
    assert job.motions is not None
    for bone, motion in job.motions.at(1.0).items():
        places = surface_samples(job.anatomy[bone].surface, spacing_mm=0.3).points
        assert np.abs(result.deformation(places) - motion(places)).max() < 1e-9
    free = musclefit.retarget(musclefit.read_rig(rig, overrides=by_joints), tets=None).result.deformation
    places = surface_samples(job.anatomy["bone_distal"].surface, spacing_mm=0.3).points
    assert np.abs(free(places) - job.motions.at(1.0)["bone_distal"](places)).max() > 1e-3


def test_landmarks_into_another_bone_are_refused(tmp_path: Path) -> None:
    rig = write_tiny_rig(tmp_path / "rig")
    rows = landmark_rows()
    for row in rows[7:]:
        row[5:8] = [repr(float(row[2]) - 30.0), *row[3:5]]
    write_landmarks(rig.with_name("landmarks.csv"), rows)
    with pytest.raises(InputError, match=r"collide at .* % of the way.*correct where the bones are sent"):
        musclefit.retarget(musclefit.read_rig(rig, overrides=RIGID), tets=None)


def test_a_frame_whose_bones_collide_is_refused_and_the_others_are_made(colliding: Path, tmp_path: Path) -> None:
    job = musclefit.read_rig(colliding, overrides=RIGID)
    report = run_sequence(planned(job), tmp_path / "out")
    assert [frame.outcome for frame in report.frames] == ["made", "refused", "made"]
    said = report.frames[1].problem
    assert said.startswith("frame 1 at 1 s is refused: bones 'bone_distal' and 'bone_proximal' collide at")
    assert "% of the way: " in said
    assert "mm deep, sharing" in said
    assert "the largest feasible pose on this way is" in said


def test_bones_that_slide_past_each_other_are_tested_on_the_way(colliding: Path) -> None:
    """At its end the distal bone is beyond the proximal one; on its way it passed through."""
    through = {
        "bone_proximal": musclefit.RigidMotion.identity(),
        "bone_distal": musclefit.RigidMotion(np.eye(3), np.array([-100.0, 0.0, 0.0])),
    }
    poses = {0.0: dict.fromkeys(through, musclefit.RigidMotion.identity()), 1.0: through}
    colliding.with_name("moved.json").write_text(transforms_text(poses), encoding="utf-8")
    job = musclefit.read_rig(colliding, overrides=RIGID)
    pose = Pose(1, 1.0, ())
    posed = posed_job(job, pose)
    found = collision_on_the_way(posed, bones_of(posed))
    assert found is not None
    assert 0.0 < found.at < 0.5


# --- over time


def turned(
    axis: tuple[float, float, float], degrees: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> musclefit.RigidMotion:
    return musclefit.RigidMotion.about_axis(centre=np.array(centre), axis=np.array(axis), angle_deg=degrees)


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Job:
    """The elbow bends to 30 degrees and back; each bone's transforms start from a frame of its own, not from rest.

    At 0 s the bones stand as the anatomy does.
    """
    rig = write_tiny_rig(tmp_path_factory.mktemp("moving") / "rig")
    drive_by(rig, f"{BY_TRANSFORMS}\nreference_time_s = 0")
    own_frames = {
        "bone_proximal": turned((0.3, 1.0, -0.2), 110.0, centre=(50.0, 20.0, 90.0)),
        "bone_distal": turned((1.0, 0.1, 0.5), -70.0, centre=(-30.0, 0.0, 10.0)),
    }
    bends = ((0.0, 0.0), (0.5, 30.0), (0.8, 10.0), (1.0, 0.0))
    poses = {
        time: {
            "bone_proximal": own_frames["bone_proximal"],
            "bone_distal": turned((0.0, 0.0, 1.0), degrees) @ own_frames["bone_distal"],
        }
        for time, degrees in bends
    }
    rig.with_name("moved.json").write_text(transforms_text(poses), encoding="utf-8")
    return musclefit.read_rig(rig, overrides=(*RIGID, "deformer.min_steps=1", "deformer.degrees_per_step=10"))


def test_frames_are_made_at_the_files_times_each_from_rest(moving: Job, tmp_path: Path) -> None:
    report = run_sequence(planned(moving), tmp_path / "out")
    assert [frame.time_s for frame in report.frames] == [0.0, 0.5, 0.8, 1.0]
    assert report.verdict == "passed", [check for check in report.checks if not check.passed]
    assert report.resampling.startswith("transforms of 2 bones at 4 times, between them each bone on the screw")
    made = [frame.anatomy() for frame in read_frames(moving, tmp_path / "out")]
    for anatomy, degrees in zip(made, (0.0, 30.0, 10.0, 0.0), strict=True):
        exact = turned((0.0, 0.0, 1.0), degrees)(moving.anatomy["bone_distal"].surface.vertices)
        np.testing.assert_allclose(anatomy["bone_distal"].surface.vertices, exact, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(made[0].vertices(), moving.anatomy.vertices())
    assert [check.name for check in report.checks if "rest" in check.name] == ["rest pose off rest"]
    alone = Stage.of(moving).frame(planned(moving).poses[1])
    assert alone.anatomy is not None
    np.testing.assert_array_equal(alone.anatomy.vertices(), made[1].vertices())
    plan = json.loads((tmp_path / "out" / "sequence.json").read_text(encoding="utf-8"))
    assert plan["interpolation"] == "screw"


def test_a_sequence_of_transforms_goes_on_and_keeps_its_frames(moving: Job, tmp_path: Path) -> None:
    folder, plan = tmp_path / "out", planned(moving, frames=3)
    assert [pose.time_s for pose in plan.poses] == [0.0, 0.5, 1.0]
    run_sequence(plan, folder, between=False)
    kept = (folder / "frames" / "0001" / "frame.json").stat().st_mtime_ns
    (folder / "frames" / "0002" / "vertices.npy").unlink()
    run_sequence(plan, folder, between=False)
    assert (folder / "frames" / "0001" / "frame.json").stat().st_mtime_ns == kept
    assert (folder / "frames" / "0002" / "vertices.npy").is_file()
    with pytest.raises(InputError, match=r"holds another sequence \(differing: frames\)"):
        run_sequence(planned(moving, frames=4), folder)
    assert moving.transforms is not None
    other = replace(moving, transforms=moving.transforms.relative_to(0.8))
    with pytest.raises(InputError, match=r"holds another sequence \(differing: motion_sha256\)"):
        run_sequence(planned(other, frames=3), folder)


@pytest.mark.parametrize(("time_s", "steps"), [(0.0, 1), (0.8, 1), (0.5, 3)])
def test_small_poses_take_few_steps(moving: Job, time_s: float, steps: int) -> None:
    assert least_steps(posed_job(moving, Pose(0, time_s, ()))) == steps


def test_the_rest_pose_is_known(moving: Job) -> None:
    assert [at_rest(moving, pose) for pose in planned(moving).poses][:2] == [True, False]


def test_times_beyond_the_file_are_refused(moving: Job) -> None:
    with pytest.raises(InputError, match=r"moved.json: asked for 1.5 s; its bones are known from 0 to 1 s"):
        check_pose(moving, Pose(0, 1.5, ()))


def test_transforms_have_no_other_motion(moving: Job, jobs: dict[str, Job]) -> None:
    with pytest.raises(InputError, match=r"the motion bend.csv has no effect: the rig follows drive.transforms"):
        planned(moving, motion="bend.csv")
    with pytest.raises(InputError, match=r"the interpolation linear has no effect"):
        planned(moving, interpolation=musclefit.rig.motion.Interpolation.LINEAR)
    with pytest.raises(InputError, match=r"moved.json: states no times, so there is one pose alone"):
        _ = planned(jobs["transforms"]).poses
    with pytest.raises(InputError, match=r"a motion turns joints or follows transforms"):
        planned(jobs["landmarks"])


def test_the_bend_of_the_tiny_rig_is_the_one_of_its_landmarks(jobs: dict[str, Job]) -> None:
    """What the three drives say is the landmark table's own bend, so that a slip in one of them cannot hide."""
    assert jobs["landmarks"].motions is not None
    assert jobs["landmarks"].motions.at(1.0)["bone_distal"].turn_deg == pytest.approx(BEND_DEG, abs=1e-9)
