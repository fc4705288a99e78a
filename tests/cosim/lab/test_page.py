"""The page in a headless browser: dragging, mistakes, two tabs, recorded runs, a live run."""

import json
import time
from importlib.resources import files
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest

from tests.cosim.lab.conftest import TEXT, Page, Served
from tests.integration import conftest as live
from tools.screenshot_recording import Browser

pytest.importorskip("nicegui", reason="the extra `lab` is not installed")


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
    # From then on, each tab has its own settings.
    other.drag("loss probability", 1.0)
    other.wait("location.search.includes('network.loss.probability=1')")
    assert page.js(r"/loss\.probability=0(\.0)?(&|$)/.test(location.search)")
    address = address.partition("?")[0]
    page.go(f"{address}?scenario=lane_following&trigger.beta=-1")
    page.wait(f"{TEXT}.includes('trigger.beta')")
    page.go(f"{address}?scenario=/etc/passwd")
    page.wait(f"{TEXT}.includes('an address opens shipped scenarios')")


def test_a_mistake_in_the_form_is_shown_at_its_field(browser: Browser, address: str) -> None:
    page = Page(browser, address)
    page.unfold("all settings (form)")
    page.unfold("trigger")
    page.fill("beta", "abc")
    wrong = "[...document.querySelectorAll('.q-field--error')].map(e => e.innerText).join('|')"
    page.wait(f"{wrong}.includes('should be a valid number')")
    assert page.js(f"{wrong}.startsWith('beta')")
    assert page.js("document.querySelector('input[aria-label=beta]').value") == "abc"
    page.fill("beta", "0.25")
    page.wait(f"{wrong} === '' && location.search.includes('trigger.beta=0.25')")
    # A slider moves the field, too.
    page.drag("β, threshold at the start", 1.0)
    page.wait("document.querySelector('input[aria-label=beta]').value === '5.0'")


TABS = ("explore", "run live", "recorded runs", "tutorial")
RULES = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"], "iframes": False}
EDITOR = {"light": "=== 'rgb(255, 255, 255)'", "dark": "!== 'rgb(255, 255, 255)'"}


def violations(page: Page) -> list[str]:
    """Return what axe-core finds, as one line per element."""
    pytest.importorskip("axe_core_python", reason="axe-core-python is not installed")
    page.js(files("axe_core_python").joinpath("axe.min.js").read_text("utf-8"))
    options = json.dumps(RULES)
    found = page.js(
        f"axe.run({{exclude: [['iframe']]}}, {options}).then(r => r.violations.flatMap("
        "v => v.nodes.map(n => v.id + ' ' + n.target + ': ' + n.failureSummary)))"
    )
    return [] if found is None else list(found)


@pytest.mark.parametrize(("scheme", "size"), [("light", (1280, 900)), ("dark", (390, 844))])
def test_controls_have_names_and_text_has_contrast(
    browser: Browser, address: str, scheme: str, size: tuple[int, int]
) -> None:
    page = Page(browser, address, size=size, scheme=scheme)
    page.js("document.head.insertAdjacentHTML('beforeend', '<style>*{transition:none !important}')")
    if size[0] < 800:
        page.press_button("settings")
    for part in ("all settings (form)", "trigger", "all settings (TOML)"):
        page.unfold(part)
    page.wait("!!document.querySelector('.cm-content[aria-label]')")
    page.wait(
        f"getComputedStyle(document.querySelector('.cm-editor')).backgroundColor {EDITOR[scheme]}"
    )
    page.wait(f"{TEXT}.includes('assumed (')")
    for tab in TABS:
        page.click(tab, ".q-tab")
        page.wait(f"document.querySelector('.q-tab--active').innerText.trim() === {tab!r}")
        assert violations(page) == [], tab
        assert page.js("document.scrollingElement.scrollWidth <= innerWidth"), tab
    page.fill("beta", "abc")
    page.wait("!!document.querySelector('.q-field--error')")
    assert violations(page) == []


FOCUSED = """(() => {
  const at = document.activeElement, shown = at.closest('.q-slider, .q-field') || at;
  const seen = [at, shown].some(e => getComputedStyle(e).boxShadow.includes('rgb(199, 119, 0)'));
  const label = at.closest('label')?.querySelector('.q-field__label')?.innerText;
  const name = at.closest('.q-slider')?.ariaLabel || at.ariaLabel || label;
  return [name || at.innerText.split('\\n').pop(), seen, at === document.body];
})()"""


def test_the_keyboard_reaches_and_moves_everything(browser: Browser, address: str) -> None:
    page = Page(browser, address)
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
    sliders = page.js("[...document.querySelectorAll('.q-slider')].map(e => e.ariaLabel)")
    labels = page.js("[...document.querySelectorAll('.q-field__label')].map(e => e.innerText)")
    assert {*sliders, "scenario", "drawn state", "explore", "files", "dark or light"} <= {*reached}
    assert {one for one in labels if one != "run"} <= {*reached}


def test_a_live_run_ends_with_a_verdict_and_is_the_selected_recorded_run(
    browser: Browser, address: str, folder: Path
) -> None:
    page = Page(browser, address)
    page.click("recorded runs", ".q-tab")
    page.wait(f"{TEXT}.includes('No run has ended in the folder runs yet')")
    page.click("run live", ".q-tab")
    page.wait(f"{TEXT}.includes('start as five processes on this machine')")
    page.click("run live", "button")
    page.wait(f"{TEXT}.includes('ended: 4.0 of 4 s')")
    verdict = "document.querySelector('[aria-label=verdict]').innerText"
    page.wait("!!document.querySelector('[aria-label=verdict]')")
    lines = page.js(verdict).split("\n")
    assert "show the viewer here" not in page.js(TEXT)  # its server has ended with the loop
    assert lines[0].startswith("completed 4 s: stable, ‖x‖ fell from ")
    assert lines[1].startswith("guarantee ")
    assert " transmissions (ideal loop: " in lines[2]
    assert violations(page) == []
    (run,) = [path for path in (folder / "runs").iterdir() if not path.is_symlink()]
    report = page.js("[...document.links].find(e => e.innerText.startsWith('report')).href")
    assert report == f"{address.partition('?')[0]}report/{run.name}"
    page.press_button("figures of this run")
    page.wait("!!document.querySelector('iframe.lab-report')")
    assert page.js("document.querySelector('iframe.lab-report').src") == report
    page.click("replay", "button")
    page.wait(f"{TEXT}.includes('bit-exact')")
    # The report comes without scripts, and only for whom the page's address is known.
    page.call("Page.navigate", url=report)
    page.wait(f"{TEXT}.includes('completed 4 s') && origin === 'null'")
    for wrong, status in ((report.replace("/report/", "x/report/"), 404), (report + "x", 404)):
        with pytest.raises(HTTPError) as refused:
            urlopen(wrong)
        assert refused.value.code == status
        refused.value.close()
    # A new page selects the newest run.
    page.go(address)
    page.click("recorded runs", ".q-tab")
    page.wait(
        f"[...document.querySelectorAll('.q-select')].at(-1).innerText.includes({run.name!r})"
    )


def test_a_click_reaches_the_run_while_the_viewer_draws(browser: Browser, address: str) -> None:
    page = Page(browser, address.partition("?")[0] + "?scenario=lane_following&horizon_s=600")
    page.click("run live", ".q-tab")
    page.press_button("run live")
    page.wait(f"{TEXT}.includes('of 600 s')")
    log = "document.querySelector('.lab-log').innerText"
    # This browser has no graphics card, so it does not draw the viewer unless asked.
    assert not page.js("!!document.querySelector('iframe')")
    page.press_button("show the viewer here")
    page.wait("!!document.querySelector('iframe')")
    viewer = page.js("document.querySelector('iframe').src")
    page.press_button("kill controller")
    page.wait(f"{log}.includes('controller died: killed by SIGKILL')")
    # The viewer has a process of its own, whose drawing does not keep the page from its clicks.
    targets = browser.call("Target.getTargets")["targetInfos"]
    assert any(one["url"].startswith(viewer) for one in targets if one["type"] == "iframe")
    page.press_button("stop")
    page.wait(f"{TEXT}.includes('stopped after ')")


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
