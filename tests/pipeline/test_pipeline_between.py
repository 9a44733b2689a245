"""Between frames of a rig: poses on the way are made like frames, and cut surfaces follow the map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_rigs import drive_by_joints, write_tiny_rig

import musclefit
from musclefit.anatomy.model import Anatomy
from musclefit.errors import InputError
from musclefit.geometry.rigid import RigidMotion
from musclefit.pipeline import between, proving
from musclefit.pipeline.between import MAX_POSES, PoseError, PosesOnTheWay, between_frames
from musclefit.pipeline.chosen_settings import surface_choices
from musclefit.pipeline.sequence import Stage
from musclefit.rig.motion import Pose
from musclefit.validate.between_frames import PassageCheck
from musclefit.validate.close_meetings import MeetingKind

pytest.importorskip("ipctk")

PAIR = ("bone_distal", "muscle_flexor")
POSES = Pose(0, 0.0, (("elbow", 0.0),)), Pose(1, 1.0, (("elbow", 40.0),))


FREE = ("deformer.path=joints", "certificate.max_boxes=2000")
HELD = (
    *FREE,
    "bones.rigid=true",
    "deformer.kernel=isochoric-r3",
    "deformer.step=cayley",
    "bones.lattices_mm=[16]",  # coarse, and few iterations: the map itself misses the bones
    "bones.iterations=2",
)


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path: Path = write_tiny_rig(tmp_path_factory.mktemp("tiny") / "rig")
    drive_by_joints(path)
    joints = path.with_name("joints.toml")
    joints.write_text(joints.read_text(encoding="utf-8").replace("[-5, 60]", "[-175, 175]"), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def stage(rig: Path) -> Stage:
    return Stage.of(musclefit.read_rig(rig, overrides=FREE))


@pytest.fixture(scope="module")
def ends(stage: Stage) -> tuple[Anatomy, Anatomy]:
    first, second = (stage.frame(pose).anatomy for pose in POSES)
    assert first is not None
    assert second is not None
    return first, second


def test_refined_tissues_end_where_the_frames_are(stage: Stage, ends: tuple[Anatomy, Anatomy]) -> None:
    refined = PosesOnTheWay(stage, POSES, ends).refined(PAIR, [0.0, 0.5, 1.0], fineness=1)
    chosen = surface_choices(stage.job)
    assert (refined.chord_mm, refined.longest_mm) == (chosen.chord_mm / 4, chosen.longest.most_mm / 2)
    for posed, frame in zip((refined.posed[0], refined.posed[2]), ends, strict=True):
        for name in PAIR:
            given = frame[name].surface.vertices
            np.testing.assert_allclose(posed.anatomy[name].surface.vertices[: len(given)], given, atol=1e-9)
    for name in PAIR:
        surface = refined.rest[name].surface
        edges = surface.vertices[surface.faces] - surface.vertices[np.roll(surface.faces, 1, axis=1)]
        assert np.linalg.norm(edges, axis=2).max() <= refined.longest_mm
        middles = 0.5 * (surface.vertices[surface.faces] + surface.vertices[np.roll(surface.faces, 1, axis=1)])
        for posed in refined.posed:
            moved = posed.anatomy[name].surface.vertices
            chords = 0.5 * (moved[surface.faces] + moved[np.roll(surface.faces, 1, axis=1)])
            off = np.linalg.norm(posed.mapped(middles.reshape(-1, 3))[0] - chords.reshape(-1, 3), axis=1)
            assert off.max() <= 1.5 * refined.chord_mm


def test_the_pose_half_way_is_the_frame_of_half_the_angle(stage: Stage, ends: tuple[Anatomy, Anatomy]) -> None:
    way = PosesOnTheWay(stage, POSES, ends)
    half = stage.frame(Pose(0, 0.5, (("elbow", 20.0),))).anatomy
    assert half is not None
    assert way.pose(0.5).degrees == (("elbow", 20.0),)
    refined = way.refined(PAIR, [0.0, 0.5, 1.0], fineness=0)
    given = half["muscle_flexor"].surface.vertices
    moved = refined.posed[1].anatomy["muscle_flexor"].surface.vertices
    np.testing.assert_allclose(moved[: len(given)], given, atol=1e-9)


def test_bones_that_are_held_go_by_their_own_motions(rig: Path) -> None:
    stage = Stage.of(musclefit.read_rig(rig, overrides=HELD))
    first, second = (stage.frame(pose).anatomy for pose in POSES)
    assert first is not None
    assert second is not None
    refined = PosesOnTheWay(stage, POSES, (first, second)).refined(PAIR, [0.0, 0.5, 1.0], fineness=0)
    rest = refined.rest["bone_distal"].surface.vertices
    assert len(rest) > len(stage.job.anatomy["bone_distal"].surface.vertices)
    for posed, degrees in zip(refined.posed, (0.0, 20.0, 40.0), strict=True):
        turn = RigidMotion.about_axis(centre=np.zeros(3), axis=np.array([0.0, 0.0, 1.0]), angle_deg=degrees)
        np.testing.assert_allclose(posed.anatomy["bone_distal"].surface.vertices, turn(rest), atol=1e-9)
    by_the_map = refined.posed[2].mapped(rest)[0]
    assert np.linalg.norm(by_the_map - refined.posed[2].anatomy["bone_distal"].surface.vertices, axis=1).max() > 1e-3


def test_no_more_poses_are_made_than_stated(stage: Stage, ends: tuple[Anatomy, Anatomy]) -> None:
    way = PosesOnTheWay(stage, POSES, ends)
    assert way.can_make(np.linspace(0, 1, MAX_POSES).tolist())
    assert not way.can_make(np.linspace(0, 1, MAX_POSES + 1).tolist())


def test_a_pose_that_cannot_be_made_says_why(
    stage: Stage, ends: tuple[Anatomy, Anatomy], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(between, "MAX_TRIANGLES", 100)
    with pytest.raises(PoseError, match="would need more than 50 triangles"):
        PosesOnTheWay(stage, POSES, ends).refined(PAIR, [0.0, 1.0], fineness=0)


def test_a_motion_without_meetings_is_proved_free(stage: Stage, ends: tuple[Anatomy, Anatomy]) -> None:
    found = between_frames(stage, POSES, ends)
    assert found.meetings == ()
    assert found.pairs_examined > 0


def _jumped(anatomy: Anatomy) -> Anatomy:
    """The muscle on the other side of the bones: not what the map does, but what given triangles are said to do."""
    places = anatomy.vertices().copy()
    places[anatomy.slices()["muscle_flexor"]] -= (0, 40, 0)
    return anatomy.with_vertices(places)


def test_a_graze_of_straight_ways_is_cleared_on_the_maps_own_way(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    """From -90 to 90 degrees the distal bone goes round the elbow; on straight ways it cuts through the muscle."""
    poses = Pose(0, 0.0, (("elbow", -90.0),)), Pose(1, 1.0, (("elbow", 90.0),))
    first, second = (stage.frame(pose).anatomy for pose in poses)
    assert first is not None
    assert second is not None
    frames = first, second
    found = between_frames(stage, poses, frames)
    ((passage, look),) = found.meetings
    assert {passage.a, passage.b} == set(PAIR)
    assert (passage.hidden, passage.touching) == (True, False)
    assert (look.kind, look.most_overlap_mm3) == (MeetingKind.GRAZE, 0.0)
    assert 1 <= look.poses <= MAX_POSES - 2
    monkeypatch.setattr(between, "MAX_PAIRS", 0)
    ((_, unlooked),) = between_frames(stage, poses, frames).meetings
    assert (unlooked.kind, unlooked.triangles) == (MeetingKind.UNSETTLED, 0)
    assert "no more are" in unlooked.note
    shown = replace(passage, overlap_after_mm3=2.0)
    monkeypatch.setattr(between, "check_passages", lambda *_, **__: PassageCheck((shown,), 1))
    ((_, entered),) = between_frames(stage, poses, frames).meetings
    assert (entered.kind, entered.triangles) == (MeetingKind.ENTERS, 0)
    monkeypatch.undo()
    monkeypatch.setattr(between, "MAX_POSES", 2)
    ((_, unmade),) = between_frames(stage, poses, frames).meetings
    assert unmade.kind is MeetingKind.UNSETTLED


def test_the_maps_own_way_says_nothing_about_frames_that_it_does_not_make(
    stage: Stage, ends: tuple[Anatomy, Anatomy]
) -> None:
    """The second frame is forged: the muscle is on the other side of the bones, and the map never takes it there."""
    found = between_frames(stage, POSES, (ends[0], _jumped(ends[1])))
    assert found.meetings
    assert {look.kind for _, look in found.meetings} == {MeetingKind.UNSETTLED}
    assert "40 mm off in a frame from where the map takes it" in found.meetings[0][1].note


def test_other_tissues_are_refused(stage: Stage, ends: tuple[Anatomy, Anatomy]) -> None:
    fewer = Anatomy(tuple(tissue for tissue in ends[1] if tissue.name != "bone_distal"), ends[1].frame)
    with pytest.raises(InputError, match="different tissues"):
        between_frames(stage, POSES, (ends[0], fewer))


def test_poses_on_the_way_go_back_to_the_march_as_frames_do(rig: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame whose march was taken back by its proof is made alike when it is looked at closer."""
    narrow = ("deformer.kernel=gaussian", "deformer.kernel_scale_mm=8")
    stage = Stage.of(musclefit.read_rig(rig, overrides=(*FREE, *narrow)))
    vertices = stage.job.anatomy.vertices()
    places = np.random.default_rng(3).uniform(vertices.min(axis=0), vertices.max(axis=0), size=(20_000, 3))
    monkeypatch.setattr(proving, "place_at_rest", lambda *_: places)
    first, second = (stage.frame(pose) for pose in POSES)
    assert second.side is not None
    assert second.side.steps_returned > 0
    assert first.anatomy is not None
    assert second.anatomy is not None
    PosesOnTheWay(stage, POSES, (first.anatomy, second.anatomy)).refined(PAIR, [0.0, 1.0], fineness=0)
    monkeypatch.setattr(between, "proved", lambda made, *_, **__: (made, None))
    with pytest.raises(PoseError, match="off in a frame from where the map takes it"):
        PosesOnTheWay(stage, POSES, (first.anatomy, second.anatomy)).refined(PAIR, [0.0, 1.0], fineness=0)
