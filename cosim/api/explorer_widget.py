"""The explorer of a notebook: sliders and choices beside the figure, by ipywidgets.

While a slider is dragged the run is drawn at once; certificate and bands follow when no setting has
changed for a moment. The margin takes seconds in the kernel's own thread, so a button asks for it.
"""

import asyncio
import html
import io
from collections.abc import Callable, Mapping

import ipywidgets as widgets

from cosim.interactive.draft_results import CERTIFICATE, ENSEMBLE, MARGIN, DraftResults
from cosim.interactive.exploration_figure import exploration_figure
from cosim.interactive.scenario_draft import Draft
from cosim.interactive.sliders import Choice, Slider, choose, controls_of, drag
from cosim.output.figures.figure_drawing import draw
from cosim.output.figures.figure_layout import matplotlib_settings
from noack.core.errors import NoackError
from noack.core.number_format import as_html

_QUIET_S = 0.3
"""Time after the last change at which what takes longer than a redraw is computed."""
_REST = [CERTIFICATE, ENSEMBLE]
_DPI = 90
_QUICK = {"compress_level": 1}
_WIDE, _SIDE = widgets.Layout(width="98%"), widgets.Layout(width="340px", flex="0 0 auto")


class ExplorerWidget:
    """The widgets of an explorer; ``whole`` is what the notebook shows."""

    def __init__(self, results: DraftResults) -> None:
        self._results = results
        self._quiet = False
        self._shape: tuple[object, ...] = ()
        self._inputs: dict[str, widgets.Widget] = {}
        self._sliders: dict[str, Slider] = {}
        self._pending: asyncio.Handle | None = None
        names = results.run.state_names
        self._state = widgets.Dropdown(
            options=[(name, i) for i, name in enumerate(names)],
            value=len(names) - 1,
            description="drawn state",
            style={"description_width": "initial"},
        )
        self._state.observe(lambda _: self._draw(), "value")
        self._controls = widgets.VBox()
        self._message = widgets.HTML()
        self._image = widgets.Image(format="png", layout=widgets.Layout(max_width="100%"))
        self._facts = widgets.HTML()
        margin = widgets.Button(description="compute the margin", tooltip="takes some seconds")
        margin.on_click(lambda _: self._compute_rest([MARGIN]))
        side = widgets.VBox([self._controls, self._state], layout=_SIDE)
        figure = widgets.VBox(
            [self._message, self._image, self._facts, margin],
            layout=widgets.Layout(flex="1 1 420px", min_width="0"),
        )
        self.whole = widgets.HBox([side, figure], layout=widgets.Layout(flex_flow="row wrap"))
        self.show()
        results.listeners.append(self.show)

    def show(self) -> None:
        """Show the explorer's scenario: its controls, the run at once, the rest a moment later."""
        self._quiet = True
        try:
            self._show_controls()
        finally:
            self._quiet = False
        if self._pending is not None:
            self._pending.cancel()
        try:
            loop = asyncio.get_running_loop()
        except RuntimeError:  # no kernel: nothing will ever be dragged while this computes
            self._compute_rest(_REST)
        else:
            self._draw()
            self._schedule(loop, _QUIET_S, _REST)

    def _schedule(self, loop: asyncio.AbstractEventLoop, after_s: float, names: list[str]) -> None:
        """Compute one result after another; a change in between begins anew."""

        def compute() -> None:
            self._compute_rest(names[:1])
            if names[1:]:
                self._schedule(loop, 0.0, names[1:])

        self._pending = loop.call_later(after_s, compute)

    def _compute_rest(self, names: list[str]) -> None:
        failure = ""
        try:
            for name in names:
                getattr(self._results, name)
        except NoackError as error:
            failure = str(error)
        self._draw()
        if failure:
            self._show_message(failure)

    def _draw(self) -> None:
        try:
            states = self._results.run.x.shape[1]
            self._image.value = _png(self._results, self._state.value % states)
        except NoackError as error:
            self._show_message(str(error))
            return
        self._show_message(self._results.warning if CERTIFICATE in self._results.known else "")
        self._facts.value = as_html([row for rows in self._results.facts.values() for row in rows])

    def _show_message(self, text: str) -> None:
        lines = "<br>".join(map(html.escape, text.splitlines()))
        self._message.value = f'<b style="color: #b3261e">{lines}</b>' if text else ""

    def _show_controls(self) -> None:
        controls = controls_of(self._results.draft)
        self._sliders = {slider.key: slider for slider in controls.sliders}
        if controls.shape == self._shape:
            for slider in controls.sliders:
                widget = self._inputs[slider.key]
                if abs(slider.position_of(widget.value) - slider.position) > slider.step / 2:
                    widget.value = slider.value
            return
        self._shape, self._inputs = controls.shape, {}
        rows: list[widgets.Widget] = [self._choice(choice) for choice in controls.choices]
        for slider in controls.sliders:
            self._inputs[slider.key] = self._slider(slider)
            rows += [widgets.Label(slider.label), self._inputs[slider.key]]
        self._controls.children = rows

    def _choice(self, choice: Choice) -> widgets.Widget:
        dropdown = widgets.Dropdown(
            options=[(text, value) for value, text in choice.options.items()],
            value=choice.value,
            layout=_WIDE,
        )
        dropdown.observe(
            lambda change: self._change(lambda draft: choose(draft, choice.key, change["new"])),
            "value",
        )
        return widgets.VBox([widgets.Label(choice.label), dropdown], layout=_WIDE)

    def _slider(self, slider: Slider) -> widgets.Widget:
        low, high = slider.ends
        if slider.logarithmic:
            widget = widgets.FloatLogSlider(
                value=slider.value, min=low, max=high, step=slider.step, readout_format=".3g"
            )
        elif slider.whole:
            widget = widgets.IntSlider(value=round(slider.value), min=int(low), max=int(high))
        else:
            widget = widgets.FloatSlider(
                value=slider.value, min=low, max=high, step=slider.step, readout_format=".3g"
            )
        widget.layout = _WIDE
        key = slider.key

        def moved(change: Mapping[str, float]) -> None:
            current = self._sliders[key]
            value = current.value_at(current.position_of(change["new"]))
            if value != current.value:
                self._change(lambda draft: drag(draft, current, value))

        widget.observe(moved, "value")
        return widget

    def _change(self, change: Callable[[Draft], Draft]) -> None:
        if self._quiet:
            return
        try:
            self._results.take(change(self._results.draft))
        except NoackError as error:
            self._show_message(str(error))


def _png(results: DraftResults, state: int) -> bytes:
    buffer = io.BytesIO()
    with matplotlib_settings():
        figure = draw(exploration_figure(results.explored_run(state)))
        figure.savefig(buffer, format="png", dpi=_DPI, pil_kwargs=_QUICK)
    return buffer.getvalue()
