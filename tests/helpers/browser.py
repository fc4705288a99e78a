"""A headless browser for tests."""

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tools.screenshot_recording import Browser


@contextmanager
def started(profile: Path, *card: str) -> Iterator[Browser]:
    """Start a headless browser within the context; skip the test if there is none."""
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None or sys.platform != "linux" or not hasattr(os, "fork"):
        pytest.skip("no chromium here")
    browser = Browser(program, str(profile), card)
    try:
        yield browser
    finally:
        browser.close()
