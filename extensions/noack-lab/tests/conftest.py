"""Servers of the page, and tabs of a headless browser that show it, as fixtures."""

import json
import re
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser
from playwright.sync_api import TimeoutError as PlaywrightTimeoutError

from noack_lab.live_run import noack_program
from tests.helpers.browser import started
from tests.helpers.waiting import PATIENCE_S

TEXT = "document.body.innerText"
_TWO_FRAMES = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"


@contextmanager
def served(folder: Path, *arguments: str) -> Iterator[str]:
    """Serve the page within the context, and end it by Ctrl-C; yield its address."""
    command = [noack_program(), "lab", "--no-browser", "--json", "--set", "horizon_s=4", *arguments]
    errors = folder / "errors.txt"
    with errors.open("w") as file:
        process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=file, text=True)
    assert process.stdout is not None
    try:
        yield json.loads(process.stdout.readline())["address"]
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=PATIENCE_S) == 0
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    # nicegui says so if the machine stalls for 2 s; it then names those that have not ended: none.
    text = re.sub(r"Could not cancel \d+ tasks within timeout: \n", "", errors.read_text())
    assert not text, text


class LabPage:
    """A tab of the browser that shows the page."""

    def __init__(self, browser: Browser, address: str, width: int = 1280, height: int = 900) -> None:
        self.tab = browser.new_page(viewport={"width": width, "height": height})
        self.tab.set_default_timeout(1e3 * PATIENCE_S)
        self.tab.goto(address)
        self.wait(f"{TEXT}.includes('transmissions')")  # it is connected

    def js(self, expression: str) -> Any:
        """Return the value of a JavaScript expression; a promise is awaited."""
        return self.tab.evaluate(expression)

    def wait(self, condition: str) -> None:
        """Wait until a JavaScript expression is true."""
        try:
            self.tab.wait_for_function(condition, polling=50)
        except PlaywrightTimeoutError:
            pytest.fail(f"{condition} does not become true of {self.js(TEXT)}")

    def click(self, text: str) -> None:
        """Click on a button whose text ends so, once it can be clicked."""
        element = (
            "[...document.querySelectorAll('button, .q-expansion-item .q-item')].find(e => !e.disabled && "
            "e.offsetParent && "
            f"e.innerText.replace('keyboard_arrow_down', '').trim().endsWith({json.dumps(text)}))"
        )
        self.wait(f"!!{element}")
        self.js(f"{element}.click()")

    def drag(self, label: str, to: float) -> None:
        """Drag the slider with a label to a share of its length."""
        x, y, width = self.js(
            "(e => { e.scrollIntoView({ block: 'center' }); const r = e.getBoundingClientRect(); "
            "return [r.x, r.y + r.height / 2, r.width]; })"
            f"(document.querySelector('.q-slider[aria-label^={json.dumps(label)}]'))"
        )
        self.tab.mouse.move(x + 0.4 * width, y)
        self.tab.mouse.down()
        for share in (0.45, to):
            self.tab.mouse.move(x + share * width, y)
            self.js(_TWO_FRAMES)  # the browser joins moves within a frame
        self.tab.mouse.up()

    def resize(self, width: int, height: int) -> None:
        """Give the window another size."""
        self.tab.set_viewport_size({"width": width, "height": height})
        self.js(_TWO_FRAMES)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("lab")


@pytest.fixture(scope="module")
def address(folder: Path) -> Iterator[str]:
    with served(folder) as address:
        yield address


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with started() as browser:
        yield browser


@pytest.fixture
def open_page(browser: Browser, address: str) -> Iterator[Callable[..., LabPage]]:
    """Open a tab; the tabs of a test are closed after it."""
    yield lambda *size: LabPage(browser, address, *size)
    for context in browser.contexts:
        context.close()
