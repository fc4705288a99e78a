"""The parts of the page that the browser is sent: figure, choices and sliders, texts.

Each is sent when it changes. ``figure.js`` draws the figure, ``lab.js`` makes and shows the other
parts. Nothing of the framework is between them, so that a slider's new curve is drawn within a few
frames. Only the editor of the scenario's text is an element of the framework.
"""

import base64
import json
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
from nicegui import Client, ui
from nicegui.events import ValueChangeEventArguments

from cosim.interactive.scenario_draft import Draft, Mistake
from cosim.interactive.sliders import Controls
from cosim.output.figures.figure_description import (
    Band,
    FigureDescription,
    Line,
    Marks,
    Panel,
    finite,
    log_ends,
    near_ends,
)
from noack.core.linear_systems import Vector
from noack.core.number_format import number

Apply = Callable[[Callable[[Draft], Draft], str], Awaitable[None]]
"""Applies a change of the draft; the second argument is the key."""
Json = dict[str, Any]

_PIXELS_PER_POINT = 4 / 3
_AXIS_MARGIN = 0.06
"""Space above and below the curves, as a share of their range."""
_DRAWN_S = 10.0
"""Parts that the browser has not answered within this time are sent again with the next ones."""


class PageParts:
    """The parts that one page shows."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._shown: Json = {}

    @property
    def has_figure(self) -> bool:
        """Whether a figure is shown."""
        return "figure" in self._shown

    async def show(self, **parts: object) -> None:
        """Show parts, by name; what the browser has already is not sent. Wait until it is drawn."""
        changed = {key: part for key, part in parts.items() if self._shown.get(key, ...) != part}
        if not changed or self._client.is_deleted:
            return
        self._shown |= changed
        try:
            # An expression: code with "return" is compiled twice, since it is a function's body.
            code = f"labShow({json.dumps(changed, ensure_ascii=False)})"
            await self._client.run_javascript(code, timeout=_DRAWN_S)
        except TimeoutError:  # a busy browser, or a page that was closed
            self._shown.clear()


class _Columns(dict[int, tuple[int, Vector]]):
    """The columns of a figure, by identity, each with its number: a shared one is sent once."""

    def add(self, values: Vector) -> int:
        """Return the number of a column."""
        return self.setdefault(id(values), (len(self), values))[0]


def figure_part(figure: FigureDescription) -> Json:
    """Return a figure with one panel in each row for the browser.

    All columns are one array of 32-bit numbers, little endian, in Base64.
    """
    columns = _Columns()
    panels = [_panel(row.panels[0], row.height_in, columns) for row in figure.rows]
    values = [column for _, column in columns.values()]
    with np.errstate(over="ignore"):
        numbers = base64.b64encode(np.concatenate(values).astype("<f4").tobytes()).decode()
    return {
        "panels": panels,
        "description": figure.description,
        "lengths": [*map(len, values)],
        "numbers": numbers,
    }


def _panel(panel: Panel, height: float, columns: _Columns) -> Json:
    items = [_item(item, columns) for item in panel.items if isinstance(item, Line | Band | Marks)]
    by_label = {item["label"]: item for item in reversed(items)}
    style = ("kind", "colour", "width", "dash", "opacity", "label")
    low, high = _ends(panel)
    return {
        "title": panel.title,
        "height": height,
        "items": items,
        "log": panel.y.logarithmic,
        "low": low,
        "high": high,
        "start": panel.x.ends[0] or 0.0,
        "end": panel.x.ends[1],
        "numbers": panel.x.numbers,
        "label": panel.x.label,
        "legend": [{key: by_label[name][key] for key in style} for name in panel.labels],
    }


def _item(item: Line | Band | Marks, columns: _Columns) -> Json:
    part: Json = {
        "colour": f"rgb{item.colour}",
        "label": item.label,
        "opacity": item.opacity,
        "x": columns.add(item.x),
        "width": 0.0,
        "dash": (),
    }
    if isinstance(item, Band):
        low, high = columns.add(item.low), columns.add(item.high)
        return part | {"kind": "band", "y": low, "high": high}
    part["y"] = columns.add(item.y)
    if isinstance(item, Marks):
        kind = "cross" if item.marker == "x" else "dot"
        return part | {"kind": kind, "width": round(_PIXELS_PER_POINT * item.stroke, 1)}
    width = round(_PIXELS_PER_POINT * item.width, 1)
    return part | {"kind": "line", "width": width, "dash": item.dash}


def _ends(panel: Panel) -> tuple[float, float]:
    """Return the ends of the vertical axis."""
    axis, values = panel.y, [np.zeros(0)]
    for item in panel.items:
        if isinstance(item, Band):
            values += [item.low, item.high]
        elif isinstance(item, Line | Marks):
            values.append(item.y)
    numbers = finite(np.concatenate(values))
    numbers = numbers[np.isfinite(numbers)]
    about = numbers if axis.about is None else axis.about
    if axis.logarithmic:
        return log_ends(numbers, about, axis.decades or 99) or (0.1, 1.0)
    low, high = (float(numbers.min()), float(numbers.max())) if len(numbers) else (0.0, 1.0)
    room = _AXIS_MARGIN * (high - low) or 0.5
    if axis.about is not None:
        low, high = near_ends((low, high), about)
    first, last = axis.ends
    return low - room if first is None else first, high + room if last is None else last


class TextPanel:
    """The text of the scenario, in an editor; it passes on each change."""

    def __init__(self, draft: Draft, apply: Apply) -> None:
        self._draft, self._apply, self._quiet = draft, apply, False
        with ui.expansion("all settings (TOML)").classes("w-full").props("dense") as expansion:
            self._mistakes = ui.column().classes("gap-0 w-full").props("role=status")
            self._editor = ui.codemirror(
                draft.text, language="TOML", line_wrapping=True, on_change=self._take_edit
            ).classes("w-full h-96")
        expansion.on("after-show", js_handler="labNameEditor")

    def show(self, draft: Draft, mistakes: list[Mistake]) -> None:
        """Show another draft, with its mistakes above the editor."""
        self._draft, self._quiet = draft, True
        if self._editor.value != draft.text:
            self._editor.set_value(draft.text)
        self._quiet = False
        self._mistakes.clear()
        with self._mistakes:
            for mistake in mistakes:
                ui.label(mistake.text).classes("text-negative")

    def show_dark(self, *, dark: bool) -> None:
        """Choose the colours of the editor."""
        self._editor.set_theme("vscodeDark" if dark else "vscodeLight")

    def _take_edit(self, event: ValueChangeEventArguments[str]) -> Awaitable[None] | None:
        if self._quiet or event.value == self._draft.text:
            return None
        return self._apply(lambda draft: draft.with_text(event.value), "scenario")


def controls_part(controls: Controls, wrong: set[str], *, live: bool) -> Json:
    """Return choices and sliders for the browser.

    Args:
        controls: they.
        wrong: keys with mistakes.
        live: whether a loop is running, which some sliders change.
    """
    return {
        "choices": [
            {
                "key": choice.key,
                "label": choice.label,
                "value": choice.value,
                "options": [*choice.options.items()],
            }
            for choice in controls.choices
        ],
        "sliders": [
            {
                "key": slider.key,
                "label": slider.label + (" · also live" if live and slider.live else ""),
                "min": slider.ends[0],
                "max": slider.ends[1],
                "step": slider.step,
                "position": slider.position,
                "text": value_text(slider.value),
                "wrong": slider.key in wrong,
            }
            for slider in controls.sliders
        ],
    }


def value_text(value: float) -> str:
    """Return the value of a slider as text."""
    return f"{value:g}" if isinstance(value, int) else number(value, 3)
