"""A bar of tets bent and twisted by skeleton handles: exact handles, no inverted tet, and shapes with a formula."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from musclefit.fields.radial import RadialBackend
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.march import Pace, march
from musclefit.flow.rules import cayley_fractions
from musclefit.flow.steppers import HandleStepper, cayley_step
from musclefit.geometry.measures import signed_volumes
from musclefit.rig.skeleton import Skeleton, SkeletonPath, SkeletonPose, ring

LENGTH, HALF = 48.0, 4.0
ALONG = np.linspace(0.0, LENGTH, 5)
NO_TWIST = np.zeros(5)
FULL_TURN = np.linspace(0.0, 360.0, 5)


def bar(cubes: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and right-handed tets of a bar along z, six tets to a cell."""
    ends = (-HALF, HALF), (-HALF, HALF), (0.0, LENGTH)
    axes = [np.linspace(low, high, n + 1) for (low, high), n in zip(ends, cubes, strict=True)]
    vertices = np.stack([g.ravel() for g in np.meshgrid(*axes, indexing="ij")], axis=1)
    number = np.arange(len(vertices)).reshape([n + 1 for n in cubes])
    tets = []
    for cell in np.ndindex(*cubes):
        for order in itertools.permutations(np.eye(3, dtype=int)):
            corners = np.cumsum([cell, *order], axis=0)
            tets.append([number[tuple(c)] for c in corners])
    found = np.array(tets)
    wrong = signed_volumes(vertices, found) < 0.0
    found[wrong] = found[wrong][:, [0, 1, 3, 2]]
    return vertices, found


def arc(angle_deg: float) -> np.ndarray:
    turned = np.deg2rad(angle_deg) * ALONG / LENGTH
    return LENGTH / np.deg2rad(angle_deg) * np.stack([1.0 - np.cos(turned), 0.0 * turned, np.sin(turned)], axis=1)


def straight() -> np.ndarray:
    return np.stack([0.0 * ALONG, 0.0 * ALONG, ALONG], axis=1)


SKELETON = Skeleton(straight(), np.array([1.0, 0.0, 0.0]), ring(8, radius_mm=HALF))
BEND = SkeletonPath(SKELETON, (SkeletonPose(1.0, arc(150.0), NO_TWIST),))
TWIST_AND_BEND = SkeletonPath(
    SKELETON, (SkeletonPose(2.0 / 3.0, straight(), FULL_TURN), SkeletonPose(1.0, arc(150.0), FULL_TURN))
)
VERTICES, TETS = bar((4, 4, 24))


def deformed(path: SkeletonPath, kernel: str) -> Deformation:
    stepper = HandleStepper(path, RadialBackend(kernel), cayley_step)
    return march(stepper, rule=cayley_fractions, tested=VERTICES, pace=Pace(6, 6))


def test_the_bar_fills_its_box() -> None:
    volumes = signed_volumes(VERTICES, TETS)
    assert volumes.min() > 0.0
    np.testing.assert_allclose(volumes.sum(), 4.0 * HALF * HALF * LENGTH, rtol=1e-12, atol=0)


@pytest.mark.parametrize(("kernel", "least_ratio"), [("r3", 0.72), ("isochoric-r5", 0.86)])
def test_five_landmarks_bend_a_bar_by_150_degrees_in_one_call(kernel: str, least_ratio: float) -> None:
    deformation = deformed(BEND, kernel)
    assert deformation.status is Status.CONVERGED
    assert len(deformation.steps) <= 6
    np.testing.assert_allclose(deformation(BEND.position(0.0)), BEND.position(1.0), rtol=0, atol=1e-9)
    ratios = signed_volumes(deformation(VERTICES), TETS) / signed_volumes(VERTICES, TETS)
    assert ratios.min() >= least_ratio


@pytest.mark.parametrize(
    ("path", "least_ratio", "within"),
    [(BEND, 0.86, 0.004), (TWIST_AND_BEND, 0.76, 0.04)],
    ids=["bend", "twist and bend"],
)
def test_an_isochoric_field_keeps_the_volume_of_the_bar(path: SkeletonPath, least_ratio: float, within: float) -> None:
    deformation = deformed(path, "isochoric-r5")
    assert deformation.status is Status.CONVERGED
    assert len(deformation.steps) <= 6
    np.testing.assert_allclose(deformation(path.position(0.0)), path.position(1.0), rtol=0, atol=1e-9)
    rest, moved = signed_volumes(VERTICES, TETS), signed_volumes(deformation(VERTICES), TETS)
    assert (
        moved / rest
    ).min() >= least_ratio  # of coarse straight tets: 0.93 and 0.88 on 18,432 (examples/fig4_bar.py)
    determinants = np.linalg.det(deformation.jacobian(VERTICES))
    assert abs(determinants.mean() - 1.0) <= 0.002
    # Six steps: an implicit midpoint step keeps volume to third order in its size.
    np.testing.assert_allclose(determinants, 1.0, rtol=0, atol=within)


def test_the_axis_of_the_bent_bar_is_a_circular_arc() -> None:
    deformation = deformed(BEND, "isochoric-r5")
    axis = np.stack([np.zeros(97), np.zeros(97), np.linspace(0.0, LENGTH, 97)], axis=1)
    radius = LENGTH / np.deg2rad(150.0)
    from_centre = np.linalg.norm(deformation(axis) - np.array([radius, 0.0, 0.0]), axis=1)
    # Between the stations, 12 mm apart, the axis is free.
    np.testing.assert_allclose(from_centre, radius, rtol=0, atol=0.8)
    np.testing.assert_allclose(from_centre[::24], radius, rtol=0, atol=1e-9)


def test_a_twist_turns_every_section_by_its_share() -> None:
    path = SkeletonPath(SKELETON, (SkeletonPose(1.0, straight(), FULL_TURN),))
    deformation = deformed(path, "isochoric-r5")
    z = np.linspace(0.0, LENGTH, 49)
    angle = np.deg2rad(360.0) * z / LENGTH
    moved = deformation(np.stack([np.full(49, 2.0), np.zeros(49), z], axis=1))
    expected = np.stack([2.0 * np.cos(angle), 2.0 * np.sin(angle), z], axis=1)
    np.testing.assert_allclose(moved, expected, rtol=0, atol=0.5)


def test_a_full_turn_is_lost_on_straight_lines_and_kept_on_the_path() -> None:
    path = SkeletonPath(SKELETON, (SkeletonPose(1.0, straight(), np.full(5, 360.0)),))
    np.testing.assert_allclose(path.position(1.0), path.position(0.0), rtol=0, atol=1e-12)
    np.testing.assert_allclose(path.position(0.5)[5], -path.position(0.0)[5], rtol=0, atol=1e-12)
