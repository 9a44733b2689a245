"""Vertices moved aside where tets come out wrong: bones stand exactly, nothing is wrong any more, all of it is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tet_blocks import block, two_tissues

import musclefit.flow.tet_mending as under_test
from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.certify.meshes import certify_mesh
from musclefit.flow.tet_refinement import CarriedTets, HeldBones, mended_tets, moved_tets
from musclefit.geometry.arrays import Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.progress import Silent
from musclefit.vocabulary import Claim


def turn(degrees: float) -> RigidMotion:
    return RigidMotion.about_axis(centre=np.array([2.0, 2, 2]), axis=np.array([0, 0, 1.0]), angle_deg=degrees)


def slab_of_filler() -> TetAnatomy:
    """Two bones with filler of one cell between, whose every tet touches both, and filler around."""
    mesh = block((9, 6, 6))
    centres = mesh.vertices[mesh.tets].mean(axis=1)
    within = ((centres[:, 1:] > 1) & (centres[:, 1:] < 5)).all(axis=1)
    labels = np.zeros(len(mesh.tets), dtype=int)
    labels[within & (centres[:, 0] > 1) & (centres[:, 0] < 4)] = 1
    labels[within & (centres[:, 0] > 5) & (centres[:, 0] < 8)] = 2
    surface = TriMesh(np.eye(4)[:, :3], np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    tissues = (
        Tissue("skin", TissueKind.SKIN, surface),
        Tissue("bone_a", TissueKind.BONE, surface),
        Tissue("bone_b", TissueKind.BONE, surface),
    )
    return TetAnatomy(anatomy=Anatomy(tissues, "test, mm"), mesh=mesh, tissue_of_tet=labels, dropped=0, findings=())


def carried(rest: TetAnatomy, where: Points) -> CarriedTets:
    return replace(moved_tets(rest, lambda points: points), vertices=where, stopped="")


def assert_certified(found: CarriedTets) -> None:
    assert (found.inverted_left, found.crossings_left, found.stopped) == (0, 0, "")
    assert certify_mesh(found.rest.mesh.with_vertices(found.vertices)).claim is Claim.CERTIFIED


def test_where_nothing_is_wrong_nothing_is_moved() -> None:
    rest = two_tissues((4, 3, 3))
    given = carried(rest, turn(30.0)(rest.mesh.vertices))
    found = mended_tets(given, (), progress=Silent())
    np.testing.assert_array_equal(found.vertices, given.vertices)
    assert (found.moving_rounds, found.moved_aside, found.left_out) == (0, (), 0)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_scattered_vertices_are_set_right_and_all_of_them_told(seed: int) -> None:
    rest = two_tissues((6, 4, 4))
    size = rest.mesh.vertices.max(axis=0)
    inner = ((rest.mesh.vertices > 0) & (rest.mesh.vertices < size)).all(axis=1)
    where = np.array(rest.mesh.vertices)
    where[inner] += np.random.default_rng(seed).uniform(-1.2, 1.2, (int(inner.sum()), 3))
    assert certify_mesh(rest.mesh.with_vertices(where)).inverted > 0
    found = mended_tets(carried(rest, where), (), progress=Silent())
    assert_certified(found)
    assert found.left_out == 0
    off = np.linalg.norm(found.vertices - where, axis=1)
    for aside in found.moved_aside:
        own = off[np.unique(rest.mesh.tets[rest.tissue_of_tet == rest.names.index(aside.tissue)])]
        assert (aside.vertices, aside.farthest_mm) == ((own > 0.01).sum(), own.max())
    assert {aside.tissue for aside in found.moved_aside} == {"bone", "muscle"}


def test_a_held_bone_stands_exactly_and_the_muscle_at_it_gives_way() -> None:
    rest, motion = two_tissues((8, 4, 4)), turn(60.0)
    found = mended_tets(carried(rest, rest.mesh.vertices), (HeldBones(("bone",), motion),), progress=Silent())
    assert found.inverted_before > 0
    assert_certified(found)
    own = np.unique(rest.mesh.tets[rest.tissue_of_tet == rest.names.index("bone")])
    np.testing.assert_array_equal(found.vertices[own], motion(rest.mesh.vertices[own]))


def test_filler_between_bones_that_turn_against_each_other_is_left_out_and_nothing_else() -> None:
    """One bone turns before the other's end: filler between them has no vertex that could give way."""
    rest = slab_of_filler()
    turned = RigidMotion.about_axis(centre=np.array([0, 3.0, 3.0]), axis=np.array([1.0, 0, 0]), angle_deg=100.0)
    held = (HeldBones(("bone_a",), RigidMotion.identity()), HeldBones(("bone_b",), turned))
    beyond = rest.mesh.vertices[:, 0] > 4.5
    where = np.where(beyond[:, None], turned(rest.mesh.vertices), rest.mesh.vertices)
    found = mended_tets(carried(rest, where), held, progress=Silent())
    assert_certified(found)
    assert found.left_out > 0
    before, after = rest.volumes_by_tissue(), found.rest.volumes_by_tissue()
    np.testing.assert_allclose(before[1:], after[1:], rtol=1e-12, atol=0)
    np.testing.assert_allclose(before[0] - after[0], found.left_out_mm3, rtol=1e-9, atol=0)
    for number, bones in enumerate(held, start=1):
        own = np.unique(found.rest.mesh.tets[found.rest.tissue_of_tet == number])
        np.testing.assert_array_equal(found.vertices[own], bones.motion(found.rest.mesh.vertices[own]))


def test_what_cannot_be_mended_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bone turned inside out has no valid place, and bones never give way."""
    monkeypatch.setattr(under_test, "ROUNDS", 2)
    rest = two_tissues((4, 2, 2))
    mirror = HeldBones(("bone",), lambda points: points * [1.0, 1.0, -1.0])
    found = mended_tets(carried(rest, rest.mesh.vertices), (mirror,), progress=Silent())
    assert found.stopped == "2 rounds of moving vertices"
    assert certify_mesh(found.rest.mesh.with_vertices(found.vertices)).claim is Claim.REFUTED
