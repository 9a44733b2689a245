"""Bones that collide: true depth, limits by the bones' size, what rides along from rest, feasible poses."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import MeshError
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.validate.bones import (
    DEPTH_MOST_MM,
    RESOLUTION_DEG,
    VOLUME_SHARE,
    BoneCollision,
    Motions,
    first_collision,
    rigid_bones,
    shared_by_bones,
)
from musclefit.validate.model import BoneOverlap

STILL = RigidMotion.identity()


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> TriMesh:
    mesh = trimesh.creation.box(bounds=[low, high])
    return TriMesh(np.array(mesh.vertices), np.array(mesh.faces))


def ridge(*, length: float, top: float, along: str, down: bool) -> TriMesh:
    """A right-angled roof of a prism whose ridge runs along an axis at z = ``top``; upside down where ``down``."""
    half = 0.5 * length
    profile = np.array([[0.0, 0.0], [10.0, -10.0], [-10.0, -10.0]]) * (1.0, -1.0 if down else 1.0)
    corners = [(s, y, top + z) if along == "x" else (y, s, top + z) for s in (-half, half) for y, z in profile]
    hull = trimesh.convex.convex_hull(np.array(corners))
    return TriMesh(np.array(hull.vertices), np.array(hull.faces))


def bones(**surfaces: TriMesh) -> Anatomy:
    return Anatomy(tuple(Tissue(name, TissueKind.BONE, surface) for name, surface in surfaces.items()), "test")


def scaled(mesh: TriMesh, by: float) -> TriMesh:
    return TriMesh(by * mesh.vertices, mesh.faces)


def by(x: float, y: float = 0.0, z: float = 0.0) -> RigidMotion:
    return RigidMotion(np.eye(3), np.array([x, y, z]))


def shared(anatomy: Anatomy, **motions: RigidMotion) -> tuple[BoneOverlap, ...]:
    names = [tissue.name for tissue in anatomy]
    return shared_by_bones(rigid_bones(anatomy, names), {name: motions.get(name, STILL) for name in names})


def two_boxes(gap: float) -> Anatomy:
    return bones(a=box((-5, -5, -5), (5, 5, 5)), b=box((5 + gap, -10, -10), (15 + gap, 10, 10)))


def on_the_way(anatomy: Anatomy, end: RigidMotion, *, turn_deg: float) -> BoneCollision | None:
    """The first collision when ``b`` moves straight to a translation."""
    names = [tissue.name for tissue in anatomy]

    def at(t: float) -> Motions:
        return {name: by(*(t * end.translation)) if name == "b" else STILL for name in names}

    return first_collision(rigid_bones(anatomy, names), at, turn_deg=turn_deg)


# --- depth


def test_depth_and_volume_of_two_boxes():
    (found,) = shared(two_boxes(2.0), b=by(-2.5))
    assert (found.a, found.b, found.rest_mm3) == ("a", "b", 0.0)
    assert found.posed_mm3 == found.beyond_mm3 == pytest.approx(50.0, rel=1e-9)
    assert found.depth_mm == pytest.approx(0.5, rel=1e-6)


@pytest.mark.parametrize("names", [("condyle", "plate"), ("plate", "condyle")])
def test_a_point_through_a_face_has_its_true_depth_whichever_bone_comes_first(names: tuple[str, str]):
    """But for its tip, all that is shared lies on that face, so that seen from the condyle alone it is 0 mm deep."""
    cone = trimesh.creation.cone(radius=4.0, height=10.0, sections=24)
    made = {
        "condyle": TriMesh(np.array(cone.vertices) - (0, 0, 11.0), np.array(cone.faces)),
        "plate": box((-60, -60, 0), (60, 60, 50)),
    }
    (found,) = shared(bones(**{name: made[name] for name in names}), condyle=by(0, 0, 2.0))
    assert found.rest_mm3 == 0.0
    assert found.depth_mm == pytest.approx(1.0, abs=1e-6)


def test_edges_that_cross_are_deep_between_their_vertices():
    """Two right-angled roofs, one upside down across the other, 1 mm in each other: each ridge is 1 mm cos 45 below
    the other's faces, where there is no vertex at all."""
    anatomy = bones(
        a=ridge(length=60.0, top=0.0, along="x", down=False), b=ridge(length=60.0, top=1.0, along="y", down=True)
    )
    (found,) = shared(anatomy, b=by(0, 0, -2.0))
    assert found.rest_mm3 == 0.0
    assert found.depth_mm == pytest.approx(np.sqrt(0.5), abs=0.06)


def test_bones_that_coincide_are_as_deep_as_they_are_thick():
    anatomy = bones(a=box((-5, -5, -5), (5, 5, 5)), b=box((25, -5, -5), (35, 5, 5)))
    (found,) = shared(anatomy, b=by(-30.0))
    assert found.posed_mm3 == pytest.approx(1000.0)
    assert found.depth_mm == pytest.approx(5.0, abs=1.0)
    assert found.collides


# --- limits that scale


def test_the_same_overlap_may_be_a_collision_of_small_bones_and_none_of_large_ones():
    small = bones(a=box((-1, -1, -1), (1, 1, 1)), b=box((1.5, -50, -50), (50, 50, 50)))
    large = bones(a=box((-20, -1, -1), (1, 60, 60)), b=box((1.5, -50, -50), (50, 1, 1)))
    (in_small,), (in_large,) = (shared(anatomy, b=by(-0.7)) for anatomy in (small, large))
    assert in_small.beyond_mm3 == pytest.approx(in_large.beyond_mm3)
    assert in_small.depth_mm == pytest.approx(in_large.depth_mm)
    assert in_small.collides
    assert not in_large.collides


@pytest.mark.parametrize("by_factor", [0.2, 1.0])
def test_small_bones_of_one_shape_collide_at_one_share_of_their_size(by_factor: float):
    for gap, collides in ((0.0035, True), (0.0015, False)):
        a, b = box((0, 0, 0), (8, 8, 8)), box((8.5, -8, -8), (20, 16, 16))
        anatomy = bones(a=scaled(a, by_factor), b=scaled(b, by_factor))
        (found,) = shared(anatomy, b=by(-by_factor * (0.5 + 8.0 * gap)))
        assert found.collides == collides


def test_no_bone_is_so_large_that_it_may_be_deep_in_another():
    anatomy = bones(a=box((-400, -40, -40), (0, 40, 40)), b=box((1, -1, -1), (400, 40, 40)))
    (found,) = shared(anatomy, b=by(-1.0 - 1.05 * DEPTH_MOST_MM))
    assert found.beyond_mm3 < found.beyond_limit_mm3
    assert found.depth_limit_mm == DEPTH_MOST_MM
    assert found.collides


# --- what bones share at rest


def test_bones_that_move_together_share_nothing_new():
    turn = RigidMotion.about_axis(centre=np.array([3.0, 1.0, 0.0]), axis=np.array([1.0, 2.0, 0.5]), angle_deg=70.0)
    assert shared(two_boxes(-3.0), a=turn, b=turn) == ()
    assert shared(two_boxes(-3.0)) == ()


def test_overlap_at_rest_is_no_collision_until_it_grows():
    (kept,) = shared(two_boxes(-1.0), b=by(-0.02))
    assert kept.rest_mm3 == pytest.approx(100.0)
    assert kept.beyond_mm3 == pytest.approx(2.0)
    assert kept.depth_mm == pytest.approx(0.02, abs=1e-6)
    assert not kept.collides
    (grown,) = shared(two_boxes(-1.0), b=by(-0.5))
    assert grown.beyond_mm3 == pytest.approx(50.0)
    assert grown.depth_mm == pytest.approx(0.5, abs=1e-6)
    assert grown.collides


@pytest.mark.parametrize(("plank", "block"), [("a", "b"), ("b", "a")])
def test_a_bone_that_slides_on_as_deep_as_at_rest_brings_nothing_new(plank: str, block: str):
    anatomy = bones(**{plank: box((-60, -5, -4), (60, 5, 0)), block: box((-3, -3, -1), (3, 3, 5))})
    for moving in (plank, block):
        (found,) = shared(anatomy, **{moving: by(20.0)})
        assert found.posed_mm3 == pytest.approx(found.rest_mm3)
        assert found.beyond_mm3 == pytest.approx(0.0, abs=1e-6)
        assert not found.collides


def test_overlap_that_leaves_one_place_and_enters_another_is_new():
    """The volume is that of rest throughout; only where it lies tells."""
    beam = trimesh.util.concatenate(
        [
            trimesh.creation.box(bounds=[(-60, -4, -4), (60, 4, 0)]),
            trimesh.creation.box(bounds=[(40, -4, 20), (60, 4, 24)]),
        ]
    )
    a = TriMesh(np.array(beam.vertices), np.array(beam.faces))
    block = box((-3, -3, -1), (3, 3, 5))
    (found,) = shared(bones(a=a, b=block), b=by(50.0, 0.0, 16.0))
    assert found.posed_mm3 == pytest.approx(found.rest_mm3)
    assert found.beyond_mm3 == pytest.approx(found.posed_mm3)
    assert found.depth_mm > DEPTH_MOST_MM
    assert found.collides


# --- the way


def test_the_largest_feasible_fraction_is_found_by_bisection():
    """10 mm cubes of bone meet after 2 of 5 mm, and collide when they share 2.5 mm³: 0.025 mm later."""
    found = on_the_way(two_boxes(2.0), by(-5.0), turn_deg=50.0)
    assert found is not None
    resolution = RESOLUTION_DEG / 50.0
    assert found.feasible <= 2.025 / 5.0 < found.at <= found.feasible + resolution
    assert found.found.collides
    assert found.there is not None
    assert found.there.depth_mm == pytest.approx(3.0, rel=1e-6)


def test_bones_that_stay_apart_do_not_collide():
    assert on_the_way(two_boxes(6.0), by(-5.0), turn_deg=50.0) is None


def test_a_thin_bone_does_not_jump_through_another_between_two_tested_poses():
    """No joint turns at all, so that only how far the bones go past each other says how often to look."""
    anatomy = bones(a=box((0, -5, -5), (4, 5, 5)), b=box((60, -5, -5), (63, 5, 5)))
    found = on_the_way(anatomy, by(-120.0), turn_deg=0.0)
    assert found is not None
    assert found.there is None
    assert 56.0 / 120.0 <= found.at < 56.0 / 120.0 + 2e-3


def test_relative_poses_are_measured_once():
    anatomy = two_boxes(2.0)
    prepared = rigid_bones(anatomy, ["a", "b"])
    turn = RigidMotion.about_axis(centre=np.zeros(3), axis=np.array([0.0, 0.0, 1.0]), angle_deg=33.0)
    first = shared_by_bones(prepared, {"a": STILL, "b": by(-2.5)})
    again = shared_by_bones(prepared, {"a": turn, "b": turn @ by(-2.5)})
    assert len(prepared.known) == 1
    assert again == first


def test_a_bone_that_is_no_solid_is_named():
    open_box = box((20, 0, 0), (30, 10, 10))
    anatomy = bones(a=box((0, 0, 0), (10, 10, 10)), b=TriMesh(open_box.vertices, open_box.faces[:-1]))
    prepared = rigid_bones(anatomy, ["a", "b"])
    assert prepared.names == ("a",)
    with pytest.raises(MeshError, match=r"bone 'b' .*not a closed oriented 2-manifold"):
        prepared.require_all()


def test_the_feasible_pose_holds_for_bones_that_are_tested_less_often_than_others():
    """A bone that goes far past others is tested on the way oftener than one that creeps up to them."""
    plates = TriMesh.together([box((-30, -30, -10), (30, 15, 0)), box((-30, 29, -10), (30, 30, 0))])
    creeping, sliding = box((-5, -5, 0.2), (5, 5, 10)), box((-28, 20, -9), (-20, 28, -1))
    anatomy = bones(plates=plates, creeping=creeping, sliding=sliding)
    names = [tissue.name for tissue in anatomy]
    prepared = rigid_bones(anatomy, names)

    def at(t: float) -> Motions:
        return {"plates": STILL, "creeping": by(0.0, 0.0, -2.0 * t), "sliding": by(40.0 * t)}

    found = first_collision(prepared, at, turn_deg=3.0)
    assert found is not None
    # at a depth at which they share VOLUME_SHARE of the smaller one's 980 mm³ over 100 mm²
    assert found.feasible == pytest.approx(0.5 * (0.2 + 980.0 * VOLUME_SHARE / 100.0), abs=RESOLUTION_DEG / 3.0)
    assert not any(overlap.collides for overlap in shared_by_bones(prepared, at(found.feasible)))
