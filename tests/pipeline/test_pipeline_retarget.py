"""Whole runs through the Python API: the same numbers as report.json, the paper's loop against one shot, early ends."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_rigs import BEND_DEG, LANDMARKS, TISSUES, drive_by_joints, exchanged_rows, write_landmarks, write_tiny_rig

import musclefit
from musclefit.certify.meshes import certify_mesh
from musclefit.errors import NotConvergedError, RigError
from musclefit.figures.stills import Stills
from musclefit.flow.deformation import Status
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.anatomy import read_surface
from musclefit.io.run_folder import ply_bytes
from musclefit.pipeline.deformers import _bone_stepper
from musclefit.pipeline.retarget import Outcome, Retargeting
from musclefit.progress import Silent, Tick
from musclefit.report.model import CONVERGED
from musclefit.report.schema import to_json
from musclefit.workflows import run as runs

LANDMARK_MM = 1e-6


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    return write_tiny_rig(tmp_path / "rig")


@pytest.fixture
def bent_rig(rig: Path) -> Path:
    """Joints that may bend farther than one step can go."""
    drive_by_joints(rig)
    joints = rig.with_name("joints.toml")
    joints.write_text(joints.read_text(encoding="utf-8").replace("[-5, 60]", "[-5, 170]"), encoding="utf-8")
    return rig


def run(rig: Path, *overrides: str) -> Retargeting:
    return musclefit.retarget(musclefit.read_rig(rig, overrides=overrides), tets=None)


# --- the same numbers everywhere


def test_report_json_holds_the_numbers_of_the_api(rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "stills", lambda *_, **__: Stills(problem="not in this test"))
    job = musclefit.read_rig(rig)
    tets = musclefit.tetrahedralise(job.anatomy, musclefit.LayerRules(0.2, 0.01))
    result = musclefit.retarget(job, tets=tets)
    returned = musclefit.save(result, tmp_path / "out", seconds={"march": 1.5})
    written = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    beside = {key: written.pop(key) for key in ("files", "surfaces")}
    assert written == to_json(returned)
    assert written["timings_s"] == {"march": 1.5}
    measured = ("timings_s", "certificate_cost", "peak_memory_mb", "provenance")
    assert {k: v for k, v in to_json(result.report).items() if k not in measured} == {
        k: v for k, v in written.items() if k not in measured
    }
    assert_measured_again(written, result.result, result)
    assert_measured_again(written["baseline"], result.baseline, result)
    for entry, tissue in zip(beside["surfaces"], result.result.deformed, strict=True):
        on_disk = read_surface(tmp_path / "out" / entry["ply"])
        assert entry["name"] == tissue.name
        np.testing.assert_array_equal(on_disk.vertices, tissue.surface.vertices)
        np.testing.assert_array_equal(on_disk.faces, tissue.surface.faces)


def assert_measured_again(said: dict[str, Any], outcome: Outcome, result: Retargeting) -> None:
    """One side of report.json against what its deformation and surfaces say."""
    job = result.job
    arrived = outcome.deformation(job.handles.source)
    errors = np.linalg.norm(arrived - job.path.position(1.0), axis=1)
    assert said["landmarks"]["count"] == LANDMARKS
    assert said["landmarks"]["max_error_mm"] == pytest.approx(errors.max(), rel=1e-9, abs=1e-15)
    smallest = np.linalg.det(outcome.deformation.jacobian(job.anatomy.vertices())).min()
    assert said["map"]["min_jacobian_determinant"] == pytest.approx(smallest, rel=1e-12)
    for tissue in said["tissues"]:
        rest, after = (enclosed_volume(a[tissue["name"]].surface) for a in (job.anatomy, outcome.deformed))
        assert tissue["rest_volume_mm3"] == pytest.approx(rest, rel=1e-12)
        assert tissue["volume_mm3"] == pytest.approx(after, rel=1e-12)
        assert tissue["volume_change_percent"] == pytest.approx(100 * (after - rest) / rest, rel=1e-9, abs=1e-9)
    assert outcome.tets is not None
    assert outcome.tet_vertices is not None
    np.testing.assert_allclose(
        outcome.tet_vertices, outcome.deformation(outcome.tets.mesh.vertices), rtol=0, atol=1e-12
    )
    corners = outcome.tet_vertices[outcome.tets.mesh.tets]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    assert said["mesh"]["tets"] == len(volumes)
    assert said["mesh"]["inverted"] == (volumes <= 0).sum() == 0
    assert (
        said["mesh"]["claim"]
        == certify_mesh(outcome.tets.mesh.with_vertices(outcome.tet_vertices)).claim
        == "certified"
    )


def test_two_runs_give_the_same_numbers(rig: Path) -> None:
    first, second = (to_json(run(rig).report) for _ in range(2))
    assert first == second


def test_paths_may_be_text(rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "stills", lambda *_, **__: Stills(problem="not in this test"))
    folder = str(rig.parent / "anatomy")
    whole = musclefit.read_anatomy(folder)
    parts = musclefit.read_anatomy([f"{folder}/skin.ply", f"{folder}/bone_*.ply"])
    assert [len(read.anatomy) for read in (whole, parts)] == [4, 3]
    assert len(musclefit.read_landmarks(str(rig.parent / "landmarks.csv"))) == LANDMARKS
    musclefit.save(musclefit.retarget(musclefit.read_rig(str(rig)), tets=None), str(tmp_path / "out"))
    assert (tmp_path / "out" / "report.json").is_file()


# --- the paper's loop and one shot


def test_within_one_safe_step_the_loop_is_the_one_shot_warp(rig: Path) -> None:
    result = run(rig)
    assert (result.result.side.steps, result.result.side.status) == (1, CONVERGED)
    assert result.result.deformation.margin > 0
    np.testing.assert_array_equal(result.result.deformed.vertices(), result.baseline.deformed.vertices())


@pytest.mark.parametrize("kernel", ["r", "r2logr", "r3"])
def test_the_loop_keeps_what_one_shot_folds(bent_rig: Path, kernel: str) -> None:
    result = run(bent_rig, "drive.pose.elbow_deg=150", f"deformer.kernel={kernel}")
    loop, shot = result.result.side, result.baseline.side
    assert (loop.status, loop.steps > 4, shot.steps) == (CONVERGED, True, 1)
    assert (loop.map.folded_points, shot.map.folded_points > 0) == (0, True)
    assert loop.map.min_jacobian_determinant > 0 > shot.map.min_jacobian_determinant
    assert result.result.deformation.margin >= 0 > result.baseline.deformation.margin
    assert max(loop.landmarks.max_error_mm, shot.landmarks.max_error_mm) <= LANDMARK_MM
    assert "not held to any rule" in shot.status


@pytest.mark.parametrize("path", ["straight", "joints"])
@pytest.mark.parametrize("rule", ["row-norm", "gershgorin"])
def test_landmarks_arrive(bent_rig: Path, path: str, rule: str) -> None:
    more = ("drive.pose.elbow_deg=90", f"deformer.path={path}", f"deformer.step_rule={rule}")
    side = run(bent_rig, *more).result.side
    assert side.status == CONVERGED
    assert side.landmarks.max_error_mm <= LANDMARK_MM


def test_the_landmarks_alone_are_tested_where_the_rig_says_so(bent_rig: Path) -> None:
    """The paper's shortcut takes fewer steps, since it looks at fewer points; what it missed is in its report."""
    pose = "drive.pose.elbow_deg=150"
    everywhere, shortcut = run(bent_rig, pose).result, run(bent_rig, pose, "deformer.tested_at=landmarks").result
    assert shortcut.side.steps < everywhere.side.steps
    assert shortcut.side.map.points_tested == everywhere.side.map.points_tested
    assert "landmarks only" in shortcut.side.method


def test_rest_stays_at_rest(bent_rig: Path) -> None:
    result = run(bent_rig, "drive.pose.elbow_deg=0")
    np.testing.assert_array_equal(result.result.deformed.vertices(), result.job.anatomy.vertices())
    assert result.report.verdict == "passed"


def test_a_body_elsewhere_is_deformed_alike(rig: Path, tmp_path: Path) -> None:
    """Turning and shifting tissues and landmarks turns and shifts the result, and changes no measured number."""
    motion = RigidMotion.about_axis(centre=np.array([3.0, -2.0, 5.0]), axis=np.array([0.6, 0.0, 0.8]), angle_deg=40.0)
    away = write_tiny_rig(tmp_path / "away")
    for name, surface in TISSUES.items():
        moved = TriMesh(motion(surface.vertices), surface.faces)
        (away.parent / "anatomy" / f"{name}.ply").write_bytes(ply_bytes(moved))
    header, *rows = (line.split(",") for line in (rig.parent / "landmarks.csv").read_text().splitlines())
    for row in rows:
        ends = motion(np.array([row[2:5], row[5:8]], dtype=float))
        row[2:8] = [repr(float(x)) for x in ends.ravel()]
    write_landmarks(away.parent / "landmarks.csv", [header, *rows])
    here, there = (run(r, "deformer.step_rule=monotone") for r in (rig, away))
    np.testing.assert_allclose(
        there.result.deformed.vertices(), motion(here.result.deformed.vertices()), rtol=0, atol=1e-9
    )
    for a, b in zip(here.result.side.tissues, there.result.side.tissues, strict=True):
        assert a.volume_change_percent == pytest.approx(b.volume_change_percent, rel=1e-7, abs=1e-7)


# --- early ends


def test_a_run_that_stalls_is_reported_not_raised(rig: Path) -> None:
    write_landmarks(rig.with_name("landmarks.csv"), exchanged_rows())
    result = run(rig, "deformer.kernel=r2logr")
    assert result.result.deformation.status is Status.STALLED
    assert result.report.verdict == "failed"
    side = result.result.side
    assert side.status == Status.STALLED.value
    assert side.landmarks.max_error_mm > 1.0
    assert side.map.folded_points == 0
    failed = {check.name for check in result.report.checks if not check.passed}
    assert failed >= {"not converged", "landmark error"}
    with pytest.raises(NotConvergedError, match="ended early: no safe step is left") as ended:
        result.result.deformation.require()
    assert ended.value.result is result.result.deformation


def test_a_run_out_of_steps_is_reported_not_raised(bent_rig: Path) -> None:
    result = run(bent_rig, "drive.pose.elbow_deg=150", "deformer.max_steps=2")
    assert result.result.side.steps == 2
    assert "raise max_steps" in result.result.side.status
    assert result.report.verdict == "failed"


# --- progress


class Watched:
    """Keeps the stages and their ticks."""

    def __init__(self) -> None:
        self.ticks: dict[str, list[float]] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[Tick]:
        yield self.ticks.setdefault(name, []).append


def test_progress_is_told_stage_by_stage(rig: Path) -> None:
    watched = Watched()
    musclefit.retarget(musclefit.read_rig(rig, progress=watched), tets=None, progress=watched)
    assert {"read and check the surfaces", "march", "check result", "check baseline"} <= set(watched.ticks)
    for name in ("march", "check result", "check baseline"):
        told = watched.ticks[name]
        assert told == sorted(told)
        assert told[-1] == 1.0


def test_the_distances_around_locked_bones_are_told_and_made_once(bent_rig: Path) -> None:
    job, watched = musclefit.read_rig(bent_rig, overrides=("deformer.method=rigid-bones",)), Watched()
    stepper = _bone_stepper(job, watched)
    told = watched.ticks["distances around bones"]
    assert told == [(k + 1) / len(stepper.groups) for k in range(len(stepper.groups))]
    assert len(told) > 1
    assert _bone_stepper(replace(job), Silent()).locks is stepper.locks


# --- bones by their joints


def test_bones_are_held_against_the_motion_of_their_joints(bent_rig: Path) -> None:
    result = run(bent_rig, f"drive.pose.elbow_deg={BEND_DEG}")
    turn = RigidMotion.about_axis(centre=np.zeros(3), axis=np.array([0.0, 0.0, 1.0]), angle_deg=BEND_DEG)
    for name, motion in (("bone_proximal", RigidMotion.identity()), ("bone_distal", turn)):
        said = next(t for t in result.result.side.tissues if t.name == name)
        rest, after = (a[name].surface.vertices for a in (result.job.anatomy, result.result.deformed))
        off = np.linalg.norm(after - motion(rest), axis=1).max()
        assert said.rigidity_reference == "prescribed"
        assert said.rigidity_mm == pytest.approx(off, rel=1e-9)
        assert 0.01 < off < 2.0


# --- the real forearm


@pytest.fixture(scope="module")
def forearm(anatomy_data: Path) -> Retargeting:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MUSCLEFIT_DATA", str(anatomy_data))
        few = ["certificate.max_boxes=10000"]  # twice what the loop takes; the one shot, which none proves, ends soon
        return musclefit.retarget(musclefit.read_rig("forearm", overrides=few), tets=None)


@pytest.mark.anatomy
def test_the_real_forearm_arrives(forearm: Retargeting) -> None:
    """Fig. 8 of Yu et al. 2014: a real forearm to elbow 75 and forearm 70 degrees by 35 landmarks."""
    kinds = [tissue.kind.value for tissue in forearm.result.deformed]
    assert (kinds.count("skin"), kinds.count("bone"), kinds.count("muscle"), len(kinds)) == (1, 30, 39, 70)
    side = forearm.result.side
    assert (side.status, side.landmarks.count) == (CONVERGED, 35)
    assert side.landmarks.max_error_mm <= LANDMARK_MM
    assert forearm.baseline.side.landmarks.max_error_mm <= LANDMARK_MM
    assert (side.steps > 1, forearm.baseline.side.steps) == (True, 1)


@pytest.mark.anatomy
def test_the_real_forearm_does_not_fold_where_it_was_tested(forearm: Retargeting) -> None:
    side, shot = forearm.result.side, forearm.baseline.side
    assert side.map.points_tested > 200_000
    assert (side.map.folded_points, side.map.claim.value) == (0, "certified")
    assert side.map.boxes_examined > 0 == side.map.boxes_left
    assert side.map.margin >= 0 > forearm.baseline.deformation.records[0].margin, "the one shot breaks the rule"
    assert side.map.min_jacobian_determinant > max(0.0, shot.map.min_jacobian_determinant)


@pytest.mark.anatomy
@pytest.mark.parametrize("which", ["result", "baseline"])
def test_the_real_forearm_tells_what_folds_overlaps_bends_and_shrinks(forearm: Retargeting, which: str) -> None:
    report = to_json(forearm.report)
    said = report if which == "result" else report["baseline"]
    assert said["map"]["min_jacobian_determinant"] is not None
    assert said["pairs_tested"] > 100
    assert said["overlap_total"]["rest_mm3"] == pytest.approx(0.0, abs=1e-6)
    assert said["overlap_total"]["introduced_mm3"] > 1.0
    by_kind = {kind: [t for t in said["tissues"] if t["kind"] == kind] for kind in ("bone", "muscle")}
    assert max(t["rigidity_mm"] for t in by_kind["bone"]) > 1.0, "the paper's method bends bones: this says how much"
    assert {t["rigidity_reference"] for t in by_kind["bone"]} == {"prescribed"}  # joints move all 30
    assert max(abs(t["volume_change_percent"]) for t in by_kind["muscle"]) > 1.0
    assert 0.0 <= sum(t["outside_skin_mm3"] for kind in by_kind.values() for t in kind) < 0.1
    assert said["verdict"] == "failed"
    failed = {check["name"] for check in said["checks"] if not check["passed"]}
    assert failed >= {"bone off rigid", "muscle volume change"}
    assert said["mesh"] is None


# --- where the map is looked at


IMPLICIT = ("deformer.step=cayley", "deformer.kernel=isochoric-r3")


def test_an_implicit_march_keeps_its_floor_on_surfaces_cut_before_it(rig: Path) -> None:
    result = run(rig, *IMPLICIT, "surfaces.refine=true", "surfaces.longest_edge_mm=2.0").result
    side = result.side
    assert side.map.gap_mm is not None
    assert side.map.gap_mm <= 2.0 / math.sqrt(3.0) + 1e-9
    assert result.deformation.margin >= 0.2
    assert side.map.points_tested == len(result.rest.vertices())
    corners = np.concatenate([t.surface.corners() for t in result.rest])
    assert np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max() <= 2.0
    alone = result.deformation.jacobian(result.rest.vertices())
    np.testing.assert_allclose(result.determinants, np.linalg.det(alone), rtol=1e-9)
    assert side.steps_returned == 0
    said = json.loads(json.dumps(to_json(run(rig, *IMPLICIT).report)))
    assert said["map"]["gap_mm"] > 0.0
    assert {"steps_returned", "crossings_left"} <= set(said)


def test_a_coarse_surface_is_looked_at_between_its_vertices(rig: Path) -> None:
    result = run(rig, "surfaces.longest_edge_mm=1.0").result
    assert result.side.map.points_tested > 2 * len(result.rest.vertices())
    assert len(result.determinants) == len(result.rest.vertices())


def test_the_paper_s_loop_is_tested_at_the_vertices_alone(rig: Path) -> None:
    """Looking closer at the end changes no step of the loop."""
    coarse, fine = (run(rig, f"surfaces.longest_edge_mm={length}").result for length in (1.0, 100.0))
    assert coarse.deformation.records == fine.deformation.records


def test_a_higher_floor_makes_more_steps(rig: Path) -> None:
    drive_by_joints(rig)
    low, high = (run(rig, *IMPLICIT, f"deformer.margin_floor={floor}").result for floor in (0.0, 0.97))
    assert high.deformation.margin >= 0.97 > low.deformation.margin
    assert high.side.steps > low.side.steps


def test_a_floor_without_implicit_steps_is_refused(rig: Path) -> None:
    with pytest.raises(RigError, match=r"deformer.margin_floor: has no effect on \"explicit\" steps"):
        musclefit.read_rig(rig, overrides=["deformer.margin_floor=0.3"])
    with pytest.raises(RigError, match=r"deformer.margin_floor: found 1.0; expected a share of at least 0, below 1"):
        musclefit.read_rig(rig, overrides=[*IMPLICIT, "deformer.margin_floor=1.0"])
