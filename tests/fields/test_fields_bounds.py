"""Attacks on the proved bounds of radial fields: nothing sampled, and nothing of higher precision, may leave them."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from musclefit.errors import FieldError
from musclefit.fields.enclosures.eigenvalues import eigenvalue_floor
from musclefit.fields.kernels import KERNELS
from musclefit.fields.radial import RadialBackend, RadialField

SCALES = {
    "gaussian": 30.0,
    "inverse-multiquadric": 30.0,
    "wendland-c2": 60.0,
    "wendland-c4": 60.0,
    "isochoric-r3-mollified": 5.0,
    "isochoric-wendland-c6": 80.0,
}
SCALARS = [name for name, kernel in KERNELS.items() if not kernel.isochoric]
WHOLE = (-np.inf, np.inf)
TIGHT = (np.inf, -np.inf)
Long = np.longdouble


def chain(name: str, scale: float, r: np.ndarray) -> tuple[np.ndarray, ...]:
    """f_1, f_2 (scalar) or f_2, f_3 (isochoric) in extended precision, written down independently of the loops."""
    r, s = Long(r), Long(scale)
    q = r / s
    u = np.maximum(1 - q, 0)
    match name:
        case "r":
            return -1 / r, 1 / r**3
        case "r2logr":
            return 2 * np.log(r) + 1, 2 / r**2
        case "r3":
            return 3 * r, 3 / r
        case "gaussian":
            return -2 / s**2 * np.exp(-(q**2)), 4 / s**4 * np.exp(-(q**2))
        case "inverse-multiquadric":
            return -1 / s**2 / (1 + q**2) ** Long(1.5), 3 / s**4 / (1 + q**2) ** Long(2.5)
        case "wendland-c2":
            return -20 / s**2 * u**3, 60 / s**4 * u**2 / q
        case "wendland-c4":
            return -Long(56) / 3 / s**2 * u**5 * (5 * q + 1), 560 / s**4 * u**4
        case "isochoric-r3":
            return 3 / r, -3 / r**3
        case "isochoric-r3-mollified":
            return 3 / np.sqrt(r**2 + s**2), -3 / np.sqrt(r**2 + s**2) ** 3
        case "isochoric-r5":
            return -15 * r, -15 / r
        case _:
            return 528 / s**2 * u**6 * (6 * q + 1), -22176 / s**4 * u**5


def gradient_in_long(field: RadialField, points: np.ndarray) -> np.ndarray:
    """The gradient at points off the centres, in extended precision from exact coordinates."""
    n = points.shape[1]
    x = Long(points)[:, None] - Long(field.centres)[None]
    r = np.sqrt((x**2).sum(axis=2))
    w, eye = Long(field.weights), np.eye(n, dtype=Long)
    a, b = chain(field.kernel, field.scale, r)
    if not KERNELS[field.kernel].isochoric:
        return Long(field.linear) + np.einsum("ji,pj,pjk->pik", w, a, x)
    s = np.einsum("pjk,jk->pj", x, w)
    along = -(4 * a + r**2 * b)
    total = np.einsum("pj,ji,pjk->pik", along, w, x) + np.einsum("pj,pji,pjk->pik", b * s, x, x)
    total = total + np.einsum("pj,jk,pji->pik", a, w, x) + (a * s).sum(axis=1)[:, None, None] * eye
    return Long(field.linear) + total


def random_field(name: str, rng: np.random.Generator, *, n: int = 3, m: int = 20, offset: float = 0.0) -> RadialField:
    """Weights without side conditions, a linear part, and an origin away from the handles' mean."""
    centres = rng.uniform(-50.0, 50.0, (m, n)) + offset
    unit = RadialField(
        kernel=name,
        scale=SCALES.get(name, 1.0),
        centres=centres,
        weights=rng.normal(size=(m, n)),
        origin=centres.mean(axis=0) + rng.normal(size=n),
        linear=rng.normal(size=(n, n)) * 0.1,
        translation=rng.normal(size=n),
        polynomial_rank=0,
        polynomial_terms=0,
    )
    size = np.abs(unit.gradient(centres + 0.5)).max()
    return unit.scaled(1.0 / size)


def boxes(field: RadialField, rng: np.random.Generator, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Boxes anywhere, around centres, beside centres; some flat, some points."""
    n, m = field.centres.shape[1], len(field.centres)
    middle = field.centres.mean(axis=0)
    centres = np.concatenate(
        [
            rng.uniform(-70.0, 70.0, (60, n)) + middle,
            field.centres,
            field.centres + rng.normal(size=(m, n)) * width,
            field.centres + rng.normal(size=(m, n)) * width * 1e-3,
        ]
    )
    halves = rng.uniform(0.0, width, centres.shape)
    halves[::7, 0] = 0.0
    halves[::11] = width
    return centres, halves


def points_in(centres: np.ndarray, halves: np.ndarray, field: RadialField, rng: np.random.Generator) -> np.ndarray:
    """(B, k, n) points of each box: random, corners, faces' middles, and beside the centres that it holds."""
    n = centres.shape[1]
    shifts = [rng.uniform(-1.0, 1.0, (30, n)), np.array(list(itertools.product((-1.0, 1.0), repeat=n))), np.eye(n)]
    points = centres[:, None] + halves[:, None] * np.concatenate(shifts)
    nearest = field.centres[np.argmin(np.linalg.norm(centres[:, None] - field.centres, axis=2), axis=1)]
    beside = nearest[:, None] + rng.normal(size=(len(centres), 8, n)) * 10.0 ** rng.uniform(-9, 0, (len(centres), 8, 1))
    low, high = (centres - halves)[:, None], (centres + halves)[:, None]
    return np.concatenate([points, np.clip(beside, low, high)], axis=1)


@pytest.mark.parametrize("width", [1e-4, 0.1, 3.0, 30.0])
@pytest.mark.parametrize("name", KERNELS)
def test_no_point_of_a_box_leaves_its_enclosure(name: str, width: float) -> None:
    rng = np.random.default_rng([len(name), int(width * 10)])
    field = random_field(name, rng)
    centres, halves = boxes(field, rng, width)
    points = points_in(centres, halves, field, rng)
    flat = points.reshape(-1, 3)
    gradients = field.gradient(flat).reshape(*points.shape, 3)
    off_centres = np.linalg.norm(flat[:, None] - field.centres, axis=2).min(axis=1).reshape(points.shape[:2]) > 1e-9

    matrices, radii = field.gradient_bounds(centres, halves)
    deviations = np.where(off_centres, np.linalg.norm(gradients - matrices[:, None], 2, axis=(2, 3)), 0.0)
    assert np.all(deviations <= radii[:, None] + 1e-9), (deviations - radii[:, None]).max()

    strains = np.linalg.eigvalsh(0.5 * (gradients + gradients.swapaxes(2, 3)))
    for enough in (WHOLE, TIGHT):
        ranges, _ = field.strain_bounds(centres, halves, enough=enough)
        assert np.all(np.where(off_centres, strains[..., 0], np.inf) >= ranges[:, :1] - 1e-9)
        assert np.all(np.where(off_centres, strains[..., -1], -np.inf) <= ranges[:, 1:] + 1e-9)

    values, reach = field.displacement_bounds(centres, halves)
    moved = field.displacement(flat).reshape(points.shape)
    assert np.all(np.abs(moved - values[:, None]) <= reach[:, None] + 1e-9)


@pytest.mark.parametrize("name", KERNELS)
def test_no_point_of_a_ball_leaves_its_enclosure(name: str) -> None:
    rng = np.random.default_rng(7)
    field = random_field(name, rng)
    for size in (0.01, 2.0, 15.0):
        centres = boxes(field, rng, size)[0]
        radii = rng.uniform(0.0, size, len(centres))
        directions = rng.normal(size=(len(centres), 60, 3))
        directions /= np.linalg.norm(directions, axis=2, keepdims=True)
        points = centres[:, None] + directions * radii[:, None, None] * rng.uniform(0.0, 1.0, (1, 60, 1)) ** (1 / 3)
        gradients = field.gradient(points.reshape(-1, 3)).reshape(*points.shape, 3)
        matrices, spread = field.gradient_ball_bounds(centres, radii)
        assert np.all(np.linalg.norm(gradients - matrices[:, None], 2, axis=(2, 3)) <= spread[:, None] + 1e-9)
        strains = np.linalg.eigvalsh(0.5 * (gradients + gradients.swapaxes(2, 3)))
        ranges, _ = field.strain_ball_bounds(centres, radii)
        assert np.all(strains[..., 0].min(axis=1) >= ranges[:, 0] - 1e-9)
        assert np.all(strains[..., -1].max(axis=1) <= ranges[:, 1] + 1e-9)


@pytest.mark.parametrize("name", KERNELS)
def test_gradients_bounded_in_one_pass_with_the_strain_are_those_bounded_alone(name: str) -> None:
    rng = np.random.default_rng(8)
    field = random_field(name, rng)
    cases = [(boxes(field, rng, size)[0], size) for size in (0.01, 2.0, 15.0)]
    for centres, size in [*cases, (np.full((1, 3), 1e200), 1e180)]:  # the last overflows
        radii = rng.uniform(0.0, size, len(centres))
        found = field.ball_bounds(centres, radii)
        for one, other in zip(found[:2], field.gradient_ball_bounds(centres, radii), strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("offset", [0.0, 3000.0])
@pytest.mark.parametrize("name", KERNELS)
def test_rounding_is_enclosed_at_single_points(name: str, offset: float) -> None:
    """Boxes of no size: the enclosure is wider than the rounding of cancelling sums, measured in extended precision."""
    rng = np.random.default_rng(3)
    field = random_field(name, rng, m=200, offset=offset)
    field = field.scaled(1e3)
    points = rng.uniform(-60.0, 60.0, (200, 3)) + offset
    points[:50] = field.centres[:50] + rng.normal(size=(50, 3)) * 10.0 ** rng.uniform(-6, 0, (50, 1))
    matrices, radii = field.gradient_bounds(points, np.zeros_like(points))
    off = np.sqrt(((Long(matrices) - gradient_in_long(field, points)) ** 2).sum(axis=(1, 2)))
    assert np.all(off <= radii)
    assert np.median(radii) < 3e-5  # of gradients around 1000


@pytest.mark.parametrize("name", KERNELS)
def test_small_boxes_away_from_centres_are_enclosed_tightly(name: str) -> None:
    rng = np.random.default_rng(11)
    field = random_field(name, rng)
    centres = rng.uniform(-50.0, 50.0, (400, 3))
    centres = centres[np.linalg.norm(centres[:, None] - field.centres, axis=2).min(axis=1) > 5.0]
    halves = np.full_like(centres, 0.02)
    points = points_in(centres, halves, field, rng)
    gradients = field.gradient(points.reshape(-1, 3)).reshape(*points.shape, 3)
    matrices, radii = field.gradient_bounds(centres, halves)
    sampled = np.linalg.norm(gradients - matrices[:, None], 2, axis=(2, 3)).max(axis=1)
    moving = sampled > 1e-6  # compact kernels have regions of no gradient at all
    assert np.median(radii[moving] / sampled[moving]) < 1.3
    assert np.all(radii[moving] < 2.5 * sampled[moving])
    ranges, middles = field.strain_bounds(centres, halves, enough=TIGHT)
    strains = np.linalg.eigvalsh(0.5 * (gradients + gradients.swapaxes(2, 3)))
    np.testing.assert_allclose(ranges[:, 0], strains[..., 0].min(axis=1), rtol=0, atol=2e-4)
    np.testing.assert_allclose(ranges[:, 1], strains[..., -1].max(axis=1), rtol=0, atol=2e-4)
    exact = np.linalg.eigvalsh(0.5 * (field.gradient(centres) + field.gradient(centres).swapaxes(1, 2)))
    np.testing.assert_allclose(middles, exact[:, [0, -1]], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", SCALARS)
def test_plane_fields_are_enclosed_with_their_own_eigenvalues(name: str) -> None:
    rng = np.random.default_rng(5)
    field = random_field(name, rng, n=2)
    for width in (0.0, 0.5, 10.0):
        centres, halves = boxes(field, rng, width)
        points = points_in(centres, halves, field, rng)
        flat = points.reshape(-1, 2)
        known = np.linalg.norm(flat[:, None] - field.centres, axis=2).min(axis=1).reshape(points.shape[:2]) > 1e-9
        gradients = field.gradient(flat).reshape(*points.shape, 2)
        matrices, radii = field.gradient_bounds(centres, halves)
        deviations = np.linalg.norm(gradients - matrices[:, None], 2, axis=(2, 3))
        assert np.all(np.where(known, deviations, 0.0) <= radii[:, None] + 1e-9)
        strains = np.linalg.eigvalsh(0.5 * (gradients + gradients.swapaxes(2, 3)))
        ranges, _ = field.strain_bounds(centres, halves, enough=TIGHT)
        assert np.all(np.where(known, strains[..., 0], np.inf) >= ranges[:, :1] - 1e-9)
        assert np.all(np.where(known, strains[..., 1], -np.inf) <= ranges[:, 1:] + 1e-9)
        if width == 0.0:  # the missing third direction does not show
            single = known[:, 0] & (radii < 1e-6)
            assert single.sum() > 50
            np.testing.assert_allclose(ranges[single], strains[single, 0][:, [0, 1]], rtol=0, atol=1e-6)


def test_kernel_r_jumps_by_its_weight() -> None:
    """Around one source of kernel r the enclosure is a ball of radius |w| around 0, however small the box."""
    field = RadialField(
        "r", 1.0, np.zeros((1, 3)), np.array([[0.3, 0.0, 0.0]]), np.zeros(3), np.zeros((3, 3)), np.zeros(3), 0, 0
    )
    matrices, radii = field.gradient_bounds(np.zeros((1, 3)), np.full((1, 3), 1e-9))
    np.testing.assert_allclose(matrices, 0.0, rtol=0, atol=1e-15)
    np.testing.assert_allclose(radii, 0.3, rtol=1e-9, atol=0)
    ranges, middles = field.strain_bounds(np.zeros((1, 3)), np.full((1, 3), 1e-9), enough=TIGHT)
    np.testing.assert_allclose(ranges, [[-0.3, 0.3]], rtol=1e-9, atol=0)
    assert np.isnan(middles).all()


def test_isochoric_r3_strains_by_six_times_its_weight() -> None:
    field = RadialField(
        "isochoric-r3",
        1.0,
        np.zeros((1, 3)),
        np.array([[0.0, 0.1, 0.0]]),
        np.zeros(3),
        np.zeros((3, 3)),
        np.zeros(3),
        0,
        0,
    )
    ranges, _ = field.strain_bounds(np.zeros((1, 3)), np.full((1, 3), 1e-3), enough=TIGHT)
    np.testing.assert_allclose(ranges, [[-0.6, 0.6]], rtol=0.01, atol=0)


@pytest.mark.parametrize("name", KERNELS)
def test_no_derivative_of_a_kernel_exceeds_its_majorant(name: str) -> None:
    """N1 to N4 against differences of one source's gradient along random directions, in extended precision."""
    rng = np.random.default_rng(17)
    kernel = KERNELS[name]
    scale = 1.0
    table, extent = kernel.proved().majorants, kernel.proved().extent
    step = Long(2.0) ** -9
    # Fourth-order differences of the gradient along e, of order 0 to 3.
    stencils = (
        np.array([0, 0, 0, 1, 0, 0, 0]),
        np.array([0, 1, -8, 0, 8, -1, 0]) / Long(12),
        np.array([0, -1, 16, -30, 16, -1, 0]) / Long(12),
        np.array([1, -8, 13, 0, -13, 8, -1]) / Long(8),
    )
    largest = np.zeros(4)
    for r in (0.2, 0.35, 0.5, 0.8, 1.7):
        for _ in range(150):
            w, e, x = (v / np.linalg.norm(v) for v in rng.normal(size=(3, 3)))
            field = RadialField(
                name, scale, np.zeros((1, 3)), w[None], np.zeros(3), np.zeros((3, 3)), np.zeros(3), 0, 0
            )
            h = step * r / 4
            line = Long(r) * Long(x) + np.arange(-3, 4)[:, None] * h * Long(e)
            gradients = gradient_in_long(field, line)
            for order, stencil in enumerate(stencils):
                if order == 3 and not kernel.isochoric and table.shape[1] > 1:
                    continue  # not tabulated
                if name == "r2logr" and order < 2:
                    continue  # no power of the distance
                if kernel.compact and abs(r - 1.0) < 0.1:
                    continue
                matrix = np.asarray(np.tensordot(stencil, gradients, axes=1) / h**order, dtype=np.float64)
                sizes = np.linalg.norm(0.5 * (matrix + matrix.T), 2), np.linalg.norm(matrix, 2)
                rho = np.sqrt(r**2 + 1.0) if name == "isochoric-r3-mollified" else r
                if table.shape[1] > 1:
                    cell = min(int(r / extent * (table.shape[1] - 1)), table.shape[1] - 1)
                    bounds = table[order, cell], table[4 + order, cell]
                else:
                    power = {"r2logr": 1, "r3": 2, "isochoric-r5": 2}.get(name, 0) - order
                    bounds = table[order, 0] * rho**power, table[4 + order, 0] * rho**power
                assert sizes[0] <= bounds[0] * (1 + 1e-6) + 1e-12, (order, r)
                assert sizes[1] <= bounds[1] * (1 + 1e-6) + 1e-12, (order, r)
                largest[order] = max(largest[order], sizes[0] / max(bounds[0], 1e-300))
    first = 2 if name == "r2logr" else 0
    last = 3 if not kernel.isochoric and table.shape[1] > 1 else 4
    assert np.all(largest[first:last] > 0.5)  # and the majorants are worth something


def test_eigenvalue_floor_is_below_and_close() -> None:
    rng = np.random.default_rng(23)
    for k in range(3000):
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        values = rng.normal(size=3) * 10.0 ** rng.uniform(-6, 6)
        if k % 3 == 0:
            values[1] = values[0] * (1 + rng.choice([0.0, 1e-15, 1e-9]))
        if k % 10 == 0:
            values[:] = values[0]
        matrix = q @ np.diag(values) @ q.T
        a = 0.5 * (matrix + matrix.T)
        floor = eigenvalue_floor(a[0, 0], a[1, 1], a[2, 2], a[0, 1], a[0, 2], a[1, 2])
        exact = np.linalg.eigvalsh(a)[0]
        size = np.abs(a).sum()
        assert floor <= exact + 1e-15 * size
        assert floor >= exact - 1e-7 * size
    assert eigenvalue_floor(np.nan, 0.0, 0.0, 0.0, 0.0, 0.0) == -np.inf
    assert eigenvalue_floor(0.0, 0.0, 0.0, 0.0, 0.0, 0.0) <= 0.0


@pytest.mark.parametrize("name", KERNELS)
def test_boxes_without_bounds_prove_nothing(name: str) -> None:
    """Overflow gives infinite ranges, never NaN that could pass for a proof."""
    field = random_field(name, np.random.default_rng(1))
    field = replace(field, weights=np.full_like(field.weights, 1e290), linear=np.full((3, 3), 1e308))
    ranges, _ = field.strain_bounds(np.zeros((2, 3)), np.full((2, 3), 1e160), enough=WHOLE)
    assert not np.any(ranges[:, 0] > -1e200)
    assert not np.any(ranges[:, 1] < 1e200)


def test_a_fitted_field_reproduces_its_affine_part_with_no_spread() -> None:
    rng = np.random.default_rng(2)
    at = rng.uniform(-50, 50, (30, 3))
    field = RadialBackend("r3").fit(at, at @ np.array([[0.1, 0.2, 0.0], [0.0, -0.1, 0.0], [0.0, 0.3, 0.2]]).T)
    _, radii = field.gradient_bounds(np.zeros((1, 3)), np.full((1, 3), 40.0))
    assert radii[0] < 1e-9


def test_boxes_of_the_wrong_shape_are_named() -> None:
    field = random_field("r", np.random.default_rng(0))
    with pytest.raises(FieldError, match=r"needs \(B, 3\) of both"):
        field.gradient_bounds(np.zeros((2, 2)), np.zeros((2, 2)))
    with pytest.raises(FieldError, match="half widths"):
        field.gradient_bounds(np.zeros((2, 3)), np.full((2, 3), -1.0))
