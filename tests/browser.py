"""A real browser for tests of pages: Debian's Chromium, driven by Playwright."""

import shutil
from contextlib import contextmanager

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
PATIENCE = 60_000
"""Beside other load things take their time [ms]."""


@pytest.fixture(scope="session")
def browser():
    """Chromium; the test is skipped where it or Playwright is not installed."""
    path = next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip("needs a browser: apt install chromium")
    playwright = pytest.importorskip("playwright.sync_api", reason="needs Playwright (pip)")
    with playwright.sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield chromium
        chromium.close()


@contextmanager
def opened(browser, url, *, first="", refused=False, **options):
    """A page whose scripts must not fail, with the addresses it asked for in `page.asked`.

    `first` is a script that runs before the page's own; `refused` says that the server may refuse
    what the page asks.
    """
    context = browser.new_context(reduced_motion="reduce", **options)
    context.set_default_timeout(PATIENCE)
    context.add_init_script(first)
    page = context.new_page()
    page.asked, troubles = [], []
    page.on("request", lambda request: page.asked.append(request.url))
    page.on("websocket", lambda socket: page.asked.append(socket.url))
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("console", lambda m: troubles.append(m.text) if m.type == "error" else None)
    page.goto(url)
    try:
        yield page
        assert [t for t in troubles if not (refused and "with a status of 4" in t)] == []
    finally:
        context.close()


def still(page):
    """Wait until the map has come to rest, from what was done to it just now as well."""
    page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    page.wait_for_selector('.map[data-state="still"]')
