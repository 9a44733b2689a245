"""Planted defects of every kind are found, repaired and named; clean surfaces come back as they are."""

from __future__ import annotations

import numpy as np
import pytest
from planted import ball, box, joined, moebius, voxels

from musclefit.anatomy.repair.records import RepairSettings, Way
from musclefit.anatomy.repair.surface import repair_surface
from musclefit.errors import InputError, MeshError
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.faults import faults_of

LOOSE = RepairSettings(limit_mm=5.0)


def _repaired(mesh, settings=LOOSE, fill=None):
    return repair_surface("bone", mesh, settings=settings, fill=fill, source="bone.ply")


def _without(mesh, faces):
    return TriMesh(mesh.vertices, np.delete(mesh.faces, faces, axis=0))


def _fin(mesh):
    a, b = mesh.faces[5, :2]
    tip = 1.2 * mesh.vertices[a]
    return TriMesh(np.vstack([mesh.vertices, tip]), np.vstack([mesh.faces, [a, b, len(mesh.vertices)]]))


def _soup(mesh):
    return TriMesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(mesh.faces.size).reshape(-1, 3))


def _cracked(mesh):
    soup = _soup(mesh)
    return TriMesh(soup.vertices + np.random.default_rng(1).uniform(-0.002, 0.002, soup.vertices.shape), soup.faces)


def _pushed_in(mesh):
    vertices = mesh.vertices.copy()
    vertices[7] *= -1.3
    return TriMesh(vertices, mesh.faces)


def _sliver(mesh):
    face = mesh.faces[0]
    n = len(mesh.vertices)
    middle = 0.5 * (mesh.vertices[face[0]] + mesh.vertices[face[1]])
    faces = np.vstack([mesh.faces[1:], [face[0], n, face[2]], [n, face[1], face[2]], [face[0], face[1], n]])
    return TriMesh(np.vstack([mesh.vertices, middle]), faces)


def _thin_piece():
    plate = box((4.0, 4.0, 1e-4), at=(30.0, 0.0, 0.0))
    return joined(ball(), plate)


CUBE = box((16.0, 16.0, 16.0), at=(-8.0, -8.0, -8.0))

PLANTED = {
    "merged-vertices": lambda: _soup(ball()),
    "welded-vertices": lambda: _cracked(ball()),
    "collapsed-faces": lambda: TriMesh(ball().vertices, np.vstack([ball().faces, [[0, 0, 1]]])),
    "doubled-faces": lambda: TriMesh(ball().vertices, np.vstack([ball().faces, ball().faces[9:10, [1, 2, 0]]])),
    "dropped-sheets": lambda: _fin(ball()),
    "turned-faces": lambda: TriMesh(ball().vertices, np.vstack([ball().faces[4:], ball().faces[:4, ::-1]])),
    "filled-holes": lambda: _without(ball(), [3, 100]),
    "removed-crossings": lambda: _pushed_in(ball(2)),
    "flat-faces": lambda: _sliver(CUBE),
    "parted-vertices": lambda: voxels([(0, 0, 0), (1, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1)]),
    "cut-non-manifold-vertices": lambda: voxels([(0, 0, 0), (1, 1, 1)]),
    "united-pieces": lambda: joined(ball(), ball(at=(12.0, 1.0, 0.5))),
    "stray-pieces": lambda: joined(ball(), ball(1, radius=0.05, at=(30.0, 0.0, 0.0))),
    "turned-pieces": lambda: TriMesh(ball().vertices, ball().faces[:, ::-1]),
}


@pytest.mark.parametrize("code", PLANTED)
def test_a_planted_defect_is_found_repaired_and_named(code):
    mesh = PLANTED[code]()
    found = _repaired(mesh)
    assert not found.before.none or code == "stray-pieces"
    assert found.way is Way.LOCAL
    assert found.after.none
    assert faults_of(found.mesh).none
    assert enclosed_volume(found.mesh) > 0.0
    named = {change.code: change for change in found.changes}
    assert code in named
    assert named[code].count > 0
    assert str(named[code].count) in named[code].message or code in ("filled-holes", "turned-pieces")
    assert found.passed


@pytest.mark.parametrize(
    "mesh",
    [
        ball(),
        CUBE,
        joined(ball(), ball(at=(40.0, 0.0, 0.0))),
        joined(ball(), TriMesh(ball(radius=5.0).vertices, ball(radius=5.0).faces[:, ::-1])),
    ],
    ids=["ball", "box", "two", "hollow"],
)
def test_a_clean_surface_comes_back_bit_for_bit(mesh):
    found = _repaired(mesh)
    assert found.mesh is mesh
    assert found.way is Way.UNTOUCHED
    assert found.changes == ()
    assert found.deviation.largest_mm == 0.0


@pytest.mark.parametrize("holes", [[], [3]], ids=["clean", "open"])
def test_vertices_of_no_face_are_removed_and_told(holes):
    mesh = _without(ball(), holes)
    stray = np.array([[0.0, 0.0, 0.0], [500.0, 0.0, 0.0]])
    found = _repaired(TriMesh(np.vstack([stray, mesh.vertices]), mesh.faces + 2), RepairSettings())
    assert (found.way, found.passed) == (Way.LOCAL, True)
    np.testing.assert_array_equal(found.mesh.vertices, ball().vertices)
    assert found.changes[0].code == "unused-vertices"
    assert found.changes[0].message == "removed 2 vertices that belong to no face"
    assert len(found.changes) == 1 + len(holes)
    assert found.deviation.largest_mm <= 1e-9


def test_vertices_away_from_a_defect_stay_bit_for_bit():
    mesh = ball(3)
    found = _repaired(_without(mesh, [3, 4, 5]))
    np.testing.assert_array_equal(found.mesh.vertices, mesh.vertices)
    old = {tuple(face) for face in np.sort(found.mesh.faces, axis=1)}
    assert all(tuple(np.sort(face)) in old for face in np.delete(mesh.faces, [3, 4, 5], axis=0))


def test_holes_are_named_with_size_and_place_and_counted_apart():
    cube = CUBE
    top = (cube.vertices[cube.faces][:, :, 2] == 8.0).all(axis=1)
    found = _repaired(TriMesh(cube.vertices, cube.faces[~top]), RepairSettings())
    (change,) = found.changes
    assert change.message == "filled a hole of 4 edges, 64 mm round and 256 mm², near (0.00, 0.00, 8.00) mm"
    assert change.area_mm2 == pytest.approx(256.0, rel=1e-12)
    assert found.deviation.largest_mm <= 1e-9
    assert 8.0 - 1e-9 <= found.deviation.whole_mm <= 8.16
    assert found.volume_after_mm3 == pytest.approx(4096.0, rel=1e-12)


def test_a_hollow_that_faces_the_wrong_way_is_kept_and_turned():
    inner = ball(radius=5.0)
    found = _repaired(joined(ball(), inner), RepairSettings())
    assert [change.code for change in found.changes] == ["turned-pieces"]
    assert found.volume_after_mm3 == pytest.approx(enclosed_volume(ball()) - enclosed_volume(inner), rel=1e-12)
    assert "a hollow inside another piece" in found.changes[0].message


def test_a_turned_half_is_turned_back():
    mesh = ball()
    faces = mesh.faces.copy()
    upper = mesh.vertices[faces].mean(axis=1)[:, 2] > 1.0
    faces[upper] = faces[upper][:, ::-1]
    found = _repaired(TriMesh(mesh.vertices, faces), RepairSettings())
    assert found.passed
    assert found.volume_after_mm3 == pytest.approx(enclosed_volume(mesh), rel=1e-12)


def test_crossing_blobs_are_united_with_the_volume_that_they_shared():
    a, b = ball(3), ball(3, at=(12.0, 0.0, 0.0))
    found = _repaired(joined(a, b), RepairSettings())
    (change,) = [c for c in found.changes if c.code == "united-pieces"]
    lens = np.pi * (4.0 * 10.0 + 12.0) * (2.0 * 10.0 - 12.0) ** 2 / 12.0
    assert change.volume_mm3 == pytest.approx(lens, rel=0.05)
    assert found.passed
    assert found.deviation.enclosed_mm2 > 100.0  # the walls inside


def test_stray_and_thin_pieces_go_and_are_measured():
    found = _repaired(_thin_piece(), RepairSettings())
    (change,) = found.changes
    assert change.code == "stray-pieces"
    assert change.area_mm2 == pytest.approx(32.0, rel=1e-3)
    assert found.volume_after_mm3 == pytest.approx(enclosed_volume(ball()), rel=1e-12)
    kept = _repaired(joined(ball(), ball(radius=1.0, at=(30.0, 0.0, 0.0))), RepairSettings())
    assert kept.way is Way.UNTOUCHED


def test_an_open_sheet_is_refused_or_thickened_to_its_area_times_the_thickness():
    grid = np.array([[x, y, 0.0] for x in range(9) for y in range(9)], dtype=float)
    quads = np.array([[9 * i + j, 9 * i + j + 9, 9 * i + j + 10, 9 * i + j + 1] for i in range(8) for j in range(8)])
    sheet = TriMesh(grid, np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))
    with pytest.raises(MeshError, match=r"form an open sheet of 64 mm².*--thicken-mm"):
        _repaired(sheet)
    found = _repaired(sheet, RepairSettings(thicken_mm=0.5))
    assert found.after.none
    assert found.volume_after_mm3 == pytest.approx(32.0, rel=1e-9)
    assert [change.code for change in found.changes] == ["thickened-sheets"]
    assert 0.25 - 1e-9 <= found.deviation.largest_mm <= 0.27


def test_a_moebius_band_is_refused_by_name():
    vertices, faces = moebius()
    with pytest.raises(MeshError, match=r"bone.ply: 24 of 24 faces form a one-sided surface, as a Möbius band is"):
        _repaired(TriMesh(vertices, faces))


def test_a_closed_sheet_without_thickness_is_refused():
    mesh = ball(1)
    with pytest.raises(MeshError, match="no inside"):
        _repaired(TriMesh(mesh.vertices * [1.0, 1.0, 0.0], mesh.faces))


def test_a_broken_limit_is_told_not_hidden():
    found = _repaired(_pushed_in(ball(2)), RepairSettings(limit_mm=0.001))
    assert found.after.none
    assert not found.within_limit
    assert not found.passed


def test_a_surface_that_no_way_mends_comes_back_as_it_was_with_the_reason():
    def fails(vertices, faces):
        raise MeshError("no tetrahedra today")

    rng = np.random.default_rng(0)
    tangle = TriMesh(rng.normal(size=(30, 3)), rng.permutation(np.arange(30)).reshape(10, 3))
    tangled = joined(ball(1, radius=3.0), tangle)
    try:
        found = repair_surface("x", tangled, settings=RepairSettings(), fill=fails, source="x.ply")
    except MeshError as error:
        assert "open sheet" in str(error)  # noqa: PT017 (either answer names what is wrong)
    else:
        assert found.passed or found.changes


def test_resurfacing_is_named_and_used_only_where_local_repair_breaks_the_limit():
    calls = []

    def fill(vertices, faces):
        """One cube around the origin cut in tets from its centre: a stand-in for a tetrahedraliser."""
        calls.append(len(faces))
        shell = box((20.0, 20.0, 20.0), at=(-10.0, -10.0, -10.0))
        centre = len(shell.vertices)
        tets = np.column_stack([np.full(len(shell.faces), centre), shell.faces])
        return np.vstack([shell.vertices, np.zeros(3)]), tets

    assert _repaired(_without(ball(), [3]), fill=fill).way is Way.LOCAL
    assert not calls
    found = _repaired(_pushed_in(ball(2)), RepairSettings(limit_mm=0.001), fill=fill)
    assert calls
    assert found.way is Way.LOCAL  # both break the limit, and the stand-in more


@pytest.mark.parametrize("name", ["limit_mm", "weld_mm", "thicken_mm", "stray_percent"])
def test_settings_out_of_range_are_refused(name):
    with pytest.raises(InputError, match=name):
        RepairSettings(**{name: -1.0})
