"""A headless browser, in which pages have no network.

Each module of tests has its own, closed at its end: an open one leaves an event loop running in its thread, in which
neither a second one nor any `asyncio.run` may start.
"""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
# WebGL without a GPU
ARGUMENTS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")


@pytest.fixture(scope="module")
def browser() -> Iterator:
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install -e '.[dev]'")
    found = next(filter(None, map(shutil.which, NAMES)), None)
    with sync_api.sync_playwright() as playwright:
        if found is None and not Path(playwright.chromium.executable_path).is_file():
            pytest.skip("no Chromium: install your system's, or run `playwright install chromium`")
        browser = playwright.chromium.launch(executable_path=found, args=list(ARGUMENTS))
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def open_page(browser) -> Iterator[Callable]:
    """Opens a page from disk, which lists in `complaints` what it logs as a warning and what it asks of any network."""
    contexts = []

    def open_page(path: Path):
        context = browser.new_context(viewport={"width": 1400, "height": 1000}, offline=True, has_touch=True)
        contexts.append(context)
        page = context.new_page()
        page.complaints = []
        page.set_default_timeout(60_000)
        page.on("console", lambda said: said.type in ("error", "warning") and page.complaints.append(said.text))
        page.on("pageerror", lambda error: page.complaints.append(str(error)))
        page.on("request", lambda asked: asked.url.startswith("http") and page.complaints.append(asked.url))
        page.goto(path.resolve().as_uri())
        page.wait_for_selector("body[data-ready=yes]")
        return page

    yield open_page
    for context in contexts:
        context.close()
