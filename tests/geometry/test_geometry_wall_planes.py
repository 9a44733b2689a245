"""Planes in front of walls and between triangles: which side, how far, and what they leave alone."""

from __future__ import annotations

import numpy as np
import trimesh

from musclefit.geometry.arrays import Points
from musclefit.geometry.tets.relocation import Planes
from musclefit.geometry.tets.wall_planes import Divide, Wall, planes_before

BALL = trimesh.creation.icosphere(subdivisions=4, radius=5.0)
FACES = np.asarray(BALL.faces)


def ahead(planes: Planes, positions: Points) -> Points:
    """How far in front of its plane each point is, mm."""
    points = (positions[planes.corners] * planes.shares[:, :, None]).sum(axis=1)
    return ((points - planes.places) * planes.normals).sum(axis=1)


def seen(triangle: Points, *, rest_off: float = 2.0, margin: float = 0.1) -> tuple[Planes, Points]:
    """The planes before a ball for a triangle that was ``rest_off`` mm farther out at rest."""
    ball = np.asarray(BALL.vertices)
    now = np.vstack([ball, triangle])
    rest = np.vstack([ball, triangle + np.array([0, 0, rest_off])])
    wall = Wall.of(FACES, rest=rest, now=now)
    corners = np.arange(3)[None] + len(ball)
    faces = np.concatenate([FACES, corners])
    return planes_before(wall, faces, rest=rest, now=now, margins=np.full(len(now), margin)), now


def test_a_chord_through_a_ball_is_pushed_out_where_it_is_inside() -> None:
    """All corners are outside, the middle is 0.4 mm inside."""
    planes, now = seen(np.array([[-3.0, 0, 4.6], [3.0, 0, 4.6], [0.0, 0.2, 4.6]]))
    assert (planes.corners >= len(BALL.vertices)).all()  # the ball is not held off itself
    depth = np.linalg.norm((now[planes.corners] * planes.shares[:, :, None]).sum(axis=1), axis=1) - 5.0
    np.testing.assert_allclose(ahead(planes, now), depth, rtol=0, atol=0.02)
    assert depth.min() < -0.3
    np.testing.assert_allclose(planes.margins, 0.1, rtol=0, atol=0)


def test_nothing_is_held_farther_off_than_it_was_at_rest() -> None:
    planes, _ = seen(np.array([[-0.5, 0, 5.05], [0.5, 0, 5.05], [0.0, 0.5, 5.05]]), rest_off=0.0, margin=0.5)
    assert len(planes.margins)
    assert planes.margins.max() < 0.2


def test_what_is_far_off_needs_no_plane() -> None:
    planes, _ = seen(np.array([[-1.0, 0, 8.0], [1.0, 0, 8.0], [0.0, 1.0, 8.0]]))
    assert len(planes.margins) == 0


def test_a_divide_keeps_triangles_on_their_sides_and_shared_corners_alone() -> None:
    positions = np.array([[0, 0, 0.1], [1, 0, 0.1], [0, 1, 0.1], [1, 1, -0.1], [2, 0, -0.1]])
    first, second = np.array([0, 1, 2]), np.array([1, 3, 4])
    divide = Divide(first, second, np.zeros(3), np.array([0.0, 0, 1]), 0.05)
    planes = divide.planes()
    assert sorted(planes.corners[planes.shares > 0]) == [0, 2, 3, 4]
    np.testing.assert_allclose(ahead(planes, positions), -0.1, rtol=0, atol=1e-12)  # all on the wrong side
    assert divide.wider(np.ones(3), np.ones(3), by_mm=1.0, up_to_mm=0.3).margin_mm == 0.3
