"""The page in a headless browser: dragging, mistakes, two tabs, recorded runs, a live run."""

from pathlib import Path

import pytest

pytest.importorskip("nicegui", reason="the extra `lab` is not installed")

from tests.cosim.lab.page.lab_browser import TEXT, Page
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


def test_one_slider_makes_the_loop_unstable_and_the_page_says_why(
    browser: Browser, address: str
) -> None:
    page = Page(browser, address.partition("?")[0])
    page.drag("model error", 1.0)
    page.wait(f"{TEXT}.includes('The events accumulate: 3000 events until')")
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
