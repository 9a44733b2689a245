"""Fitted joints: axes and centres of known place come back however the bones are cut, turned, mirrored and scaled."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from joint_shapes import KnownJoint, known_joint, missed

from musclefit.errors import InputError
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.anatomy import read_surface
from musclefit.io.opensim_geometry import find_geometry, placed_meshes
from musclefit.rig.articulation import FARTHEST, FittedJoint, fitted_joint
from musclefit.rig.joint_kinds import JointKind
from musclefit.workflows.fit_joint import JointFit
from musclefit.workflows.import_osim import read_osim


def fit(known: KnownJoint) -> FittedJoint:
    return fitted_joint(known.fixed, known.moving, kind=known.kind)


@pytest.mark.parametrize(
    ("name", "cuts", "scale", "mirrored", "deg", "mm"),
    [
        ("roller", (70, 24), 1.0, True, 3.0, 0.5),
        ("trochlea", (24, 70), 0.4, False, 3.0, 0.5),
        ("condyle", (40, 40), 1.0, False, 8.0, 2.0),
        pytest.param("saddle", (40, 40), 1.0, False, 12.0, 3.0, marks=pytest.mark.slow),
        ("ball", (24, 60), 1.5, True, 0.0, 1.0),
    ],
)
def test_joints_come_back(
    name: str, cuts: tuple[int, int], scale: float, mirrored: bool, deg: float, mm: float
) -> None:
    known = known_joint(name, cuts=cuts, scale=scale, mirrored=mirrored)
    found = fit(known)
    off = missed(found, known)
    assert off.degrees <= deg
    assert off.mm <= mm * scale
    assert off.degrees <= 3.0 * found.uncertain_deg
    assert off.mm <= 4.0 * found.uncertain_mm
    assert found.uncertain_deg < 12.0


@pytest.mark.parametrize(("name", "apart"), [("condyle", 6.0), pytest.param("saddle", 19.0, marks=pytest.mark.slow)])
def test_both_axes_of_a_torus_are_at_their_depths(name: str, apart: float) -> None:
    """Only about the first does a torus turn into itself; the second is where the normals of its profile meet."""
    known = known_joint(name, noise_mm=0.0)
    found = fit(known)
    assert missed(found, known).mm < 0.1
    assert found.apart_mm == pytest.approx(apart, abs=0.2)


def test_draws_that_lose_an_axis_count_as_far_as_it_may_be() -> None:
    """One of 40 that lies kilometres away says that the joint is not sure, and no number of kilometres."""
    flat = trimesh.creation.box([60.0, 60.0, 4.0]).subdivide().subdivide()
    fixed = TriMesh(np.asarray(flat.vertices), np.asarray(flat.faces))
    moving = TriMesh(fixed.vertices + np.array([0.0, 0.0, 6.0]), fixed.faces)
    found = fitted_joint(fixed, moving, kind=JointKind.UNIVERSAL)
    size = np.sqrt(2.0) * 30.0
    assert found.uncertain_mm < 2.0 * FARTHEST * size
    assert not JointFit("a", "b", found).believable


def test_the_fineness_of_a_bone_changes_nothing() -> None:
    """One bone is cut 9 times as finely as before: the finer one does not win."""
    axes = [fit(known_joint("trochlea", cuts=cuts, noise_mm=0.0)).axes[0] for cuts in ((30, 30), (90, 30))]
    assert np.degrees(np.arccos(min(1.0, abs(axes[0] @ axes[1])))) < 1.0


def test_what_has_no_axis_is_not_believed() -> None:
    """A ball turns about every axis: a hinge fitted to it says so."""
    known = replace(known_joint("ball"), kind=JointKind.HINGE)
    found = fit(known)
    assert found.uncertain_deg > 15.0 or found.other_deg > 15.0


def test_bones_that_say_different_axes_are_not_believed() -> None:
    """Each of two rollers is as sure as can be of its own axis; only that they disagree shows that the joint is not."""
    known = known_joint("roller", noise_mm=0.1)
    across = np.cross(known.axes[0], [0.3, 0.5, 0.8])
    turn = RigidMotion.about_axis(centre=known.centre, axis=across, angle_deg=40.0)
    turned = TriMesh(turn(known.moving.vertices), known.moving.faces)
    found = fitted_joint(known.fixed, turned, kind=known.kind)
    assert found.redrawn_deg < 10.0
    assert found.uncertain_deg > 10.0
    assert not JointFit("a", "b", found).believable


def test_bones_as_small_as_the_end_of_a_finger_are_fitted() -> None:
    """Too few samples at the spacing that serves an elbow: the surfaces are cut finer."""
    known = known_joint("ball", moved=False, noise_mm=0.0, cuts=(4, 4))
    share = 0.08
    fixed, moving = (TriMesh(share * bone.vertices, bone.faces) for bone in (known.fixed, known.moving))
    found = fitted_joint(fixed, moving, kind=JointKind.BALL)
    assert found.sides[0].facing_mm2 < 20.0
    assert np.linalg.norm(found.centre - share * known.centre) < 0.5


def test_bones_that_do_not_meet_are_refused() -> None:
    known = known_joint("ball", moved=False)
    away = TriMesh(known.moving.vertices - np.array([0.0, 0.0, 60.0]), known.moving.faces)
    with pytest.raises(InputError, match=r"the two bones are .* apart where they are closest, more than 15 mm"):
        fitted_joint(known.fixed, away, kind=JointKind.BALL)
    turned_away = TriMesh(known.moving.vertices, known.moving.faces[:, ::-1])
    with pytest.raises(InputError, match=r"0 mm² of the moving bone face the other within 5 mm of the smallest gap"):
        fitted_joint(known.fixed, turned_away, kind=JointKind.BALL)
    with pytest.raises(InputError, match="found kind 'screw'; only a hinge, a universal joint and a ball"):
        fitted_joint(known.fixed, known.moving, kind=JointKind.SCREW)
    with pytest.raises(InputError, match="within_mm is 0; give a distance"):
        fitted_joint(known.fixed, known.moving, kind=JointKind.BALL, within_mm=0.0)


@pytest.mark.anatomy
def test_a_real_elbow_is_found(anatomy_data: Path) -> None:
    """Within 5 degrees of the axis that is known."""
    bones = anatomy_data / "arm" / "disjoint"
    humerus, ulna = (read_surface(next(bones.rglob(f"bone_right_{name}_*.ply"))).mesh() for name in ("humerus", "ulna"))
    known = json.loads((anatomy_data / "arm" / "joints.json").read_text())["elbow"]["axis"]
    found = fitted_joint(humerus, ulna, kind=JointKind.HINGE)
    assert np.degrees(np.arccos(abs(found.axes[0] @ known) / np.linalg.norm(known))) < 5.0


@pytest.mark.anatomy
@pytest.mark.slow
def test_real_hips_are_found(anatomy_data: Path) -> None:
    """Within 3 mm of where OpenSim's model has them."""
    model = read_osim(anatomy_data / "opensim" / "rajagopal2016" / "Rajagopal2016.osim")
    meshes = {mesh.name: mesh.mesh for mesh in placed_meshes(model, find_geometry(model, [])[0])}
    places = model.multibody.places({})
    for side in "lr":
        pelvis, femur = meshes[f"pelvis__{side}_pelvis"], meshes[f"femur_{side}__{side}_femur"]
        found = fitted_joint(pelvis, femur, kind=JointKind.BALL)
        assert np.linalg.norm(found.centre - places[f"femur_{side}"].translation) < 3.0
