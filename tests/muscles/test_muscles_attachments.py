"""Where muscles hold on: bars and boxes whose areas are known, what users state, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError, MeshError
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import DistanceTree
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.surfaces.samples import surface_samples
from musclefit.geometry.surfaces.sections import Lengthwise
from musclefit.io.formats.attachments import read_attachments
from musclefit.muscles.attachments import (
    CLEARANCE_SECTIONS,
    WITHIN_SECTIONS,
    End,
    StatedEnd,
    find_ends,
    usual_distance_mm,
)
from musclefit.muscles.moment_arms import moment_arms

GAP = 0.3


def box(low: tuple[float, float, float], high: tuple[float, float, float], *, edge: float = 2.0) -> TriMesh:
    made = trimesh.creation.box(bounds=[low, high]).subdivide_to_size(edge)
    return TriMesh(np.asarray(made.vertices), np.asarray(made.faces))


def limb(*, far: float = GAP, scale: float = 1.0) -> Anatomy:
    """A muscle of 8 by 6 mm and 60 mm long between two bones, and a third that it passes in the middle."""
    shapes = {
        "muscle": (TissueKind.MUSCLE, box((0, 0, 0), (60, 8, 6))),
        "proximal": (TissueKind.BONE, box((-20, -10, -10), (-GAP, 20, 20), edge=6.0)),
        "distal": (TissueKind.BONE, box((60 + far, -10, -10), (90, 20, 20), edge=6.0)),
        "passed": (TissueKind.BONE, box((25, 8 + 2 * GAP, 0), (35, 14, 6))),
    }
    tissues = [Tissue(n, kind, m.with_vertices(scale * m.vertices)) for n, (kind, m) in shapes.items()]
    return Anatomy(tuple(tissues), "test")


TRAVEL = {"proximal": 0.0, "distal": 5.0, "passed": 5.0}


@pytest.mark.parametrize("scale", [1.0, 0.2, 7.0])
def test_areas_bones_and_distances_are_those_of_the_boxes(scale: float) -> None:
    anatomy = limb(scale=scale)
    (ends,) = find_ends(anatomy, within_mm=usual_distance_mm(anatomy), travel=TRAVEL)
    assert ends.attached
    for at, bone, x in ((ends.origin, "proximal", 0.0), (ends.insertion, "distal", 60.0)):
        assert at.bone == bone
        assert 48.0 * scale**2 <= at.area_mm2 <= 80.0 * scale**2  # the end's face, and a little of the sides
        np.testing.assert_allclose(at.centroid_mm / scale, (x, 4.0, 3.0), atol=0.5)
        assert at.distance_mm == pytest.approx(GAP * scale, rel=0.5)
    assert [bone for bone, _ in ends.touched] == ["passed"]


def test_with_a_distance_of_just_more_than_the_gap_the_area_is_exact() -> None:
    (ends,) = find_ends(limb(), within_mm=GAP + 1e-9, travel=TRAVEL)
    for at in (ends.origin, ends.insertion):
        assert at.area_mm2 == pytest.approx(48.0, rel=1e-12)
        assert at.distance_mm == pytest.approx(GAP, abs=1e-9)
        np.testing.assert_allclose(np.abs(at.feet - at.surface.vertices), [[GAP, 0, 0]] * len(at.feet), atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_the_usual_distance_counts_the_nearest_of_all_samples(seed: int) -> None:
    """Of muscles with large triangles that come near to bone in their middles, edges and corners."""
    rng = np.random.default_rng(seed)
    thickness, gaps, tissues = [], [], []
    for k in range(3):
        ball = trimesh.creation.icosphere(1, radius=5.0)
        egg = TriMesh(np.array(ball.vertices) * [6.0, 1.0, 1.2] + [0.0, 40.0 * k, 0.0], np.array(ball.faces))
        tissues.append(Tissue(f"muscle_{k}", TissueKind.MUSCLE, egg))
        thickness.append(np.sqrt(np.median(Lengthwise.of(egg).sections.measure(egg.vertices).areas)))
    bones = [
        box(tuple(low), tuple(low + rng.uniform(1.0, 9.0, 3)), edge=4.0)
        for low in np.column_stack([rng.uniform(-30, 30, 6), 40.0 * np.arange(6) % 120 + 5.1, rng.uniform(-4, 2, 6)])
    ]
    tissues += [Tissue(f"bone_{k}", TissueKind.BONE, bone) for k, bone in enumerate(bones)]
    spacing = CLEARANCE_SECTIONS * float(np.median(thickness))
    for muscle in tissues[:3]:
        places = surface_samples(muscle.surface, spacing_mm=spacing).points
        gaps.append(min(DistanceTree(bone)(places).min() for bone in bones))
    expected = np.median(gaps) + WITHIN_SECTIONS * np.median(thickness)
    assert usual_distance_mm(Anatomy(tuple(tissues), "test")) == pytest.approx(expected, rel=1e-12)


def test_the_far_side_of_a_thin_sheet_is_no_attachment() -> None:
    """A sheet of 0.5 mm that lies on a bone: of its two sides, both close, the one that faces the bone holds on."""
    anatomy = Anatomy(
        (
            Tissue("sheet", TissueKind.MUSCLE, box((0, 0, 0), (20, 8, 0.5))),
            Tissue("bone", TissueKind.BONE, box((-5, -5, -9), (12, 15, -GAP), edge=6.0)),
        ),
        "test",
    )
    (ends,) = find_ends(anatomy, within_mm=GAP + 0.6)
    at = ends.origin if ends.origin.bone else ends.insertion
    assert at.bone == "bone"
    assert 12.0 * 8.0 <= at.area_mm2 <= 1.25 * 13.0 * 8.0
    assert at.surface.corners()[:, :, 2].mean(axis=1).max() < 0.5 - 1e-9


def test_the_origin_is_the_end_that_moves_less() -> None:
    (ends,) = find_ends(limb(), within_mm=0.5, travel={"proximal": 5.0, "distal": 0.0, "passed": 0.0})
    assert (ends.origin.bone, ends.insertion.bone) == ("distal", "proximal")


def test_an_end_without_bone_is_free_and_says_why() -> None:
    (ends,) = find_ends(limb(far=9.0), within_mm=0.5, travel=TRAVEL)
    assert not ends.attached
    assert ends.insertion.bone == ""
    assert ends.insertion.centroid_mm[0] > 55.0
    assert "the nearest is distal, 9 mm off" in ends.insertion.reason


def test_what_is_stated_comes_before_what_is_found(tmp_path: Path) -> None:
    file = tmp_path / "ends.csv"
    file.write_text("muscle,end,bone,within_mm\nmuscle,insertion,passed,0.7\n", encoding="utf-8")
    (ends,) = find_ends(limb(), within_mm=0.5, stated=read_attachments(file), travel=TRAVEL)
    assert (ends.origin.bone, ends.insertion.bone) == ("proximal", "passed")
    assert ends.insertion.centroid_mm[0] == pytest.approx(30.0, abs=0.5)
    corners = np.flatnonzero(limb()["muscle"].surface.vertices[:, 2] == 0.0)
    by_vertices = StatedEnd("muscle", End.ORIGIN, ("proximal",), None, tuple(corners.tolist()))
    (ends,) = find_ends(limb(), within_mm=0.5, stated=[by_vertices], travel=TRAVEL)
    assert ends.origin.area_mm2 == pytest.approx(480.0)


def test_only_the_muscles_asked_for_are_looked_at() -> None:
    """Beside one that has no area, and so no length, which looking at it would refuse."""
    flat = Tissue("flat", TissueKind.MUSCLE, TriMesh(np.outer([0.0, 1.0, 3.0], [1.0, 0.0, 0.0]), np.array([[0, 1, 2]])))
    both = Anatomy((flat, *limb()), "test")
    with pytest.raises(MeshError, match="without area"):
        find_ends(both, within_mm=0.5, travel=TRAVEL)
    (found,) = find_ends(both, within_mm=0.5, travel=TRAVEL, muscles=["muscle"])
    (alone,) = find_ends(limb(), within_mm=0.5, travel=TRAVEL)
    assert (found.muscle, found.origin.area_mm2) == ("muscle", alone.origin.area_mm2)
    stated = [StatedEnd("flat", End.ORIGIN, ("femur",))]
    with pytest.raises(InputError, match="no bone is named 'femur'"):
        find_ends(both, within_mm=0.5, stated=stated, muscles=["muscle"])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("muscle,bone\na,b\n", "expected muscle, end, bone"),
        ("muscle,end,bone\nmuscle,middle,distal\n", "line 2: the end is 'middle'"),
        ("muscle,end,bone\nmuscle,origin\n", "line 2 has 2 values for 3 columns"),
        ("muscle,end,bone,within_mm\nmuscle,origin,distal,far\n", "line 2: could not convert"),
        ("muscle,end,bone,within_mm\nmuscle,origin,distal,-1\n", "within_mm is -1"),
        ("muscle,end,bone\nbiceps,origin,distal\n", "no muscle is named 'biceps'"),
        ("muscle,end,bone\nmuscle,origin,femur\n", "no bone is named 'femur'"),
        ("muscle,end,bone\nmuscle,origin,distal\nmuscle,origin,passed\n", "stated twice"),
        ("muscle,end,bone,within_mm\nmuscle,origin,distal,0.1\n", "no part of it comes within 0.1 mm"),
        ("muscle,end,bone,vertices\nmuscle,origin,distal,999999\n", "vertex 999999 is not among"),
    ],
)
def test_files_that_say_nothing_usable_are_refused(text: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "ends.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=said):
        find_ends(limb(), within_mm=0.5, stated=read_attachments(file), travel=TRAVEL)


class Hinge:
    """The distal bone turns about z through a point beside the muscle."""

    def motions(self, pose: dict[str, float]) -> dict[str, RigidMotion]:
        turn = RigidMotion.about_axis(
            centre=np.array([30.0, -20.0, 3.0]), axis=np.array([0.0, 0.0, 1.0]), angle_deg=pose.get("hinge", 0.0)
        )
        return {"proximal": RigidMotion.identity(), "distal": turn}


@pytest.mark.parametrize("angle", [-20.0, 0.0, 50.0])
def test_moment_arms_are_those_of_a_triangle(angle: float) -> None:
    (ends,) = find_ends(limb(), within_mm=GAP + 1e-9, travel=TRAVEL)
    (arm,) = moment_arms([ends], Hinge(), pose={"hinge": angle}, coordinates=["hinge"])
    # ends at (0, 4) and (60, 4) seen from (30, -20): equal sides, an angle between them that the hinge makes wider
    side = np.hypot(30.0, 24.0)
    between = 2.0 * np.arctan2(30.0, 24.0) - np.radians(angle)
    length = 2.0 * side * np.sin(between / 2.0)
    assert arm.length_mm == pytest.approx(length, rel=1e-12)
    assert arm.moment_arm_mm == pytest.approx(side**2 * np.sin(between) / length, rel=1e-7)
