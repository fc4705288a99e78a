"""The page in a headless browser: dragging, mistakes, two tabs, recorded runs, a live run."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("nicegui", reason="the extra `lab` is not installed")

from tests.integration import conftest as live
from tools.screenshot_recording import Browser

SLIDERS = "document.querySelectorAll('.q-slider').length"
TEXT = "document.body.innerText"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("lab")


@pytest.fixture(scope="module")
def address(folder: Path) -> Iterator[str]:
    command = live.noack_command("lab", "--no-browser", "--json", "--set", "horizon_s=4")
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            text = "".join(iter(server.stdout.readline, "}\n")) + "}"
            yield json.loads(text)["address"]
        finally:
            server.send_signal(signal.SIGINT)
            assert server.wait(timeout=live.PATIENCE_S) in (0, 130)


class Page:
    """A tab of the browser."""

    def __init__(self, browser: Browser, address: str) -> None:
        self.browser = browser
        browser.open(address, 1280, 900)
        self.wait(f"{SLIDERS} > 5 && {TEXT}.includes('transmissions')")  # it is connected

    def js(self, expression: str) -> Any:
        found = self.browser.call("Runtime.evaluate", expression=expression, returnByValue=True)
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


def test_dragging_changes_the_run_and_the_address(browser: Browser, address: str) -> None:
    page = Page(browser, address)
    page.wait(f"{TEXT}.includes('certified: every loss pattern')")
    page.drag("maximum consecutive losses", 1.0)
    page.wait("location.search.includes('network.mansd=20')")
    page.wait(f"{TEXT}.includes('no certificate') || {TEXT}.includes('certified: ')")
    page.drag("loss probability", 0.0)
    page.wait(f"{TEXT}.includes('lost\\n0')")
    page.wait(r"/loss\.probability=0(\.0)?(&|$)/.test(location.search)")
    # The address has the settings: another tab opens them.
    other = Page(browser, page.js("location.href"))
    other.wait(f"{TEXT}.includes('lost\\n0')")


def test_a_wrong_address_says_so(browser: Browser, address: str) -> None:
    address = address.partition("?")[0]
    page = Page(browser, f"{address}?scenario=lane_following&trigger.beta=-1")
    page.wait(f"{TEXT}.includes('trigger.beta')")
    page = Page(browser, f"{address}?scenario=/etc/passwd")
    page.wait(f"{TEXT}.includes('an address opens shipped scenarios')")


def test_a_live_run_ends_and_is_among_the_recorded_ones(
    browser: Browser, address: str, folder: Path
) -> None:
    page = Page(browser, address)
    page.click("run live", ".q-tab")
    page.click("run live", "button")
    page.wait(f"{TEXT}.includes('ended: 4.0 of 4 s')")
    assert page.js("!!document.querySelector('iframe').src.startsWith('http://127.0.0.1:')")
    page.click("recorded runs", ".q-tab")
    (run,) = [path for path in (folder / "runs").iterdir() if not path.is_symlink()]
    page.click("refresh", "button")
    page.js(
        "[...document.querySelectorAll('.q-select')].at(-1).querySelector('.q-field__native').click()"
    )
    page.click(run.name, ".q-item")
    page.click("replay", "button")
    page.wait(f"{TEXT}.includes('bit-exact')")
