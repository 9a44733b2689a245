"""Implicit shapes against formulas: distances of balls and cylinders, bounds of blends, volumes of surfaces."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from musclefit.anatomy.builtin.implicit_shapes import (
    NEVER,
    ball,
    carved,
    cylinder,
    ellipsoid,
    graded_axis,
    offset,
    parted,
    polygonised,
    revolved,
    smooth_maximum,
    smooth_minimum,
    swept_about_x,
    tube,
    union,
    within_box,
)
from musclefit.errors import MeshError
from musclefit.geometry.measures import enclosed_volume

ORIGIN = np.zeros(3)
POINTS = np.random.default_rng(5).uniform(-8.0, 8.0, (500, 3))
EVEN = [np.arange(-8.25, 8.3, 0.5)] * 3


@given(st.floats(-10, 10), st.floats(-10, 10), st.floats(0.1, 5))
def test_smooth_minimum_is_below_by_at_most_a_quarter_of_the_blend(a: float, b: float, blend: float) -> None:
    first, second = np.array([a]), np.array([b])
    low = smooth_minimum(first, second, blend_mm=blend)[0]
    assert min(a, b) - blend / 4.0 - 1e-12 <= low <= min(a, b)
    assert smooth_maximum(-first, -second, blend_mm=blend)[0] == -low


def test_distances_that_have_formulas() -> None:
    np.testing.assert_allclose(
        ball(np.array([1.0, 0, 0]), radius_mm=2.0)(POINTS),
        np.linalg.norm(POINTS - [1.0, 0, 0], axis=1) - 2.0,
        atol=1e-12,
    )
    sphere = ellipsoid(ORIGIN, semi_axes_mm=np.full(3, 3.0), rotation=np.eye(3))
    np.testing.assert_allclose(sphere(POINTS), np.linalg.norm(POINTS, axis=1) - 3.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(sphere(ORIGIN[None]), [-3.0], rtol=0, atol=1e-12)
    rod = cylinder(start=np.array([0, 0, -3.0]), end=np.array([0, 0, 3.0]), radius_mm=2.0, rounding_mm=0.5)
    at = np.array([[0.0, 0, 0], [5, 0, 0], [0, 0, 7], [0, 1.5 + 3, 2.5 + 4]])
    np.testing.assert_allclose(rod(at), [-2.0, 3.0, 4.0, 5.0 - 0.5], rtol=0, atol=1e-12)


def test_straight_round_tube_is_a_capsule() -> None:
    capsule = tube(np.array([[0, 0, -4.0], [0, 0, 0], [0, 0, 4.0]]), np.full((3, 2), 1.5), width_direction=[1.0, 0, 0])
    nearest = np.clip(POINTS[:, 2], -4.0, 4.0)[:, None] * [0, 0, 1.0]
    np.testing.assert_allclose(capsule(POINTS), np.linalg.norm(POINTS - nearest, axis=1) - 1.5, rtol=0, atol=1e-9)


def test_tube_has_its_semi_axes_along_the_width_and_across() -> None:
    flat = tube(np.array([[0, 0, -9.0], [0, 0, 9.0]]), np.array([[4.0, 1.0], [4.0, 1.0]]), width_direction=[0, 1.0, 0])
    on_surface = np.array([[0, 4.0, 0], [1.0, 0, 0], [0, 0, 10.0]])
    np.testing.assert_allclose(flat(on_surface), 0.0, rtol=0, atol=1e-12)


def test_revolved_line_is_a_cylinder_that_grows_by_its_margin() -> None:
    solid = revolved(np.array([-2.0, 0.0, 2.0]), np.full(3, 1.0), margin_mm=0.5)
    np.testing.assert_allclose(solid(np.array([[0, 0, 1.5], [2.5, 0, 0], [0, 2.5, 0]])), [0, 0, 1], rtol=0, atol=1e-12)


def test_carving_keeps_the_gap_and_parting_keeps_both_apart() -> None:
    first, second = ball(np.array([-1.5, 0, 0]), radius_mm=3.0), ball(np.array([1.5, 0, 0]), radius_mm=3.0)
    inside = carved(first, second, gap_mm=0.7, blend_mm=1.0)(POINTS) < 0.0
    assert inside.any()
    assert second(POINTS[inside]).min() >= 0.7
    left = parted(first, second, gap_mm=0.6, blend_mm=1.0)(POINTS) < 0.0
    right = parted(second, first, gap_mm=0.6, blend_mm=1.0)(POINTS) < 0.0
    assert left.any()
    assert right.any()
    gaps = np.linalg.norm(POINTS[left][:, None] - POINTS[right][None], axis=2)
    assert gaps.min() >= 0.6 - 1e-12


def test_sweep_is_the_union_of_the_turned_shapes() -> None:
    """A ball at radius 4 turned a quarter: a quarter torus with round ends, known up to the lattice's spacing²."""
    swept = swept_about_x(
        ball(np.array([0, 4.0, 0]), radius_mm=1.5), turn_deg=(0, 90), half_length_mm=9, radius_mm=12, spacing_mm=0.25
    )
    angle = np.clip(np.arctan2(POINTS[:, 2], POINTS[:, 1]), 0.0, np.pi / 2)
    behind = np.arctan2(POINTS[:, 2], POINTS[:, 1]) < -0.75 * np.pi
    angle = np.where(behind, np.pi / 2, angle)
    nearest = 4.0 * np.column_stack([np.zeros_like(angle), np.cos(angle), np.sin(angle)])
    expected = np.linalg.norm(POINTS - nearest, axis=1) - 1.5
    np.testing.assert_allclose(swept(POINTS), expected, rtol=0, atol=0.12)
    assert swept(np.array([[0, 0, 13.0]]))[0] == NEVER


def test_box_leaves_the_inside_and_hides_the_outside() -> None:
    shape = ball(ORIGIN, radius_mm=2.0)
    boxed = within_box(shape, np.array([[-3.0] * 3, [3.0] * 3]))(POINTS)
    inside = (np.abs(POINTS) < 3.0).all(axis=1)
    np.testing.assert_array_equal(boxed[inside], shape(POINTS[inside]))
    assert (boxed[~inside] == NEVER).all()


def test_graded_axis_meets_its_stretches() -> None:
    axis = graded_axis((0.0, 1.0, 0.3), (1.0, 9.0, 2.0))
    np.testing.assert_allclose(axis, [0, 0.25, 0.5, 0.75, 1, 3, 5, 7, 9], rtol=0, atol=1e-12)


@pytest.mark.parametrize("rounds", [0, 5])
def test_surface_of_a_ball(rounds: int) -> None:
    mesh = polygonised(ball(ORIGIN, radius_mm=5.0), axes=EVEN, relaxations=rounds)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 5.0, rtol=0, atol=1e-3)
    assert enclosed_volume(mesh) == pytest.approx(4.0 / 3.0 * np.pi * 125.0, rel=0.01)


def test_uneven_lattice_gives_the_same_solid() -> None:
    axes = [*EVEN[:2], graded_axis((-8.0, 0.0, 0.4), (0.0, 8.0, 1.1))]
    shape = union(ball(ORIGIN, radius_mm=4.0), ball(np.array([0, 0, 3.0]), radius_mm=3.0), blend_mm=1.0)
    even, uneven = (polygonised(shape, axes=a, relaxations=3) for a in (EVEN, axes))
    assert enclosed_volume(uneven) == pytest.approx(enclosed_volume(even), rel=0.01)
    np.testing.assert_allclose(shape(uneven.vertices), 0.0, rtol=0, atol=0.01)


def test_relaxing_removes_slivers() -> None:
    def worst(rounds: int) -> float:
        corners = polygonised(ball(ORIGIN, radius_mm=5.0), axes=EVEN, relaxations=rounds).corners()
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        return float((sides.min(axis=1) / sides.max(axis=1)).min())

    assert worst(6) > 3.0 * worst(0)
    assert worst(6) > 0.35


def test_surface_that_leaves_the_lattice_is_refused() -> None:
    with pytest.raises(MeshError, match="widen the axes"):
        polygonised(ball(ORIGIN, radius_mm=9.0), axes=EVEN, relaxations=0)
    with pytest.raises(MeshError, match="negative inside"):
        polygonised(offset(ball(ORIGIN, radius_mm=1.0), by_mm=-2.0), axes=EVEN, relaxations=0)


def test_two_pieces_are_refused_and_located() -> None:
    apart = union(ball(np.array([-4.0, 0, 0]), radius_mm=3.0), ball(np.array([4.0, 0, 0]), radius_mm=2.0), blend_mm=0.1)
    with pytest.raises(MeshError, match=r"2 pieces .* near \[ ?4"):
        polygonised(apart, axes=EVEN, relaxations=0)
