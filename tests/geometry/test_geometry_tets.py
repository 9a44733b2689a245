"""Faces, edges and splits of tet meshes: counts, Euler's formula, conformity, and volumes to the last bit."""

from __future__ import annotations

from collections import Counter
from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest
from tet_blocks import block

from musclefit.errors import MeshError
from musclefit.geometry.measures import enclosed_volume, signed_volumes
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.geometry.tets.orientation import orientations
from musclefit.geometry.tets.quality import dihedral_angles
from musclefit.geometry.tets.subdivision import Incidence, independent_edges, split_edges, tets_around
from musclefit.geometry.tets.topology import interface, tet_edges, tet_faces


def euler_characteristic(tets: np.ndarray) -> int:
    """Vertices - edges + faces - tets; 1 for a ball."""
    return len(np.unique(tets)) - len(tet_edges(tets)[0]) + len(tet_faces(tets).corners) - len(tets)


def face_uses(tets: np.ndarray) -> Counter[tuple[int, ...]]:
    """The oracle: how many tets have each face."""
    return Counter(tuple(sorted(face)) for tet in tets.tolist() for face in combinations(tet, 3))


def exact_volume(vertices: np.ndarray, tets: np.ndarray) -> Fraction:
    """Six times the sum of the volumes, in fractions."""
    total = Fraction(0)
    for a, b, c, d in ([[Fraction(float(x)) for x in vertices[v]] for v in tet] for tet in tets):
        u, v, w = ([y - x for x, y in zip(a, other, strict=True)] for other in (b, c, d))
        total += (
            u[0] * (v[1] * w[2] - v[2] * w[1]) - u[1] * (v[0] * w[2] - v[2] * w[0]) + u[2] * (v[0] * w[1] - v[1] * w[0])
        )
    return total


def split_at_random(mesh: TetMesh, rng: np.random.Generator, *, rounds: int) -> tuple[TetMesh, np.ndarray]:
    """The mesh after random splits, and the tet of ``mesh`` that each tet was cut from."""
    vertices, tets, origin = mesh.vertices, mesh.tets, np.arange(len(mesh.tets))
    for _ in range(rounds):
        ends = rng.permutation(tet_edges(tets)[0])[:40]
        ends = ends[independent_edges(tets_around(tets, ends))]
        split = split_edges(tets, ends, len(vertices) + np.arange(len(ends)))
        vertices = np.vstack([vertices, vertices[ends].mean(axis=1)])
        tets, origin = split.tets, origin[split.parent]
    return TetMesh(vertices, tets), origin


def test_a_block_is_a_conforming_ball() -> None:
    mesh = block((3, 2, 2))
    faces = tet_faces(mesh.tets)
    uses = face_uses(mesh.tets)
    assert (orientations(mesh.vertices, mesh.tets) == 1).all()
    assert len(faces.corners) == len(uses)
    assert len(faces.boundary) == sum(count == 1 for count in uses.values()) == 4 * (3 * 2 + 3 * 2 + 2 * 2)
    assert faces.odd.size == 0
    assert euler_characteristic(mesh.tets) == 1
    np.testing.assert_allclose(enclosed_volume(TriMesh(mesh.vertices, faces.boundary)), 12.0, rtol=1e-12)


def test_both_tets_of_a_face_have_its_corners() -> None:
    mesh = block((2, 2, 2))
    faces = tet_faces(mesh.tets)
    for corners, (one, other) in zip(faces.corners, faces.tets, strict=True):
        assert set(corners) <= set(mesh.tets[one])
        assert other < 0 or set(corners) <= set(mesh.tets[other])
    np.testing.assert_array_equal(faces.boundary_tets, faces.tets[faces.tets[:, 1] < 0, 0])


def test_a_face_of_three_tets_and_a_tet_laid_over_its_neighbour_are_odd() -> None:
    tets = np.array([[0, 1, 2, 3], [0, 2, 1, 4], [0, 2, 1, 5]])
    np.testing.assert_array_equal(tet_faces(tets).odd, [0, 1, 2])
    np.testing.assert_array_equal(tet_faces(np.array([[0, 1, 2, 3], [0, 1, 2, 4]])).odd, [0, 1])
    assert tet_faces(tets[:2]).odd.size == 0
    assert tet_faces(np.array([[0, 1, 2, 3], [0, 1, 2, 3]])).odd.size == 2


def test_edges_and_their_opposites_have_no_common_corner() -> None:
    mesh = block((2, 1, 1))
    ends, of_tet = tet_edges(mesh.tets)
    assert sorted(map(tuple, ends.tolist())) == sorted(
        {tuple(sorted(pair)) for tet in mesh.tets.tolist() for pair in combinations(tet, 2)}
    )
    for edges in of_tet:
        for k in range(3):
            assert not set(ends[edges[k]]) & set(ends[edges[5 - k]])


def test_splits_keep_conformity_orientation_topology_and_every_volume_exactly() -> None:
    mesh = block((3, 3, 3), edge_mm=64.0)
    label = np.arange(len(mesh.tets)) % 5
    fine, origin = split_at_random(mesh, np.random.default_rng(1), rounds=12)
    assert len(fine.tets) > 3 * len(mesh.tets)
    assert (orientations(fine.vertices, fine.tets) == 1).all()
    uses = face_uses(fine.tets)
    assert max(uses.values()) == 2
    assert tet_faces(fine.tets).odd.size == 0
    assert euler_characteristic(fine.tets) == 1
    boundary = TriMesh(fine.vertices, tet_faces(fine.tets).boundary)
    np.testing.assert_allclose(enclosed_volume(boundary), 192.0**3, rtol=1e-12)
    for tissue in range(5):
        before = exact_volume(mesh.vertices, mesh.tets[label == tissue])
        assert exact_volume(fine.vertices, fine.tets[label[origin] == tissue]) == before
    assert np.isin(boundary.vertices[np.unique(boundary.faces)], [0.0, 192.0]).any(axis=1).all()


def test_splitting_an_edge_cuts_all_tets_around_it_and_no_others() -> None:
    mesh = block((2, 2, 2))
    ends, _ = tet_edges(mesh.tets)
    for edge in ends[::7]:
        around = tets_around(mesh.tets, edge[None])[0]
        assert around.tolist() == [t for t, tet in enumerate(mesh.tets.tolist()) if set(edge) <= set(tet)]
        split = split_edges(mesh.tets, edge[None], np.array([len(mesh.vertices)]))
        assert len(split.tets) == len(mesh.tets) + len(around)
        assert not any(set(edge) <= set(tet) for tet in split.tets.tolist())
        np.testing.assert_array_equal(split.parent[len(mesh.tets) :], around)


def test_edges_that_share_a_tet_or_belong_to_none_are_refused() -> None:
    mesh = block((1, 1, 1))
    with pytest.raises(MeshError, match="two of the edges to split are in tet 0"):
        split_edges(mesh.tets, np.sort(mesh.tets[0])[[[0, 1], [0, 2]]], np.array([8, 9]))
    with pytest.raises(MeshError, match=r"no tet has the edge \[1, 6\]"):
        split_edges(mesh.tets, np.array([[1, 6]]), np.array([8]))


def test_no_two_independent_edges_share_a_tet() -> None:
    mesh = block((3, 3, 3))
    ends, _ = tet_edges(mesh.tets)
    around = tets_around(mesh.tets, ends)
    chosen = independent_edges(around)
    used = np.concatenate([around[edge] for edge in chosen])
    assert len(np.unique(used)) == len(used)
    assert all(np.isin(around[edge], used).any() for edge in range(len(ends)))


def test_the_interface_of_a_part_is_closed_and_bounds_its_volume() -> None:
    mesh = block((4, 3, 2))
    part = np.flatnonzero(mesh.vertices[mesh.tets].mean(axis=1)[:, 0] < 2.0)
    surface = interface(tet_faces(mesh.tets), part, count=len(mesh.tets))
    np.testing.assert_allclose(enclosed_volume(TriMesh(mesh.vertices, surface)), 12.0, rtol=1e-12)


def test_angles_of_a_regular_tet_of_a_corner_and_of_a_sliver() -> None:
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    regular = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
    sliver = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 1e-3], [0, -1, 1e-3]])
    tets = np.arange(12).reshape(-1, 4)
    found = dihedral_angles(np.vstack([corner, regular, sliver]), tets)
    beside = np.degrees(np.arctan(np.sqrt(2.0)))
    np.testing.assert_allclose(np.sort(found[0]), [beside, beside, beside, 90, 90, 90], rtol=1e-12)
    np.testing.assert_allclose(found[1], np.degrees(np.arccos(1 / 3)), rtol=1e-12)
    assert found[2].min() < 0.2
    assert found[2].max() > 179.7
    assert np.isnan(dihedral_angles(np.zeros((4, 3)), tets[:1])).all()


def test_volumes_of_a_split_block_add_up() -> None:
    mesh = block((2, 2, 2))
    fine, origin = split_at_random(mesh, np.random.default_rng(2), rounds=5)
    sums = np.bincount(origin, weights=signed_volumes(fine.vertices, fine.tets))
    np.testing.assert_allclose(sums, signed_volumes(mesh.vertices, mesh.tets), rtol=1e-12)


def test_tets_around_edges_are_the_same_by_incidence() -> None:
    mesh = block((3, 2, 2))
    ends, _ = tet_edges(mesh.tets)
    near = Incidence(mesh.tets, np.arange(0, len(mesh.vertices), 2))
    for edge, around in zip(ends, tets_around(mesh.tets, ends), strict=True):
        if (edge % 2).all():
            with pytest.raises(MeshError, match="has no end among the vertices"):
                near.around(edge)
        else:
            np.testing.assert_array_equal(near.around(edge), around)
    assert near.around(np.array([0, len(mesh.vertices) - 1])).size == 0
