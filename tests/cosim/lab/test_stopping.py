"""A server that ends under an open page, and an end by Ctrl-C at any time."""

import time
from pathlib import Path
from urllib.parse import urlsplit

import pytest

pytest.importorskip("nicegui", reason="the extra `lab` is not installed")

from tests.cosim.lab.lab_browser import TEXT, Page, Served
from tests.integration import conftest as live
from tools.screenshot_recording import Browser

LOST = "getComputedStyle(document.getElementById('popup')).visibility === 'visible'"
NO_LOSS = "network.loss.probability=0"


def test_a_page_says_that_its_server_ended(browser: Browser, tmp_path: Path) -> None:
    with Served(tmp_path) as server:
        page = Page(browser, server.address)
        page.drag("loss probability", 0.0)
        page.wait(rf"/{NO_LOSS}(\.0)?(&|$)/.test(location.search)")
        settings = page.js("location.search")
    page.wait(LOST)
    assert "Start it again" in page.js("document.getElementById('popup').innerText")
    with Served(tmp_path, "--port", str(urlsplit(server.address).port)) as again:
        page.call("Page.reload")
        page.wait(f"{TEXT}.includes('open the one that its terminal shows')")
        page.go(again.address.partition("?")[0] + settings)
        page.wait(f"{TEXT}.includes(', 0 (0 %) lost')")


def test_ctrl_c_during_a_live_run_is_quiet_and_keeps_the_record(
    browser: Browser, tmp_path: Path
) -> None:
    with Served(tmp_path) as server:
        page = Page(browser, server.address)
        page.click("run live", ".q-tab")
        page.click("run live", "button")
        page.wait(f"{TEXT}.includes('all processes run')")
        page.drag("loss probability", 0.9)  # the draws are computed, too
    (run,) = [path for path in (tmp_path / "runs").iterdir() if not path.is_symlink()]
    deadline_s = time.monotonic() + live.PATIENCE_S
    while not (run / "summary.json").exists():
        assert time.monotonic() < deadline_s
        time.sleep(0.1)
