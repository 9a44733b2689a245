"""Report pages in the system's own Chromium, from a file, drawn by software: what a reader can do with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from browsers import colours_in, drawn_after, page_of
from test_report_scene import HOSTILE, moved
from tiny_rigs import TISSUES

from musclefit.report.html import PNG_SIGNATURE, render_html
from musclefit.report.scene import Scene, SceneField, SceneMark, SceneShape, SceneTissue
from musclefit.validate.model import OverlapCheck, PairOverlap, WorstTet


def make_scene(names=tuple(TISSUES), *, frames=0):
    rest = tuple(TISSUES.values())
    result = tuple(moved(s, [0, 5.0, 0]) for s in rest)
    count = sum(len(s.vertices) for s in rest)
    values = SceneField("det J", "", 0.0, 2.0, np.linspace(-0.2, 2.2, count))
    marks = (
        SceneMark("overlap", "2 mm³", (names[1], names[2]), rest[3].vertices, rest[3].faces),
        SceneMark("fold", "3 vertices", (names[3],), rest[3].vertices[:3]),
    )
    zone = SceneMark("contact zone", "within 5 mm", (names[2], names[3]), rest[2].vertices[:2])
    shapes = [SceneShape("Rest", rest, (), (zone,)), SceneShape("Result", result, (values,), marks)]
    shapes += [SceneShape(f"f{k}", tuple(moved(s, [k, 0, 0]) for s in rest), time_s=0.1 * k) for k in range(frames)]
    tissues = tuple(SceneTissue(name, kind.split("_")[0], "#aa3322") for name, kind in zip(names, TISSUES, strict=True))
    return Scene(tissues, tuple(shapes), np.array([1.0, 0, 0]), np.array([0, 0, 1.0]))


@pytest.fixture
def written(tmp_path, make_report, make_side, make_tissue):
    """Writes a report on the four balls, by whatever names."""

    def write(names=tuple(TISSUES), **scene):
        kinds = [name.split("_")[0] for name in TISSUES]
        checked = tuple(
            make_tissue(n, k, volume_change_percent=float(i)) for i, (n, k) in enumerate(zip(names, kinds, strict=True))
        )
        many = tuple(make_tissue(f"muscle_{k}", "muscle", volume_change_percent=-float(k)) for k in range(40))
        mesh = replace(make_side().mesh, worst=(WorstTet(7, names[3], (0, 0, 0), (3.0, 4.0, 5.0), 0.1),))
        pairs = OverlapCheck((PairOverlap(names[1], names[2], 0.0, 2.0, 2.0),), 3, ())
        side = make_side(tissues=(*checked, *many), overlaps=pairs, mesh=mesh)
        report = make_report(title=f"Arm {names[1]}", result=side, baseline=side, paper_loop=side)
        path = tmp_path / "report.html"
        pictures = {"Front": PNG_SIGNATURE, "Side": PNG_SIGNATURE}
        path.write_text(render_html(report, pictures=pictures, scene=make_scene(names, **scene)), encoding="utf-8")
        return path

    return write


def test_the_view_shows_states_layers_sections_and_values(browser, written):
    with page_of(browser, written()) as page:
        assert page.get_attribute("html", "data-viewer") == "ready"
        assert page.get_attribute("#viewer", "data-shown") == "Rest | Result"
        first = page.evaluate("() => document.getElementById('view').toDataURL()")
        assert len(colours_in(page)) > 5
        one = drawn_after(page, lambda: page.select_option("#left", "none"))
        assert page.get_attribute("#viewer", "data-shown") == "Result"
        assert page.input_value("#section-axis") == "2", "the first section faces the reader"
        cut = drawn_after(page, lambda: page.check("#section-on"))
        drawn_after(page, lambda: page.uncheck("#section-on"))
        page.click("summary:has-text('Layers')")
        hidden = drawn_after(page, lambda: page.uncheck("#layers input[data-kind=muscle]"))
        assert page.locator("#layers .names input:not(:checked)").count() == 1
        valued = drawn_after(page, lambda: page.select_option("#colour", "det J"))
        assert page.is_visible("#scale")
        moved_by = drawn_after(page, lambda: page.select_option("#colour", "displacement"))
        assert page.inner_text("#scale-high") == "5.00"
        assert len({first, one, cut, hidden, valued, moved_by}) == 6


def test_places_in_tables_take_the_view_there(browser, written):
    with page_of(browser, written()) as page:
        page.click("tr[data-mark='1 0'] button.fly")
        page.wait_for_selector("#viewer[data-at]")
        x, y, _ = map(float, page.get_attribute("#viewer", "data-at").split())
        assert (abs(x), abs(y - 13)) < (0.1, 0.1)
        assert "bone_proximal and bone_distal" in page.text_content("#view-said")
        assert page.get_attribute("#viewer", "data-shown") == "Result", "another state would show another place"
        page.click("tr[data-with] button.fly")
        assert page.get_attribute("#viewer", "data-shown") == "Rest | Result", "as before the place was shown"
        page.click("tr[data-at] button.fly")
        page.wait_for_selector("#viewer[data-at^='3.00 4.00 5.00']")
        page.click("#show-all")
        assert page.get_attribute("#viewer", "data-shown") == "Rest | Result"
        assert page.is_hidden("#show-all")
        assert page.is_hidden("tr[data-mark='0 0']"), "contact zones are folded away"
        page.click("summary:has-text('1 contact zone of bones')")
        page.click("tr[data-mark='0 0'] button.fly")
        assert page.get_attribute("#viewer", "data-shown") == "Rest"
        page.click("#show-all")
        page.click("tr[data-with] button.fly")
        assert page.is_visible("#show-all")


def test_keys_turn_and_a_click_names_a_tissue(browser, written):
    with page_of(browser, written()) as page:
        page.select_option("#left", "none")
        page.focus("#view")
        turned = drawn_after(page, lambda: page.keyboard.press("ArrowLeft"))
        nearer = drawn_after(page, lambda: page.keyboard.press("+"))
        drawn_after(page, lambda: page.keyboard.press("s"))
        assert page.is_checked("#section-on")
        drawn_after(page, lambda: page.keyboard.press("s"))
        home = drawn_after(page, lambda: page.keyboard.press("0"))
        assert len({turned, nearer, home}) == 3
        box = page.locator("#view").bounding_box()
        page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] * 0.32)
        assert "bone_distal (bone)" in page.text_content("#view-said")
        assert "Arrow keys" in page.get_attribute("#view", "aria-label")


def test_a_motion_plays_and_can_be_stepped(browser, written):
    with page_of(browser, written(frames=4)) as page:
        assert page.get_attribute("#viewer", "data-shown").endswith("f0")
        page.focus("#time")
        page.keyboard.press("ArrowRight")
        assert page.get_attribute("#viewer", "data-shown").endswith("f1")
        assert page.get_attribute("#time", "aria-valuetext") == "0.100 s, frame 2 of 4"
        page.click("#play")
        page.wait_for_selector("#viewer[data-shown$=f3]")
        page.click("#play")
        assert page.inner_text("#play") == "Play"


def test_tables_are_sorted_and_filtered(browser, written):
    with page_of(browser, written()) as page:
        table = page.locator("table", has=page.locator("tr[data-tissue='muscle_7']"))
        assert table.locator("tbody tr:visible").count() == 25
        table.locator("th:nth-child(4) button").click()  # largest change first
        top = table.locator("tbody tr").first
        assert top.get_attribute("data-tissue") == "muscle_flexor"
        table.locator("th:nth-child(4) button").click()
        assert table.locator("tbody tr").first.get_attribute("data-tissue") == "muscle_39"
        assert table.locator("th:nth-child(4)").get_attribute("aria-sort") == "ascending"
        tools = table.locator("xpath=ancestor::div[contains(@class,'scroll')]/preceding-sibling::div[1]")
        tools.locator("input").fill("muscle_3")
        assert table.locator("tbody tr:visible").count() == 11
        assert "11 of 44 rows" in tools.inner_text()


def test_a_section_goes_through_the_middle_of_what_is_shown_until_it_is_moved(browser, written):
    def place(page):
        return float(page.inner_text("#section-said").split()[0])

    with page_of(browser, written()) as page:
        page.check("#section-on")
        page.select_option("#section-axis", "1")
        page.select_option("#left", "none")
        result = place(page)
        page.select_option("#right", "0")
        assert result - place(page) == pytest.approx(5.0, abs=0.3)
        page.locator("#section-at").fill("12")
        by_hand = place(page)
        page.select_option("#right", "1")
        assert place(page) == by_hand != result


def test_dark_light_phone_and_print(browser, written):
    path = written()
    shade = "() => getComputedStyle(document.querySelector('main')).backgroundColor"
    with page_of(browser, path, color_scheme="dark") as page:
        assert max(map(int, page.evaluate(shade)[4:-1].split(","))) < 64
    with page_of(browser, path, wide=390, high=844, is_mobile=True) as page:
        assert page.evaluate("() => document.documentElement.scrollWidth") <= 390
        assert page.get_attribute("#viewer", "data-shown") == "Result"
        heads = page.locator("table.summary thead th").all_inner_texts()
        assert heads.index("Result") < heads.index("Paper's loop") < heads.index("One shot")
        right = page.evaluate("() => document.querySelector('table.summary td.side').getBoundingClientRect().right")
        assert right <= 390
        wide = page.evaluate("() => document.querySelector('figure.story-picture img').getBoundingClientRect().width")
        assert wide > 900, "four panels side by side are scrolled, not shrunk"
    with page_of(browser, path) as page:
        assert page.evaluate(shade) == "rgb(255, 255, 255)"
        narrowest = "() => Math.min(...[...document.querySelectorAll('td.name')].map((c) => c.offsetWidth || 999))"
        assert page.evaluate(narrowest) >= 80, "short names are not broken"
        links = page.locator("nav.contents a")
        for k in range(links.count()):
            assert page.locator(f"{links.nth(k).get_attribute('href')} + h2").count() == 1
        page.emulate_media(media="print")
        assert page.is_hidden("#explore")
        assert page.is_visible("figure img") or page.locator("figure img").count()


def test_hostile_names_do_no_harm(browser, written):
    names = tuple(f"{HOSTILE}{k}" for k in range(4))
    with page_of(browser, written(names)) as page:
        page.click("tr[data-mark='1 0'] button.fly")
        page.wait_for_selector("#viewer[data-at]")
        assert HOSTILE in page.text_content("#view-said")
        page.click("summary:has-text('Layers')")
        assert HOSTILE in page.text_content("#layers")
        assert page.locator("img[src=x]").count() == 0


def test_without_webgl_the_pictures_stay(browser, written):
    path = written()
    context = browser.new_context()
    page = context.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(path.as_uri())
    page.wait_for_selector("html[data-viewer=none]", state="attached")
    assert page.is_hidden("#viewer")
    assert "The pictures show the same" in page.inner_text("#viewer-problem")
    assert page.locator("figure img").count() == 2
    context.close()
