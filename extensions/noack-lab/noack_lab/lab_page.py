"""The page as a visitor sees it: the figure, the words about it, and a drawer with the settings.

The figure shows one of three sources: the explored run, the live run, or a recorded one.
"""

import asyncio
from collections.abc import Callable, Iterable
from functools import partial
from typing import Literal

from nicegui import ui
from nicegui.events import GenericEventArguments, ValueChangeEventArguments

import noack
from noack_lab import results
from noack_lab.chart import PHONE_PX, Drawn, chart_options, height_px, layout_of, values_of
from noack_lab.lab_services import LabServices
from noack_lab.results import Guarantee, ShownRun, VerdictText
from noack_lab.scenario_draft import Draft, open_draft
from noack_lab.sliders import LOSSES, MODES, POLICIES, Slider, choose, drag, sliders

EXPLORE, LIVE, RECORDED = "explore", "live", "recorded"
_POLL_S = 0.5
"""Time between two looks at the live run."""
_QUIET_S = 0.3
"""Time after the last change until what takes longer than a redraw is computed."""
_GESTURE_S = 1.0
"""Changes of one key follow each other within this time while a slider is dragged."""
_THROTTLE_S = 0.08
"""Least time between two values of a dragged slider."""
_ABOUT = (
    "“run live” starts plant, sensor, network emulator, controller and recorder as five processes on "
    "this machine, which exchange real UDP packets in real time. When the run has ended, its record "
    "is shown. “noack view” shows it moving."
)
_CSS = """
.nicegui-content { padding: 8px 12px; }
.q-header .q-field__label { color: white; opacity: 1; }
.lab-stage { display: grid; grid-template-columns: minmax(0, 1fr); gap: 8px 20px; width: 100%; }
@media (min-width: 1240px) { .lab-stage { grid-template-columns: minmax(0, 1fr) 21rem; } }
.lab-side { display: flex; flex-direction: column; gap: 8px; min-width: 0; overflow-wrap: anywhere; }
.lab-verdict { padding: 6px 12px; background: #f4f6f8; border-left: 5px solid #75808c; min-height: 5.6rem; }
.lab-good { color: #116329; } .lab-doubt { color: #845300; } .lab-bad { color: #b3202f; font-weight: 600; }
.lab-side table { width: 100%; border-collapse: collapse; font-variant-numeric: tabular-nums; }
.lab-side td, .lab-side th { text-align: left; vertical-align: top; padding: 2px 8px 2px 0;
  border-bottom: 1px solid #dfe3e8; font-weight: normal; }
.lab-side td { font-weight: 600; }
.lab-side .nicegui-log, .lab-side .nicegui-log * { white-space: pre-wrap; font-size: 13px; }
.lab-stale { opacity: .35; }
.lab-label { font-size: 13px; line-height: 1.3; }
.lab-side a { color: #1d4ed8; text-decoration: underline; }
@media (max-width: 600px) { .lab-title { display: none; } }
"""
_REPORT_WIDTH = """
let last = 0, timer;
new ResizeObserver(([stage]) => {
  clearTimeout(timer);
  timer = setTimeout(() => {
    const width = Math.round(document.querySelector('.lab-chart').clientWidth);
    if (width && width !== last) emitEvent('lab_width', last = width);
  }, 250);
}).observe(document.querySelector('.lab-stage'));
"""
"""Reports the width of the figure: its legends have as many lines as they need there."""


async def show_page(services: LabServices) -> None:
    """Build the page for one visitor, and draw for the first time."""
    ui.add_css(_CSS)
    ui.colors(primary="#1f5f99", negative="#b3261e", warning="#8a5300", positive="#1b6e3c")
    page, client = _Page(services), ui.context.client
    page.build()
    await client.connected()
    if not client.is_deleted:  # what asks for the page only, as a preview of links, never connects
        client.run_javascript(_REPORT_WIDTH)
        await page.open(services.draft)


class _Page:
    """The page of one visitor."""

    def __init__(self, services: LabServices) -> None:
        self._services, self._client = services, ui.context.client
        self._draft = self._base = services.draft
        self._source, self._state = EXPLORE, ""
        self._run: ShownRun | None = None
        """The explored run."""
        self._guarantee: Guarantee | None = None
        self._before: ShownRun | None = None
        """The run before the last change."""
        self._kept: ShownRun | None = None
        self._recorded: ShownRun | None = None
        self._wanted = self._drawn = 0
        """Numbers of the newest draft, and of the one that is drawn."""
        self._is_drawing = False
        self._last_change = ("", 0.0)
        """The key that was changed last, and when."""
        self._rest: asyncio.Task[None] | None = None
        self._live_version = -1
        self._margin = self._explored_note = ""
        self._width_px = PHONE_PX
        """Width of the figure."""
        self._layout: object = None
        """Panels and curves of the chart; with the same, only values are sent."""

    # What the page has

    def build(self) -> None:
        """Build head, drawer, bar, figure and side."""
        with ui.header().classes("items-center gap-2 py-1 no-wrap"):
            ui.button(icon="tune", on_click=self._toggle_drawer).props(
                'flat color=white dense aria-label="settings" title="settings"'
            )
            ui.label("noack lab").classes("text-h6 lab-title").props("role=heading aria-level=1")
            names = sorted({*noack.scenarios(), self._draft.name})
            self._scenarios = ui.select(
                names, value=self._draft.name, label="scenario", on_change=self._choose_scenario
            )
            self._scenarios.props("dense options-dense dark standout").classes("w-60")
            ui.space()
            ui.button(icon="download", on_click=self._download).props(
                'flat color=white dense aria-label="save scenario" title="save the scenario as a file"'
            )
        with ui.left_drawer(value=False, bordered=True).props(
            "width=320 breakpoint=900 show-if-above"
        ) as self._drawer:
            self._controls = ui.column().classes("w-full gap-1")
            with ui.expansion("all settings (TOML)").classes("w-full").props("dense"):
                self._editor = ui.codemirror(
                    self._draft.text, language="TOML", line_wrapping=True, on_change=self._edit
                ).classes("w-full h-96")
        with ui.row().classes("items-center gap-2 w-full"):
            self._toggle = ui.toggle([EXPLORE, LIVE, RECORDED], value=EXPLORE, on_change=self._switch)
            self._toggle.props("no-caps dense")
            self._states = ui.select([], label="state", on_change=self._choose_state).classes("w-28")
            self._states.props("dense options-dense")
            with ui.row().classes("items-center gap-2") as self._of_explore:
                self._keep = ui.button("keep for comparison", icon="compare", on_click=self._keep_run)
                self._keep.props("outline no-caps dense")
                self._compare = ui.checkbox("compare", value=True, on_change=self._draw).props("dense")
            with ui.row().classes("items-center gap-2") as self._of_live:
                self._start = ui.button("run live", icon="play_arrow", on_click=self._run_live)
                self._start.props("no-caps dense")
                self._stop = ui.button("stop", icon="stop", on_click=self._stop_live).props(
                    "outline no-caps dense"
                )
            with ui.row().classes("items-center gap-2") as self._of_recorded:
                self._runs = ui.select([], label="run", on_change=self._read_record).classes("w-72")
                self._loops = ui.select([], label="loop", on_change=self._read_record).classes("w-32")
                for select in (self._runs, self._loops):
                    select.props("dense options-dense")
                ui.button("replay", icon="replay", on_click=self._replay).props("outline no-caps dense")
        with ui.element("main").classes("lab-stage"):
            self._chart = ui.echart({}).classes("w-full lab-chart").props("role=img aria-label=figure")
            with ui.element("div").classes("lab-side"):
                self._progress = ui.linear_progress(0.0, show_value=False).props("aria-label=progress")
                self._verdict = ui.element("section").classes("lab-verdict").props("aria-label=verdict")
                self._note = ui.label().classes("lab-doubt whitespace-pre-line").props("role=status")
                self._report = ui.link("report of this run (all figures and tables)", "", new_tab=True)
                self._margin_button = ui.button("compute the margin", on_click=self._compute_margin)
                self._margin_button.props("outline no-caps dense")
                self._facts = ui.element("div")
                self._log = ui.log(max_lines=200).classes("w-full h-40")
                self._log.props('tabindex=0 role=region aria-label="log of the run"')
        ui.timer(_POLL_S, self._follow)
        ui.on("lab_width", self._set_width)
        self._show_parts()

    def _set_width(self, event: GenericEventArguments) -> None:
        self._width_px = int(event.args)
        self._draw()

    def _toggle_drawer(self) -> None:
        self._drawer.toggle()

    def _show_parts(self) -> None:
        """Show the parts of the chosen source."""
        live = self._services.live
        self._of_explore.set_visibility(self._source == EXPLORE)
        self._of_live.set_visibility(self._source == LIVE)
        self._of_recorded.set_visibility(self._source == RECORDED)
        self._margin_button.set_visibility(self._source == EXPLORE)
        is_running = live is not None and not live.is_over
        self._progress.set_visibility(self._source == LIVE and is_running)
        self._log.set_visibility(self._source == LIVE)
        self._start.set_enabled(not is_running)
        self._stop.set_enabled(is_running)
        self._report.set_visibility(self._source == RECORDED and bool(self._runs.value))
        self._loops.set_visibility(self._source == RECORDED and len(self._loops.options) > 1)

    def _build_controls(self) -> None:
        """Build choices and sliders of the draft; those of a wrong one stay."""
        try:
            found, scenario = sliders(self._draft, self._base), self._draft.scenario
        except noack.NoackError:
            return
        self._controls.clear()
        with self._controls:
            for key, label, value, options in (
                ("mode", "input between updates", scenario.mode, MODES),
                ("trigger", "trigger policy", scenario.trigger.policy, _words(POLICIES)),
                ("network.loss", "loss model", scenario.network.loss.model, _words(LOSSES)),
            ):
                known = {value: value.replace("_", " "), **options}
                select = ui.select(known, value=value, label=label, on_change=partial(self._choose, key))
                select.classes("w-full").props("dense options-dense")
            for slider in found:
                self._build_slider(slider)

    def _build_slider(self, slider: Slider) -> None:
        with ui.row().classes("w-full justify-between no-wrap gap-2 lab-label"):
            ui.label(slider.label)
            value = ui.label(slider.text).classes("font-bold")
        low, high = slider.position_of(slider.low), slider.position_of(slider.high)
        element = ui.slider(
            min=low, max=high, step=slider.step, value=slider.position_of(slider.value)
        ).props(f'dense aria-label="{slider.label}"')

        async def slide(event: GenericEventArguments) -> None:
            new = slider.value_at(float(event.args))
            value.set_text(f"{new:.4g}")
            await self._change(lambda draft: drag(draft, self._base, slider.key, new), slider.key)

        async def released(event: GenericEventArguments) -> None:
            live = self._services.live
            if live is None or not slider.is_live or self._source != LIVE:
                return
            if problem := await live.change(slider.key, slider.value_at(float(event.args))):
                self._notify(problem, "warning")

        element.on("update:model-value", slide, throttle=_THROTTLE_S)
        element.on("change", released)

    # What is computed

    async def open(self, draft: Draft) -> None:
        """Show a scenario, from which the sliders have their ranges."""
        self._base = draft
        self._run = self._before = self._guarantee = None
        await self._change(lambda _: draft, "")
        if not self._client.is_deleted:
            self._build_controls()

    async def _change(self, change: Callable[[Draft], Draft], key: str) -> None:
        """Change the draft; of several changes during a redraw only the newest is drawn."""
        now_s, (last_key, last_s) = asyncio.get_running_loop().time(), self._last_change
        self._last_change = (key, now_s)
        if self._run is not None and (key != last_key or now_s - last_s > _GESTURE_S):
            self._before = self._run
        try:
            self._draft = change(self._draft)
        except noack.NoackError as error:
            self._notify(str(error), "negative")
            return
        self._wanted += 1
        if self._rest is not None:
            self._rest.cancel()
        if self._is_drawing:
            return
        self._is_drawing = True
        try:
            while self._drawn != self._wanted:
                self._drawn = self._wanted
                await self._explore()
        finally:
            self._is_drawing = False
        self._rest = asyncio.create_task(self._compute_rest(self._draft))

    async def _explore(self) -> None:
        """Run the draft, and draw it; a wrong one leaves the figure as it was, but pale."""
        try:
            scenario = self._draft.scenario
            try:
                self._run = results.exact_run_of(scenario)
            except noack.NoackError:
                self._run = await self._services.compute(results.run_of, scenario)
            note, self._guarantee, self._margin = self._run.note, None, ""
            is_wrong = False
        except noack.NoackError as error:
            note = f"{error}\nThe figure shows the settings before." if self._run else str(error)
            is_wrong = True
        if self._client.is_deleted:  # the visitor has left meanwhile
            return
        self._chart.classes(add="lab-stale" if is_wrong else None, remove=None if is_wrong else "lab-stale")
        self._explored_note = note
        self._note.set_text(note)
        self._draw()

    async def _compute_rest(self, draft: Draft) -> None:
        """Compute what takes longer, once the settings have rested for a moment."""
        await asyncio.sleep(_QUIET_S)
        if self._client.is_deleted:
            return
        if self._editor.value != draft.text:
            self._editor.set_value(draft.text)
        try:
            scenario = draft.scenario
        except noack.NoackError:
            return
        if scenario.loops:
            return
        guarantee = await self._services.compute(results.guarantee_of, scenario)
        if draft is self._draft:
            self._guarantee = guarantee
            self._draw()

    async def _compute_margin(self) -> None:
        draft = self._draft
        self._margin = "being computed"
        self._draw()
        margin = await self._services.compute(results.margin_of, draft.scenario)
        if draft is self._draft:
            self._margin = margin
            self._draw()

    # What is shown

    def _shown(self) -> ShownRun | None:
        live = self._services.live
        if self._source == LIVE:
            return None if live is None else live.shown
        return self._run if self._source == EXPLORE else self._recorded

    def _draw(self) -> None:
        """Show the chosen source: figure, verdict, key numbers; nothing to a visitor who has left."""
        if self._client.is_deleted:
            return
        self._show_parts()
        run = self._shown()
        self._chart.set_visibility(run is not None)
        self._states.set_visibility(run is not None and len(run.states) > 1)
        self._show_verdict(
            [VerdictText(_ABOUT)] if run is None and self._source == LIVE else self._lines(run)
        )
        if run is None:
            self._facts.clear()
            return
        exploring = self._source == EXPLORE
        reference = (self._kept or self._before) if exploring and self._compare.value else None
        bounds = self._guarantee.curves if exploring and self._guarantee else ()
        options = chart_options(Drawn(run, self._state, bounds, reference, self._width_px))
        if (layout := layout_of(options)) == self._layout:
            self._chart.run_chart_method("setOption", values_of(options))
        else:
            self._layout = layout
            self._chart.options.clear()
            self._chart.options.update(options)
            self._chart.style(f"height: {height_px(options)}px")
            self._chart.update()
        if self._states.options != run.states:
            state = self._state if self._state in run.states else next(iter(run.states), None)
            self._states.set_options(run.states, value=state)
        self._show_facts(run, reference)

    def _lines(self, run: ShownRun | None) -> list[VerdictText]:
        if run is None or self._source != EXPLORE:
            return [] if run is None else run.verdict
        if run.kind != results.EXACT:  # its verdict has the guarantee
            return run.verdict
        if self._guarantee is None:
            return [*run.verdict, VerdictText("certificate: being computed")]
        return [*run.verdict, results.kept_line(run, self._guarantee)]

    def _show_verdict(self, lines: Iterable[VerdictText]) -> None:
        self._verdict.clear()
        with self._verdict:
            for line in lines:
                ui.label(line.text).classes(f"lab-{line.tone}" if line.tone else "")

    def _show_facts(self, run: ShownRun, reference: ShownRun | None) -> None:
        self._facts.clear()
        with self._facts:
            if reference is not None:
                kept = "the kept run" if self._kept else "before"
                _table(("", kept, "now"), results.compare(reference, run))
            elif self._source != LIVE:
                _table(("", run.kind), run.facts)
            if self._source == EXPLORE and self._guarantee is not None and self._guarantee.facts:
                _table(("certificate", ""), self._guarantee.facts)
            if self._margin:
                _table(("margin", ""), [("every loss pattern", self._margin)])

    # What the visitor does

    async def _choose(self, key: str, event: ValueChangeEventArguments[str]) -> None:
        await self._change(lambda draft: choose(draft, key, event.value), key)
        self._build_controls()

    async def _edit(self, event: ValueChangeEventArguments[str]) -> None:
        if event.value != self._draft.text:
            await self._change(lambda draft: Draft(draft.name, event.value), "text")
            self._build_controls()

    async def _choose_scenario(self, event: ValueChangeEventArguments[str]) -> None:
        draft = self._services.draft
        if event.value != draft.name:
            draft = open_draft(event.value)
        self._toggle.set_value(EXPLORE)
        await self.open(draft)

    def _choose_state(self, event: ValueChangeEventArguments[str]) -> None:
        if event.value and event.value != self._state:
            self._state = event.value
            self._draw()

    def _keep_run(self) -> None:
        self._kept = self._run if self._kept is None else None
        self._keep.set_text("keep for comparison" if self._kept is None else "forget the kept run")
        self._draw()

    def _download(self) -> None:
        ui.download(self._draft.text.encode(), "my_loop.toml", "application/toml")

    async def _switch(self, event: ValueChangeEventArguments[str]) -> None:
        self._source = event.value
        self._note.set_text(self._explored_note if self._source == EXPLORE else "")
        if self._source == RECORDED:
            await self._look_for_runs()
        self._draw()

    def _run_live(self) -> None:
        try:
            self._services.run_live(self._draft.with_value("ports", None).scenario)
        except noack.NoackError as error:
            self._notify(str(error), "negative")
        self._log.clear()
        self._draw()

    def _stop_live(self) -> None:
        if self._services.live is not None:
            self._services.live.stop()

    async def _follow(self) -> None:
        """Follow the live run; when it has ended, show its record."""
        live = self._services.live
        if live is None or live.version == self._live_version or self._source != LIVE:
            return
        is_new = self._live_version < 0
        self._live_version = live.version
        self._progress.set_value(live.share)
        self._log.clear()
        for line in live.lines:
            self._log.push(line)
        self._draw()
        if live.is_over and live.directory is not None and not is_new:
            self._toggle.set_value(RECORDED)

    async def _look_for_runs(self) -> None:
        names = await asyncio.to_thread(self._services.recorded)
        self._note.set_text("" if names else f"no run has ended in {self._services.runs} yet")
        newest = names[0] if names else None
        chosen = self._runs.value if self._runs.options[:1] == names[:1] else newest
        self._runs.set_options(names, value=chosen)

    async def _read_record(self, event: ValueChangeEventArguments[str]) -> None:
        name, loop = self._runs.value, self._loops.value
        if not name or (event.sender is self._loops and self._recorded is None):
            return
        self._note.set_text("reading the record …")
        try:
            record = await self._services.compute(results.recorded_run, self._services.runs / name, loop)
        except noack.NoackError as error:
            if not self._client.is_deleted:
                self._note.set_text(str(error))
            return
        if name != self._runs.value or self._client.is_deleted:
            return  # another one was chosen meanwhile, or the visitor has left
        self._recorded = record
        self._note.set_text("")
        self._report.props["href"] = f"report/{name}"
        if self._loops.options != list(record.loops):
            self._loops.set_options(list(record.loops), value=record.loops[0])
        self._draw()

    async def _replay(self) -> None:
        if name := self._runs.value:
            self._note.set_text("replaying …")
            try:
                answer = await self._services.compute(results.replay, self._services.runs / name)
            except noack.NoackError as error:
                answer = str(error)
            if not self._client.is_deleted:
                self._note.set_text(answer)

    def _notify(self, text: str, kind: Literal["negative", "warning"]) -> None:
        with self._client:
            ui.notify(text, type=kind, multi_line=True, close_button="close")


def _table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> None:
    """Show rows of text; the first cell of each is its name."""
    with ui.element("table"):
        with ui.element("thead"), ui.element("tr"):
            for head in heads:
                with ui.element("th").props("scope=col"):
                    ui.label(head)
        with ui.element("tbody"):
            for row in rows:
                with ui.element("tr"):
                    for i, cell in enumerate(row):
                        with ui.element("td" if i else "th").props("" if i else "scope=row"):
                            ui.label(cell)


def _words(names: Iterable[str]) -> dict[str, str]:
    return {name: name.replace("_", " ") for name in names}
