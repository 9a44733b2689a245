"""Inverted tets are counted by tissue, volumes compared; rounding never turns into a certificate."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.errors import MeshError
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.validate.model import MeshClaim
from musclefit.validate.tets import check_tets


def bar() -> TetAnatomy:
    """Two tets that share a face: a bone and a muscle, and one more of bone apart from them."""
    surface = trimesh.creation.box()
    mesh = TriMesh(np.asarray(surface.vertices), np.asarray(surface.faces))
    anatomy = Anatomy((Tissue("muscle", TissueKind.MUSCLE, mesh), Tissue("bone", TissueKind.BONE, mesh)), "test, mm")
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [5, 0, 0], [6, 0, 0], [5, 1, 0], [5, 0, 1]]
    tets = [[0, 1, 2, 3], [0, 2, 1, 4], [5, 6, 7, 8]]
    return TetAnatomy(
        anatomy=anatomy,
        mesh=TetMesh(np.array(vertices, dtype=float), np.array(tets)),
        tissue_of_tet=np.array([0, 1, 1]),
        dropped=0,
        findings=(),
    )


def test_at_rest_nothing_is_inverted_and_the_claim_is_sampled() -> None:
    rest = bar()
    check = check_tets(rest, rest.mesh.vertices)
    assert (check.tets, check.inverted, check.claim, check.inverted_by_tissue) == (3, 0, MeshClaim.SAMPLED, ())
    np.testing.assert_allclose([check.min_volume_ratio, check.max_volume_ratio], 1.0, rtol=1e-12)


def test_a_tet_pushed_through_refutes_and_names_its_tissue() -> None:
    rest = bar()
    vertices = np.array(rest.mesh.vertices)
    vertices[3, 2] = -0.5  # the muscle's apex goes through the shared face
    vertices[4, 2] = -2.0
    check = check_tets(rest, vertices)
    assert (check.inverted, check.claim, check.inverted_by_tissue) == (1, MeshClaim.REFUTED, (("muscle", 1),))
    np.testing.assert_allclose([check.min_volume_ratio, check.max_volume_ratio], [-0.5, 2.0], rtol=1e-12)


def test_a_flat_tet_is_inverted() -> None:
    rest = bar()
    vertices = np.array(rest.mesh.vertices)
    vertices[8, 2] = 0.0
    assert check_tets(rest, vertices).inverted_by_tissue == (("bone", 1),)


def test_a_mirror_inverts_all_and_lists_the_tissue_with_most_first() -> None:
    rest = bar()
    check = check_tets(rest, rest.mesh.vertices * (1, 1, -1))
    assert (check.inverted, check.inverted_by_tissue) == (3, (("bone", 2), ("muscle", 1)))


def test_rotation_and_growth_keep_all_tets() -> None:
    rest = bar()
    check = check_tets(rest, 2.0 * rest.mesh.vertices[:, [1, 2, 0]])
    assert check.claim is MeshClaim.SAMPLED
    np.testing.assert_allclose([check.min_volume_ratio, check.max_volume_ratio], 8.0, rtol=1e-12)


def test_wrong_vertices_are_refused() -> None:
    rest = bar()
    with pytest.raises(MeshError, match="move every vertex of the tet mesh"):
        check_tets(rest, rest.mesh.vertices[:-1])
    vertices = np.array(rest.mesh.vertices)
    vertices[2, 0] = np.nan
    with pytest.raises(MeshError, match="not finite"):
        check_tets(rest, vertices)
