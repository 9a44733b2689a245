"""Counterexamples name their places: what is proved of a ball is not told of a centre far from it."""

from __future__ import annotations

import numpy as np
import pytest
from attacks import grid
from map_campaign import outcome

from musclefit.certify.ball_covers import Cover
from musclefit.certify.folds import _midpoint_near
from musclefit.fields.protocol import Field
from musclefit.fields.radial import RadialBackend
from musclefit.vocabulary import Claim

EXTENT = 20.0


@pytest.fixture(scope="module")
def steep() -> Field:
    handles = np.concatenate([grid(-10.0 * np.ones(3), 10.0 * np.ones(3), 3), [[3.0, 0.0, 0.0], [-3.0, 0.0, 0.0]]])
    moves = np.zeros_like(handles)
    moves[-2:, 0] = 9.0, -9.0
    return RadialBackend("gaussian", 4.0).fit(handles, moves)


def test_a_midpoint_is_where_it_is_said_to_be_wherever_the_search_for_it_began(steep: Field) -> None:
    """The proof holds for wide balls as well, whose centres may be far from the midpoints."""
    rng = np.random.default_rng(0)
    found = []
    for start in rng.uniform(-6.0, 6.0, (150, 1, 3)):
        point = Cover(rng.uniform(-2.0, 2.0, (1, 3)), np.zeros(1))
        ball = _midpoint_near(steep, point, start)
        if np.isfinite(ball.radii).all():
            off = ball.points - 0.5 * steep.displacement(ball.points) - point.points
            found.append((float(ball.radii[0]), float(np.abs(off).max())))
    assert len(found) > 100
    np.testing.assert_array_less(found, 1e-9 * EXTENT)


@pytest.mark.parametrize("seed", [449])
def test_claims_of_the_campaign_that_were_wrong_once(seed: int) -> None:
    """449: refuted, with a second midpoint that was 1 mm from the place that was told, in a body of 13 m."""
    found = outcome(seed, max_boxes=60_000)
    assert found.wrong == ""
    assert found.claim == Claim.REFUTED.value
