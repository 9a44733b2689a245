"""Pictures: folds and overlaps cannot be missed, panels agree, and no screen is a reason, not a crash."""

from __future__ import annotations

import sys
from io import BytesIO

import numpy as np
import pytest
import trimesh
from PIL import Image

from musclefit.errors import InputError
from musclefit.figures import stills as stills_module
from musclefit.figures.camera import principal_views
from musclefit.figures.colours import tissue_colours
from musclefit.figures.panels import Marks, Panel, determinant_panels, screenshot, tissue_panels
from musclefit.figures.rendering import rendering_problem, try_rendering
from musclefit.figures.stills import stills
from musclefit.geometry.meshes import TriMesh

HEIGHT = 240


@pytest.fixture
def screen():
    problem = rendering_problem()
    if problem:
        pytest.skip(problem)


def _pixels(png):
    return np.asarray(Image.open(BytesIO(png)).convert("RGB")).astype(float) / 255


def _count(png, colour):
    return int((np.abs(_pixels(png) - colour).max(axis=-1) < 0.25).sum())


MAGENTA, BLUE = (0.85, 0.0, 0.95), (0.0, 0.35, 1.0)


def _dets(anatomy, folded=()):
    dets = {t.name: np.ones(len(t.surface.vertices)) for t in anatomy if t.kind != "skin"}
    for name in folded:
        dets[name][:5] = [0.0, -1e-12, -50.0, np.nan, -np.inf]
    return dets


def _beside(anatomy):
    return {"One shot": (anatomy, Marks()), "Paper's loop": (anatomy, Marks())}


def test_pictures_of_a_run_show_every_panel(limb, screen):
    moved = limb.with_vertices(limb.vertices() * [1.0, 1.0, 1.2])
    found = stills(limb, moved, beside=_beside(limb), marks=Marks(_dets(moved)), height_px=HEIGHT)
    assert found.problem == ""
    assert [caption.split(":")[0] for caption in found.pictures] == [
        "All tissues, from the broad side",
        "All tissues, a quarter turn on",
        "Bones alone",
        "Local volume ratio det J",
    ]
    assert ": rest, one shot, paper's loop, result" in next(iter(found.pictures))
    for caption, png in found.pictures.items():
        picture = _pixels(png)
        panels = 1 if caption.startswith("Local") else 4
        height = HEIGHT if panels == 1 else round(HEIGHT * np.sqrt(3 / 4))  # no more pixels than three panels have
        assert picture.shape[0] == height
        for part in np.array_split(picture, panels, axis=1):
            inside = part.min(axis=-1) < 0.9
            assert inside[height // 2].any()
            assert part[:3].min() > 0.95
            assert part[-3:].min() > 0.95
        assert _count(png, MAGENTA) == _count(png, BLUE) == 0


def test_the_same_anatomy_looks_the_same_in_every_panel(limb, screen):
    png = next(iter(stills(limb, limb, beside=_beside(limb), height_px=HEIGHT).pictures.values()))
    below_titles = _pixels(png)[HEIGHT // 5 :]
    first, *others = np.array_split(below_titles, 4, axis=1)
    for other in others:
        np.testing.assert_allclose(other, first, rtol=0, atol=0.02)


def test_skin_is_translucent_and_muscles_are_seen_through_it(limb, screen):
    png = next(iter(stills(limb, limb, height_px=HEIGHT).pictures.values()))
    picture = _pixels(png)
    assert (picture[..., 0] - picture[..., 1] > 0.25).sum() > 200
    skin_alone = (np.abs(picture - picture[0, 0]).max(axis=-1) > 0.02) & (picture.min(axis=-1) > 0.75)
    assert skin_alone.sum() > 200


def test_a_single_fold_hidden_inside_is_seen_in_every_picture(limb, screen):
    marks = Marks(_dets(limb, folded=("humerus",)))
    found = stills(limb, limb, marks=marks, height_px=HEIGHT)
    for caption, png in found.pictures.items():
        if not caption.startswith("Bones"):
            assert _count(png, MAGENTA) >= 10, caption
    assert "folded places in magenta" in next(iter(found.pictures))


def test_folds_stay_loud_however_deep_and_kept_volume_is_quiet(limb, screen):
    front, _ = principal_views(limb.vertices())

    def picture(value):
        dets = {t.name: np.full(len(t.surface.vertices), value) for t in limb if t.kind != "skin"}
        return screenshot(determinant_panels((Panel("Result", limb, Marks(dets)),), front, height_px=HEIGHT))

    folded = [_count(picture(value), MAGENTA) for value in (0.0, -1e-300, -1e9, float("nan"))]
    assert min(folded) > 1000
    for value in (1e-9, 1.0, 2.0, 50.0):
        assert _count(picture(value), MAGENTA) == 0


def test_an_overlap_hidden_inside_is_seen(limb, screen):
    ball = trimesh.creation.icosphere(radius=4.0)
    solid = TriMesh(np.asarray(ball.vertices), np.asarray(ball.faces))
    found = stills(limb, limb, marks=Marks(overlaps=(solid,)), height_px=HEIGHT)
    assert _count(next(iter(found.pictures.values())), BLUE) >= 20
    assert "overlaps in blue" in next(iter(found.pictures))


def test_a_figure_is_given_unshown(limb, screen):
    front, _ = principal_views(limb.vertices())
    plotter = tissue_panels((Panel("Rest", limb),), front, colours=tissue_colours(limb), height_px=HEIGHT)
    assert not plotter._closed
    assert plotter.camera.parallel_projection
    plotter.close()


def test_no_rendering_is_a_reason_and_no_crash(limb, monkeypatch):
    monkeypatch.setattr(stills_module, "rendering_problem", lambda: "no OpenGL here")
    found = stills(limb, limb)
    assert (dict(found.pictures), found.problem) == ({}, "no OpenGL here")


@pytest.mark.parametrize(
    ("code", "told"),
    [
        ("import os; os.abort()", "killed by SIGABRT"),
        ("raise SystemExit('no picture')", "exit code 1: no picture"),
        ("import time; time.sleep(60)", "no picture within 2 s"),
    ],
)
@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX")
def test_a_renderer_that_dies_is_told_apart(code, told):
    problem = try_rendering((sys.executable, "-c", code), timeout_s=2.0)
    assert told in problem
    assert "libegl1" in problem


def test_a_renderer_that_works_has_no_problem():
    assert try_rendering((sys.executable, "-c", "pass"), timeout_s=60.0) == ""
    assert "could not be tried" in try_rendering(("/nonexistent/python",), timeout_s=1.0)


def test_different_tissues_and_wrong_determinants_are_refused(limb):
    from dataclasses import replace

    with pytest.raises(InputError, match=r"Result and rest have different tissues \(skin\)"):
        stills(limb, replace(limb, tissues=limb.tissues[1:]))
    with pytest.raises(InputError, match=r"'biceps' have shape \(3,\); give one for each of its 642 vertices"):
        stills(limb, limb, marks=Marks({"biceps": np.ones(3)}))
    with pytest.raises(InputError, match="no tissue is named 'tail'"):
        stills(limb, limb, marks=Marks({"tail": np.ones(3)}))
