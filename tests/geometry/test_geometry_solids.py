"""Booleans of solids against formulas, and attacks by surfaces that must not pass as solids."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from musclefit.errors import MeshError
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.solids import (
    ROUNDING_MM3,
    candidate_pairs,
    outside_mesh,
    overlap_mesh,
    overlap_volume,
    pieces,
    refined_to,
    solid_of,
    volume_outside,
)
from musclefit.geometry.queries.winding import winding_numbers


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> TriMesh:
    mesh = trimesh.creation.box(bounds=[low, high])
    return TriMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def sphere(radius: float, *, centre: tuple[float, float, float] = (0, 0, 0), subdivisions: int = 4) -> TriMesh:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return TriMesh(np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces))


def reversed_mesh(mesh: TriMesh) -> TriMesh:
    return TriMesh(mesh.vertices, mesh.faces[:, ::-1])


def joined(*meshes: TriMesh) -> TriMesh:
    offsets = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    return TriMesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + o for m, o in zip(meshes, offsets, strict=False)]),
    )


def lens_volume(r: float, s: float, d: float) -> float:
    """Intersection of two balls of radii r and s, centres d apart (textbook formula)."""
    return np.pi * (r + s - d) ** 2 * (d * d + 2 * d * (r + s) - 3 * (r - s) ** 2) / (12 * d)


def test_overlap_of_two_boxes_is_the_common_box() -> None:
    a, b = solid_of(box((0, 0, 0), (10, 10, 10))), solid_of(box((7, 4, -3), (20, 9, 2)))
    np.testing.assert_allclose(overlap_volume(a, b), 3 * 5 * 2, rtol=1e-12, atol=0)
    np.testing.assert_allclose(volume_outside(a, b), 1000 - 30, rtol=1e-12, atol=0)
    np.testing.assert_allclose(enclosed_volume(overlap_mesh(a, b)), 30, rtol=1e-12, atol=0)
    np.testing.assert_allclose(enclosed_volume(outside_mesh(a, b)), 970, rtol=1e-12, atol=0)


@pytest.mark.parametrize(("r", "s", "d"), [(10.0, 10.0, 10.0), (10.0, 6.0, 12.0), (5.0, 5.0, 9.0)])
def test_overlap_of_two_spheres_is_the_lens(r: float, s: float, d: float) -> None:
    a, b = solid_of(sphere(r, subdivisions=5)), solid_of(sphere(s, centre=(0, 0.6 * d, 0.8 * d), subdivisions=5))
    # The spheres are inscribed polyhedra: 0.1 % of their volume, more of a thin lens.
    np.testing.assert_allclose(overlap_volume(a, b), lens_volume(r, s, d), rtol=0.01, atol=0)


def test_far_from_the_origin_no_digits_are_lost() -> None:
    shift = np.array([1e4, -2e4, 3e4])
    a, b = box((0, 0, 0), (10, 10, 10)), box((9.999, 0, 0), (20, 10, 10))
    volume = overlap_volume(
        solid_of(a.with_vertices(a.vertices + shift)), solid_of(b.with_vertices(b.vertices + shift))
    )
    np.testing.assert_allclose(volume, 0.1, rtol=1e-6, atol=0)


@given(
    seed=st.integers(0, 2**31),
    shift=st.tuples(*[st.floats(-12, 12)] * 3),
    radius=st.floats(0.5, 12),
)
@settings(max_examples=40, deadline=None)
def test_inside_and_outside_make_up_the_whole_and_order_does_not_matter(seed, shift, radius) -> None:
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    ball, cube = sphere(radius, centre=shift, subdivisions=2), box((-5, -4, -3), (5, 4, 3))
    a, b = solid_of(ball), solid_of(cube.with_vertices(cube.vertices @ turn.T))
    shared = overlap_volume(a, b)
    np.testing.assert_allclose(shared + volume_outside(a, b), a.volume, rtol=1e-9, atol=ROUNDING_MM3)
    np.testing.assert_allclose(shared, overlap_volume(b, a), rtol=1e-9, atol=ROUNDING_MM3)


@pytest.mark.parametrize("seed", range(8))
def test_two_halves_of_a_cut_ball_touch_without_overlap(seed: int) -> None:
    """The noise floor: flat walls meshed differently, moved to a place where nothing is representable exactly."""
    rng = np.random.default_rng(seed)
    move = Rotation.random(rng=rng).as_matrix()
    upper, lower = box((-100, -100, 0), (100, 100, 90)), box((-100, -100, -50), (100, 100, 0))
    halves = [refined_to(upper, edge_length_mm=17.0), refined_to(lower, edge_length_mm=23.0)]
    a, b = (solid_of(h.with_vertices(h.vertices @ move.T + 700.0)) for h in halves)
    assert overlap_volume(a, b) < ROUNDING_MM3
    np.testing.assert_allclose(volume_outside(a, b), a.volume, rtol=0, atol=10 * ROUNDING_MM3)


@pytest.mark.parametrize("depth", [1e-8, 1e-6, 1e-3])
def test_a_true_overlap_far_thinner_than_a_hair_is_seen(depth: float) -> None:
    a, b = solid_of(box((0, 0, 0), (100, 100, 10))), solid_of(box((0, 0, 10 - depth), (100, 100, 20)))
    np.testing.assert_allclose(overlap_volume(a, b), 1e4 * depth, rtol=1e-2, atol=0)


def test_a_solid_wholly_inside_another_overlaps_by_its_own_volume() -> None:
    inner, outer = solid_of(sphere(3, subdivisions=3)), solid_of(sphere(10, subdivisions=3))
    np.testing.assert_allclose(overlap_volume(inner, outer), inner.volume, rtol=1e-12, atol=0)
    assert volume_outside(inner, outer) == 0.0


def test_boxes_apart_share_nothing_and_give_an_empty_mesh() -> None:
    a, b = solid_of(box((0, 0, 0), (1, 1, 1))), solid_of(box((2, 0, 0), (3, 1, 1)))
    assert overlap_volume(a, b) == 0.0
    assert volume_outside(a, b) == a.volume
    assert len(overlap_mesh(a, b).faces) == 0


def test_an_inside_out_surface_is_refused_and_never_overlaps_by_nothing() -> None:
    with pytest.raises(MeshError, match=r"encloses -1000 mm³, so it is inside-out or flat"):
        solid_of(reversed_mesh(box((0, 0, 0), (10, 10, 10))))


def test_an_open_surface_is_refused() -> None:
    mesh = box((0, 0, 0), (10, 10, 10))
    with pytest.raises(MeshError, match="not a closed oriented 2-manifold"):
        solid_of(TriMesh(mesh.vertices, mesh.faces[1:]))


def test_a_surface_with_one_turned_triangle_is_refused() -> None:
    mesh = box((0, 0, 0), (10, 10, 10))
    faces = mesh.faces.copy()
    faces[0] = faces[0, ::-1]
    with pytest.raises(MeshError, match="not a closed oriented 2-manifold"):
        solid_of(TriMesh(mesh.vertices, faces))


def test_an_empty_surface_is_refused() -> None:
    with pytest.raises(MeshError, match="no triangle"):
        solid_of(TriMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)))


def test_an_inside_out_piece_beside_a_larger_good_one_is_refused() -> None:
    """The whole has a positive volume, so that a look at the sum alone would pass it."""
    mesh = joined(sphere(10, subdivisions=2), reversed_mesh(sphere(3, centre=(30, 0, 0), subdivisions=2)))
    assert enclosed_volume(mesh) > 0
    with pytest.raises(MeshError, match=r"piece 2 of 2 .* is inside-out and no cavity"):
        solid_of(mesh)


def test_a_cavity_is_no_fault_and_is_empty() -> None:
    hollow = solid_of(joined(sphere(10, subdivisions=3), reversed_mesh(sphere(5, subdivisions=3))))
    core = solid_of(sphere(2, subdivisions=2))
    assert overlap_volume(hollow, core) == 0.0
    np.testing.assert_allclose(volume_outside(core, hollow), core.volume, rtol=1e-12, atol=0)


def test_a_piece_counted_twice_is_refused() -> None:
    with pytest.raises(MeshError, match="lies wholly inside another piece and would count twice"):
        solid_of(joined(sphere(10, subdivisions=2), sphere(5, subdivisions=2)))


def test_two_pieces_apart_are_one_solid() -> None:
    pair = solid_of(joined(box((0, 0, 0), (1, 1, 1)), box((4, 0, 0), (5, 1, 1))))
    np.testing.assert_allclose(overlap_volume(pair, solid_of(box((0.5, 0, 0), (4.5, 1, 1)))), 1.0, rtol=1e-12, atol=0)


def test_a_surface_folded_through_itself_cannot_give_a_negative_overlap() -> None:
    """A tube pulled through its own end has a lobe that winds -1 times: the boolean there is negative."""
    ball = sphere(10, subdivisions=4)
    high = ball.vertices[:, 2] > 8.5
    vertices = ball.vertices.copy()
    vertices[high, 2] -= 24.0  # the top cap sinks through the bottom and hangs out below, inside out
    folded, probe = solid_of(ball.with_vertices(vertices)), solid_of(box((-2, -2, -13.5), (2, 2, -11)))
    with pytest.raises(MeshError, match=r"outside 0 to .* crosses itself or is locally inside out"):
        overlap_volume(folded, probe)


def test_refining_keeps_the_surface_and_shortens_its_edges() -> None:
    mesh = box((0, 0, 0), (10, 6, 3))
    fine = refined_to(mesh, edge_length_mm=1.0)
    np.testing.assert_allclose(enclosed_volume(fine), 180, rtol=1e-12, atol=0)
    corners = fine.corners()
    assert np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max() < 1.6


def test_pieces_are_found() -> None:
    parts = pieces(joined(box((0, 0, 0), (1, 1, 1)), sphere(2, centre=(9, 0, 0), subdivisions=1)))
    assert [len(p.faces) for p in parts] == [12, 80]


@given(seed=st.integers(0, 2**31), n=st.integers(0, 40))
@settings(max_examples=60, deadline=None)
def test_candidate_pairs_equal_all_pairs_tested_one_by_one(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    low = rng.integers(0, 10, size=(n, 3)).astype(float)  # integers: boxes that just touch are common
    boxes = [np.stack([a, a + rng.integers(0, 4, size=3)]) for a in low]
    expected = [
        (i, j)
        for i, j in itertools.combinations(range(n), 2)
        if (boxes[i][0] <= boxes[j][1]).all() and (boxes[j][0] <= boxes[i][1]).all()
    ]
    assert [tuple(p) for p in candidate_pairs(boxes)] == expected


def test_winding_numbers_tell_inside_from_outside() -> None:
    points = np.random.default_rng(3).uniform(-12, 12, size=(5000, 3))
    radius = np.linalg.norm(points, axis=1)
    numbers = winding_numbers(sphere(10), points)
    np.testing.assert_allclose(numbers[radius < 9.8], 1.0, rtol=0, atol=0.02)
    np.testing.assert_allclose(numbers[radius > 10.0], 0.0, rtol=0, atol=0.02)
    np.testing.assert_allclose(winding_numbers(reversed_mesh(sphere(10)), points), -numbers, rtol=0, atol=1e-6)
