"""Servers of the page and browsers for the tests, as fixtures."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.lab_browser import Served, started
from tools.screenshot_recording import EMULATED_CARD, Browser


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("lab")


@pytest.fixture(scope="module")
def address(folder: Path) -> Iterator[str]:
    with Served(folder, viewer=False) as server:
        yield server.address


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with started(tmp_path_factory.mktemp("browser")) as browser:
        yield browser


@pytest.fixture
def with_card(tmp_path: Path) -> Iterator[Browser]:
    """A browser with an emulated graphics card, which draws at a high cost, for rerun's viewer."""
    with started(tmp_path, *EMULATED_CARD) as browser:
        yield browser


@pytest.fixture
def browser(program: Browser) -> Iterator[Browser]:
    """The browser; the tabs of a test are closed after it."""
    yield program
    program.session = None
    for target in program.call("Target.getTargets")["targetInfos"]:
        if target["type"] == "page" and target["url"] != "about:blank":
            program.call("Target.closeTarget", targetId=target["targetId"])
