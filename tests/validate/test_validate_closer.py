"""A closer look: what passes through is found, grazes of coarse triangles are cleared, a touch at the start is told."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import MusclefitError
from musclefit.geometry.arrays import Gradients, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.subdivision import with_short_edges
from musclefit.progress import Silent
from musclefit.validate.between_frames import Passage, check_passages
from musclefit.validate.close_meetings import Look, MeetingKind, Names, Posed, Refined, looked_at

pytest.importorskip("ipctk")

A, B = "muscle_a", "bone_b"
RADIUS_MM = 8.0

Way = Callable[[Points, float], Points]
"""Where points of the moving tissue are at a fraction of the way."""


def ball(centre: Sequence[float], radius: float = RADIUS_MM) -> TriMesh:
    made = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    return TriMesh(np.asarray(made.vertices) + centre, np.asarray(made.faces))


def box(extents: Sequence[float], centre: Sequence[float]) -> TriMesh:
    made = trimesh.creation.box(extents=extents)
    return TriMesh(np.asarray(made.vertices) + centre, np.asarray(made.faces))


def two(a: TriMesh, b: TriMesh) -> Anatomy:
    return Anatomy((Tissue(A, TissueKind("muscle"), a), Tissue(B, TissueKind("bone"), b)), "test")


class Poses:
    """The first tissue goes a way, the second stays; edges get shorter with every step of fineness."""

    def __init__(self, rest: Anatomy, way: Way, *, most: int = 1000, problem: str = "") -> None:
        self.rest, self.way, self.most, self.problem = rest, way, most, problem
        self.longest_mm = 6.0
        self.made: set[float] = set()
        self.finest = -1

    def can_make(self, moments: Sequence[float]) -> bool:
        return len({*self.made, *moments}) <= self.most

    def refined(self, names: Names, moments: Sequence[float], *, fineness: int) -> Refined:
        if self.problem:
            raise MusclefitError(self.problem)
        self.made |= set(moments)
        self.finest = max(self.finest, fineness)
        longest = self.longest_mm / 2**fineness
        rest = two(*(with_short_edges(self.rest[name].surface, longest_mm=longest) for name in names))
        return Refined(rest, tuple(self._posed(rest, t) for t in moments), 0.02 / 4**fineness, longest)

    def _posed(self, rest: Anatomy, moment: float) -> Posed:
        def mapped(points: Points) -> tuple[Points, Gradients]:
            return points, np.broadcast_to(np.eye(3), (len(points), 3, 3))

        return Posed(at(rest, self.way, moment), mapped)


def at(rest: Anatomy, way: Way, moment: float) -> Anatomy:
    surface = rest[A].surface
    return two(surface.with_vertices(way(surface.vertices, moment)), rest[B].surface)


def straight(by: Sequence[float]) -> Way:
    return lambda points, moment: points + moment * np.asarray(by, dtype=float)


def round_z(degrees: float) -> Way:
    def way(points: Points, moment: float) -> Points:
        angle = np.radians(degrees) * moment
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        return points @ turn.T

    return way


def seen(rest: Anatomy, way: Way) -> Passage:
    (passage,) = check_passages(at(rest, way, 0.0), at(rest, way, 1.0), progress=Silent()).passages
    return passage


def look(rest: Anatomy, way: Way, poses: Poses | None = None) -> Look:
    return looked_at(seen(rest, way), rest, poses or Poses(rest, way))


def test_a_ball_that_goes_through_another_is_found_though_both_frames_are_clean() -> None:
    rest, way = two(ball((-40, 0, 0)), ball((0, 0, 0))), straight((80, 0, 0))
    assert seen(rest, way).hidden
    found = look(rest, way)
    assert (found.kind, found.kind.fails) == (MeetingKind.THROUGH, True)
    assert found.poses >= 1
    assert found.most_overlap_mm3 > 1000.0


def test_what_goes_through_a_thin_sheet_between_all_poses_is_not_cleared() -> None:
    rest, way = two(box((0.2, 0.2, 1.0), (0, 0, 5)), box((20, 20, 0.05), (0, 0, 0))), straight((0, 0, -7))
    found = look(rest, way)
    assert found.kind.fails
    few = look(rest, way, Poses(rest, way, most=3))
    assert (few.kind, few.poses) == (MeetingKind.UNSETTLED, 1)
    assert "triangles still meet on the way, from 0.5 to 1 of it" in few.note


def test_a_graze_of_straight_ways_that_the_tissues_go_round_is_cleared() -> None:
    """A ball goes 80 degrees round another with a gap of 1 mm; on straight ways it would be 3 mm deep in it."""
    rest, way = two(ball((17, 0, 0)), ball((0, 0, 0))), round_z(80)
    assert seen(rest, way).hidden
    poses = Poses(rest, way)
    found = looked_at(seen(rest, way), rest, poses)
    assert (found.kind, found.kind.fails, found.most_overlap_mm3) == (MeetingKind.GRAZE, False, 0.0)
    assert found.poses == len(poses.made) - 2 > 0
    assert (found.longest_mm, found.chord_mm) == (6.0 / 2**poses.finest, 0.02 / 4**poses.finest)
    assert found.triangles >= 2 * 320


def test_a_graze_of_triangles_too_coarse_for_the_bend_is_cleared() -> None:
    """A slab bends round a bar that it never touches: its one long edge at rest would cut through."""

    def bent(points: Points, moment: float) -> Points:
        lifted = points.copy()
        lifted[:, 1] -= moment * 0.012 * points[:, 0] ** 2
        return lifted

    slab, bar = box((40, 1, 10), (0, 3, 0)), box((4, 4, 20), (0, 0, 0))
    rest = two(slab, bar)
    assert seen(rest, bent).overlap_after_mm3 > 1.0
    found = look(rest, bent)
    assert (found.kind, found.most_overlap_mm3) == (MeetingKind.GRAZE, 0.0)


def test_what_touches_at_the_start_and_parts_is_told_without_a_pose() -> None:
    rest, way = two(box((10, 10, 10), (10, 0, 0)), box((10, 10, 10), (0, 0, 0))), straight((3, 0, 0))
    passage = seen(rest, way)
    assert passage.touching
    found = looked_at(passage, rest, Poses(rest, way, problem="no pose needs to be made"))
    assert (found.kind, found.kind.fails, found.poses) == (MeetingKind.TOUCHES, False, 0)


def test_what_overlaps_in_the_first_frame_or_at_rest_is_told_without_a_pose() -> None:
    rest, way = two(ball((12, 0, 0)), ball((0, 0, 0))), straight((20, 0, 0))
    assert (
        looked_at(seen(rest, way), rest, Poses(rest, way, problem="no pose needs to be made")).kind
        is MeetingKind.TOUCHES
    )
    apart = two(ball((30, 0, 0)), ball((0, 0, 0)))
    into = seen(apart, straight((-60, 0, 0)))
    assert looked_at(into, rest, Poses(rest, way, problem="no pose needs to be made")).note == "overlapping at rest"
    assert looked_at(into, apart, Poses(apart, straight((-60, 0, 0)))).kind is MeetingKind.THROUGH


def test_a_touch_at_the_start_does_not_hide_a_passage_elsewhere() -> None:
    """A bar touches a block's face at one end, and its other end swings through a post of the same tissue."""
    block, post = box((10, 10, 10), (0, 0, 0)), box((4, 4, 10), (60, 20, 0))
    both = TriMesh(np.vstack([block.vertices, post.vertices]), np.vstack([block.faces, post.faces + 8]))
    rest, way = two(box((80, 2, 4), (40, 6, 0)), both), straight((0, 40, 0))
    passage = seen(rest, way)
    assert passage.touching
    assert passage.further
    assert look(rest, way).kind is MeetingKind.THROUGH


def test_a_touch_of_coarse_triangles_in_the_first_frame_excuses_nothing_that_is_not_settled() -> None:
    """Only tissues that touch at rest touch in every pose, however fine the triangles."""
    apart = two(box((10, 10, 10), (30, 0, 0)), box((10, 10, 10), (0, 0, 0)))
    at_rest = two(box((10, 10, 10), (10, 0, 0)), box((10, 10, 10), (0, 0, 0)))
    passage = Passage(A, B, 0.2, 0.0, 0.0, touching=True, further=True)

    def way(points: Points, moment: float) -> Points:
        return points + np.array([0, 0, 20.0 * moment if moment < 1.0 else 0.0])

    def sheared(rest: Anatomy) -> Way:
        off = rest[A].surface.vertices[:, 0].mean() - 10.0
        return lambda points, moment: way(points, moment) - np.array([off, 0, 0])

    strict = looked_at(passage, apart, Poses(apart, sheared(apart), most=3))
    assert (strict.kind, strict.triangles > 0) == (MeetingKind.UNSETTLED, True)
    excused = looked_at(passage, at_rest, Poses(at_rest, sheared(at_rest), most=3))
    assert (excused.kind, excused.note) == (MeetingKind.TOUCHES, f"touching at rest; {strict.note}")
    unmade = looked_at(passage, at_rest, Poses(at_rest, sheared(at_rest), problem="no such pose"))
    assert (unmade.kind, unmade.note) == (MeetingKind.UNSETTLED, "no such pose")


def test_what_ends_in_an_overlap_is_seen_in_the_frame() -> None:
    rest, way = two(ball((-30, 0, 0)), ball((0, 0, 0))), straight((18, 0, 0))
    found = look(rest, way)
    assert (found.kind, found.kind.fails) == (MeetingKind.ENTERS, False)


def test_without_poses_nothing_is_settled_and_that_fails() -> None:
    rest, way = two(ball((17, 0, 0)), ball((0, 0, 0))), round_z(80)
    found = look(rest, way, Poses(rest, way, most=2))
    assert (found.kind, found.kind.fails, found.triangles) == (MeetingKind.UNSETTLED, True, 0)

    found = look(rest, way, Poses(rest, way, problem="no such pose"))
    assert (found.kind, found.note) == (MeetingKind.UNSETTLED, "no such pose")


@pytest.mark.parametrize("gap_mm", [-0.5, 0.5])
def test_half_a_millimetre_decides(gap_mm: float) -> None:
    """Round the other with a gap, or half a millimetre deep: the ways look alike on coarse triangles."""
    rest = two(ball((24, 0, 0)), ball((0, 0, 0)))

    def way(points: Points, moment: float) -> Points:
        nearest = 2 * RADIUS_MM + gap_mm
        inward = (nearest - 24.0) * np.sin(np.pi * moment)
        return round_z(120)(points + np.array([inward, 0, 0]), moment)

    kinds = {-0.5: MeetingKind.THROUGH, 0.5: MeetingKind.GRAZE}
    assert look(rest, way).kind is kinds[gap_mm]


@pytest.mark.parametrize(("share", "kind"), [(0.25, MeetingKind.UNSETTLED), (1.0, MeetingKind.THROUGH)])
def test_an_overlap_that_finer_triangles_take_away_is_not_believed(share: float, kind: MeetingKind) -> None:
    """Half way a ball is in another, with each fineness by a share of the depth before."""
    rest = two(ball((40, 0, 0)), ball((0, 0, 0)))

    def way(points: Points, moment: float) -> Points:
        depth = 1.0 * share ** max(poses.finest, 0)
        return points + np.array([np.sin(np.pi * moment) * (15.9 - depth - 40.0), 80 * (moment - 0.5), 0])

    poses = Poses(rest, way)
    passage = Passage(A, B, 0.5, 0.0, 0.0)
    found = looked_at(passage, rest, poses)
    assert found.kind is kind
    assert ("shrinks" in found.note) == (share < 1.0)


def test_open_surfaces_are_judged_by_what_crosses_and_that_is_said() -> None:
    way, passage = straight((80, 0, 0)), Passage(A, B, 0.3, np.nan, np.nan)

    def open_ball(beside_mm: float) -> Anatomy:
        whole = ball((-40, beside_mm, 0))
        return two(TriMesh(whole.vertices, whole.faces[1:]), ball((0, 0, 0)))

    assert looked_at(passage, open_ball(3), Poses(open_ball(3), way)).kind is MeetingKind.THROUGH
    found = looked_at(passage, open_ball(30), Poses(open_ball(30), way))
    assert found.kind is MeetingKind.GRAZE
    assert "not a solid" in found.note
