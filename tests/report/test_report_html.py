"""The page: nothing from outside, every name escaped, every fault in sight."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from musclefit.anatomy.findings import Finding
from musclefit.errors import InputError
from musclefit.report.html import PNG_SIGNATURE, number, render_html, render_inspection, seconds
from musclefit.report.model import MeshReport, TissueSummary
from musclefit.validate.joint_ranges import JointRange, RangeEnd
from musclefit.validate.model import BoneOverlap, NotChecked, OverlapCheck, PairOverlap

HOSTILE = '"><script>alert(1)</script>&<img src=x onerror=alert(2)>{{ 7*7 }}'
PNG = PNG_SIGNATURE + b"rest"


class _Reader(HTMLParser):
    """Collects tags and text, and checks that tags close in order."""

    VOID = frozenset({"meta", "br", "img", "wbr", "link", "input", "hr"})

    def __init__(self, page):
        super().__init__()
        self.open, self.tags, self.sources, self.words = [], [], [], []
        self.feed(page)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href") and not value.startswith("#")]
        assert not [name for name, _ in attrs if name.startswith("on")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self):
        return re.sub(r"\s+", " ", "".join(self.words))


def test_a_page_needs_nothing_from_outside(make_report, make_side):
    page = render_html(make_report(baseline=make_side()), pictures={"Front": PNG, "Side": PNG})
    read = _Reader(page)
    assert len(read.sources) == 2
    assert all(source.startswith("data:image/png;base64,") for source in read.sources)
    assert not {"link", "iframe"} & set(read.tags)
    assert read.tags.count("script") == 1  # sorts and filters tables
    without_references = re.sub(r'<pre id="bibtex">.*?</pre>', "", page, flags=re.DOTALL)  # addresses as text
    assert not re.findall(r"url\(|@import|https?://", without_references)


def test_every_name_is_escaped(make_report, make_side, make_tissue):
    side = make_side(
        method=HOSTILE,
        status=HOSTILE,
        tissues=(make_tissue(HOSTILE, "muscle", volume_change_percent=9.0), make_tissue("b", "bone")),
        overlaps=OverlapCheck((PairOverlap(HOSTILE, "b", 0, 2, 2),), 1, (NotChecked(HOSTILE, HOSTILE),)),
        mesh=replace(make_side().mesh, inverted=1, inverted_by_tissue=((HOSTILE, 1),)),
        landmarks=replace(make_side().landmarks, worst=HOSTILE),
    )
    report = make_report(
        title=HOSTILE,
        result=side,
        baseline=side,
        paper_loop=side,
        findings=(Finding(HOSTILE, HOSTILE, HOSTILE),),
        timings_s={HOSTILE: 1.0},
        provenance={HOSTILE: [HOSTILE]},
    )
    read = _Reader(render_html(report, pictures={HOSTILE: PNG}, pictures_problem=HOSTILE))
    assert read.tags.count("script") == 1  # the page's own
    assert read.tags.count("img") == 1
    assert read.text.count("alert(1)") >= 12
    assert "{{ 7*7 }}" in read.text
    inspected = MeshReport(HOSTILE, HOSTILE, (TissueSummary(HOSTILE, "bone", 1, 1, 1.0, None),), (), side.overlaps)
    assert _Reader(render_inspection(inspected)).tags.count("script") == 1


def test_touching_bones_and_joint_ranges_are_shown(make_report, make_side):
    assert "How far the joints can turn" not in render_html(make_report(), pictures={})
    touching = BoneOverlap(HOSTILE, "ulna", 0.0, 0.5, 0.5, 0.2, 100.0, 0.6)
    elbow = JointRange("elbow", RangeEnd(-5.0, "limit"), RangeEnd(120.5, "bones", touching), (-5.0, 150.0), (HOSTILE,))
    free = JointRange("wrist", RangeEnd(-180.0, "not met"), RangeEnd(180.0, "not met"), (-math.inf, math.inf))
    side = make_side(overlaps=OverlapCheck((), 3, (), (touching,)))
    read = _Reader(render_html(make_report(result=side, joint_ranges=(elbow, free)), pictures={}))
    assert read.tags.count("script") == 1  # the page's own
    for words in ("Bones that touch in the pose", "120.5", "0.2 mm deep", "its limit", "nothing so far", "not closed"):
        assert words in read.text


def test_the_banner_says_passed_or_what_failed(make_report, make_side, make_tissue):
    assert "All 12 checks are within their limits." in _Reader(render_html(make_report(), pictures={})).text
    side = make_side(status="the step budget ran out", tissues=(make_tissue("ulna", "bone", rigidity_mm=2.5),))
    text = _Reader(render_html(make_report(result=side), pictures={})).text
    assert "not converged: the step budget ran out" in text
    assert "bone off rigid: 2.5\u00a0mm (ulna); the limit is 0.01\u00a0mm" in text.replace(" mm", "\u00a0mm")
    assert "Passed" not in text


def test_long_tables_fold_away_all_but_the_worst(make_report, make_side, make_tissue):
    tissues = tuple(make_tissue(f"muscle_{k}", "muscle", volume_change_percent=float(k)) for k in range(689))
    pairs = tuple(PairOverlap(f"a{k}", f"b{k}", 9.0, 9.0 + k, float(k)) for k in range(60))
    report = make_report(result=make_side(tissues=tissues, overlaps=OverlapCheck(pairs, 99, ())))
    page = render_html(report, pictures={})
    read = _Reader(page)
    assert page.count('<details class="more-rows">') == 2
    assert "664 more tissues" in read.text
    assert "35 more pairs" in read.text
    folded = page.index("664 more tissues")
    assert page.index("muscle_<wbr>688") < page.index("muscle_<wbr>664") < folded < page.index("muscle_<wbr>663")
    assert page.count("muscle_<wbr>0<") == 1


def test_what_is_missing_is_told(make_report, make_side, make_tissue):
    side = make_side(
        mesh=None,
        tissues=(make_tissue("m", "muscle", volume_change_percent=math.nan),),
        overlaps=OverlapCheck((), 0, (NotChecked("m", "crosses itself at 3 faces"),)),
    )
    text = _Reader(render_html(make_report(result=side), pictures={}, pictures_problem="no OpenGL library")).text
    for told in (
        "No pictures: no OpenGL library.",
        "no bone, no skin, no tetrahedra",
        "crosses itself at 3 faces",
        "muscle volume change: not measured (m)",
        "No pair of tissues overlaps.",
    ):
        assert told in text


def test_pairs_apart_at_rest_are_listed_first_then_the_largest_of_both_sides(make_report, make_side):
    grown, new = PairOverlap("g", "h", 10, 99, 80), (PairOverlap("a", "b", 0, 1, 1), PairOverlap("c", "d", 0, 5, 5))
    result = make_side(overlaps=OverlapCheck((grown, *new), 9, ()))
    baseline = make_side(overlaps=OverlapCheck((PairOverlap("e", "f", 0, 70, 70),), 9, ()))
    page = render_html(make_report(result=result, baseline=baseline), pictures={})
    section = page[page.index("<h2>Overlapping pairs") : page.index("<h2>Tissues")]
    assert re.findall(r'<td class="name">(.)</td><td class="name">(.)</td>', section) == [
        ("c", "d"),
        ("a", "b"),
        ("g", "h"),
        ("e", "f"),
    ]


def test_a_pair_is_marked_only_where_a_limit_is_broken(make_report, make_side):
    def marked(*pairs):
        page = render_html(make_report(result=make_side(overlaps=OverlapCheck(pairs, 9, ()))), pictures={})
        section = page[page.index("<h2>Overlapping pairs") : page.index("<h2>Tissues")]
        return re.findall(r'<td class="n bad">([^<]*)</td>', section)

    assert marked(PairOverlap("a", "b", 0, 0.4, 0.4), PairOverlap("c", "d", 0, 0.5, 0.5)) == []
    together = (PairOverlap("a", "b", 0, 0.6, 0.6), PairOverlap("c", "d", 0, 0.5, 0.5))  # 1 mm³ is allowed in all
    assert marked(*together, PairOverlap("g", "h", 10, 10, 0.0)) == ["0.6", "0.5"]


def test_chosen_settings_stand_apart_from_findings(make_report):
    chosen = Finding("bones.lattice", "chosen-setting", "bones.lattice: 3 mm, because bones are thin")
    text = _Reader(render_html(make_report(findings=(chosen,)), pictures={})).text
    assert "Nothing was found amiss in the input." in text
    assert "bones.lattice3 mm, because bones are thin" in text
    both = render_html(make_report(findings=(chosen, Finding("skin", "cut", "skin: 4 squares cut"))), pictures={})
    assert "skincut4 squares cut" in _Reader(both).text
    assert both.index("4 squares cut") < both.index("chosen from the anatomy") < both.index("because bones are thin")


def test_settings_are_told_in_lines(make_report):
    settings = {"pose": [["elbow", 75.0], ["forearm", 70.0]], "tets": True, "stops": [], "kinds": {}, "scale": None}
    report = make_report(provenance={"versions": {"python": "3.11"}, "settings": settings})
    text = _Reader(render_html(report, pictures={})).text
    for told in ("pose elbow 75, forearm 70", "tets yes", "stops none", "kinds none", "scale none"):
        assert told.replace(" ", "", 1) in text


def test_columns_are_result_then_the_papers_loop_then_one_shot(make_report, make_side, make_tissue):
    """On a narrow screen what comes first is seen without scrolling: the result."""

    def side(steps, change, introduced):
        muscle = make_tissue("biceps", "muscle", volume_change_percent=change)
        pair = PairOverlap("a", "b", 0.0, introduced, introduced)
        return make_side(
            steps=steps, tissues=(muscle,), overlaps=OverlapCheck((pair,), 1, ()), method=f"method {steps}"
        )

    report = make_report(result=side(31, 0.31, 0.031), paper_loop=side(22, 22.5, 2.25), baseline=side(1, 11.5, 1.15))
    page = render_html(report, pictures={})
    summary, pairs, tissues = (
        page[page.index(f"<h2>{title}") : page.index("</table>", page.index(f"<h2>{title}"))]
        for title in ("Summary", "Overlapping pairs", "Tissues, worst first")
    )
    heads = [re.sub(r"<[^>]+>", " ", head).strip() for head in re.findall(r"<th[^>]*>(.*?)</th>", summary)]
    assert heads[:5] == ["", "Result", "Limit", "Paper's loop", "One shot"]
    steps = summary[summary.index(">steps<") :]
    assert re.findall(r">(\d+)</td>", steps) == ["31", "22", "1"]
    assert pairs.index("0.031<") < pairs.index("2.25<") < pairs.index("1.15<")
    assert tissues.index("0.31<") < tissues.index("22.5<") < tissues.index("11.5<")
    text = _Reader(page).text
    assert "Paper's loop: method 22; converged, 22 steps, on the surfaces as given." in text
    assert "Held against the same limits, the paper's loop fails 2 of" in text
    alone = render_html(make_report(result=side(31, 0.31, 0.031), baseline=side(1, 11.5, 1.15)), pictures={})
    assert "aper's loop" not in alone


def test_a_picture_that_is_no_png_is_refused(make_report):
    with pytest.raises(InputError, match="'Front' is not a PNG"):
        render_html(make_report(), pictures={"Front": b"GIF89a"})


def test_inspection_lists_tissues_overlaps_and_findings():
    tissues = (TissueSummary("skin", "skin", 8, 12, 1234567.0, None), TissueSummary("b", "bone", 8, 12, 5.0, 3.0))
    overlaps = OverlapCheck((PairOverlap("skin", "b", 2.0, 2.0, 0.0),), 1, ())
    report = MeshReport("arm", "mm", tissues, (Finding("b", "cut", "b: 4 squares cut"),), overlaps)
    text = _Reader(render_inspection(report)).text
    for told in ("2 of 3 checks are beyond", "1 of 1 tested", "bcut4 squares cut", "outside skin: 3"):
        assert told in text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (-0.8, "−0.8"),
        (3.2e-8, "3.2 × 10⁻⁸"),
        (1234567.0, "1\u202f234\u202f567"),
        (0.99999, "1"),
        (9.99996, "10"),
        (999.96, "1\u202f000"),
        (100.0, "100"),
        (2.5e12, "2.5 × 10¹²"),
        (math.nan, "not measured"),
        (-math.inf, "−∞"),
        (None, "–"),
        (7, "7"),
    ],
)
def test_numbers_are_readable(value, text):
    assert number(value) == text


def test_durations_are_readable():
    assert seconds(1.25) == "1.25\u00a0s"
    assert seconds(0.0001) == "< 0.01\u00a0s"
    assert seconds(32.3167) == "32.3\u00a0s"
    assert seconds(119.99999) == "120\u00a0s"
    assert seconds(605.4) == "10\u00a0min 05\u00a0s"
