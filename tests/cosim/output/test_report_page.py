"""The report in a browser, for a screen reader, and with hostile input."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from cosim.analysis.summary.summary_model import RunSummary
from cosim.output import report_page
from cosim.output.figures.run_figures import run_figures
from cosim.output.page_kit import document_page
from cosim.output.report_page import Report, report_document, write_report
from cosim.record.run_directory import REPORT_FILE
from cosim.record.run_record import RunRecord
from noack.scenario.scenario_file import dumps as scenario_toml
from tests.cosim.output.conftest import CASES, HOSTILE, make_record, scenario_of
from tests.cosim.output.parsed_page import Page
from tests.helpers.browser import started
from tests.helpers.command_line import invoke
from tests.helpers.summaries import run_of_one_loop, summary_of

FIGURES = ["states", "errors", "state-norm", "input", "inter-event", "losses"]
TIMED = ["lateness", "latency"]
CLAIM = {
    "what": "controller error", "kind": "paper", "source": "theorem T", "bound": "‖e_c‖ ≤ 5 β e^(−αt)",
    "certified": 2.5, "observed": 0.4371, "ratio": 0.17484, "verdict": "held", "since_s": None,
    "until_s": None,
}  # fmt: skip
CLAIMS = [
    CLAIM,
    CLAIM | {"verdict": "ended", "since_s": 3.25, "cause": "losses", "detail": "recover 2"},
    CLAIM | {"verdict": "violated", "certified": 0.011, "ratio": None},
]


def written(record: RunRecord, run_dir: Path, **more: Any) -> tuple[Page, RunSummary]:
    """Write a report and check it."""
    (run_dir / "scenario.toml").write_text(scenario_toml(record.scenario), encoding="utf-8")
    summary = summary_of(record, **more)
    html = write_report(run_of_one_loop(record), summary, run_dir).read_text(encoding="utf-8")
    assert html.startswith("<!DOCTYPE html>")
    parsed = Page(html)
    check(parsed, html)
    return parsed, summary


def shown(record: RunRecord, **more: Any) -> str:
    """The text of a report without figures, which take most of the time."""
    html = document_page(report_document(Report(summary_of(record, **more), record.scenario, 0)))
    parsed = Page(html)
    check(parsed, html)
    return parsed.text


def check(parsed: Page, html: str) -> None:
    """Properties of every report."""
    ids = parsed.ids()
    assert len(ids) == len(set(ids))
    tags = {tag for tag, _ in parsed.tags}
    assert not tags & {"script", "link", "iframe", "object", "embed", "form", "base"}
    for tag, attributes in parsed.tags:
        for name, value in attributes.items():
            assert not name.startswith("on"), (tag, name)
            if name in ("src", "href", "action", "data", "srcset", "poster"):
                assert value is not None
                assert value.startswith(("#", "data:image/png")), value
            if value is not None:
                for address in re.findall(r"url\(([^)]*)\)", value):
                    assert address.startswith("#"), address
                for target in re.findall(r"(?:url\(|^)#([^)]+)", value if name != "style" else ""):
                    assert target in ids, target
    assert not re.search(r"@import|url\(", html.partition("<style>")[2].partition("</style>")[0])
    for attributes in parsed.attributes("svg"):
        assert attributes["role"] == "img"
        assert attributes["aria-label"]
    for attributes in parsed.attributes("img"):
        assert attributes["alt"]
    for attributes in parsed.attributes("th"):
        assert attributes.get("scope") in ("col", "row")
    assert parsed.attributes("html")[0]["lang"] == "en"
    assert "undefined" not in parsed.text.lower()
    assert len(html.encode()) < 2_000_000


def figure_names(parsed: Page) -> list[str]:
    return [(a["id"] or "").removeprefix("figure-") for a in parsed.attributes("figure")]


def test_the_report_of_a_live_run_is_complete(record: RunRecord, tmp_path: Path) -> None:
    (tmp_path / "environment.json").write_text(
        json.dumps({"started": "2020-01-02", "command": ["noack", "run"], "packages": {"a": "1.2"}})
    )
    page, _ = written(record, tmp_path, claims=CLAIMS)
    assert figure_names(page) == FIGURES + TIMED
    for claim in CLAIMS:
        for key in ("what", "source", "bound", "verdict"):
            assert str(claim[key]) in page.text
    reason = "losses beyond the guarantee (recover 2)"
    for number in ("2.5", "0.4371", "17.5 %", "ended at 3.250 s", reason, "0.011"):
        assert number in page.text
    assert scenario_toml(record.scenario) in page.text
    assert "guarantee broken since 0.000 s: violated: controller error" in page.text
    assert "started 2020-01-02" in page.text


OUTSIDE = """(() => {
  const within = (e, box, by) => (r => !r.width || (r.left > box.left - by && r.right < box.right + by
    && r.top > box.top - by && r.bottom < box.bottom + by))(e.getBoundingClientRect());
  const page = document.documentElement.getBoundingClientRect();
  const figures = [...document.querySelectorAll('figure svg')].filter(e => e.clientWidth);
  const fonts = e => (e.closest('.narrow') ? 8 : 9) * e.clientWidth / e.viewBox.baseVal.width;
  const tables = [...document.querySelectorAll('.scroll:has(table)')];
  const scrolled = tables.filter(e => e.scrollWidth > e.clientWidth);
  scrolled.forEach(e => { e.scrollLeft = 30; });
  const lost = scrolled.filter(e => !within(e.querySelector('tbody tr').firstElementChild, page, 0));
  return [figures.length, lost.length, document.scrollingElement.scrollWidth - innerWidth,
    figures.filter(e => fonts(e) < 10).length,
    figures.flatMap(e => [...e.querySelectorAll('use')].filter(
      u => !within(u, e.getBoundingClientRect(), 4))).length,
    [...document.querySelectorAll('main *')].filter(e => !e.closest('.scroll, pre, svg')
      && !within(e, page, 1)).map(e => e.outerHTML.slice(0, 80)).join()];
})()"""
"""Numbers of figures, of names that were scrolled away, of pixels beyond the page, of figures with
texts below 10 pixels, of their glyphs that are cut, and what is wider than the page."""


@pytest.mark.system
def test_nothing_is_cut_or_too_small_to_read_on_any_screen(record: RunRecord, tmp_path: Path) -> None:
    written(record, tmp_path, claims=CLAIMS)
    with started() as browser:
        page = browser.new_page()
        page.goto((tmp_path / REPORT_FILE).as_uri())
        for width in (390, 768, 847, 849, 1366, 1920):
            page.set_viewport_size({"width": width, "height": 844})
            assert page.evaluate(OUTSIDE) == [len(FIGURES + TIMED), 0, 0, 0, 0, ""], width


HOSTILE_NAME = "</title></svg><script>alert('x')</script> & {\"x"
"""A name may not have a $."""


def test_user_text_is_escaped(content: dict[str, Any], tmp_path: Path) -> None:
    content["description"] = HOSTILE
    scenario = scenario_of(content, 3, state_names=[HOSTILE_NAME, "_x", "y}"], input_names=[HOSTILE_NAME])
    parsed, _ = written(
        make_record(scenario),
        tmp_path,
        exit={"status": 1, "reason": HOSTILE},
        claims=[
            CLAIM
            | dict.fromkeys(("what", "source", "bound", "detail"), HOSTILE)
            | {"verdict": "unchecked", "cause": "no certificate"}
        ],
        conformance=[dict.fromkeys(("certificate", "document"), HOSTILE)],
        violations=[dict.fromkeys(("process", "cause", "what"), HOSTILE) | {"t_s": 1.0}],
        ideal_loop={"reason": HOSTILE},
        replay={"bit_exact": None, "error": HOSTILE},
        rejected_datagrams={HOSTILE: {HOSTILE: 3}},
        missing_samples=1,
        missing_by_table={HOSTILE: 1},
    )
    assert parsed.text.count(HOSTILE) >= 12
    assert parsed.attributes("title") == [{}]


@pytest.mark.parametrize("case", CASES)
def test_every_run_gets_a_report(case: str) -> None:
    record = CASES[case]()
    assert [*run_figures(record)] == FIGURES + TIMED
    shown(record)


@pytest.fixture
def dead_run(content: dict[str, Any], tmp_path: Path) -> Path:
    """The directory of a run in which all processes died before they recorded anything."""
    (tmp_path / "scenario.toml").write_text(scenario_toml(scenario_of(content)), encoding="utf-8")
    (tmp_path / "ending.json").touch()
    return tmp_path


def test_the_command_writes_a_missing_report_and_others_only_if_asked(
    dead_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also for a run that has not been finalized; without figures, which take most of the time."""
    monkeypatch.setattr(report_page, "run_figures", lambda *_, **__: {})
    ran = invoke("report", dead_run, "--json")
    assert ran.exit_code == 0, ran.output
    path = dead_run / REPORT_FILE
    assert json.loads(ran.stdout) == {"report": str(path)}
    parsed = Page(path.read_text(encoding="utf-8"))
    assert "the launcher ended early" in parsed.text
    path.write_text("as it was")
    assert invoke("report", dead_run).stdout == f"{path}\n"
    assert path.read_text() == "as it was"
    assert invoke("report", dead_run, "--again").exit_code == 0
    assert Page(path.read_text(encoding="utf-8")).text == parsed.text
