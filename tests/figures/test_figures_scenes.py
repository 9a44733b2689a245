"""Values that a page colours by: the stretch along muscles, on maps where it is known."""

from __future__ import annotations

import numpy as np
import pytest

from musclefit.figures.scenes import lengthwise_stretch


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.6])
def test_what_is_scaled_is_stretched_by_its_scale(limb, factor):
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    posed = limb.with_vertices(factor * limb.vertices() @ turn + 5.0)
    found = lengthwise_stretch(limb, posed)
    known = ~np.isnan(found.values)
    assert np.allclose(found.values[known], factor, rtol=1e-12, atol=0)
    where = limb.slices()
    for name in ("biceps", "triceps"):
        assert known[where[name]].mean() > 0.9
    for name in ("skin", "humerus"):
        assert not known[where[name]].any()


def test_lengthening_shows_at_the_belly_and_not_across(limb):
    """Twice as long at constant volume: 2 along the axis; where a line leans by an angle, by Pythagoras."""
    vertices = limb.vertices()
    posed = limb.with_vertices(vertices * [0.5**0.5, 0.5**0.5, 2.0])
    found = lengthwise_stretch(limb, posed).values
    where = limb.slices()["biceps"]
    belly = np.abs(vertices[where][:, 2]) < 6
    assert np.allclose(found[where][belly], 2.0, rtol=2e-3, atol=0)
    known = found[where][~np.isnan(found[where])]
    assert known.min() > np.sqrt(0.25 * 4 + 0.75 * 0.5) - 0.05  # a line that leans by 60 degrees
    assert known.max() < 2.0 + 1e-9


def test_triangles_without_area_and_flat_ends_are_left_out(limb):
    flat = limb.with_vertices(limb.vertices() * [1.0, 1.0, 1e-9])
    found = lengthwise_stretch(flat, limb).values
    assert np.isnan(found[limb.slices()["skin"]]).all()
    assert np.isfinite(found[limb.slices()["biceps"]]).any()
