"""Limbs filled with tets and bent: certified once mended, and manifold3d finds no overlap either; slow."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from tet_surfaces import surface_of_tets

from musclefit.anatomy.model import TissueKind
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.certify.meshes import certify_mesh
from musclefit.flow.tet_refinement import CarriedTets, HeldBones, carried_tets, mended_tets, moved_tets
from musclefit.geometry.arrays import Points
from musclefit.geometry.queries.solids import overlap_volume, solid_of
from musclefit.io.rig_names import find_rig
from musclefit.io.rigs import read_rig
from musclefit.pipeline.deformers import deform
from musclefit.progress import Silent
from musclefit.rig.job import Job
from musclefit.validate.tets import check_tets
from musclefit.vocabulary import Claim
from musclefit.workflows.run import prepared_tets

RIGID = ("tets.enabled=true", "bones.handle_spacing_mm=9", "bones.iterations=40")


LOOP = ("deformer.method=own", "bones.rigid=false", "deformer.kernel=r2logr", "deformer.step=explicit")
"""Explicit steps along the joints: a map that folds nowhere and turns tets inside out."""


@pytest.mark.slow
def test_the_bent_limb_is_certified_and_its_tissues_are_apart() -> None:
    job = read_rig(find_rig("upper_limb"), overrides=LOOP, progress=Silent())
    tets = prepared_tets(job)
    assert tets is not None
    deformation = deform(job, job.anatomy.vertices(), progress=Silent()).deformation
    found = carried_tets(tets, deformation, max_rounds=120, max_growth=1.5, progress=Silent())
    assert (found.inverted_left, found.crossings_left, found.stopped) == (0, 0, "")
    moved = found.rest.mesh.with_vertices(found.vertices)
    assert certify_mesh(moved).claim is Claim.CERTIFIED
    np.testing.assert_allclose(found.rest.volumes_by_tissue(), tets.volumes_by_tissue(), rtol=1e-12, atol=1e-9)
    assert largest_overlap(found.rest, found.vertices) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("number", range(3))
def test_a_limb_bent_deeper_is_certified_with_whatever_mesh_comes(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tetrahedraliser makes another mesh each time; compressed muscles must not fold onto themselves in any."""
    monkeypatch.setenv("MUSCLEFIT_CACHE", str(tmp_path / str(number)))
    pose = ("drive.pose.elbow_deg=100", "drive.pose.forearm_deg=80", "mesh.refine=true")
    job = read_rig(find_rig("upper_limb"), overrides=pose, progress=Silent())
    tets = prepared_tets(job)
    assert tets is not None
    found, _ = certified_with_rigid_bones(job, tets)
    assert_only_filler_was_left_out(tets, found.rest)


@pytest.mark.slow
def test_the_real_forearm_with_rigid_bones_is_certified_and_its_tissues_are_apart(
    anatomy_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All 70 surfaces in one mesh, elbow 75, forearm 70 degrees; meshed now (10 minutes) unless the cache has it."""
    monkeypatch.setenv("MUSCLEFIT_DATA", str(anatomy_data))
    job = read_rig(find_rig("forearm_rigid"), overrides=RIGID, progress=Silent())
    tets = prepared_tets(job)
    assert tets is not None
    assert len(job.anatomy) == 70
    fits = {fit.name: fit for fit in tets.fits}
    for tissue in job.anatomy:
        fit = fits[tissue.name]
        assert fit.tets > 0
        assert fit.surface_mm3 is not None
        np.testing.assert_allclose(fit.volume_mm3, fit.surface_mm3, rtol=0.02, atol=0, err_msg=tissue.name)
    found, held = certified_with_rigid_bones(job, tets)
    assert set(found.rest.tissue_of_tet) == set(range(70))
    assert found.left_out_mm3 < 1e-3 * tets.volumes_by_tissue()[skin_of(tets)]
    assert_only_filler_was_left_out(tets, found.rest)
    for bones in held:
        numbers = [k for k, tissue in enumerate(job.anatomy) if tissue.name in bones.names]
        own = np.unique(found.rest.mesh.tets[np.isin(found.rest.tissue_of_tet, numbers)])
        np.testing.assert_array_equal(found.vertices[own], bones.motion(found.rest.mesh.vertices[own]))
    assert largest_overlap(found.rest, found.vertices) < 1e-6


def certified_with_rigid_bones(job: Job, tets: TetAnatomy) -> tuple[CarriedTets, list[HeldBones]]:
    """The tets of a job with rigid bones, moved and mended, which must be certified; and what was held."""
    assert job.motions is not None
    deformed = deform(job, job.anatomy.vertices(), progress=Silent())
    motions = job.motions.at(1.0)
    held = [HeldBones(group.bones, motions[group.bones[0]]) for group in deformed.groups]
    found = mended_tets(moved_tets(tets, deformed.deformation), held, progress=Silent())
    check = check_tets(found.rest, found.vertices)
    assert (check.claim, check.inverted, check.crossings) == (Claim.CERTIFIED, 0, 0)
    return found, held


def skin_of(tets: TetAnatomy) -> int:
    return next(k for k, tissue in enumerate(tets.anatomy) if tissue.kind is TissueKind.SKIN)


def assert_only_filler_was_left_out(before: TetAnatomy, after: TetAnatomy) -> None:
    filler = skin_of(before)
    given, kept = before.volumes_by_tissue(), after.volumes_by_tissue()
    others = np.arange(len(given)) != filler
    np.testing.assert_allclose(kept[others], given[others], rtol=1e-12, atol=0)
    assert kept[filler] <= given[filler]


def largest_overlap(tets: TetAnatomy, vertices: Points) -> float:
    """Of any two tissues, by manifold3d on the surfaces of their tets, mm³."""
    moved, labels = tets.mesh.with_vertices(vertices), tets.tissue_of_tet
    parts = [np.flatnonzero(labels == k) for k in np.unique(labels) if k != skin_of(tets)]
    solids = [solid_of(surface_of_tets(moved, part)) for part in parts]
    return max(abs(overlap_volume(a, b)) for a, b in combinations(solids, 2))
