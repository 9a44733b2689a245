"""Residuals on the exposed surface of bones: by area, between the places where the field is held, contact left out."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np
import pytest
import trimesh

from musclefit.fields.radial import RadialBackend
from musclefit.flow.bones import RigidGroup
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.residuals import surface_residuals
from musclefit.flow.steps import ExplicitStep
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion

STILL = Deformation((), (), Status.CONVERGED)
BOX = trimesh.creation.box(extents=(20.0, 20.0, 20.0)).subdivide_to_size(6.0)
SURFACE = TriMesh(np.asarray(BOX.vertices), np.asarray(BOX.faces))


def group(contact: np.ndarray) -> RigidGroup:
    return RigidGroup(("bone",), SURFACE, contact, 8)


def test_a_map_that_stays_behind_is_off_by_the_motion_and_the_contact_zone_is_left_out() -> None:
    motions = MappingProxyType({"bone": RigidMotion(np.eye(3), np.array([0.3, 0.0, 0.4]))})
    whole = surface_residuals([group(np.zeros(len(SURFACE.vertices), dtype=bool))], STILL, motions)
    np.testing.assert_allclose(whole.distances, 0.5, rtol=1e-12)
    assert whole.areas.sum() == pytest.approx(2400.0)
    corners = SURFACE.corners()
    assert whole.gap_mm == pytest.approx(np.linalg.norm(corners - corners.mean(axis=1)[:, None], axis=2).max())
    part = surface_residuals([group(SURFACE.vertices[:, 2] > 9.0)], STILL, motions)
    assert 0 < len(part.distances) < len(whole.distances)
    assert part.areas.sum() < 2000.0 + 1e-9


def test_what_is_off_only_between_the_vertices_is_seen() -> None:
    """A field that is held at every vertex and pushed in the middle of one triangle, as a field between samples is."""
    middle = SURFACE.corners()[0].mean(axis=0)
    at, moves = np.vstack([SURFACE.vertices, middle]), np.zeros((len(SURFACE.vertices) + 1, 3))
    moves[-1] = 0.2
    pushed = Deformation((ExplicitStep(RadialBackend("r").fit(at, moves)),), (), Status.CONVERGED)
    assert np.linalg.norm(pushed(SURFACE.vertices) - SURFACE.vertices, axis=1).max() < 1e-9
    still = MappingProxyType({"bone": RigidMotion.identity()})
    found = surface_residuals([group(np.zeros(len(SURFACE.vertices), dtype=bool))], pushed, still)
    assert found.distances.max() == pytest.approx(0.2 * np.sqrt(3.0), rel=1e-6)
