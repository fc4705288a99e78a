"""The page in a headless browser: dragging, mistakes, two tabs, recorded runs, a live run."""

from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest

pytest.importorskip("nicegui", reason="the extra `lab` is not installed")

from tests.cosim.lab.lab_browser import TEXT, Page
from tools.screenshot_recording import Browser


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


def test_one_slider_makes_the_loop_unstable_and_the_page_says_why(
    browser: Browser, address: str
) -> None:
    page = Page(browser, address.partition("?")[0])
    page.drag("model error", 1.0)
    page.wait(f"{TEXT}.includes('inter-event times shrink to 0 (3000 events until')")
    page.wait(f"{TEXT}.includes('It has no certificate: a mode of the loop grows at')")
    page.drag("model error", 0.05)
    page.wait(f"!{TEXT}.includes('accumulate')")


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
    page.fill("alpha_per_s", "")
    page.wait(f"{wrong}.includes('missing')")
    page.fill("alpha_per_s", "0.2")
    page.wait(f"{wrong} === '' && location.search.includes('trigger.alpha_per_s=0.2')")
    # A slider moves the field, too.
    page.drag("β, threshold at the start", 1.0)
    page.wait("document.querySelector('input[aria-label=beta]').value === '5.0'")


def test_a_wrong_address_says_so(browser: Browser, address: str) -> None:
    address = address.partition("?")[0]
    page = Page(browser, f"{address}?scenario=lane_following&trigger.beta=-1")
    page.wait(f"{TEXT}.includes('trigger.beta')")
    page = Page(browser, f"{address}?scenario=/etc/passwd")
    page.wait(f"{TEXT}.includes('an address opens shipped scenarios')")


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
    one, other = Page(browser, address), Page(browser, address)
    # Two runs: the log of each is that of the newest in all tabs.
    for page, horizon_s in ((one, 3), (other, 600)):
        page.go(address.partition("?")[0] + f"?scenario=lane_following&horizon_s={horizon_s}")
        page.click("run live", ".q-tab")
        page.press_button("run live")
        page.wait(f"{TEXT}.includes('of {horizon_s} s')")
        if page is one:
            page.wait(f"{TEXT}.includes('completed 3 s')")
    log = "document.querySelector('.lab-log').innerText"
    one.wait(f"{TEXT}.includes('of 600 s')")
    assert one.js(log).count("all processes run") == 1
    assert not one.js("!!document.querySelector('[aria-label=verdict]')")
    # This browser has no graphics card, so it does not draw the viewer unless asked.
    assert not other.js("!!document.querySelector('iframe')")
    other.press_button("show the viewer here")
    other.wait("!!document.querySelector('iframe')")
    viewer = other.js("document.querySelector('iframe').src")
    other.press_button("kill controller")
    other.wait(f"{log}.includes('controller died: killed by SIGKILL')")
    # The viewer has a process of its own, whose drawing does not keep the page from its clicks.
    targets = browser.call("Target.getTargets")["targetInfos"]
    assert any(one["url"].startswith(viewer) for one in targets if one["type"] == "iframe")
    other.press_button("stop")
    other.wait(f"{TEXT}.includes('stopped after ')")


def test_the_tutorial_has_its_figure_beside_it(browser: Browser, address: str) -> None:
    page = Page(browser, address)
    page.click("tutorial", ".q-tab")
    page.wait("!!document.querySelector('.lab-guided canvas')")
    page.click("next", "button")
    page.wait(f"{TEXT}.includes('2 of 5') && location.search.includes('loss.probability=0.5')")
    assert page.js("document.querySelector('.q-tab--active').innerText") == "tutorial"
    page.drag("loss probability", 0.0)
    page.wait("document.querySelector('.lab-guided').innerText.includes(', 0 (0 %) lost')")
