"""What to do about a failed check: none lacks it, and every key, command and option that is named exists."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest

from musclefit.cli.commands import app
from musclefit.flow.deformation import Status
from musclefit.report import next_steps
from musclefit.report.html import render_html
from musclefit.report.model import checks_against
from musclefit.report.schema import to_json
from musclefit.rig.rig_table import known_keys
from musclefit.rig.settings import Limits
from musclefit.validate.model import BoneFieldCheck, Check, MeshRefinement
from musclefit.vocabulary import Purpose

HELD = BoneFieldCheck(4.0, 100, 10, 0.001, 0.002, 0.1)


def sentences():
    """Every text of the module."""
    texts = [text for name, text in vars(next_steps).items() if name.isupper() and isinstance(text, str)]
    return [*texts, *next_steps.NOT_CONVERGED.values()]


def step_of(name, side, limits=None):
    (step,) = [check.next_step for check in checks_against(limits or Limits(), side) if check.name == name]
    return step


def test_a_check_cannot_be_made_without_a_next_step():
    with pytest.raises(TypeError, match="next_step"):
        Check("new check", 0.0, 0.0, "")  # type: ignore[call-arg]
    with pytest.raises(ValueError, match="'new check' does not say what to do"):
        Check("new check", 0.0, 0.0, "", next_step=" ")


@pytest.mark.parametrize("text", sentences())
def test_every_key_command_and_option_named_exists(text):
    keys = re.findall(r"\b(?:anatomy|drive|deformer|bones|surfaces|certificate|tets|mesh|limits)\.\w+", text)
    assert set(keys) <= set(known_keys())
    commands = re.findall(r"\bmusclefit ([a-z][a-z-]+) [A-Z]", text)
    assert set(commands) <= set(app)
    options = re.findall(r"(--[a-z-]+)", text)
    known = {
        name
        for command in app
        if not command.startswith("-")
        for argument in app[command].assemble_argument_collection()
        for name in argument.names
    }
    assert set(options) <= known


def test_every_sentence_says_what_to_set_or_run():
    whole = [text for text in sentences() if text.endswith(".")]
    assert len(whole) >= 25
    for text in whole:
        acts = r"\b(Set|Run|Repair|Name|Remove|Give|Stay|Inspect|Correct|Install|Find|Leave|report)\b"
        assert re.match(rf".*{acts}", text), text
        assert len(re.findall(r"[.] [A-Z]", text)) == 0, f"more than one sentence: {text}"


def test_every_way_to_end_early_has_its_own(make_side):
    early = [status for status in Status if status not in (Status.CONVERGED, Status.ONE_SHOT)]
    steps = {step_of("not converged", make_side(status=status.value)) for status in early}
    assert len(steps) == len(early)
    assert "max_steps" in step_of("not converged", make_side(status=Status.OUT_OF_STEPS.value))
    assert "held to a rule" in step_of("not converged", make_side(status=Status.ONE_SHOT.value))


def test_what_bones_need_depends_on_what_moves_them(make_side, make_tissue):
    driven = make_side(tissues=(make_tissue("ulna", "bone", rigidity_mm=2.0),))
    free = make_side(tissues=(make_tissue("ulna", "bone", rigidity_mm=2.0, rigidity_reference="best fit"),))
    assert 'deformer.method = "rigid-bones"' in step_of("bone off rigid", driven)
    assert "bones.keep_rigid" in step_of("bone off rigid", free)
    assert "Name the bone in the drive" in step_of("bone off rigid", replace(free, bones=HELD))


def test_what_muscles_need_depends_on_the_kernel_and_on_what_moves_bones(make_side, make_tissue):
    assert step_of("muscle volume change", make_side()) == next_steps.MUSCLES_CHANGE
    free = make_side(tissues=(make_tissue("biceps", "muscle"),))
    assert 'limits.purpose = "another-body"' in step_of("muscle volume change", free)
    isochoric = make_side(method="implicit midpoint RBF, kernel isochoric-r3")
    assert "deformer.min_steps" in step_of("muscle volume change", isochoric)


def test_landmarks_that_miss_because_the_run_ended_early_are_told_so(make_side):
    assert "Find out why" in step_of("landmark error", make_side(status=Status.STALLED.value))
    assert "smoothing" in step_of("landmark error", make_side())


def test_what_ended_the_mending_of_tets_is_told(make_side):
    refinement = MeshRefinement(3, 9, 900, 2, 0, (), stopped="mesh.max_rounds")
    mesh = replace(make_side().mesh, inverted=2, refinement=refinement)
    assert step_of("inverted tets", make_side(mesh=mesh)).endswith("; mending stopped at mesh.max_rounds.")


def test_json_and_page_say_what_to_do(make_report, make_side, make_tissue):
    side = make_side(tissues=(make_tissue("biceps", "muscle", volume_change_percent=9.0),))
    report = make_report(result=side)
    (failed,) = [check for check in to_json(report)["checks"] if not check["passed"]]
    assert failed["next_step"] == next_steps.MUSCLES_CHANGE_FREELY
    page = render_html(report, pictures={})
    assert "Next: Set deformer.kernel" in page
    assert "Next:" not in render_html(make_report(), pictures={})


# --- limits by purpose

ANOTHER = Limits(Purpose.ANOTHER_BODY, bone_rigidity_mm=None, muscle_volume_percent=None)


def changed(make_side, make_tissue, *, kept=0.0, **more):
    """Another body: one bone that is kept and one that bends, and a muscle that grows."""
    tissues = (
        make_tissue("biceps", "muscle", volume_change_percent=80.0),
        make_tissue("humerus", "bone", rigidity_mm=kept),
        make_tissue("ulna", "bone", rigidity_mm=7.0, rigidity_reference="best fit"),
    )
    return make_side(tissues=tissues, **more)


def test_another_body_is_told_and_not_failed(make_report, make_side, make_tissue):
    report = make_report(result=changed(make_side, make_tissue), limits=ANOTHER, purpose_because="a cage drives")
    assert report.verdict == "passed"
    found = {check["name"]: check for check in to_json(report)["checks"]}
    assert (found["muscle volume change"]["value"], found["muscle volume change"]["limit"]) == (80.0, None)
    assert (found["bone off rigid"]["value"], found["bone off rigid"]["place"]) == (7.0, "ulna")
    said = to_json(report)["limits"]
    assert (said["purpose"], said["because"], said["bone_rigidity_mm"]) == ("another-body", "a cage drives", None)
    assert isinstance(said["inverted_tets"], int)
    page = render_html(report, pictures={})
    assert "Measured without a limit: bone off rigid, muscle volume change." in page
    assert "for another body, because a cage drives; no limit on the bending of free bones and the volume" in page
    assert 'td class="n off"' not in page


@pytest.mark.parametrize(("off_mm", "verdict"), [(0.005, "passed"), (0.02, "failed")])
def test_bones_that_are_kept_stay_held_against_theirs(make_report, make_side, make_tissue, off_mm, verdict):
    side = changed(make_side, make_tissue, kept=off_mm, bones=HELD)
    report = make_report(result=side, limits=ANOTHER)
    found = {check.name: check for check in report.checks}
    assert report.verdict == verdict
    assert (found["bone off rigid"].place, found["bone off rigid"].limit) == ("humerus", 0.01)
    assert (found["free bone off rigid"].place, found["free bone off rigid"].limit) == ("ulna", math.inf)


def test_numbers_win_over_the_purpose(make_report, make_side, make_tissue):
    limits = replace(ANOTHER, bone_rigidity_mm=5.0, muscle_volume_percent=100.0)
    report = make_report(result=changed(make_side, make_tissue, bones=HELD), limits=limits)
    assert [check.name for check in report.checks if not check.passed] == ["bone off rigid"]


def test_what_cannot_be_measured_fails_without_a_limit_too(make_report, make_side, make_tissue):
    side = make_side(tissues=(make_tissue("biceps", "muscle", volume_change_percent=math.nan),))
    report = make_report(result=side, limits=ANOTHER)
    assert [check.name for check in report.checks if not check.passed] == ["muscle volume change"]
    assert "muscle volume change: not measured (biceps)" in render_html(report, pictures={})
