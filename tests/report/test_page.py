"""The report of a real sweep in a real browser: wide, narrow, by keyboard and on paper."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlparse

import pytest
from needs import need_drawing, slow
from PIL import Image
from playwright.sync_api import Page

from msk_ray.cli import run
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.records import best_records, read_records
from msk_ray.report.__main__ import main
from msk_ray.report.best import strip_text

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def reported(sweep: Experiment, tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    """A copy of the sweep with its report, the best policy's evaluation and strip included."""
    need_drawing()
    copy = Experiment(Path(shutil.copytree(sweep.path, tmp_path_factory.mktemp("reported") / "small")))
    assert run(main, [str(copy.path), "--device", "cpu"]) == 0
    return copy


WHATEVER_THE_WIDTH = pytest.mark.parametrize("window", [375, *slow(1280)], indirect=True)


@pytest.fixture(scope="module", params=[1280, 375], ids=["wide", "narrow"])
def window(browser: Any, request: pytest.FixtureRequest) -> Iterator[Page]:
    """A window for all tests: opening one costs more than what a test does in it."""
    context = browser.new_context(viewport={"width": request.param, "height": 800})
    opened = context.new_page()
    opened.complaints, opened.requests = [], []
    opened.on("console", lambda message: opened.complaints.append(message.text))
    opened.on("pageerror", lambda error: opened.complaints.append(str(error)))
    opened.on("requestfailed", lambda failed: opened.complaints.append(failed.url))
    opened.on("request", lambda made: opened.requests.append(made.url))
    opened.width = request.param
    yield opened
    context.close()


@pytest.fixture
def page(reported: Experiment, window: Any) -> Page:
    """The page as it opens, with everything the browser complains of in `complaints`, and what it loads in
    `requests`."""
    window.goto("about:blank")
    window.set_viewport_size({"width": window.width, "height": 800})
    window.emulate_media(media="null", color_scheme="null")
    window.complaints.clear()
    window.requests.clear()
    window.goto((reported.path / "report" / "index.html").as_uri())
    return window


def test_all_is_drawn_without_complaints_and_fits(page: Page, reported: Experiment) -> None:
    assert page.complaints == []  # type: ignore[attr-defined]
    fetched = [url for url in page.requests if not url.startswith("data:")]  # type: ignore[attr-defined]
    assert fetched == [(reported.path / "report" / "index.html").as_uri()]
    images = page.evaluate("[...document.images].map(i => [i.complete && i.naturalWidth, i.alt.length, i.clientWidth])")
    assert len(images) == 1, "the strip"
    assert all(width > 200 and alt > 30 for width, alt, _ in images)
    inner, scroll = page.evaluate("[window.innerWidth, document.documentElement.scrollWidth]")
    assert scroll <= inner
    assert page.locator("figure[data-figure]").count() == 5, "curves, effects, parallel coordinates, stops, gradients"
    # Something is drawn on each canvas, which is as wide as there is room.
    inked = """[...document.querySelectorAll(".chart canvas")].map(c => [c.clientWidth,
        new Set(new Uint32Array(c.getContext("2d").getImageData(0, 0, c.width, c.height).data.buffer)).size])"""
    drawn = page.evaluate(inked)
    assert len(drawn) >= 6
    assert all(200 < width <= inner and colours > 5 for width, colours in drawn)


@WHATEVER_THE_WIDTH
def test_a_figure_is_saved_as_it_is_shown(page: Page) -> None:
    """Three times as sharp, with curves, axes and legend: several colours beside the paper's."""
    figure = page.locator("figure[data-figure=curves]")
    with page.expect_download() as download:
        figure.get_by_role("button", name="save this figure as PNG").click()
    assert download.value.suggested_filename == "curves.png"
    with Image.open(download.value.path()) as image:
        width = figure.locator(".charts").evaluate("room => room.getBoundingClientRect().width")
        assert image.width == int(3 * width)
        assert len(image.convert("RGB").getcolors(1 << 24) or []) > 20


def test_charts_are_filtered_hovered_and_zoomed(page: Page) -> None:
    rows = page.locator("tr[data-trial]:visible")
    assert (rows.count(), page.locator("#shown").text_content()) == (4, "all 4")
    page.fill("#words", "seed=1 actor_lr=0.01")
    assert (rows.count(), page.locator("#shown").text_content()) == (1, "1 of 4")
    chart = page.locator("[data-figure=curves] .chart")
    shown = "box => page.chart(box).getOption().series.map(one => one.trial).filter(trial => trial !== undefined)"
    (place,) = chart.evaluate(shown)
    trial = rows.first.locator("code").text_content()
    assert str(place) == rows.first.get_attribute("data-trial")
    # The pointer on the curve's last point names the trial.
    spot = """box => { const chart = page.chart(box);
        const data = chart.getOption().series.find(s => s.trial !== undefined).data;
        return chart.convertToPixel({gridIndex: 0}, data[data.length - 1]); }"""
    chart.scroll_into_view_if_needed()
    frame, (x, y) = chart.bounding_box(), chart.evaluate(spot)
    assert frame is not None
    page.mouse.move(frame["x"] + x - 5, frame["y"] + y - 3)
    page.mouse.move(frame["x"] + x - 2, frame["y"] + y)
    assert str(page.locator(".tip").text_content()).startswith(f"{trial}\n")
    page.click("#filter button")
    assert rows.count() == 4
    chart.focus()
    page.keyboard.press("+")
    ends = "box => page.chart(box).getOption().dataZoom.map(z => [z.start, z.end])"
    assert chart.evaluate(ends) == [[25, 75], [0, 100]]
    page.keyboard.press("0")
    assert chart.evaluate(ends) == [[0, 100], [0, 100]]
    # A variant is switched off by its button, which keeps the focus.
    entry = page.locator("[data-figure=curves] .legend button").first
    before = len(chart.evaluate("box => page.chart(box).getOption().series"))
    entry.focus()
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.getAttribute('aria-pressed')") == "false"
    assert len(chart.evaluate("box => page.chart(box).getOption().series")) < before
    assert page.complaints == []  # type: ignore[attr-defined]


@WHATEVER_THE_WIDTH
def test_it_is_dark_where_the_reader_wants_it_and_white_on_paper(page: Page) -> None:
    paper = "getComputedStyle(document.body).backgroundColor"
    assert page.evaluate(paper) == "rgb(255, 255, 255)"
    page.emulate_media(color_scheme="dark")
    assert page.evaluate(paper) == "rgb(13, 17, 23)"
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert page.evaluate(paper) == "rgb(255, 255, 255)"
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert page.evaluate(paper) == "rgb(13, 17, 23)"
    assert page.complaints == []  # type: ignore[attr-defined]


def test_wide_tables_keep_their_first_column(page: Page) -> None:
    """And show that they go on where they do."""
    frame = page.locator(".scroll", has=page.locator("tr[data-trial]"))
    frame.scroll_into_view_if_needed()
    more = "f => [f.scrollWidth > f.clientWidth + 1, f.classList.contains('more')]"
    wider, shaded = frame.evaluate(more)
    assert wider == shaded
    if page.evaluate("innerWidth") < 600:
        assert wider
    left = "f => f.querySelector('tbody td').getBoundingClientRect().left"
    before = frame.evaluate(left)
    frame.evaluate("f => { f.scrollLeft = 1e4; f.dispatchEvent(new Event('scroll')); }")
    assert abs(frame.evaluate(left) - before) < 2
    assert not frame.evaluate(more)[1]


@WHATEVER_THE_WIDTH
def test_links_resolve(page: Page, reported: Experiment) -> None:
    links = page.evaluate("[...document.querySelectorAll('a')].map(a => a.href)")
    assert len(links) > 20
    base = (reported.path / "report" / "index.html").as_uri()
    for link in links:
        target, _, anchor = link.partition("#")
        if target == base:
            assert page.evaluate("id => document.getElementById(id) !== null", anchor), link
        else:
            assert Path(unquote(urlparse(target).path)).is_file(), link


@WHATEVER_THE_WIDTH
def test_tables_are_sorted_by_keyboard(page: Page) -> None:
    heading = page.locator("table[data-sortable] th", has_text="score").first
    heading.locator("button").focus()
    column = heading.evaluate("th => th.cellIndex")
    rows = "[...document.querySelector('table[data-sortable]').tBodies[0].rows]"
    cells = f"{rows}.map(row => +row.cells[{column}].dataset.value)"
    page.keyboard.press("Enter")
    assert heading.get_attribute("aria-sort") == "descending"
    falling = page.evaluate(cells)
    assert falling == sorted(falling, reverse=True)
    page.keyboard.press("Enter")
    assert heading.get_attribute("aria-sort") == "ascending"
    assert page.evaluate(cells) == falling[::-1]
    # The first Tab of the page reaches the link past the navigation.
    page.evaluate("document.activeElement.blur(); window.scrollTo(0, 0)")
    page.reload()
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    assert page.locator("h1").count() == 1
    assert page.evaluate("[...document.querySelectorAll('h1,h2,h3')].map(h => +h.tagName[1])")[:3] == [1, 2, 2]


@WHATEVER_THE_WIDTH
def test_paper_shows_everything(page: Page) -> None:
    page.emulate_media(media="print")
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert not page.locator("nav").is_visible()
    assert page.evaluate("[...document.querySelectorAll('details')].every(d => d.open)")
    cut = "d => getComputedStyle(d).overflowX !== 'visible'"
    hidden = page.evaluate(f"[...document.querySelectorAll('.scroll')].filter({cut}).length")
    assert hidden == 0
    page.set_viewport_size({"width": 720, "height": 1000})  # about a page of A4
    beyond = "[...document.querySelectorAll('body *')].filter(e => e.getBoundingClientRect().right > innerWidth + 1)"
    assert page.evaluate(f"{beyond}.map(e => e.outerHTML.slice(0, 80))") == [], "nothing is cut off"


def test_the_best_policy_is_shown_and_not_made_twice(reported: Experiment, capsys: pytest.CaptureFixture[str]) -> None:
    best = best_records(read_records(reported)).get("cartpole")
    assert best is not None
    assert best.best is not None
    text = (reported.path / "report" / "index.html").read_text()
    assert f"{best.trial.id}" in text
    assert f"{best.best.score:.5g}".replace("-", "−") in text
    assert "the score by which trials are ranked" in text
    assert "reward: pole_angle" in text
    assert len(text) < 2e6
    strip = reported.path / "report" / "strip.png"
    before = strip.stat().st_mtime_ns
    assert run(main, [str(reported.path), "--device", "cpu"]) == 0
    assert strip.stat().st_mtime_ns == before
    assert "evaluating" not in capsys.readouterr().out
    # A strip of another policy, or a torn one, is not taken for this one's.
    assert strip_text(strip, "another") is None
