"""Heads of hinges: the side that they are set off to, what turns past the joint, fits that a front would mislead."""

from __future__ import annotations

import numpy as np
import pytest
from joint_shapes import known_joint, missed, shaft

from musclefit.geometry.measures import area_vectors
from musclefit.geometry.meshes import TriMesh
from musclefit.rig.articulation import fitted_joint
from musclefit.rig.hinge_heads import TURN_DEG, outwardness, overhanging_side, turned_past

X = np.array([1.0, 0.0, 0.0])


def samples(mesh: TriMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    vectors = area_vectors(mesh)
    areas = np.linalg.norm(vectors, axis=1)
    return mesh.corners().mean(axis=1), vectors / areas[:, None], areas


def head_and_shaft(set_off_mm: float, length: float = 90.0) -> tuple[np.ndarray, np.ndarray]:
    """A ball of 10 mm at the origin and a tube of 8 mm from it along z, set off along y."""
    tube = shaft(length, 8.0, start=5.0, sign=1.0, cuts=40)
    places, _, areas = samples(TriMesh(tube.vertices + np.array([0.0, set_off_mm, 0.0]), tube.faces))
    turn, height = np.meshgrid(np.linspace(0, 2 * np.pi, 30), np.linspace(-9.5, 9.5, 30))
    round_it = np.sqrt(100.0 - height**2)
    ball = np.stack([round_it * np.cos(turn), round_it * np.sin(turn), height], axis=-1).reshape(-1, 3)
    return np.concatenate([places, ball]), np.concatenate([areas, np.full(len(ball), 1.4)])


def test_a_head_points_outwards_and_a_cup_inwards() -> None:
    places, normals, areas = samples(shaft(30.0, 8.0, start=0.0, sign=1.0, cuts=40))
    axis = {"at": np.array([0.0, 0.0, 3.0]), "along": np.array([0.0, 0.0, 1.0])}
    assert abs(outwardness(places, normals, areas, **axis)) == pytest.approx(1.0, abs=0.01)
    assert outwardness(places, -normals, areas, **axis) == pytest.approx(-outwardness(places, normals, areas, **axis))


@pytest.mark.parametrize("set_off", [7.0, -7.0])
def test_the_side_that_a_head_is_set_off_to(set_off: float) -> None:
    points, areas = head_and_shaft(set_off)
    side = overhanging_side(points, areas, middle=np.array([0.0, 0.0, -10.0]), along=X, size=8.0)
    assert side is not None
    assert side @ [0.0, -np.sign(set_off), 0.0] > 0.98


def test_a_head_straight_above_its_shaft_has_no_side() -> None:
    points, areas = head_and_shaft(0.0)
    assert overhanging_side(points, areas, middle=np.array([0.0, 0.0, -10.0]), along=X, size=8.0) is None


def test_a_short_bone_has_no_shaft() -> None:
    points, areas = head_and_shaft(7.0, length=20.0)
    assert overhanging_side(points, areas, middle=np.array([0.0, 0.0, -10.0]), along=X, size=8.0) is None


def test_what_turns_past_goes_on_to_the_side() -> None:
    """About x through the origin, what faces below: places at angles from there, some beyond what faces along x."""
    degrees = np.array([-60.0, -10.0, 0.0, 60.0, 110.0, 150.0])
    ring = 10.0 * np.column_stack([np.zeros(6), np.sin(np.radians(degrees)), -np.cos(np.radians(degrees))])
    facing = np.array([[x, y, -10.0] for x in (-5.0, 5.0) for y in (-2.0, 0.0, 2.0)])
    asked = {"at": np.zeros(3), "along": X, "middle": np.array([0.0, 0.0, -10.0])}
    there = turned_past(ring, facing, np.ones(6), side=np.array([0.0, 1.0, 0.0]), **asked)
    assert there.tolist() == [bool(TURN_DEG[0] < angle < TURN_DEG[1]) for angle in degrees]
    other = turned_past(ring, facing, np.ones(6), side=np.array([0.0, -1.0, 0.0]), **asked)
    assert other.tolist() == [True, True, True, False, False, False]
    cup = turned_past(ring, facing, np.ones(6), side=None, **asked)
    assert cup.tolist() == [False, True, True, False, False, False]
    assert not turned_past(ring + 9.0 * X, facing, np.ones(6), side=None, **asked).any()


@pytest.mark.parametrize("swapped", [False, True])
def test_the_front_of_a_head_does_not_mislead(swapped: bool) -> None:
    """As a femur's does: it turns about an axis 15 mm away. All around the joint fits an axis 4 mm off."""
    known = known_joint("condyles", cuts=(24, 24), noise_mm=0.1, mirrored=swapped)
    bones = (known.moving, known.fixed) if swapped else (known.fixed, known.moving)
    found = fitted_joint(*bones, kind=known.kind)
    off = missed(found, known)
    assert off.degrees < 1.5
    assert off.mm < 1.5
    assert off.mm < 2.0 * found.uncertain_mm
