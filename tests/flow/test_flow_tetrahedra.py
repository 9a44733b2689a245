"""Tets cut finer where a one-to-one map leaves them inverted: nothing wrong is left, nothing at rest has changed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from tet_blocks import block, two_tissues

import musclefit.flow.tet_refinement as under_test
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.certify.meshes import certify_mesh
from musclefit.flow.tet_refinement import CarriedTets, carried_tets, moved_tets
from musclefit.geometry.arrays import Points
from musclefit.geometry.meshes import TetMesh
from musclefit.geometry.tets.topology import tet_edges, tet_faces
from musclefit.progress import Silent
from musclefit.vocabulary import Claim

Map = Callable[[Points], Points]


def bend(degrees_per_mm: float) -> Map:
    """Bends the x axis into a circle in the x-y plane; one-to-one while radii stay positive and it is no full turn."""
    radius = 1.0 / np.radians(degrees_per_mm)

    def to(points: Points) -> Points:
        angle, distance = points[:, 0] / radius, radius - points[:, 1]
        return np.stack([distance * np.sin(angle), radius - distance * np.cos(angle), points[:, 2]], axis=1)

    return to


def shear_wave(height: float, length: float) -> Map:
    """Moves y by a wave along x and z by one along y: volume is kept everywhere, so no point folds."""

    def to(points: Points) -> Points:
        x, y, z = points.T
        y = y + height * np.sin(x / length)
        return np.stack([x, y, z + height * np.sin(y / length)], axis=1)

    return to


def with_slivers(anatomy: TetAnatomy, rng: np.random.Generator) -> TetAnatomy:
    """The block with inner vertices shifted until some tets are nearly flat, all still right-handed."""
    vertices = np.array(anatomy.mesh.vertices)
    size = vertices.max(axis=0)
    inner = np.flatnonzero(((vertices > 0) & (vertices < size)).all(axis=1))
    for vertex in inner:
        shift = rng.uniform(-1.0, 1.0, 3)
        for share in np.linspace(1.0, 0.0, 60):
            trial = vertices.copy()
            trial[vertex] += share * shift
            corners = trial[anatomy.mesh.tets[(anatomy.mesh.tets == vertex).any(axis=1)]]
            if np.linalg.det(corners[:, 1:] - corners[:, :1]).min() > 0.0:
                vertices = trial
                break
    return replace(anatomy, mesh=anatomy.mesh.with_vertices(vertices))


def shaken(anatomy: TetAnatomy) -> TetAnatomy:
    """The block with inner vertices off their lattice, but no tet nearly flat."""
    vertices = np.array(anatomy.mesh.vertices)
    inner = ((vertices > 0) & (vertices < vertices.max(axis=0))).all(axis=1)
    vertices[inner] += np.random.default_rng(1).uniform(-0.5, 0.5, (int(inner.sum()), 3))
    return replace(anatomy, mesh=anatomy.mesh.with_vertices(vertices))


def euler_characteristic(tets: np.ndarray) -> int:
    return len(np.unique(tets)) - len(tet_edges(tets)[0]) + len(tet_faces(tets).corners) - len(tets)


def assert_same_space(before: TetAnatomy, after: CarriedTets, where: Map) -> None:
    """Conforming, the same tissues of the same volumes, the same vertices first, all of them where the map says."""
    fine = after.rest
    uses = Counter(tuple(sorted(face)) for tet in fine.mesh.tets.tolist() for face in combinations(tet, 3))
    assert max(uses.values()) == 2
    assert tet_faces(fine.mesh.tets).odd.size == 0
    assert euler_characteristic(fine.mesh.tets) == euler_characteristic(before.mesh.tets)
    np.testing.assert_allclose(fine.volumes_by_tissue(), before.volumes_by_tissue(), rtol=1e-12)
    np.testing.assert_array_equal(fine.mesh.vertices[: len(before.mesh.vertices)], before.mesh.vertices)
    np.testing.assert_allclose(after.vertices, where(fine.mesh.vertices), rtol=0, atol=1e-12)
    assert certify_mesh(fine.mesh).claim is Claim.CERTIFIED


def carried_whole(rest: TetAnatomy, where: Map) -> CarriedTets:
    return carried_tets(rest, where, max_rounds=240, max_growth=30.0, progress=Silent())


@pytest.mark.parametrize(
    ("where", "seed"), [(bend(14.0), 1), (bend(14.0), 2), (shear_wave(0.8, 0.9), 3), (shear_wave(1.5, 1.6), 4)]
)
def test_slivers_that_a_bend_inverts_are_cut_until_the_mesh_is_certified(where: Map, seed: int) -> None:
    rest = with_slivers(two_tissues((6, 3, 3)), np.random.default_rng(seed))
    assert certify_mesh(rest.mesh.with_vertices(where(rest.mesh.vertices))).inverted > 0
    found = carried_whole(rest, where)
    assert found.inverted_before > 0
    assert (found.inverted_left, found.crossings_left, found.stopped) == (0, 0, "")
    assert found.edges_split > 0
    assert found.given == len(rest.mesh.tets)
    assert sum(count for _, count in found.cut_by_tissue) <= found.given
    assert_same_space(rest, found, where)
    assert certify_mesh(found.rest.mesh.with_vertices(found.vertices)).claim is Claim.CERTIFIED


@pytest.mark.parametrize("order", [1, 2])
def test_each_order_alone_ends_well_where_no_tet_is_nearly_flat(order: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(under_test, "_ORDERS", ((under_test._ORDERS[order][0], 1.0),))
    rest, where = shaken(two_tissues((5, 3, 3), edge_mm=2.0)), shear_wave(2.0, 1.2)
    found = carried_whole(rest, where)
    assert found.inverted_before > 0
    assert (found.inverted_left, found.crossings_left, found.stopped) == (0, 0, "")
    assert_same_space(rest, found, where)


def test_a_boundary_that_crosses_only_because_it_is_coarse_is_cut_until_it_does_not() -> None:
    """Two bars with a narrow gap between, bent together: corners of one stand out beyond the chords of the other."""
    bar, where = block((4, 1, 1), edge_mm=10.0), bend(1.0)
    shifted = bar.vertices + np.array([5.0, 10.05, 0.0])
    both = TetMesh(np.vstack([bar.vertices, shifted]), np.vstack([bar.tets, bar.tets + len(bar.vertices)]))
    labels = np.repeat([0, 1], len(bar.tets))
    rest = replace(two_tissues((4, 1, 1), edge_mm=10.0), mesh=both, tissue_of_tet=labels)
    assert certify_mesh(rest.mesh).claim is Claim.CERTIFIED
    before = certify_mesh(rest.mesh.with_vertices(where(rest.mesh.vertices)))
    assert before.inverted == 0
    assert before.crossings > 0
    found = carried_whole(rest, where)
    assert (found.inverted_before, found.crossings_before) == (0, before.crossings)
    assert (found.inverted_left, found.crossings_left, found.stopped) == (0, 0, "")
    assert_same_space(rest, found, where)
    assert certify_mesh(found.rest.mesh.with_vertices(found.vertices)).claim is Claim.CERTIFIED


def test_what_comes_out_right_is_left_as_it_is() -> None:
    rest = two_tissues((4, 2, 2))
    found = carried_whole(rest, bend(5.0))
    assert found.rest is rest
    assert (found.rounds, found.edges_split, found.cut_by_tissue, found.stopped) == (0, 0, (), "")


def test_a_fold_cannot_be_cut_away_and_the_mesh_is_given_back_with_the_bound_named() -> None:
    rest = two_tissues((4, 2, 2))

    def fold(points: Points) -> Points:
        return np.stack([np.abs(points[:, 0] - 1.7), points[:, 1], points[:, 2]], axis=1)

    found = carried_tets(rest, fold, max_rounds=3, max_growth=3.0, progress=Silent())
    assert found.inverted_left > 0
    assert "rounds of splitting" in found.stopped or "times those given" in found.stopped
    assert found.inverted_left <= found.inverted_before
    small = carried_tets(rest, fold, max_rounds=30, max_growth=1.0, progress=Silent())
    assert "more than 1 times those given" in small.stopped


def test_tets_only_moved_are_counted_in_nothing() -> None:
    rest = two_tissues((2, 2, 2))
    found = moved_tets(rest, bend(10.0))
    assert (found.rest is rest, found.rounds, found.stopped) == (True, 0, "not asked for")
    np.testing.assert_array_equal(found.vertices, bend(10.0)(rest.mesh.vertices))


def test_a_tet_too_flat_to_be_cut_stays() -> None:
    """Two tets as flat as numbers allow: the middle of their longest edge rounds onto the face."""
    flat = np.nextafter(1.0, 2.0)
    vertices = np.array([[0.3, 0.1, 1.0], [7.7, 0.2, 1.0], [0.1, 9.1, 1.0], [2.9, 3.1, flat]])
    rest = two_tissues((2, 2, 2))
    rest = replace(rest, mesh=TetMesh(vertices, np.array([[0, 1, 2, 3]])), tissue_of_tet=np.array([0]))

    def mirror(points: Points) -> Points:
        return points * (1, 1, -1)

    found = carried_tets(rest, mirror, max_rounds=60, max_growth=50.0, progress=Silent())
    assert found.stopped
    assert found.rest is rest
