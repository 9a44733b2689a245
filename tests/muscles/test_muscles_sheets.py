"""Fibres between tendon sheets: pennate blocks whose fibre angle and length are known by construction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tet_blocks import two_tissues

from musclefit.errors import MeshError
from musclefit.geometry.arrays import Points
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.geometry.surfaces.sections import Lengthwise
from musclefit.geometry.tets.topology import tet_faces
from musclefit.muscles.attachments import Attachment, MuscleEnds
from musclefit.muscles.fibres import FibreField, sheet_fibres
from musclefit.muscles.measures import belly_of, measure_at_rest
from musclefit.muscles.streamlines import streamlines

HEIGHT = 6.0
LENGTH = 40.0


def pennate(angle_deg: float, *, shape: tuple[int, int, int] = (30, 3, 4)) -> TetMesh:
    """A block between two sheets z = 0 and z = 6 mm, whose end walls slant: all its fibres run along these walls."""
    mesh = two_tissues(shape).mesh
    unit = (mesh.vertices - mesh.vertices.min(axis=0)) / np.ptp(mesh.vertices, axis=0)
    x, y, z = unit.T
    slant = HEIGHT / np.tan(np.radians(angle_deg))
    return TetMesh(np.stack([LENGTH * x + slant * z, 4.0 * y, HEIGHT * z], axis=1), mesh.tets)


def plate(z: float, low: float, high: float, *, wide: tuple[float, float] = (-1.0, 5.0)) -> TriMesh:
    """A flat sheet in two triangles, wider than the block."""
    corners = np.array([[low, wide[0], z], [high, wide[0], z], [high, wide[1], z], [low, wide[1], z]])
    return TriMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def end_faces(mesh: TetMesh, z: float) -> TriMesh:
    boundary = tet_faces(mesh.tets).boundary
    return TriMesh(mesh.vertices, boundary[(np.abs(mesh.vertices[boundary][:, :, 2] - z) < 1e-9).all(axis=1)])


def between(mesh: TetMesh, low: TriMesh | None, high: TriMesh | None, *, reach_mm: float = 0.5) -> FibreField:
    ends = {"origin": end_faces(mesh, 0.0), "insertion": end_faces(mesh, mesh.vertices[:, 2].max())}
    return sheet_fibres(mesh, **ends, sheets=(low, high), within_mm=1e-6, reach_mm=reach_mm)


def angles(field: FibreField, fibre: Points) -> Points:
    cosines = field.directions[field.used] @ fibre
    return np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))


@pytest.mark.parametrize("angle", [20.0, 35.0, 60.0])
def test_fibres_of_a_pennate_block_have_the_angle_and_length_of_its_walls(angle: float) -> None:
    """The exact solution is linear; the sheets' triangles are not the mesh's, which leaves a little near them."""
    mesh = pennate(angle)
    field = between(mesh, end_faces(mesh, 0.0), end_faces(mesh, HEIGHT))
    fibre = np.array([np.cos(np.radians(angle)), 0.0, np.sin(np.radians(angle))])
    assert angles(field, fibre).max() < 1e-5
    assert field.sheets == (True, True)
    lines = streamlines(field, count=100)
    assert lines.complete.all()
    assert lines.are_fibres
    np.testing.assert_allclose(lines.lengths(), HEIGHT / np.sin(np.radians(angle)), rtol=1e-6)


def test_pennation_and_pcsa_of_the_table_are_those_of_the_block() -> None:
    mesh, angle = pennate(20.0), 20.0
    low, high = end_faces(mesh, 0.0), end_faces(mesh, HEIGHT)
    field = between(mesh, low, high)
    boundary = tet_faces(mesh.tets).boundary
    used, corners = np.unique(boundary, return_inverse=True)
    surface = TriMesh(mesh.vertices[used], corners.reshape(-1, 3))
    origin = Attachment("m", "hum", low, low.vertices, 1.0, np.zeros(3), 0.0, sheet=low)
    ends = MuscleEnds("m", origin, replace(origin, sheet=high))
    belly = belly_of(surface, Lengthwise.of(surface))
    row = measure_at_rest(surface, ends, field, streamlines(field, count=100), belly=belly, pieces=1, missed_mm=0.0)
    length = HEIGHT / np.sin(np.radians(angle))
    assert row.fibre_mm == pytest.approx(length, rel=1e-6)
    assert row.pcsa_mm2 == pytest.approx(LENGTH * 4.0 * HEIGHT / length, rel=1e-6)
    assert row.fibres == "flow by the tendon sheets of origin and insertion"
    assert row.note == ""
    # the centreline of so short a block turns at its ends, where sections slant
    assert row.pennation_deg == pytest.approx(angle, abs=4.0)


def test_a_sheet_beside_the_muscle_acts_at_the_nearest_places_within_reach() -> None:
    angle = 35.0
    mesh = pennate(angle)
    slant = HEIGHT / np.tan(np.radians(angle))
    low, high = plate(-0.3, 0.0, LENGTH, wide=(0.0, 4.0)), plate(HEIGHT + 0.3, slant, slant + LENGTH, wide=(0.0, 4.0))
    field = between(mesh, low, high)
    fibre = np.array([np.cos(np.radians(angle)), 0.0, np.sin(np.radians(angle))])
    assert np.quantile(angles(field, fibre), 0.9) < 1.0
    assert np.median(angles(field, fibre)) < 0.2
    with pytest.raises(MeshError, match=r"no place of its tendon sheet is in it or within 0\.2 mm"):
        between(mesh, low, high, reach_mm=0.2)


@pytest.mark.parametrize("at", [0.0, 0.13])
def test_a_bipennate_muscle_has_fibres_at_its_angle_on_both_sides_of_the_inner_sheet(at: float) -> None:
    """Two pennate blocks with a sheet between them, on faces of the mesh or through its tetrahedra."""
    angle, half = 30.0, 6.0
    mesh = two_tissues((30, 2, 8)).mesh
    unit = (mesh.vertices - mesh.vertices.min(axis=0)) / np.ptp(mesh.vertices, axis=0)
    z = half * (2.0 * unit[:, 2] - 1.0)
    slope = 1.0 / np.tan(np.radians(angle))
    mesh = TetMesh(np.stack([LENGTH * unit[:, 0] + slope * (half - np.abs(z)), 2.0 * unit[:, 1], z], axis=1), mesh.tets)
    inner = plate(at, slope * half, slope * half + LENGTH)
    outer = TriMesh.together([end_faces(mesh, -half), end_faces(mesh, half)])
    field = sheet_fibres(mesh, origin=outer, insertion=inner, sheets=(outer, inner), within_mm=1e-6, reach_mm=0.1)
    middles = mesh.vertices[mesh.tets].mean(axis=1)
    side = np.sign(middles[:, 2])
    fibre = np.stack([np.full(len(side), slope), np.zeros(len(side)), -side], axis=1) * np.sin(np.radians(angle))
    away = np.abs(middles[:, 2] - at) > 1.5
    cosines = np.einsum("ki,ki->k", field.directions, fibre)[away]
    off = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    assert np.median(off) < 1.5
    assert np.quantile(off, 0.95) < 8.0
    lines = streamlines(field, count=100)
    assert lines.complete.mean() > 0.95
    lengths = lines.lengths()[lines.complete]
    known = half / np.sin(np.radians(angle))
    if at == 0.0:
        np.testing.assert_allclose(lengths, known, rtol=5e-3)
    else:  # those from above end a tetrahedron early
        assert np.median(lengths) == pytest.approx(known, rel=0.01)
        assert lengths.min() > 0.74 * known
        assert lengths.max() < 1.15 * known
