"""Views show everything, the right way up, and are the same every time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from musclefit.figures.camera import principal_views
from musclefit.figures.colours import FOLD, OVERLAP, tissue_colours


def _box(rng, size):
    return (rng.random((400, 3)) - 0.5) * size


def test_the_longest_extent_is_upright_and_the_first_view_is_the_broad_one():
    points = _box(np.random.default_rng(1), [30.0, 300.0, 80.0])
    front, side = principal_views(points)
    np.testing.assert_allclose(np.abs(front.up), [0, 1, 0], rtol=0, atol=0.02)
    np.testing.assert_allclose(np.abs(front.right), [0, 0, 1], rtol=0, atol=0.05)
    assert front.half_height_mm > front.half_width_mm > front.half_depth_mm
    np.testing.assert_allclose(side.half_width_mm, front.half_depth_mm, rtol=1e-12, atol=0)
    assert 0.9 * 80 / 300 < front.aspect < 1.1 * 80 / 300


def test_up_is_up_for_a_standing_body():
    points = _box(np.random.default_rng(2), [300.0, 200.0, 1700.0])
    for view in principal_views(points) + principal_views(points * [1, -1, 1] + 500):
        assert view.up[2] > 0.99


@given(
    arrays(np.float64, st.tuples(st.integers(1, 12), st.just(3)), elements=st.floats(-1e3, 1e3, width=32)),
    st.floats(0.3, 3.0),
)
def test_every_point_is_in_the_panel_whatever_its_shape(points, panel_aspect):
    for view in principal_views(points):
        axes = np.stack([view.right, view.up, view.towards])
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), rtol=0, atol=1e-9)
        assert np.linalg.det(axes) == pytest.approx(1.0, abs=1e-9)
        seen = np.abs((points - view.centre) @ axes.T)
        scale = view.parallel_scale_mm(panel_aspect)
        assert scale > 0
        assert seen[:, 1].max() <= scale
        assert seen[:, 0].max() <= scale * panel_aspect


def test_each_muscle_has_a_red_of_its_own(limb):
    colours = tissue_colours(limb)
    assert set(colours) == {t.name for t in limb}
    muscles = [colours[t.name] for t in limb if t.kind == "muscle"]
    assert len(set(muscles)) == len(muscles) == 2
    for red, green, blue in muscles:
        assert red > 1.4 * max(green, blue)
    for loud in (FOLD, OVERLAP):
        assert min(np.linalg.norm(np.subtract(loud, other)) for other in colours.values()) > 0.5
