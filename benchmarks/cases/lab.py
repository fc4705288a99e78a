"""The lab page in a headless browser: a live run beside it, and a slider that is dragged."""

import itertools
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.programs import noack
from benchmarks.report import Goal, MeasurementError, Row, announce, benchmark
from benchmarks.rounds import Figures, Rounds
from tests.helpers.lab_browser import TEXT, Page, Served
from tests.helpers.live_runs import EPHEMERAL
from tools.screenshot_recording import BROWSERS, EMULATED_CARD, Browser

ROUNDS = 1
HORIZON_S = 10.0
ALONE, OPEN = "run without the page", "page open"
DRAGGED, VIEWED = "a slider moves", "viewer open"
_MOVE = """((slider, moves) => setInterval(() => {
  moves++ % 40 < 20 ? slider.stepDown() : slider.stepUp();
  slider.dispatchEvent(new Event("input", { bubbles: true }));
}, 50))(document.getElementById("lab-set-network.loss.probability"), 0)"""
"""Moves a slider to and fro, 20 times a second."""
_BUSY_PROCESSES = 4
_STROKES, _STROKE_S = 40, 0.15
_DRAGGED_SLIDER = "document.getElementById('lab-set-trigger.beta')"
_NOTE_STROKES = Path(__file__).parents[1] / "strokes.js"


@contextmanager
def _open_page(folder: Path, *settings: str, card: tuple[str, ...] = EMULATED_CARD) -> Iterator[Page]:
    """Show the lab page in a headless browser."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        raise MeasurementError("no Chromium or Chrome")
    browser = Browser(program, str(folder / "profile"), card)
    with closing(browser), Served(folder, "lane_following", *settings, *EPHEMERAL) as server:
        page = Page(browser, server.address)
        page.wait(f"{TEXT}.includes('certified')")
        yield page


def _strokes_ms(page: Page) -> list[float]:
    """Drag a slider; return the times from each move to its curve on the screen."""
    x, y, width = page.box(_DRAGGED_SLIDER)
    page.js(_NOTE_STROKES.read_text())
    page.mouse("mousePressed", x + 0.5 * width, y)
    time.sleep(1)  # the curve of this place is drawn
    for i in range(1, _STROKES + 1):
        page.mouse("mouseMoved", x + (0.5 + 0.005 * i) * width, y)
        time.sleep(_STROKE_S)
    return [float(stroke_ms) for stroke_ms in page.js("STROKES")]


def summary_of(side: str, folder: Path) -> dict[str, Any]:
    """Run a side; return the summary."""
    settings = ("--set", f"horizon_s={HORIZON_S}")
    if side == ALONE:
        return noack("run", "lane_following", *settings)
    with _open_page(folder, *settings) as page:
        if side == DRAGGED:
            page.js(_MOVE)
        if side != VIEWED:
            return noack("run", "lane_following", *settings)
        for button in ("live", "run live"):
            page.press_button(button)
        page.wait(f"{TEXT}.includes('completed {HORIZON_S:g} s')")
    summary: dict[str, Any] = json.loads((folder / "runs/latest/summary.json").read_bytes())
    return summary


@benchmark("stroke", "From a moved slider of the lab page to its curve on the screen")
def stroke() -> Iterator[Row]:
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
            ExitStack() as stack,
        ):
            for _ in range(processes):
                busy = stack.enter_context(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
                stack.callback(busy.kill)
            median_ms = median(_strokes_ms(page))
        yield Row(f"moved slider to painted curve, {name}", median_ms, "ms", goal=Goal("<=", goal_ms))


@benchmark("lab", "A live run while the lab page is open")
def lab() -> Iterator[Row]:
    """Measure the lateness of a live run while the lab page is open, which must not disturb the loop."""
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
