"""Samples of surfaces: gaps against a dense search, areas that add up, and the same picture whatever the triangles."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from musclefit.errors import MeshError
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.samples import largest_gap, surface_places, surface_samples
from musclefit.geometry.surfaces.subdivision import with_short_edges

SQUARE = TriMesh(
    np.array([[0.0, 0.0, 0.0], [40.0, 0.0, 0.0], [40.0, 30.0, 0.0], [0.0, 30.0, 0.0]]),
    np.array([[0, 1, 2], [0, 2, 3]]),
)
BARYCENTRIC = np.array([(i, j, 60 - i - j) for i in range(61) for j in range(61 - i)]) / 60.0


def places_on(mesh: TriMesh) -> np.ndarray:
    return (BARYCENTRIC @ mesh.corners()).reshape(-1, 3)


def triangle(*corners: tuple[float, float]) -> TriMesh:
    return TriMesh(np.column_stack([np.array(corners, dtype=float), np.zeros(3)]), np.array([[0, 1, 2]]))


@pytest.mark.parametrize(
    "mesh",
    [
        triangle((0, 0), (10, 0), (5, 8.66)),
        triangle((0, 0), (10, 0), (0, 10)),
        triangle((0, 0), (10, 0), (3, 0.5)),
        triangle((0, 0), (10, 0), (9.9, 1.5)),
        triangle((0, 0), (10, 0), (5, 40)),
        triangle((0, 0), (10, 0), (5, 0.0)),
        triangle((0, 0), (0, 0), (10, 0)),
    ],
)
def test_the_largest_gap_of_a_triangle_is_what_a_dense_search_finds(mesh: TriMesh) -> None:
    found = cKDTree(mesh.vertices).query(places_on(mesh))[0].max()
    assert found <= largest_gap(mesh) + 1e-9
    assert largest_gap(mesh) == pytest.approx(found, rel=0.03)


def test_a_triangle_that_is_a_point_has_no_gap() -> None:
    assert largest_gap(triangle((7, 7), (7, 7), (7, 7))) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("spacing", [1.0, 3.0, 100.0])
def test_no_place_is_farther_from_a_sample_than_the_gap_and_the_gap_is_within_the_spacing(spacing: float) -> None:
    samples = surface_samples(SQUARE, spacing_mm=spacing)
    found = cKDTree(samples.points).query(places_on(SQUARE))[0].max()
    assert found <= samples.gap_mm + 1e-9
    assert samples.gap_mm <= spacing
    np.testing.assert_array_equal(samples.points[: samples.given], SQUARE.vertices)
    assert len(samples.between) == len(samples.points) - 4
    assert samples.areas.sum() == pytest.approx(1200.0)


@pytest.mark.parametrize("spacing", [0.7, 3.0, 100.0])
def test_places_by_triangle_keep_their_gap_too(spacing: float) -> None:
    slender = TriMesh(np.vstack([SQUARE.vertices, [[20.0, -0.5, 4.0]]]), np.vstack([SQUARE.faces, [[1, 0, 4]]]))
    places, gap = surface_places(slender, spacing_mm=spacing)
    found = cKDTree(places).query(places_on(slender))[0].max()
    assert 0.8 * gap <= found <= gap + 1e-9
    assert gap <= spacing
    assert cKDTree(places).query(slender.vertices)[0].max() == 0.0


def test_areas_make_a_mean_that_does_not_see_how_finely_a_part_is_cut() -> None:
    """One of the two triangles of the square cut a hundred times: the mean place stays the middle."""
    fine = with_short_edges(triangle((0, 0), (40, 0), (40, 30)), longest_mm=0.5)
    other = TriMesh(SQUARE.vertices, SQUARE.faces[1:])
    both = TriMesh(
        np.concatenate([fine.vertices, other.vertices]), np.concatenate([fine.faces, other.faces + len(fine.vertices)])
    )
    samples = surface_samples(both, spacing_mm=2.0)
    assert np.linalg.norm(both.vertices.mean(axis=0) - [20.0, 15.0, 0.0]) > 5.0
    np.testing.assert_allclose(np.average(samples.points, axis=0, weights=samples.areas), [20, 15, 0], atol=0.05)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.inf, np.nan])
def test_a_spacing_is_a_finite_length(bad: float) -> None:
    with pytest.raises(MeshError, match="expected a finite length above 0"):
        surface_samples(SQUARE, spacing_mm=bad)


@pytest.mark.parametrize("spacing", [1.0, 3.0, 100.0])
def test_values_at_samples_are_linear_between_those_at_the_vertices(spacing: float) -> None:
    samples = surface_samples(SQUARE, spacing_mm=spacing)
    slope = np.array([0.3, -2.0, 0.0])
    found = samples.interpolated(SQUARE.vertices @ slope + 1.0)
    np.testing.assert_allclose(found, samples.points @ slope + 1.0, rtol=0, atol=1e-12)
