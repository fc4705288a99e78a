"""Save the scenario, share the address, export the figure and its data."""

import csv
import io
import re

import numpy as np
from nicegui import ui

from cosim.interactive.exploration import Exploration
from cosim.lab.page.lab_services import LabServices
from cosim.lab.page.session import Session
from noack.core.errors import NoackError
from noack.core.file_access import write_whole

_NAME = re.compile(r"[A-Za-z0-9][\w.-]{0,63}\.toml")


class FileMenu:
    """The menu in the header."""

    def __init__(self, services: LabServices, session: Session) -> None:
        self._services, self._session = services, session
        opener = ui.button(icon="more_vert").props('flat color=white dense aria-label="files"')
        with opener, ui.menu():
            ui.menu_item("save as scenario …", self._ask)
            ui.menu_item("copy link to these settings", self._share)
            ui.menu_item("data of the figure (CSV)", self._data)
            ui.menu_item("figure (SVG)", self._figure)
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
        address = await ui.run_javascript("location.href")
        ui.clipboard.write(address)
        ui.notify("copied; it opens as long as this page runs", type="positive")

    def _data(self) -> None:
        if self._session.run is not None:
            ui.download(csv_of(self._session.run).encode(), "exploration.csv", "text/csv")

    async def _figure(self) -> None:
        run = self._session.run
        if run is not None:
            svg = await self._services.compute(svg_of, run)
            ui.download(svg.encode(), "exploration.svg", "image/svg+xml")


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


def svg_of(run: Exploration) -> str:
    """Return the curves of a run as a figure; called in the worker process."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 6), layout="constrained")
    states, errors = figure.subplots(2, 1, sharex=True)
    for i, name in enumerate(run.state_names):
        states.plot(run.t_s, run.x[:, i], label=name)
    errors.semilogy(run.t_s, run.e_s_norm, label="‖e_s‖")
    errors.semilogy(run.t_s, run.e_c_norm, label="‖e_c‖")
    if run.threshold is not None:
        errors.semilogy(run.t_s, run.threshold, "--", label="threshold")
    errors.set_xlabel("time [s]")
    for axes in (states, errors):
        axes.legend(fontsize="small")
    text = io.StringIO()
    figure.savefig(text, format="svg")
    return text.getvalue()
