"""The browser that pages are looked at in."""

from __future__ import annotations

import os
import shutil

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def found_browser() -> str:
    """The browser that CHROMIUM names, or the first on the PATH; the test is skipped where there is none."""
    named = os.environ.get("CHROMIUM")
    if named is not None and shutil.which(named) is None:
        pytest.fail(f"CHROMIUM is {named}, which cannot be run")
    browser = named or next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip(
            f"CHROMIUM is not set, and none of {', '.join(BROWSERS)} is here: no page is looked at in a browser"
        )
    return browser
