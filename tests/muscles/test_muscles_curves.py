"""Curves of fibres over a motion against a formula: a bar bent about a joint beside it."""

from __future__ import annotations

import numpy as np
import pytest
from tet_blocks import two_tissues

from musclefit.geometry.arrays import Points
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.geometry.surfaces.sections import Lengthwise
from musclefit.geometry.tets.topology import tet_faces
from musclefit.muscles.attachments import Attachment, MuscleEnds
from musclefit.muscles.fibres import laplace_fibres
from musclefit.muscles.measures import Lines, belly_of
from musclefit.muscles.motion_curves import MovingMuscle, motion_curves
from musclefit.muscles.streamlines import Streamlines, streamlines

LENGTH, LOW, HIGH = 60.0, 5.0, 8.0
"""Along x, and the bar's distances from the line through the joint, mm."""


def bar() -> TetMesh:
    mesh = two_tissues((20, 3, 3)).mesh
    low, size = mesh.vertices.min(axis=0), np.ptp(mesh.vertices, axis=0)
    return TetMesh((mesh.vertices - low) / size * [LENGTH, HIGH - LOW, 3.0] + [0.0, LOW, 0.0], mesh.tets)


def end(mesh: TetMesh, x: float, bone: str) -> Attachment:
    boundary = tet_faces(mesh.tets).boundary
    area = TriMesh(mesh.vertices, boundary[(np.abs(mesh.vertices[boundary][:, :, 0] - x) < 1e-9).all(axis=1)])
    middle = np.array([x, (LOW + HIGH) / 2.0, 1.5])
    return Attachment("bar", bone, area, np.zeros((0, 3)), 9.0, middle, 0.0)


def bent(points: Points, angle: float) -> Points:
    """The line y = 0 onto a circle, its length kept: what lies at y has the length L - y times the angle."""
    if angle == 0.0:
        return points
    radius = LENGTH / angle
    turned = points[:, 0] / radius
    return np.stack(
        [(radius - points[:, 1]) * np.sin(turned), radius - (radius - points[:, 1]) * np.cos(turned), points[:, 2]],
        axis=1,
    )


class Stage:
    """The bar from one angle to the next, by way of rest."""

    def __init__(self, seen: list[Points], angle: float) -> None:
        self.seen, self.angle = seen, angle

    def __call__(self, points: Points) -> Points:
        self.seen.append(points)
        return bent(self.seen[0], self.angle)


def bar_surface(mesh: TetMesh) -> TriMesh:
    corners, faces = np.unique(tet_faces(mesh.tets).boundary, return_inverse=True)
    return TriMesh(mesh.vertices[corners], faces.reshape(-1, 3))


def curves(angles_deg: list[float], *, other: list[float] | None = None):
    mesh = bar()
    ends = MuscleEnds("bar", end(mesh, 0.0, "one"), end(mesh, LENGTH, "two"))
    field = laplace_fibres(mesh, origin=ends.origin.surface, insertion=ends.insertion.surface, within_mm=1e-6)
    surface = bar_surface(mesh)
    muscle = MovingMuscle(ends, surface, streamlines(field, count=100), belly_of(surface, Lengthwise.of(surface)))
    seen: list[Points] = []
    shares = np.linspace(0.0, 1.0, len(angles_deg) + 1)
    stretches = [
        (a, b, Stage(seen, np.radians(angle))) for a, b, angle in zip(shares[:-1], shares[1:], angles_deg, strict=True)
    ]
    turned = other or [0.0] * len(shares)
    angles = {
        t: {"elbow": angle, "turn": second} for t, angle, second in zip(shares, [0.0, *angles_deg], turned, strict=True)
    }
    return motion_curves([muscle], stretches, angles_at=angles)


def test_lengths_and_moment_arms_are_those_of_the_bent_bar() -> None:
    states = curves([10.0, 25.0, 40.0, 60.0])
    assert [state.at for state in states] == pytest.approx([0.0, 0.25, 0.5, 0.75, 1.0])
    middle = (LOW + HIGH) / 2.0
    for state in states:
        angle = np.radians(state.angles_deg["elbow"])
        assert state.path_mm == pytest.approx(LENGTH - middle * angle, rel=1e-3)
        assert state.stretch == pytest.approx(1.0 - middle * angle / LENGTH, rel=1e-3)
        assert state.pennation_deg < 5.0  # the centreline is one of few sections
        assert state.moment_arm_path_mm == pytest.approx(middle, rel=0.01)  # of 100 lines
        chord = 2.0 * (LENGTH / angle - middle) * np.sin(angle / 2.0) if angle else LENGTH
        assert state.line_mm == pytest.approx(chord, rel=1e-9)
    assert states[0].moment_arm_line_mm == pytest.approx(middle, rel=0.02)
    assert states[-1].moment_arm_line_mm > middle  # type: ignore[operator]


def test_there_is_no_moment_arm_where_two_joints_turn_or_one_turns_back() -> None:
    both = curves([10.0, 20.0, 30.0], other=[0.0, 5.0, 10.0, 15.0])
    back = curves([10.0, 20.0, 15.0])
    assert all(state.moment_arm_path_mm is None for state in (*both, *back))


def test_lines_are_carried_by_a_third_of_their_points_and_keep_their_lengths() -> None:
    """Wavy lines, of numbers of points that three does and does not divide, and one with a point twice."""
    surface = bar_surface(bar())
    belly = belly_of(surface, Lengthwise.of(surface))
    at = [np.linspace(0.0, LENGTH, count) for count in (101, 100, 99, 2)]
    wavy = [np.stack([x, 6.5 + 0.3 * np.sin(x / 4.0), 1.5 + 0.2 * np.cos(x / 3.0)], axis=1) for x in at]
    wavy.append(np.repeat(wavy[1], 2, axis=0))
    lines = Streamlines(tuple(wavy), np.ones(len(wavy), dtype=bool), np.zeros(len(wavy)))
    fine, coarse = Lines.of(lines, belly), Lines.carried(lines, belly)
    assert len(coarse.points) < 0.35 * len(fine.points)
    for part, line in zip(coarse.split(coarse.points), lines.points, strict=True):
        np.testing.assert_array_equal(part[[0, -1]], line[[0, -1]])
    for angle, limit in ((0.0, 1e-12), (np.radians(60.0), 2e-3)):
        paths, fibres = [], []
        for of in (fine, coarse):
            tangents = np.tile([1.0, 0.0, 0.0], (len(of.starts), 1))
            path, fibre, _ = of.measure(bent(of.points, angle), tangents, count=len(wavy))
            paths.append(path)
            fibres.append(fibre)
        np.testing.assert_allclose(paths[1], paths[0], rtol=limit, atol=0)
        np.testing.assert_allclose(fibres[1], fibres[0], rtol=limit, atol=0)
        assert (fibres[0] <= paths[0]).all()
