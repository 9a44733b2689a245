"""Known fibres against formulas: streamlines cut at a box, directions of a helix, lines across a plate."""

from __future__ import annotations

import numpy as np
import pytest
from tet_blocks import two_tissues

from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.geometry.tets.topology import tet_faces
from musclefit.muscles.fibres import FibreField, laplace_fibres
from musclefit.muscles.given_fibres import (
    FibreSamples,
    KnownFibres,
    NearbyDirections,
    by_muscle,
    followed_lines,
    known_field,
    known_lines,
)

RNG = np.random.default_rng(11)


def block(shape: tuple[int, int, int], *, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> TetMesh:
    """Unit cells from a corner on."""
    mesh = two_tissues(shape).mesh
    return TetMesh(mesh.vertices - mesh.vertices.min(axis=0) + at, mesh.tets)


def surface_of(mesh: TetMesh) -> TriMesh:
    boundary = tet_faces(mesh.tets).boundary
    used, corners = np.unique(boundary, return_inverse=True)
    return TriMesh(mesh.vertices[used], corners.reshape(-1, 3))


def flow_along_x(mesh: TetMesh) -> FibreField:
    boundary = tet_faces(mesh.tets).boundary
    x = mesh.vertices[boundary][:, :, 0]
    ends = [TriMesh(mesh.vertices, boundary[(x == at).all(axis=1)]) for at in (x.min(), x.max())]
    return laplace_fibres(mesh, origin=ends[0], insertion=ends[1], within_mm=1e-6)


def straight(start: Points, end: Points, count: int = 9) -> Points:
    return np.linspace(start, end, count)


BOXES = {"a": surface_of(block((8, 4, 4))), "b": surface_of(block((8, 4, 4), at=(0.0, 0.0, 6.0)))}


def test_lines_are_cut_at_the_surface_of_the_muscle_that_most_of_them_runs_in() -> None:
    across = straight([2.0, 2.0, -1.0], [5.0, 2.0, 5.0])  # of its 6 mm of height 4 in a
    mostly_b = straight([4.0, 1.0, 3.5], [4.0, 1.0, 10.5])  # 0.5 mm in a, 4 mm in b
    outside = straight([-3.0, 2.0, 2.0], [2.0, 2.0, 2.0])  # 2 of 5 mm
    far = straight([0.0, 50.0, 0.0], [1.0, 50.0, 0.0])
    known, (use,) = by_muscle([FibreSamples("all.tck", (across, mostly_b, outside, far))], BOXES)
    (one,), (other,) = known["a"].lines, known["b"].lines
    np.testing.assert_allclose(one[[0, -1]], [[2.5, 2.0, 0.0], [4.5, 2.0, 4.0]], atol=2e-3)
    np.testing.assert_allclose(other[[0, -1], 2], [6.0, 10.0], atol=2e-3)
    assert (use.lines, use.lines_in_muscles, use.lines_outside) == (4, 2, 2)
    length = np.hypot(3.0, 6.0)
    assert use.cut_share == pytest.approx(1.0 - (length * 4.0 / 6.0 + 4.0) / (length + 7.0), abs=1e-3)


def test_a_file_of_one_muscle_is_of_no_other() -> None:
    line = straight([4.0, 1.0, 1.0], [4.0, 1.0, 9.0])  # 3 mm in each
    known, uses = by_muscle([FibreSamples("b.tck", (line,), muscle="b")], BOXES)
    assert list(known) == ["b"] or not known
    assert uses[0].lines_in_muscles == 0  # 3 of 8 mm are too little
    known, uses = by_muscle([FibreSamples("b.tck", (line[3:],), muscle="b")], BOXES)
    assert list(known) == ["b"]
    assert (uses[0].lines_in_muscles, known["b"].sources) == (1, ("b.tck",))
    places = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 7.0], [1.0, 1.0, 5.0]])
    known, uses = by_muscle([FibreSamples("f.vtu", (), places, np.eye(3))], BOXES)
    assert {name: len(one.places) for name, one in known.items()} == {"a": 2, "b": 2}  # its own, and that in none
    assert (uses[0].directions_in_muscles, uses[0].directions_outside) == (2, 1)


def helix(places: Points) -> Points:
    turn = 0.15 * places[:, 2]
    return np.stack([np.cos(turn), np.sin(turn), np.zeros(len(places))], axis=1)


def test_directions_near_samples_are_those_of_the_field_whichever_way_samples_point() -> None:
    samples = RNG.uniform(0.0, 10.0, (4000, 3))
    signs = RNG.choice([-1.0, 1.0], (4000, 1))
    near = NearbyDirections.of(KnownFibres((), samples, signs * helix(samples), ("f",)), reach_mm=2.0)
    asked = RNG.uniform(1.0, 9.0, (300, 3))
    cosines = np.abs(np.einsum("ni,ni->n", near.at(asked), helix(asked)))
    assert np.degrees(np.arccos(np.clip(cosines, 0.0, 1.0))).max() < 4.0
    at_samples = np.abs(np.einsum("ni,ni->n", near.at(samples[:200]), helix(samples[:200])))
    assert np.degrees(np.arccos(np.clip(at_samples, 0.0, 1.0))).max() < 0.1
    np.testing.assert_array_equal(near.at(np.array([[5.0, 5.0, 12.1], [5.0, 5.0, 30.0]]))[1], 0.0)
    one = NearbyDirections.of(KnownFibres((), samples[:1], helix(samples[:1]), ("f",)), reach_mm=1.0)
    np.testing.assert_allclose(np.abs(one.at(samples[:1] + 0.5)), np.abs(helix(samples[:1])), atol=1e-12)


def slanted(angle_deg: float) -> Float:
    return np.array([np.cos(np.radians(angle_deg)), 0.0, np.sin(np.radians(angle_deg))])


def test_lines_along_directions_cross_a_plate_at_the_length_of_its_formula() -> None:
    """Of fibres at 30° to a plate 4 mm thick, those that its end walls do not cut are 4 / sin 30° long."""
    mesh = block((24, 3, 4))
    fibre = slanted(30.0)
    places = np.concatenate([mesh.vertices, mesh.vertices[mesh.tets].mean(axis=1)])
    directions = np.tile(fibre, (len(places), 1)) * RNG.choice([-1.0, 1.0], (len(places), 1))
    known = KnownFibres((), places, directions, ("f.vtu",))
    near = NearbyDirections.of(known, reach_mm=1.0)
    flow = flow_along_x(mesh)
    field, share = known_field(flow, near)
    assert share == 1.0
    np.testing.assert_allclose(field.directions, np.tile(fibre, (len(mesh.tets), 1)), atol=1e-9)
    lines = followed_lines(field, near, surface_of(mesh), count=60, step_mm=0.25)
    assert lines.complete.all()
    assert lines.are_fibres
    middle = np.array([abs(line[:, 0].mean() - 12.0) < 7.0 for line in lines.points])
    assert middle.sum() > 20
    np.testing.assert_allclose(lines.lengths()[middle], 8.0, atol=5e-3)
    assert all(line[-1, 0] > line[0, 0] for line in lines.points)


def test_a_line_that_ends_where_nothing_is_known_is_not_whole() -> None:
    mesh = block((24, 3, 4))
    flow = flow_along_x(mesh)
    places = mesh.vertices[mesh.vertices[:, 0] <= 12.0]
    known = KnownFibres((), places, np.tile([1.0, 0.0, 0.0], (len(places), 1)), ("f.vtu",))
    near = NearbyDirections.of(known, reach_mm=1.0)
    field, share = known_field(flow, near)
    assert 0.4 < share < 0.6
    lines = followed_lines(field, near, surface_of(mesh), count=20, step_mm=0.25)
    assert not lines.complete.any()


def test_known_lines_run_from_origin_to_insertion() -> None:
    flow = flow_along_x(block((8, 4, 4)))
    there = straight([1.0, 2.0, 2.0], [7.0, 2.0, 2.0])
    lines = known_lines(flow, [there, there[::-1]])
    for line in lines.points:
        np.testing.assert_array_equal(line, there)
    assert lines.complete.all()
