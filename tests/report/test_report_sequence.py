"""Reports of sequences: the worst frame speaks for all, refused frames fail, the page escapes names, curves fit."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from xml.etree import ElementTree

import pytest

from musclefit.report.curves import curves
from musclefit.report.sequence import (
    BetweenSummary,
    FrameSummary,
    PassageSummary,
    SequenceReport,
    measures_table,
    sequence_to_json,
    summary_of,
)
from musclefit.report.sequence_html import render_sequence
from musclefit.validate.model import Check
from musclefit.validate.muscles import MuscleMeasures

NAME = 'muscle_<b>"x"'


def frame(number: int, landmark: float, *, gap: float | None = 0.5) -> FrameSummary:
    muscle = MuscleMeasures(NAME, 100.0 + number, 50.0, 20.0 - number, 300.0, gap, "bone_a" if gap else None)
    return FrameSummary(
        number=number,
        time_s=0.5 * number,
        pose_deg={"knee": 10.0 * number},
        outcome="made",
        problem="",
        checks=(
            Check("landmark error", landmark, 1e-6, "mm", "knee_1", next_step="Wait."),
            Check("bone off rigid", 0.002, 0.01, "mm", "femur", next_step="Hold it."),
        ),
        claim="certified",
        steps=4,
        method="implicit midpoint",
        off_rest_mm=0.0 if number == 0 else None,
        overlap_mm3=0.0,
        overlaps=(),
        muscles=(muscle,),
        volume_changes={NAME: float(number)},
        cpu_s={"frame": 1.5},
    )


def report(*frames: FrameSummary, between: tuple[BetweenSummary, ...] = ()) -> SequenceReport:
    limits = {"landmark_mm": 1e-6, "introduced_overlap_mm3": 1.0}
    return SequenceReport("A <motion>", "even", frames, between, limits, {"frames": 3.0}, {"version": "1"})


def test_the_worst_frame_speaks_for_all() -> None:
    made = report(frame(0, 1e-9), frame(1, 3e-7), frame(2, 2e-8))
    said = {check.name: check for check in made.checks}
    assert made.verdict == "passed"
    assert (said["landmark error"].value, said["landmark error"].place) == (3e-7, "frame 1 at 0.5 s: knee_1")
    assert report(frame(0, 1e-9), frame(1, float("nan")), frame(2, 1.0)).checks[2].value != 1.0
    assert report(frame(0, 1e-9), frame(1, 2e-6)).verdict == "failed"


def test_a_rest_pose_off_rest_fails() -> None:
    moved = replace(frame(0, 1e-9), off_rest_mm=1e-6)
    (check,) = [c for c in report(moved, frame(1, 1e-9)).checks if not c.passed]
    assert (check.name, check.limit, check.place) == ("rest pose off rest", 1e-9, "frame 0 at 0 s")


def test_refused_frames_and_hidden_passages_fail_and_are_named() -> None:
    refused = replace(frame(1, 0.0), outcome="refused", problem="bones 'a' and 'b' ... 2.5 mm deep", checks=())
    hidden = BetweenSummary(0, 1, (PassageSummary("muscle_a", "muscle_b", 0.31, 0.0, 0.0, "passes through"),), 100)
    seen = BetweenSummary(1, 2, (PassageSummary("muscle_a", "muscle_b", 0.7, 0.0, 3.0, "enters"),), 100)
    found = report(frame(0, 1e-9), refused, frame(2, 1e-9), between=(hidden, seen))
    failed = {check.name: check for check in found.checks if not check.passed}
    assert failed.keys() == {"refused frames", "passed through between frames"}
    assert "2.5 mm deep" in failed["refused frames"].place
    assert failed["passed through between frames"].value == 1.0
    assert "muscle_a / muscle_b at 0.31 s, between frames 0 and 1" in failed["passed through between frames"].place


def test_json_has_no_number_that_json_cannot_say() -> None:
    gone = BetweenSummary(0, 1, (PassageSummary("a", "b", 0.1, float("nan"), 0.0, "touching at the start"),), 7)
    text = json.dumps(sequence_to_json(report(frame(0, float("nan")), frame(1, 0.0), between=(gone,))), allow_nan=False)
    read = json.loads(text)
    assert read["frames"][0]["checks"][0]["value"] is None
    assert read["between"][0]["passages"][0]["overlap_before_mm3"] is None
    assert read["certified_frames"] == 2


GRAZE = PassageSummary("muscle_a", "bone_<b>", 0.3, 0.0, 0.0, "graze of coarse triangles", 3, 0.005, 1.5, 4000, 0.0)


def test_grazes_and_touches_are_told_and_do_not_fail() -> None:
    touch = PassageSummary("muscle_a", "muscle_b", 0.0, 2.0, 0.0, "touching at the start", note="in the frame before")
    between = (BetweenSummary(0, 1, (GRAZE, touch), 100), BetweenSummary(1, 2, (), 50))
    found = report(frame(0, 1e-9), frame(1, 1e-9), frame(2, 1e-9), between=between)
    assert found.verdict == "passed"
    said = sequence_to_json(found)["between"]
    assert [b["proved_free"] for b in said] == [False, True]
    graze, told = said[0]["passages"]
    assert (graze["kind"], graze["poses"], graze["chord_mm"], graze["longest_mm"]) == (GRAZE.kind, 3, 0.005, 1.5)
    assert (told["triangles"], told["chord_mm"], told["note"]) == (0, None, "in the frame before")
    assert (sequence_to_json(found)["proved_free_between"], sequence_to_json(found)["looked_closer_between"]) == (1, 1)
    page = render_sequence(found, pictures={})
    assert "1 of the 2 meetings were looked at with finer triangles" in page
    assert "Between 1 of 2 pairs of frames it is proved that none do" in page
    assert "3 poses on the way, 4000 triangles, edges up to 1.5 mm, chord tolerance 0.005 mm" in page
    assert "touching at the start: in the frame before" in page
    assert "bone_&lt;b&gt;" in page.replace("<wbr>", "")


def test_what_is_not_settled_fails_and_what_was_not_examined_is_not_proved_free() -> None:
    doubt = replace(GRAZE, kind="not settled", note="triangles still meet on the way")
    between = (BetweenSummary(0, 1, (doubt,), 100), BetweenSummary(1, 2, problem="no ipctk"))
    found = report(frame(0, 1e-9), frame(1, 1e-9), frame(2, 1e-9), between=between)
    failed = {check.name: check.place for check in found.checks if not check.passed}
    assert failed.keys() == {"not settled between frames", "not examined between frames"}
    assert "triangles still meet on the way" in failed["not settled between frames"]
    assert not any(b.proved_free for b in found.between)


@pytest.mark.parametrize(("overlap_mm3", "failed"), [(0.9, []), (1.1, ["introduced overlap between frames"])])
def test_what_enters_is_held_against_the_limit_for_overlap_in_every_pose(overlap_mm3: float, failed: list[str]) -> None:
    unknown = replace(GRAZE, most_overlap_mm3=float("nan"))
    deep = replace(GRAZE, kind="enters", most_overlap_mm3=overlap_mm3)
    between = (BetweenSummary(0, 1, (GRAZE, unknown, deep), 100),)
    found = report(frame(0, 1e-9), frame(1, 1e-9), between=between)
    assert [check.name for check in found.checks if not check.passed] == failed
    (check,) = [c for c in found.checks if c.name == "introduced overlap between frames"]
    assert (check.value, check.limit, check.unit) == (overlap_mm3, 1.0, "mm³")
    assert "between frames 0 and 1" in check.place


def test_measures_come_as_rows() -> None:
    rows = measures_table([frame(0, 0.0), frame(1, 0.0, gap=None)])
    assert rows[0][:4] == ["frame", "time_s", "muscle", "volume_mm3"]
    cells = [dict(zip(rows[0], row, strict=True)) for row in rows[1:]]
    assert [c["largest_section_mm2"] for c in cells] == ["20.0", "19.0"]
    assert [c["gap_mm"] for c in cells] == ["0.5", ""]
    assert [c["volume_change_percent"] for c in cells] == ["0.0", "1.0"]


def test_the_page_escapes_names_and_says_what_failed() -> None:
    refused = replace(frame(1, 0.0), outcome="refused", problem="bones <a> collide", checks=(), muscles=())
    page = render_sequence(report(frame(0, 1e-9), refused, frame(2, 2e-6)), pictures={}, problems="no screen")
    assert "A &lt;motion&gt;" in page
    assert "<b>" not in page
    assert "bones &lt;a&gt; collide" in page
    assert "✗ Failed" in page
    assert "no screen" in page
    assert page.count('<svg class="curves"') == 1 + 5


def test_curves_are_svg_whose_lines_meet_the_values() -> None:
    drawn = curves([0.0, 1.0, 2.0], {"a": [0.0, 10.0, 5.0], "b": [1.0, None, 1.0]}, unit="mm")
    root = ElementTree.fromstring(drawn)
    paths = {p[0].text: p.attrib["d"] for p in root.iter("path")}
    heights = [float(y) for y in re.findall(r"[ML][\d.]+ ([\d.]+)", paths["a"])]
    assert heights[1] < heights[2] < heights[0], "the larger the value, the higher the point"
    assert heights[2] == pytest.approx((heights[0] + heights[1]) / 2, abs=0.1)
    assert paths["b"].count("M") == 2
    assert curves([0.0, 1.0], {"a": [None, None]}, unit="mm") == ""


def test_a_refused_frame_is_read_back() -> None:
    record = {
        "number": 3,
        "time_s": 1.5,
        "pose_deg": {"ankle": -35.0},
        "outcome": "refused",
        "problem": "bones",
        "off_rest_mm": None,
        "result": None,
        "muscles": [],
        "cpu_s": {"frame": 0.2},
    }
    read = summary_of(record)
    assert (read.verdict, read.checks, read.muscles, read.claim) == ("failed", (), (), "")
