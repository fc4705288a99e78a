"""The page in a headless browser: dragging, mistakes, a live run, recorded runs, legibility."""

import json
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest

import noack

pytestmark = [pytest.mark.live, pytest.mark.system]

OpenPage = Callable[..., Any]
TEXT = "document.body.innerText"
VERDICT = "document.querySelector('.lab-verdict').innerText"
CURVE = "document.querySelector('.nicegui-echart canvas').toDataURL()"
PALE = "!!document.querySelector('.nicegui-echart.lab-stale')"


def row(label: str, value: object) -> str:
    """A condition: the tables have a row that begins with a label and ends with a value."""
    cells = "[...r.cells].map(c => c.innerText.trim())"
    rows = f"[...document.querySelectorAll('.lab-side tr')].map(r => {cells})"
    return f"{rows}.some(r => r[0] === {json.dumps(label)} && r.at(-1) === {json.dumps(str(value))})"


def test_dragging_changes_run_figure_and_text_and_is_compared_with_before(open_page: OpenPage) -> None:
    page = open_page()
    page.wait(f"{VERDICT}.includes('certified: ')")
    runs = [noack.simulate_exactly(noack.load("lane_following", {"horizon_s": 4.0} | settings))
            for settings in ({}, {"network.loss.probability": 0.0})]  # fmt: skip
    before, now = (len(run.event_s) for run in runs)
    page.wait(row("transmissions", before))
    picture = page.js(CURVE)
    page.drag("loss probability", 0.0)
    page.wait(row("transmissions", now))
    page.wait(row("lost", "0 (0 %)"))
    page.wait(f"{CURVE} !== {json.dumps(picture)}")
    page.click("all settings (TOML)")
    # The editor renders lines near the visible ones only.
    scrolled = "[...document.querySelectorAll('.cm-line')].at(-1)?.scrollIntoView()"
    page.wait(f"({scrolled}, {TEXT}.includes('probability = 0.0'))")
    page.click("keep for comparison")
    page.drag("lost in a row, at most", 1.0)
    page.wait(f"{TEXT}.includes('the kept run')")


def test_a_mistake_in_the_text_is_said_and_the_figure_pales(open_page: OpenPage) -> None:
    page = open_page()
    page.click("all settings (TOML)")
    editor = "document.querySelector('.cm-content')"
    page.wait(f"({editor}?.focus(), document.activeElement === {editor})")
    page.tab.keyboard.insert_text("horizon_s = -1\n")
    page.wait(f"{PALE} && {TEXT}.includes('not TOML: ')")  # the key is given twice


SMALL = """(() => {
  const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT), small = [];
  while (texts.nextNode()) {
    const {parentElement: at, data} = texts.currentNode;
    if (!data.trim() || !at.checkVisibility?.() || at.closest('script, style, .q-field__label')) continue;
    if (parseFloat(getComputedStyle(at).fontSize) < 13) small.push(data.trim());
  }
  return small;
})()"""


def test_text_is_large_and_has_contrast_and_nothing_is_wider_than_the_page(open_page: OpenPage) -> None:
    pytest.importorskip("axe_core_python", reason="axe-core-python is not installed")
    page = open_page()
    page.wait(f"{VERDICT}.includes('certified: ')")
    page.js(files("axe_core_python").joinpath("axe.min.js").read_text("utf-8"))
    found = page.js(
        "axe.run({runOnly: ['color-contrast', 'label', 'button-name']}).then(r => r.violations.flatMap("
        "v => v.nodes.map(n => v.id + ' ' + n.target + ': ' + n.failureSummary)))"
    )
    assert found == []
    assert page.js(SMALL) == []
    for source in ("explore", "live", "recorded"):
        page.resize(1280, 844)
        page.click(source)
        for width in (390, 800, 1280):
            page.resize(width, 844)
            page.wait("document.scrollingElement.scrollWidth <= innerWidth")


def test_the_settings_open_and_close_beside_the_figure_and_above_it(open_page: OpenPage) -> None:
    seen = "(r => r.right > 50 && r.left >= 0)(document.querySelector('.q-drawer').getBoundingClientRect())"
    for size, is_open in (((1280, 900), True), ((390, 844), False)):
        page = open_page(*size)
        for shown in (is_open, not is_open, is_open):
            page.wait(f"{seen} === {json.dumps(shown)}")
            page.js("document.querySelector('[aria-label=settings]').click()")


def test_a_live_run_ends_with_a_verdict_and_is_the_chosen_recorded_run(
    open_page: OpenPage, address: str, folder: Path
) -> None:
    page = open_page()
    page.click("recorded")
    page.wait(f"{TEXT}.includes('no run has ended')")
    page.click("live")
    page.wait(f"{VERDICT}.includes('five processes on this machine')")
    page.click("run live")
    page.wait(f"{VERDICT}.startsWith('running: ')")
    page.wait(f"{VERDICT}.startsWith('lateral offset was at most ')")
    outputs, completed, guarantee = [line for line in page.js(VERDICT).split("\n") if line][:3]
    assert outputs.endswith("consecutive packets were lost")
    assert completed.startswith("completed 4 s")
    assert guarantee.startswith("guarantee ")
    (run,) = [path for path in (folder / "runs").iterdir() if not path.is_symlink()]
    summary = noack.open_run(run).summary.loops[0]
    page.wait(row("transmissions", summary.events))
    page.click("replay")
    page.wait(f"{TEXT}.includes('bit-exact')")
    report = page.js("[...document.links].find(e => e.innerText.startsWith('report')).href")
    assert report == f"{address}report/{run.name}"
    # The report comes without scripts, and only for whom the page's address is known.
    page.tab.goto(report)
    page.wait(f"{TEXT}.includes('completed 4 s') && origin === 'null'")
    for wrong in (report.replace("/report/", "x/report/"), report + "x"):
        with pytest.raises(HTTPError) as error:
            urlopen(wrong)
        assert error.value.code == 404
        error.value.close()
