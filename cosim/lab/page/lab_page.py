"""The page as a visitor sees it: settings at the left, what follows from them at the right."""

import json
from contextlib import suppress
from typing import Any

from nicegui import ui

from cosim.interactive.draft import Draft, DraftError, draft_of_query, open_draft
from cosim.lab.page.explore_panel import ExplorePanel
from cosim.lab.page.file_menu import FileMenu
from cosim.lab.page.lab_services import ANSWER_S, LabServices, PageCalls
from cosim.lab.page.live_panel import LivePanel
from cosim.lab.page.runs_panel import RunsPanel
from cosim.lab.page.session import Session
from cosim.lab.page.settings_panel import SettingsPanel
from cosim.lab.page.tutorial_panel import Step, TutorialPanel
from noack.core.errors import NoackError

_STYLE = """
.lab-body { display: grid; grid-template-columns: minmax(260px, 340px) minmax(0, 1fr); gap: 1rem; }
.lab-body { font-size: 14px; }
.lab-body .cm-editor { font-size: 13px; }
.lab-head { flex-wrap: nowrap; }
.lab-sheet-button { display: none; }
.lab-about { margin: 0; padding-left: 1.2rem; list-style: disc; max-width: 46rem; }
.lab-guided { display: grid; gap: 1rem; }
.lab-body .q-tab-panels { background: transparent; }
.lab-settings { position: sticky; top: 56px; align-self: start; padding: 0 10px 1rem; }
.lab-settings { max-height: calc(100vh - 64px); overflow-y: auto; }
.lab-facts { display: grid; gap: 1rem; }
.lab-facts { grid-template-columns: repeat(auto-fit, minmax(260px, 1fr)); }
.lab-rows { display: grid; grid-template-columns: auto auto; gap: 0 1rem; margin: 0; }
.lab-rows dd { margin: 0; }
.lab-viewer { height: 70vh; border: 0; }
.nicegui-error-popup { max-width: 30rem; border: 3px solid var(--q-negative); }
.lab-figure { --ink: #1b1f24; --grid: #d9dde3; --paper: #ffffff; }
.body--dark .lab-figure { --ink: #e6eaef; --grid: #3a424d; --paper: #14181d; }
.lab-figure :is(svg, img) { width: 100%; height: auto; max-width: 900px; }
.lab-log * { white-space: pre-wrap; overflow-wrap: anywhere; }
:focus-visible, .q-slider:focus-within, .q-field:focus-within {
  outline: none; box-shadow: 0 0 0 2px white, 0 0 0 5px #c77700 !important;
}
.q-header { background: #1f5f99; }
.q-header .q-field__label { color: white; opacity: 1; }
.body--dark .q-btn.bg-primary, .body--dark .q-btn.bg-primary * { color: #08131e !important; }
.body--dark { --q-primary: #64a8e8 !important; --q-negative: #ff8a80 !important; }
.body--dark { --q-warning: #ffb74d !important; --q-positive: #7fd39b !important; }
.body--dark .cm-activeLine { background: transparent !important; }
.body--dark .cm-gutterElement { color: #b0b0b0 !important; }
@media (min-width: 1200px) {
  .lab-guided { grid-template-columns: minmax(260px, 1fr) minmax(0, 2fr); align-items: start; }
}
@media (max-width: 800px) {
  html { scroll-padding-bottom: 56px; }
  .lab-body { grid-template-columns: minmax(0, 1fr); padding-bottom: 48px; }
  .lab-head { gap: 4px; padding: 0 8px; }
  .lab-head .lab-scenario { flex: 1 1 0; min-width: 0; }
  .lab-head .q-space { max-width: 0; }
  .lab-keep .block { position: absolute; width: 1px; height: 1px; overflow: hidden; }
  .lab-settings { position: fixed; left: 0; right: 0; top: auto; bottom: 0; z-index: 1000; }
  .lab-settings { max-height: 46px; padding: 0; overflow: hidden; background: white; }
  .lab-settings { border-top: 2px solid var(--q-primary); }
  .body--dark .lab-settings { background: #121212; }
  .lab-sheet { padding: 0 16px 16px; }
  .lab-sheet-button { display: flex; width: 100%; min-height: 44px; }
  .lab-settings:not(.lab-open) .lab-sheet { visibility: hidden; }
  .lab-settings.lab-open { max-height: 45vh; overflow-y: auto; }
  .lab-open .lab-sheet-button { position: sticky; top: 0; z-index: 1; background: inherit; }
}
"""

_EXPLORE, _LIVE, _RUNS, _TUTORIAL = "explore", "run live", "recorded runs", "tutorial"
_SHEET = """event => {
  const button = event.currentTarget;
  button.ariaExpanded = button.parentElement.classList.toggle('lab-open');
}"""
"""Opens or closes the settings on a small screen."""
_KEEP = "keep for comparison"
_LOST = """
const lost = document.getElementById('popup');
lost.role = 'alert';
lost.children[0].textContent = 'The page has lost its server.';
lost.children[1].textContent = 'Has noack lab ended? Start it again and open the address that it '
    + 'shows. The settings are in the address of this page, after the "?".';
"""
"""Words for the framework's notice, which is shown after 2 s without a connection."""


async def show_page(services: LabServices) -> None:
    """Build the page for one visitor."""
    ui.add_css(_STYLE)
    ui.colors(primary="#1f5f99", negative="#b3261e", warning="#8a5300", positive="#1b6e3c")
    query = ui.context.client.request.url.query if ui.context.client.request else ""
    problem = ""
    try:
        draft = draft_of_query(query, services.scenario, services.known)
        _ = draft.scenario  # a page without a valid scenario would have no sliders
    except NoackError as error:
        problem, draft = str(error), open_draft(services.scenario)
    page = _Page(services, draft)
    page.build()
    if problem:
        ui.notify(problem, type="warning", multi_line=True, close_button="close")
    with suppress(TimeoutError):  # the page was closed
        await page.begin()


class _Page:
    def __init__(self, services: LabServices, draft: Draft) -> None:
        self._services, self._client = services, ui.context.client
        self._calls = PageCalls(services)
        self._session = Session(self._calls, draft, self._drawn)
        self._dark = ui.dark_mode(None)
        self._is_dark = False
        self._tab = _EXPLORE
        self._figures: dict[str, ExplorePanel] = {}
        """The figure of each tab that has one."""
        self._outdated: set[str] = set()
        """Tabs whose figure is not that of the newest results."""
        self._client.on_disconnect(self._session.end)  # a page that connects again is a new one

    def build(self) -> None:
        """Build header and panels."""
        with ui.header().classes("items-center gap-3 py-1 lab-head"):
            ui.label("noack lab").classes("text-h6").props("role=heading aria-level=1")
            self._scenarios = ui.select(
                sorted(self._services.known), value=self._session.draft.base, label="scenario",
                on_change=self._choose,
            ).props("dense options-dense dark standout").classes("w-56 lab-scenario")  # fmt: skip
            ui.space()
            self._keep = ui.button(_KEEP, icon="compare", on_click=self._compare).props(
                f'flat color=white dense no-caps aria-label="{_KEEP}"'
            ).classes("lab-keep")  # fmt: skip
            FileMenu(self._services, self._calls, self._session)
            ui.button(icon="contrast", on_click=self._toggle).props(
                'flat color=white dense aria-label="dark or light"'
            )
        with ui.element("main").classes("lab-body w-full"):
            with ui.column().classes("gap-2 lab-settings").props("role=region aria-label=settings"):
                ui.button("settings", icon="tune").classes("lab-sheet-button").props(
                    "flat no-caps aria-expanded=false"
                ).on("click", js_handler=_SHEET)
                with ui.column().classes("w-full gap-2 lab-sheet"):
                    self._settings = SettingsPanel(self._session.draft, self._changed)
            with ui.column().classes("gap-2 w-full"):
                with ui.tabs(on_change=self._show_tab).props("dense align=left no-caps") as tabs:
                    for name in (_EXPLORE, _LIVE, _RUNS, _TUTORIAL):
                        ui.tab(name)
                self._tabs = tabs
                with ui.tab_panels(tabs, value=_EXPLORE, animated=False, keep_alive=True).classes(
                    "w-full"
                ):
                    with ui.tab_panel(_EXPLORE).classes("p-0"):
                        self._figures[_EXPLORE] = ExplorePanel()
                    with ui.tab_panel(_LIVE).classes("p-0"):
                        self._live = LivePanel(self._services, self._open_run, self._run_ended)
                    with ui.tab_panel(_RUNS).classes("p-0"):
                        self._runs = RunsPanel(
                            self._services, self._calls, lambda: tabs.set_value(_LIVE)
                        )
                    with ui.tab_panel(_TUTORIAL).classes("p-0 lab-guided"):
                        TutorialPanel(self._begin_step)
                        with ui.column().classes("gap-2 w-full"):
                            self._figures[_TUTORIAL] = ExplorePanel()

    async def begin(self) -> None:
        """Draw for the first time."""
        await ui.context.client.connected()
        ui.run_javascript(_LOST)
        self._settings.begin()
        self._is_dark = await ui.run_javascript(
            "window.matchMedia('(prefers-color-scheme: dark)').matches", timeout=ANSWER_S
        )
        self._settings.show_dark(dark=self._is_dark)
        self._live.take(self._session.draft)
        await self._session.change(self._session.draft)
        await self._live.begin()

    async def _show_tab(self, event: Any) -> None:
        self._tab = event.value
        self._live.remove_old_viewer()
        if event.value == _RUNS:
            self._runs.refresh()
        await self._draw()

    async def _drawn(self) -> None:
        if self._client.is_deleted:
            return
        self._settings.show_mistakes(self._session.mistakes)
        self._outdated = set(self._figures)
        await self._draw()

    async def _draw(self) -> None:
        """Draw the tab's figure; one that nobody sees would take time from a running loop."""
        if self._tab in self._outdated:
            self._outdated.remove(self._tab)
            await self._figures[self._tab].draw(self._session, dark=self._is_dark)

    def _run_ended(self) -> None:
        if self._tab == _RUNS:
            self._runs.refresh()

    def _open_run(self, name: str) -> None:
        self._tabs.set_value(_RUNS)
        self._runs.show(name)

    async def _changed(self, draft: Draft, key: str) -> None:
        self._show_address(draft)
        await self._session.change(draft)
        if not self._session.mistakes:
            await self._live.change(draft, key)

    def _show_address(self, draft: Draft) -> None:
        """Put the settings into the address, so that it can be shared."""
        try:
            query = json.dumps(f"?{draft.query()}")
        except DraftError:
            return
        # The browser limits how often this may be called.
        ui.run_javascript(
            f"clearTimeout(window.labQuery); window.labQuery = setTimeout("
            f"() => history.replaceState(null, '', {query}), 300)"
        )

    async def _choose(self, event: Any) -> None:
        if event.value == self._session.draft.base:
            return
        try:
            draft = open_draft(self._services.known[event.value])
        except NoackError as error:
            ui.notify(str(error), type="negative")
            return
        await self._open(draft)

    async def _begin_step(self, step: Step) -> None:
        draft = open_draft(step.scenario)
        for key, value in step.settings.items():
            draft = draft.with_value(key, value)
        await self._open(draft)

    async def _open(self, draft: Draft) -> None:
        self._session.reference = None
        self._session.draft = draft
        self._scenarios.set_value(draft.base)
        self._settings.show(draft)
        await self._changed(draft, "")

    async def _compare(self) -> None:
        self._session.keep()
        text = _KEEP if self._session.reference is None else "forget the kept settings"
        self._keep.set_text(text)
        self._keep.props["aria-label"] = text
        await self._drawn()

    async def _toggle(self) -> None:
        self._is_dark = not self._is_dark
        self._dark.set_value(self._is_dark)
        self._settings.show_dark(dark=self._is_dark)
        await self._drawn()
