"""The lab page for tests and benchmarks: its server, and a tab of a headless browser that shows it."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import pytest

from tests.helpers.live_runs import WITHOUT_VIEWER, noack_command
from tests.helpers.waiting import PATIENCE_S
from tools.screenshot_recording import Browser

SLIDERS = "document.querySelectorAll('.lab-slider').length"
_TWO_FRAMES = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
TEXT = "document.body.innerText"


class Served:
    """A server of the page, whose errors are in a file; a context that ends it by Ctrl-C."""

    def __init__(self, folder: Path, *arguments: str, viewer: bool = True) -> None:
        self.errors = folder / "errors.txt"
        command = noack_command("lab", "--no-browser", "--json", "--set", "horizon_s=4", *arguments)
        environment = os.environ | ({} if viewer else WITHOUT_VIEWER)
        with self.errors.open("w") as errors:
            self._process = subprocess.Popen(
                command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=errors, text=True
            )
        assert self._process.stdout is not None
        text = "".join(iter(self._process.stdout.readline, "}\n")) + "}"
        self.address: str = json.loads(text)["address"]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.send_signal(signal.SIGINT)
        try:
            assert self._process.wait(timeout=PATIENCE_S) == 0
        finally:
            self._process.kill()
            assert self._process.stdout is not None
            self._process.stdout.close()
        # nicegui says so if the machine stalls for 2 s; it then names those that have not ended: none.
        errors = re.sub(r"Could not cancel \d+ tasks within timeout: \n", "", self.errors.read_text())
        assert not errors, errors


class Page:
    """A tab of the browser."""

    def __init__(
        self,
        browser: Browser,
        address: str,
        *,
        size: tuple[int, int] = (1280, 900),
        scheme: str = "light",
    ) -> None:
        self.browser = browser
        browser.open("about:blank", *size)
        preferred = [{"name": "prefers-color-scheme", "value": scheme}]
        browser.call("Emulation.setEmulatedMedia", features=preferred)
        browser.call("Emulation.setFocusEmulationEnabled", enabled=True)
        self._session = browser.session
        self.go(address)

    def go(self, address: str) -> None:
        """Open an address and wait until the page can be used."""
        self.call("Page.navigate", url=address)
        self.wait(f"{SLIDERS} > 5 && {TEXT}.includes('transmissions')")  # it is connected

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command to this tab."""
        self.browser.session = self._session
        return self.browser.call(method, **parameters)

    def press(self, key: str, code: int) -> None:
        """Press a key, given by its name and its Windows code."""
        text = {"text": "\r"} if key == "Enter" else {}  # without it a plain button is not pressed
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent",
                type=kind, key=key, code=key, windowsVirtualKeyCode=code, **text,
            )  # fmt: skip

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

    def click(self, text: str, kind: str) -> None:
        """Click on the last element of a kind whose text ends so."""
        element = (
            f"[...document.querySelectorAll('{kind}')].filter(e => e.offsetParent && "
            f"e.innerText.trim().toLowerCase().endsWith({json.dumps(text)}))"
        )
        self.wait(f"{element}.length > 0")
        self.js(f"{element}.at(-1).click()")

    def press_button(self, text: str) -> None:
        """Click on a button with the mouse, once it can be clicked; again if it moved meanwhile."""
        element = (
            f"[...document.querySelectorAll('button')].find(e => !e.disabled && e.offsetParent && "
            f"e.innerText.trim().toLowerCase().endsWith({json.dumps(text)}))"
        )
        self.js("window.pressed = false")
        deadline_s = time.monotonic() + PATIENCE_S
        while not self.js("window.pressed"):
            assert time.monotonic() < deadline_s, text
            self.wait(f"!!{element}")
            self.js(
                f"{element}.addEventListener('click', () => {{ window.pressed = true; }}, {{ once: true }})"
            )
            x, y, width = self.box(element)
            for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
                self.mouse(kind, x + width / 2, y)

    def box(self, element: str) -> tuple[float, float, float]:
        """Scroll to an element; return its left edge, its middle's height, and its width."""
        x, y, width = self.js(
            "(e => { e.scrollIntoView({ block: 'center' }); const r = e.getBoundingClientRect(); "
            f"return [r.x, r.y + r.height / 2, r.width]; }})({element})"
        )
        return x, y, width

    def mouse(self, kind: str, x: float, y: float) -> None:
        """Move, press or release the mouse."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def unfold(self, title: str) -> None:
        """Open a part of the settings."""
        element = (
            "[...document.querySelectorAll('summary, .q-expansion-item .q-item')].filter(e => "
            f"e.innerText.replace('keyboard_arrow_down', '').trim() === {json.dumps(title)})"
        )
        self.wait(f"{element}.length > 0")
        self.js(f"{element}[0].click()")

    def resize(self, width: int, height: int) -> None:
        """Give the window another size."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height,
                  deviceScaleFactor=1, mobile=False)  # fmt: skip
        self.js(_TWO_FRAMES)

    def drag(self, label: str, to: float) -> None:
        """Drag the slider with a label to a share of its length."""
        slider = (
            "[...document.querySelectorAll('.lab-slider')].find(e => "
            f"e.innerText.startsWith({json.dumps(label)})).querySelector('input')"
        )
        x, y, width = self.box(slider)
        for kind, share in (("mousePressed", 0.4), ("mouseMoved", 0.45), ("mouseMoved", to),
                            ("mouseReleased", to)):  # fmt: skip
            self.mouse(kind, x + share * width, y)
            self.js(_TWO_FRAMES)  # the browser joins moves within a frame


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
