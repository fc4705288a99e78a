"""The figure of the run, its key numbers, and what is guaranteed."""

from collections.abc import Sequence
from typing import Any

from nicegui import ui

from cosim.interactive.exploration_figure import Shown, exploration_figure
from cosim.interactive.scenario_guarantee import CERTIFIED, Guarantee, Margin
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
        self._guaranteed: tuple[int, int] | None = None
        """Which guarantee and margin are shown; arrays are not compared."""
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
        with ui.element("div").classes("w-full lab-facts"):
            with ui.column().classes("gap-0"):
                self._kind = _heading("this run")
                self._numbers = _Rows()
            self._guarantee = ui.column().classes("gap-0")

    async def draw(self, session: Session, *, dark: bool) -> None:
        """Show what was computed; a redraw of the same figure replaces its data only."""
        first = session.mistakes[0].text if session.mistakes else ""
        more = f" (and {len(session.mistakes) - 1} more)" if len(session.mistakes) > 1 else ""
        note = first + more or session.warning or session.note
        shown = session.shown()
        self._mark_stale(shown is None)
        if shown is None and self._chart is not None:
            note += ". Below: the settings before"
        self._note.set_text(note)
        self._note.set_visibility(bool(note))
        self._pending.set_text(session.pending)
        if shown is None:
            return
        self._choose_state(session)
        await self._show_figure(shown, dark=dark)
        if not self._area.is_deleted:
            self._show_facts(session)

    def _mark_stale(self, stale: bool) -> None:
        """Draw the figure faintly while it is not that of the settings."""
        if stale != self._stale:
            self._stale = stale
            self._area.style(f"opacity: {0.4 if stale else 1}")
            self._summary.set_visibility(not stale)
            self._verdict.set_visibility(not stale)

    async def _show_figure(self, shown: Shown, *, dark: bool) -> None:
        run, figure = shown.run, exploration_figure(shown)
        shape = (shown.state, run.state_names, run.scenario.horizon_s, dark,
                 shown.reference is None)  # fmt: skip
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
            await self._chart.run_chart_method("setOption", data_options(figure), timeout=_DRAWN_S)
        except TimeoutError:
            self._shape = ()

    def _choose_state(self, session: Session) -> None:
        assert session.run is not None
        names = dict(enumerate(session.run.state_names))
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

    def _show_facts(self, session: Session) -> None:
        run, found = session.run, session.ensemble
        assert run is not None
        self._kind.set_text(f"this run ({run.kind})")
        self._show_summary(session, dict(run.numbers))
        self._numbers.show([*run.numbers, *(() if found is None else found.numbers)])
        if self._guaranteed == (shown := (id(session.guarantee), id(session.margin))):
            return
        self._guaranteed = shown
        self._guarantee.clear()
        with self._guarantee:
            _show_guarantee(session.guarantee)
            _show_margin(session.margin)

    def _show_summary(self, session: Session, numbers: dict[str, str]) -> None:
        """Show above the figure what changes most."""
        first, last = session.run.x_norm[[0, -1]] if session.run else (0.0, 0.0)
        self._summary.set_text(
            f"{numbers.get('transmissions', 0)} transmissions, {numbers.get('lost', 0)} lost; "
            f"‖x‖ from {number(first, 3)} to {number(last, 3)}"
        )
        verdict = session.guarantee.verdict if session.guarantee else ""
        self._verdict.set_text(verdict)
        self._verdict.classes(replace=_TONES.get(verdict, "text-warning"))


def _show_guarantee(found: Guarantee | None) -> None:
    _heading("certificate")
    if found is None:
        ui.label("follows when no setting changes")
        return
    ui.label(f"{found.verdict}: {found.reason}").classes(_TONES.get(found.verdict, "text-warning"))
    _Rows().show(found.rows)
    for verdict, what, why in found.assumptions:
        ui.label(f"{verdict}: {what} ({why})")


def _show_margin(found: Margin | None) -> None:
    if found is None or not found.defined:
        return
    _heading("margin")
    ui.label(found.verdict)
    ui.label("Pattern: D delivered, L lost. Growth of the worst pattern per event; 1 is the limit.")
    for m, growth, verdict in found.rows:
        ui.label(f"M = {m}: growth {growth}, {verdict}")


def _heading(text: str) -> ui.label:
    return ui.label(text).classes("text-subtitle2 mt-2").props("role=heading aria-level=3")


class _Rows:
    """Names with values; while the names stay, only texts change, which is quick."""

    def __init__(self) -> None:
        self._names: list[str] = []
        self._values: list[ui.label] = []
        self._list = ui.element("dl").classes("lab-rows")

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
                        self._values.append(ui.label().classes("font-mono"))
        for label, (_, value) in zip(self._values, rows, strict=True):
            if label.text != value:
                label.set_text(value)
