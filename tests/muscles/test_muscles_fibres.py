"""Fibres against formulas: a bar and a ring at rest; stretched, twisted and bent bars carried."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from tet_blocks import two_tissues

from musclefit.errors import MeshError
from musclefit.fields.radial import RadialBackend
from musclefit.flow.deformation import Deformation
from musclefit.flow.march import one_shot
from musclefit.flow.rules import rule_for
from musclefit.geometry.arrays import Gradients, Points
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.geometry.tets.topology import tet_faces
from musclefit.muscles.fibres import end_vertices, laplace_fibres
from musclefit.muscles.measures import carried_directions
from musclefit.muscles.streamlines import MOST_POINTS, streamlines
from musclefit.rig.handles import StraightPath
from musclefit.vocabulary import StepKind, StepRule

RNG = np.random.default_rng(7)


def bar(shape: tuple[int, int, int] = (6, 3, 3), *, warp: Callable[[Points], Points] = lambda p: p) -> TetMesh:
    """A block of unit cells, its vertices moved."""
    mesh = two_tissues(shape).mesh
    return TetMesh(warp(mesh.vertices), mesh.tets)


def faces_at(mesh: TetMesh, rest: Points, x: float) -> TriMesh:
    boundary = tet_faces(mesh.tets).boundary
    return TriMesh(mesh.vertices, boundary[(np.abs(rest[boundary][:, :, 0] - x) < 1e-9).all(axis=1)])


def ends_of(mesh: TetMesh, rest: Points) -> tuple[TriMesh, TriMesh]:
    return faces_at(mesh, rest, rest[:, 0].min()), faces_at(mesh, rest, rest[:, 0].max())


def test_a_straight_bar_has_straight_fibres_of_its_length() -> None:
    mesh = bar()
    origin, insertion = ends_of(mesh, mesh.vertices)
    field = laplace_fibres(mesh, origin=origin, insertion=insertion, within_mm=1e-6)
    length = np.ptp(mesh.vertices[:, 0])
    np.testing.assert_allclose(field.directions, np.broadcast_to([1.0, 0, 0], field.directions.shape), atol=1e-12)
    np.testing.assert_allclose(field.potential, (mesh.vertices[:, 0] - mesh.vertices[:, 0].min()) / length, atol=1e-12)
    assert field.residual < 1e-12
    assert (field.singular_share, field.left_out_share) == (0.0, 0.0)
    lines = streamlines(field, count=50)
    assert lines.complete.all()
    np.testing.assert_allclose(lines.lengths(), length, atol=1e-9)


def test_fibres_of_a_ring_are_arcs() -> None:
    """Laplace flow between two radial cuts of a ring: the potential is the angle, fibres are circles."""
    rest = bar((24, 4, 2)).vertices
    low, size = rest.min(axis=0), np.ptp(rest, axis=0)

    def ring(points: Points) -> Points:
        t, r, z = ((points - low) / size).T
        angle, radius = t * np.pi / 2.0, 20.0 + 6.0 * r
        return np.stack([radius * np.sin(angle), radius * np.cos(angle), 3.0 * z], axis=1)

    mesh = bar((24, 4, 2), warp=ring)
    if np.linalg.det(mesh.vertices[mesh.tets[0, 1:]] - mesh.vertices[mesh.tets[0, 0]]) < 0.0:
        mesh = TetMesh(mesh.vertices, mesh.tets[:, [0, 2, 1, 3]])
    origin, insertion = ends_of(mesh, rest)
    field = laplace_fibres(mesh, origin=origin, insertion=insertion, within_mm=1e-6)
    middles = mesh.vertices[mesh.tets].mean(axis=1)
    radial = middles[:, :2] / np.linalg.norm(middles[:, :2], axis=1, keepdims=True)
    expected = np.stack([radial[:, 1], -radial[:, 0], np.zeros(len(radial))], axis=1)
    assert np.abs(np.einsum("ki,ki->k", field.directions, expected)).min() > np.cos(np.radians(6.0))
    lines = streamlines(field, count=60)
    assert lines.complete.all()
    radii = np.array([np.linalg.norm(line[len(line) // 2, :2]) for line in lines.points])
    np.testing.assert_allclose(lines.lengths(), radii * np.pi / 2.0, rtol=0.02)


def test_a_muscle_that_holds_on_all_along_has_fibres_by_an_even_flux() -> None:
    """In through the whole floor, out through one end: the exact potential is that of (x² - (h - z)²) / 2."""
    mesh = bar((40, 2, 4), warp=lambda p: p * [1.0, 1.0, 0.5])
    low = mesh.vertices.min(axis=0)
    boundary = tet_faces(mesh.tets).boundary
    floor = TriMesh(mesh.vertices, boundary[(np.abs(mesh.vertices[boundary][:, :, 2] - low[2]) < 1e-9).all(axis=1)])
    _, end = ends_of(mesh, mesh.vertices)
    field = laplace_fibres(mesh, origin=floor, insertion=end, within_mm=1e-6)
    assert field.even_flux
    assert field.residual < 1e-10
    assert field.singular_share < 0.1
    x, _, z = (mesh.vertices[mesh.tets].mean(axis=1) - low).T
    exact = np.stack([x, np.zeros(len(x)), 2.0 - z], axis=1)
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    inside = x < 38.0  # at the last cells the floor's vertices belong to the end
    cosines = np.einsum("ki,ki->k", field.directions, exact)[inside]
    assert np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).mean() < 3.0
    lines = streamlines(field, count=100)
    assert lines.complete.all()
    assert lines.along_edges.mean() < 0.05


@pytest.mark.parametrize("waist", [0.5, 0.3])
def test_lines_run_whole_through_a_neck_of_bad_tetrahedra(waist: float) -> None:
    rest = bar((16, 3, 3)).vertices
    rng = np.random.default_rng(3)
    along = (rest[:, 0] - rest[:, 0].mean()) / np.ptp(rest[:, 0])
    thin = 1.0 - (1.0 - waist) * np.exp(-((along / 0.1) ** 2))
    noise = 0.15 * rng.uniform(-1.0, 1.0, rest.shape)
    noise[np.abs(along) > 0.49] = 0.0
    middle = rest.mean(axis=0)

    def necked(points: Points) -> Points:
        return middle + (points - middle + noise) * np.stack([np.ones(len(points)), thin, thin], axis=1)

    mesh = bar((16, 3, 3), warp=necked)
    flipped = np.linalg.det(mesh.vertices[mesh.tets[:, 1:]] - mesh.vertices[mesh.tets[:, :1]]) <= 0.0
    assert not flipped.any()
    origin, insertion = ends_of(mesh, rest)
    lines = streamlines(laplace_fibres(mesh, origin=origin, insertion=insertion, within_mm=1e-6), count=200)
    assert lines.complete.all()
    assert lines.lengths().min() > 0.99 * np.ptp(rest[:, 0])
    assert lines.along_edges.max() < 0.5
    assert max(map(len, lines.points)) <= MOST_POINTS


def test_a_tip_on_the_bone_all_along_is_still_the_other_end() -> None:
    mesh = bar((6, 3, 3))
    boundary = tet_faces(mesh.tets).boundary
    origin, insertion = TriMesh(mesh.vertices, boundary), ends_of(mesh, mesh.vertices)[1]
    begins, ends = end_vertices(mesh, origin, insertion, within_mm=1e-6)
    np.testing.assert_array_equal(ends, mesh.vertices[:, 0] == mesh.vertices[:, 0].max())
    assert not (begins & ends).any()
    turned = end_vertices(mesh, insertion, origin, within_mm=1e-6)
    np.testing.assert_array_equal(turned[0], ends)


def test_a_muscle_whose_ends_no_piece_joins_is_refused() -> None:
    one, far = bar(), bar(warp=lambda p: p + 100.0)
    mesh = TetMesh(np.vstack([one.vertices, far.vertices]), np.vstack([one.tets, far.tets + len(one.vertices)]))
    with pytest.raises(MeshError, match="no piece of the tetrahedra reaches"):
        laplace_fibres(
            mesh,
            origin=ends_of(one, one.vertices)[0],
            insertion=ends_of(far, far.vertices)[1],
            within_mm=1e-6,
        )


def affine_map(matrix: Points) -> Deformation:
    corners = np.array([[x, y, z] for x in (-20.0, 20.0) for y in (-9.0, 9.0) for z in (-9.0, 9.0)])
    path = StraightPath(corners, corners @ matrix.T)
    return one_shot(
        path, RadialBackend("r3"), rule=rule_for(StepKind.EXPLICIT, StepRule.ROW_NORM), tested=corners / 2.0
    )


def test_a_stretched_bar_by_the_maps_own_jacobian() -> None:
    """1.4 along x, as much thinner across as keeps the volume: fibres at an angle a to x have the stretch below."""
    across = 1.4**-0.5
    carry = affine_map(np.diag([1.4, across, across])).with_jacobian
    places = RNG.uniform(-8.0, 8.0, (200, 3))
    angle = RNG.uniform(0.0, np.pi / 2.0, 200)
    fibres = np.stack([np.cos(angle), np.sin(angle), np.zeros(200)], axis=1)
    found = carried_directions(carry, places, fibres)
    stretch = np.hypot(1.4 * np.cos(angle), across * np.sin(angle))
    np.testing.assert_allclose(found.stretch, stretch, atol=1e-9)
    np.testing.assert_allclose(found.directions[:, 0], 1.4 * np.cos(angle) / stretch, atol=1e-9)
    np.testing.assert_allclose(found.section_ratio, 1.0 / stretch, atol=1e-9)


def twisted(points: Points) -> tuple[Points, Gradients]:
    """0.07 radians per mm about x; the Jacobian by complex steps, which have no truncation to speak of."""

    def move(p: Points) -> Points:
        c, s = np.cos(0.07 * p[:, 0]), np.sin(0.07 * p[:, 0])
        return np.stack([p[:, 0], c * p[:, 1] - s * p[:, 2], s * p[:, 1] + c * p[:, 2]], axis=1)

    return _with_jacobian(move, points)


def bent(points: Points) -> tuple[Points, Gradients]:
    """The axis x onto a circle of radius 30 mm."""

    def move(p: Points) -> Points:
        angle, radius = p[:, 0] / 30.0, 30.0 - p[:, 1]
        return np.stack([radius * np.sin(angle), 30.0 - radius * np.cos(angle), p[:, 2]], axis=1)

    return _with_jacobian(move, points)


def _with_jacobian(move: Callable[[Points], Points], points: Points) -> tuple[Points, Gradients]:
    steps = [move(points + 1e-30j * axis).imag / 1e-30 for axis in np.eye(3)]
    return move(points), np.stack(steps, axis=2)


def test_a_twisted_bar() -> None:
    places = RNG.uniform(-8.0, 8.0, (200, 3))
    found = carried_directions(twisted, places, np.tile([1.0, 0.0, 0.0], (200, 1)))
    radius = np.linalg.norm(places[:, 1:], axis=1)
    stretch = np.sqrt(1.0 + (0.07 * radius) ** 2)
    np.testing.assert_allclose(found.stretch, stretch, atol=1e-9)
    moved = found.places
    expected = np.stack([np.ones(200), -0.07 * moved[:, 2], 0.07 * moved[:, 1]], axis=1) / stretch[:, None]
    np.testing.assert_allclose(found.directions, expected, atol=1e-9)
    np.testing.assert_allclose(found.section_ratio, 1.0 / stretch, atol=1e-9)


def test_a_bent_bar() -> None:
    places = RNG.uniform(-8.0, 8.0, (200, 3))
    found = carried_directions(bent, places, np.tile([1.0, 0.0, 0.0], (200, 1)))
    np.testing.assert_allclose(found.stretch, 1.0 - places[:, 1] / 30.0, atol=1e-9)
    angle = places[:, 0] / 30.0
    np.testing.assert_allclose(
        found.directions, np.stack([np.cos(angle), np.sin(angle), np.zeros(200)], axis=1), atol=1e-9
    )
    np.testing.assert_allclose(found.section_ratio, 1.0, atol=1e-9)
