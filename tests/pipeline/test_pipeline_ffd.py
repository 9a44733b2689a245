"""Rigid bones by free-form deformation, an equal of radial sums on posed limbs; a whole body by plain splines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_rigs import drive_by_joints, write_tiny_rig

import musclefit
from musclefit.fields.corrected import CorrectedField
from musclefit.fields.locked import LockedField
from musclefit.geometry.surfaces.samples import surface_samples
from musclefit.io.rig_names import find_rig
from musclefit.pipeline.retarget import Retargeting
from musclefit.progress import Silent
from musclefit.rig.job import Job
from musclefit.vocabulary import Claim

SPLINES = ("deformer.backend=ffd", "compare.methods=[]")
STRICT = ("limits.bone_rigidity_mm=0.01", "limits.muscle_volume_percent=1.0")


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Job:
    rig = write_tiny_rig(tmp_path_factory.mktemp("ffd") / "rig")
    drive_by_joints(rig)
    rig.write_text(rig.read_text(encoding="utf-8").replace('kernel = "r3"\n', ""), encoding="utf-8")
    return musclefit.read_rig(rig, overrides=(*SPLINES, *STRICT, "certificate.max_boxes=200000"))


@pytest.fixture(scope="module")
def run(job: Job) -> Retargeting:
    return musclefit.retarget(job, tets=None)


def test_a_small_limb_passes_with_rigid_bones_and_a_certified_map(run: Retargeting) -> None:
    report = run.report
    assert (report.verdict, [check.name for check in report.checks if not check.passed]) == ("passed", [])
    assert run.result.side.map.claim is Claim.CERTIFIED
    assert "implicit midpoint isochoric FFD, rigid bones" in run.result.side.method


def test_no_radial_sum_is_left_in_its_steps(run: Retargeting) -> None:
    for step in run.result.deformation.steps:
        assert isinstance(step.field, LockedField)
        base = step.field.base
        assert isinstance(base, CorrectedField)
        assert len(base.radial.centres) == 0
        spacings = [level.spacing_mm for level in base.local.levels]
        assert len(spacings) > 3
        assert spacings == sorted(spacings, reverse=True)


def test_the_map_moves_a_bone_rigidly_on_its_whole_surface(job: Job, run: Retargeting) -> None:
    assert job.motions is not None
    for bone, motion in job.motions.at(1.0).items():
        places = surface_samples(job.anatomy[bone].surface, spacing_mm=0.5).points
        np.testing.assert_allclose(run.result.deformation(places), motion(places), rtol=0, atol=1e-6)


def test_the_map_keeps_volume_at_every_place_and_can_be_taken_back(job: Job, run: Retargeting) -> None:
    muscle = job.anatomy["muscle_flexor"].surface
    inside = muscle.vertices.mean(axis=0) + 0.7 * (muscle.vertices - muscle.vertices.mean(axis=0))
    moved, jacobians = run.result.deformation.with_jacobian(inside)
    np.testing.assert_allclose(np.linalg.det(jacobians), 1.0, rtol=0, atol=0.01)
    np.testing.assert_allclose(run.result.deformation.inverse()(moved), inside, rtol=0, atol=1e-9)


def test_plain_splines_do_not_keep_volume(job: Job) -> None:
    """What the test above would find of the backend without rigid bones."""
    free = musclefit.read_rig(
        Path(job.source), overrides=(*SPLINES, "deformer.method=own", "bones.rigid=false", "certificate.enabled=false")
    )
    muscle = job.anatomy["muscle_flexor"].surface
    jacobians = musclefit.retarget(free, tets=None).result.deformation.jacobian(muscle.vertices)
    assert np.abs(np.linalg.det(jacobians) - 1.0).max() > 0.05


@pytest.mark.slow
def test_the_real_forearm_passes_by_splines(anatomy_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Elbow 75, forearm 70 degrees, at the rig's own settings."""
    monkeypatch.setenv("MUSCLEFIT_DATA", str(anatomy_data))
    forearm = musclefit.read_rig(find_rig("forearm_rigid"), overrides=SPLINES, progress=Silent())
    run = musclefit.retarget(forearm, tets=None)
    assert (run.report.verdict, [check.name for check in run.report.checks if not check.passed]) == ("passed", [])
    assert run.result.side.map.claim is Claim.CERTIFIED
    changes = [abs(t.volume_change_percent or 0.0) for t in run.result.side.of_kind(musclefit.TissueKind.MUSCLE)]
    assert len(changes) == 39
    assert max(changes) < 1.0


@pytest.mark.slow
def test_a_whole_body_ends_by_splines(anatomy_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """688 tissues by the 509 vertices of a cage, 13 mm apart at the closest: one lattice of 20 mm tells them apart."""
    monkeypatch.setenv("MUSCLEFIT_DATA", str(anatomy_data))
    body = musclefit.read_rig(find_rig("body_heavy"), overrides=SPLINES, progress=Silent())
    run = musclefit.retarget(body, tets=None)
    assert (run.report.verdict, [check.name for check in run.report.checks if not check.passed]) == ("passed", [])
    assert run.result.side.map.claim is Claim.CERTIFIED
    assert run.result.deformation.stretches <= 3
    assert run.result.side.landmarks.max_error_mm < 1e-9
