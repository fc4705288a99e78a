"""The page as a visitor sees it: settings at the left, what follows from them at the right."""

import json
from typing import Any

from nicegui import ui

from cosim.interactive.draft import Draft, DraftError, draft_of_query, open_draft
from cosim.lab.page.explore_panel import ExplorePanel
from cosim.lab.page.file_menu import FileMenu
from cosim.lab.page.lab_services import LabServices
from cosim.lab.page.live_panel import LivePanel
from cosim.lab.page.runs_panel import RunsPanel
from cosim.lab.page.session import Session
from cosim.lab.page.settings_panel import SettingsPanel
from cosim.lab.page.tutorial_panel import Step, TutorialPanel
from noack.core.errors import NoackError

_STYLE = """
.lab-body { display: grid; grid-template-columns: minmax(260px, 340px) minmax(0, 1fr); gap: 1rem; }
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
@media (max-width: 800px) {
  .lab-body { grid-template-columns: minmax(0, 1fr); }
  .lab-settings { order: 2; top: auto; bottom: 0; z-index: 1; max-height: 38vh; }
  .lab-settings { border-top: 2px solid var(--q-primary); background: white; }
  .body--dark .lab-settings { background: #121212; }
}
"""

_EXPLORE = "explore"
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
    await page.begin()


class _Page:
    def __init__(self, services: LabServices, draft: Draft) -> None:
        self._services, self._client = services, ui.context.client
        self._session = Session(services, draft, self._drawn)
        self._dark = ui.dark_mode(None)
        self._is_dark = False
        self._tab, self._is_drawn = _EXPLORE, False
        self._client.on_delete(self._session.end)

    def build(self) -> None:
        """Build header and panels."""
        with ui.header().classes("items-center gap-3 py-1"):
            ui.label("noack lab").classes("text-h6").props("role=heading aria-level=1")
            self._scenarios = ui.select(
                sorted(self._services.known), value=self._session.draft.base, label="scenario",
                on_change=self._choose,
            ).props("dense options-dense dark standout").classes("w-56")  # fmt: skip
            ui.space()
            self._keep = ui.button("keep for comparison", on_click=self._compare).props(
                "flat color=white dense"
            )
            self._files = FileMenu(self._services, self._session)
            ui.button(icon="contrast", on_click=self._toggle).props(
                'flat color=white dense aria-label="dark or light"'
            )
        with ui.element("main").classes("lab-body w-full"):
            with ui.column().classes("gap-2 lab-settings").props("role=region aria-label=settings"):
                self._settings = SettingsPanel(self._session.draft, self._changed)
            with ui.column().classes("gap-2 w-full"):
                with ui.tabs(on_change=self._show_tab).props("dense align=left no-caps") as tabs:
                    names = (_EXPLORE, "run live", "recorded runs", "tutorial")
                    explore, live, runs, tutorial = (ui.tab(name) for name in names)
                self._tabs, self._explore_tab = tabs, explore
                with ui.tab_panels(tabs, value=explore, animated=False, keep_alive=True).classes(
                    "w-full"
                ):
                    with ui.tab_panel(explore).classes("p-0"):
                        self._explore = ExplorePanel()
                    with ui.tab_panel(live).classes("p-0"):
                        self._live = LivePanel(self._services)
                    with ui.tab_panel(runs).classes("p-0"):
                        self._runs = RunsPanel(self._services)
                    with ui.tab_panel(tutorial).classes("p-0"):
                        TutorialPanel(self._begin_step)

    async def begin(self) -> None:
        """Draw for the first time."""
        await ui.context.client.connected()
        ui.run_javascript(_LOST)
        self._is_dark = await ui.run_javascript(
            "window.matchMedia('(prefers-color-scheme: dark)').matches"
        )
        self._settings.show_dark(dark=self._is_dark)
        self._live.take(self._session.draft)
        await self._session.change(self._session.draft)

    async def _show_tab(self, event: Any) -> None:
        self._tab = event.value
        if event.value == "recorded runs":
            self._runs.refresh()
        elif event.value == _EXPLORE and not self._is_drawn:
            await self._drawn()

    async def _drawn(self) -> None:
        if self._client.is_deleted:
            return
        self._settings.show_mistakes(self._session.mistakes)
        self._is_drawn = self._tab == _EXPLORE
        if not self._is_drawn:
            return  # a figure that nobody sees would take time from a running loop
        await self._explore.draw(self._session, dark=self._is_dark)

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
        self._tabs.set_value(self._explore_tab)
        await self._open(draft)
        self._explore.show_step(step.drag)

    async def _open(self, draft: Draft) -> None:
        self._session.reference = None
        self._explore.show_step("")
        self._session.draft = draft
        self._scenarios.set_value(draft.base)
        self._settings.show(draft)
        await self._changed(draft, "")

    async def _compare(self) -> None:
        self._session.keep()
        kept = self._session.reference is not None
        self._keep.set_text("forget the kept settings" if kept else "keep for comparison")
        await self._drawn()

    async def _toggle(self) -> None:
        self._is_dark = not self._is_dark
        self._dark.set_value(self._is_dark)
        self._settings.show_dark(dark=self._is_dark)
        await self._drawn()
