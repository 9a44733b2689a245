"""What a result is shown beside: the paper's loop on the same handles, wherever the method is not that loop itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_rigs import drive_by_joints, write_tiny_rig

import musclefit
from musclefit.pipeline.comparisons import is_papers_loop, papers_loop
from musclefit.pipeline.retarget import Retargeting
from musclefit.progress import CERTIFY, MARCH
from musclefit.rig.job import Job
from musclefit.vocabulary import Claim, Method

IMPLICIT = ("deformer.kernel=isochoric-r3", "deformer.step=cayley")
ALONG_JOINTS = (*IMPLICIT, "deformer.path=joints")
RIGID = ("deformer.method=rigid-bones",)


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    path = write_tiny_rig(tmp_path / "rig")
    drive_by_joints(path)
    return path


@pytest.fixture
def landmark_rig(tmp_path: Path) -> Path:
    return write_tiny_rig(tmp_path / "landmarks")


def read(rig: Path, *overrides: str) -> Job:
    return musclefit.read_rig(rig, overrides=overrides)


def run(rig: Path, *overrides: str) -> Retargeting:
    return musclefit.retarget(read(rig, *overrides), tets=None)


@pytest.mark.parametrize("overrides", [ALONG_JOINTS, ("deformer.path=joints",), IMPLICIT])
def test_the_loop_beside_a_result_is_the_run_of_that_method(rig: Path, overrides: tuple[str, ...]) -> None:
    """Every number of it is that of a run by `method = "yu2014"`."""
    beside = run(rig, *overrides).paper_loop
    assert beside is not None
    kernel = "r3" if overrides == ("deformer.path=joints",) else "r2logr"
    by_itself = run(rig, "deformer.method=yu2014", f"deformer.kernel={kernel}", "certificate.enabled=false")
    assert by_itself.job.rig.deformer.method is Method.YU2014
    np.testing.assert_array_equal(beside.deformed.vertices(), by_itself.result.deformed.vertices())
    assert beside.side == by_itself.result.side
    assert by_itself.paper_loop is None


def test_rigid_bones_are_shown_beside_the_loop_that_bends_them(rig: Path) -> None:
    result = run(rig, *RIGID, "certificate.enabled=false", "surfaces.longest_edge_mm=8")
    loop = result.paper_loop
    assert loop is not None
    bends = {
        name: max(t.rigidity_mm or 0.0 for t in side.tissues)
        for name, side in (("ours", result.result.side), ("loop", loop.side))
    }
    assert bends["ours"] <= 0.01 < bends["loop"]
    assert {t.rigidity_reference for t in loop.side.of_kind(musclefit.TissueKind.BONE)} == {"prescribed"}
    assert loop.side.map.claim.value == "sampled"
    assert [len(t.surface.faces) for t in loop.deformed] == [len(t.surface.faces) for t in result.job.anatomy]


@pytest.mark.parametrize(
    ("overrides", "itself"),
    [
        ((), True),
        (("deformer.path=joints",), False),
        (("deformer.step_rule=gershgorin",), False),
        (("deformer.tested_at=landmarks",), True),
        (("deformer.kernel=isochoric-r3",), False),
        (("deformer.backend=ffd",), True),
        (('bones.keep_rigid=["bone_distal"]',), False),
        (IMPLICIT, False),
    ],
)
def test_it_is_left_out_where_it_is_the_method_itself(rig: Path, overrides: tuple[str, ...], itself: bool) -> None:
    job = read(rig, *overrides)
    assert is_papers_loop(job) is itself
    assert (papers_loop(job) is None) is itself


def test_it_goes_straight_by_the_rigs_own_handles(rig: Path) -> None:
    job = read(rig, *ALONG_JOINTS, "drive.keyframes=[{ at = 0.5, elbow_deg = 20 }]")
    loop = papers_loop(job)
    assert loop is not None
    assert loop.handles is job.handles
    assert (job.stops, loop.stops) == ((0.5,), ())
    start, end = job.handles.source, job.path.position(1.0)
    np.testing.assert_allclose(loop.path.position(0.5), 0.5 * (start + end), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(loop.path.position(1.0), end)


def test_keyframes_of_landmarks_are_gone_through(landmark_rig: Path) -> None:
    rows = (landmark_rig.parent / "landmarks.csv").read_text(encoding="utf-8").splitlines()
    half = [",".join(cells[:2] + cells[5:8]) for cells in (row.split(",") for row in rows)]
    half[0] = "name,bone,x_mm,y_mm,z_mm"
    (landmark_rig.parent / "half.csv").write_text("\n".join(half) + "\n", encoding="utf-8")
    loop = papers_loop(read(landmark_rig, *IMPLICIT, 'drive.keyframes=[{ at = 0.5, file = "half.csv" }]'))
    assert loop is not None
    assert loop.stops == (0.5,)


@pytest.mark.parametrize(
    ("methods", "loop", "shot"),
    [
        ("[]", False, False),
        ('["one-shot"]', False, True),
        ('["yu2014"]', True, False),
        ('["yu2014", "one-shot"]', True, True),
    ],
)
def test_a_rig_says_what_it_is_shown_beside(rig: Path, methods: str, loop: bool, shot: bool) -> None:
    result = run(rig, *ALONG_JOINTS, f"compare.methods={methods}", "certificate.enabled=false")
    assert (result.paper_loop is not None, result.baseline is not None) == (loop, shot)
    report = result.report
    assert (report.paper_loop is not None, report.baseline is not None) == (loop, shot)


def test_its_march_is_no_part_of_what_the_proof_is_compared_with(rig: Path) -> None:
    from musclefit.workflows.progress import TimedStages

    stages = TimedStages(shown=False)
    musclefit.retarget(read(rig, *ALONG_JOINTS), tets=None, progress=stages)
    assert {MARCH, CERTIFY, "march the paper's loop", "check the paper's loop"} <= set(stages.seconds)


def test_with_tets_they_are_moved_as_they_are(rig: Path) -> None:
    job = read(rig, *ALONG_JOINTS, "certificate.enabled=false")
    tets = musclefit.tetrahedralise(job.anatomy, musclefit.LayerRules(0.2, 0.01))
    loop = musclefit.retarget(job, tets=tets).paper_loop
    assert loop is not None
    assert loop.tets is not None
    assert loop.tet_vertices is not None
    assert loop.side.mesh is not None
    assert loop.side.mesh.refinement is None
    np.testing.assert_allclose(loop.tet_vertices, loop.deformation(tets.mesh.vertices), rtol=0, atol=1e-12)


def test_what_a_result_is_compared_with_has_a_small_part_of_its_budget_of_boxes(rig: Path) -> None:
    done = run(rig, *ALONG_JOINTS, "certificate.max_boxes=10000")
    baseline = done.baseline
    assert baseline is not None
    of_result, of_baseline = done.result.side.map, baseline.side.map
    assert of_result.claim is Claim.CERTIFIED
    assert of_result.boxes_examined > 500
    assert of_baseline.claim is Claim.UNDECIDED
    assert of_baseline.boxes_examined <= 500
