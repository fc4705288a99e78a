"""The lab page in a headless browser: a live run beside it, and a slider that is dragged.

Page and server are those of the tests (``tests/helpers/lab_browser.py``).
"""

import argparse
import itertools
import json
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.programs import FREE_PORTS, noack
from benchmarks.report import Figures, Goal, MeasurementError, Rounds, Row, announce, benchmark, median
from tests.helpers.lab_browser import TEXT, Page, Served
from tools.screenshot_recording import BROWSERS, EMULATED_CARD, Browser

ROUNDS = 1
HORIZON_S = 10.0
ALONE, OPEN = "run without the page", "page open"
DRAGGED, VIEWED = "a slider moves", "viewer open"
_MOVE_S = 0.05
"""Time between two moves of the slider."""
_KEYS = [("ArrowLeft", 37)] * 20 + [("ArrowRight", 39)] * 20
_SLIDER = "document.getElementById('lab-set-network.loss.probability')"
_BUSY_PROCESSES = 4
_STROKES, _STROKE_S = 40, 0.15
_DRAGGED_SLIDER = "document.getElementById('lab-set-trigger.beta')"
_BOX = f"""(slider => {{
  slider.scrollIntoView({{ block: "center" }});
  const r = slider.getBoundingClientRect();
  return [r.x, r.y + r.height / 2, r.width];
}})({_DRAGGED_SLIDER})"""
_NOTE_STROKES = Path(__file__).parents[1] / "strokes.js"


@contextmanager
def _open_page(folder: Path, *settings: str, card: tuple[str, ...] = EMULATED_CARD) -> Iterator[Page]:
    """Show the lab page in a headless browser."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        raise MeasurementError("no Chromium or Chrome")
    browser = Browser(program, str(folder / "profile"), card)
    with closing(browser), Served(folder, "lane_following", *settings, *FREE_PORTS) as server:
        page = Page(browser, server.address)
        page.wait(f"{TEXT}.includes('certified')")
        yield page


@contextmanager
def _moving(page: Page) -> Iterator[None]:
    """Move a slider to and fro meanwhile."""
    ended = threading.Event()

    def move() -> None:
        page.js(f"{_SLIDER}.focus()")
        for key, code in itertools.cycle(_KEYS):
            if ended.wait(_MOVE_S):
                return
            page.press(key, code)

    mover = threading.Thread(target=move)
    mover.start()
    try:
        yield
    finally:
        ended.set()
        mover.join()


def _strokes_ms(page: Page) -> list[float]:
    """Drag a slider; return the times from each move to its curve on the screen."""
    x, y, width = page.js(_BOX)
    page.js(_NOTE_STROKES.read_text())

    def mouse(kind: str, share: float) -> None:
        at = x + share * width
        page.call("Input.dispatchMouseEvent", type=kind, x=at, y=y, button="left", buttons=1, clickCount=1)

    mouse("mousePressed", 0.5)
    time.sleep(1)  # the curve of this place is drawn
    for i in range(1, _STROKES + 1):
        mouse("mouseMoved", 0.5 + 0.005 * i)
        time.sleep(_STROKE_S)
    return [float(stroke_ms) for stroke_ms in page.js("STROKES")]


def summary_of(side: str, folder: Path) -> dict[str, Any]:
    """Run a side; return the summary."""
    settings = ("--set", f"horizon_s={HORIZON_S}")
    arguments = ("run", "lane_following", *settings)
    if side == ALONE:
        return noack(*arguments).summary
    with _open_page(folder, *settings) as page:
        if side == OPEN:
            return noack(*arguments).summary
        if side == DRAGGED:
            with _moving(page):
                return noack(*arguments).summary
        for button in ("live", "run live"):
            page.press_button(button)
        page.wait(f"{TEXT}.includes('completed {HORIZON_S:g} s')")
    summary: dict[str, Any] = json.loads((folder / "runs/latest/summary.json").read_bytes())
    return summary


@contextmanager
def _busy(processes: int) -> Iterator[None]:
    """Keep the processor busy meanwhile."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


@benchmark("stroke", "From a moved slider of the lab page to its curve on the screen")
def stroke(options: argparse.Namespace) -> Iterator[Row]:
    """Measure the median time from a move of a dragged slider until its curve is painted.

    A frame of the browser is 17 ms. It draws by the processor, as it does without a graphics card;
    none is emulated, as the viewer would need.
    """
    for name, processes, goal_ms in (
        ("idle", 0, 60),
        (f"{_BUSY_PROCESSES} busy processes", _BUSY_PROCESSES, 120),
    ):
        announce(name)
        with (
            tempfile.TemporaryDirectory(prefix="noack-bench-", ignore_cleanup_errors=True) as folder,
            _open_page(Path(folder), "--set", "horizon_s=20", card=()) as page,
            _busy(processes),
        ):
            median_ms = median(_strokes_ms(page))
        yield Row(f"moved slider to painted curve, {name}", median_ms, "ms", goal=Goal("<=", goal_ms))


@benchmark("lab", "A live run while the lab page is open")
def lab(options: argparse.Namespace) -> Iterator[Row]:
    """Measure the lateness of a live run while the lab page is open: it must not disturb the loop.

    A run of the paper's example is measured alone; while the page is open in a headless browser;
    while a slider of it moves without pause; and started by the page, which then shows the viewer.
    Without a graphics card the browser draws by the processor, which is the worst case.
    """
    rounds, sides, roles = Rounds(), (ALONE, OPEN, DRAGGED, VIEWED), ("plant", "controller")

    def lateness_us(side: str) -> Figures:
        with tempfile.TemporaryDirectory(prefix="noack-bench-", ignore_cleanup_errors=True) as folder:
            summary = summary_of(side, Path(folder))
        if summary["exit"]["status"] != 0:
            raise MeasurementError(f"the run ended: {summary['exit']['reason']}")
        late = summary["loops"][0]["lateness_us"]
        return {role: late[role]["p99"] for role in roles}

    rounds.measure_in_turn(ROUNDS, {side: partial(lateness_us, side) for side in sides})
    for side, role in itertools.product(sides[1:], roles):
        name = f"{role} lateness, p99, {side}"
        yield rounds.row(name, "µs", role, side, ALONE, Goal("<=", 1.2), paired=True)
