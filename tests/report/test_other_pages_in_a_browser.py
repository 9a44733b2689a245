"""Pages of sequences, comparisons, studies and inspections in the system's own Chromium, from a file."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field, replace
from io import BytesIO

import numpy as np
import pytest
from browsers import colours_in, drawn_after, page_of
from PIL import Image
from test_report_scene import HOSTILE, moved
from test_report_sequence import frame, report
from tiny_rigs import TISSUES

from musclefit.anatomy.findings import Finding
from musclefit.report.cohort import render_cohort
from musclefit.report.html import render_differences, render_inspection
from musclefit.report.model import MeshReport, TissueSummary
from musclefit.report.run_differences import Differences, FrameRow, MeasureRow, PairRow, SettingRow, TissueRow
from musclefit.report.scene import Scene, SceneShape, SceneTissue
from musclefit.report.sequence_html import render_sequence
from musclefit.validate.model import OverlapCheck, PairOverlap

NAMES = tuple(TISSUES)
SHADE = "() => getComputedStyle(document.querySelector('main')).backgroundColor"


def two_motions(names=NAMES, *, runs=("left", "right")):
    """Two motions of four frames, the second twice as far, at the same times but the last."""
    rest = tuple(TISSUES.values())
    shapes = [SceneShape("Rest", rest)]
    for number, run in enumerate(runs, start=1):
        times = (0.0, 0.1, 0.2, 0.2 + 0.1 * number)
        shapes += [
            SceneShape(f"{t:.1f} s", tuple(moved(s, [0, 30 * number * t, 0]) for s in rest), time_s=t, motion=run)
            for t in times
        ]
    tissues = tuple(SceneTissue(n, k.split("_")[0], "#aa3322") for n, k in zip(names, NAMES, strict=True))
    return Scene(tissues, tuple(shapes), np.array([1.0, 0, 0]), np.array([0, 0, 1.0]), ("one of 2 frames is shown",))


def two_runs(names=NAMES):
    """A rest and two results."""
    rest = tuple(TISSUES.values())
    shapes = [SceneShape(t, tuple(moved(s, [0, y, 0]) for s in rest)) for t, y in (("Rest", 0), ("a", 4), ("b", 9))]
    tissues = tuple(SceneTissue(n, k.split("_")[0], "#aa3322") for n, k in zip(names, NAMES, strict=True))
    return Scene(tissues, tuple(shapes), np.array([1.0, 0, 0]), np.array([0, 0, 1.0]))


def beside(names=NAMES, *, runs=("left", "right"), frames=False):
    """Two runs, or sequences, that differ; 41 tissues."""
    more = [f"muscle_{k}" for k in range(40)]
    tissues = tuple(
        TissueRow(n, "muscle", (0.1, float(k)), (None, None), (0.0, 0.0), (0.0, float(k)), (0,))
        for k, n in enumerate([names[1], *more])
    )
    rows = (FrameRow(0.1, ("made", "refused"), (0.1, None), (0.0, None), (0.0, None)),) if frames else ()
    return Differences(
        runs=runs,
        titles=runs,
        verdicts=("passed", "failed"),
        claims=("certified", "sampled"),
        mesh_claims=("none", "none"),
        best=0,
        because="it fails fewer checks",
        settings=(SettingRow("drive.pose", runs),),
        measures=(MeasureRow("muscle volume change", "%", (0.1, 3.0), (True, False), (0,)),),
        tissues=tissues,
        pairs=(PairRow(names[1], names[2], (0.0, 2.0), (0.0, 2.0), (0,)),),
        notes=(f"{runs[0]} is another body",),
        frames=rows,
    )


@pytest.fixture
def put(tmp_path):
    """Writes a page and gives its path."""

    def write(text):
        path = tmp_path / "page.html"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_runs_are_seen_beside_each_other(browser, put):
    page_path = put(render_differences(beside(), links=["../left/report.html", ""], scene=two_runs()))
    with page_of(browser, page_path) as page:
        assert page.get_attribute("#viewer", "data-shown") == "Rest | a"
        first = drawn_after(page, lambda: page.select_option("#left", label="a"))
        second = drawn_after(page, lambda: page.select_option("#right", label="b"))
        assert page.get_attribute("#viewer", "data-shown") == "a | b"
        cut = drawn_after(page, lambda: page.check("#section-on"))
        assert len({first, second, cut}) == 3
        assert len(colours_in(page)) > 5
        table = page.locator("table", has=page.locator("tr[data-tissue='muscle_7']"))
        assert table.locator("tbody tr:visible").count() == 25
        table.locator("th:nth-child(3) button").click()  # farthest apart first
        assert table.locator("tbody tr").first.get_attribute("data-tissue") == "muscle_39"
        page.click("tr[data-with] button.fly")
        assert page.is_visible("#show-all")
        assert "left is better" in page.inner_text(".banner")
        assert page.inner_text(".story").split() == ["Muscle", "volume", "change", "A", "0.1", "%", "★", "B", "3", "%"]


def test_two_motions_run_on_one_clock(browser, put):
    found = beside(frames=True)
    page_path = put(render_differences(found, links=["", ""], scene=two_motions()))
    with page_of(browser, page_path) as page:
        assert page.get_attribute("#viewer", "data-shown") == "left: 0.0 s | right: 0.0 s"
        page.focus("#time")
        page.keyboard.press("End")
        assert page.get_attribute("#viewer", "data-shown") == "left: 0.3 s | right: 0.4 s"
        page.keyboard.press("ArrowLeft")
        assert page.get_attribute("#viewer", "data-shown") == "left: 0.3 s | right: 0.2 s"
        assert page.get_attribute("#time", "aria-valuetext") == "0.300 s, frame 4 of 5"
        page.select_option("#colour", "displacement")
        assert page.inner_text("#scale-high") == "24.0"
        page.focus("#view")
        page.keyboard.press(" ")
        page.wait_for_selector("#viewer[data-shown='left: 0.1 s | right: 0.1 s']")
        page.keyboard.press(" ")
        assert "one of 2 frames is shown" in page.inner_text("#explore")
        assert "refused" in page.inner_text("main")


def drawn(colour="#333"):
    data = BytesIO()
    Image.new("RGB", (60, 40), colour).save(data, "PNG")
    return data.getvalue()


def test_a_sequence_is_told_in_a_minute_and_opens_where_it_is_farthest(browser, put):
    scene = replace(two_motions(runs=("",)), first_time_s=0.2)
    pictures = {"Frames in order of time": ("image/png", drawn()), "The motion": ("image/gif", b"GIF89a")}
    made = report(frame(0, 1e-9), frame(1, 5e-6), frame(2, 2e-8))
    with page_of(browser, put(render_sequence(made, pictures=pictures, scene=scene))) as page:
        assert page.get_attribute("#viewer", "data-shown") == "Rest | 0.2 s"
        assert page.locator(".story > div").count() == 3
        assert "worst: frame 1 at 0.5 s: knee_1" in page.inner_text(".story")
        order = page.evaluate(
            "() => [...document.querySelectorAll('.banner, .story, .story-picture, nav.contents, #explore')]"
            ".map((e) => e.getBoundingClientRect().top)"
        )
        assert len(order) == 5
        assert order == sorted(order)


@dataclass(frozen=True)
class Case:
    name: str
    change: float | None
    subject: str = "s"
    rig: str = "limb"
    motion: str = ""
    facts: dict = field(default_factory=lambda: {"age": "31"})
    reason: str = ""

    @property
    def status(self):
        return "passed" if self.change is not None and self.change < 1 else "limits broken"

    @property
    def values(self):
        return {"map": "certified", "landmark error [mm]": 1e-12, "muscle volume change [%]": self.change}


def cohort(names):
    cases = [Case(name, 0.1 * k + (5.0 if k == 11 else 0.0)) for k, name in enumerate(names)]
    cases.append(Case("late", None, reason="no elbow bends so far"))
    picture = BytesIO()
    Image.new("RGB", (60, 90), "#933").save(picture, "JPEG")
    links = {names[0]: "subjects/s/limb/result/report.html"}
    return render_cohort(f"Study of {names[0]}", cases, thumbnails={names[0]: picture.getvalue()}, links=links)


def test_a_cohort_is_sorted_filtered_and_told(browser, put):
    names = [f"s{k:02d}/limb" for k in range(12)]
    with page_of(browser, put(cohort(names)), viewer=False) as page:
        heads = [head.split("\n")[0] for head in page.locator("#cases thead th").all_inner_texts()]
        assert [head.rstrip(" ↕") for head in heads][:4] == ["Picture", "Case", "status", "muscle volume change"]
        page.click("#cases th:nth-child(4) button")
        assert "s11/limb" in page.inner_text("#cases tbody tr:first-child")
        assert "late" in page.inner_text("#cases tbody tr:last-child"), "what was not measured is last"
        page.click("#cases th:nth-child(4) button")
        assert "s00/limb" in page.inner_text("#cases tbody tr:first-child")
        assert "late" in page.inner_text("#cases tbody tr:last-child"), "whichever way"
        page.fill(".table-tools input >> nth=0", "s1")
        assert page.locator("#cases tbody tr:visible").count() == 2
        told = page.inner_text(".story")
        assert "10 of 13" in told
        assert "6.1" in told
        assert page.locator("td.far").count() == 1
        assert "no elbow bends so far" in page.inner_text("main")
        loaded = "(i) => i.complete && i.naturalWidth === 60"
        assert page.locator("img.thumb").evaluate(loaded)


@pytest.mark.parametrize("kind", ["comparison", "sequences", "sequence", "cohort", "inspection"])
def test_hostile_names_do_no_harm_on_any_page(browser, put, kind):
    names = tuple(f"{HOSTILE}{k}" for k in range(4))
    pages = {
        "comparison": lambda: render_differences(
            beside(names, runs=(HOSTILE, "b")), links=["", ""], scene=two_runs(names)
        ),
        "sequences": lambda: render_differences(
            beside(names, runs=(HOSTILE, "b"), frames=True),
            links=["", ""],
            scene=two_motions(names, runs=(HOSTILE, "b")),
        ),
        "sequence": lambda: render_sequence(
            replace(report(frame(0, 1e-9), frame(1, 1.0)), title=HOSTILE),
            pictures={HOSTILE: ("image/png", drawn())},
            problems=HOSTILE,
            scene=two_motions(names, runs=("",)),
        ),
        "cohort": lambda: cohort([f"{HOSTILE}{k}" for k in range(12)]),
        "inspection": lambda: render_inspection(
            MeshReport(
                HOSTILE,
                HOSTILE,
                tuple(TissueSummary(n, "bone", 8, 12, 5.0, 3.0) for n in names),
                (Finding(HOSTILE, HOSTILE, HOSTILE), Finding(HOSTILE, "chosen-setting", f"{HOSTILE}: {HOSTILE}")),
                OverlapCheck((PairOverlap(names[0], names[1], 2.0, 2.0, 0.0),), 6, ()),
            )
        ),
    }
    viewer = kind not in ("cohort", "inspection")
    with page_of(browser, put(pages[kind]()), viewer=viewer) as page:
        assert HOSTILE in page.inner_text("main")
        assert page.locator("img[src=x]").count() == 0
        assert page.locator("main script").count() == 0
        if viewer:
            page.click("summary:has-text('Layers')")
            assert HOSTILE in page.inner_text("#layers")
        if kind == "sequences":
            assert page.get_attribute("#viewer", "data-shown").startswith(f"{HOSTILE}: ")
            assert HOSTILE in page.inner_text("#title-left")
            page.select_option("#right", label=HOSTILE)
        if kind == "comparison":
            page.click("tr[data-with] button.fly")
            assert HOSTILE in page.text_content("#view-said")


@pytest.mark.parametrize("kind", ["comparison", "sequence", "cohort"])
def test_dark_light_phone_keyboard_and_print(browser, put, kind):
    made = {
        "comparison": lambda: render_differences(beside(frames=True), links=["", ""], scene=two_runs()),
        "sequence": lambda: render_sequence(
            report(frame(0, 1e-9), frame(1, 5e-6)),
            pictures={"Frames": ("image/png", drawn())},
            scene=two_motions(runs=("",)),
        ),
        "cohort": lambda: cohort([f"s{k:02d}/limb" for k in range(12)]),
    }[kind]()
    path, viewer = put(made), kind != "cohort"
    with page_of(browser, path, viewer=viewer, color_scheme="dark") as page:
        assert max(map(int, page.evaluate(SHADE)[4:-1].split(","))) < 64
    with page_of(browser, path, viewer=viewer, wide=390, high=844, is_mobile=True) as page:
        assert page.evaluate("() => document.documentElement.scrollWidth") <= 390
        assert page.locator(".story").bounding_box()["y"] < 844, "the numbers are on the first screen"
    with page_of(browser, path, viewer=viewer) as page:
        assert page.evaluate(SHADE) == "rgb(255, 255, 255)"
        page.keyboard.press("Tab")
        assert page.evaluate("() => document.activeElement.className") == "skip"
        page.locator("thead th button.sort").first.focus()
        page.keyboard.press("Enter")
        assert page.locator("th[aria-sort]").count() == 1
        links = page.locator("nav.contents a")
        assert links.count() > 1
        for k in range(links.count()):
            assert page.locator(f"{links.nth(k).get_attribute('href')} + h2").count() == 1
        page.emulate_media(media="print")
        assert page.is_hidden("nav.contents")
        assert page.locator("#explore").count() == 0 or page.is_hidden("#explore")
        assert base64.b64encode(page.pdf(format="A4"))[:5] == b"JVBER"
