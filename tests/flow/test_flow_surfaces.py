"""Surfaces cut before and after a march: what folds between coarse vertices takes it back, within stated bounds."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import NotConvergedError
from musclefit.fields.radial import RadialBackend
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.march import Marching, Pace, one_shot
from musclefit.flow.rules import cayley_fractions, row_norm_fractions
from musclefit.flow.steppers import HandleStepper, cayley_step
from musclefit.flow.surface_refinement import CutAnatomy, carried, carried_finely, cut_at_rest, finely_carried
from musclefit.flow.tracked_points import MarchRiders, PlainRiders, riders_of
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.progress import Silent
from musclefit.rig.handles import StraightPath

FLOOR = 0.2
NONE = frozenset[str]()


def block(name: str, low: tuple[float, float, float], high: tuple[float, float, float]) -> Tissue:
    mesh = trimesh.creation.box(bounds=[low, high])
    return Tissue(name, TissueKind.MUSCLE, TriMesh(np.array(mesh.vertices), np.array(mesh.faces)))


ANATOMY = Anatomy(
    (block("muscle_near", (0, 0, 0), (100, 100, 40)), block("muscle_far", (0, 0, -60), (100, 100, -20))), "test"
)
CORNERS = ANATOMY.vertices()


def squeeze(distance: float) -> StraightPath:
    """Two places of a face, far from all vertices, that pass each other; all corners are held."""
    inner = np.array([[35.0, 60.0, 0.0], [45.0, 60.0, 0.0]])
    moved = inner + np.array([[distance, 5.0, 2.0], [-distance, -5.0, -2.0]])
    return StraightPath(np.vstack([CORNERS, inner]), np.vstack([CORNERS, moved]))


def marched(distance: float, tested: np.ndarray) -> Marching:
    stepper = HandleStepper(squeeze(distance), RadialBackend("r3"), cayley_step)
    return Marching.begun(stepper, rule=cayley_fractions, tested=tested, pace=Pace(100, 3, 1.0 - FLOOR)).marched()


def margins_of(deformation: Deformation, points: np.ndarray) -> np.ndarray:
    """The least margin of all steps at each point."""
    found, here = np.ones(len(points)), points
    for step in deformation.steps:
        trial = step.trial(here)
        found = np.minimum(found, 1.0 - 1.0 / cayley_fractions(trial.gradients))
        here = trial.moved
    return found


def least_margin(deformation: Deformation, points: np.ndarray) -> float:
    return float(margins_of(deformation, points).min())


def test_an_anatomy_is_cut_at_rest_with_its_vertices_first_and_its_wholes_left() -> None:
    cut = cut_at_rest(ANATOMY, longest_mm=30.0, whole=frozenset({"muscle_far"}))
    assert set(cut.splits) == {"muscle_near"}
    assert cut.anatomy["muscle_far"] is ANATOMY["muscle_far"]
    given, finer = ANATOMY["muscle_near"].surface, cut.anatomy["muscle_near"].surface
    np.testing.assert_array_equal(finer.vertices[: len(given.vertices)], given.vertices)
    sides = np.linalg.norm(finer.corners() - np.roll(finer.corners(), 1, axis=1), axis=2)
    assert sides.max() <= 30.0


def test_what_refinement_finds_goes_back_to_the_march() -> None:
    """Corners alone let a march through that has no solution, or nearly none, on the faces between them."""
    coarse = cut_at_rest(ANATOMY, longest_mm=40.0, whole=NONE)
    first = marched(28.0, coarse.anatomy.vertices())
    assert first.status is Status.CONVERGED
    dense = cut_at_rest(ANATOMY, longest_mm=2.0, whole=NONE).anatomy.vertices()
    try:
        hidden = least_margin(first.deformation, dense)
    except NotConvergedError:
        hidden = -1.0
    assert hidden < FLOOR, "the test needs a march that fails between its points"
    riders = riders_of(first, coarse.anatomy.vertices())
    moved, after = finely_carried(coarse, riders, tolerance_mm=0.5, whole=NONE, progress=Silent())
    assert after.returns > 0
    assert after.deformation.status is Status.CONVERGED
    rest = moved.rest.vertices()
    assert least_margin(after.deformation, rest) >= FLOOR
    assert after.deformation.margin == pytest.approx(least_margin(after.deformation, rest), abs=0.02)
    assert moved.determinants.min() > 0.0
    alone = Deformation(after.deformation.steps, (), Status.CONVERGED)
    np.testing.assert_allclose(moved.deformed.vertices(), alone(rest), rtol=0, atol=1e-8)
    np.testing.assert_allclose(moved.determinants, np.linalg.det(alone.jacobian(rest)), rtol=1e-7)
    for before, now in zip(ANATOMY, moved.rest, strict=True):
        np.testing.assert_array_equal(now.surface.vertices[: len(before.surface.vertices)], before.surface.vertices)
    assert moved.unsolved == 0


def test_surfaces_that_were_cut_before_the_march_leave_it_little_to_go_back_for() -> None:
    cut = cut_at_rest(ANATOMY, longest_mm=5.0, whole=NONE)
    riders = riders_of(marched(28.0, cut.anatomy.vertices()), cut.anatomy.vertices())
    moved, after = finely_carried(cut, riders, tolerance_mm=0.1, whole=NONE, progress=Silent())
    assert after.returns <= 1
    assert moved.splits["muscle_near"] > cut.splits["muscle_near"]
    assert least_margin(after.deformation, moved.rest.vertices()) >= FLOOR


def test_a_converged_march_is_not_given_up_for_one_that_stalls() -> None:
    """A rule that lets nothing through as soon as more points are asked about."""
    number = len(CORNERS)

    def never_for_more(gradients: np.ndarray) -> np.ndarray:
        return np.full(len(gradients), 10.0 if len(gradients) == number else 0.0)

    stepper = HandleStepper(squeeze(3.0), RadialBackend("r3"), cayley_step)
    first = Marching.begun(stepper, rule=never_for_more, tested=CORNERS, pace=Pace(100, 3)).marched()
    assert first.status is Status.CONVERGED
    riders = MarchRiders(first, Silent())
    assert riders.joined(np.array([[35.0, 60.0, 0.0]])) is None
    moved, after = finely_carried(
        CutAnatomy(ANATOMY, {}, ANATOMY), riders, tolerance_mm=1e-6, whole=NONE, progress=Silent()
    )
    assert after.deformation.steps == first.deformation.steps
    assert moved.unsolved > 0
    assert moved.undecided_edges > 0
    np.testing.assert_array_equal(moved.rest.vertices(), CORNERS)


def test_returns_are_bounded_and_then_only_the_rule_itself_counts() -> None:
    first = marched(20.0, CORNERS)
    dense = cut_at_rest(ANATOMY, longest_mm=4.0, whole=NONE).anatomy.vertices()[len(CORNERS) :]
    free = MarchRiders(first, Silent()).joined(dense)
    assert free is not None
    assert free.returns == 1
    assert least_margin(free.deformation, dense) >= FLOOR
    margins = margins_of(first.deformation, dense)
    mild = dense[np.flatnonzero((margins > 0.0) & (margins < FLOOR))[0]]
    bounded = MarchRiders(first, Silent(), max_returns=0).joined(mild[None])
    assert bounded is not None
    assert bounded.returns == 0
    assert bounded.deformation.steps == first.deformation.steps
    assert bounded.deformation.margin == pytest.approx(least_margin(first.deformation, mild[None]))


def test_points_without_a_solution_cannot_join_a_finished_map() -> None:
    class Unsolvable(Deformation):
        def with_jacobian(self, points):
            if len(points) == 1:
                raise NotConvergedError("no solution", result=None)
            return super().with_jacobian(points)

    first = marched(3.0, CORNERS).deformation
    riders = PlainRiders.of(Unsolvable(first.steps, (), Status.CONVERGED), CORNERS)
    assert riders.joined(CORNERS[:1]) is None
    joined = riders.joined(CORNERS[:2])
    assert joined is not None
    assert len(joined.moved) == len(CORNERS) + 2


# --- crossings


def folded() -> Deformation:
    """A warp in one shot that folds the face: what crosses there crosses however small the triangles are."""
    path = squeeze(40.0)
    return one_shot(path, RadialBackend("r3"), rule=row_norm_fractions, tested=CORNERS)


def test_crossings_that_halving_does_not_part_are_left_and_counted_not_multiplied() -> None:
    deformation = folded()
    moved = carried_finely(ANATOMY, deformation, tolerance_mm=0.5, longest_mm=20.0, whole=NONE, progress=Silent())
    assert moved.determinants.min() < 0.0
    left = sum(len(self_crossings(tissue.surface)) for tissue in moved.deformed)
    assert moved.crossings_left == left > 0
    np.testing.assert_allclose(moved.deformed.vertices(), deformation(moved.rest.vertices()), rtol=0, atol=1e-9)
    assert len(moved.determinants) == len(moved.rest.vertices())
    assert sum(moved.splits.values()) == len(moved.rest.vertices()) - len(CORNERS)
    bends_alone = carried(moved.rest, deformation)
    assert sum(len(self_crossings(tissue.surface)) for tissue in bends_alone.deformed) == left


def test_edges_far_below_the_chord_tolerance_are_not_halved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Slivers as small as these are told, not cut: with the shortest edge above all edges nothing is split."""
    deformation = folded()
    monkeypatch.setattr("musclefit.flow.surface_refinement.SHORTEST_SHARE", 1e6)
    whole = carried_finely(ANATOMY, deformation, tolerance_mm=0.5, longest_mm=20.0, whole=NONE, progress=Silent())
    assert whole.crossings_left > 0
    monkeypatch.setattr("musclefit.flow.surface_refinement.MAX_CROSSING_ROUNDS", 0)
    again = carried_finely(ANATOMY, deformation, tolerance_mm=0.5, longest_mm=20.0, whole=NONE, progress=Silent())
    assert again.splits == whole.splits
    assert again.crossings_left == whole.crossings_left


class Saddle(Deformation):
    """y grows by x z / 50: two triangles of a long face with one diagonal come to lie above those with the other."""

    def with_jacobian(self, points):
        x, y, z = points.T
        jacobians = np.tile(np.eye(3), (len(points), 1, 1))
        jacobians[:, 1, 0], jacobians[:, 1, 2] = 0.02 * z, 0.02 * x
        return np.column_stack([x, y + 0.02 * x * z, z]), jacobians


def test_sheets_that_all_but_touch_part_though_their_crossings_multiply_at_first() -> None:
    """Long faces 2e-5 mm apart: as they are halved more and more pairs cross, until the triangles are small enough."""
    one = block("one", (0, -1, 0), (8, 0, 0.16)).surface
    other = block("other", (-1.3, 2e-5, -0.03), (8.9, 1, 0.15)).surface
    anatomy = Anatomy((Tissue("muscle", TissueKind.MUSCLE, TriMesh.together([one, other])),), "test")
    map_ = Saddle((), (), Status.CONVERGED)
    coarse = carried(anatomy, map_).deformed["muscle"].surface
    assert len(self_crossings(coarse)) > 0, "the test needs diagonals that cross"
    moved = carried_finely(anatomy, map_, tolerance_mm=0.5, longest_mm=100.0, whole=NONE, progress=Silent())
    assert moved.crossings_left == 0
    assert len(self_crossings(moved.deformed["muscle"].surface)) == 0
    assert sum(moved.splits.values()) < 3000
