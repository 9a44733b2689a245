"""Thin places, slivers and triangles that are too near: found and taken out on shapes whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planted import ball, box, joined

from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.queries.hausdorff import reach
from musclefit.geometry.queries.nearby_faces import faces_near
from musclefit.geometry.surfaces.booleans import AROUND, LEAST_COSINE, SHRINKS, difference, grown_by, padded
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.geometry.surfaces.faults import faults_of
from musclefit.geometry.surfaces.slivers import heights, without_slivers
from musclefit.geometry.surfaces.thin_walls import thin_places, without_thin_places


def _wedge(degrees):
    """A blade of 10 mm in x and y whose two faces meet at x = 0."""
    h = 5.0 * np.tan(np.radians(0.5 * degrees)) * 2.0
    vertices = np.array([[0, 0, 0], [0, 10, 0], [10, 0, -h], [10, 10, -h], [10, 0, h], [10, 10, h]], dtype=float)
    faces = np.array([[0, 1, 2], [1, 3, 2], [0, 4, 1], [1, 4, 5], [2, 3, 4], [3, 5, 4], [0, 2, 4], [1, 5, 3]])
    return TriMesh(vertices, faces)


@pytest.mark.parametrize(("thickness", "thin"), [(0.02, True), (0.099, True), (0.101, False), (1.0, False)])
def test_a_plate_is_a_thin_wall_below_the_width_and_not_above(thickness, thin):
    found = thin_places(box((8.0, 6.0, thickness)), width_mm=0.1)
    assert found.area_mm2 == pytest.approx(2 * 48.0 if thin else 0.0, rel=0.01)
    assert not found.slot.any()


@pytest.mark.parametrize(("gap", "thin"), [(0.02, True), (0.099, True), (0.101, False)])
def test_two_parts_of_one_surface_are_a_slot_below_the_width(gap, thin):
    found = thin_places(joined(box((8.0, 6.0, 2.0)), box((8.0, 6.0, 2.0), at=(0.0, 0.0, 2.0 + gap))), width_mm=0.1)
    assert found.area_mm2 == pytest.approx(2 * 48.0 if thin else 0.0, rel=0.01)
    assert not found.wall.any()


@pytest.mark.parametrize(("degrees", "thin"), [(3.0, True), (8.0, True), (15.0, False), (60.0, False)])
def test_a_wedge_is_thin_up_to_where_it_is_as_wide(degrees, thin):
    found = thin_places(_wedge(degrees), width_mm=0.2)
    where = found.mesh.corners().mean(axis=1)[found.thin]
    assert bool(len(where)) == thin
    if thin:
        assert where[:, 0].max() == pytest.approx(0.2 / (2.0 * np.tan(np.radians(0.5 * degrees))), abs=0.5)


@given(st.integers(0, 2**31), st.floats(0.01, 0.3), st.floats(0.01, 0.3))
@settings(max_examples=25, deadline=None)
def test_thin_places_do_not_depend_on_the_triangles_or_the_axes(seed, thickness, width):
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    plate = box((3.0, 2.0, thickness))
    found = thin_places(plate.with_vertices(np.array(plate.vertices) @ turn.T + rng.normal(size=3)), width_mm=width)
    if abs(thickness - width) > 1e-6:
        assert found.thin.any() == (thickness < width)


def test_thin_places_go_with_their_surroundings_and_nothing_else_does():
    mesh = difference(box((20.0, 10.0, 4.0)), [box((8.0, 12.0, 4.0), at=(-1.0, -1.0, 0.04))], smooth_within_mm=0.0)
    found = thin_places(mesh, width_mm=0.1)
    assert found.area_mm2 == pytest.approx(2 * 70.0, rel=0.02)
    left = without_thin_places(mesh, found, width_mm=0.1, smooth_within_mm=0.0)
    assert faults_of(left).none
    assert enclosed_volume(left) == pytest.approx(13.0 * 10.0 * 4.0, rel=2e-3)
    assert not thin_places(left, width_mm=0.1).thin.any()
    assert len(found.covering().faces) < 0.7 * found.thin.sum()


def test_what_covers_thin_places_has_their_area():
    found = thin_places(_wedge(4.0), width_mm=0.2)
    cover = found.covering()
    sizes = np.linalg.norm(np.cross(*np.moveaxis(np.diff(cover.corners(), axis=1), 1, 0)), axis=1)
    assert 0.5 * sizes.sum() == pytest.approx(found.area_mm2, rel=1e-9)


def test_the_icosahedra_that_stand_for_balls_hold_the_unit_ball():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    widths = (directions @ AROUND.T).max(axis=1)
    assert widths.min() >= 1.0
    assert np.linalg.norm(AROUND, axis=1) == pytest.approx(1.2584, abs=1e-4)
    point = TriMesh(1e-9 * np.eye(3), np.array([[0, 1, 2]]))
    surface = padded(point, np.array([0]), distance_mm=1.0)
    assert nearest_places(np.zeros((1, 3)), surface).distances[0] >= 1.0


@pytest.mark.parametrize("gap", [0.05, 0.2, 0.5])
def test_faces_near_another_surface_are_found_by_their_whole_area(gap):
    plate = box((20.0, 20.0, 1.0), at=(-10.0, -10.0, -1.0 - gap))  # large triangles: no corner is near the ball
    small = ball(3, radius=2.0, at=(1.0, 3.0, 2.0))
    found = faces_near(plate, small, within_mm=0.1)
    assert bool(len(found)) == (gap < 0.1)
    back = faces_near(small, plate, within_mm=0.1)
    low = small.vertices[small.faces][:, :, 2].min(axis=1) + gap
    assert set(np.flatnonzero(low < 0.1)) <= set(back)
    assert (low[back] <= 0.11).all()


@given(st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_no_face_near_another_surface_is_missed(seed):
    rng = np.random.default_rng(seed)
    small = ball(1, radius=1.0)
    mesh = TriMesh(rng.normal(scale=2.0, size=(60, 3)), np.arange(60).reshape(20, 3))
    weights = np.array([(i, j, 12 - i - j) for i in range(13) for j in range(13 - i)]) / 12.0
    places = np.einsum("wk,fki->fwi", weights, mesh.corners())
    apart = nearest_places(places.reshape(-1, 3), small).distances.reshape(20, -1).min(axis=1)
    found = faces_near(mesh, small, within_mm=0.2)
    assert set(np.flatnonzero(apart < 0.2)) <= set(found)


def test_growing_a_surface_into_its_own_notch_does_not_make_it_cross_itself():
    notched = difference(box((10.0, 10.0, 10.0)), [box((0.15, 12.0, 6.0), at=(5.0, -1.0, 5.0))], smooth_within_mm=0.0)
    grown = grown_by(notched, distance_mm=0.1)
    assert len(self_crossings(grown)) == 0
    moved = np.linalg.norm(grown.vertices - notched.vertices, axis=1)
    assert moved.min() >= 0.1 * 0.5**SHRINKS
    assert moved.max() <= 0.1 / LEAST_COSINE


def _grazed(seed):
    """Two balls of which one grazes the other: a boolean's needles and caps."""
    rng = np.random.default_rng(seed)
    at = rng.normal(size=3)
    at *= rng.uniform(14.0, 15.5) / np.linalg.norm(at)
    return difference(ball(4), [ball(4, radius=5.5, at=at)], smooth_within_mm=0.0)


@pytest.mark.parametrize("seed", range(6))
def test_slivers_go_within_the_distance_and_leave_a_solid(seed):
    mesh = _grazed(seed)
    done = without_slivers(mesh, least_mm=0.02, most_mm=0.05)
    assert done.slivers == (heights(mesh) < 0.02).sum() > 0
    assert done.left == (heights(done.mesh) < 0.02).sum() <= 0.3 * done.slivers
    assert faults_of(done.mesh).none
    assert done.moved_mm <= 0.05
    apart = max(reach(mesh, done.mesh, tolerance_mm=1e-3).at_least, reach(done.mesh, mesh, tolerance_mm=1e-3).at_least)
    assert apart <= done.moved_mm + 1e-9
    assert enclosed_volume(done.mesh) == pytest.approx(enclosed_volume(mesh), rel=1e-4)


def test_a_surface_without_slivers_comes_back_as_it_was():
    mesh = ball(2)
    done = without_slivers(mesh, least_mm=0.02, most_mm=0.05)
    assert done.mesh is mesh
    assert (done.slivers, done.left, done.moved_mm) == (0, 0, 0.0)


def test_nothing_moves_where_nothing_may():
    mesh = _grazed(1)
    done = without_slivers(mesh, least_mm=0.02, most_mm=0.0)
    assert done.moved_mm == 0.0
    assert done.left == done.slivers
