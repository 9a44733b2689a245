"""Pages of real anatomy: small enough to mail, and quick to open, drawn by software."""

from __future__ import annotations

from dataclasses import replace

import pytest
from browsers import page_of

from musclefit.figures.scenes import motion_scene
from musclefit.io.rig_names import find_rig
from musclefit.io.rigs import read_rig
from musclefit.pipeline.deformers import deform
from musclefit.pipeline.sequence import posed_job
from musclefit.progress import Silent
from musclefit.report.sequence_html import render_sequence
from musclefit.workflows.run import run
from musclefit.workflows.sequence import planned

pytestmark = [pytest.mark.slow, pytest.mark.anatomy, pytest.mark.usefixtures("anatomy_data")]

FOREARM_BYTES, LEG_BYTES, FIRST_FRAME_MS = 12e6, 40e6, 10_000


def first_frame_ms(page):
    return int(page.get_attribute("#viewer", "data-first-frame-ms"))


def test_the_page_of_a_forearm_with_seventy_surfaces(browser, tmp_path):
    run("forearm_rigid", out=tmp_path / "out", overrides=["certificate.enabled=false"], progress=Silent())
    path = tmp_path / "out" / "report.html"
    assert path.stat().st_size <= FOREARM_BYTES
    with page_of(browser, path) as page:
        assert page.locator("#layers .names input").count() == 70
        assert first_frame_ms(page) <= FIRST_FRAME_MS


def test_the_page_of_a_leg_in_sixty_frames(browser, tmp_path):
    """The motion by the paper's quick maps, which takes a minute and not an hour; what they fold is as hard to pack."""
    from test_report_sequence import frame, report

    job = read_rig(find_rig("leg_jump"), overrides=["deformer.method=yu2014", "compare.methods=[]"])
    plan, rest = planned(job), job.anatomy.vertices()
    frames = []
    for pose in plan.poses:
        made = deform(posed_job(job, pose), rest, progress=Silent()).deformation
        frames.append((pose.said, pose.time_s, job.anatomy.with_vertices(made(rest))))
    assert len(frames) == 60
    scene = motion_scene(job.anatomy, frames)
    assert scene.left_out == ()
    told = report(*(replace(frame(k, 0.0), time_s=pose.time_s) for k, pose in enumerate(plan.poses)))
    path = tmp_path / "report.html"
    path.write_text(render_sequence(told, pictures={}, scene=scene), encoding="utf-8")
    assert path.stat().st_size <= LEG_BYTES - 8e6, "leaves room for film and pictures, 5 MB on the leg"
    with page_of(browser, path) as page:
        page.focus("#time")
        page.keyboard.press("ArrowLeft")
        assert "of 60" in page.get_attribute("#time", "aria-valuetext")
