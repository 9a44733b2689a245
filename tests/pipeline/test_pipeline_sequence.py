"""Sequences: frames that know no other frame, refused poses, resuming, tampering, worker processes, iterators."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from tiny_rigs import drive_by_joints, write_tiny_rig

import musclefit
from musclefit.errors import InputError, RigError
from musclefit.io.sequence_frames import read_frame
from musclefit.pipeline import refining
from musclefit.pipeline.chosen_settings import surface_choices
from musclefit.pipeline.deformers import least_steps
from musclefit.pipeline.sequence import Stage, frames, posed_job
from musclefit.rig.job import Job
from musclefit.rig.motion import Interpolation, Motion, Pose
from musclefit.workflows import sequence, sequence_tasks
from musclefit.workflows.sequence import longest_first, run_sequence
from musclefit.workflows.sequence_frames import read_frames
from musclefit.workflows.sequence_plan import SequencePlan, planned

BEND = "time_s,elbow_deg,phase\n0,0,rest\n1,40,bent\n2,0,rest\n"
PATH = ("deformer.path=joints", "certificate.max_boxes=2000")


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = write_tiny_rig(tmp_path_factory.mktemp("tiny") / "rig")
    drive_by_joints(path)
    joints = path.with_name("joints.toml")
    joints.write_text(joints.read_text(encoding="utf-8").replace("[-5, 60]", "[-175, 175]"), encoding="utf-8")
    path.with_name("bend.csv").write_text(BEND, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def job(rig: Path) -> Job:
    return musclefit.read_rig(rig, overrides=PATH)


@pytest.fixture(scope="module")
def plan(job: Job, rig: Path) -> SequencePlan:
    return planned(job, motion=rig.with_name("bend.csv"), frames=5)


@pytest.fixture(scope="module")
def made(plan: SequencePlan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sequence") / "out"
    report = run_sequence(plan, folder)
    assert report.verdict == "passed"
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("vertices.npy")}


# --- frames


def test_a_frame_alone_is_the_frame_in_the_sequence(job: Job, plan: SequencePlan, made: Path) -> None:
    """History-free: bit for bit the same, whatever was made before, in this process or another."""
    alone = Stage.of(job).frame(plan.poses[3])
    assert alone.anatomy is not None
    in_sequence = [frame.anatomy().vertices() for frame in read_frames(job, made)]
    np.testing.assert_array_equal(alone.anatomy.vertices(), in_sequence[3])


@pytest.mark.parametrize(("degrees", "steps"), [(0.0, 1), (10.0, 1), (20.0, 2), (20.5, 3)])
def test_small_poses_take_few_steps(rig: Path, degrees: float, steps: int) -> None:
    job = musclefit.read_rig(rig, overrides=("deformer.path=joints", "deformer.degrees_per_step=10"))
    assert least_steps(posed_job(job, Pose(0, 0.0, (("elbow", degrees),)))) == steps
    assert least_steps(replace(job, rig=replace(job.rig, deformer=replace(job.rig.deformer, min_steps=7)))) >= 7


def test_the_longest_marches_come_first() -> None:
    """Else the last frames of a motion, often the farthest from rest, keep one worker busy and the others waiting."""
    assert longest_first([0, 1, 2, 3, 5], [1, 4, 4, 2, 9, 0]) == [1, 2, 3, 0, 5]


def test_what_no_pose_changes_is_made_once(job: Job, plan: SequencePlan) -> None:
    one, other = (posed_job(job, pose) for pose in plan.poses[1:3])
    cut = refining._cut(one, frozenset())
    assert refining._cut(other, frozenset()) is cut
    assert refining._cut(other, frozenset({"bone_distal"})) is not cut
    surfaces = replace(job.rig.surfaces, refine=True, longest_edge_mm=4.0)
    finer = (replace(posed, rig=replace(posed.rig, surfaces=surfaces)) for posed in (one, other))
    first, second = (refining._cut(posed, frozenset()) for posed in finer)
    assert first is second
    assert len(first.anatomy.vertices()) > len(cut.anatomy.vertices())
    longest = surface_choices(job).longest.most_mm
    assert refining._between(cut.anatomy, longest_mm=longest) is refining._between(cut.anatomy, longest_mm=longest)


def test_a_motion_that_comes_back_comes_back_to_rest(job: Job, made: Path) -> None:
    first, *_, last = (frame.anatomy().vertices() for frame in read_frames(job, made))
    np.testing.assert_array_equal(first, job.anatomy.vertices())
    np.testing.assert_array_equal(last, job.anatomy.vertices())


def test_frames_come_one_after_the_other_in_memory(job: Job, plan: SequencePlan) -> None:
    seen = list(frames(job, plan.poses[:2]))
    assert [frame.pose.number for frame in seen] == [0, 1]
    assert all(frame.anatomy is not None and frame.side is not None for frame in seen)
    with pytest.raises(RigError, match="found 200 degrees"):
        frames(job, [Pose(0, 0.0, (("elbow", 200.0),))])


def test_a_pose_whose_bones_collide_is_refused_and_the_others_are_made(job: Job, tmp_path: Path) -> None:
    motion = Motion(np.array([0.0, 1.0, 2.0]), ("elbow",), np.array([[0.0], [150.0], [0.0]]), "far.csv")
    report = run_sequence(SequencePlan(job, motion, 3, Interpolation.LINEAR), tmp_path / "out")
    assert [frame.outcome for frame in report.frames] == ["made", "refused", "made"]
    said = report.frames[1].problem
    assert "frame 1 at 1 s (elbow 150 deg) is refused: bones 'bone_distal' and 'bone_proximal' collide" in said
    assert "mm deep" in said
    assert "the largest feasible pose on this way is elbow 145." in said
    assert report.verdict == "failed"
    assert {check.name for check in report.checks if not check.passed} == {
        "refused frames",
        "not examined between frames",
    }


@pytest.mark.slow
def test_worker_processes_make_the_same_frames(plan: SequencePlan, made: Path, tmp_path: Path) -> None:
    report = run_sequence(plan, tmp_path / "out", workers=2)
    assert report.verdict == "passed"
    assert contents(tmp_path / "out") == contents(made)
    assert all(frame.cpu_s["frame"] > 0.0 for frame in report.frames)


# --- on disk


def test_an_interrupted_sequence_goes_on_and_ends_alike(
    plan: SequencePlan, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed between frames: what is finished stays, what is half-written goes, the end is the same bit for bit."""
    folder = tmp_path / "out"
    shutil.copytree(made, folder)
    shutil.rmtree(folder / "frames" / "0003")
    shutil.rmtree(folder / "frames" / "0001")
    (folder / "frames" / ".0001.partial-0").mkdir()
    (folder / "frames" / ".0001.partial-0" / "vertices.npy").write_bytes(b"half")
    kept = {k: (folder / "frames" / k / "frame.json").stat().st_mtime_ns for k in ("0000", "0002", "0004")}
    report = run_sequence(plan, folder)
    assert report.verdict == "passed"
    assert contents(folder) == contents(made)
    assert not list((folder / "frames").glob(".*"))
    assert kept == {k: (folder / "frames" / k / "frame.json").stat().st_mtime_ns for k in kept}


def test_frames_that_were_changed_are_made_again(plan: SequencePlan, made: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    shutil.copytree(made, folder)
    for number, file in enumerate(("vertices.npy", "tissues.vtp", "frame.json"), start=1):
        changed = folder / "frames" / f"{number:04d}" / file
        data = bytearray(changed.read_bytes())
        data[-20] ^= 1
        changed.write_bytes(bytes(data))
        with pytest.raises(InputError, match=r"frame 1: .*was changed"):
            list(read_frames(plan.job, folder))
        assert isinstance(read_frame(folder, number, key=""), str)
    run_sequence(plan, folder)
    assert contents(folder) == contents(made)


def test_the_surfaces_of_a_frame_are_those_that_were_measured(rig: Path, tmp_path: Path) -> None:
    """Given triangles where they were split would be other bodies than the report's."""
    finer = ("surfaces.refine=true", "surfaces.longest_edge_mm=4")
    job = musclefit.read_rig(rig, overrides=(*PATH, *finer))
    run_sequence(planned(job, motion=rig.with_name("bend.csv"), frames=3), tmp_path / "out")
    folder = tmp_path / "out" / "frames" / "0001"
    record = json.loads((folder / "frame.json").read_text(encoding="utf-8"))["result"]
    surfaces = pv.read(folder / "tissues.vtp")
    assert record["edges_split"] > 0
    assert surfaces.n_points == len(job.anatomy.vertices()) + record["edges_split"]
    for number, tissue in enumerate(record["tissues"]):
        own = surfaces.extract_cells(surfaces.cell_data["tissue"] == number).extract_surface(algorithm=None)
        assert own.volume == pytest.approx(tissue["volume_mm3"], rel=1e-5)
    assert len(np.load(folder / "vertices.npy")) == len(job.anatomy.vertices())


def test_frames_of_other_settings_are_made_again(job: Job, rig: Path, made: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    shutil.copytree(made, folder)
    other = musclefit.read_rig(rig, overrides=(*PATH, "deformer.kernel=r"))
    run_sequence(planned(other, motion=rig.with_name("bend.csv"), frames=5), folder, between=False)
    assert contents(folder)["frames/0002/vertices.npy"] != contents(made)["frames/0002/vertices.npy"]


def test_a_folder_of_something_else_is_refused(plan: SequencePlan, made: Path, tmp_path: Path, rig: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"holds no sequence\.json"):
        run_sequence(plan, tmp_path)
    with pytest.raises(InputError, match=r"holds another sequence \(differing: frames\)"):
        run_sequence(planned(plan.job, motion=rig.with_name("bend.csv"), frames=6), made)


def test_a_frame_that_a_full_disk_cut_short_ends_the_sequence(
    plan: SequencePlan, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "out"
    shutil.copytree(made, folder)
    shutil.rmtree(folder / "frames" / "0002")

    def cut_short(number: int) -> float:
        took = sequence_tasks.make(number)
        surfaces = folder / "frames" / f"{number:04d}" / "tissues.vtp"
        surfaces.write_bytes(surfaces.read_bytes()[:-1])
        return took

    monkeypatch.setattr(sequence, "make", cut_short)
    with pytest.raises(OSError, match=r"frame 2 was not written whole \(.*\); is the disk full\?"):
        run_sequence(plan, folder)
    monkeypatch.undo()
    assert run_sequence(plan, folder).verdict == "passed"
    assert contents(folder) == contents(made)


def test_a_sequence_keeps_its_folder_from_another_rig_with_the_same_motion(
    plan: SequencePlan, made: Path, rig: Path, tmp_path: Path
) -> None:
    """Whose file may even have the same name; a copy of the same rig is no other."""
    shutil.copytree(rig.parent, tmp_path / "rig")
    copied = tmp_path / "rig" / rig.name
    kept = contents(made)
    run_sequence(planned(musclefit.read_rig(copied, overrides=PATH), motion=rig.with_name("bend.csv"), frames=5), made)
    run_sequence(plan, made)
    copied.write_text(copied.read_text(encoding="utf-8").replace("Four balls", "Four others"), encoding="utf-8")
    renamed = copied.rename(copied.with_name("other.toml"))
    shutil.copy(renamed, copied)
    for other in (copied, renamed):
        its = planned(musclefit.read_rig(other, overrides=PATH), motion=rig.with_name("bend.csv"), frames=5)
        with pytest.raises(InputError, match=rf"holds a sequence of another rig \({rig}, here {other}\); name another"):
            run_sequence(its, made)
    assert contents(made) == kept


def test_what_lies_between_is_examined_again_when_a_frame_changed(made: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    shutil.copytree(made, folder)
    assert sequence_tasks.read_between(folder, 1) is not None
    path = folder / "frames" / "0002" / "vertices.npy"
    np.save(path, np.load(path) + 0.1)
    assert sequence_tasks.read_between(folder, 1) is None
    assert sequence_tasks.read_between(folder, 3) is not None


def test_report_and_measures_say_the_same(made: Path) -> None:
    report = json.loads((made / "report.json").read_text(encoding="utf-8"))
    assert [frame["number"] for frame in report["frames"]] == list(range(5))
    assert report["resampling"].startswith("3 keyframes joined by monotone cubics")
    lines = (made / "muscles.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0].startswith("frame,time_s,muscle,volume_mm3,centreline_mm,largest_section_mm2,surface_mm2,gap_mm")
    assert len(lines) == 1 + 5
    cells = dict(zip(lines[0].split(","), lines[3].split(","), strict=True))
    said = report["frames"][2]["muscles"][0]
    assert float(cells["volume_mm3"]) == said["volume_mm3"]
    assert float(cells["centreline_mm"]) == said["centreline_mm"]


def test_the_series_is_read_by_paraviews_reader(job: Job, made: Path) -> None:
    reader = pv.get_reader(made / "sequence.pvd")
    assert reader.time_values == [0.0, 0.5, 1.0, 1.5, 2.0]
    reader.set_active_time_value(1.0)
    (block,) = reader.read()
    vertices = [frame.anatomy().vertices() for frame in read_frames(job, made)][2]
    np.testing.assert_allclose(block.points, vertices, rtol=1e-6, atol=1e-5)
    assert set(np.unique(block.cell_data["kind"])) == {0, 2, 3}
    moved = vertices - job.anatomy.vertices()
    np.testing.assert_allclose(block.point_data["displacement_mm"], moved, rtol=0, atol=1e-4)


def test_a_rig_without_joints_or_motion_is_refused(tmp_path: Path) -> None:
    plain = musclefit.read_rig(write_tiny_rig(tmp_path / "plain"))
    with pytest.raises(InputError, match="a motion turns joints"):
        planned(plain)
    drive_by_joints(tmp_path / "plain" / "tiny.toml")
    with pytest.raises(InputError, match=r"drive\.motion names no keyframes"):
        planned(musclefit.read_rig(tmp_path / "plain" / "tiny.toml"))
