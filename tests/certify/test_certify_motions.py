"""The safe part of a straight motion: analytic cases, rational sampling that tries to break it, and exactness."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tet_blocks import block

from musclefit.certify.motions import DEPTH, largest_safe_fraction, positive_throughout
from musclefit.errors import MeshError

CORNER = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
ONE_TET = np.array([[0, 1, 2, 3]])


def rational_volume(start: np.ndarray, end: np.ndarray, at: Fraction) -> Fraction:
    """Six times the volume on the way, the oracle."""
    corners = [
        [(1 - at) * Fraction(float(x)) + at * Fraction(float(y)) for x, y in zip(p, q, strict=True)]
        for p, q in zip(start, end, strict=True)
    ]
    u, v, w = ([y - x for x, y in zip(corners[0], other, strict=True)] for other in corners[1:])
    return u[0] * (v[1] * w[2] - v[2] * w[1]) - u[1] * (v[0] * w[2] - v[2] * w[0]) + u[2] * (v[0] * w[1] - v[1] * w[0])


def turned(degrees: float) -> np.ndarray:
    angle = np.radians(degrees)
    turn = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    return CORNER @ np.array(turn).T


@pytest.mark.parametrize(("height", "fraction"), [(-1.0, 0.5), (-3.0, 0.25), (0.0, 1.0), (0.5, 1.0)])
def test_an_apex_that_goes_through_its_base_stops_there(height: float, fraction: float) -> None:
    end = CORNER.copy()
    end[3, 2] = height
    found = largest_safe_fraction(CORNER, end, ONE_TET)
    assert abs(found.fraction - fraction) <= 2.0**-DEPTH
    assert found.tet == (0 if height <= 0 else -1)


def test_a_turn_is_safe_below_half_a_turn_and_stops_in_the_middle_of_one() -> None:
    assert largest_safe_fraction(CORNER, turned(179.0), ONE_TET).fraction == 1.0
    end = CORNER * (-1, -1, 1)  # exactly half a turn: the volume is (1 - 2t)^2 and touches 0 without a change of sign
    found = largest_safe_fraction(CORNER, end, ONE_TET)
    assert 0.5 - 2.0**-DEPTH <= found.fraction < 0.5
    assert found.tet == 0


def test_a_tet_that_is_flat_at_the_start_allows_nothing() -> None:
    flat = CORNER * (1, 1, 0)
    assert largest_safe_fraction(flat, CORNER, ONE_TET).fraction == 0.0


def test_one_ulp_through_the_base_at_the_end_is_seen() -> None:
    start = np.array([[0.1, 0.2, 0.3], [7.3, 0.2, 0.3], [0.1, 9.7, 0.3], [2.2, 3.3, 4.3]])
    for height, safe in ((np.nextafter(0.3, 1.0), True), (0.3, False), (np.nextafter(0.3, 0.0), False)):
        end = start.copy()
        end[3, 2] = height
        found = largest_safe_fraction(start, end, ONE_TET)
        assert (found.tet == -1) == safe
        assert found.fraction >= 1.0 - 2.0 * 2.0**-DEPTH


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.3, 1.0, 3.0]))
def test_no_rational_time_before_the_fraction_is_inverted_and_just_after_it_the_proof_ends(
    seed: int, size: float
) -> None:
    rng = np.random.default_rng(seed)
    start = CORNER + rng.uniform(-0.2, 0.2, (4, 3))
    end = start + rng.uniform(-size, size, (4, 3))
    found = largest_safe_fraction(start, end, ONE_TET)
    safe = Fraction(found.fraction)
    for k in range(60):
        assert rational_volume(start, end, safe * k / 60) > 0
    if found.tet >= 0:  # a root, or a double one, is within the resolution: the volume there is next to nothing
        after = [safe + Fraction(step, 2**DEPTH) for step in (0, 1, 2)]
        assert min(rational_volume(start, end, t) for t in after) < Fraction(1, 2**20)


def test_the_first_tet_to_turn_is_named() -> None:
    mesh = block((3, 3, 3))
    end = np.array(mesh.vertices)
    end[21] += (0.0, 0.0, 1.7)
    end[42] += (0.0, 2.9, 0.0)
    found = largest_safe_fraction(mesh.vertices, end, mesh.tets)
    each = [largest_safe_fraction(mesh.vertices, end, tet[None]).fraction for tet in mesh.tets]
    assert found.fraction == min(each) == each[found.tet]
    assert 0.2 < found.fraction < 0.6


def test_floating_point_proves_what_is_far_from_turning_and_nothing_else() -> None:
    mesh = block((3, 3, 3))
    assert positive_throughout(mesh.vertices, 1.5 * mesh.vertices, mesh.tets).all()
    assert not positive_throughout(mesh.vertices, -mesh.vertices, mesh.tets).any()
    assert largest_safe_fraction(1e-160 * mesh.vertices, 2e-160 * mesh.vertices, mesh.tets).fraction == 1.0


def test_positions_must_fit_and_be_finite() -> None:
    with pytest.raises(MeshError, match=r"starts at positions of shape \(4, 3\) and ends at \(3, 3\)"):
        largest_safe_fraction(CORNER, CORNER[:3], ONE_TET)
    with pytest.raises(MeshError, match="not finite"):
        largest_safe_fraction(CORNER, CORNER + np.inf, ONE_TET)
