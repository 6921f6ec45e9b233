"""The page of a run in a headless Chromium: wipes, zoom and the light of a pixel do what they say, without errors."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from analytic import WrongField, scene_of, sphere
from browsers import chromium
from page_reader import Page

from mmsynth.report.report import write_run_report

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    field = WrongField(sphere())
    field.wrong = False
    scene = scene_of(field, folder / "scene", truth=False)
    field.wrong = True
    return write_run_report(folder, field, scene=scene)  # type: ignore[arg-type]


@pytest.fixture
def opened(report: Path) -> Iterator[Any]:
    """The page; it must not have said or asked for anything when it is closed."""
    said: list[str] = []
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 1200, "height": 900})
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: said.append(request.url) if not request.url.startswith(("file:", "data:")) else None)
        page.goto(report.as_uri())
        yield page
    assert said == []


def numbers(page: Any, within: str, key: str) -> list[float]:
    """What the readout says."""
    return [float(text) for text in page.locator(f"{within} .readout tr[data-key={key}] td").all_inner_texts()]


def test_the_edge_of_a_wipe_moves(opened: Any) -> None:
    over = opened.locator(".wipe .pair img").first
    clip = lambda: over.evaluate("image => getComputedStyle(image).clipPath")
    boxes = [opened.locator(".wipe .pair img").nth(i).bounding_box() for i in (0, 1)]
    assert boxes[0] == boxes[1] and boxes[0]["height"] > 100  # one over the other
    before = clip()
    slider = opened.locator(".wipe input[type=range]").first
    slider.focus()
    for _ in range(5):
        opened.keyboard.press("ArrowRight")
    assert slider.input_value() == "55" and clip() != before
    slider.fill("100")
    assert clip() in ("inset(0px)", "inset(0px 0% 0px 0px)", "inset(0px calc(0%) 0px 0px)")


def test_enter_enlarges_a_picture_and_escape_closes_it(opened: Any) -> None:
    look, dialog = opened.locator(".look").nth(1), opened.locator("dialog")
    assert not dialog.is_visible()
    look.focus()
    opened.keyboard.press("Enter")
    assert dialog.is_visible()
    large = opened.locator("dialog .look img").first
    assert large.bounding_box()["width"] > 1.5 * look.bounding_box()["width"]
    assert large.evaluate("image => getComputedStyle(image).imageRendering") == "pixelated"
    opened.keyboard.press("Escape")
    assert not dialog.is_visible() and look.evaluate("look => document.activeElement === look")
    opened.locator(".look").first.click()
    assert dialog.is_visible() and opened.locator("dialog .pair img").count() == 2
    opened.locator("dialog button").click()
    assert not dialog.is_visible()


def test_hovering_and_arrow_keys_show_the_light_of_the_pixel(opened: Any, report: Path) -> None:
    stored = Page(report).spectra()["ms"]
    name = opened.locator("section.modality", has_text="ms").first.get_attribute("data-spectra")
    within = f"section[data-spectra={name}]"
    look = opened.locator(f"{within} .look").nth(1)
    look.scroll_into_view_if_needed()
    box = look.bounding_box()
    for x, y in ((12, 9), (7, 5), (0, 17)):
        opened.mouse.move(box["x"] + (x + 0.5) / 24 * box["width"], box["y"] + (y + 0.5) / 18 * box["height"])
        assert f"column {x}, row {y}" in opened.locator(f"{within} .where").inner_text()
        for key in ("measured", "rendered"):
            shown = opened.locator(f"{within} .readout tr[data-key={key}] td").all_inner_texts()
            truth = stored[key][y, x]
            assert shown == [f"{v:.4f}" if v == v else "–" for v in truth] or numbers(opened, within, key) == pytest.approx(
                truth, abs=5.1e-5
            )
    assert opened.locator(f"{within} .readout svg circle").count() >= 8
    look.focus()
    for key in ("ArrowUp", "ArrowRight", "ArrowRight", "ArrowLeft"):
        opened.keyboard.press(key)
    assert "column 1, row 16" in opened.locator(f"{within} .where").inner_text()
    assert "column 1, row 16" in opened.locator("[aria-live]").inner_text()


def test_dark_light_and_paper(opened: Any) -> None:
    style = lambda what, key: opened.evaluate(f"getComputedStyle(document.querySelector('{what}')).{key}")
    brightness = lambda: sum(int(part) for part in style("body", "backgroundColor")[4:-1].split(",")[:3])
    opened.emulate_media(color_scheme="light")
    assert brightness() > 700
    opened.emulate_media(color_scheme="dark")
    assert brightness() < 120
    opened.emulate_media(media="print", color_scheme="light")
    over, under = (opened.locator(".wipe .pair img").nth(i).bounding_box() for i in (0, 1))
    assert under["x"] >= over["x"] + over["width"] and abs(under["y"] - over["y"]) < 1 and style(".pair img", "clipPath") == "none"
    assert not opened.locator(".wipe input").first.is_visible()


def test_polarization_stays_in_one_line(opened: Any) -> None:
    for width in (1200, 500):
        opened.set_viewport_size({"width": width, "height": 800})
        row = opened.locator("section.modality", has_text="pol").first
        tops = {round(row.locator("figure").nth(i).bounding_box()["y"]) for i in range(row.locator("figure").count())}
        assert len(tops) == 1 and row.locator("figure").count() == 5
        assert opened.evaluate("document.documentElement.scrollWidth <= window.innerWidth")  # the row scrolls, the page does not
