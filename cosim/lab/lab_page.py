"""The page as a visitor sees it: the figure, the words about it, and a drawer with the settings.

The figure shows one of three sources: the explored run, the live run, or a recorded one. What the
browser is sent are the parts of :class:`cosim.lab.page_parts.PageParts`.
"""

import asyncio
import tomllib
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from nicegui import ui
from nicegui.events import GenericEventArguments, ValueChangeEventArguments

from cosim.interactive.draft_results import CERTIFICATE
from cosim.interactive.exploration import EXACT, Fact
from cosim.interactive.exploration_figure import ExploredRun, exploration_figure
from cosim.interactive.exploration_words import Reference, compare, verdict_of
from cosim.interactive.scenario_draft import Draft, DraftError, draft_of_query, open_draft
from cosim.interactive.sliders import Controls, choose, controls_of, drag
from cosim.lab.figure_sources import LiveSource, RecordedSource, report_address
from cosim.lab.file_menu import FileMenu
from cosim.lab.lab_services import ANSWER_S, LabServices, PageCalls, Session
from cosim.lab.page_parts import PageParts, TextPanel, controls_part, figure_part, value_text
from cosim.output.run_verdict import Tone, VerdictLine
from noack.core.errors import NoackError

_FOLDER = Path(__file__).parent
EXPLORE, LIVE, RECORDED = "explore", "live", "recorded"
_KEEP_TEXT, _FORGET_TEXT = "keep for comparison", "forget the kept run"
_POLL_S = 0.25
"""Time between two looks at the live run."""
_GESTURE_S = 1.0
"""Changes of one key follow each other within this time while a slider is dragged."""


async def show_page(services: LabServices) -> None:
    """Build the page for one visitor."""
    ui.add_css(_FOLDER / "lab.css")
    for name in ("figure.js", "lab.js"):
        ui.add_head_html(f"<script>{_FOLDER.joinpath(name).read_text()}</script>")
    ui.colors(primary="#1f5f99", negative="#b3261e", warning="#8a5300", positive="#1b6e3c")
    query = ui.context.client.request.url.query if ui.context.client.request else ""
    problem = ""
    try:
        draft = draft_of_query(query, services.scenario, services.known)
        draft.require_valid()  # a page without a valid scenario would have no sliders
    except NoackError as error:
        problem, draft = str(error), open_draft(services.scenario)
    page = _Page(services, draft)
    page.build()
    if problem:
        ui.notify(problem, type="warning", multi_line=True, close_button="close")
    with suppress(TimeoutError):  # the page was closed
        await page.begin()


class _Page:
    """The page of one visitor: its elements, and what they show of its session."""

    def __init__(self, services: LabServices, draft: Draft) -> None:
        self._services, self._client = services, ui.context.client
        self._calls = PageCalls(services)
        self._session = Session(self._calls, draft, self._show_run, self._settle)
        self._parts = PageParts(self._client)
        self._dark = ui.dark_mode(None)
        self._is_dark = False
        self._source, self._drawn_state, self._comparing = EXPLORE, 0, True
        self._kept: Reference | None = None
        self._controls: Controls | None = None
        self._moved = _MovedSlider("", "")
        self._last = _LastChange("", 0.0)
        self._unsettled = {""}
        """Keys that have changed since the settings rested; an empty one for all keys."""
        self._client.on_disconnect(self._session.end)  # a page that connects again is a new one
        ui.on("lab", self._respond)

    def build(self) -> None:
        """Build head, bar, figure and drawer."""
        with ui.header().classes("items-center gap-3 py-1 lab-head"):
            ui.label("noack lab").classes("text-h6 lab-title").props("role=heading aria-level=1")
            for text, icon, kind in (
                ("settings", "tune", "drawer"),
                ("tutorial", "school", "guide"),
            ):
                ui.button(icon=icon).classes(f"lab-{kind}-button").props(
                    f'flat color=white dense aria-label="{text}" title="{text}" '
                    f"aria-expanded=false aria-controls=lab-{kind}"
                ).on("click", js_handler=f"() => labToggle{kind.capitalize()}()")
            self._scenarios = (
                ui.select(
                    sorted(self._services.known),
                    value=self._session.draft.base,
                    label="scenario",
                    on_change=self._choose_scenario,
                )
                .props("dense options-dense dark standout")
                .classes("lab-scenario")
            )
            ui.space()
            FileMenu(self._services, self._calls, self._session, self._explored_run)
            ui.button(icon="contrast", on_click=self._toggle_dark).props(
                'flat color=white dense aria-label="dark or light"'
            )
        with ui.element("main").classes("lab-body w-full"):
            with ui.element("aside").props("id=lab-drawer aria-label=settings tabindex=-1"):
                for name in ("guide hidden", "controls"):
                    ui.element("div").props(f"id=lab-{name}")
                self._text_panel = TextPanel(self._session.draft, self._apply)
            with ui.element("div").classes("lab-main"):
                self._build_bar()
                self._build_stage()
        ui.timer(_POLL_S, self._follow)

    def _build_bar(self) -> None:
        with ui.element("div").classes("lab-bar"):
            self._source_toggle = ui.toggle(
                [EXPLORE, LIVE, RECORDED], value=EXPLORE, on_change=self._switch_source
            ).props("no-caps dense")
            with ui.element("div").classes("lab-of lab-of-live"):
                self._live = LiveSource(self._services, lambda: self._session.draft, self._replay)
            with ui.element("div").classes("lab-of lab-of-recorded"):
                self._recorded = RecordedSource(self._services, self._calls, self._show)
            self._keep_button = ui.button(_KEEP_TEXT, icon="compare", on_click=self._keep_run).props(
                "outline no-caps dense"
            )
            ui.checkbox("compare", value=True, on_change=self._switch_comparison).props("dense")
            with ui.element("label").props("hidden"):
                ui.label("drawn state ").classes("inline")
                ui.element("select").props('id=lab-state aria-label="drawn state"')

    def _build_stage(self) -> None:
        with ui.element("div").classes("lab-stage").props("id=lab-stage"):
            ui.element("div").props("id=lab-figure role=img")
            with ui.element("div").classes("lab-side"):
                ui.element("progress").props("id=lab-progress max=1 hidden aria-label=progress")
                ui.element("section").props("id=lab-verdict aria-label=verdict")
                with ui.element("a").props("id=lab-report hidden target=_blank"):
                    ui.label("report of this run (all figures and tables)")
                for source in (self._live, self._recorded):
                    with ui.element("div").classes(f"lab-of-{source.name} w-full"):
                        source.build_details()
                for name in ("note role=status", "pending role=status", "compare", "facts"):
                    ui.element("div").props(f"id=lab-{name}")

    async def begin(self) -> None:
        """Draw for the first time."""
        await self._client.connected()
        self._is_dark = await ui.run_javascript("labBegin()", timeout=ANSWER_S)
        self._text_panel.show_dark(dark=self._is_dark)
        steps = [{"title": step.title, "text": step.text, "drag": step.drag} for step in STEPS]
        await self._parts.show(source=EXPLORE, steps=steps)
        await self._session.change(self._session.draft)

    # What is shown

    async def _show(self) -> None:
        """Show the chosen source."""
        explored, live = self._explored_run(), self._source == LIVE
        with suppress(DraftError):  # the mistakes are shown; the sliders stay
            self._controls = controls_of(self._session.draft)
        parts = self._drawing(explored) | {"note": self._note(explored), "verdict": self._verdict()}
        if self._controls is not None:
            wrong = {mistake.key for mistake in self._session.mistakes}
            parts["controls"] = controls_part(self._controls, wrong, live=self._live.is_running)
        if explored is not None:
            run = explored.run
            facts: Mapping[str, Sequence[Fact]] = {f"this run ({run.kind})": run.numbers}
            if self._source == EXPLORE and self._session.results is not None:
                facts = self._session.results.facts
            reference = self._reference()
            parts["compare"] = reference and compare(reference, run)._asdict()
            parts["facts"] = [[heading, [*map(list, rows)]] for heading, rows in facts.items()]
            parts["states"] = {"names": run.state_names, "chosen": explored.state}
        recorded = self._recorded.chosen if self._source == RECORDED else ""
        name = self._live.report if live else recorded
        pending = {EXPLORE: self._session.pending, RECORDED: self._recorded.note}
        await self._parts.show(
            pending=pending.get(self._source, ""),
            progress=self._live.progress if live else None,
            report=name and report_address(name),
            **parts,
        )

    def _drawing(self, explored: ExploredRun | None) -> dict[str, object]:
        """Return what is shown anew while a slider is dragged."""
        parts: dict[str, object] = {"source": self._source, "stale": explored is None}
        if explored is not None:
            parts["figure"] = figure_part(exploration_figure(explored))
        return parts

    def _note(self, explored: ExploredRun | None) -> str:
        """Return what is wrong with the settings, or what the drawing leaves out."""
        session = self._session
        if self._source != EXPLORE:
            return ""
        first = session.mistakes[0].text if session.mistakes else ""
        more = f" (and {len(session.mistakes) - 1} more)" if len(session.mistakes) > 1 else ""
        note = first + more or session.note
        is_old = note and explored is None and self._parts.has_figure
        return f"{note}. The figure shows the settings before" if is_old else note

    def _explored_run(self) -> ExploredRun | None:
        """Return what the figure shows; None without a run."""
        view, reference = self._recorded.view, self._reference()
        explored = None
        if self._source == EXPLORE and self._session.results is not None:
            explored = self._session.results.explored_run(0)
        elif self._source == LIVE and (run := self._live.watch()) is not None:
            explored = ExploredRun(run, 0)
        elif self._source == RECORDED and view is not None:
            explored = ExploredRun(view.run, 0, guarantee=view.bounds)
        if explored is None:
            return None
        state = min(self._drawn_state, explored.run.x.shape[1] - 1)
        return explored._replace(state=state, reference=reference and reference.run)

    def _reference(self) -> Reference | None:
        """Return the run that the shown one is compared with."""
        session = self._session
        if not self._comparing:
            return None
        if self._kept is not None:
            return self._kept
        if self._source == EXPLORE:
            name, run = "the settings before the last change", session.before
        else:
            run = session.results.run if session.results else None
            kind = "ideal loop" if run is None or run.kind == EXACT else "simulation"
            name = f"the {kind} with the settings of this page"
        return None if run is None else Reference(name, run)

    def _verdict(self) -> list[VerdictLine]:
        if self._source == LIVE:
            return self._live.verdict
        if self._source == RECORDED and (view := self._recorded.view) is not None:
            return [*view.verdict, *(VerdictLine(text, Tone.NEUTRAL) for text in view.remarks)]
        if self._source == EXPLORE and (results := self._session.results) is not None:
            known = CERTIFICATE in results.known
            return [*verdict_of(results.run, results.certificate if known else None)]
        return []

    # What the visitor does

    async def _respond(self, event: GenericEventArguments) -> None:
        """Respond to an element that is not the framework's; see labSend in lab.js."""
        message = event.args
        match message["what"]:
            case "slide":
                await self._move_slider(message["key"], float(message["position"]))
            case "choose":
                key, value = message["key"], str(message["value"])
                await self._apply(lambda draft: choose(draft, key, value), key)
            case "state":
                self._drawn_state = int(message["number"])
                await self._show()
            case "step":
                await self._begin_tutorial_step(STEPS[int(message["number"])])

    async def _move_slider(self, key: str, position: float) -> None:
        sliders = self._controls.sliders if self._controls else ()
        if slider := next((slider for slider in sliders if slider.key == key), None):
            value = slider.value_at(position)
            self._moved = _MovedSlider(key, value_text(value))
            await self._apply(lambda draft: drag(draft, slider, value), key)

    async def _begin_tutorial_step(self, step: "TutorialStep") -> None:
        draft = open_draft(step.scenario)
        for key, setting in step.settings.items():
            draft = draft.with_value(key, setting)
        await self._open_draft(draft)

    async def _switch_source(self, event: ValueChangeEventArguments[str]) -> None:
        self._source = event.value
        if self._source == RECORDED:
            self._recorded.refresh()
        await self._show()

    async def _replay(self, name: str) -> None:
        self._source_toggle.set_value(RECORDED)
        await self._recorded.replay(name)

    async def _follow(self) -> None:
        """Follow the live run."""
        if self._live.follow() and self._source == LIVE:
            await self._show()

    async def _show_run(self) -> None:
        """Show the figure of a new run at once; its words follow when the settings rest."""
        explored = self._explored_run()
        if self._source != EXPLORE or explored is None:
            await self._show()
            return
        await self._parts.show(slider=self._moved, **self._drawing(explored))

    async def _settle(self) -> None:
        """Bring up to date what need not follow while a slider is dragged."""
        draft, keys, self._unsettled = self._session.draft, self._unsettled, set()
        with self._client:
            if keys:
                mistakes = self._session.mistakes
                self._text_panel.show(draft, mistakes)
                with suppress(DraftError):  # the text is no TOML
                    await self._parts.show(query=f"?{draft.query()}")
                if not mistakes:
                    await self._live.change(draft, keys)
            await self._show()

    def _apply(self, change: Callable[[Draft], Draft], key: str) -> Awaitable[None]:
        """Apply a change at once, before the next event is handled; return what follows."""
        now_s = asyncio.get_running_loop().time()
        last, self._last = self._last, _LastChange(key, now_s)
        try:
            draft = change(self._session.draft)
        except NoackError as error:
            ui.notify(str(error), type="negative")
            return self._show()
        self._unsettled.add(key)
        gesture = key != last.key or now_s - last.at_s > _GESTURE_S
        return self._session.change(draft, gesture=gesture)

    async def _choose_scenario(self, event: ValueChangeEventArguments[str]) -> None:
        if event.value == self._session.draft.base:
            return
        try:
            draft = open_draft(self._services.known[event.value])
        except NoackError as error:
            ui.notify(str(error), type="negative")
            return
        await self._open_draft(draft)

    async def _open_draft(self, draft: Draft) -> None:
        self._session.results = self._session.before = None
        self._session.draft = draft
        self._unsettled.add("")
        self._scenarios.set_value(draft.base)
        self._source_toggle.set_value(EXPLORE)
        await self._session.change(draft)

    async def _keep_run(self) -> None:
        explored = self._explored_run()
        if self._kept is not None or explored is None:
            self._kept = None
        else:
            self._kept = Reference(f"the kept run ({explored.run.kind})", explored.run)
        self._keep_button.set_text(_KEEP_TEXT if self._kept is None else _FORGET_TEXT)
        await self._show()

    async def _switch_comparison(self, event: ValueChangeEventArguments[bool | None]) -> None:
        self._comparing = bool(event.value)
        await self._show()

    async def _toggle_dark(self) -> None:
        self._is_dark = not self._is_dark
        self._dark.set_value(self._is_dark)
        self._text_panel.show_dark(dark=self._is_dark)


class _MovedSlider(NamedTuple):
    """The slider that was moved last, with its value as text."""

    key: str
    text: str


class _LastChange(NamedTuple):
    """The last change of a key, and its time in the event loop."""

    key: str
    at_s: float


class TutorialStep(NamedTuple):
    """A step of the tutorial: what to read, which settings it begins with, what to drag."""

    title: str
    text: str
    scenario: str
    settings: dict[str, object]
    drag: str


STEPS = [
    TutorialStep(**step)
    for step in tomllib.loads(_FOLDER.joinpath("tutorial.toml").read_text("utf-8"))["steps"]
]
