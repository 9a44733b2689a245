"""Crossing triangles against a slow exact oracle, on contacts whose answer is known, and on real anatomy."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest
import trimesh

from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.crossings import crossings_between, self_crossings

FLOOR = [[0.0, 0, 0], [2, 0, 0], [0, 2, 0]]


def _pair(*second, shared=()):
    """The floor triangle and a second one, given by points or by numbers of the floor's corners."""
    faces = np.array([[0, 1, 2], [*shared, *range(3, 3 + len(second))]])
    return TriMesh(np.array([*FLOOR, *second], dtype=float), faces)


def _sphere(*, radius=10.0, at=(0.0, 0.0, 0.0), subdivisions=2):
    ball = trimesh.creation.icosphere(subdivisions, radius=radius)
    return TriMesh(np.array(ball.vertices) + at, np.array(ball.faces, dtype=np.int64))


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        pytest.param(_pair([0.5, 0.5, -1], [0.5, 0.5, 1], [3, 3, 1]), 1, id="pierced"),
        pytest.param(_pair([0.5, 0.5, 1], [0.5, 0.6, 1], [3, 3, 1]), 0, id="apart"),
        pytest.param(_pair([0.5, 0.5, 0], [1, 0.5, 1], [0.5, 1, 1]), 1, id="corner on face"),
        pytest.param(_pair([0.5, 0.5, 1e-300], [1, 0.5, 1], [0.5, 1, 1]), 0, id="corner next to face"),
        pytest.param(_pair([0, 0, 0], [1, 0.5, 1], [0.5, 1, 1]), 0, id="corner on corner"),
        pytest.param(_pair([1, 1, 1], [1, 0.5, -1], shared=[0]), 1, id="common corner, pierced"),
        pytest.param(_pair([-1, 0, 1], [0, -1, 1], shared=[0]), 0, id="common corner only"),
        pytest.param(_pair([0.5, -0.5, 0], shared=[1, 0]), 0, id="flat neighbours"),
        pytest.param(_pair([0.5, 0.5, 0], shared=[1, 0]), 1, id="folded onto each other"),
        pytest.param(_pair(shared=[2, 1, 0]), 1, id="back to back"),
        pytest.param(_pair([0.5, 0.5, -1], shared=[0, 0]), 0, id="a face that repeats a vertex"),
    ],
)
def test_contacts(mesh, expected):
    assert len(self_crossings(mesh)) == expected


@pytest.mark.parametrize("corner", [0, 1, 2])
@pytest.mark.parametrize("runs_back", [False, True])
@pytest.mark.parametrize(
    ("tip", "expected"), [([0.5, 0.5, 0], 1), ([0.5, 3, 0], 1), ([0.5, -0.5, 0], 0), ([1, 3, 1e-9], 0)]
)
def test_flat_neighbours_are_judged_the_same_however_they_are_oriented(tip, expected, runs_back, corner):
    second = [[1, 0, 3], [0, 1, 3]][runs_back]
    faces = np.array([[0, 1, 2], np.roll(second, corner)])
    found = self_crossings(TriMesh(np.array([*FLOOR, tip]), faces))
    assert len(found) == expected
    assert found.coplanar.all()


def test_only_coplanar_pairs_are_marked():
    assert self_crossings(_pair([0.5, 0.5, 0], shared=[1, 0])).coplanar.tolist() == [True]
    assert self_crossings(_pair([0.5, 0.5, -1], [0.5, 0.5, 1], [3, 3, 1])).coplanar.tolist() == [False]


def test_the_place_lies_in_both_boxes():
    (place,) = self_crossings(_pair([0.5, 0.5, -1], [0.5, 0.5, 1], [3, 3, 1])).places
    np.testing.assert_allclose(place, [1.25, 1.25, 0.0], rtol=0, atol=1e-12)


def _edge_pierces(a, b, corners):
    """Strictly, in exact arithmetic: the segment a b passes through the inside of the triangle."""

    def side(p, q, r, s):
        rows = [[Fraction(x) - Fraction(y) for x, y in zip(end, p, strict=True)] for end in (q, r, s)]
        (u, v, w) = rows
        return (
            u[0] * (v[1] * w[2] - v[2] * w[1]) - u[1] * (v[0] * w[2] - v[2] * w[0]) + u[2] * (v[0] * w[1] - v[1] * w[0])
        )

    first, second, third = corners
    if side(first, second, third, a) * side(first, second, third, b) >= 0:
        return False
    turns = [side(a, b, corners[i], corners[(i + 1) % 3]) for i in range(3)]
    return all(t > 0 for t in turns) or all(t < 0 for t in turns)


def _pierce(first, second):
    return any(
        _edge_pierces(own[i], own[(i + 1) % 3], other)
        for own, other in ((first, second), (second, first))
        for i in range(3)
    )


@pytest.mark.parametrize("seed", range(4))
def test_random_triangles_equal_the_oracle(seed):
    rng = np.random.default_rng(seed)
    soup = rng.uniform(-1, 1, (24, 1, 3)) + 1.2 * rng.uniform(-1, 1, (24, 3, 3))
    mesh = TriMesh(soup.reshape(-1, 3), np.arange(72).reshape(-1, 3))
    expected = [[i, j] for i, j in combinations(range(24), 2) if _pierce(soup[i], soup[j])]
    assert len(expected) > 10
    assert self_crossings(mesh).pairs.tolist() == expected
    a, b = (
        TriMesh(soup[:12].reshape(-1, 3), np.arange(36).reshape(-1, 3)),
        TriMesh(soup[12:].reshape(-1, 3), np.arange(36).reshape(-1, 3)),
    )
    between = [[i, j - 12] for i, j in expected if i < 12 <= j]
    assert crossings_between(a, b).pairs.tolist() == between


@pytest.mark.parametrize("seed", range(3))
def test_random_triangles_with_a_common_corner_equal_the_oracle(seed):
    rng = np.random.default_rng(seed)
    vertices = np.concatenate([[[0.1, 0.2, 0.3]], rng.uniform(-1, 1, (32, 3))])
    faces = np.stack([np.zeros(16, dtype=np.int64), np.arange(1, 33, 2), np.arange(2, 33, 2)], axis=1)
    soup = vertices[faces]
    expected = [[i, j] for i, j in combinations(range(16), 2) if _pierce(soup[i], soup[j])]
    assert len(expected) > 3
    assert self_crossings(TriMesh(vertices, faces)).pairs.tolist() == expected


def test_spheres_cross_where_they_overlap_and_not_when_nested():
    assert len(crossings_between(_sphere(), _sphere(at=(30, 0, 0)))) == 0
    assert len(crossings_between(_sphere(), _sphere(radius=5))) == 0
    found = crossings_between(_sphere(), _sphere(at=(10.1, 0.2, 0.3)))
    assert len(found) > 10
    ring = np.linalg.norm(found.places - [5.05, 0.1, 0.15], axis=1)  # the circle where two equal spheres meet
    np.testing.assert_allclose(ring, np.sqrt(100 - 5.05**2), rtol=0.25)


def test_touching_spheres_do_not_cross_themselves_and_a_merged_vertex_makes_no_difference():
    left, right = _sphere(subdivisions=1), _sphere(subdivisions=1)
    tip = left.vertices[np.argmax(left.vertices[:, 0])]
    mirrored = right.vertices * [-1, 1, 1] + 2 * tip * [1, 0, 0]
    both = TriMesh(
        np.concatenate([left.vertices, mirrored]),
        np.concatenate([left.faces, right.faces[:, ::-1] + len(left.vertices)]),
    )
    assert len(self_crossings(both)) == 0


def test_a_sphere_pushed_through_its_other_side_crosses_itself():
    ball = _sphere()
    vertices = ball.vertices.copy()
    top = int(np.argmax(vertices[:, 2]))
    vertices[top, 2] = -15.0
    found = self_crossings(TriMesh(vertices, ball.faces))
    assert len(found) > 0
    assert (found.pairs[:, 0] < found.pairs[:, 1]).all()
    spike = np.flatnonzero((ball.faces == top).any(axis=1))
    assert np.isin(found.pairs, spike).any(axis=1).all()


def test_empty_surfaces_do_not_cross():
    empty = TriMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    assert len(crossings_between(empty, _sphere())) == 0
    assert len(self_crossings(empty)) == 0


@pytest.mark.parametrize("depth", [1e-13, 1e-9, 1e-5, 0.1])
def test_what_reaches_through_by_no_more_than_a_length_is_told_from_what_crosses(depth: float) -> None:
    # A spike whose tip reaches through a plate by the depth.
    plate = [[-1.0, -1.0, 0.0], [3.0, -1.0, 0.0], [-1.0, 3.0, 0.0]]
    spike = [[0.0, 0.0, -depth], [0.2, 0.0, 1.0], [0.0, 0.2, 1.0]]
    mesh = TriMesh(np.array(plate + spike), np.array([[0, 1, 2], [3, 4, 5]]))
    found = self_crossings(mesh)
    assert len(found) == 1
    assert len(found.deeper(mesh, than_mm=1e-8)) == (depth > 1e-8)


def test_a_needle_through_a_plate_crosses_however_thin_it_is() -> None:
    plate = [[-1.0, -1.0, 0.0], [3.0, -1.0, 0.0], [-1.0, 3.0, 0.0]]
    needle = [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [1e-12, 0.0, 1.0]]
    mesh = TriMesh(np.array(plate + needle), np.array([[0, 1, 2], [3, 4, 5]]))
    found = self_crossings(mesh)
    assert len(found) == len(found.deeper(mesh, than_mm=1e-8)) == 1
