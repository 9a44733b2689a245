"""Volumes and rigidity against formulas: scaled boxes, moved bones, a bone bent by a known amount."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError, MeshError
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.surfaces.subdivision import FaceEdges, split_edges
from musclefit.validate.model import OutsideCheck, OutsideSkin
from musclefit.validate.tissues import BEST_FIT, PRESCRIBED, check_tissues

NOTHING_OUTSIDE = OutsideCheck((), ())
TURN = RigidMotion.about_axis(centre=np.array([5.0, -3, 80]), axis=np.array([1.0, 2, -1]), angle_deg=75.0)


def box(size: float, *, name: str, kind: TissueKind, at: tuple[float, float, float] = (0, 0, 0)) -> Tissue:
    mesh = trimesh.creation.box(extents=(size, size, size))
    return Tissue(name, kind, TriMesh(np.asarray(mesh.vertices) + at, np.asarray(mesh.faces)))


def limb() -> Anatomy:
    return Anatomy(
        (
            box(4, name="femur", kind=TissueKind.BONE, at=(500, 0, 900)),
            box(2, name="tibia", kind=TissueKind.BONE),
            box(10, name="vastus", kind=TissueKind.MUSCLE),
            box(50, name="skin", kind=TissueKind.SKIN),
        ),
        "test, mm",
    )


def test_volumes_and_percent_of_a_body_scaled_by_a_tenth() -> None:
    rest = limb()
    checks = check_tissues(rest, rest.with_vertices(1.1 * rest.vertices()), motions={}, outside=NOTHING_OUTSIDE)
    assert [(c.name, c.kind) for c in checks] == [
        ("skin", "skin"), ("vastus", "muscle"), ("femur", "bone"), ("tibia", "bone")
    ]  # fmt: skip
    np.testing.assert_allclose([c.rest_volume_mm3 for c in checks], [125e3, 1e3, 64, 8], rtol=1e-12)
    np.testing.assert_allclose([c.volume_mm3 for c in checks], np.array([125e3, 1e3, 64, 8]) * 1.331, rtol=1e-12)
    np.testing.assert_allclose([c.volume_change_percent for c in checks], 33.1, rtol=1e-9)


def test_a_bone_that_does_as_told_is_rigid() -> None:
    rest = limb()
    checks = check_tissues(
        rest, rest.with_vertices(TURN(rest.vertices())), motions={"femur": TURN}, outside=NOTHING_OUTSIDE
    )
    by_name = {c.name: c for c in checks}
    assert (by_name["femur"].rigidity_reference, by_name["tibia"].rigidity_reference) == (PRESCRIBED, BEST_FIT)
    assert (by_name["skin"].rigidity_mm, by_name["vastus"].rigidity_reference) == (None, None)
    np.testing.assert_allclose([by_name["femur"].rigidity_mm, by_name["tibia"].rigidity_mm], 0, atol=1e-11)


def test_a_rigid_bone_in_the_wrong_place_is_off_its_prescribed_motion_only() -> None:
    rest = limb()
    moved = rest.with_vertices(TURN(rest.vertices()) + np.array([0, 0.3, 0.4]))
    told = {c.name: c for c in check_tissues(rest, moved, motions={"femur": TURN}, outside=NOTHING_OUTSIDE)}
    np.testing.assert_allclose(told["femur"].rigidity_mm, 0.5, rtol=1e-9)
    np.testing.assert_allclose(told["tibia"].rigidity_mm, 0.0, atol=1e-11)


def test_a_stretched_bone_is_off_its_best_fit_by_half_the_stretch() -> None:
    rest = limb()
    vertices = np.array(rest.vertices())
    tibia = rest.slices()["tibia"]
    vertices[tibia, 2] *= 1.2  # from 2 to 2.4 mm: each end moves 0.2 mm
    checks = check_tissues(rest, rest.with_vertices(vertices), motions={}, outside=NOTHING_OUTSIDE)
    np.testing.assert_allclose(checks[-1].rigidity_mm, 0.2, rtol=1e-9)


def test_the_best_fit_does_not_lean_to_where_a_bone_is_cut_finely() -> None:
    """A bone whose one end is bent aside: the same distance from rigid, however small the triangles of that end are."""
    rod = trimesh.creation.box(extents=(60.0, 6.0, 6.0)).subdivide_to_size(4.0)
    coarse = TriMesh(np.asarray(rod.vertices), np.asarray(rod.faces))
    edges = FaceEdges.of(coarse.faces)
    fine = coarse
    for _ in range(4):
        edges = FaceEdges.of(fine.faces)
        fine = split_edges(fine, edges, (fine.vertices[edges.ends][:, :, 0] > 10.0).all(axis=1))
    found = []
    for surface in (coarse, fine):
        rest = Anatomy((Tissue("rod", TissueKind.BONE, surface),), "x")
        aside = np.zeros_like(surface.vertices)
        aside[:, 1] = 0.1 * np.interp(surface.vertices[:, 0], [-30.0, 10.0, 30.0], [0.0, 0.0, 20.0])
        moved = rest.with_vertices(surface.vertices + aside)
        found.append(check_tissues(rest, moved, motions={}, outside=NOTHING_OUTSIDE)[0].rigidity_mm)
    assert len(fine.faces) > 10 * len(coarse.faces)
    np.testing.assert_allclose(found[1], found[0], rtol=0.02)


def test_volumes_outside_the_skin_are_taken_over() -> None:
    rest = limb()
    outside = OutsideCheck((OutsideSkin("vastus", 1.0, 3.0, 1.5),), ())
    skin, vastus, *_ = check_tissues(rest, rest, motions={}, outside=outside)
    assert (vastus.outside_skin_rest_mm3, vastus.outside_skin_mm3, vastus.outside_skin_introduced_mm3) == (1, 3, 1.5)
    assert (skin.outside_skin_rest_mm3, skin.outside_skin_mm3, skin.outside_skin_introduced_mm3) == (None, None, None)


def test_a_tissue_turned_inside_out_loses_more_than_all_its_volume() -> None:
    rest = limb()
    mirrored = rest.with_vertices(rest.vertices() * (-1, 1, 1))
    checks = check_tissues(rest, mirrored, motions={}, outside=NOTHING_OUTSIDE)
    np.testing.assert_allclose([c.volume_change_percent for c in checks], -200, rtol=1e-9)
    assert checks[-1].rigidity_mm is not None
    assert checks[-1].rigidity_mm > 1.0  # no rotation is a mirror


def test_wrong_input_is_refused_by_name() -> None:
    rest = limb()
    with pytest.raises(InputError, match="prescribed for 'vastus', which is not a bone; bones are: femur, tibia"):
        check_tissues(rest, rest, motions={"vastus": TURN}, outside=NOTHING_OUTSIDE)
    with pytest.raises(InputError, match="differ in: femur"):
        check_tissues(rest, Anatomy(rest.tissues[:2] + rest.tissues[3:], "x"), motions={}, outside=NOTHING_OUTSIDE)
    turned = [Tissue(t.name, t.kind, TriMesh(t.surface.vertices, t.surface.faces[:, ::-1])) for t in rest]
    with pytest.raises(MeshError, match="skin encloses -125000 mm³ at rest"):
        check_tissues(Anatomy(tuple(turned), "x"), rest, motions={}, outside=NOTHING_OUTSIDE)
