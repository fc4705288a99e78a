"""The page in a headless browser: dragging, mistakes, two tabs, recorded runs, a live run."""

import json
from importlib.resources import files
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest

import noack
from cosim.simulation.continuous import run_continuous
from noack.scenario.resolution import resolve
from tests.helpers import live_runs as live
from tests.helpers.lab_browser import TEXT, Page, Served
from tools.screenshot_recording import Browser

pytestmark = pytest.mark.system

pytest.importorskip("nicegui", reason="the extra `lab` is not installed")


VERDICT = "document.getElementById('lab-verdict').innerText"
COMPARED = "document.getElementById('lab-compare').innerText"
PIXELS = "LAB.figure.panels.map(panel => panel.canvas.toDataURL()).join()"


def test_dragging_changes_the_run_and_the_address(browser: Browser, address: str) -> None:
    page = Page(browser, address)
    page.wait(f"{VERDICT}.includes('guarantee kept: ‖e_c‖ was at most')")
    page.drag("maximum consecutive losses", 1.0)
    page.wait("location.search.includes('network.mansd=20')")
    page.wait(f"{VERDICT}.includes('guarantee kept') || {VERDICT}.includes('not checkable')")
    page.drag("loss probability", 0.0)
    page.wait(f"{TEXT}.includes('lost\\n0')")
    page.wait(r"/loss\.probability=0(\.0)?(&|$)/.test(location.search)")
    # The address has the settings: another tab opens them.
    other = Page(browser, page.js("location.href"))
    other.wait(f"{TEXT}.includes('lost\\n0')")
    # From then on, each tab has its own settings.
    other.drag("loss probability", 1.0)
    other.wait("location.search.includes('network.loss.probability=1')")
    assert page.js(r"/loss\.probability=0(\.0)?(&|$)/.test(location.search)")
    address = address.partition("?")[0]
    page.go(f"{address}?scenario=lane_following&trigger.beta=-1")
    page.wait(f"{TEXT}.includes('trigger.beta')")
    page.go(f"{address}?scenario=/etc/passwd")
    page.wait(f"{TEXT}.includes('an address opens shipped scenarios')")


def counts(scenario: str, **settings: object) -> list[str]:
    """Return the numbers of transmissions and losses, from the exact simulation."""
    run = run_continuous(resolve(noack.load(scenario, settings)))
    return [str(len(run.event_s)), str(int((~run.delivered).sum()))]


def test_a_kept_run_is_drawn_beside_the_next_one_and_the_difference_is_said(
    browser: Browser, address: str
) -> None:
    page = Page(browser, address)
    page.drag("β, threshold at the start", 1.0)  # of itself compared with what was before
    # A page that was busy during the drag may compare with where the slider was on its way.
    page.wait(f"{COMPARED}.includes('trigger.beta') && {COMPARED}.includes('→ 5.0')")
    page.press_button("keep for comparison")
    page.wait(f"{COMPARED}.includes('the kept run') && {COMPARED}.includes('are the same')")
    empty_pixels = page.js(PIXELS)
    page.drag("β, threshold at the start", 0.0)
    page.wait(f"{COMPARED}.includes('trigger.beta 5.0 → 0.05')")
    assert page.js(PIXELS) != empty_pixels
    rows = [row.split("\t") for row in page.js(COMPARED).split("\n") if "\t" in row]
    kept, now = (counts("lane_following", **{"horizon_s": 4.0, "trigger.beta": beta}) for beta in (5.0, 0.05))
    assert [row[1:3] for row in rows[1:3]] == [list(pair) for pair in zip(kept, now, strict=True)]
    assert rows[1][3] == f"{int(now[0]) - int(kept[0])} more"
    assert rows[3][0] == "‖x‖ at the end"
    assert rows[4][0] == "largest ‖e_c‖"
    pixels = page.js(PIXELS)
    page.js("document.querySelector('.lab-bar [role=checkbox]').click()")
    page.wait(f"document.getElementById('lab-compare').hidden && {PIXELS} !== {json.dumps(pixels)}")


SOURCES = ("explore", "live", "recorded")
WIDTHS = {"light": (390, 600, 801, 1000, 1400), "dark": (390,)}
"""The layout does not depend on the colours."""
SMALL = """(() => {
  const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT), small = [];
  while (texts.nextNode()) {
    const {parentElement: at, data} = texts.currentNode;
    if (!data.trim() || !at.checkVisibility?.() || at.closest('script, style')) continue;
    if (parseFloat(getComputedStyle(at).fontSize) < 13) small.push(data.trim());
  }
  return small;
})()"""
ACCESSIBLE = ("wcag2a", "wcag2aa", "wcag21a", "wcag21aa")
RULES = {"light": ACCESSIBLE, "dark": ("color-contrast",)}
EDITOR = {"light": "=== 'rgb(255, 255, 255)'", "dark": "!== 'rgb(255, 255, 255)'"}


def violations(page: Page, *rules: str, except_in: str = "iframe") -> list[str]:
    """Return what axe-core finds by rules of its, as one line per element."""
    pytest.importorskip("axe_core_python", reason="axe-core-python is not installed")
    if not page.js("!!window.axe"):
        page.js(files("axe_core_python").joinpath("axe.min.js").read_text("utf-8"))
    options = json.dumps({"runOnly": rules, "iframes": False})
    texts = page.js(
        f"axe.run({{exclude: [['iframe'], ['{except_in}']]}}, {options}).then(r => r.violations.flatMap("
        "v => v.nodes.map(n => v.id + ' ' + n.target + ': ' + n.failureSummary)))"
    )
    return [] if texts is None else list(texts)


@pytest.mark.parametrize(("scheme", "size"), [("light", (1280, 900)), ("dark", (390, 844))])
def test_text_is_large_and_has_contrast_and_nothing_is_wider_than_the_page(
    browser: Browser, address: str, scheme: str, size: tuple[int, int]
) -> None:
    page = Page(browser, address, size=size, scheme=scheme)
    page.js("document.head.insertAdjacentHTML('beforeend', '<style>*{transition:none !important}')")
    page.js("localStorage.removeItem('lab-drawer'), labDrawer(true, false), labToggleGuide()")
    for part in ("all settings (TOML)",):
        page.unfold(part)
    page.wait("!!document.querySelector('.cm-content[aria-label]')")
    page.wait(f"getComputedStyle(document.querySelector('.cm-editor')).backgroundColor {EDITOR[scheme]}")
    page.wait(f"{TEXT}.includes('assumed (')")
    for source in SOURCES:
        page.click(source, "button")
        page.wait(f"document.body.dataset.labSource === {source!r}")
        # The drawer, half of the page, is the same for every source.
        assert violations(page, *RULES[scheme], except_in="#lab-drawer") == [], source
        assert page.js(SMALL) == [], source
        for width in WIDTHS[scheme]:
            page.resize(width, size[1])
            assert page.js("document.scrollingElement.scrollWidth <= innerWidth"), (source, width)
            place = page.js("document.getElementById('lab-figure').getBoundingClientRect().top")
            assert place < 260, (source, width)  # it is the first thing below the bar
        page.resize(*size)


FOCUSED = """(() => {
  const at = document.activeElement, shown = at.closest('.q-field') || at;
  const seen = [at, shown].some(e => getComputedStyle(e).boxShadow.includes('rgb(199, 119, 0)'));
  const label = at.labels?.[0]?.innerText || at.closest('label')?.innerText.split('\\n')[0];
  return [at.ariaLabel || label || at.innerText.split('\\n').pop(), seen, at === document.body];
})()"""


def reached_by_tab(page: Page) -> list[str]:
    """Return the names of what the tabulator key reaches."""
    reached: list[str] = []
    for _ in range(60):
        page.press("Tab", 9)
        name, seen, outside = page.js(FOCUSED)
        if outside or name in reached[:1]:
            break
        assert seen, name
        reached.append(name)
        if name == "loss probability":
            page.press("ArrowLeft", 37)
            page.wait("location.search.includes('network.loss.probability=0.79')")
    return reached


def test_the_keyboard_reaches_and_moves_everything(browser: Browser, address: str) -> None:
    page = Page(browser, address)
    page.js("localStorage.clear()")
    reached = reached_by_tab(page)
    labels = page.js("[...document.querySelectorAll('#lab-controls label')].map(e => e.innerText)")
    assert {*labels, "settings", "tutorial", "scenario", "files", "dark or light"} <= {*reached}
    assert {*SOURCES[:1], "keep for comparison", "compare", "drawn state"} <= {*reached}


def test_the_drawer_opens_and_closes_by_the_keyboard_and_stays_so(browser: Browser, address: str) -> None:
    button = "document.querySelector('.lab-drawer-button')"
    page = Page(browser, address, size=(390, 844))
    assert page.js(f"{button}.ariaExpanded") == "false"  # a small screen shows the figure first
    for state in ("true", "false"):
        page.js(f"{button}.focus()")
        page.press("Enter", 13)
        page.wait(f"{button}.ariaExpanded === '{state}'")
        page.go(address)
        assert page.js(f"{button}.ariaExpanded") == state  # it is remembered
        assert page.js("document.getElementById('lab-drawer').inert") == (state == "false")
    page.js("labToggleGuide()")
    page.wait("document.activeElement.innerText === 'next'")
    page.press("Enter", 13)
    page.wait(f"{TEXT}.includes('2 of 5: ') && location.search.includes('probability=0.5')")
    page.press("Escape", 27)
    page.wait(f"document.activeElement === {button} && {button}.ariaExpanded === 'false'")
    page.js("localStorage.clear()")


def test_a_live_run_ends_with_a_verdict_and_is_the_selected_recorded_run(
    browser: Browser, address: str, folder: Path
) -> None:
    page = Page(browser, address)
    page.click("recorded", "button")
    page.wait(f"{TEXT}.includes('No run has ended in the folder runs yet')")
    page.click("live", "button")
    page.wait(f"{VERDICT}.includes('five processes on this machine')")
    page.click("run live", "button")
    page.wait(f"{VERDICT}.startsWith('completed 4 s') && {TEXT}.includes('this run (recorded)')")
    assert "the ideal loop with the settings of this page" in page.js(COMPARED)
    lines = [line for line in page.js(VERDICT).split("\n") if line]
    # On a machine that stalls, the loop may be late, and ‖x‖ large at the end.
    assert lines[0].startswith(("completed 4 s: stable, ‖x‖ ", "completed 4 s: bounded, ‖x‖ "))
    assert lines[1].startswith("guarantee ")
    assert " in the ideal loop), " in lines[2]
    assert violations(page, *ACCESSIBLE) == []
    (run,) = [path for path in (folder / "runs").iterdir() if not path.is_symlink()]
    report = page.js("[...document.links].find(e => e.innerText.startsWith('report')).href")
    assert report == f"{address.partition('?')[0]}report/{run.name}"
    page.press_button("replay this run")
    page.wait(f"{TEXT}.includes('bit-exact') && {TEXT}.includes('this run (recorded)')")
    assert page.js(VERDICT).split("\n")[0] == lines[0]
    # The report comes without scripts, and only for whom the page's address is known.
    page.call("Page.navigate", url=report)
    page.wait(f"{TEXT}.includes('completed 4 s') && origin === 'null'")
    for wrong, status in ((report.replace("/report/", "x/report/"), 404), (report + "x", 404)):
        with pytest.raises(HTTPError) as error:
            urlopen(wrong)
        assert error.value.code == status
        error.value.close()
    # A new page selects the newest run.
    page.go(address)
    page.click("recorded", "button")
    page.wait(f"[...document.querySelectorAll('.q-select')].some(e => e.innerText.includes({run.name!r}))")


def test_clicks_reach_a_run_while_the_viewer_draws_and_ctrl_c_keeps_the_record_of_the_next(
    with_card: Browser, tmp_path: Path
) -> None:
    with Served(tmp_path) as server:
        address = server.address.partition("?")[0] + "?scenario=lane_following&horizon_s=100"
        page = Page(with_card, address, size=(320, 200))  # the viewer's drawing costs by the pixel
        page.click("live", "button")
        page.press_button("run live")
        page.wait(f"{TEXT}.includes('of 100 s')")
        log = "document.querySelector('.lab-log').innerText"
        page.press_button("show the rerun viewer")
        page.wait("!!document.querySelector('iframe')")
        viewer = page.js("document.querySelector('iframe').src")
        page.press_button("kill controller")
        page.wait(f"{log}.includes('controller died: killed by SIGKILL')")
        # The viewer has a process of its own, whose drawing does not keep the page from its clicks.
        targets = with_card.call("Target.getTargets")["targetInfos"]
        assert any(target["url"].startswith(viewer) for target in targets if target["type"] == "iframe")
        page.press_button("stop")
        page.wait(f"{TEXT}.includes('stopped after ')")
        page.press_button("run live")
        page.wait(f"{log}.includes('all processes run') && !{log}.includes('died')")
        page.drag("loss probability", 0.9)  # the draws are computed, too
    runs = {path.resolve() for path in (tmp_path / "runs").iterdir()}
    assert len(runs) == 2
    live.wait_for(lambda: all((run / "summary.json").exists() for run in runs))
