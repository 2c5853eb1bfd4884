"""Headless Chromium for the tests of pages."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest

WORDS = (
    "headless",
    "no-sandbox",
    "no-first-run",
    "disable-background-networking",
    "disable-component-update",
    "disable-sync",
    "use-angle=swiftshader",
    "enable-unsafe-swiftshader",
)


@contextmanager
def headless(
    width: int, height: int, words: Sequence[str] = (), logs: dict[str, str] | None = None
) -> Iterator[Any]:
    """A window of that many pixels, with a profile of its own; skips where there is no Chromium.

    Args:
        width, height: of the window.
        words: further options of the command line.
        logs: which are kept, and from which level on.
    """
    webdriver = pytest.importorskip("selenium.webdriver")
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not (chromium and driver):
        pytest.skip("chromium and chromedriver are not installed")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        own = (f"window-size={width},{height}", f"user-data-dir={profile}")
        for word in (*WORDS, *words, *own):
            options.add_argument(f"--{word}")
        if logs:
            options.set_capability("goog:loggingPrefs", logs)
        window = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
        try:
            yield window
        finally:
            window.quit()
