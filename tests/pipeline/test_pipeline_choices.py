"""Lengths chosen from the bones: in proportion to them, given ones stand, and each says why."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from tiny_rigs import drive_by_joints, write_tiny_rig

import musclefit
from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.geometry.meshes import TriMesh
from musclefit.pipeline.chosen_settings import (
    CHORD,
    CHORDS,
    bone_choices,
    bone_sizes,
    surface_choices,
    thickness,
    tight_gap,
)
from musclefit.rig.job import Job


@pytest.fixture
def job(tmp_path: Path) -> Job:
    rig = write_tiny_rig(tmp_path / "rig")
    drive_by_joints(rig)
    return musclefit.read_rig(rig, overrides=("deformer.method=rigid-bones",))


def grown(job: Job, times: float) -> Job:
    anatomy = Anatomy(
        tuple(replace(t, surface=t.surface.with_vertices(times * t.surface.vertices)) for t in job.anatomy),
        job.anatomy.frame,
    )

    class Scaled:
        def at(self, t: float):
            return {
                bone: replace(motion, translation=times * motion.translation)
                for bone, motion in job.motions.at(t).items()
            }

    return replace(job, anatomy=anatomy, motions=Scaled())


def test_a_balls_thickness_is_its_radius():
    mesh = trimesh.creation.icosphere(4, radius=7.0)
    assert thickness(TriMesh(np.array(mesh.vertices), np.array(mesh.faces))) == pytest.approx(7.0, rel=0.01)


@pytest.mark.parametrize("times", [0.1, 3.0])
def test_lengths_grow_with_the_anatomy(job, times):
    own, other = bone_choices(job), bone_choices(grown(job, times))
    assert other.groups == own.groups
    assert other.handle_spacing_mm == pytest.approx(times * own.handle_spacing_mm)
    np.testing.assert_allclose(other.lattices_mm, times * np.array(own.lattices_mm), rtol=2e-3)
    np.testing.assert_allclose(other.zones_mm, times * own.zones_mm)


def test_lattices_share_their_knots_to_the_last_digit(job):
    wide, middle, narrow = bone_choices(job).lattices_mm
    assert (wide, middle) == (4.0 * narrow, 2.0 * narrow)
    for k in range(-1000, 1000, 7):
        for first in range(-40, 40, 3):
            assert first * narrow + k * narrow == (first + k) * narrow


def test_what_the_rig_gives_stands_and_the_rest_says_why(job):
    given = replace(job.rig, bones=replace(job.rig.bones, handle_spacing_mm=9.0, contact_zone_mm=2.0))
    chosen = bone_choices(replace(job, rig=given))
    assert chosen.handle_spacing_mm == 9.0
    assert (chosen.zones_mm == 2.0).all()
    assert [finding.subject for finding in chosen.findings] == ["bones.lattices_mm", "bones.iterations"]
    assert all(lock.zone_mm == pytest.approx(2.0) for lock in chosen.locks)
    sizes = bone_sizes(job.anatomy, job.motions)
    whys = [finding.message for finding in bone_choices(job).findings if finding.subject != "bones.iterations"]
    assert all("mm thick" in why for why in whys)
    assert f"{sizes.typical_mm:.3g} mm thick" in whys[0]
    assert len(whys) == 2 + len(chosen.groups)


@pytest.mark.parametrize("times", [0.1, 3.0])
def test_edges_and_chords_grow_with_the_anatomy(job, times):
    own, other = surface_choices(job), surface_choices(grown(job, times))
    assert other.chord_mm == pytest.approx(times * own.chord_mm, rel=1e-6)
    assert other.longest.near_mm == pytest.approx(times * own.longest.near_mm, rel=2e-3)
    assert other.longest.most_mm == pytest.approx(4.0 * other.longest.near_mm)


def slabs(gap: float) -> Anatomy:
    """Two slabs, one above the other."""
    box = trimesh.creation.box((20.0, 20.0, 2.0)).subdivide().subdivide().subdivide()
    surface = TriMesh(np.array(box.vertices), np.array(box.faces))
    above = surface.with_vertices(surface.vertices + np.array([0.0, 0.0, 2.0 + gap]))
    return Anatomy(
        (Tissue("muscle_below", TissueKind.MUSCLE, surface), Tissue("muscle_above", TissueKind.MUSCLE, above)), None
    )


@pytest.mark.parametrize("gap", [0.01, 0.2, 0.9])
def test_the_tight_gap_of_two_slabs_is_what_is_between_them(gap):
    assert tight_gap(slabs(gap), within_mm=1.0) == pytest.approx(gap)


def test_gaps_farther_than_what_is_looked_for_are_not_told_apart():
    assert tight_gap(slabs(3.0), within_mm=1.0) == 1.0


def test_the_chord_tolerance_follows_the_gaps(job):
    size = bone_sizes(job.anatomy, job.motions).typical_mm
    least, most = (bound * size for bound in CHORDS)
    assert surface_choices(job).chord_mm == pytest.approx(most)  # the balls stand far apart
    for gap in (1.2 * most, 0.1 * least):
        more = tuple(
            replace(t, surface=t.surface.with_vertices(0.1 * t.surface.vertices + 500.0)) for t in slabs(10.0 * gap)
        )
        crowded = replace(job, anatomy=Anatomy((*job.anatomy, *more), job.anatomy.frame))
        assert surface_choices(crowded).chord_mm == pytest.approx(max(CHORD * gap, least))


def test_what_the_rig_gives_of_surfaces_stands(job):
    given = replace(job.rig, surfaces=replace(job.rig.surfaces, chord_tolerance_mm=0.3, longest_edge_mm=7.0))
    chosen = surface_choices(replace(job, rig=given))
    assert (chosen.chord_mm, chosen.longest.near_mm, chosen.longest.most_mm) == (0.3, 7.0, 7.0)
    assert chosen.findings == ()
    assert [f.subject for f in surface_choices(job).findings] == [
        "surfaces.longest_edge_mm",
        "surfaces.chord_tolerance_mm",
    ]


@pytest.mark.parametrize(("lock", "iterations"), [(True, 15), (False, 40)])
def test_bones_that_are_not_locked_are_fitted_longer(job, lock, iterations):
    rig = replace(job.rig, bones=replace(job.rig.bones, lock=lock))
    assert bone_choices(replace(job, rig=rig)).iterations == iterations
    given = replace(rig, bones=replace(rig.bones, iterations=7))
    assert bone_choices(replace(job, rig=given)).iterations == 7
