"""Recorded runs: their reports, in a frame; replay and fidelity on request.

The report of a run is served below the page's address.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any
from urllib.parse import quote

from fastapi import FastAPI
from fastapi.responses import HTMLResponse, PlainTextResponse, Response
from nicegui import ui

from cosim.lab.lab_services import LabServices, PageCalls
from cosim.output.run_verdict import BAD, DOUBTFUL, GOOD, NEUTRAL
from noack.core.errors import NoackError


def replayed(directory: Path) -> str:
    """Replay a run; called in the worker process."""
    import noack

    found = noack.open_run(directory).replay()
    return (
        "bit-exact: the same numbers again"
        if found.bit_exact
        else f"differs: {found.first_difference}"
    )


def compared(directory: Path) -> str:
    """Compare a run with the ideal loop; called in the worker process."""
    import noack

    return str(noack.open_run(directory).fidelity().verdict)


class RunsPanel:
    """The panel."""

    def __init__(
        self, services: LabServices, calls: PageCalls, run_live: Callable[[], object]
    ) -> None:
        self._services, self._calls = services, calls
        self._newest: str | None = None
        with ui.row().classes("items-center gap-2"):
            self._select = ui.select([], label="run", on_change=self._open).classes("w-72")
            ui.button(icon="refresh", on_click=self.refresh).props(
                'flat dense aria-label="look for new runs"'
            )
        with ui.column().classes("gap-2") as self._empty:
            ui.label(f"No run has ended in the folder {services.runs} yet.")
            ui.label(
                "A live run appears here with its verdict, key numbers, claims and figures; so "
                "does each run of “noack run” and “noack simulate” in this folder."
            )
            ui.button("to the live run", icon="play_arrow", on_click=run_live).props("no-caps")
        self._content = ui.column().classes("w-full gap-2")

    def refresh(self) -> None:
        """Look for new runs; open the newest that has ended, if it is a new one."""
        names = self._services.recorded()
        newest = next((name for name in names if self._services.has_ended(name)), None)
        chosen = self._select.value if newest == self._newest else newest
        self._newest = newest
        self._empty.set_visibility(newest is None)
        self._select.set_options(names, value=chosen)

    def show(self, name: str) -> None:
        """Open a run."""
        self.refresh()
        self._select.set_value(name)

    def _open(self, event: Any) -> None:
        if not event.value:
            return
        directory = self._services.runs / event.value
        self._content.clear()
        with self._content:
            with ui.row().classes("items-center gap-2"):
                self._on_request("replay", replayed, directory)
                self._on_request("compare with the ideal loop", compared, directory)
            waiting = ui.label("A report that is not written yet takes some seconds.")
            report = ui.element("iframe").classes("w-full lab-report")
            report.props(f'src="{_address(directory.name)}" title="report of the run"')
            report.on("load", lambda: waiting.set_visibility(False))

    def _on_request(self, words: str, function: Any, directory: Path) -> None:
        answer = ui.label()

        async def ask() -> None:
            button.disable()
            try:
                answer.set_text(await self._calls.compute(function, directory))
            except NoackError as error:
                answer.set_text(str(error))
            button.enable()

        button = ui.button(words, on_click=ask).props("outline no-caps")
        answer.move()


_TONES = {GOOD: "text-positive", DOUBTFUL: "text-warning", BAD: "text-negative", NEUTRAL: ""}
# A run directory may come from somebody else; a report needs no scripts.
_POLICY = "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; font-src data:"


def show_verdict(lines: Iterable[tuple[str, str]], name: str) -> None:
    """Show the lines of a verdict, each with its style, and the link to the report of a run."""
    with ui.card().classes("w-full gap-1").props('role=region aria-label="verdict"'):
        for text, style in lines:
            ui.label(text).classes(f"text-base {_TONES[style]}")
        ui.link("report of this run (all figures and tables)", _address(name), new_tab=True)


def _address(name: str) -> str:
    return f"report/{quote(name)}"


def serve_reports(application: FastAPI, services: LabServices) -> None:
    """Serve the reports of recorded runs below the page's address; a missing one is written."""

    @application.get("/report/{name}")
    async def report(name: str) -> Response:
        if name not in services.recorded():
            return PlainTextResponse(f"no run {name} is recorded in {services.runs}", 404)
        try:
            page = await services.compute(report_page, services.runs / name)
        except NoackError as error:
            return PlainTextResponse(str(error), 409)
        headers = {"content-security-policy": _POLICY, "cache-control": "no-store"}
        return HTMLResponse(page, headers=headers)


def report_page(directory: Path) -> bytes:
    """Return the report of a run, which is written if missing; called in the worker process."""
    from cosim.live.finalize import run_report

    return run_report(directory).read_bytes()
