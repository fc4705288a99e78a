"""Lateness of a live run while the lab page is open: it must not disturb the loop.

A run of the paper's example is measured alone; while the page is open in a headless browser; while
a slider of it moves without pause; and started by the page, which then shows the viewer. Without a
graphics card the browser draws by the processor, which is the worst case.
"""

import argparse
import itertools
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks._report import Benchmark, Figures, Goal, MeasurementError, Rounds, Row, say
from benchmarks._runs import FREE_PORTS, noack
from tools.screenshot_recording import BROWSERS, Browser

ROUNDS = 3
HORIZON_S = 10.0
ALONE, OPEN = "run without the page", "page open"
DRAGGED, VIEWED = "a slider moves", "viewer open"
_SETTINGS = ("--set", f"horizon_s={HORIZON_S}")
_PATIENCE_S = 120.0
_MOVE_S = 0.05
_KEYS = [("ArrowLeft", 37)] * 20 + [("ArrowRight", 39)] * 20
_SLIDER = "document.querySelector('.q-slider[aria-label=\"loss probability\"] [tabindex]')"


class _Page:
    """The page in a headless browser."""

    def __init__(self, browser: Browser, address: str) -> None:
        self._browser = browser
        browser.open(address, 1280, 900)
        self.wait(f"!!{_SLIDER} && document.body.innerText.includes('certified')")

    def js(self, expression: str) -> Any:
        """Return the value of an expression."""
        found = self._browser.call("Runtime.evaluate", expression=expression, returnByValue=True)
        return found["result"].get("value")

    def wait(self, condition: str) -> None:
        """Wait until a condition holds."""
        deadline_s = time.monotonic() + _PATIENCE_S
        while not self.js(condition):
            if time.monotonic() > deadline_s:
                text = self.js("document.body.innerText")
                raise MeasurementError(f"the page does not reach {condition}: {text}")
            time.sleep(0.2)

    def move(self, until: threading.Event) -> None:
        """Move a slider to and fro."""
        self.js(f"{_SLIDER}.focus()")
        for key, code in itertools.cycle(_KEYS):
            if until.wait(_MOVE_S):
                return
            for kind in ("rawKeyDown", "keyUp"):
                self._browser.call("Input.dispatchKeyEvent", type=kind, key=key, code=key,
                                   windowsVirtualKeyCode=code)  # fmt: skip

    def run_live(self) -> None:
        """Run live by the page, until it says that the run ended."""
        for kind in (".q-tab", "button"):
            self.js(
                f"[...document.querySelectorAll('{kind}')].filter("
                "e => e.innerText.trim().toLowerCase().endsWith('run live')).at(-1).click()"
            )
            time.sleep(0.5)
        self.wait(f"document.body.innerText.includes('ended: {HORIZON_S} of')")


@contextmanager
def _opened(folder: Path) -> Iterator[_Page]:
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        raise MeasurementError("no Chromium or Chrome")
    command = [sys.executable, "-m", "cosim.cli", "lab", "lane_following", "--no-browser", "--json"]
    server = subprocess.Popen([*command, *_SETTINGS, *FREE_PORTS], cwd=folder,
                              stdout=subprocess.PIPE, text=True)  # fmt: skip
    assert server.stdout is not None
    browser = Browser(program, str(folder / "profile"))
    try:
        address = json.loads("".join(iter(server.stdout.readline, "}\n")) + "}")["address"]
        yield _Page(browser, address)
    finally:
        browser.close()
        server.send_signal(signal.SIGINT)
        server.wait()


def summary_of(side: str, folder: Path) -> dict[str, Any]:
    """Run a side; return the summary."""
    arguments = ("run", "lane_following", *_SETTINGS)
    if side == ALONE:
        return noack(*arguments).summary
    with _opened(folder) as page:
        if side == VIEWED:
            page.run_live()
        else:
            ended = threading.Event()
            mover = threading.Thread(target=page.move, args=(ended,))
            if side == DRAGGED:
                mover.start()
            try:
                return noack(*arguments).summary
            finally:
                ended.set()
                if side == DRAGGED:
                    mover.join()
    found: dict[str, Any] = json.loads((folder / "runs/latest/summary.json").read_bytes())
    return found


def lateness(side: str) -> Figures:
    """Return the lateness of plant and controller, p99, µs."""
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as folder:
        summary = summary_of(side, Path(folder))
    if summary["exit"]["status"] != 0:
        raise MeasurementError(f"the run ended: {summary['exit']['reason']}")
    late = summary["loops"][0]["lateness_us"]
    return {role: late[role]["p99"] for role in ("plant", "controller")}


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure all sides in turn."""
    rounds, sides, goal = Rounds(), (ALONE, OPEN, DRAGGED, VIEWED), Goal("<=", 1.2)
    for i, side in itertools.product(range(ROUNDS), sides):
        say(f"round {i + 1} of {ROUNDS}: {side}")
        rounds.add(side, lateness(side))
    return [
        rounds.row(f"{role} lateness, p99, {side}", "µs", role, side, ALONE, goal, paired=True)
        for side in sides[1:]
        for role in ("plant", "controller")
    ]


BENCHMARK = Benchmark("lab", "A live run while the lab page is open", measure)
