"""Save the scenario, share the address, export the figure and its data."""

import csv
import io
import re
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
from nicegui import ui

from cosim.interactive.exploration import Exploration
from cosim.interactive.figure_curves import Shown
from cosim.lab.page.lab_services import ANSWER_S, LabServices, PageCalls
from cosim.lab.page.session import Session
from cosim.output.figure_format import FigureFormat
from noack.core.errors import NoackError
from noack.core.file_access import write_whole

_NAME = re.compile(r"[A-Za-z0-9][\w.-]{0,63}\.toml")


class FileMenu:
    """The menu in the header."""

    def __init__(self, services: LabServices, calls: PageCalls, session: Session) -> None:
        self._services, self._calls, self._session = services, calls, session
        opener = ui.button(icon="more_vert").props('flat color=white dense aria-label="files"')
        with opener, ui.menu():
            ui.menu_item("save as scenario …", self._ask)
            ui.menu_item("copy link to these settings", self._share)
            ui.menu_item("data of the figure (CSV)", self._data)
            for kind in (FigureFormat.SVG, FigureFormat.PDF):
                ui.menu_item(f"figure ({kind.upper()})", partial(self._figure, kind))
        with ui.dialog() as self._dialog, ui.card():
            ui.label(f"Save in {services.folder}")
            self._name = ui.input("file name", value="my_loop.toml", validation={
                "a name like my_loop.toml": lambda text: bool(_NAME.fullmatch(text))
            }).classes("w-64")  # fmt: skip
            self._replace = ui.checkbox("replace a file of this name")
            with ui.row():
                ui.button("save", on_click=self._save)
                ui.button("cancel", on_click=self._dialog.close).props("flat")

    def _ask(self) -> None:
        self._dialog.open()

    def _save(self) -> None:
        if not _NAME.fullmatch(self._name.value):
            return
        path = self._services.folder / self._name.value
        if path.exists() and not self._replace.value:
            ui.notify(f"{path.name} exists; tick the box to replace it", type="warning")
            return
        try:
            write_whole(path, self._session.draft.text.encode())
        except NoackError as error:
            ui.notify(str(error), type="negative")
            return
        self._dialog.close()
        ui.notify(f"saved as {path.name}; noack run {path.name}", type="positive")

    async def _share(self) -> None:
        address = await ui.run_javascript("location.href", timeout=ANSWER_S)
        ui.clipboard.write(address)
        ui.notify("copied; it opens as long as this page runs", type="positive")

    def _data(self) -> None:
        if self._session.run is not None:
            ui.download(csv_of(self._session.run).encode(), "exploration.csv", "text/csv")

    async def _figure(self, kind: FigureFormat) -> None:
        shown = self._session.shown(dark=False)
        if shown is not None:
            content = await self._calls.compute(figure_file, shown, kind)
            ui.download(content, f"exploration.{kind}")


def csv_of(run: Exploration) -> str:
    """Return the curves of a run as CSV."""
    n = run.x.shape[1]
    heads = ["t_s", *(f"{name}_{i + 1}" for name in ("x", "x_s", "x_c") for i in range(n))]
    columns = [run.t_s[:, None], run.x, run.x_s, run.x_c]
    for name, one in (("e_s_norm", run.e_s_norm), ("e_c_norm", run.e_c_norm),
                      ("threshold", run.threshold)):  # fmt: skip
        if one is not None:
            heads.append(name)
            columns.append(one[:, None])
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(heads)
    writer.writerows(np.hstack(columns).tolist())
    return text.getvalue()


def figure_file(shown: Shown, kind: FigureFormat) -> bytes:
    """Return the figure as a file's content; called in the worker process."""
    from cosim.interactive.exploration_figure import exploration_figure
    from cosim.output.report.figure_files import save_figure

    with tempfile.TemporaryDirectory(prefix="noack-") as folder:
        path = Path(folder) / f"exploration.{kind}"
        save_figure(exploration_figure(shown), path)
        return path.read_bytes()
