"""Cuts that free flat tets: at the place where their parts are closest, and none where a tet is not flat."""

from __future__ import annotations

import numpy as np
import pytest

from musclefit.geometry.tets.flatness import freeing_cut


def test_edges_that_pass_each_other_are_cut_where_they_do() -> None:
    corners = np.array([[-3, 0, 0], [1, 0, 0], [0.0, -1, 0.01], [0, 2, 0.01]])
    i, j, share = freeing_cut(corners) or pytest.fail("a sliver is flat")
    assert (i, j) == (0, 1)
    np.testing.assert_allclose(share, 0.75, rtol=1e-12)


def test_an_edge_is_cut_beside_the_corner_close_to_it() -> None:
    corners = np.array([[0, 0, 0], [4, 0, 0], [1, 0.02, 0.0], [2, 3, 1.0]])
    i, j, share = freeing_cut(corners) or pytest.fail("a corner at an edge is flat")
    assert (i, j) == (0, 1)
    np.testing.assert_allclose(share, 0.25, rtol=1e-2)


def test_a_face_is_cut_on_the_way_to_the_corner_over_it() -> None:
    corners = np.array([[0, 0, 0], [4, 0, 0], [2, 4, 0], [2, 1.3, 0.01]])
    i, j, share = freeing_cut(corners) or pytest.fail("a corner over a face is flat")
    assert {i, j} < {0, 1, 2}
    assert 0.3 < share < 0.7


def test_regular_tets_and_those_with_one_short_edge_are_not_cut() -> None:
    regular = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
    assert freeing_cut(regular) is None
    short = np.array([[0, 0, 0], [0, 0, 0.01], [1, 0, 0], [0, 1, 0.0]])
    assert freeing_cut(short) is None


def test_a_cut_moves_with_its_tet() -> None:
    rng = np.random.default_rng(1)
    corners = np.array([[-3, 0, 0], [1, 0, 0], [0.0, -1, 0.01], [0, 2, 0.01]])
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    first, second = freeing_cut(corners), freeing_cut(7.0 * corners @ turn.T + 50.0)
    assert first is not None
    assert second is not None
    np.testing.assert_allclose(first, second, rtol=1e-9)
