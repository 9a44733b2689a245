"""Bones along with their neighbours: the way of joints found again from rest and poses alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.rigs import find_rig, read_rig
from musclefit.rig.chain import ChainMotions, carriers_of, chain_findings, some_of
from musclefit.rig.joints import JointSystem, parse_joints

POINTS = np.random.default_rng(0).uniform(-100.0, 100.0, (20, 3))
LENGTHS = (60.0, 40.0, 25.0, 18.0)
"""Of a finger's bones, from the metacarpal on, mm."""


def rods(lengths: Sequence[float], names: Sequence[str], *, at: tuple[float, float] = (0.0, 0.0)) -> list[Tissue]:
    """Rods along x, 1.5 mm apart, each 8 mm thick."""
    made, x = [], 0.0
    for name, length in zip(names, lengths, strict=True):
        box = trimesh.creation.box((length, 8.0, 8.0)).subdivide().subdivide()
        surface = TriMesh(np.asarray(box.vertices) + np.array([x + 0.5 * length, *at]), np.asarray(box.faces))
        made.append(Tissue(name, TissueKind.BONE, surface))
        x += length + 1.5
    return made


def hinges(names: Sequence[str], axis: tuple[float, float, float] = (0.0, 1.0, 0.0)) -> JointSystem:
    """A hinge in each gap of a row of rods, across it."""
    table: dict[str, object] = {"units": "mm"}
    x = 0.0
    for k, length in enumerate(LENGTHS[: len(names) - 1]):
        x += length + (0.75 if not k else 1.5)
        table[f"j{k}"] = {
            "centre_mm": [x, 0, 0],
            "axis": list(axis),
            "fixed": [names[k]],
            "moving": list(names[k + 1 :]),
        }
    return parse_joints(table, source="hinges.json")


def off_the_way(found: ChainMotions, system: JointSystem, pose: Mapping[str, float]) -> float:
    """The farthest that a place is off the joints' way, mm."""
    way = system.along(pose)
    return max(
        float(np.abs(motion(POINTS) - way.at(t)[bone](POINTS)).max())
        for t in (0.0, 0.25, 0.6, 1.0)
        for bone, motion in found.at(t).items()
    )


NAMES = ("mc", "prox", "mid", "dist")


@pytest.mark.parametrize("angles", [(40.0, 40.0, 15.0), (-30.0, 100.0, 60.0), (20.0, 40.0, -40.0), (0.0, 0.0, 70.0)])
def test_a_finger_goes_as_its_joints_do(angles: tuple[float, float, float]) -> None:
    """With opposite turns too, after which two bones that are not jointed are parallel as at rest."""
    anatomy, system = Anatomy(tuple(rods(LENGTHS, NAMES)), "none"), hinges(NAMES)
    pose = {f"j{k}": angle for k, angle in enumerate(angles)}
    final = system.motions(pose)
    carriers = carriers_of(anatomy, [final])
    assert off_the_way(ChainMotions(final, carriers), system, pose) < 1e-10
    assert carriers == {"prox": "mc", "mid": "prox", "dist": "mid"}


def test_the_radius_goes_with_the_ulna_and_not_on_its_own_screw() -> None:
    job = read_rig(find_rig("upper_limb"))
    assert job.joints is not None
    system, pose = job.joints, {"elbow": 75.0, "forearm": 70.0}
    final = system.motions(pose)
    chain = ChainMotions(final, carriers_of(job.anatomy, [final]))
    assert chain.carriers == {"bone_ulna": "bone_humerus", "bone_radius": "bone_ulna"}
    assert off_the_way(chain, system, pose) < 1e-9
    assert off_the_way(ChainMotions(final), system, pose) > 5.0, "its own screw leads elsewhere"
    (finding,) = chain_findings(chain, subject="rig.toml")
    assert "bone_ulna on bone_humerus (75 deg), bone_radius on bone_ulna (70 deg)" in finding.message


def test_the_last_motion_is_the_one_that_was_given_and_the_first_is_rest() -> None:
    anatomy, system = Anatomy(tuple(rods(LENGTHS, NAMES)), "none"), hinges(NAMES)
    final = system.motions({"j0": 40.0, "j1": 20.0})
    chain = ChainMotions(final, carriers_of(anatomy, [final]))
    assert chain.at(1.0) is final
    for motion in chain.at(0.0).values():
        np.testing.assert_array_equal(motion.rotation, np.eye(3))
        np.testing.assert_array_equal(motion.translation, np.zeros(3))


def test_bones_that_move_as_one_stay_one_on_the_way() -> None:
    anatomy, system = Anatomy(tuple(rods(LENGTHS, NAMES)), "none"), hinges(NAMES)
    final = system.motions({"j1": 50.0})
    halfway = ChainMotions(final, carriers_of(anatomy, [final])).at(0.5)
    for one, other in (("mc", "prox"), ("mid", "dist")):
        np.testing.assert_allclose(halfway[one](POINTS), halfway[other](POINTS), rtol=0, atol=1e-11)
    assert chain_findings(ChainMotions(final, {"mid": "prox"}), subject="x") == (), "one joint leaves no choice"


def test_a_pose_at_rest_does_not_hide_who_is_jointed() -> None:
    anatomy, system = Anatomy(tuple(rods(LENGTHS, NAMES)), "none"), hinges(NAMES)
    poses = [system.motions({"j0": a, "j1": b, "j2": c}) for a, b, c in ((0, 0, 0), (30, 10, 0), (0, 40, 60))]
    assert carriers_of(anatomy, poses) == {"prox": "mc", "mid": "prox", "dist": "mid"}
    assert carriers_of(anatomy, [{"mc": RigidMotion.identity()}]) == {}


def test_some_poses_hold_the_last_and_are_few() -> None:
    poses = [{"b": RigidMotion(np.eye(3), np.array([float(k), 0, 0]))} for k in range(100)]
    chosen = some_of(poses)
    assert len(chosen) <= 8
    assert chosen[0] is poses[-1]
    assert list(some_of(poses[:3])) == poses[2::-1]
