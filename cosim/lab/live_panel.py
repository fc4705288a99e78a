"""Runs the scenario live: five real processes, their progress, their log, the rerun viewer."""

import asyncio
from collections.abc import Callable

from nicegui import ui

from cosim.interactive.controls import controls_of
from cosim.interactive.draft import Draft, DraftError
from cosim.lab.lab_services import ANSWER_S, LabServices
from cosim.lab.live_run import MOST_LINES, LiveRun
from cosim.lab.runs_panel import show_verdict
from noack.core.errors import NoackError
from noack.core.number_format import number
from noack.runtime.run_registry import find, request_change

_POLL_S = 0.25
_REJOIN_S = 5.0
_KILLABLE = ("sensor", "netem", "controller")
_ABOUT = (
    "Plant, sensor, network emulator (netem), controller and recorder start as five processes on "
    "this machine and exchange real UDP packets, in real time.",
    "While they run, their progress, their log and the rerun viewer appear here. A line of the log "
    "says when a claim becomes void, and why.",
    "The kill buttons end a process by SIGKILL. If killed processes are restarted, the loop goes "
    "on; otherwise the run fails.",
    "At the end come a verdict of three lines and a link to the report. The record is kept in the "
    "folder {}.",
)


class LivePanel:
    """The panel; all visitors of the page see the same live run."""

    def __init__(
        self, services: LabServices, open_run: Callable[[str], None], ended: Callable[[], None]
    ) -> None:
        self._services, self._open_run, self._ended = services, open_run, ended
        self._draft: Draft | None = None
        self._live: LiveRun | None = None
        """The run that is shown, with its version and the number of its lines that are shown."""
        self._version = self._lines = 0
        self._viewer, self._is_offered = "", False
        """Address of the viewer, and whether it is offered but not shown."""
        self._shows_viewer = False
        """Whether the viewer is shown without being asked for."""
        self._plan = ui.label()
        with ui.row().classes("items-center gap-2"):
            self._start = ui.button("run live", icon="play_arrow", on_click=self._begin)
            self._stop = ui.button("stop", icon="stop", on_click=self._end).props("outline")
            self._restarts = ui.checkbox("restart killed processes", value=True)
        self._about = ui.element("ul").classes("lab-about")
        with self._about:
            for text in _ABOUT:
                with ui.element("li"):
                    ui.label(text.format(services.runs))
        self._state = ui.column().classes("w-full gap-2")
        with self._state:
            with ui.row().classes("items-center gap-2"):
                self._kill = [
                    ui.button(f"kill {role}", icon="dangerous", on_click=self._killer(role)).props(
                        "outline color=negative no-caps"
                    )
                    for role in _KILLABLE
                ]
            self._text = ui.label().props("role=status")
            self._bar = ui.linear_progress(0.0, show_value=False).props("aria-label=progress")
            self._verdict = ui.column().classes("w-full")
            self._log = (
                ui.log(max_lines=MOST_LINES).classes("w-full h-40 lab-log").props("tabindex=0")
            )
            self._frame = ui.element("div").classes("w-full")
        self._state.set_visibility(False)
        self._stop.disable()
        ui.timer(_POLL_S, self._show)

    async def begin(self) -> None:
        """Decide whether the viewer is shown without being asked for."""
        slow = await ui.run_javascript("labDrawsByProcessor()", timeout=ANSWER_S)
        self._shows_viewer = not slow

    def take(self, draft: Draft) -> None:
        """Take the draft that the next run has."""
        self._draft = draft
        try:
            horizon_s = number(draft.scenario.horizon_s, 4)
            live = [one.label for one in controls_of(draft).sliders if one.live]
        except DraftError:
            self._plan.set_text("The settings have mistakes, so they cannot be run.")
            return
        self._plan.set_text(
            f"The next run is {draft.scenario.name} with the present settings, for {horizon_s} s. "
            f"These sliders change it while it runs: {'; '.join(live)}."
        )

    async def change(self, draft: Draft, key: str) -> None:
        """Pass a slider's value on to the running loop, if that can change it."""
        self.take(draft)
        live = self._services.live
        if live is None or live.state != "running" or live.run_dir is None:
            return
        sliders = {one.key: one for one in controls_of(draft).sliders}
        if key not in sliders or not sliders[key].live:
            return
        try:
            run = find(run_dir=live.run_dir)
            await asyncio.to_thread(request_change, run, {key: draft.value(key)})
        except NoackError as error:
            ui.notify(str(error), type="warning")

    def remove_old_viewer(self) -> None:
        """Remove the viewer of a loop that has ended: loaded again it would find no server."""
        if self._live is not None and self._live.state not in ("starting", "running"):
            self._is_offered = False
            self._frame.clear()

    async def _begin(self) -> None:
        if self._draft is None:
            return
        draft = self._draft
        try:
            if draft.value("ports") is not None:
                draft = draft.without("ports")  # fixed ports may be taken by another run
            if self._restarts.value:
                draft = draft.with_value("recovery.rejoin_within_s", _REJOIN_S)
            horizon_s = draft.scenario.horizon_s
        except DraftError as error:
            ui.notify(str(error), type="negative")
            return
        self._start.disable()
        await self._services.run_live(draft.text, horizon_s, draft.folder)

    def _end(self) -> None:
        if self._services.live is not None:
            self._services.live.stop()

    def _killer(self, role: str) -> Callable[[], None]:
        def kill() -> None:
            live = self._services.live
            if live is None or not live.kill(role):
                ui.notify(f"no {role} is running", type="warning")

        return kill

    def _show(self) -> None:
        live = self._services.live
        if live is None or (self._live, self._version) == (live, live.version):
            return
        if self._live is not live:
            self._begin_anew(live)
        self._version = live.version
        for line in live.lines[max(self._lines - live.first_line, 0) :]:
            self._log.push(line)
        self._lines = live.first_line + len(live.lines)
        self._text.set_text(_words(live))
        reached_s = live.progress.t_s if live.progress else 0.0
        self._bar.set_value(min(reached_s / live.horizon_s, 1.0))
        for button, enabled in (
            (self._start, live.is_over),
            (self._stop, not live.is_over),
            *((one, live.state == "running") for one in self._kill),
        ):
            button.set_enabled(enabled)
        if live.viewer and live.viewer != self._viewer:
            self._viewer = live.viewer
            self._offer_viewer(live.viewer)
        if self._is_offered and live.state != "running":
            self.remove_old_viewer()  # its server ends with the loop
        if live.verdict and live.run_dir is not None and not self._verdict.default_slot.children:
            name = live.run_dir.name
            with self._verdict:
                show_verdict(live.verdict, name)
                ui.button("figures of this run", on_click=lambda: self._open_run(name)).props(
                    "outline no-caps"
                )
            self._ended()

    def _begin_anew(self, live: LiveRun) -> None:
        """Remove what is shown of another run."""
        self._live, self._lines, self._viewer = live, 0, ""
        self._about.set_visibility(False)
        self._state.set_visibility(True)
        for one in (self._log, self._frame, self._verdict):
            one.clear()

    def _offer_viewer(self, address: str) -> None:
        if self._shows_viewer:
            self._show_viewer(address)
            return
        self._is_offered = True
        with self._frame:
            ui.label("This browser draws without a graphics card: the viewer would take the "
                     "processor from the loop and from this page.")  # fmt: skip
            ui.button("show the viewer here", on_click=lambda: self._show_viewer(address)).props(
                "outline no-caps"
            )

    def _show_viewer(self, address: str) -> None:
        self._is_offered = False
        self._frame.clear()
        with self._frame:
            ui.link("open the viewer in a tab of its own", address, new_tab=True)
            ui.element("iframe").props(f'src="{address}" title="rerun viewer"').classes(
                "w-full lab-viewer"
            )


def _words(live: LiveRun) -> str:
    if (progress := live.progress) is None:
        return live.state
    found = (
        f"{live.state}: {progress.t_s:.1f} of {live.horizon_s:g} s, "
        f"{progress.events} transmissions, {progress.deliveries} received, longest loss "
        f"burst {progress.longest_loss_burst}"
    )
    if progress.x_norm is not None:
        found += f", ‖x‖ {progress.x_norm:.3g}"
    return found
