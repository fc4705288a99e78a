"""The verdict of a run and the link to its report, and the address at which that is served."""

from collections.abc import Iterable
from pathlib import Path
from urllib.parse import quote

from fastapi import FastAPI
from fastapi.responses import HTMLResponse, PlainTextResponse, Response
from nicegui import ui

from cosim.lab.page.lab_services import LabServices
from cosim.output.run_verdict import BAD, DOUBTFUL, GOOD, NEUTRAL
from noack.core.errors import NoackError

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
