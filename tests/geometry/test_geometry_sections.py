"""Sections along a surface: cylinders and ellipsoids of known length and area, bent and turned; sections ride along."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from musclefit.errors import MeshError
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.surfaces.sections import sections_along

TURN = RigidMotion.about_axis(centre=np.array([5.0, 2.0, 1.0]), axis=np.array([1.0, 2.0, -2.0]), angle_deg=70.0)


def cylinder(radius: float, length: float) -> TriMesh:
    solid = trimesh.creation.cylinder(radius=radius, height=length, sections=48).subdivide_to_size(5.0)
    return TriMesh(np.asarray(solid.vertices), np.asarray(solid.faces))


def ellipsoid(a: float, b: float, c: float) -> TriMesh:
    ball = trimesh.creation.icosphere(subdivisions=4)
    return TriMesh(np.asarray(ball.vertices) * (a, b, c), np.asarray(ball.faces))


@pytest.mark.parametrize("turned", [False, True])
def test_a_cylinder_has_its_length_and_area(turned: bool) -> None:
    surface = cylinder(8.0, 100.0)
    if turned:
        surface = surface.with_vertices(TURN(surface.vertices))
    found = sections_along(surface).measure(surface.vertices)
    assert found.length == pytest.approx(100.0, rel=2e-3)
    polygon = 48 / 2 * 8.0**2 * np.sin(2 * np.pi / 48)
    np.testing.assert_allclose(found.areas[5:-5], polygon, rtol=5e-3)


@pytest.mark.parametrize("axes", [(60.0, 10.0, 10.0), (80.0, 12.0, 7.0)])
def test_an_ellipsoid_has_its_axis_and_its_middle_section(axes: tuple[float, float, float]) -> None:
    surface = ellipsoid(*axes)
    found = sections_along(surface).measure(surface.vertices)
    assert found.length == pytest.approx(2 * axes[0], rel=5e-3)
    assert found.largest_area == pytest.approx(np.pi * axes[1] * axes[2], rel=5e-3)


def test_sections_ride_along_when_a_cylinder_is_bent() -> None:
    straight = cylinder(5.0, 120.0)
    sections = sections_along(straight)
    radius = 150.0
    angle = straight.vertices[:, 2] / radius
    out = radius + straight.vertices[:, 0]
    bent = np.column_stack([out * np.cos(angle), straight.vertices[:, 1], out * np.sin(angle)])
    found = sections.measure(bent)
    assert found.length == pytest.approx(120.0, rel=3e-3)
    polygon = 48 / 2 * 5.0**2 * np.sin(2 * np.pi / 48)
    np.testing.assert_allclose(found.areas[5:-5], polygon, rtol=1e-2)


def test_a_sheared_cylinder_is_measured_across_its_centreline() -> None:
    """Shear x += s z: sections stay discs of the same area in their planes; across the centreline they are smaller."""
    straight = cylinder(5.0, 200.0)
    sections = sections_along(straight)
    sheared = straight.vertices + 0.75 * straight.vertices[:, [2]] * (1.0, 0.0, 0.0)
    found = sections.measure(sheared)
    polygon = 48 / 2 * 5.0**2 * np.sin(2 * np.pi / 48)
    np.testing.assert_allclose(found.areas[6:-6], polygon / np.hypot(1.0, 0.75), rtol=1e-2)
    assert found.length == pytest.approx(200.0 * np.hypot(1.0, 0.75), rel=1e-2)


def test_the_vertices_that_are_named_are_all_that_is_looked_at() -> None:
    surface = ellipsoid(60.0, 10.0, 7.0)
    sections = sections_along(surface)
    named = sections.vertices
    assert len(named) < len(surface.vertices)
    others = np.setdiff1d(np.arange(len(surface.vertices)), named)
    lost = surface.vertices.copy()
    lost[others] = np.nan
    found, whole = sections.measure(lost), sections.measure(surface.vertices)
    np.testing.assert_array_equal(found.centreline, whole.centreline)
    np.testing.assert_array_equal(found.areas, whole.areas)


def test_growing_scales_lengths_and_areas() -> None:
    surface = ellipsoid(50.0, 9.0, 6.0)
    sections = sections_along(surface)
    rest, grown = sections.measure(surface.vertices), sections.measure(1.3 * surface.vertices)
    assert grown.length == pytest.approx(1.3 * rest.length, rel=1e-12)
    np.testing.assert_allclose(grown.areas, 1.69 * rest.areas, rtol=1e-12)


def test_two_pieces_are_cut_along_their_longest_axis() -> None:
    one = ellipsoid(20.0, 5.0, 5.0)
    both = TriMesh(
        np.vstack([one.vertices - (22.0, 0, 0), one.vertices + np.array([22.0, 0, 0])]),
        np.vstack([one.faces, one.faces + len(one.vertices)]),
    )
    found = sections_along(both).measure(both.vertices)
    assert found.length == pytest.approx(84.0, rel=2e-2)
    assert found.largest_area == pytest.approx(np.pi * 25.0, rel=2e-2)


def test_a_surface_without_area_is_refused() -> None:
    with pytest.raises(MeshError, match="without area"):
        sections_along(TriMesh(np.zeros((3, 3)), np.array([[0, 1, 2]])))
