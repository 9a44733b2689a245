"""Pictures for print: their size, their scale, what is left out, and views that go round without a change of scale."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest
from PIL import Image
from tiny_rigs import TISSUES

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError
from musclefit.figures.camera import views_around
from musclefit.figures.renders import Look, Size, round_length_mm, still

SIZE = Size(40.0, 30.0, 150.0)
KINDS = {"skin": TissueKind.SKIN, "muscle_flexor": TissueKind.MUSCLE}


def limb() -> Anatomy:
    return Anatomy(tuple(Tissue(n, KINDS.get(n, TissueKind.BONE), s) for n, s in TISSUES.items()), frame="mm")


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(BytesIO(png)).convert("RGBA")).astype(int)


def drawn_box(png: bytes) -> tuple[int, int]:
    """Width and height in pixels of what is not background."""
    inked = pixels(png)[..., 3] > 128
    across, down = np.flatnonzero(inked.any(axis=0)), np.flatnonzero(inked.any(axis=1))
    return int(np.ptp(across)) + 1, int(np.ptp(down)) + 1


def test_a_still_has_the_size_and_the_scale_that_it_states() -> None:
    anatomy = limb()
    alone = Anatomy((anatomy["bone_distal"],), frame="mm")
    view = views_around(alone.vertices(), count=4)[0]
    made = still(alone, view, size=SIZE, look=Look(transparent=True, scale_bar=False))
    picture = Image.open(BytesIO(made.png))
    assert picture.size == SIZE.pixels == (236, 177)
    assert picture.info["dpi"] == pytest.approx((150.0, 150.0), rel=1e-3)
    extents = np.ptp(alone["bone_distal"].surface.vertices @ np.stack([view.right, view.up]).T, axis=0)
    wide, high = drawn_box(made.png)
    assert wide * made.mm_per_px == pytest.approx(extents[0], abs=2.5 * made.mm_per_px)
    assert high * made.mm_per_px == pytest.approx(extents[1], abs=2.5 * made.mm_per_px)


def test_the_scale_bar_is_as_long_as_it_says() -> None:
    anatomy = limb()
    view = views_around(anatomy.vertices(), count=4)[0]
    bare = still(anatomy, view, size=SIZE, look=Look(scale_bar=False))
    made = still(anatomy, view, size=SIZE, look=Look())
    assert made.bar_mm == 20.0
    changed = (pixels(made.png) != pixels(bare.png)).any(axis=2)
    longest = max(int(row.sum()) for row in changed)
    assert longest * made.mm_per_px == pytest.approx(20.0, abs=1.5 * made.mm_per_px)
    assert bare.bar_mm == 0.0


def test_views_go_round_at_one_scale_and_show_all() -> None:
    points = limb().vertices() + np.array([100.0, -50.0, 30.0])
    views = views_around(points, count=7)
    assert len({(view.half_width_mm, view.half_height_mm) for view in views}) == 1
    turns = [np.degrees(np.arccos(np.clip(views[0].right @ view.right, -1, 1))) for view in views]
    np.testing.assert_allclose(turns, [min(a, 360 - a) for a in 360 * np.arange(7) / 7], rtol=0, atol=1e-5)
    for view in views:
        off = (points - view.centre) @ np.stack([view.right, view.up]).T
        assert (np.abs(off) <= np.array([view.half_width_mm, view.half_height_mm]) + 1e-9).all()
        np.testing.assert_allclose(np.cross(view.right, view.up), view.towards, rtol=0, atol=1e-12)


def test_skin_and_values_change_what_is_seen() -> None:
    anatomy = limb()
    view = views_around(anatomy.vertices(), count=4)[0]
    seen = drawn_box(still(anatomy, view, size=SIZE, look=Look(transparent=True, scale_bar=False, skin_opacity=1)).png)
    bare = drawn_box(still(anatomy, view, size=SIZE, look=Look(transparent=True, scale_bar=False, skin_opacity=0)).png)
    assert bare[1] < seen[1]
    values = {t.name: np.linspace(0.0, 3.0, len(t.surface.vertices)) for t in anatomy}
    look = Look(values=values, values_name="displacement, mm", scale_bar=False, skin_opacity=0)
    coloured = pixels(still(anatomy, view, size=SIZE, look=look).png)[..., :3]
    yellow = (np.abs(coloured - [253, 231, 37]).sum(axis=2) < 12).sum()
    assert yellow > 0, "the strip of colours ends in that of the largest value"


@pytest.mark.parametrize(
    ("size", "said"),
    [
        ((0.0, 10.0, 300.0), "width_mm = 0"),
        ((10.0, 10.0, float("nan")), "dpi = nan"),
        ((500.0, 10.0, 600.0), "11811 x"),
    ],
)
def test_sizes_that_cannot_be_drawn_are_refused(size: tuple[float, float, float], said: str) -> None:
    with pytest.raises(InputError, match=said):
        Size(*size)


def test_lengths_of_bars_are_round() -> None:
    assert [round_length_mm(x) for x in (1.0, 1.99, 2.0, 4.99, 5.0, 9.9, 10.0, 730.0)] == [1, 1, 2, 2, 5, 5, 10, 500]
