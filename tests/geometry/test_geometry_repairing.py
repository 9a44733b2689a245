"""Faults counted, holes filled, patches dropped, crossings taken out, distances bracketed: on shapes that are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planted import ball, box, moebius, voxels

from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.queries.hausdorff import distances_from_triangles, reach
from musclefit.geometry.surfaces.booleans import difference, grown_by, united, vertex_normals
from musclefit.geometry.surfaces.crossings import crossings_between, self_crossings
from musclefit.geometry.surfaces.faults import Faults, faults_of, non_manifold_vertices
from musclefit.geometry.surfaces.holes import filled_holes, rims
from musclefit.geometry.surfaces.patches import cancelled, cut_at_non_manifold_vertices, facing_outwards, superfluous
from musclefit.geometry.surfaces.topology import consistent_orientation, edges_of
from musclefit.geometry.surfaces.uncrossing import parted, uncrossed, with_holes_filled, without_flat_faces


def test_a_clean_surface_has_no_fault():
    assert faults_of(ball()).none
    assert faults_of(ball()).said() == "none"


PLANTED = {
    "collapsed": lambda m: np.vstack([m.faces, [m.faces[0, [0, 1, 1]]]]),
    "doubled": lambda m: np.vstack([m.faces, m.faces[:1, [1, 2, 0]]]),
    "boundary_edges": lambda m: m.faces[1:],
    "inconsistently_oriented_edges": lambda m: np.vstack([m.faces[1:], m.faces[:1, ::-1]]),
    "misplaced": lambda m: m.faces[:, ::-1],
}


@pytest.mark.parametrize("fault", PLANTED)
def test_a_planted_fault_is_counted(fault):
    mesh = ball()
    found = faults_of(TriMesh(mesh.vertices, PLANTED[fault](mesh)))
    assert getattr(found, fault) > 0
    assert not found.none
    assert fault.replace("_", " ") in found.said()


def test_two_tetrahedra_that_share_a_vertex_or_an_edge_are_pinched_there():
    corners = np.vstack([np.zeros(3), np.eye(3), -np.eye(3), [[1.0, -1.0, -1.0], [1.0, -1.0, 1.0]]])
    tet = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    mirrored = np.array([0, 4, 5, 6])[tet][:, ::-1]
    by_vertex = TriMesh(corners, np.vstack([tet, mirrored]))
    np.testing.assert_array_equal(non_manifold_vertices(by_vertex.faces), [0])
    other = np.array([0, 1, 8, 7])[tet]
    by_edge = TriMesh(corners, np.vstack([tet, other]))
    assert faults_of(by_edge).non_manifold_edges == 1
    for mesh in (by_vertex, by_edge):
        cut = cut_at_non_manifold_vertices(mesh)
        assert cut.added == (1 if mesh is by_vertex else 2)
        found = faults_of(cut.mesh)
        assert found == Faults(0, 0, 0, 0, 0, 0, 0, cut.added, 0, 0)
        assert faults_of(parted(mesh)).none


@given(st.integers(0, 319), st.integers(0, 2))
@settings(max_examples=25, deadline=None)
def test_a_hole_is_filled_with_its_own_rim_and_closes(first, rings):
    mesh = ball(2)
    gone = np.zeros(len(mesh.faces), dtype=bool)
    gone[first] = True
    for _ in range(rings):
        gone = np.isin(mesh.faces, mesh.faces[gone]).any(axis=1)
    (hole,) = filled_holes(mesh.vertices, mesh.faces[~gone])
    rim = np.unique(edges_of(mesh.faces[~gone]).boundary)
    np.testing.assert_array_equal(np.sort(hole.rim), rim)
    assert len(hole.patch) == len(rim) - 2
    assert faults_of(TriMesh(mesh.vertices, np.vstack([mesh.faces[~gone], hole.patch]))).none


def test_a_square_hole_has_its_length_and_area():
    cube = box((4.0, 3.0, 2.0))
    top = cube.vertices[cube.faces][:, :, 2].min(axis=1) == 2.0
    (hole,) = filled_holes(cube.vertices, cube.faces[~top])
    assert hole.length_mm == pytest.approx(14.0, rel=1e-12)
    assert hole.area_mm2 == pytest.approx(12.0, rel=1e-12)


def test_rims_that_meet_in_a_vertex_are_told_apart():
    mesh = ball(2)
    a = int(mesh.faces[0, 0])
    at = np.flatnonzero((mesh.faces == a).any(axis=1))
    around = [f for f in at if f == at[0] or len(np.intersect1d(mesh.faces[f], mesh.faces[at[0]])) == 1]
    holes = rims(mesh.vertices, np.delete(mesh.faces, around[:2], axis=0))
    assert sorted(len(hole) for hole in holes) == [3, 3]
    assert all(a in hole for hole in holes)
    closed = with_holes_filled(TriMesh(mesh.vertices, np.delete(mesh.faces, around[:2], axis=0)))
    assert faults_of(closed).none


def test_a_wall_between_two_rooms_is_found():
    mesh = voxels([(0, 0, 0), (1, 0, 0)])
    across = np.flatnonzero((mesh.vertices[mesh.faces][:, :, 0] == 0.0).all(axis=1))
    at = {tuple(v): k for k, v in enumerate(mesh.vertices)}
    wall = np.array([[at[tuple(v + np.array([1.0, 0.0, 0.0]))] for v in mesh.vertices[f]] for f in mesh.faces[across]])
    walled = TriMesh(mesh.vertices, np.vstack([mesh.faces, wall]))
    assert faults_of(walled).non_manifold_edges == 4
    np.testing.assert_array_equal(np.flatnonzero(superfluous(walled)), len(mesh.faces) + np.arange(2))


def test_fins_and_opposite_copies_are_found():
    mesh = ball(2)
    a, b = mesh.faces[5, :2]
    fin = TriMesh(
        np.vstack([mesh.vertices, 1.4 * mesh.vertices[a]]), np.vstack([mesh.faces, [a, b, len(mesh.vertices)]])
    )
    np.testing.assert_array_equal(np.flatnonzero(superfluous(fin)), [len(mesh.faces)])
    both = np.vstack([mesh.faces, mesh.faces[:1], mesh.faces[3:4, ::-1]])
    keep = cancelled(both)
    np.testing.assert_array_equal(np.flatnonzero(~keep), [3, len(mesh.faces), len(mesh.faces) + 1])


def test_a_body_that_meets_itself_in_an_edge_is_turned_outwards_and_cut_there():
    mesh = voxels([(0, 0, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (1, 1, 0)])
    assert faults_of(mesh) == Faults(0, 0, 0, 1, 0, 2, 0, 0, 0, 0)
    turned = TriMesh(mesh.vertices, facing_outwards(TriMesh(mesh.vertices, mesh.faces[:, ::-1])))
    assert enclosed_volume(turned) == pytest.approx(5.0, rel=1e-14)
    cut = cut_at_non_manifold_vertices(turned)
    assert cut.added == 1  # the edge's lower end; round its upper end both sides are one fan
    assert faults_of(cut.mesh) == Faults(0, 0, 0, 0, 0, 0, 0, 1, 0, 0)
    assert enclosed_volume(cut.mesh) == pytest.approx(5.0, rel=1e-14)


@pytest.mark.parametrize("seed", range(4))
def test_a_pushed_in_corner_is_uncrossed_and_the_rest_stays(seed):
    mesh = ball(3)
    vertices = mesh.vertices.copy()
    at = np.random.default_rng(seed).integers(len(vertices))
    vertices[at] *= -0.5 if seed % 2 else 1.0
    vertices[at] += 4.0 * vertices[(at + 7) % len(vertices)] / 10.0
    crossed = TriMesh(vertices, mesh.faces)
    found = uncrossed(crossed)
    assert found.left == 0
    assert faults_of(found.mesh).none
    assert found.pairs == len(self_crossings(crossed))
    kept = {tuple(v) for v in found.mesh.vertices}
    assert sum(tuple(v) in kept for v in mesh.vertices) > 0.9 * len(mesh.vertices)


def test_flat_faces_go_and_the_shape_stays():
    cube = box((2.0, 2.0, 2.0))
    face = cube.faces[0]
    middle = cube.vertices[face[:2]].mean(axis=0)
    n = len(cube.vertices)
    # a vertex on an edge that only one side knows of, closed by a face without area
    faces = np.vstack([cube.faces[1:], [face[0], n, face[2]], [n, face[1], face[2]], [face[0], face[1], n]])
    flat = TriMesh(np.vstack([cube.vertices, middle]), faces)
    assert faults_of(flat).flat == 1
    mended = without_flat_faces(flat)
    assert faults_of(mended).none
    assert enclosed_volume(mended) == pytest.approx(8.0, rel=1e-14)


def test_distances_bracket_what_formulas_say():
    inner, outer = ball(3, radius=10.0), ball(3, radius=10.5)
    found = reach(outer, inner, tolerance_mm=0.001)
    assert found.at_least <= 0.5 + 1e-12 <= found.at_most + 0.002
    assert found.at_most - found.at_least <= 0.001
    cube, moved = box((4.0, 4.0, 4.0)), box((4.0, 4.0, 4.0), at=(0.0, 0.0, 1.0))
    assert reach(cube, moved, tolerance_mm=1e-4).at_least == pytest.approx(1.0, abs=1e-4)
    assert reach(cube, cube, tolerance_mm=1e-4).at_most <= 1e-12


def test_distance_is_largest_inside_a_triangle_and_still_found():
    lid = TriMesh(np.array([[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [0.0, 9.0, 0.0]]), np.array([[0, 1, 2]]))
    tent = TriMesh(np.vstack([lid.vertices, [0.0, -3.0, 2.0]]), np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3]]))
    found = reach(lid, tent, tolerance_mm=0.02)
    dense = np.random.default_rng(3).dirichlet(np.ones(3), 20000) @ lid.vertices
    sampled = nearest_places(dense, tent).distances.max()
    assert sampled - 0.02 <= found.at_least
    assert sampled <= found.at_most <= sampled + 0.05
    above = reach(lid, tent, tolerance_mm=0.02, where=lambda points: points[:, 0] > 100.0)
    assert above.at_least == 0.0
    assert above.passed_over_mm2 > 0.0


def test_distances_from_triangles_equal_igl():
    rng = np.random.default_rng(5)
    triangles, points = rng.normal(size=(50, 3, 3)), rng.normal(size=(50, 3))
    oracle = [
        nearest_places(p[None], TriMesh(t, np.array([[0, 1, 2]]))).distances[0]
        for p, t in zip(points, triangles, strict=True)
    ]
    np.testing.assert_allclose(distances_from_triangles(points, triangles), oracle, rtol=1e-9, atol=1e-12)


def test_a_grown_box_is_a_larger_box():
    grown = grown_by(box((2.0, 3.0, 4.0)), distance_mm=0.1)
    assert enclosed_volume(grown) == pytest.approx(2.2 * 3.2 * 4.2, rel=1e-9)
    lengths = np.linalg.norm(vertex_normals(ball()), axis=1)
    np.testing.assert_allclose(lengths, 1.0, rtol=1e-12, atol=0)


def test_a_difference_keeps_its_clearance():
    a, b = box((4.0, 4.0, 4.0)), box((4.0, 4.0, 4.0), at=(3.0, 1.0, 1.0))
    left = difference(a, [grown_by(b, distance_mm=0.05)], smooth_within_mm=1e-4)
    assert len(crossings_between(left, b)) == 0
    assert enclosed_volume(left) == pytest.approx(64.0 - 1.05 * 3.05 * 3.05, rel=1e-9)
    assert nearest_places(left.vertices, b).distances.min() == pytest.approx(0.05, abs=1e-3)


def test_a_union_of_balls_is_what_the_lens_says():
    a, b = ball(4), ball(4, at=(12.0, 0.0, 0.0))
    r, d = 10.0, 12.0
    lens = np.pi * (4.0 * r + d) * (2.0 * r - d) ** 2 / 12.0
    whole = united([a, b], smooth_within_mm=1e-6)
    assert enclosed_volume(whole) == pytest.approx(2.0 * enclosed_volume(a) - lens, rel=5e-3)


def test_a_moebius_band_has_one_rim():
    vertices, faces = moebius()
    assert faults_of(TriMesh(vertices, faces)).boundary_edges == 24
    assert consistent_orientation(faces).one_sided.all()
