"""The page, served for all tests of a file, and a headless browser for each test."""

import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cosim.lab.lab_browser import Served
from tools.screenshot_recording import Browser


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("lab")


@pytest.fixture(scope="module")
def address(folder: Path) -> Iterator[str]:
    with Served(folder) as server:
        yield server.address


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None or sys.platform != "linux" or not hasattr(os, "fork"):
        pytest.skip("no chromium here")
    started = Browser(program, str(tmp_path))
    try:
        yield started
    finally:
        started.close()
