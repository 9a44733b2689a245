"""Bones that run into each other on the way are named with place and depth; those that touch nothing are not."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.rigs import find_rig, read_rig
from musclefit.pipeline.retarget import retarget
from musclefit.validate.bones import first_collision


def box(x: float, *, breadth: float) -> TriMesh:
    mesh = trimesh.creation.box(extents=(10.0, breadth, breadth))
    mesh.apply_translation((x, 0.0, 0.0))
    return TriMesh(np.array(mesh.vertices), np.array(mesh.faces))


def slid(mm: float) -> dict[str, RigidMotion]:
    return {"a": RigidMotion.identity(), "b": RigidMotion(np.eye(3), np.array([-mm, 0.0, 0.0]))}


def two_boxes(gap: float) -> Anatomy:
    return Anatomy(
        (
            Tissue("a", TissueKind.BONE, box(0.0, breadth=10.0)),
            Tissue("b", TissueKind.BONE, box(10.0 + gap, breadth=20.0)),
        ),
        "test",
    )


def test_the_first_pose_that_collides_is_named_with_volume_and_depth():
    poses = [(t, slid(5.0 * t)) for t in (0.25, 0.5, 0.75, 1.0)]
    found = first_collision(two_boxes(2.0), poses)
    assert found is not None
    assert (found.a, found.b, found.at) == ("a", "b", 0.5)
    assert found.volume_mm3 == pytest.approx(50.0, rel=1e-9)
    assert found.depth_mm == pytest.approx(0.5, rel=1e-9)


def test_bones_that_stay_apart_or_move_together_do_not_collide():
    assert first_collision(two_boxes(6.0), [(1.0, slid(5.0))]) is None
    still = {"a": RigidMotion.identity(), "b": RigidMotion.identity()}
    assert first_collision(two_boxes(-3.0), [(1.0, still)]) is None


def test_overlap_at_rest_is_not_a_collision_until_it_grows():
    assert first_collision(two_boxes(-1.0), [(1.0, slid(0.005))]) is None
    grown = first_collision(two_boxes(-1.0), [(1.0, slid(0.5))])
    assert grown is not None
    assert grown.volume_mm3 == pytest.approx(150.0, rel=1e-9)


def test_a_forbidden_pose_is_refused_before_the_soft_tissue_is_touched():
    overrides = (
        "drive.pose.elbow_deg=170",
        "deformer.kernel=isochoric-r3",
        "deformer.step=cayley",
        "bones.rigid=true",
    )
    job = read_rig(find_rig("upper_limb"), overrides=overrides)
    with pytest.raises(
        InputError, match=r"'bone_humerus' and 'bone_\w+' run into each other at elbow 1[45]\d.*mm deep"
    ):
        retarget(job, tets=None)
