"""The sign of a tet's volume is that of rational arithmetic, however flat the tet and wherever its corners."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from musclefit.errors import MeshError
from musclefit.geometry.tets.orientation import orientations, undecided_in_floating_point

ONE_TET = np.array([[0, 1, 2, 3]])


def rational_sign(corners: np.ndarray) -> int:
    """The oracle: fractions, nothing shared with the code under test."""
    (a, b, c, d) = [[Fraction(float(x)) for x in corner] for corner in corners]
    u, v, w = ([y - x for x, y in zip(a, other, strict=True)] for other in (b, c, d))
    det = u[0] * (v[1] * w[2] - v[2] * w[1]) - u[1] * (v[0] * w[2] - v[2] * w[0]) + u[2] * (v[0] * w[1] - v[1] * w[0])
    return (det > 0) - (det < 0)


def nearly_flat(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 4, 3) corners: the fourth is in the plane of the others but for rounding, or an ulp or two off."""
    corners = rng.uniform(-300.0, 300.0, (count, 4, 3))
    weights = rng.uniform(-1.0, 2.0, (count, 2))
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    corners[:, 3] = a + weights[:, :1] * (b - a) + weights[:, 1:] * (c - a)
    off = rng.integers(-2, 3, (count, 3))
    corners[:, 3] += off * np.spacing(corners[:, 3])
    return corners


def floating_signs(corners: np.ndarray) -> np.ndarray:
    """What a plain determinant says."""
    return np.sign(np.linalg.det(corners[:, 1:] - corners[:, :1])).astype(np.int64)


def wrong_signs(count: int, rng: np.random.Generator) -> tuple[int, int, int]:
    """Wrong signs of the predicate and of the plain determinant, and how many tets are exactly flat."""
    corners = nearly_flat(count, rng)
    truth = np.array([rational_sign(tet) for tet in corners])
    found = orientations(corners.reshape(-1, 3), np.arange(4 * count).reshape(-1, 4))
    return int((found != truth).sum()), int((floating_signs(corners) != truth).sum()), int((truth == 0).sum())


def test_no_sign_of_nearly_flat_tets_is_wrong_where_the_plain_determinant_often_lies() -> None:
    exact, floating, _ = wrong_signs(2_000, np.random.default_rng(1))
    assert exact == 0
    assert floating > 20


@pytest.mark.slow
def test_no_sign_is_wrong_among_a_million_nearly_flat_tets() -> None:
    rng = np.random.default_rng(2)
    counts = np.array([wrong_signs(100_000, rng) for _ in range(10)]).sum(axis=0)
    print(f"1000000 nearly flat tets: predicate {counts[0]} wrong, plain determinant {counts[1]}, flat {counts[2]}")
    assert counts[0] == 0
    assert counts[1] > 10_000


@pytest.mark.parametrize("scale", [1e-320, 1e-160, 1e-60, 1.0, 1e60, 1e150, 1e307])
def test_signs_survive_scales_at_which_products_vanish_or_overflow(scale: float) -> None:
    corners = nearly_flat(200, np.random.default_rng(3)) / 300.0 * scale
    assert np.isfinite(corners).all()
    found = orientations(corners.reshape(-1, 3), np.arange(800).reshape(-1, 4))
    np.testing.assert_array_equal(found, [rational_sign(tet) for tet in corners])


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=12, max_size=12))
def test_any_finite_positions_get_their_rational_sign(numbers: list[float]) -> None:
    corners = np.array(numbers).reshape(4, 3)
    assert orientations(corners, ONE_TET)[0] == rational_sign(corners)


@given(st.lists(st.integers(-3, 3), min_size=12, max_size=12), st.permutations(range(4)))
def test_exchanging_two_corners_turns_the_sign(numbers: list[int], order: list[int]) -> None:
    corners = np.array(numbers, dtype=np.float64).reshape(4, 3)
    parity = round(float(np.linalg.det(np.eye(4)[order])))
    assert orientations(corners, np.array([order]))[0] == parity * orientations(corners, ONE_TET)[0]


def test_one_ulp_through_the_opposite_face_is_seen() -> None:
    corners = np.array([[0.1, 0.2, 0.3], [7.3, 0.2, 0.3], [0.1, 9.7, 0.3], [2.2, 3.3, 0.3]])
    signs = []
    for height in (np.nextafter(0.3, 1.0), 0.3, np.nextafter(0.3, 0.0)):
        corners[3, 2] = height
        signs.append(int(orientations(corners, ONE_TET)[0]))
    assert signs == [1, 0, -1]


def test_tets_far_from_flat_need_no_integers() -> None:
    corners = np.random.default_rng(4).uniform(-300.0, 300.0, (4_000, 3))
    assert undecided_in_floating_point(corners, np.arange(4_000).reshape(-1, 4)).sum() == 0


def test_positions_that_are_not_finite_are_refused_by_number() -> None:
    corners = np.eye(4, 3)
    corners[2, 1] = np.nan
    with pytest.raises(MeshError, match="1 vertices are not finite, the first is number 2"):
        orientations(corners, ONE_TET)


def test_no_tets_have_no_signs() -> None:
    assert orientations(np.zeros((3, 3)), np.zeros((0, 4), np.int64)).shape == (0,)
