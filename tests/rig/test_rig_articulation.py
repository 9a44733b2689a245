"""Fitted joints: spheres and cylinders of known place come back with known residuals; bones that do not meet."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from musclefit.errors import InputError
from musclefit.geometry.fitting import CylinderFit, fitted_cylinder, fitted_sphere
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.subdivision import FaceEdges, split_edges
from musclefit.rig.articulation import fitted_joint
from musclefit.rig.joint_kinds import JointKind

AXIS = np.array([0.36, 0.48, 0.8])
CENTRE = np.array([40.0, -20.0, 700.0])


def cylinder_points(*, arc_deg: float, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of part of a cylinder of radius 12 mm and length 30 mm."""
    rng = np.random.default_rng(5)
    u = np.cross(AXIS, [1.0, 0.0, 0.0])
    u /= np.linalg.norm(u)
    v = np.cross(AXIS, u)
    angles, along = np.radians(rng.uniform(0, arc_deg, 500)), rng.uniform(-15, 15, 500)
    normals = np.cos(angles)[:, None] * u + np.sin(angles)[:, None] * v
    return CENTRE + (12.0 + noise * rng.normal(size=500))[:, None] * normals + along[:, None] * AXIS, normals


@pytest.mark.parametrize("arc_deg", [70.0, 180.0, 360.0])
def test_a_cylinder_comes_back(arc_deg: float) -> None:
    fit = fitted_cylinder(*cylinder_points(arc_deg=arc_deg))
    assert abs(abs(fit.axis @ AXIS) - 1.0) < 1e-10
    off = fit.centre - CENTRE
    assert np.linalg.norm(off - (off @ AXIS) * AXIS) < 1e-6
    assert fit.radius == pytest.approx(12.0, abs=1e-6)
    assert fit.rms < 1e-7
    assert fit.spread == pytest.approx(arc_deg, abs=6.0)


def test_residuals_are_those_of_the_points() -> None:
    fit = fitted_cylinder(*cylinder_points(arc_deg=200.0, noise=0.4))
    assert fit.rms == pytest.approx(0.4, rel=0.1)
    assert np.degrees(np.arccos(min(1.0, abs(fit.axis @ AXIS)))) < 0.5


def test_a_sphere_comes_back_from_a_cap() -> None:
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    cap = directions[directions[:, 2] > 0.5]
    fit = fitted_sphere(CENTRE + 24.0 * cap)
    np.testing.assert_allclose(fit.centre, CENTRE, rtol=0, atol=1e-6)
    assert fit.radius == pytest.approx(24.0, abs=1e-6)


def test_points_that_fit_anything_are_refused() -> None:
    with pytest.raises(InputError, match="3 points fit many spheres"):
        fitted_sphere(np.eye(3))
    with pytest.raises(InputError, match="lie in a plane"):
        fitted_sphere(np.column_stack([np.random.default_rng(0).normal(size=(9, 2)), np.zeros(9)]))


def mesh(solid: trimesh.Trimesh) -> TriMesh:
    return TriMesh(np.asarray(solid.vertices), np.asarray(solid.faces))


def shell(ball_radius: float, inner: float) -> tuple[TriMesh, TriMesh]:
    """A ball, and a thick cap around its upper half with a gap between."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=ball_radius)
    outer = trimesh.creation.icosphere(subdivisions=4, radius=inner + 5.0)
    hollow = trimesh.creation.icosphere(subdivisions=4, radius=inner)
    below = trimesh.creation.box(
        extents=(200, 200, 200), transform=trimesh.transformations.translation_matrix([0, 0, -100])
    )
    cup = trimesh.boolean.difference([outer, hollow, below])
    for solid in (ball, cup):
        solid.apply_translation(CENTRE)
    return mesh(cup), mesh(ball)


def test_a_ball_joint_is_found_from_either_bone() -> None:
    cup, ball = shell(20.0, 21.5)
    fits = fitted_joint(cup, ball, kind=JointKind.BALL, within_mm=3.0)
    assert {fit.of for fit in fits} == {"fixed", "moving"}
    for found in fits:
        np.testing.assert_allclose(found.fit.centre, CENTRE, rtol=0, atol=0.05)
        assert found.fit.radius == pytest.approx(20.0 if found.of == "moving" else 21.5, abs=0.1)


def test_a_hinge_is_found_between_a_roller_and_its_bed() -> None:
    roller = trimesh.creation.cylinder(radius=10.0, height=30.0, sections=96).subdivide_to_size(4.0)
    bed = trimesh.boolean.difference(
        [
            trimesh.creation.box(
                extents=(40, 20, 29), transform=trimesh.transformations.translation_matrix([0, -10, 0])
            ),
            trimesh.creation.cylinder(radius=11.0, height=40.0, sections=96),
        ]
    ).subdivide_to_size(4.0)
    fits = fitted_joint(mesh(bed), mesh(roller), kind=JointKind.HINGE, within_mm=2.0)
    for found in fits:
        assert isinstance(found.fit, CylinderFit)
        assert abs(found.fit.axis[2]) > 0.9999
        np.testing.assert_allclose(found.fit.centre[:2], [0, 0], rtol=0, atol=0.1)


def half_cut(surface: TriMesh, *, longest_mm: float) -> TriMesh:
    """The same surface with one half cut much finer."""
    finer = surface
    while True:
        edges = FaceEdges.of(finer.faces)
        ends = finer.vertices[edges.ends]
        there = ends.mean(axis=1)[:, 0] > np.median(surface.vertices[:, 0])
        long = there & (np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > longest_mm)
        if not long.any():
            return finer
        finer = split_edges(finer, edges, long)


def lopsided(radius: float, **cut: float) -> TriMesh:
    """A ball whose one half is a little larger, in the finite triangles of a bone, cut or not."""
    solid = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    vertices = np.asarray(solid.vertices) * np.where(np.asarray(solid.vertices)[:, :1] > 0.0, 1.06, 1.0)
    found = TriMesh(vertices + CENTRE, np.asarray(solid.faces))
    return half_cut(found, **cut) if cut else found


def test_a_joint_does_not_see_how_finely_a_part_of_its_surface_is_cut() -> None:
    """The two halves of the ball fit two spheres; what lies between them must not lean to the finer one."""
    cup, _ = shell(20.0, 23.0)
    coarse, fine = lopsided(20.0), lopsided(20.0, longest_mm=0.4)
    assert len(fine.faces) > 10 * len(coarse.faces)
    fits = [
        next(fit for fit in fitted_joint(cup, ball, kind=JointKind.BALL, within_mm=5.0) if fit.of == "moving")
        for ball in (coarse, fine)
    ]
    np.testing.assert_allclose(fits[1].fit.centre, fits[0].fit.centre, rtol=0, atol=0.02)
    assert fits[1].fit.radius == pytest.approx(fits[0].fit.radius, abs=0.02)
    assert fits[1].used_mm2 == pytest.approx(fits[0].used_mm2, rel=0.05)


def test_a_hinge_does_not_see_how_finely_a_part_of_its_surface_is_cut() -> None:
    roller = trimesh.creation.cylinder(radius=10.0, height=16.0, sections=24)
    bed = trimesh.creation.annulus(r_min=12.0, r_max=16.0, height=16.0, sections=24)
    cone = np.array(roller.vertices) * (1.0 + 0.004 * np.array(roller.vertices)[:, 2:] * [1.0, 0.5, 0.0])
    coarse = TriMesh(cone, np.asarray(roller.faces))
    axes = [
        next(fit.fit for fit in fitted_joint(mesh(bed), own, kind=JointKind.HINGE) if fit.of == "moving")
        for own in (coarse, half_cut(coarse, longest_mm=1.2))
    ]
    assert isinstance(axes[0], CylinderFit)
    assert isinstance(axes[1], CylinderFit)
    assert np.degrees(np.arccos(min(1.0, abs(axes[0].axis @ axes[1].axis)))) < 0.1
    off = axes[1].centre - axes[0].centre
    assert np.linalg.norm(off - (off @ axes[0].axis) * axes[0].axis) < 0.02


def test_bones_that_do_not_meet_are_refused() -> None:
    cup, ball = shell(20.0, 30.0)
    with pytest.raises(
        InputError, match=r"0 mm² of the fixed bone face the other within 3 mm \(0 samples; a fit needs 30\)"
    ):
        fitted_joint(cup, ball, kind=JointKind.BALL, within_mm=3.0)
    with pytest.raises(InputError, match="found kind 'screw'; only a hinge and a ball"):
        fitted_joint(cup, ball, kind=JointKind.SCREW)
