"""Very many handles: met exactly however close they are, sparse, and bounded as rigorously as every other field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from musclefit.certify.maps import certify_map
from musclefit.certify.strain import Condition, strain_ranges
from musclefit.errors import FieldError
from musclefit.fields.enclosures.cell_slopes import CellSlopes
from musclefit.fields.evaluation.neighbours import Cells
from musclefit.fields.fitting import multilevel
from musclefit.fields.fitting.multilevel import MultilevelBackend
from musclefit.fields.protocol import prepared
from musclefit.fields.radial import RadialBackend
from musclefit.vocabulary import Claim, StepKind

RNG = np.random.default_rng(0)
BOX = np.array([[90.0, 0.0, 0.0]]), np.full((1, 3), 10.0)
"""Around half of the uneven points."""


def uneven(count: int, *, dimensions: int = 3) -> np.ndarray:
    """Points over a ball's surface and in it, ten times denser on one side, some pairs very close."""
    points = RNG.normal(size=(count, dimensions))
    points *= 100.0 / np.linalg.norm(points, axis=1)[:, None] * RNG.choice([1.0, 0.7, 0.3], count)[:, None]
    points[: count // 2] = 0.1 * points[: count // 2] + np.eye(dimensions)[0] * 90.0
    points[1::50] = points[0::50] + 1e-3 * RNG.normal(size=points[0::50].shape)
    return points


def smooth(points: np.ndarray) -> np.ndarray:
    return np.column_stack([5.0 * np.sin(points[:, k] / 40.0) + 0.05 * points[:, 0] for k in range(points.shape[1])])


@pytest.fixture
def small_base(monkeypatch):
    monkeypatch.setattr(multilevel, "BASE", 60)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_every_handle_is_met_and_between_them_the_field_is_near(small_base, dimensions):
    at = uneven(1500, dimensions=dimensions)
    field = MultilevelBackend("r3").fit(at, smooth(at))
    assert len(field.layers) > 5
    np.testing.assert_allclose(field.displacement(at), smooth(at), rtol=0, atol=1e-9)
    between = at[RNG.integers(len(at), size=300)] + RNG.normal(scale=0.5, size=(300, dimensions))
    assert np.percentile(np.linalg.norm(field.displacement(between) - smooth(between), axis=1), 95) < 0.3


def test_random_displacements_are_met_too(small_base):
    at = uneven(800)
    wanted = RNG.normal(size=at.shape) * 1e-3
    np.testing.assert_allclose(MultilevelBackend("r").fit(at, wanted).displacement(at), wanted, rtol=0, atol=1e-12)


def test_handles_of_a_level_are_the_first_of_their_cells_and_apart_from_each_other_and_from_those_met():
    at, spacing = uneven(700), 9.0
    before, met = RNG.permutation(700)[:50], RNG.random(700) < 0.1
    found = multilevel._apart(at, met, spacing, before=before)
    seen: set[tuple[int, ...]] = set()
    candidates = []
    for k in [*before, *(k for k in range(700) if k not in set(before))]:
        cell = tuple(np.floor((at[k] - at.min(axis=0)) / spacing).astype(int))
        if not met[k] and cell not in seen:
            seen.add(cell)
            candidates.append(k)
    near = multilevel.APART * spacing
    earlier = list(np.flatnonzero(met))
    expected = []
    for k in candidates:
        if (np.linalg.norm(at[earlier] - at[k], axis=1) > near).all():
            expected.append(k)
        earlier.append(k)
    assert len(expected) > 50
    assert found.tolist() == expected


def test_the_radial_sum_goes_through_the_first_spacing_at_which_enough_handles_are_apart(small_base):
    at = uneven(2000)
    spacing, found = multilevel._coarse(at)
    nobody, none = np.zeros(2000, dtype=bool), np.zeros(0, dtype=np.int64)
    assert found.tolist() == multilevel._apart(at, nobody, spacing, before=none).tolist()
    wider = float(np.linalg.norm(np.ptp(at, axis=0))) / 4.0
    while wider > 1.01 * spacing:
        assert len(multilevel._apart(at, nobody, wider, before=none)) < multilevel.BASE
        wider /= 1.2
    assert wider == pytest.approx(spacing, rel=1e-9)
    assert len(found) >= multilevel.BASE


def test_the_sparse_system_of_a_level_is_wendlands_function_and_is_solved():
    at, support = uneven(400), 12.0
    q = np.linalg.norm(at[:, None] - at, axis=2) / support
    dense = np.maximum(1.0 - q, 0.0) ** 4 * (4.0 * q + 1.0)
    np.testing.assert_allclose(multilevel._matrix(at, support).toarray(), dense, rtol=0, atol=1e-14)
    apart = multilevel._apart(at, np.zeros(400, dtype=bool), 3.0, before=np.arange(0))
    data = smooth(at[apart])
    weights = multilevel._solved(multilevel._matrix(at[apart], support), data, tolerance=1e-11)
    np.testing.assert_allclose(dense[np.ix_(apart, apart)] @ weights, data, rtol=0, atol=1e-10)


def test_rows_are_multiplied_alike_in_any_number_of_threads():
    matrix = multilevel._matrix(RNG.uniform(0.0, 40.0, (20_000, 3)), 2.0)
    vectors = RNG.normal(size=(20_000, 3))
    image = np.full_like(vectors, np.nan)
    multilevel.multiply_rows(matrix.indptr, matrix.indices, matrix.data, vectors, image)
    np.testing.assert_allclose(image, matrix @ vectors, rtol=0, atol=1e-12)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_layers_add_up(small_base, dimensions):
    at = uneven(900, dimensions=dimensions)
    field = MultilevelBackend("r3").fit(at, smooth(at))
    points = RNG.uniform(-80, 80, (300, dimensions))
    for found, parts in zip(
        field.displacement_and_gradient(points),
        zip(*(layer.displacement_and_gradient(points) for layer in field.layers), strict=True),
        strict=True,
    ):
        assert found.flags.c_contiguous
        np.testing.assert_allclose(found, sum(parts), rtol=0, atol=1e-10)


def test_few_handles_are_those_of_the_radial_sum():
    at = uneven(200)
    one, other = MultilevelBackend("r3").fit(at, smooth(at)), RadialBackend("r3").fit(at, smooth(at))
    points = RNG.uniform(-80, 80, (50, 3))
    np.testing.assert_array_equal(one.displacement(points), other.displacement(points))


def test_fine_levels_are_empty_where_handles_are_far_apart(small_base):
    at = uneven(1500)
    layers = MultilevelBackend("r3").fit(at, smooth(at)).layers
    assert sum(len(layer.centres) for layer in layers) < 6 * len(at)
    finest = layers[-1]
    assert len(finest.centres) < 0.2 * len(at)


def test_gradients_are_derivatives_and_scaling_scales(small_base):
    at = uneven(600)
    field = MultilevelBackend("r3").fit(at, smooth(at))
    points, h = RNG.uniform(-60, 60, (40, 3)), 1e-5
    values, gradients = field.displacement_and_gradient(points)
    np.testing.assert_allclose(values, field.displacement(points), rtol=0, atol=1e-12)
    for k in range(3):
        step = h * np.eye(3)[k]
        numeric = (field.displacement(points + step) - field.displacement(points - step)) / (2 * h)
        np.testing.assert_allclose(gradients[:, :, k], numeric, rtol=0, atol=1e-6)
    np.testing.assert_allclose(field.scaled(-2.0).gradient(points), -2.0 * gradients, rtol=0, atol=1e-12)


@pytest.mark.parametrize("prepared", [False, True])
def test_bounds_hold_at_every_sampled_place(small_base, prepared):
    """An attack: boxes of all sizes, sampled densely; not one place may leave what is proved of it."""
    at = uneven(500)
    field = MultilevelBackend("r3").fit(at, smooth(at))
    field = field.prepared() if prepared else field
    centres = np.concatenate([at[::10] + RNG.normal(scale=0.3, size=at[::10].shape), RNG.uniform(-90, 90, (30, 3))])
    half_widths = np.exp(RNG.uniform(-6, 2, (len(centres), 1))) * np.ones(3)
    radii = half_widths[:, 0]
    in_boxes = centres[:, None] + RNG.uniform(-1, 1, (len(centres), 200, 3)) * half_widths[:, None]
    directions = RNG.normal(size=(len(centres), 200, 3))
    directions *= (RNG.uniform(0, 1, (len(centres), 200)) ** 0.33 / np.linalg.norm(directions, axis=2))[..., None]
    in_balls = centres[:, None] + directions * radii[:, None, None]
    gradient_bounds = field.gradient_bounds(centres, half_widths), field.gradient_ball_bounds(centres, radii)
    strains = (
        field.strain_bounds(centres, half_widths, enough=(-0.5, 0.5))[0],
        field.strain_ball_bounds(centres, radii)[0],
    )
    values, spread = field.displacement_bounds(centres, half_widths)
    for places, (middles, reach), ranges in zip((in_boxes, in_balls), gradient_bounds, strains, strict=True):
        flat = places.reshape(-1, 3)
        moved, gradients = field.displacement_and_gradient(flat)
        gradients = gradients.reshape(*places.shape, 3)
        known = np.isfinite(middles).all(axis=(1, 2))
        assert known.any()
        off = np.linalg.norm(gradients[known] - middles[known, None], 2, axis=(2, 3))
        assert (off <= reach[known, None] + 1e-12).all()
        eigenvalues = np.linalg.eigvalsh(0.5 * (gradients + gradients.swapaxes(2, 3)))
        assert (eigenvalues[..., 0] >= ranges[:, None, 0] - 1e-12).all()
        assert (eigenvalues[..., -1] <= ranges[:, None, 1] + 1e-12).all()
        assert np.isfinite(ranges[radii < 0.01]).all()
        if places is in_boxes:
            inside = np.abs(moved.reshape(places.shape) - values[:, None]) <= spread[:, None] + 1e-12
            assert inside.all()


@pytest.mark.parametrize("dimensions", [2, 3])
def test_slopes_of_cells_are_never_exceeded(small_base, dimensions):
    """An attack on the bound of the compact layers from any one on, over boxes of all sizes, with their corners."""
    at = uneven(500, dimensions=dimensions)
    layers = MultilevelBackend("r3").fit(at, smooth(at)).layers[1:]
    slopes = CellSlopes.of(layers)
    centres = np.concatenate([at[::10], RNG.uniform(-90, 90, (50, dimensions))])
    half_widths = np.exp(RNG.uniform(-6, 5, (len(centres), 1))) * np.ones(dimensions)
    corners = np.sign(RNG.uniform(-1, 1, (len(centres), 20, dimensions)))
    places = (
        centres[:, None] + np.concatenate([corners, RNG.uniform(-1, 1, corners.shape)], axis=1) * half_widths[:, None]
    )
    for first in range(len(layers)):
        gradients = sum(layer.gradient(places.reshape(-1, dimensions)) for layer in layers[first:])
        lengths = np.linalg.norm(gradients, 2, axis=(1, 2)).reshape(places.shape[:2]).max(axis=1)
        bounds = slopes.over(centres, half_widths, np.full(len(centres), first))
        assert (lengths <= bounds).all()
        assert first or lengths.max() > 0.02 * bounds.max()
    beyond = np.full((1, dimensions), 1e4)
    everything = np.full((1, dimensions), 1e9)
    assert slopes.over(beyond, np.ones_like(beyond), np.array([len(layers)])) == 0.0
    assert slopes.over(beyond, everything, np.array([0])) == slopes.levels[-1][0].max()
    assert slopes.over(beyond * np.nan, everything, np.array([0])) == np.inf


def test_what_a_field_says_of_its_slopes_proves_nothing(small_base):
    """A certificate finds them anew: those that a field was given may be wrong."""
    at = uneven(300)
    field = MultilevelBackend("r3").fit(at, smooth(at))
    right = field.prepared()
    assert right.slopes is not None
    wrong = replace(right, slopes=replace(right.slopes, levels=tuple(0.0 * level for level in right.slopes.levels)))
    box = np.zeros((1, 3)), np.full((1, 3), 50.0)
    assert prepared(wrong).gradient_bounds(*box)[1] == right.gradient_bounds(*box)[1] > wrong.gradient_bounds(*box)[1]
    assert field.scaled(2.0).slopes is None


def test_a_step_of_many_handles_is_proved_in_few_boxes(small_base):
    """Boxes wide for the finest supports are proved as they are, by the slopes of cells."""
    at = uneven(3000)
    field = MultilevelBackend("r3").fit(at, 0.3 * smooth(at))
    found = certify_map([(StepKind.CAYLEY, field)], at, max_boxes=20_000)
    assert found.claim is Claim.CERTIFIED
    condition, everything = Condition.of(StepKind.CAYLEY), (np.inf, -np.inf)
    strong = field.scaled(10.0)
    alone, known = (
        condition.margins(strain_ranges(f, *BOX, enough=everything)[0]) for f in (strong, strong.prepared())
    )
    assert alone < 0.0 < known  # every source in the box counts, or those of its worst cell


def test_what_cannot_be_fitted_is_said():
    at = uneven(100)
    for kernel, said in (("isochoric-r3", "isochoric"), ("wendland-c2", "compact")):
        with pytest.raises(FieldError, match=said):
            MultilevelBackend(kernel, 10.0)
    many = np.concatenate([uneven(1500), np.full((2, 3), 7.0)])
    with pytest.raises(FieldError, match="1 handles coincide"):
        MultilevelBackend("r3").fit(many, smooth(many))
    assert len(at) == 100


def test_a_short_support_in_a_large_body_makes_no_billions_of_cells():
    points = RNG.uniform(-1000, 1000, (500, 3))
    cells = Cells.of(points, width=0.01)
    assert int(np.prod(cells.counts)) < 100_000
    assert cells.width >= 0.01
    assert sorted(cells.order.tolist()) == list(range(500))
