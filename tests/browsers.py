"""Pages in the system's own Chromium, from a file, drawn by software."""

from __future__ import annotations

import os
import shutil
from contextlib import contextmanager

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
SOFTWARE = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]


@contextmanager
def opened_browser():
    """A Chromium; without one tests skip, but fail under CI."""
    sync_api = pytest.importorskip("playwright.sync_api")
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        reason = f"no browser: install one of {', '.join(BROWSERS)}"
        if os.environ.get("CI") == "true":
            pytest.fail(reason)
        pytest.skip(reason)
    with sync_api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=path, args=SOFTWARE)
        yield opened
        opened.close()


@contextmanager
def page_of(browser, path, *, wide=1000, high=800, viewer=True, **settings):
    """A page opened from a file; no word on its console and no request beyond the file itself."""
    context = browser.new_context(viewport={"width": wide, "height": high}, reduced_motion="reduce", **settings)
    page, said, asked = context.new_page(), [], []
    page.set_default_timeout(60000)
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))

    def dismissed(dialog):
        said.append(f"dialog: {dialog.message}")
        dialog.dismiss()

    page.on("dialog", dismissed)
    page.on("request", lambda request: asked.append(request.url))
    page.goto(path.as_uri())
    if viewer:
        page.wait_for_selector("html[data-viewer]", state="attached")
    yield page
    wrong = [text for text in said if "GPU stall" not in text and "GL Driver Message" not in text]
    assert not wrong
    assert [url for url in asked if not url.startswith(("data:", "blob:"))] == [path.as_uri()]
    context.close()


def colours_in(page):
    """Distinct colours of what the view drew."""
    return page.evaluate(
        """() => { const view = document.getElementById("view"), flat = document.createElement("canvas");
        flat.width = view.width; flat.height = view.height; const context = flat.getContext("2d");
        context.drawImage(view, 0, 0); const data = context.getImageData(0, 0, flat.width, flat.height).data;
        const seen = new Set(); for (let i = 0; i < data.length; i += 4)
        if (data[i + 3] > 250) seen.add((data[i] >> 4) * 256 + (data[i + 1] >> 4) * 16 + (data[i + 2] >> 4));
        return [...seen]; }"""
    )


def drawn_after(page, act):
    """Acts, waits until the view was drawn again, and gives what it then shows."""
    before = int(page.get_attribute("#viewer", "data-drawn"))
    act()
    for _ in range(600):
        if int(page.get_attribute("#viewer", "data-drawn")) > before:
            break
        page.wait_for_timeout(50)
    page.wait_for_timeout(100)
    return page.evaluate("() => document.getElementById('view').toDataURL()")
