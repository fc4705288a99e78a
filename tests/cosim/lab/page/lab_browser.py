"""A tab of a headless browser that shows the page, for the tests."""

import json
import time
from typing import Any

from tests.integration import conftest as live
from tools.screenshot_recording import Browser

SLIDERS = "document.querySelectorAll('.q-slider').length"
TEXT = "document.body.innerText"


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
        browser.call("Page.navigate", url=address)
        self.wait(f"{SLIDERS} > 5 && {TEXT}.includes('transmissions')")  # it is connected

    def js(self, expression: str) -> Any:
        found = self.browser.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        return found["result"].get("value")

    def wait(self, condition: str) -> None:
        deadline_s = time.monotonic() + live.PATIENCE_S
        while not self.js(condition):
            assert time.monotonic() < deadline_s, (condition, self.js(TEXT))
            time.sleep(0.05)

    def click(self, text: str, kind: str) -> None:
        found = (
            f"[...document.querySelectorAll('{kind}')].filter(e => "
            f"e.innerText.trim().toLowerCase().endsWith({json.dumps(text)}))"
        )
        self.wait(f"{found}.length > 0")
        self.js(f"{found}.at(-1).click()")

    def drag(self, label: str, to: float) -> None:
        """Drag the slider with a label to a share of its length."""
        place = (
            f"(() => {{ const s = [...document.querySelectorAll('.q-slider')].find(e => "
            f"e.previousElementSibling.innerText.startsWith({json.dumps(label)})); "
            "const r = s.getBoundingClientRect(); return [r.x, r.y + r.height / 2, r.width]; })()"
        )
        x, y, width = self.js(place)
        for kind, share in (("mousePressed", 0.4), ("mouseMoved", 0.45), ("mouseMoved", to),
                            ("mouseReleased", to)):  # fmt: skip
            self.browser.call(
                "Input.dispatchMouseEvent", type=kind, x=x + share * width, y=y, button="left",
                buttons=1, clickCount=1,
            )  # fmt: skip
