"""Tets of concentric spheres and boxes: right-handed, labelled by the innermost tissue, true to volume; attacks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.tetrahedra import (
    LABELLED_VOLUME_PERCENT,
    TetAnatomy,
    labelling_findings,
)
from musclefit.errors import InputError, MeshError
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.geometry.volumes import enclosed_volume, signed_volumes
from musclefit.io.ftetwild import tetrahedralise
from musclefit.progress import Silent

QUIET = Silent()


def sphere(radius: float, *, centre: tuple[float, float, float] = (0, 0, 0)) -> TriMesh:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    return TriMesh(np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces))


def anatomy(**surfaces: TriMesh) -> Anatomy:
    """Tissues whose names start with their kind."""
    return Anatomy(tuple(Tissue(n, TissueKind(n.split("_")[0]), s) for n, s in surfaces.items()), "test, mm")


@pytest.fixture(scope="module")
def onion() -> TetAnatomy:
    layers = anatomy(skin=sphere(30), muscle_a=sphere(20), bone_a=sphere(10))
    return tetrahedralise(layers, edge_length_fraction=0.2, envelope_fraction=2e-3, progress=QUIET)


def test_every_tet_is_right_handed(onion: TetAnatomy) -> None:
    assert signed_volumes(onion.mesh.vertices, onion.mesh.tets).min() > 0


def test_the_innermost_tissue_gets_the_tet(onion: TetAnatomy) -> None:
    radius = np.linalg.norm(onion.mesh.vertices[onion.mesh.tets].mean(axis=1), axis=1)
    names = np.array(onion.names)[onion.tissue_of_tet]
    assert onion.names == ("skin", "muscle_a", "bone_a")
    assert set(names[radius < 9.0]) == {"bone_a"}
    assert set(names[(radius > 10.3) & (radius < 18.0)]) == {"muscle_a"}
    assert set(names[radius > 20.3]) == {"skin"}


def test_labelled_volumes_are_the_surfaces(onion: TetAnatomy) -> None:
    skin, muscle, bone = (enclosed_volume(tissue.surface) for tissue in onion.anatomy)
    np.testing.assert_allclose(onion.volumes_by_tissue(), [skin - muscle, muscle - bone, bone], rtol=0.02, atol=0)
    assert (onion.findings, onion.dropped) == ((), 0)


def test_neighbours_share_faces_so_that_the_mesh_has_one_boundary(onion: TetAnatomy) -> None:
    """Every triangle belongs to one or two tets, and those of one are the skin."""
    tets = onion.mesh.tets
    triangles = np.sort(tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    unique, counts = np.unique(triangles, axis=0, return_counts=True)
    assert counts.max() == 2
    outer = np.linalg.norm(onion.mesh.vertices[unique[counts == 1]], axis=2)
    assert outer.min() > 29.0


def test_without_a_skin_the_room_between_tissues_is_left_out() -> None:
    apart = anatomy(bone_a=sphere(8), bone_b=sphere(6, centre=(20, 0, 0)))
    tets = tetrahedralise(apart, edge_length_fraction=0.2, envelope_fraction=2e-3, progress=QUIET)
    np.testing.assert_allclose(tets.volumes_by_tissue(), [enclosed_volume(t.surface) for t in apart], rtol=0.02, atol=0)
    assert set(np.unique(tets.mesh.tets)) == set(range(len(tets.mesh.vertices)))


def test_within_a_kind_the_smaller_tissue_is_the_inner_one() -> None:
    nested = anatomy(muscle_a=sphere(6), muscle_b=sphere(12))
    tets = tetrahedralise(nested, edge_length_fraction=0.2, envelope_fraction=2e-3, progress=QUIET)
    inner, outer = (enclosed_volume(t.surface) for t in nested)
    np.testing.assert_allclose(tets.volumes_by_tissue(), [inner, outer - inner], rtol=0.02, atol=0)


def test_a_tissue_hidden_in_a_further_inward_one_is_found_to_have_no_tets() -> None:
    hidden = anatomy(muscle_a=sphere(5), bone_a=sphere(12))
    tets = tetrahedralise(hidden, edge_length_fraction=0.2, envelope_fraction=2e-3, progress=QUIET)
    assert [(f.subject, f.code) for f in tets.findings] == [("muscle_a", "no-tets")]


def test_a_tissue_whose_tets_fill_another_volume_is_found(onion: TetAnatomy) -> None:
    enclosed = np.array([enclosed_volume(tissue.surface) for tissue in onion.anatomy])
    off = 1.0 + np.array([0.9, -1.1, 1.1]) * LABELLED_VOLUME_PERCENT / 100.0
    findings = labelling_findings(onion.anatomy, filled_mm3=off * enclosed, tissue_of_tet=onion.tissue_of_tet)
    assert [(f.subject, f.code) for f in findings] == [("muscle_a", "tet-volume"), ("bone_a", "tet-volume")]
    assert "-2.2 % off the" in findings[0].message


@pytest.mark.parametrize("fraction", [0.0, -0.1, 1.5, float("nan")])
def test_fractions_out_of_range_are_refused(fraction: float) -> None:
    with pytest.raises(InputError, match=r"edge_length_fraction is .* above 0 and up to 1"):
        tetrahedralise(anatomy(bone_a=sphere(1)), edge_length_fraction=fraction, envelope_fraction=1e-3, progress=QUIET)


def test_a_flat_surface_is_refused() -> None:
    flat = TriMesh(np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0.0]]), np.array([[0, 1, 2], [0, 2, 1]]))
    with pytest.raises(MeshError, match="lies inside a tissue"):
        tetrahedralise(anatomy(bone_a=flat), edge_length_fraction=0.5, envelope_fraction=1e-3, progress=QUIET)


def test_inside_out_tets_are_refused(onion: TetAnatomy) -> None:
    with pytest.raises(MeshError, match="tets are not right-handed at rest"):
        replace(onion, mesh=TetMesh(onion.mesh.vertices, onion.mesh.tets[:, [0, 2, 1, 3]]))


def test_labels_that_do_not_fit_are_refused(onion: TetAnatomy) -> None:
    with pytest.raises(MeshError, match="give one label per tet"):
        replace(onion, tissue_of_tet=onion.tissue_of_tet[1:])
    with pytest.raises(MeshError, match="the anatomy has 3 tissues"):
        replace(onion, tissue_of_tet=onion.tissue_of_tet + 1)
