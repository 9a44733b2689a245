"""The built-in limb filled with tets and bent: certified once cut finer, and manifold3d finds no overlap either."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from musclefit.anatomy.model import TissueKind
from musclefit.certify.meshes import certify_mesh
from musclefit.flow.tetrahedra import carried_tets
from musclefit.geometry.solids import overlap_volume, solid_of
from musclefit.geometry.tet_surfaces import surface_of_tets
from musclefit.io.rig_names import find_rig
from musclefit.io.rigs import read_rig
from musclefit.io.runs import prepared_tets
from musclefit.pipeline.deformers import deform
from musclefit.progress import Silent
from musclefit.validate.model import MeshClaim


@pytest.mark.slow
def test_the_bent_limb_is_certified_and_its_tissues_are_apart() -> None:
    job = read_rig(find_rig("upper_limb"), overrides=(), progress=Silent())
    tets = prepared_tets(job)
    assert tets is not None
    deformation = deform(job, job.anatomy.vertices(), progress=Silent()).deformation
    found = carried_tets(tets, deformation, max_rounds=120, max_growth=1.5, progress=Silent())
    assert (found.inverted_left, found.crossings_left, found.stopped) == (0, 0, "")
    moved = found.rest.mesh.with_vertices(found.vertices)
    assert certify_mesh(moved).claim is MeshClaim.CERTIFIED
    np.testing.assert_allclose(found.rest.volumes_by_tissue(), tets.volumes_by_tissue(), rtol=1e-12, atol=1e-9)
    labels = found.rest.tissue_of_tet
    filler = next(k for k, tissue in enumerate(found.rest.anatomy) if tissue.kind is TissueKind.SKIN)
    solids = [solid_of(surface_of_tets(moved, np.flatnonzero(labels == k))) for k in np.unique(labels) if k != filler]
    assert max(abs(overlap_volume(a, b)) for a, b in combinations(solids, 2)) < 1e-6
