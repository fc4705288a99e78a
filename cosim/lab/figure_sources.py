"""Where the figure comes from besides exploring: a live run, and recorded runs.

Each has its controls in the bar above the figure; a live run also its log and the rerun viewer.
"""

import asyncio
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from urllib.parse import quote

from nicegui import ui
from nicegui.events import ValueChangeEventArguments

from cosim.interactive.exploration import Exploration
from cosim.interactive.scenario_draft import Draft, DraftError
from cosim.interactive.sliders import controls_of
from cosim.lab.lab_services import LabServices, PageCalls
from cosim.lab.live_run import MOST_LINES, LiveRun
from cosim.lab.recorded_views import RunView, recorded_view, replay_run
from cosim.output.run_verdict import Tone, VerdictLine, transmission_line
from noack.core.errors import NoackError
from noack.core.number_format import number
from noack.runtime.active_runs import find_run, request_change

Changed = Callable[[], Awaitable[None]]
_KILLABLE = ("sensor", "netem", "controller")
_ABOUT = (
    "“run live” starts plant, sensor, network emulator (netem), controller and recorder as five "
    "processes on this machine, which exchange real UDP packets in real time. The figure then "
    "shows what they record, dashed beside it the ideal loop. The kill buttons end a process by "
    "SIGKILL: the run ends, and says so; nothing that was recorded is lost."
)


class LiveSource:
    """The live run; all visitors of the page see the same one."""

    name = "live"

    def __init__(
        self,
        services: LabServices,
        draft: Callable[[], Draft],
        replay: Callable[[str], Awaitable[None]],
    ) -> None:
        self._services, self._draft, self._replay = services, draft, replay
        self._live: LiveRun | None = None
        """The run that is shown, with its version and the number of its lines that are shown."""
        self._version = self._lines = 0
        self._start_button = ui.button("run live", icon="play_arrow", on_click=self._start_run).props(
            "no-caps dense"
        )
        self._stop_button = ui.button("stop", icon="stop", on_click=self._stop_run).props(
            "outline no-caps dense"
        )
        self._replay_button = ui.button("replay this run", icon="replay", on_click=self._replay_run).props(
            "no-caps dense"
        )
        self._stop_button.disable()
        self._replay_button.set_visibility(False)

    def build_details(self) -> None:
        """Build kill buttons, log and viewer, which are below the words about the run."""
        with ui.row().classes("items-center gap-2"):
            self._kill_buttons = [
                ui.button(f"kill {role}", icon="dangerous", on_click=self._killer(role)).props(
                    "outline color=negative no-caps dense"
                )
                for role in _KILLABLE
            ]
        self._log = ui.log(max_lines=MOST_LINES).classes("w-full h-40 lab-log")
        self._log.props('tabindex=0 role=region aria-label="log of the run"')
        self._viewer_button = ui.button("show the rerun viewer", on_click=self._show_viewer).props(
            'outline no-caps dense title="In a browser without a graphics card it takes the '
            'processor from the loop."'
        )
        self._frame = ui.element("div").classes("w-full")

    def watch(self) -> Exploration | None:
        """Return the recorded part of the run, and ask for a newer one; None without a run."""
        if (live := self._services.live) is None:
            return None
        live.watched = True
        return live.exploration

    @property
    def is_running(self) -> bool:
        """Whether a loop is running, whose settings can then be changed."""
        return self._services.live is not None and self._services.live.state == "running"

    @property
    def progress(self) -> float | None:
        """The simulated share of the horizon; None if no run is active."""
        live = self._services.live
        if live is None or live.is_over:
            return None
        return min((live.progress.t_s if live.progress else 0.0) / live.horizon_s, 1.0)

    @property
    def verdict(self) -> list[VerdictLine]:
        """The verdict of a run that has ended; the state and the counts of an active one."""
        if (live := self._services.live) is None:
            return [VerdictLine(_ABOUT, Tone.NEUTRAL)]
        if live.verdict:
            return live.verdict
        lines = [VerdictLine(_status_text(live), Tone.NEUTRAL)]
        if (progress := live.progress) is not None:
            kept = progress.warnings[-1:] or ["guarantee kept so far"]
            tone = Tone.DOUBTFUL if progress.warnings else Tone.NEUTRAL
            lines += [VerdictLine(kept[0], tone)]
            lines += [transmission_line(progress.events, progress.deliveries)]
        return lines

    @property
    def report(self) -> str:
        """Name of the run directory of a run that has ended; empty before."""
        live = self._services.live
        return live.run_dir.name if live and live.verdict and live.run_dir else ""

    def follow(self) -> bool:
        """Bring buttons and log up to date; return whether something has changed."""
        live = self._services.live
        if live is None or (self._live, self._version) == (live, live.version):
            return False
        if self._live is not live:
            self._live, self._lines = live, 0
            self._log.clear()
        self._version = live.version
        for line in live.lines[max(self._lines - live.first_line, 0) :]:
            self._log.push(line)
        self._lines = live.first_line + len(live.lines)
        for button, enabled in (
            (self._start_button, live.is_over),
            (self._stop_button, not live.is_over),
            *((button, live.state == "running") for button in self._kill_buttons),
            (self._viewer_button, live.state == "running" and live.viewer is not None),
        ):
            button.set_enabled(enabled)
        self._replay_button.set_visibility(bool(self.report))
        if live.state != "running":
            self._frame.clear()  # its server ends with the loop
        return True

    async def change(self, draft: Draft, keys: set[str]) -> None:
        """Pass new values of sliders on to the running loop, if that can change them."""
        live = self._services.live
        if not self.is_running or live is None or live.run_dir is None:
            return
        known = {slider.key for slider in controls_of(draft).sliders if slider.live} & keys
        if not known:
            return
        try:
            run = find_run(run_dir=live.run_dir)
            await asyncio.to_thread(request_change, run, {key: draft.value(key) for key in known})
        except NoackError as error:
            ui.notify(str(error), type="warning")

    async def _start_run(self) -> None:
        draft = self._draft()
        try:
            if draft.value("ports") is not None:
                draft = draft.without("ports")  # fixed ports may be taken by another run
            horizon_s = draft.scenario.horizon_s
        except DraftError as error:
            ui.notify(str(error), type="negative")
            return
        self._start_button.disable()
        await self._services.run_live(draft.text, horizon_s, draft.folder)

    async def _replay_run(self) -> None:
        if self.report:
            await self._replay(self.report)

    def _stop_run(self) -> None:
        if self._services.live is not None:
            self._services.live.stop()

    def _killer(self, role: str) -> Callable[[], None]:
        def kill() -> None:
            live = self._services.live
            if live is None or not live.kill(role):
                ui.notify(f"no {role} is running", type="warning")

        return kill

    def _show_viewer(self) -> None:
        address = self._live.viewer if self._live else None
        self._frame.clear()
        with self._frame:
            ui.link("open the viewer in a tab of its own", address or "", new_tab=True)
            ui.element("iframe").props(f'src="{address}" title="rerun viewer"').classes("w-full lab-viewer")


def _status_text(live: LiveRun) -> str:
    if (progress := live.progress) is None:
        return live.state
    state = f"{live.state}: {progress.t_s:.1f} of {live.horizon_s:g} s"
    if progress.x_norm is not None:
        state += f", ‖x‖ {number(progress.x_norm, 3)}"
    return f"{state}, longest loss burst {progress.longest_loss_burst}"


class RecordedSource:
    """The recorded runs; one of them is chosen."""

    name = "recorded"

    def __init__(self, services: LabServices, calls: PageCalls, changed: Changed) -> None:
        self._services, self._calls, self._changed = services, calls, changed
        self.view: RunView | None = None
        self.note = ""
        self._newest: str | None = None
        self._is_replay_asked = False
        """Whether the run is replayed once its record is read."""
        self._select = ui.select([], label="run", on_change=self._read_record).classes("w-72")
        self._select.props("dense options-dense")
        self._loop = ui.select([], label="loop", on_change=self._read_record).props("dense options-dense")
        ui.button(icon="refresh", on_click=self.refresh).props('flat dense aria-label="look for new runs"')

    def build_details(self) -> None:
        """Build the button for a run, below the words about it."""
        answer = partial(self._show_answer, replay_run)
        ui.button("replay", on_click=answer).props("outline no-caps dense").classes("mr-2")

    @property
    def chosen(self) -> str:
        """Name of the chosen run; empty without one."""
        return str(self._select.value or "")

    def refresh(self) -> None:
        """Look for new runs; choose the newest that has ended, if it is a new one."""
        names = self._services.recorded()
        newest = next((name for name in names if self._services.has_ended(name)), None)
        chosen = self._select.value if newest == self._newest else newest
        self._newest = newest
        self._loop.set_visibility(False)
        if newest is None:
            self.note = (
                f"No run has ended in the folder {self._services.runs} yet. A live run appears "
                "here; so does each run of “noack run” and “noack simulate” in this folder."
            )
        self._select.set_options(names, value=chosen)

    async def replay(self, name: str) -> None:
        """Choose a run, and replay it."""
        self._is_replay_asked = True
        self.refresh()
        if self.chosen != name:
            self._select.set_value(name)
        elif self.view is not None:
            await self._replay_if_asked()

    async def _replay_if_asked(self) -> None:
        if self._is_replay_asked:
            self._is_replay_asked = False
            await self._show_answer(replay_run)

    async def _show_answer(self, function: Callable[[Path], str]) -> None:
        """Show the words that a function returns about the chosen run."""
        if not self.chosen:
            return
        self.note = "computing …"
        await self._changed()
        try:
            self.note = await self._calls.compute(function, self._services.runs / self.chosen)
        except NoackError as error:
            self.note = str(error)
        await self._changed()

    async def _read_record(self, event: ValueChangeEventArguments[str]) -> None:
        if not self.chosen:
            return
        if event.sender is self._select:
            self.view = None
        self.note = "" if self.view else "reading the record …"
        name, loop = self.chosen, self._loop.value
        try:
            view = await self._calls.compute(recorded_view, self._services.runs / name, loop)
        except NoackError as error:
            self.note = str(error)
        else:
            if name != self.chosen:
                return  # another one was chosen meanwhile
            self.view = view
            self.note = "" if self.note.startswith("reading") else self.note
            self._loop.set_visibility(len(view.loops) > 1)
            self._loop.set_options([*view.loops], value=loop if loop in view.loops else None)
        await self._changed()
        await self._replay_if_asked()


def report_address(name: str) -> str:
    """Return the address of a run's report, relative to the page."""
    return f"report/{quote(name)}"
