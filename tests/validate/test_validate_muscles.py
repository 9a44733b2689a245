"""Muscle measures: ellipsoids of known volume, length, section and surface; gaps to neighbours of known distance."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.geometry.meshes import TriMesh
from musclefit.progress import Silent
from musclefit.validate.muscles import measure_muscles, muscle_sections
from musclefit.validate.overlaps import solid_anatomy

A, B = 40.0, 8.0


def anatomy(gap: float, *, far: float = 30.0) -> Anatomy:
    """A spindle, a box below it at a gap, another spindle far off, and a skin that touches nothing."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    faces = np.asarray(ball.faces)
    spindle = np.asarray(ball.vertices) * (A, B, B)
    slab = trimesh.creation.box(bounds=[[-50, -20, -B - gap - 5.0], [50, 20, -B - gap]])
    skin = trimesh.creation.icosphere(subdivisions=2, radius=300.0)
    return Anatomy(
        (
            Tissue("muscle_near", TissueKind.MUSCLE, TriMesh(spindle, faces)),
            Tissue("muscle_far", TissueKind.MUSCLE, TriMesh(spindle + np.array([0.0, 0.0, far]), faces)),
            Tissue("bone_slab", TissueKind.BONE, TriMesh(np.asarray(slab.vertices), np.asarray(slab.faces))),
            Tissue("skin", TissueKind.SKIN, TriMesh(np.asarray(skin.vertices), np.asarray(skin.faces))),
        ),
        "test",
    )


@pytest.mark.parametrize("gap", [0.3, 4.0])
def test_a_spindle_above_a_slab(gap: float) -> None:
    there = anatomy(gap)
    found = measure_muscles(solid_anatomy(there, progress=Silent()), sections=muscle_sections(there))
    near = {muscle.name: muscle for muscle in found}["muscle_near"]
    eccentricity = np.sqrt(1.0 - (B / A) ** 2)
    surface = 2 * np.pi * B**2 * (1 + A / (B * eccentricity) * np.arcsin(eccentricity))
    assert near.volume_mm3 == pytest.approx(4 / 3 * np.pi * A * B * B, rel=5e-3)
    assert near.centreline_mm == pytest.approx(2 * A, rel=5e-3)
    assert near.largest_section_mm2 == pytest.approx(np.pi * B * B, rel=5e-3)
    assert near.surface_mm2 == pytest.approx(surface, rel=5e-3)
    assert near.gap_mm == pytest.approx(gap, abs=1e-6)
    assert near.neighbour == "bone_slab"


def test_what_has_no_neighbour_says_so_and_what_touches_has_no_gap() -> None:
    there = anatomy(4.0)
    found = measure_muscles(solid_anatomy(there, progress=Silent()), sections=muscle_sections(there))
    far = {muscle.name: muscle for muscle in found}["muscle_far"]
    assert (far.gap_mm, far.neighbour) == (None, None)
    meeting = anatomy(4.0, far=2 * B - 1.0)
    found = measure_muscles(solid_anatomy(meeting, progress=Silent()), sections=muscle_sections(meeting))
    assert {muscle.gap_mm for muscle in found} == {0.0}
    assert {muscle.neighbour for muscle in found} == {"muscle_near", "muscle_far"}


def test_sections_of_rest_measure_another_pose() -> None:
    there = anatomy(4.0)
    longer = there.with_vertices(there.vertices() * (1.25, 1.0, 1.0))
    sections = muscle_sections(there)
    rest, moved = (measure_muscles(solid_anatomy(a, progress=Silent()), sections=sections) for a in (there, longer))
    for before, after in zip(rest, moved, strict=True):
        assert after.centreline_mm == pytest.approx(1.25 * before.centreline_mm, rel=1e-3)
        assert after.volume_mm3 == pytest.approx(1.25 * before.volume_mm3, rel=1e-12)
        assert after.largest_section_mm2 == pytest.approx(before.largest_section_mm2, rel=1e-3)
