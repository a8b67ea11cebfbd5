"""A real browser without a window, for the tests of pages."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
WEBGL = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@contextmanager
def open_browser(webgl: bool = True) -> Iterator[Any]:
    """A headless Chromium, which draws a page in half the time without WebGL; the test is skipped, and says so, where
    there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright, which is not installed")
    with playwright.sync_playwright() as driver:
        own = Path(driver.chromium.executable_path)
        found = str(own) if own.exists() else next(filter(None, map(shutil.which, NAMES)), None)
        if found is None:
            pytest.skip("needs Chromium, and none is installed")
        switches = WEBGL if webgl else ["--disable-gpu"]
        browser = driver.chromium.launch(executable_path=found, args=["--no-sandbox", *switches])
        try:
            yield browser
        finally:
            browser.close()
