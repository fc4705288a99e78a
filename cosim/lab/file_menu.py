"""The menu of the lab page with what can be saved: the scenario, its address, data and figure."""

import io
import re
from collections.abc import Callable
from functools import partial

import numpy as np
import pyarrow as pa
from nicegui import ui
from pyarrow import csv

from cosim.interactive.exploration import Exploration
from cosim.interactive.exploration_figure import ExploredRun, exploration_figure
from cosim.lab.lab_services import ANSWER_S, LabServices, PageCalls, Session
from cosim.output.figures.figure_format import FigureFormat, figure_width_in
from cosim.output.page_kit import TERMS
from noack.core.errors import NoackError
from noack.core.file_access import write_whole
from noack.core.linear_systems import Vector

_FILE_NAME = re.compile(r"[A-Za-z0-9][\w.-]{0,63}\.toml")


class FileMenu:
    """The menu in the header."""

    def __init__(
        self,
        services: LabServices,
        calls: PageCalls,
        session: Session,
        explored: Callable[[], ExploredRun | None],
    ) -> None:
        self._services, self._calls, self._session = services, calls, session
        self._explored = explored
        opener = ui.button(icon="more_vert").props('flat color=white dense aria-label="files"')
        with opener, ui.menu():
            ui.menu_item("save as scenario …", self._open_save_dialog)
            ui.menu_item("copy link to these settings", self._copy_link)
            ui.menu_item("data of the figure (CSV)", self._download_data)
            for kind in (FigureFormat.SVG, FigureFormat.PDF):
                ui.menu_item(f"figure ({kind.upper()})", partial(self._download_figure, kind))
            ui.menu_item("glossary", self._open_glossary)
        with ui.dialog() as self._glossary, ui.card(), ui.element("dl").classes("lab-words"):
            for term, meaning in TERMS:
                for tag, text in (("dt", term), ("dd", meaning)):
                    with ui.element(tag):
                        ui.label(text)
        with ui.dialog() as self._save_dialog, ui.card():
            ui.label(f"Save in {services.folder}")
            self._file_name = ui.input(
                "file name",
                value="my_loop.toml",
                validation={"a name like my_loop.toml": lambda text: bool(_FILE_NAME.fullmatch(text))},
            ).classes("w-64")
            self._replace = ui.checkbox("replace a file of this name")
            with ui.row():
                ui.button("save", on_click=self._save)
                ui.button("cancel", on_click=self._save_dialog.close).props("flat")

    def _open_glossary(self) -> None:
        self._glossary.open()

    def _open_save_dialog(self) -> None:
        self._save_dialog.open()

    def _save(self) -> None:
        if not _FILE_NAME.fullmatch(self._file_name.value):
            return
        path = self._services.folder / self._file_name.value
        if path.exists() and not self._replace.value:
            ui.notify(f"{path.name} exists; tick the box to replace it", type="warning")
            return
        try:
            write_whole(path, self._session.draft.text.encode())
        except NoackError as error:
            ui.notify(str(error), type="negative")
            return
        self._save_dialog.close()
        ui.notify(f"saved as {path.name}; noack run {path.name}", type="positive")

    async def _copy_link(self) -> None:
        address = await ui.run_javascript("location.href", timeout=ANSWER_S)
        ui.clipboard.write(address)
        ui.notify("copied; it opens as long as this page runs", type="positive")

    def _download_data(self) -> None:
        if (explored := self._explored()) is not None:
            ui.download(csv_of(explored.run), "exploration.csv", "text/csv")

    async def _download_figure(self, kind: FigureFormat) -> None:
        if (explored := self._explored()) is not None:
            content = await self._calls.compute(figure_file, explored, kind)
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


def figure_file(explored: ExploredRun, kind: FigureFormat) -> bytes:
    """Return the figure as a file's content; called in the worker process."""
    from cosim.output.figures.figure_files import file_content  # needs matplotlib

    return file_content(exploration_figure(explored), kind, figure_width_in(kind, None))
