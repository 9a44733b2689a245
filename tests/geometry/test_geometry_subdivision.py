"""Edge splits keep the surface, its closedness and its orientation; nearest places and thinning against brute force."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from musclefit.errors import MeshError
from musclefit.geometry.measures import area_vectors, enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places, smooth_normals, thinned
from musclefit.geometry.surfaces.subdivision import FaceEdges, split_edges, with_short_edges
from musclefit.geometry.surfaces.topology import edges_of


def sphere(subdivisions: int = 2) -> TriMesh:
    mesh = trimesh.creation.icosphere(subdivisions)
    return TriMesh(np.array(mesh.vertices), np.array(mesh.faces))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_splits_keep_volume_area_closedness_and_the_old_vertices(share):
    mesh = sphere()
    edges = FaceEdges.of(mesh.faces)
    split = np.random.default_rng(0).random(len(edges.ends)) < share
    fine = split_edges(mesh, edges, split)
    found = edges_of(fine.faces)
    assert (len(found.boundary), len(found.unbalanced)) == (0, 0)
    assert len(fine.vertices) == len(mesh.vertices) + split.sum()
    assert len(fine.faces) == len(mesh.faces) + 2 * split.sum()
    np.testing.assert_array_equal(fine.vertices[: len(mesh.vertices)], mesh.vertices)
    assert enclosed_volume(fine) == pytest.approx(enclosed_volume(mesh), rel=1e-12)
    areas = [np.linalg.norm(area_vectors(m), axis=1).sum() for m in (mesh, fine)]
    assert areas[1] == pytest.approx(areas[0], rel=1e-12)


def test_new_vertices_are_the_middles_in_the_order_of_the_edges():
    mesh = sphere(0)
    edges = FaceEdges.of(mesh.faces)
    fine = split_edges(mesh, edges, np.ones(len(edges.ends), dtype=bool))
    middles = mesh.vertices[edges.ends].mean(axis=1)
    np.testing.assert_allclose(fine.vertices[len(mesh.vertices) :], middles, rtol=0, atol=1e-15)


def test_edges_come_in_order_and_faces_know_theirs():
    faces = np.random.default_rng(1).permutation(sphere(3).faces)
    edges = FaceEdges.of(faces)
    following = np.roll(faces, -1, axis=1)
    pairs = np.stack([np.minimum(faces, following), np.maximum(faces, following)], axis=2)
    np.testing.assert_array_equal(edges.ends, np.unique(pairs.reshape(-1, 2), axis=0))
    np.testing.assert_array_equal(edges.ends[edges.of_face], pairs)
    assert FaceEdges.of(faces[:0]).ends.shape == (0, 2)


def test_short_edges_are_short():
    fine = with_short_edges(sphere(0), longest_mm=0.2)
    ends = fine.vertices[FaceEdges.of(fine.faces).ends]
    assert np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max() <= 0.2
    assert enclosed_volume(fine) == pytest.approx(enclosed_volume(sphere(0)), rel=1e-12)


def test_one_mark_for_each_edge():
    mesh = sphere(0)
    with pytest.raises(MeshError, match="30 edges have marks of shape"):
        split_edges(mesh, FaceEdges.of(mesh.faces), np.ones(3, dtype=bool))


def test_nearest_places_and_normals_of_a_sphere():
    mesh = sphere(4)
    points = np.random.default_rng(1).normal(size=(200, 3)) * 2.0
    near = nearest_places(points, mesh)
    radius = np.linalg.norm(points, axis=1)
    np.testing.assert_allclose(near.distances, np.abs(radius - 1.0), rtol=0, atol=3e-3)
    np.testing.assert_allclose(near.places, points / radius[:, None], rtol=0, atol=4e-2)
    normals = smooth_normals(mesh, near)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(normals, near.places / np.linalg.norm(near.places, axis=1)[:, None], rtol=0, atol=2e-2)


def test_thinned_points_are_apart_and_cover_the_rest():
    points = np.random.default_rng(2).random((500, 3))
    chosen = thinned(points, spacing_mm=0.2)
    kept = points[chosen]
    apart = np.linalg.norm(kept[:, None] - kept[None], axis=2) + np.eye(len(kept))
    assert apart.min() > 0.2
    assert np.linalg.norm(points[:, None] - kept[None], axis=2).min(axis=1).max() <= 0.2
    assert chosen[0] == 0
