"""Inverted tets are counted by tissue and named by place, volumes compared; the claim is that of the certificate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.errors import MeshError
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.validate.tets import check_tets, rest_findings
from musclefit.vocabulary import Claim


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


def test_at_rest_nothing_is_inverted_and_the_mesh_is_certified() -> None:
    rest = bar()
    check = check_tets(rest, rest.mesh.vertices)
    assert (check.tets, check.inverted, check.claim, check.inverted_by_tissue) == (3, 0, Claim.CERTIFIED, ())
    np.testing.assert_allclose([check.min_volume_ratio, check.max_volume_ratio], 1.0, rtol=1e-12)


def test_a_tet_pushed_through_refutes_and_names_its_tissue() -> None:
    rest = bar()
    vertices = np.array(rest.mesh.vertices)
    vertices[3, 2] = -0.5  # the muscle's apex goes through the shared face
    vertices[4, 2] = -2.0
    check = check_tets(rest, vertices)
    assert (check.inverted, check.claim, check.inverted_by_tissue) == (1, Claim.REFUTED, (("muscle", 1),))
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
    assert check.claim is Claim.CERTIFIED
    np.testing.assert_allclose([check.min_volume_ratio, check.max_volume_ratio], 8.0, rtol=1e-12)


def test_wrong_vertices_are_refused() -> None:
    rest = bar()
    with pytest.raises(MeshError, match="move every vertex of the tet mesh"):
        check_tets(rest, rest.mesh.vertices[:-1])
    vertices = np.array(rest.mesh.vertices)
    vertices[2, 0] = np.nan
    with pytest.raises(MeshError, match="not finite"):
        check_tets(rest, vertices)


def test_the_worst_tets_are_named_by_number_tissue_and_place() -> None:
    rest = bar()
    vertices = np.array(rest.mesh.vertices)
    vertices[8, 2] = -1.0  # the tet of bone apart is turned inside out
    vertices[3, 2] = 0.5  # the muscle's is pressed to half
    check = check_tets(rest, vertices)
    worst = check.worst[0]
    assert (worst.tet, worst.tissue, len(check.worst)) == (2, "bone", 3)
    np.testing.assert_allclose(worst.rest_place_mm, [5.25, 0.25, 0.25], rtol=1e-12)
    np.testing.assert_allclose(worst.place_mm, [5.25, 0.25, -0.25], rtol=1e-12)
    np.testing.assert_allclose([tet.volume_ratio for tet in check.worst], [-1.0, 0.5, 1.0], rtol=1e-12)
    assert check.note == "1 tets are inverted"
    np.testing.assert_allclose(check.straight_fraction, 0.5, rtol=0, atol=1e-9)


def test_crossing_boundaries_are_named_by_the_tissues_behind() -> None:
    rest = bar()
    vertices = np.array(rest.mesh.vertices)
    vertices[5:] += (-4.8, 0.1, 0.1)  # the tet of bone apart runs into the other two
    check = check_tets(rest, vertices)
    assert (check.inverted, check.claim) == (0, Claim.REFUTED)
    assert check.crossings == sum(count for _, _, count in check.crossing_tissues) > 0
    assert ("bone", "muscle") in [(a, b) for a, b, _ in check.crossing_tissues]


def test_slivers_and_a_mesh_that_overlaps_itself_are_found_at_rest() -> None:
    rest = bar()
    assert rest_findings(rest, sliver_deg=1.0) == ()
    vertices = np.array(rest.mesh.vertices)
    vertices[3] = (0.3, 0.3, 1e-3)
    (sliver,) = rest_findings(replace(rest, mesh=rest.mesh.with_vertices(vertices)), sliver_deg=1.0)
    assert (sliver.subject, sliver.code) == ("tet mesh", "slivers")
    assert "1 of 3 tets have faces less than 1 deg from flat" in sliver.message
    assert "in muscle at (0.325, 0.325, 0.00025) mm" in sliver.message
    vertices = np.array(rest.mesh.vertices)
    vertices[5:] += (-4.8, 0.1, 0.1)
    (crossing,) = rest_findings(replace(rest, mesh=rest.mesh.with_vertices(vertices)), sliver_deg=1.0)
    assert crossing.code == "tets-at-rest"
    assert "refuted already at rest" in crossing.message
