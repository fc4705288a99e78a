"""The page as a visitor sees it: settings at the left, what follows from them at the right.

The page itself, then its menu of files and its tutorial.
"""

import io
import json
import re
import tomllib
from collections.abc import Awaitable, Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from nicegui import ui
from nicegui.events import ValueChangeEventArguments
from pyarrow import csv

from cosim.interactive.draft import Draft, DraftError, draft_of_query, open_draft
from cosim.interactive.exploration import Exploration
from cosim.interactive.exploration_figure import Shown
from cosim.lab.explore_panel import ExplorePanel, Rows
from cosim.lab.lab_services import ANSWER_S, LabServices, PageCalls, Session
from cosim.lab.live_panel import LivePanel
from cosim.lab.runs_panel import RunsPanel
from cosim.lab.settings_panel import SettingsPanel
from cosim.output.figure_format import FigureFormat, figure_width_in
from cosim.output.page_kit import TERMS
from noack.core.errors import NoackError
from noack.core.file_access import write_whole
from noack.core.linear_systems import Vector

_FOLDER = Path(__file__).parent
_EXPLORE, _LIVE, _RUNS, _TUTORIAL = "explore", "run live", "recorded runs", "tutorial"
_KEEP = "keep for comparison"


async def show_page(services: LabServices) -> None:
    """Build the page for one visitor."""
    ui.add_css(_FOLDER / "lab.css")
    ui.add_head_html(f"<script>{_FOLDER.joinpath('lab.js').read_text()}</script>")
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
                ).on("click", js_handler="labToggleSettings")
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
        ui.run_javascript("labNameLostServer()")
        self._settings.begin()
        self._is_dark = await ui.run_javascript(
            "window.matchMedia('(prefers-color-scheme: dark)').matches", timeout=ANSWER_S
        )
        self._settings.show_dark(dark=self._is_dark)
        self._live.take(self._session.draft)
        await self._session.change(self._session.draft)
        await self._live.begin()

    async def _show_tab(
        self, event: ValueChangeEventArguments[str | ui.tab | ui.tab_panel | None]
    ) -> None:
        self._tab = str(event.value)
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
        ui.run_javascript(f"labShowQuery({query})")

    async def _choose(self, event: ValueChangeEventArguments[str]) -> None:
        if event.value == self._session.draft.base:
            return
        try:
            draft = open_draft(self._services.known[event.value])
        except NoackError as error:
            ui.notify(str(error), type="negative")
            return
        await self._open(draft)

    async def _begin_step(self, step: "Step") -> None:
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


_NAME = re.compile(r"[A-Za-z0-9][\w.-]{0,63}\.toml")


class FileMenu:
    """The menu in the header."""

    def __init__(self, services: LabServices, calls: PageCalls, session: Session) -> None:
        self._services, self._calls, self._session = services, calls, session
        opener = ui.button(icon="more_vert").props('flat color=white dense aria-label="files"')
        with opener, ui.menu():
            ui.menu_item("save as scenario …", self._ask)
            ui.menu_item("copy link to these settings", self._share)
            ui.menu_item("data of the figure (CSV)", self._data)
            for kind in (FigureFormat.SVG, FigureFormat.PDF):
                ui.menu_item(f"figure ({kind.upper()})", partial(self._figure, kind))
            ui.menu_item("glossary", self._open_words)
        with ui.dialog() as self._words, ui.card():
            Rows("lab-words", TERMS)
        with ui.dialog() as self._dialog, ui.card():
            ui.label(f"Save in {services.folder}")
            self._name = ui.input("file name", value="my_loop.toml", validation={
                "a name like my_loop.toml": lambda text: bool(_NAME.fullmatch(text))
            }).classes("w-64")  # fmt: skip
            self._replace = ui.checkbox("replace a file of this name")
            with ui.row():
                ui.button("save", on_click=self._save)
                ui.button("cancel", on_click=self._dialog.close).props("flat")

    def _open_words(self) -> None:
        self._words.open()

    def _ask(self) -> None:
        self._dialog.open()

    def _save(self) -> None:
        if not _NAME.fullmatch(self._name.value):
            return
        path = self._services.folder / self._name.value
        if path.exists() and not self._replace.value:
            ui.notify(f"{path.name} exists; tick the box to replace it", type="warning")
            return
        try:
            write_whole(path, self._session.draft.text.encode())
        except NoackError as error:
            ui.notify(str(error), type="negative")
            return
        self._dialog.close()
        ui.notify(f"saved as {path.name}; noack run {path.name}", type="positive")

    async def _share(self) -> None:
        address = await ui.run_javascript("location.href", timeout=ANSWER_S)
        ui.clipboard.write(address)
        ui.notify("copied; it opens as long as this page runs", type="positive")

    def _data(self) -> None:
        if self._session.results is not None:
            content = csv_of(self._session.results.run)
            ui.download(content, "exploration.csv", "text/csv")

    async def _figure(self, kind: FigureFormat) -> None:
        shown = self._session.shown()
        if shown is not None:
            content = await self._calls.compute(figure_file, shown, kind)
            ui.download(content, f"exploration.{kind}")


def csv_of(run: Exploration) -> bytes:
    """Return the curves of a run as CSV."""
    columns: dict[str, Vector | None] = {"t_s": run.t_s}
    for name, states in (("x", run.x), ("x_s", run.x_s), ("x_c", run.x_c)):
        columns |= {f"{name}_{i}": values for i, values in enumerate(states.T, start=1)}
    columns |= {"e_s_norm": run.e_s_norm, "e_c_norm": run.e_c_norm, "threshold": run.threshold}
    known = {name: np.ascontiguousarray(v) for name, v in columns.items() if v is not None}
    text = io.BytesIO()
    csv.write_csv(pa.table(known), text)
    return text.getvalue()


def figure_file(shown: Shown, kind: FigureFormat) -> bytes:
    """Return the figure as a file's content; called in the worker process."""
    from cosim.interactive.exploration_figure import exploration_figure  # the worker alone
    from cosim.output.figure_files import file_content  # needs matplotlib

    return file_content(exploration_figure(shown), kind, figure_width_in(kind, None))


class Step(NamedTuple):
    """A step: what to read, which settings it begins with, what to drag."""

    title: str
    text: str
    scenario: str
    settings: dict[str, object]
    drag: str


def _steps() -> list[Step]:
    content = tomllib.loads(_FOLDER.joinpath("tutorial.toml").read_text(encoding="utf-8"))
    return [Step(**step) for step in content["steps"]]


Begin = Callable[[Step], Awaitable[None]]


class TutorialPanel:
    """The text of one step at a time; the figure is beside it."""

    def __init__(self, begin: Begin) -> None:
        self._begin, self._place, self._steps = begin, 0, _steps()
        with ui.card().classes("w-full"):
            self._title = ui.label().classes("text-h6").props("role=heading aria-level=2")
            self._text = ui.label()
            self._drag = ui.label().classes("font-bold")
            with ui.row():
                ui.button("show it", on_click=self._start)
                self._back = ui.button("back", on_click=lambda: self._go(-1)).props("flat")
                self._next = ui.button("next", on_click=lambda: self._go(1)).props("flat")
            ui.label("“show it”, “next” and “back” replace the settings by those of the step.")
        self._show()

    def _show(self) -> None:
        step = self._steps[self._place]
        self._title.set_text(f"{self._place + 1} of {len(self._steps)}: {step.title}")
        self._text.set_text(step.text)
        self._drag.set_text(step.drag)
        self._back.set_visibility(self._place > 0)
        self._next.set_visibility(self._place < len(self._steps) - 1)

    async def _go(self, by: int) -> None:
        self._place += by
        self._show()
        await self._start()

    async def _start(self) -> None:
        await self._begin(self._steps[self._place])
