"""Tets of spheres and boxes: right-handed, conforming, labelled by priority, true to volume and distance; attacks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.joint_space import SlidingBones, without_joint_space
from musclefit.anatomy.mesh_fidelity import (
    LABELLED_VOLUME_PERCENT,
    TissueFit,
    fit_findings,
    joined,
    pieces_of_surface,
    pieces_of_tets,
)
from musclefit.anatomy.mesh_rules import FILLER, Gaps, LayerRules, gap_widths
from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.tetrahedra import TetAnatomy, surface_faces, tetrahedralise_with
from musclefit.errors import InputError, MeshError
from musclefit.geometry.measures import enclosed_volume, signed_volumes
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.tets.topology import interface, tet_faces
from musclefit.meshing.ftetwild import fill, tetrahedralise
from musclefit.progress import Silent

QUIET = Silent()
RULES = LayerRules(edge_length_fraction=0.2, envelope_fraction=2e-3)


def sphere(radius: float, *, centre: tuple[float, float, float] = (0, 0, 0)) -> TriMesh:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    return TriMesh(np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces))


def anatomy(**surfaces: TriMesh) -> Anatomy:
    """Tissues whose names start with their kind."""
    return Anatomy(tuple(Tissue(n, TissueKind(n.split("_")[0]), s) for n, s in surfaces.items()), "test, mm")


@pytest.fixture(scope="module")
def onion() -> TetAnatomy:
    layers = anatomy(skin=sphere(30), muscle_a=sphere(20), bone_a=sphere(10))
    return tetrahedralise(layers, RULES, progress=QUIET)


def test_every_tet_is_right_handed(onion: TetAnatomy) -> None:
    assert signed_volumes(onion.mesh.vertices, onion.mesh.tets).min() > 0


def test_the_innermost_tissue_gets_the_tet(onion: TetAnatomy) -> None:
    radius = np.linalg.norm(onion.mesh.vertices[onion.mesh.tets].mean(axis=1), axis=1)
    names = np.array(onion.names)[onion.tissue_of_tet]
    assert onion.names == (FILLER, "muscle_a", "bone_a")
    assert set(names[radius < 9.0]) == {"bone_a"}
    assert set(names[(radius > 10.3) & (radius < 18.0)]) == {"muscle_a"}
    assert set(names[radius > 20.3]) == {FILLER}


def test_labelled_volumes_are_the_surfaces(onion: TetAnatomy) -> None:
    skin, muscle, bone = (enclosed_volume(tissue.surface) for tissue in onion.anatomy)
    np.testing.assert_allclose(onion.volumes_by_tissue(), [skin - muscle, muscle - bone, bone], rtol=0.02, atol=0)
    assert onion.findings == ()


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
    tets = tetrahedralise(apart, RULES, progress=QUIET)
    np.testing.assert_allclose(tets.volumes_by_tissue(), [enclosed_volume(t.surface) for t in apart], rtol=0.02, atol=0)
    assert set(np.unique(tets.mesh.tets)) == set(range(len(tets.mesh.vertices)))


def test_within_a_kind_the_smaller_tissue_is_the_inner_one() -> None:
    nested = anatomy(muscle_a=sphere(6), muscle_b=sphere(12))
    tets = tetrahedralise(nested, RULES, progress=QUIET)
    inner, outer = (enclosed_volume(t.surface) for t in nested)
    np.testing.assert_allclose(tets.volumes_by_tissue(), [inner, outer - inner], rtol=0.02, atol=0)


def test_a_tissue_hidden_in_one_that_wins_is_found_to_have_no_tets() -> None:
    hidden = anatomy(muscle_a=sphere(5), bone_a=sphere(12))
    tets = tetrahedralise(hidden, RULES, progress=QUIET)
    assert [(f.subject, f.code) for f in tets.findings] == [("muscle_a", "no-tets"), ("filler", "no-skin")]


def test_a_tissue_whose_tets_fill_another_volume_is_found(onion: TetAnatomy) -> None:
    off = (0.9, -1.1, 1.1)
    fits = tuple(
        replace(fit, inside_mm3=fit.surface_mm3 * (1.0 + share * LABELLED_VOLUME_PERCENT / 100.0))
        for fit, share in zip([f for f in onion.fits if f.surface_mm3 is not None], off, strict=True)
    )
    findings = fit_findings(fits)
    assert [(f.subject, f.code) for f in findings] == [("muscle_a", "tet-volume"), ("bone_a", "tet-volume")]
    assert "-2.2 % off the" in findings[0].message


@pytest.mark.parametrize("fraction", [0.0, -0.1, 1.5, float("nan")])
def test_fractions_out_of_range_are_refused(fraction: float) -> None:
    rules = LayerRules(edge_length_fraction=fraction, envelope_fraction=1e-3)
    with pytest.raises(InputError, match=r"edge_length_fraction is .* above 0 and up to 1"):
        tetrahedralise(anatomy(bone_a=sphere(1)), rules, progress=QUIET)


def test_a_flat_surface_is_refused() -> None:
    flat = TriMesh(np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0.0]]), np.array([[0, 1, 2], [0, 2, 1]]))
    with pytest.raises(MeshError, match="lies inside a tissue"):
        tetrahedralise(anatomy(bone_a=flat), replace(RULES, edge_length_fraction=0.5), progress=QUIET)


def test_inside_out_tets_are_refused(onion: TetAnatomy) -> None:
    with pytest.raises(MeshError, match="tets are not right-handed at rest"):
        replace(onion, mesh=TetMesh(onion.mesh.vertices, onion.mesh.tets[:, [0, 2, 1, 3]]))


def test_labels_that_do_not_fit_are_refused(onion: TetAnatomy) -> None:
    with pytest.raises(MeshError, match="give one label per tet"):
        replace(onion, tissue_of_tet=onion.tissue_of_tet[1:])
    with pytest.raises(MeshError, match="the anatomy has 3 tissues"):
        replace(onion, tissue_of_tet=onion.tissue_of_tet + 1)


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> TriMesh:
    mesh = trimesh.creation.box(bounds=[low, high]).subdivide().subdivide()
    return TriMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))


@pytest.fixture(scope="module")
def blocks() -> TetAnatomy:
    """In a skin, two muscles that touch with a whole face, and two bones 2 mm apart."""
    layers = anatomy(
        skin=box((-4, -5, -5), (44, 13, 13)),
        muscle_a=box((0, 0, 0), (10, 8, 8)),
        muscle_b=box((10, 0, 0), (18, 8, 8)),
        bone_a=box((22, 0, 0), (30, 8, 8)),
        bone_b=box((32, 0, 0), (40, 8, 8)),
    )
    return tetrahedralise(layers, replace(RULES, gaps=Gaps.JOINTS, gap_ratio=1.0), progress=QUIET)


def test_blocks_that_touch_share_the_faces_between_them(blocks: TetAnatomy) -> None:
    """By topology: the triangles between the two are faces of tets of both, and their area is that of the wall."""
    faces = tet_faces(blocks.mesh.tets)
    assert len(faces.odd) == 0
    labels = np.append(blocks.tissue_of_tet, -1)[faces.tets]
    wall = faces.corners[(np.sort(labels, axis=1) == [1, 2]).all(axis=1)]
    corners = blocks.mesh.vertices[wall]
    assert np.abs(corners[..., 0] - 10.0).max() < 0.15
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    np.testing.assert_allclose(area, 64.0, rtol=0.03, atol=0)


def test_filler_is_what_the_skin_holds_beside_the_tissues(blocks: TetAnatomy) -> None:
    by_name = dict(zip(blocks.names, blocks.volumes_by_tissue(), strict=True))
    np.testing.assert_allclose(by_name[FILLER], 48 * 18 * 18 - 64 * 34, rtol=4e-3, atol=0)
    np.testing.assert_allclose([by_name["muscle_a"], by_name["bone_b"]], [640, 512], rtol=0.02, atol=0)
    fits = {fit.name: fit for fit in blocks.fits}
    assert list(fits) == ["skin", FILLER, "muscle_a", "muscle_b", "bone_a", "bone_b"]
    np.testing.assert_allclose(fits[FILLER].volume_mm3, by_name[FILLER], rtol=1e-12, atol=0)
    assert fits["skin"].tets == len(blocks.mesh.tets)


def test_surfaces_of_tets_are_as_near_to_the_given_ones_as_is_said(onion: TetAnatomy) -> None:
    faces = tet_faces(onion.mesh.tets)
    for fit in onion.fits:
        if fit.kind not in ("bone", "skin"):
            continue
        inside = np.flatnonzero(onion.tissue_of_tet == 2) if fit.kind == "bone" else np.arange(len(onion.mesh.tets))
        corners = onion.mesh.vertices[interface(faces, inside, count=len(onion.mesh.tets))]
        sampled = nearest_places(corners.mean(axis=1), onion.anatomy[fit.name].surface).distances
        assert sampled.max() <= fit.off_mm + 1e-9
        assert fit.off_mm <= 1.0001 * fit.envelope_mm
        assert 0.0 <= fit.missed_mm <= 2.0 * fit.envelope_mm


def test_tets_that_came_left_handed_are_counted(onion: TetAnatomy) -> None:
    """fTetWild hands out every tet turned."""
    assert onion.turned == len(onion.mesh.tets) + onion.dropped


def test_where_tissues_overlap_the_priority_says_whose_the_tets_are() -> None:
    both = anatomy(
        bone_a=box((0, 0, 0), (10, 10, 10)),
        muscle_a=box((5, 0, 0), (15, 10, 10)),
        muscle_b=box((12, 0, 0), (22, 10, 10)),
    )
    filled = fill(both.vertices(), surface_faces(both), edge_length_fraction=0.2, envelope_fraction=2e-3)

    def same(*_: object, **__: object) -> tuple[np.ndarray, np.ndarray]:
        return filled

    usual = tetrahedralise_with(same, both, rules=RULES, progress=QUIET)
    volumes = dict(zip(usual.names, usual.volumes_by_tissue(), strict=True))
    np.testing.assert_allclose(volumes["bone_a"], 1000, rtol=0.02, atol=0)
    yielded = {fit.name: fit.yielded_mm3 for fit in usual.fits}
    np.testing.assert_allclose(yielded["bone_a"], 0.0, rtol=0, atol=1e-6)
    np.testing.assert_allclose(sum(yielded.values()), 500 + 300, rtol=0.04, atol=0)
    rules = replace(RULES, priority=("muscle_b", "muscle", "bone"))
    other = tetrahedralise_with(same, both, rules=rules, progress=QUIET)
    volumes = dict(zip(other.names, other.volumes_by_tissue(), strict=True))
    np.testing.assert_allclose(
        [volumes[name] for name in ("muscle_b", "muscle_a", "bone_a")], [1000, 700, 500], rtol=0.02, atol=0
    )


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"priority": ("bone", "tendon")}, "priority: no tissue is named 'tendon'; there are: skin, bone_a"),
        ({"priority": ("sk*",)}, "priority names the skin"),
        ({"edge_length_mm": (("bone_b", 1.0),)}, "edge_length_mm: no tissue is named 'bone_b'"),
        ({"envelope_mm": (("bone_a", 0.0),)}, "envelope_mm of 'bone_a' is 0.0"),
        ({"gap_ratio": float("nan")}, "gap_ratio is nan"),
    ],
)
def test_rules_that_do_not_fit_the_anatomy_are_refused(changed: dict[str, object], told: str) -> None:
    with pytest.raises(InputError, match=told.replace("*", r"\*")):
        replace(RULES, **changed).require_sane(anatomy(skin=sphere(5), bone_a=sphere(2)))


def test_a_tissue_may_not_be_called_as_the_filler_is() -> None:
    named = Anatomy((Tissue(FILLER, TissueKind.OTHER, sphere(1)),), "test, mm")
    with pytest.raises(InputError, match="rename it"):
        tetrahedralise(named, RULES, progress=QUIET)


def test_the_smallest_envelope_asked_for_counts_and_the_first_pattern_that_fits() -> None:
    layers = anatomy(skin=sphere(30), muscle_a=sphere(20), bone_a=sphere(10))
    rules = replace(RULES, envelope_mm=(("bone_*", 0.05), ("*_a", 0.02)))
    diagonal = float(np.linalg.norm(np.ptp(layers.vertices(), axis=0)))
    np.testing.assert_allclose(rules.smallest_envelope(layers), 0.02 / diagonal, rtol=1e-12)
    assert rules.envelope_of(layers["bone_a"], diagonal_mm=diagonal) == 0.05
    assert rules.envelope_of(layers["skin"], diagonal_mm=diagonal) == 2e-3 * diagonal


def test_gaps_are_as_wide_as_between_spheres() -> None:
    pair = anatomy(skin=sphere(40), bone_a=sphere(8), bone_b=sphere(6, centre=(15, 0, 0)), muscle_a=sphere(3))
    widths = gap_widths(pair, gaps=Gaps.JOINTS, up_to_mm=3.0)
    assert set(widths) == {"bone_a", "bone_b"}
    vertices = pair["bone_a"].surface.vertices
    exact = np.linalg.norm(vertices - [15, 0, 0], axis=1) - 6
    near = np.isfinite(widths["bone_a"])
    assert near.any()
    np.testing.assert_allclose(widths["bone_a"][near], exact[near], rtol=0, atol=0.25)  # facets lie inside the sphere
    assert (exact[~near] > 2.7).all()
    assert set(gap_widths(pair, gaps=Gaps.ALL, up_to_mm=3.0)) == {"bone_a", "bone_b", "muscle_a"}
    assert gap_widths(pair, gaps=Gaps.NONE, up_to_mm=3.0) == {}


REST = {"bone_a": RigidMotion.identity(), "bone_b": RigidMotion.identity()}


def test_joint_space_is_left_out_as_a_void_walled_by_bones(blocks: TetAnatomy) -> None:
    sliding = SlidingBones((("bone_a",), ("bone_b",)), (REST,))
    open_ = without_joint_space(blocks, sliding, zone_mm=2.3)
    corners = blocks.mesh.vertices[blocks.mesh.tets[blocks.tissue_of_tet == 0]]
    places = np.concatenate([corners, corners.mean(axis=1, keepdims=True)], axis=1)
    apart = sum(
        np.linalg.norm(np.maximum(0, np.maximum([low, 0, 0] - places, places - [low + 8, 8, 8])), axis=2)
        for low in (22, 32)
    )
    assert open_.joint_space_tets == (apart.min(axis=1) <= 2.3).sum()
    assert open_.joint_space_mm3 > 2 * 8 * 8  # all of the gap, and a rim
    before = dict(zip(blocks.names, blocks.volumes_by_tissue(), strict=True))
    after = dict(zip(open_.names, open_.volumes_by_tissue(), strict=True))
    np.testing.assert_allclose(before[FILLER] - after[FILLER], open_.joint_space_mm3, rtol=1e-9, atol=0)
    assert (before["bone_a"], before["bone_b"]) == (after["bone_a"], after["bone_b"])
    faces = tet_faces(open_.mesh.tets)
    centres = open_.mesh.vertices[faces.boundary].mean(axis=1)
    middle = (np.abs(centres - [31, 4, 4]) < [2.5, 3, 3]).all(axis=1)
    owners = np.array(open_.names)[open_.tissue_of_tet[faces.boundary_tets[middle]]]
    assert set(owners) == {"bone_a", "bone_b"}
    np.testing.assert_allclose(np.sort(np.unique(np.round(centres[middle][:, 0]))), [30, 32])


def test_bones_that_move_as_one_keep_what_is_between_them(blocks: TetAnatomy) -> None:
    together = SlidingBones((("bone_a", "bone_b"),), (REST,))
    assert without_joint_space(blocks, together, zone_mm=3.0) is blocks
    sliding = SlidingBones((("bone_a",), ("bone_b",)), (REST,))
    bridging = without_joint_space(blocks, sliding, zone_mm=0.9)  # nothing is near both, but tets span the gap
    tets, owners = blocks.mesh.tets, np.array(blocks.names)[blocks.tissue_of_tet]
    ends = [np.isin(tets, tets[owners == bone]).any(axis=1) for bone in ("bone_a", "bone_b")]
    spanning = (owners == FILLER) & ends[0] & ends[1]
    volumes = np.abs(np.linalg.det(np.diff(blocks.mesh.vertices[tets[spanning]], axis=1))) / 6.0
    np.testing.assert_allclose(bridging.joint_space_mm3, volumes.sum(), rtol=1e-9, atol=0)
    assert bridging.joint_space_mm3 > 0.4 * 2 * 8 * 8  # the gap, but for what lies on one bone only


def test_bones_that_come_near_on_the_way_count(blocks: TetAnatomy) -> None:
    """At rest they are too far apart for the zone; a pose brings them nearer."""
    nearer = {**REST, "bone_b": RigidMotion(np.eye(3), np.array([-1.5, 0, 0]))}
    sliding = SlidingBones((("bone_a",), ("bone_b",)), (REST, nearer))
    open_ = without_joint_space(blocks, sliding, zone_mm=1.8)
    assert open_.joint_space_tets > 0


def test_short_edges_where_a_tissue_asks_for_them() -> None:
    pair = anatomy(bone_a=sphere(8), bone_b=sphere(8, centre=(30, 0, 0)))
    fine = tetrahedralise(pair, replace(RULES, edge_length_mm=(("bone_b", 2.5),)), progress=QUIET)
    counts = np.bincount(fine.tissue_of_tet, minlength=2)
    assert counts[1] > 2 * counts[0]


def test_a_fit_says_how_far_its_volume_is_off() -> None:
    fit = TissueFit("a", "bone", 3, volume_mm3=80.0, surface_mm3=100.0, inside_mm3=98.0)
    np.testing.assert_allclose([fit.volume_error_percent, fit.yielded_mm3], [-2.0, 18.0], rtol=1e-12)
    filler = TissueFit(FILLER, FILLER, 3, volume_mm3=80.0)
    assert (filler.volume_error_percent, filler.yielded_mm3) == (None, None)


def test_pieces_of_tets_and_surfaces_are_counted(blocks: TetAnatomy) -> None:
    """Two bones apart are two pieces together, two muscles that touch are one."""
    faces = tet_faces(blocks.mesh.tets)
    for kind, pieces in (("bone", 2), ("muscle", 1)):
        numbers = [k for k, name in enumerate(blocks.names) if name.startswith(kind)]
        assert pieces_of_tets(faces, inside=np.isin(blocks.tissue_of_tet, numbers)) == pieces
    assert [fit.pieces for fit in blocks.fits] == [1, None, 1, 1, 1, 1]
    pair = [blocks.anatomy[name].surface for name in ("bone_a", "bone_b")]
    both = TriMesh(
        np.concatenate([s.vertices for s in pair]),
        np.concatenate([pair[0].faces, pair[1].faces + len(pair[0].vertices)]),
    )
    assert [pieces_of_surface(s) for s in (*pair, both)] == [1, 1, 2]


def test_a_tet_that_no_face_joins_to_its_tissue_is_left_to_the_next(blocks: TetAnatomy) -> None:
    """As if one tet in the middle of a muscle had its barycentre inside a bone as well."""
    faces = tet_faces(blocks.mesh.tets)
    bone = blocks.tissue_of_tet == blocks.names.index("bone_a")
    stray = bone.copy()
    stray[np.flatnonzero(blocks.tissue_of_tet == blocks.names.index("muscle_a"))[7]] = True
    np.testing.assert_array_equal(joined(faces, inside=stray), bone)
    np.testing.assert_array_equal(joined(faces, inside=stray & ~bone), stray & ~bone)  # nothing else is left
    assert [fit.alone for fit in blocks.fits] == [0] * 6


def test_a_tissue_that_came_apart_is_found() -> None:
    fit = TissueFit(
        "a", "bone", 3, 98.0, surface_mm3=100.0, inside_mm3=98.5, envelope_mm=0.1, pieces=3, surface_pieces=1
    )
    (found,) = fit_findings((fit,))
    assert (found.subject, found.code) == ("a", "tet-pieces")
    assert "fall into 3 pieces, its surface into 1" in found.message
    assert fit_findings((replace(fit, surface_pieces=3),)) == ()
