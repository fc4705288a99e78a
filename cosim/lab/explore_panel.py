"""The figure of the run, its key numbers, and what is guaranteed."""

from collections.abc import Mapping, Sequence
from typing import Any

from nicegui import ui

from cosim.interactive.exploration_figure import Shown, exploration_figure
from cosim.interactive.scenario_guarantee import CERTIFIED
from cosim.lab.chart import HEIGHT, data_options, figure_options
from cosim.lab.lab_services import Session
from noack.core.number_format import number

_DRAWN_S = 10.0
"""A redraw without an answer for so long is repeated as a whole."""
_TONES = {CERTIFIED: "text-positive"}


class ExplorePanel:
    """The panel; :meth:`draw` shows the session's newest results."""

    def __init__(self) -> None:
        self._shape: tuple[object, ...] = ()
        self._names: dict[int, str] = {}
        self._facts: dict[str, Rows] = {}
        """The groups of facts, by their headings."""
        self._chart: ui.echart | None = None
        with ui.row().classes("w-full items-center gap-x-4 gap-y-0"):
            self._summary = ui.label()
            self._verdict = ui.label()
            self._pending = ui.label().props("role=status")
            self._state = ui.row().classes("items-center gap-2")
        self._note = ui.label().classes("text-warning").props("role=status")
        self._note.set_visibility(False)
        self._area = ui.element("div").classes("w-full")
        self._stale = False
        self._groups = ui.element("div").classes("w-full lab-facts")

    async def draw(self, session: Session, *, dark: bool) -> None:
        """Show what was computed; a redraw of the same figure replaces its data only."""
        first = session.mistakes[0].text if session.mistakes else ""
        more = f" (and {len(session.mistakes) - 1} more)" if len(session.mistakes) > 1 else ""
        warning = session.results.warning if session.results else ""
        note = first + more or warning or session.note
        shown = session.shown()
        self._mark_stale(shown is None)
        if shown is None and self._chart is not None:
            note += ". Below: the settings before"
        self._note.set_text(note)
        self._note.set_visibility(bool(note))
        self._pending.set_text(session.pending)
        if shown is None or session.results is None:
            return
        self._choose_state(session, shown.run.state_names)
        await self._show_figure(shown, dark=dark)
        if not self._area.is_deleted:
            self._show_summary(shown)
            self._show_facts(session.results.facts)

    def _mark_stale(self, stale: bool) -> None:
        """Draw the figure faintly while it is not that of the settings."""
        if stale != self._stale:
            self._stale = stale
            self._area.style(f"opacity: {0.4 if stale else 1}")
            self._summary.set_visibility(not stale)
            self._verdict.set_visibility(not stale)

    async def _show_figure(self, shown: Shown, *, dark: bool) -> None:
        run, figure = shown.run, exploration_figure(shown)
        legends = tuple(bool(row.panels[0].legend) for row in figure.rows)
        shape = (shown.state, run.state_names, run.scenario.horizon_s, dark, legends)
        if self._chart is None or shape != self._shape:
            self._shape = shape
            self._area.clear()
            with self._area:
                self._chart = ui.echart(figure_options(figure, dark=dark)).classes("w-full")
                self._chart.props("role=img")
                self._chart.style(f"height: {HEIGHT}px")
            return
        try:
            # Awaited, so that a slow browser is not sent more than it draws.
            options, replaced = data_options(figure), {"replaceMerge": ["dataset", "series"]}
            await self._chart.run_chart_method("setOption", options, replaced, timeout=_DRAWN_S)
        except TimeoutError:
            self._shape = ()

    def _choose_state(self, session: Session, state_names: Sequence[str]) -> None:
        names = dict(enumerate(state_names))
        if names == self._names:
            return
        self._names = names
        self._state.clear()
        if len(names) < 2:
            return

        async def chosen(event: Any) -> None:
            session.state = event.value
            await session.on_drawn()

        with self._state:
            ui.select(names, value=session.state, label="drawn state", on_change=chosen).classes(
                "w-32"
            ).props("dense options-dense")

    def _show_facts(self, groups: Mapping[str, Sequence[tuple[str, str]]]) -> None:
        if [*groups] != [*self._facts]:
            self._groups.clear()
            with self._groups:
                self._facts = {heading: _group(heading) for heading in groups}
        for heading, rows in groups.items():
            self._facts[heading].show(rows)

    def _show_summary(self, shown: Shown) -> None:
        """Show above the figure what changes most."""
        numbers, (first, last) = dict(shown.run.numbers), shown.run.x_norm[[0, -1]]
        self._summary.set_text(
            f"{numbers.get('transmissions', 0)} transmissions, {numbers.get('lost', 0)} lost; "
            f"‖x‖ from {number(first, 3)} to {number(last, 3)}"
        )
        verdict = shown.guarantee.verdict if shown.guarantee else ""
        self._verdict.set_text(verdict)
        self._verdict.classes(replace=_TONES.get(verdict, "text-warning"))


def _group(heading: str) -> "Rows":
    with ui.column().classes("gap-0"):
        ui.label(heading).classes("text-subtitle2 mt-2").props("role=heading aria-level=3")
        return Rows("lab-rows")


class Rows:
    """A list of names with values; while the names stay, only texts change, which is quick."""

    def __init__(self, style: str, rows: Sequence[tuple[str, str]] = ()) -> None:
        self._names: list[str] = []
        self._values: list[ui.label] = []
        self._list = ui.element("dl").classes(style)
        self.show(rows)

    def show(self, rows: Sequence[tuple[str, str]]) -> None:
        """Show other rows."""
        names = [name for name, _ in rows]
        if names != self._names:
            self._names, self._values = names, []
            self._list.clear()
            with self._list:
                for name in names:
                    with ui.element("dt"):
                        ui.label(name)
                    with ui.element("dd"):
                        self._values.append(ui.label())
        for label, (_, value) in zip(self._values, rows, strict=True):
            if label.text != value:
                label.set_text(value)
