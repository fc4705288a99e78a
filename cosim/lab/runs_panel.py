"""Recorded runs: verdict, key numbers, claims and figures; replay and fidelity on request.

The full report of a run is served below the page's address.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from fastapi import FastAPI
from fastapi.responses import HTMLResponse, PlainTextResponse, Response
from nicegui import ui

from cosim.lab.explore_panel import Rows
from cosim.lab.lab_services import ANSWER_S, LabServices, PageCalls
from cosim.output.figure_format import SCREEN_IN
from cosim.output.run_verdict import BAD, DOUBTFUL, GOOD, NEUTRAL
from noack.core.errors import NoackError

_COLUMN_IN = 3.5
"""Width for which figures are laid out on a small screen."""
_FIGURES = ("network", "loops", "map", "states", "errors", "state-norm", "input", "inter-event")


NARROW_PX = 800
"""Widest window whose settings are below the figure."""


class Opened(NamedTuple):
    """What is shown of a run."""

    verdict: list[tuple[str, str]]
    """Lines, each with its style."""
    facts: list[tuple[str, str]]
    claims: list[tuple[str, str]]
    """Verdict and claim."""
    figures: list[str]
    """As HTML."""


def opened(directory: Path, width_in: float) -> Opened:
    """Read a run and draw figures of a width; called in the worker process."""
    import noack
    from cosim.output.figure_files import inline
    from cosim.output.figure_style import figure_width
    from cosim.output.network_figures import page_figures
    from cosim.output.run_tables import run_facts
    from cosim.output.run_verdict import verdict
    from cosim.record.run_record import load_run

    run = noack.open_run(directory)
    known = page_figures(load_run(directory), lambda: run.summary)
    with figure_width(width_in):
        figures = [inline(known[name]()) for name in _FIGURES if name in known]
    claims = [(str(one.verdict), f"{one.what} ({one.source})") for one in run.claims]
    lines = [(line.text, line.style) for line in verdict(run.summary)]
    return Opened(lines, run_facts(run.summary, run.directory), claims, figures)


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

    async def _open(self, event: Any) -> None:
        if not event.value:
            return
        directory = self._services.runs / event.value
        self._content.clear()
        with self._content, ui.row().classes("items-center gap-2"):
            ui.spinner(size="lg")
            ui.label("reading the run and drawing its figures, which takes some seconds")
        found: Opened | str
        try:
            is_narrow = await ui.run_javascript(f"innerWidth <= {NARROW_PX}", timeout=ANSWER_S)
            found = await self._calls.compute(
                opened, directory, _COLUMN_IN if is_narrow else SCREEN_IN
            )
        except NoackError as error:
            found = str(error)
        if self._select.value != event.value:
            return  # another run was chosen meanwhile
        self._content.clear()
        with self._content:
            if isinstance(found, str):
                ui.label(found).classes("text-negative")
            else:
                self._show(found, directory)

    def _show(self, found: Opened, directory: Path) -> None:
        show_verdict(found.verdict, directory.name)
        Rows("lab-rows", found.facts)
        with ui.expansion(f"{len(found.claims)} claims").classes("w-full"):
            for verdict, claim in found.claims:
                ui.label(f"{verdict}: {claim}")
        with ui.row().classes("items-center gap-2"):
            for words, function in (
                ("replay", replayed),
                ("compare with the ideal loop", compared),
            ):
                self._on_request(words, function, directory)
        for figure in found.figures:
            ui.html(figure, sanitize=False).classes("w-full lab-figure")

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
        ui.link(
            "report of this run (all figures and tables)", f"report/{quote(name)}", new_tab=True
        )


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
