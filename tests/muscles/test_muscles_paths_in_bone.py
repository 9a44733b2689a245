"""Paths in bone: chords of spheres and boxes, turned and moved with their bodies."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.muscles.paths_in_bone import Bones


def solid(mesh: trimesh.Trimesh) -> TriMesh:
    return TriMesh(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64))


PLACE = RigidMotion.about_axis(centre=np.array([3.0, 0, 0]), axis=np.array([1.0, 2.0, 0.5]), angle_deg=70.0)


@pytest.mark.parametrize("off", [0.0, 8.0, 16.0, 25.0])
def test_a_line_through_a_ball_is_inside_along_its_chord(off: float) -> None:
    ball = solid(trimesh.creation.icosphere(subdivisions=4, radius=20.0))
    line = PLACE(np.array([[-50.0, off, 0.0], [-1.0, off, 0.0], [60.0, off, 0.0]]))
    (found,) = Bones([("ball", "b", ball)]).along([line], {"b": PLACE})
    assert found.length_mm == pytest.approx(2.0 * np.sqrt(max(400.0 - off**2, 0.0)), abs=1.5)
    assert found.depth_mm == pytest.approx(max(20.0 - off, 0.0), abs=0.6)  # pieces of 1 mm
    assert found.bone == ("ball" if off < 20.0 else "")


def test_bones_that_overlap_count_once_and_lines_do_not_mix() -> None:
    box = trimesh.creation.box((10.0, 10.0, 10.0))
    there = box.copy()
    there.apply_translation((5.0, 0.0, 0.0))
    bones = Bones([("a", "x", solid(box)), ("b", "x", solid(there))])
    lines = [np.array([[-30.0, 0.1, 0.2], [30.0, 0.1, 0.2]]), np.array([[0.0, 30.0, 0.0], [0.0, 6.0, 0.0]])]
    through, beside = bones.along(lines, {"x": RigidMotion.identity()})
    assert through.length_mm == pytest.approx(15.0, abs=1.0)
    assert (beside.length_mm, beside.bone) == (0.0, "")


def test_a_bone_with_a_hole_and_one_inside_out_still_have_an_inside() -> None:
    box = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    holed = TriMesh(np.asarray(box.vertices), np.asarray(box.faces[:-3], dtype=np.int64))
    turned = TriMesh(np.asarray(box.vertices), np.asarray(box.faces[:, ::-1], dtype=np.int64))
    line = [np.array([[-30.0, 0.0, 0.0], [30.0, 0.0, 0.0]])]
    for bone in (holed, turned):
        (found,) = Bones([("a", "x", bone)]).along(line, {"x": RigidMotion.identity()})
        assert found.length_mm == pytest.approx(20.0, abs=1.0)
