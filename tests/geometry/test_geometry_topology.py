"""Edges, pieces, orientation and idle faces, on meshes whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.topology import (
    chains,
    consistent_orientation,
    edges_of,
    face_components,
    has_no_area,
    merge_duplicate_vertices,
    nested_pieces,
    repeats_a_face,
    repeats_a_vertex,
    turn,
)


def _sphere(subdivisions=2, *, radius=10.0, at=(0.0, 0.0, 0.0)):
    ball = trimesh.creation.icosphere(subdivisions, radius=radius)
    return np.array(ball.vertices) + at, np.array(ball.faces, dtype=np.int64)


def _joined(*surfaces):
    offsets = np.cumsum([0] + [len(v) for v, _ in surfaces[:-1]])
    return np.concatenate([v for v, _ in surfaces]), np.concatenate(
        [f + o for (_, f), o in zip(surfaces, offsets, strict=True)]
    )


def _moebius(n=12):
    index = np.arange(2 * n).reshape(n, 2)
    after = np.vstack([index[1:], index[:1, ::-1]])
    return np.concatenate(
        [np.stack([index[:, 0], index[:, 1], after[:, 0]], 1), np.stack([index[:, 1], after[:, 1], after[:, 0]], 1)]
    )


def test_a_sphere_has_closed_two_faced_balanced_edges():
    vertices, faces = _sphere()
    edges = edges_of(faces)
    assert len(vertices) - len(edges.ends) + len(faces) == 2  # Euler
    assert (edges.faces_at == 2).all()
    assert (edges.excess == 0).all()
    assert all(len(found) == 0 for found in (edges.boundary, edges.odd, edges.non_manifold, edges.unbalanced))


def test_edges_of_each_face_are_its_own():
    _, faces = _sphere(1)
    edges = edges_of(faces)
    own = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2)
    np.testing.assert_array_equal(edges.ends[edges.of_face], own)


def test_two_dropped_faces_leave_two_holes_of_three_edges():
    _, faces = _sphere()
    far = next(i for i in range(1, len(faces)) if not set(faces[i]) & set(faces[0]))
    edges = edges_of(np.delete(faces, [0, far], axis=0))
    assert len(edges.boundary) == 6
    assert [len(hole) for hole in chains(edges.boundary)] == [3, 3]


def test_the_larger_hole_comes_first():
    holes = chains(np.array([[0, 1], [1, 2], [0, 2], [5, 6], [6, 7], [7, 8], [5, 8]]))
    assert [sorted(set(hole.ravel())) for hole in holes] == [[5, 6, 7, 8], [0, 1, 2]]
    assert chains(np.zeros((0, 2), dtype=np.int64)) == []


def test_a_fin_makes_an_edge_of_three_faces_and_two_open_ones():
    vertices, faces = _sphere(1)
    edges = edges_of(np.vstack([faces, [faces[0, 0], faces[0, 1], len(vertices)]]))
    assert len(edges.non_manifold) == 1
    assert len(edges.boundary) == 2
    assert len(edges.odd) == 3


def test_merging_a_triangle_soup_gives_back_the_indexed_mesh():
    vertices, faces = _sphere()
    merged = merge_duplicate_vertices(vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3))
    assert merged.removed == faces.size - len(vertices)
    np.testing.assert_array_equal(merged.vertices[merged.faces], vertices[faces])
    _, first = np.unique(faces.ravel(), return_index=True)
    np.testing.assert_array_equal(merged.vertices, vertices[faces.ravel()[np.sort(first)]])


def test_merging_takes_minus_zero_for_zero_and_the_next_number_for_another():
    vertices = np.array([[0.0, 0, 0], [-0.0, 0, 0], [np.nextafter(0.0, 1.0), 0, 0]])
    merged = merge_duplicate_vertices(vertices, np.array([[0, 1, 2]]))
    np.testing.assert_array_equal(merged.faces, [[0, 0, 1]])


@given(arrays(np.float64, (20, 3), elements=st.sampled_from([0.0, -0.0, 1.0, 2.5])))
def test_merged_vertices_are_the_distinct_ones(vertices):
    merged = merge_duplicate_vertices(vertices, np.arange(18).reshape(-1, 3))
    assert len({tuple(v + 0.0) for v in vertices}) == len(merged.vertices)
    np.testing.assert_array_equal(merged.vertices[merged.kept_as], vertices)


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 1.0))
def test_turned_faces_are_found_and_turned_back(seed, share):
    _, faces = _sphere(1)
    flipped = np.random.default_rng(seed).random(len(faces)) < share
    oriented = consistent_orientation(turn(faces, flipped))
    assert not len(edges_of(oriented.faces).unbalanced)
    assert not oriented.one_sided.any()
    assert oriented.turned.sum() == min(flipped.sum(), (~flipped).sum())


def test_each_piece_is_oriented_by_itself():
    one, other = _sphere(1), _sphere(1, at=(30, 0, 0))
    _, faces = _joined(one, (other[0], other[1][:, ::-1]))
    flipped = np.zeros(len(faces), dtype=bool)
    flipped[[2, 100]] = True
    oriented = consistent_orientation(turn(faces, flipped))
    np.testing.assert_array_equal(oriented.turned, flipped)
    np.testing.assert_array_equal(oriented.faces, faces)


def test_a_moebius_band_is_one_sided_and_left_as_it_is():
    band = _moebius()
    _, faces = _joined(_sphere(1), (np.zeros((24, 3)), band))
    oriented = consistent_orientation(faces)
    np.testing.assert_array_equal(oriented.one_sided, np.arange(len(faces)) >= len(faces) - len(band))
    np.testing.assert_array_equal(oriented.faces, faces)


def test_a_ring_of_an_even_number_of_twists_is_two_sided():
    n = 12
    index = np.arange(2 * n).reshape(n, 2)
    after = np.roll(index, -1, axis=0)
    ring = np.concatenate(
        [np.stack([index[:, 0], index[:, 1], after[:, 0]], 1), np.stack([index[:, 1], after[:, 1], after[:, 0]], 1)]
    )
    assert not consistent_orientation(ring).one_sided.any()


def test_pieces_are_numbered_by_their_first_face():
    _, faces = _joined(_sphere(1), _sphere(0, at=(30, 0, 0)), _sphere(1, at=(60, 0, 0)))
    np.testing.assert_array_equal(face_components(faces), np.repeat([0, 1, 2], [80, 20, 80]))
    np.testing.assert_array_equal(face_components(faces[::-1]), np.repeat([0, 1, 2], [80, 20, 80]))


def test_pieces_that_share_only_a_vertex_are_two():
    assert face_components(np.array([[0, 1, 2], [2, 3, 4], [4, 3, 5]])).tolist() == [0, 1, 1]


def test_repeats():
    faces = np.array([[0, 1, 2], [1, 2, 0], [2, 1, 0], [3, 3, 1], [4, 5, 4], [6, 7, 8]])
    assert repeats_a_vertex(faces).tolist() == [False, False, False, True, True, False]
    assert repeats_a_face(faces).tolist() == [False, True, False, False, False, False]


@pytest.mark.parametrize("scale", [1.0, 0.1, 1e-8, 1e8])
def test_zero_area_on_a_slanted_line(scale):
    line = TriMesh(scale * np.array([[0.0, 0, 0], [1, 3, 5], [2, 6, 10]]), np.array([[0, 1, 2]]))
    assert has_no_area(line).tolist() == [True]


def test_a_needle_has_area():
    needle = TriMesh(np.array([[0.0, 0, 0], [1, 1, 1], [2, 2, np.nextafter(2.0, 3.0)]]), np.array([[0, 1, 2]]))
    assert has_no_area(needle).tolist() == [False]


def test_nesting_of_shell_cavity_island_and_neighbour():
    shell, cavity = _sphere(2, radius=10), _sphere(2, radius=8)
    island, neighbour = _sphere(1, radius=2, at=(3, 0, 0)), _sphere(1, radius=3, at=(20, 0, 0))
    vertices, faces = _joined(island, (cavity[0], cavity[1][:, ::-1]), shell, neighbour)
    pieces = nested_pieces(TriMesh(vertices, faces))
    assert pieces.depth.tolist() == [2, 1, 0, 0]
    assert pieces.outermost.tolist() == [2, 2, 2, 3]
    assert np.sign(pieces.volumes).tolist() == [1, -1, 1, 1]
    reference = trimesh.creation.icosphere(2, radius=8).volume
    np.testing.assert_allclose(pieces.volumes[1], -reference, rtol=1e-12)


def test_a_box_inside_the_box_of_a_bent_piece_is_not_nested():
    ring = trimesh.creation.torus(10.0, 2.0)
    ball = _sphere(1, radius=1)
    vertices, faces = _joined((np.array(ring.vertices), np.array(ring.faces, dtype=np.int64)), ball)
    assert nested_pieces(TriMesh(vertices, faces)).depth.tolist() == [0, 0]
