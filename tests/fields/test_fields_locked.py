"""Fields locked to bones: affine on the whole surface; derivatives, inverse, proved bounds."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from attacks import attack_boxes

from musclefit.certify.maps import certify_map
from musclefit.errors import FieldError
from musclefit.fields.corrected import CorrectedField
from musclefit.fields.locked import Fade, LockedField
from musclefit.fields.radial import RadialBackend
from musclefit.fields.solenoidal import PotentialLevel, SolenoidalField
from musclefit.flow.locks import BoneLocks, LockSettings, Stand, nearness_of
from musclefit.flow.steps import CayleyStep
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.queries.winding import exact_winding_numbers
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.surfaces.samples import surface_samples
from musclefit.vocabulary import Claim, StepKind


def ball(centre: tuple[float, float, float], radii: tuple[float, float, float]) -> TriMesh:
    mesh = trimesh.creation.icosphere(2)
    return TriMesh(np.array(mesh.vertices) * radii + centre, np.array(mesh.faces))


UPPER, LOWER = ball((0.0, 0.0, 22.0), (6.0, 7.0, 12.0)), ball((1.0, 0.0, -20.0), (6.0, 5.0, 13.0))
TURN = RigidMotion.about_axis(centre=np.array([0.0, 0.0, 2.0]), axis=np.array([1.0, 0.2, 0.0]), angle_deg=9.0)
FADE = Fade(over_mm=3.0, apart_mm=3.0)
BEFORE = [Stand.of(RigidMotion.identity()), Stand.of(RigidMotion.identity())]
AFTER = [Stand.of(RigidMotion.identity()), Stand.of(TURN)]


@pytest.fixture(scope="module")
def locked() -> LockedField:
    locks = BoneLocks.around([UPPER, LOWER], [LockSettings(0.8, FADE)] * 2).of_step(BEFORE, AFTER)
    at = np.concatenate([UPPER.vertices[::9], LOWER.vertices[::9]])
    to = np.concatenate([UPPER.vertices[::9], TURN(LOWER.vertices[::9])])
    return LockedField(RadialBackend("isochoric-r3").fit(0.5 * (at + to), to - at), locks)


@pytest.fixture(scope="module", params=["radial", "corrected"])
def bounded(request: pytest.FixtureRequest, locked: LockedField) -> LockedField:
    """The field on a base that knows one enclosure of its gradient, and on one that has a quick one as well."""
    if request.param == "radial":
        return locked
    rng = np.random.default_rng(8)
    levels = [PotentialLevel.around(LOWER.vertices, spacing_mm=h) for h in (6.0, 3.0)]
    local = SolenoidalField(
        tuple(replace(level, coefficients=0.15 * rng.normal(size=level.coefficients.shape)) for level in levels)
    )
    return replace(locked, base=CorrectedField(locked.base, local))


def around(count: int = 20_000, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-14.0, -14.0, -38.0], [14.0, 14.0, 40.0], (count, 3))


@pytest.mark.parametrize(("surface", "motion"), [(UPPER, RigidMotion.identity()), (LOWER, TURN)])
def test_a_step_moves_the_whole_surface_as_its_bone(locked, surface, motion):
    places = surface_samples(surface, spacing_mm=0.15).points
    assert len(places) > 20_000
    off = CayleyStep(locked)(places) - motion(places)
    assert np.abs(off).max() < 1e-9
    # without the locks the same field misses it
    assert np.abs(CayleyStep(locked.base)(places) - motion(places)).max() > 0.01


def test_smooth_distances_are_those_from_what_either_of_two_overlapping_parts_goes_around():
    parts = ball((0.0, 0.0, 0.0), (9.0, 7.0, 12.0)), ball((5.0, 2.0, 6.0), (6.0, 8.0, 5.0))
    near = nearness_of(TriMesh.together(parts), spacing_mm=0.6, reach_mm=5.0)
    places = np.random.default_rng(4).uniform(-24.0, 24.0, (30_000, 3))
    within = np.any([exact_winding_numbers(part, places) > 0.5 for part in parts], axis=0)
    apart = np.min([nearest_places(places, part).distances for part in parts], axis=0)
    wanted = np.clip(np.where(within, -apart, apart), -near.depth_mm, near.reach_mm)
    found = near.at(places)[0]
    # values are rounded at the surface alone, where they are raised, and on ridges between sides
    assert np.abs(found - wanted).max() < 0.6
    assert np.median(np.abs(found - wanted)[np.abs(wanted) < 4.0]) < 0.06
    assert (found[apart > 7.0] == np.where(within, -near.depth_mm, near.reach_mm)[apart > 7.0]).all()


def test_what_is_within_a_bone_moves_with_it(locked):
    inside = LOWER.vertices.mean(axis=0) + 0.6 * (LOWER.vertices - LOWER.vertices.mean(axis=0))
    np.testing.assert_allclose(CayleyStep(locked)(inside), TURN(inside), rtol=0, atol=1e-9)


def test_far_from_bones_the_field_is_its_base(locked):
    far = np.array([[30.0, 0.0, 0.0], [0.0, -25.0, 10.0], [12.0, 12.0, 2.0]])
    np.testing.assert_array_equal(locked.displacement(far), locked.base.displacement(far))


def test_derivatives_are_those_of_the_values(locked):
    points, h = around(2000), 1e-5
    gradients = locked.gradient(points)
    for axis in range(3):
        step = h * np.eye(3)[axis]
        slope = (locked.displacement(points + step) - locked.displacement(points - step)) / (2.0 * h)
        np.testing.assert_allclose(gradients[:, :, axis], slope, rtol=0, atol=2e-4)


def test_the_inverse_undoes_the_step(locked):
    step, points = CayleyStep(locked), around(3000)
    np.testing.assert_allclose(step.inverse()(step(points)), points, rtol=0, atol=1e-9)


@pytest.mark.parametrize("half", [0.05, 0.4, 2.0, 9.0])
def test_bounds_over_boxes_hold_at_every_place_tried(bounded, half):
    rng = np.random.default_rng(int(100 * half))
    on = np.concatenate([UPPER.vertices, LOWER.vertices])
    centres = on[rng.integers(len(on), size=400)] + rng.normal(0.0, 1.5, (400, 3))
    halves = half * rng.uniform(0.3, 1.0, (400, 3))
    assert np.isfinite(bounded.gradient_bounds(centres, halves)[1]).all()
    attack_boxes(bounded, centres, halves, rng, enough=(-0.1, 0.1), tries=60)


@pytest.fixture(scope="module")
def crowded() -> LockedField:
    """Eight bones around one place, each near to seven, each turned by itself."""
    rng = np.random.default_rng(6)
    centres = 3.3 * np.array(list(np.ndindex(2, 2, 2))) - 1.65
    bones = [ball(tuple(centre), (1.2, 1.3, 1.4)) for centre in centres]
    turns = [RigidMotion.about_axis(centre=c, axis=rng.normal(size=3), angle_deg=6.0) for c in centres]
    locks = BoneLocks.around(bones, [LockSettings(0.3, Fade(1.2, 1.5))] * len(bones))
    rest = [Stand.of(RigidMotion.identity())] * len(bones)
    handles = rng.uniform(-4.0, 4.0, (12, 3))
    base = RadialBackend("isochoric-r3").fit(handles, 0.1 * rng.normal(size=handles.shape))
    return LockedField(base, locks.of_step(rest, [Stand.of(turn) for turn in turns]))


@pytest.mark.parametrize("half", [0.4, 0.1, 0.01])
def test_bounds_hold_among_many_bones(crowded, half):
    rng = np.random.default_rng(1)
    centres = rng.uniform(-4.0, 4.0, (400, 3))
    attack_boxes(crowded, centres, half * rng.uniform(0.3, 1.0, centres.shape), rng, enough=(-0.1, 0.1), tries=60)


def test_among_many_bones_bounds_of_many_boxes_need_little_memory(crowded):
    """Found all at once, with all directions that eight bones make, they took 1.1 GB."""
    centres = np.random.default_rng(2).uniform(-4.0, 4.0, (60_000, 3))
    tracemalloc.start()
    try:
        crowded.displacement_bounds(centres, np.full(centres.shape, 0.02))
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most < 200e6


def test_bounds_come_close_to_what_small_boxes_hold(locked):
    centres = around(300)
    gradients, radii = locked.gradient_bounds(centres, np.full_like(centres, 1e-6))
    np.testing.assert_allclose(gradients, locked.gradient(centres), rtol=0, atol=1e-9)
    assert radii.max() < 1e-3


def test_a_locked_step_is_certified_and_one_too_steep_is_not(locked):
    skin = ball((0.0, 0.0, 1.0), (20.0, 20.0, 45.0))
    assert certify_map([(StepKind.CAYLEY, locked)], skin).claim is Claim.CERTIFIED
    assert certify_map([(StepKind.CAYLEY, locked.scaled(24.0))], skin).claim is not Claim.CERTIFIED


def still(surfaces: list[TriMesh], spacing: float, fade: Fade) -> LockedField:
    """Locks of bones that stay where they are."""
    stands = [Stand.of(RigidMotion.identity()) for _ in surfaces]
    locks = BoneLocks.around(surfaces, [LockSettings(spacing, fade)] * len(surfaces)).of_step(stands, stands)
    return LockedField(RadialBackend("r3").fit(UPPER.vertices[::9], 0.0 * UPPER.vertices[::9]), locks)


def test_where_bones_touch_neither_counts_and_no_place_sees_two():
    near = ball((0.0, 0.0, -14.0), (6.0, 5.0, 23.5))
    field = still([UPPER, near], 0.4, FADE)
    weights, _ = field.weights(around(60_000))
    assert (np.sort(weights, axis=0)[0] == 0.0).all()
    assert weights.max() == 1.0
    tip = np.array([[0.0, 0.0, 9.9]])
    assert field.weights(tip)[0].max() < 0.2
    top = UPPER.vertices[UPPER.vertices[:, 2] > 25.0]
    np.testing.assert_array_equal(field.weights(top)[0][0], 1.0)


def test_a_half_turn_in_one_step_is_refused():
    half = RigidMotion.about_axis(centre=np.zeros(3), axis=np.array([0.0, 1.0, 0.0]), angle_deg=180.0)
    locks = BoneLocks.around([UPPER], [LockSettings(0.8, FADE)])
    with pytest.raises(FieldError, match="180 degrees"):
        locks.of_step(BEFORE[:1], [Stand.of(half)])


BIG = ball((0.0, 0.0, 25.0), (16.0, 16.0, 24.0))
TOUCHING = {"a gap of 0.5 mm": -14.0, "an overlap of 0.4 mm": -13.1, "a wide gap": -19.0}


@pytest.mark.parametrize("z", TOUCHING.values(), ids=TOUCHING)
@pytest.mark.parametrize(("spacing", "over", "apart"), [(0.4, 2.0, 4.0), (0.8, 6.0, 3.0), (1.5, 3.0, 1.5)])
def test_weights_are_continuous_from_cell_to_cell_however_near_bones_are(z, spacing, over, apart):
    """A proof speaks of a continuous field: distances must not jump between what has values and what has none."""
    wide = 16.0 if spacing > 0.4 else 7.0  # fine lattices take long on large balls
    high, low = (ball((0.0, 0.0, at), (wide, wide, half)) for at, half in ((25.0, 24.0), (z, 14.5)))
    field = still([high, low], spacing, Fade(over, apart))
    for lock in field.locks:
        lattice = lock.nearness
        for axis in range(3):
            places = np.random.default_rng(axis).uniform([-20.0, -20.0, -35.0], [20.0, 20.0, 52.0], (60_000, 3))
            cells = np.round((places[:, axis] - lattice.low[axis]) / spacing) - 0.5
            places[:, axis] = lattice.low[axis] + cells * spacing
            beside = 1e-9 * np.eye(3)[axis]
            (before, rising), (after, going_on) = lattice.at(places - beside), lattice.at(places + beside)
            assert before.min() < 0.0
            np.testing.assert_allclose(after, before, rtol=0, atol=1e-7)
            np.testing.assert_allclose(going_on, rising, rtol=0, atol=1e-6)


@pytest.mark.parametrize("spacing", [0.4, 0.8, 2.0])
@pytest.mark.parametrize("surface", [BIG, UPPER, ball((0.0, 0.0, 0.0), (1.0, 9.0, 9.0))])
def test_smooth_distances_are_no_larger_on_the_surface_than_they_say(surface, spacing):
    """Not even on bones thinner than the lattice."""
    near = BoneLocks.around([surface], [LockSettings(spacing, FADE)]).near[0]
    distances, _ = near.at(surface_samples(surface, spacing_mm=0.15).points)
    assert distances.max() <= near.surface_mm < spacing
    # a length away they tell that length, as closely as they are smooth
    normals = surface.vertices - surface.vertices.mean(axis=0)
    outward = surface.vertices + 4.0 * normals / np.linalg.norm(normals, axis=1, keepdims=True)
    true = nearest_places(outward, surface).distances
    np.testing.assert_allclose(near.at(outward)[0], true, rtol=0, atol=0.4 * spacing)


def test_weights_change_no_faster_than_what_they_fade_over():
    low = ball((0.0, 0.0, -14.0), (16.0, 16.0, 14.5))
    field = still([BIG, low], 0.8, Fade(over_mm=3.0, apart_mm=2.0))
    places = np.random.default_rng(4).uniform([-20.0, -20.0, -35.0], [20.0, 20.0, 52.0], (200_000, 3))
    steepest = np.linalg.norm(field.weights(places)[1], axis=2).max()
    # A fall from 1 to 0 over a length is at most 1.5 over it steep; the difference of two distances changes twice.
    assert 1.0 < steepest < 1.2 * (1.5 / 3.0 + 2.0 * 1.5 / 2.0)


@pytest.mark.parametrize(("over", "apart"), [(0.5, 3.0), (3.0, 0.7)])
def test_a_lattice_too_wide_for_the_lock_is_refused(over, apart):
    with pytest.raises(FieldError, match=r"take a narrower lattice"):
        LockSettings(0.8, Fade(over, apart))


@pytest.mark.parametrize("half", [0.02, 0.2, 0.7, 3.0])
def test_ranges_of_smooth_distances_hold_and_are_close(half):
    """Over boxes across cells of the lattice and within them, and deep in the bone, where nothing varies."""
    near = BoneLocks.around([UPPER], [LockSettings(0.8, FADE)]).near[0]
    rng = np.random.default_rng(int(100 * half))
    centres = UPPER.vertices[rng.integers(len(UPPER.vertices), size=200)] + rng.normal(0.0, 1.5, (200, 3))
    centres[:40] = near.low + near.spacing_mm * (np.round((centres[:40] - near.low) / near.spacing_mm) - 0.5)
    halves = half * rng.uniform(0.3, 1.0, (200, 3))
    inside = np.concatenate([np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1.0, rng.uniform(-1.0, 1.0, (400, 3))])
    values, slopes = near.at((centres[:, None] + halves[:, None] * inside).reshape(-1, 3))
    values, slopes = values.reshape(200, -1), slopes.reshape(200, -1, 3)
    at_centres = near.at(centres)[1]
    ranges, steep = near.ranges(centres, halves), near.slope_ranges(centres, halves, at_centres)
    assert (ranges[:, 0] <= values.min(axis=1) + 1e-12).all()
    assert (values.max(axis=1) <= ranges[:, 1] + 1e-12).all()
    turned = np.linalg.norm(slopes - at_centres[:, None], axis=2).max(axis=1)
    assert (np.linalg.norm(slopes, axis=2).max(axis=1) <= steep[:, 0] + 1e-12).all()
    assert (turned <= steep[:, 1] + 1e-12).all()
    varied = np.ptp(values, axis=1)
    if half < 1.0:
        some = varied > 0.0
        assert np.median(np.ptp(ranges[some], axis=1) / varied[some]) < 1.1
        assert np.median(steep[some, 1] / turned[some]) < 1.4
