"""The report in a real browser: on a telephone, on a desk, and on paper."""

import pytest
from chromium import ARGUMENTS, browser_or_skip
from main_job import main_job

PAPER = {"width": 720, "height": 1000}


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    return (main_job(tmp_path_factory).out / "report.html").as_uri()


@pytest.fixture(scope="module")
def browser():
    playwright, path = browser_or_skip()
    running = playwright.chromium.launch(executable_path=path, args=ARGUMENTS)
    yield running
    running.close()
    playwright.stop()


@pytest.mark.parametrize("width", [390, 1400])
def test_nothing_is_wider_than_the_screen(browser, report, width):
    page = browser.new_page(viewport={"width": width, "height": 900})
    page.goto(report)
    assert page.evaluate("document.documentElement.scrollWidth") == width
    cut = "[...document.querySelectorAll('pre')].some(e => e.scrollWidth > e.clientWidth)"
    assert not page.evaluate(cut)
    # The result and the gravest warning are on the first screen.
    warning = page.locator(".warnings p").first
    assert "of its stated size" in warning.inner_text()
    assert warning.bounding_box()["y"] < 900
    page.close()


def test_numbers_are_copied_by_a_button(browser, report):
    page = browser.new_page()
    page.goto(report)
    page.evaluate("navigator.clipboard.writeText = async text => { window.copied = text; }")
    button = page.locator(".form", has_text="quaternion").first.get_by_role("button")
    button.click()
    assert page.evaluate("window.copied") == page.locator(".form pre").nth(2).inner_text()
    assert button.inner_text() == "copied"
    page.close()


def test_on_paper_there_is_a_line_to_sign_with_date_and_data(browser, report):
    page = browser.new_page(viewport=PAPER)
    page.goto(report)
    signature = page.locator(".signature")
    assert not signature.is_visible()
    page.emulate_media(media="print")
    assert signature.is_visible()
    assert "Data set: the sample. 20" in signature.inner_text()
    assert "Signature" in signature.inner_text()
    assert not page.locator("button.copy").first.is_visible()
    page.close()
