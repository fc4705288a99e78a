"""Recorded runs: key numbers, claims and figures; replay and fidelity on request."""

from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from nicegui import ui

from cosim.lab.page.lab_services import LabServices
from cosim.output.figure_format import SCREEN_IN
from noack.core.errors import NoackError

_COLUMN_IN = 3.5
"""Width for which figures are laid out on a small screen."""
_FIGURES = ("states", "errors", "state-norm", "input", "inter-event")


NARROW_PX = 800
"""Widest window whose settings are below the figure."""


class Opened(NamedTuple):
    """What is shown of a run."""

    facts: list[tuple[str, str]]
    claims: list[tuple[str, str]]
    """Verdict and claim."""
    figures: list[str]
    """As HTML."""


def opened(directory: Path, width_in: float) -> Opened:
    """Read a run and draw figures of a width; called in the worker process."""
    import noack
    from cosim.api.run_facts import run_facts
    from cosim.output.report.figure_files import inline
    from cosim.output.report.figure_layout import figure_width

    run = noack.open_run(directory)
    figures = []
    with figure_width(width_in):
        for name in _FIGURES:
            with suppress(NoackError):
                figures.append(inline(run.plot(name), f"run-{name}", f"figure: {name}"))
    claims = [(str(one["verdict"]), f"{one['what']} ({one['source']})") for one in run.claims]
    return Opened(run_facts(run), claims, figures)


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

    def __init__(self, services: LabServices) -> None:
        self._services = services
        with ui.row().classes("items-center gap-2"):
            self._select = ui.select([], label="run", on_change=self._open).classes("w-72")
            ui.button(icon="refresh", on_click=self.refresh).props(
                'flat dense aria-label="look for new runs"'
            )
        self._content = ui.column().classes("w-full gap-2")
        self.refresh()

    def refresh(self) -> None:
        """Look for new runs."""
        self._select.set_options(self._services.recorded())

    async def _open(self, event: Any) -> None:
        if not event.value:
            return
        directory = self._services.runs / event.value
        self._content.clear()
        with self._content:
            waiting = ui.spinner(size="lg")
        try:
            is_narrow = await ui.run_javascript(f"innerWidth <= {NARROW_PX}")
            found = await self._services.compute(
                opened, directory, _COLUMN_IN if is_narrow else SCREEN_IN
            )
        except NoackError as error:
            waiting.delete()
            with self._content:
                ui.label(str(error)).classes("text-negative")
            return
        self._content.clear()
        with self._content:
            self._show(found, directory)

    def _show(self, found: Opened, directory: Path) -> None:
        with ui.element("dl").classes("lab-rows text-sm"):
            for name, value in found.facts:
                with ui.element("dt"):
                    ui.label(name)
                with ui.element("dd"):
                    ui.label(value)
        with ui.expansion(f"{len(found.claims)} claims").classes("w-full"):
            for verdict, claim in found.claims:
                ui.label(f"{verdict}: {claim}").classes("text-xs")
        with ui.row().classes("items-center gap-2"):
            for words, function in (
                ("replay", replayed),
                ("compare with the ideal loop", compared),
            ):
                self._on_request(words, function, directory)
        for figure in found.figures:
            ui.html(figure, sanitize=False).classes("w-full lab-figure")

    def _on_request(self, words: str, function: Any, directory: Path) -> None:
        answer = ui.label().classes("text-sm")

        async def ask() -> None:
            button.disable()
            try:
                answer.set_text(await self._services.compute(function, directory))
            except NoackError as error:
                answer.set_text(str(error))
            button.enable()

        button = ui.button(words, on_click=ask).props("outline dense")
        answer.move()
