"""Servers of the page, and tabs of a headless browser that show it, as fixtures."""

import json
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from noack_lab.live_run import noack_program
from tests.helpers.browser import started
from tests.helpers.waiting import PATIENCE_S
from tools.screenshot_recording import Browser

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


class Page:
    """A tab of the browser."""

    def __init__(self, browser: Browser, address: str, size: tuple[int, int] = (1280, 900)) -> None:
        self._browser = browser
        browser.open("about:blank", *size)
        browser.call("Emulation.setFocusEmulationEnabled", enabled=True)
        self._session = browser.session
        self.call("Page.navigate", url=address)
        self.wait(f"{TEXT}.includes('transmissions')")  # it is connected

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command to this tab."""
        self._browser.session = self._session
        return self._browser.call(method, **parameters)

    def js(self, expression: str) -> Any:
        """Return the value of a JavaScript expression; a promise is awaited."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        return answer["result"].get("value")

    def wait(self, condition: str) -> None:
        """Wait until a JavaScript expression is true."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not self.js(condition):
            assert time.monotonic() < deadline_s, (condition, self.js(TEXT))
            time.sleep(0.05)

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
        moves = ("mousePressed", 0.4), ("mouseMoved", 0.45), ("mouseMoved", to), ("mouseReleased", to)
        for kind, share in moves:
            self.call("Input.dispatchMouseEvent", type=kind, x=x + share * width, y=y,
                      button="left", buttons=1, clickCount=1)  # fmt: skip
            self.js(_TWO_FRAMES)  # the browser joins moves within a frame

    def resize(self, width: int, height: int) -> None:
        """Give the window another size."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height,
                  deviceScaleFactor=1, mobile=False)  # fmt: skip
        self.js(_TWO_FRAMES)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("lab")


@pytest.fixture(scope="module")
def address(folder: Path) -> Iterator[str]:
    with served(folder) as address:
        yield address


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with started(tmp_path_factory.mktemp("browser")) as browser:
        yield browser


@pytest.fixture
def open_page(program: Browser, address: str) -> Iterator[Callable[..., Page]]:
    """Open a tab; the tabs of a test are closed after it."""
    yield lambda *size: Page(program, address, size or (1280, 900))
    program.session = None
    for target in program.call("Target.getTargets")["targetInfos"]:
        if target["type"] == "page" and target["url"] != "about:blank":
            program.call("Target.closeTarget", targetId=target["targetId"])
