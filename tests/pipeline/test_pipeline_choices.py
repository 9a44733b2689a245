"""Lengths chosen from the bones: in proportion to them, given ones stand, and each says why."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from tiny_rigs import drive_by_joints, write_tiny_rig

import musclefit
from musclefit.anatomy.model import Anatomy
from musclefit.geometry.meshes import TriMesh
from musclefit.pipeline.choices import bone_choices, bone_sizes, thickness
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
    assert [finding.subject for finding in chosen.findings] == ["bones.lattices_mm"]
    assert all(lock.zone_mm == pytest.approx(2.0) for lock in chosen.locks)
    sizes = bone_sizes(job.anatomy, job.motions)
    whys = [finding.message for finding in bone_choices(job).findings]
    assert all("mm thick" in why for why in whys)
    assert f"{sizes.typical_mm:.3g} mm thick" in whys[0]
    assert len(whys) == 2 + len(chosen.groups)
