"""The page for everyone: names, contrast, keyboard, small screens, in light and dark."""

import json
import math
from importlib.resources import files
from typing import Any

import pytest

pytest.importorskip("nicegui", reason="the extra `lab` is not installed")
pytest.importorskip("axe_core_python", reason="axe-core-python is not installed")

from tests.cosim.lab.lab_browser import TEXT, Page
from tools.screenshot_recording import Browser

TABS = ("explore", "run live", "recorded runs", "tutorial")
CONTROLS = {"slider", "button", "textbox", "combobox", "tab", "switch", "checkbox", "link"}
SMALL = """[...document.querySelectorAll('.lab-body *')].filter(e =>
  e.checkVisibility({visibilityProperty: true}) && parseFloat(getComputedStyle(e).fontSize) < 13
  && [...e.childNodes].some(n => n.nodeType === Node.TEXT_NODE && n.textContent.trim())
).map(e => e.innerText)"""
"""Texts in a size that is hard to read."""
RULES = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"], "iframes": False}
EDITOR = {"light": "=== 'rgb(255, 255, 255)'", "dark": "!== 'rgb(255, 255, 255)'"}


def violations(page: Page) -> list[str]:
    """Return what axe-core finds, as one line per element."""
    page.js(files("axe_core_python").joinpath("axe.min.js").read_text("utf-8"))
    options = json.dumps(RULES)
    found = page.js(
        f"axe.run({{exclude: [['iframe']]}}, {options}).then(r => r.violations.flatMap("
        "v => v.nodes.map(n => v.id + ' ' + n.target + ': ' + n.failureSummary)))"
    )
    return [] if found is None else list(found)


def nameless(page: Page) -> list[Any]:
    """Return the controls of the accessibility tree that have no name."""
    nodes = page.call("Accessibility.getFullAXTree")["nodes"]
    return [
        node["role"]["value"]
        for node in nodes
        if not node["ignored"]
        and node["role"]["value"] in CONTROLS
        and not node.get("name", {}).get("value", "").strip()
    ]


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
        assert nameless(page) == [], tab
        assert page.js("document.scrollingElement.scrollWidth <= innerWidth"), tab
        assert page.js(SMALL) == [], tab
    page.fill("beta", "abc")
    page.wait("!!document.querySelector('.q-field--error')")
    assert violations(page) == []


def test_on_a_small_screen_the_settings_are_folded_and_the_header_is_one_row(
    browser: Browser, address: str
) -> None:
    page = Page(browser, address, size=(390, 844))
    height = "document.querySelector('.lab-settings').getBoundingClientRect().height"
    assert page.js("document.querySelector('.q-header').getBoundingClientRect().height") < 60
    expanded = "document.querySelector('[aria-expanded]:is(button)').ariaExpanded"
    folded = page.js(height)
    assert folded < 60
    assert "slider" not in roles(page)
    page.press_button("settings")
    page.wait(f"{expanded} === 'true' && {height} > 300")
    assert "slider" in roles(page)
    page.drag("loss probability", 0.0)
    page.wait(f"{TEXT}.includes(', 0 (0 %) lost')")
    page.press_button("settings")
    page.wait(f"{expanded} === 'false' && {height} === {folded}")


def roles(page: Page) -> set[str]:
    """Return the roles of what can be used now."""
    nodes = page.call("Accessibility.getFullAXTree")["nodes"]
    return {node["role"]["value"] for node in nodes if not node["ignored"]}


def test_a_slider_says_its_value_not_its_place(browser: Browser, address: str) -> None:
    page = Page(browser, address)
    beta = "document.querySelector('[aria-label=\"β, threshold at the start\"]')"
    page.wait(f"{beta}.ariaValueText === '0.5'")
    assert float(page.js(f"{beta}.ariaValueNow")) == pytest.approx(math.log10(0.5))
    page.drag("β, threshold at the start", 1.0)
    page.wait(f"{beta}.ariaValueText === '5'")


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
    sliders = page.js("[...document.querySelectorAll('.q-slider')].map(e => e.ariaLabel)")
    labels = page.js("[...document.querySelectorAll('.q-field__label')].map(e => e.innerText)")
    assert {*sliders, "scenario", "drawn state", "explore", "files", "dark or light"} <= {*reached}
    assert {one for one in labels if one != "run"} <= {*reached}


def test_arrow_keys_move_a_slider(browser: Browser, address: str) -> None:
    page = Page(browser, address)
    before = page.js(f"{TEXT}.match(/[0-9]+ transmissions/)[0]")
    page.js(
        "document.querySelector('.q-slider[aria-label=\"loss probability\"] [tabindex]').focus()"
    )
    page.press("ArrowLeft", 37)
    page.wait("location.search.includes('network.loss.probability=0.79')")
    for _ in range(20):
        page.press("PageDown", 34)
    page.wait(f"{TEXT}.match(/[0-9]+ transmissions/)[0] !== {before!r}")
