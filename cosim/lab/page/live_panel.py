"""Runs the scenario live: five real processes, their progress, their log, the rerun viewer."""

import asyncio
from typing import Any

from nicegui import ui

from cosim.interactive.controls import controls_of
from cosim.interactive.draft import Draft, DraftError
from cosim.lab.live_run import LiveRun
from cosim.lab.page.lab_services import LabServices
from noack.core.errors import NoackError
from noack.runtime.run_registry import find, request_change

_POLL_S = 0.25
_REJOIN_S = 5.0
_KILLABLE = ("sensor", "netem", "controller")


class LivePanel:
    """The panel; all visitors of the page see the same live run."""

    def __init__(self, services: LabServices) -> None:
        self._services = services
        self._draft: Draft | None = None
        self._seen: tuple[LiveRun | None, int] = (None, -1)
        self._viewer = ""
        with ui.row().classes("items-center gap-2"):
            self._start = ui.button("run live", icon="play_arrow", on_click=self._begin)
            self._stop = ui.button("stop", icon="stop", on_click=self._end).props("outline")
            self._restarts = ui.checkbox("restart killed processes", value=True)
        with ui.row().classes("items-center gap-2 text-sm"):
            self._kill = [
                ui.button(f"kill {role}", on_click=lambda role=role: self._kill_one(role)).props(
                    "outline dense size=sm color=negative no-caps"
                )
                for role in _KILLABLE
            ]
        self._text = ui.label("nothing has run yet").classes("text-sm").props("role=status")
        self._bar = ui.linear_progress(0.0, show_value=False).props("aria-label=progress")
        self._log = ui.log(max_lines=200).classes("w-full h-40 text-xs lab-log")
        self._frame = ui.element("div").classes("w-full")
        ui.timer(_POLL_S, self._show)

    def take(self, draft: Draft) -> None:
        """Take the draft that the next run has."""
        self._draft = draft

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
        self._log.clear()
        await self._services.run_live(draft.text, horizon_s, draft.folder)

    def _end(self) -> None:
        if self._services.live is not None:
            self._services.live.stop()

    def _kill_one(self, role: str) -> None:
        live = self._services.live
        if live is None or not live.kill(role):
            ui.notify(f"no {role} is running", type="warning")

    def _show(self) -> None:
        live = self._services.live
        if live is None:
            self._stop.disable()
            return
        if self._seen == (live, live.version):
            return
        shown = 0 if self._seen[0] is not live else len(self._log.default_slot.children)
        self._seen = (live, live.version)
        for line in live.lines[shown:]:
            self._log.push(line)
        self._text.set_text(_words(live))
        self._bar.set_value(min(live.progress.get("t_s", 0.0) / live.horizon_s, 1.0))
        for button, enabled in (
            (self._start, live.is_over), (self._stop, not live.is_over),
            *((one, live.state == "running") for one in self._kill),
        ):  # fmt: skip
            button.set_enabled(enabled)
        if live.viewer and live.viewer != self._viewer:
            self._viewer = live.viewer
            self._show_viewer(live.viewer)

    def _show_viewer(self, address: str) -> None:
        self._frame.clear()
        with self._frame:
            ui.link("open the viewer in a tab of its own", address, new_tab=True)
            ui.element("iframe").props(f'src="{address}" title="rerun viewer"').classes(
                "w-full lab-viewer"
            )


def _words(live: LiveRun) -> str:
    progress: dict[str, Any] = live.progress
    if not progress:
        return live.state
    found = (
        f"{live.state}: {progress['t_s']:.1f} of {live.horizon_s:g} s, "
        f"{progress['events']} transmissions, {progress['deliveries']} received, longest loss "
        f"burst {progress['longest_loss_burst']}"
    )
    if progress.get("x_norm") is not None:
        found += f", ‖x‖ {progress['x_norm']:.3g}"
    return found
