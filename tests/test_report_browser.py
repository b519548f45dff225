"""The report in a real browser: the switches work, the hover reads the map, and nothing is logged as an error."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from wall_study import MODELS, wall_study

from semstab.report.page import render

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs chromium: apt-get install chromium")


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    result, folder = wall_study(tmp_path_factory.getbasetemp())
    file = tmp_path_factory.mktemp("browser") / "report.html"
    file.write_text(render(result, folder), encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def browser():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        flags = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=flags)
        yield started
        started.close()


@pytest.fixture(params=[(480, "dark"), (1500, "light")], ids=["phone", "desk"])
def page(browser, report, request):
    width, scheme = request.param
    page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
    problems: list[str] = []
    page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("request", lambda r: None if r.url.startswith(("file:", "data:")) else problems.append(r.url))
    page.goto(report.as_uri())
    page.locator("canvas").first.wait_for()
    yield page
    assert problems == []
    page.close()


def test_switches_change_the_map_and_the_hover_reads_it(page) -> None:
    painted = set()
    for layer in ("Stability", "Class", "Disagreement", "Times seen", "Drift"):
        page.get_by_role("button", name=layer).first.click()
        painted.add(page.locator("canvas").first.evaluate("canvas => canvas.toDataURL()"))
        assert page.locator(".key").first.text_content()
    assert len(painted) == 5
    page.locator("canvas").first.hover()
    words = page.locator(".readout").first.text_content()
    assert "VSS" in words
    assert "OP" in words
    page.get_by_role("button", name="Camera image").first.click()
    assert page.locator("figure.map img").first.is_visible()
    assert not page.locator("canvas").first.is_visible()


def test_models_stand_side_by_side_or_alone_and_scenes_take_turns(page) -> None:
    _, nervous = MODELS
    maps = page.locator(".scene").first.locator("figure.map")
    assert [maps.nth(k).is_visible() for k in range(2)] == [True, True]
    page.get_by_role("button", name=nervous).first.click()
    assert [maps.nth(k).is_visible() for k in range(2)] == [False, True]
    page.get_by_role("button", name="Side by side").first.click()
    assert [maps.nth(k).is_visible() for k in range(2)] == [True, True]
    page.locator("#scene").select_option("rarely")
    page.locator(".scene").nth(1).locator("canvas").first.wait_for()
    assert [page.locator(".scene").nth(k).is_visible() for k in range(2)] == [False, True]


def test_tables_sort_by_a_click_and_nothing_is_wider_than_the_window(page) -> None:
    width = page.viewport_size["width"]
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    table = page.locator("details", has=page.locator("#table-scenes"))
    table.locator("summary").click()
    column = 2
    head = table.locator("thead tr").last.locator("th").nth(column)
    rows = "rows => rows.map(row => parseFloat(row.cells[2].textContent.replace(/,/g, '')))"
    for compare in (np.greater_equal, np.less_equal):
        head.click()
        values = table.locator("tbody").first.locator("tr:not(.group)").evaluate_all(rows)
        assert len(values) > 1
        assert compare(np.diff(values), 0).all()


def test_without_script_the_map_and_all_numbers_are_there(browser, report) -> None:
    page = browser.new_page(java_script_enabled=False)
    page.goto(report.as_uri())
    assert page.locator("img.plain").first.is_visible()
    assert not page.locator(".controls").first.is_visible()
    assert page.locator(".scene").count() == page.locator(".scene:visible").count() == 2
    page.close()


def test_a_number_on_the_map_opens_its_place_and_the_hover_tells_coordinates(page) -> None:
    page.locator("canvas").first.hover()
    assert "x " in page.locator(".readout").first.text_content()
    pin = page.locator("a.pin:visible").first
    place = page.locator(f"details{pin.get_attribute('href')}")
    assert not place.evaluate("place => place.open")
    pin.click()
    assert place.evaluate("place => place.open")
    page.wait_for_function("pin => pin.classList.contains('open')", arg=pin.element_handle())
