"""The page, served for all tests of a file, and a headless browser for all of them."""

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


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    found = shutil.which("chromium") or shutil.which("google-chrome")
    if found is None or sys.platform != "linux" or not hasattr(os, "fork"):
        pytest.skip("no chromium here")
    started = Browser(found, str(tmp_path_factory.mktemp("browser")))
    try:
        yield started
    finally:
        started.close()


@pytest.fixture
def browser(program: Browser) -> Iterator[Browser]:
    """The browser; the tabs of a test are closed after it."""
    yield program
    program.session = None
    for target in program.call("Target.getTargets")["targetInfos"]:
        if target["type"] == "page" and target["url"] != "about:blank":
            program.call("Target.closeTarget", targetId=target["targetId"])
