"""The figure and what is said of it, as the browser gets them: parts, each sent when it changes.

``figure.js`` draws the figure, ``lab.js`` shows the other parts. Nothing of the framework is
between them, so that a slider's new curve is drawn within a few frames.
"""

import base64
import json
from typing import Any

import numpy as np
from nicegui import Client

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

Json = dict[str, Any]

_PIXELS_PER_POINT = 4 / 3
_MARGIN = 0.06
_DRAWN_S = 10.0
"""Parts without an answer of the browser for so long are sent again with the next ones."""


class Stage:
    """What one page shows."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._shown: Json = {}

    @property
    def has_figure(self) -> bool:
        """Whether a figure is shown."""
        return "figure" in self._shown

    async def show(self, **parts: object) -> None:
        """Show parts, by name; what the browser has already is not sent. Wait until it is drawn."""
        new = {key: part for key, part in parts.items() if self._shown.get(key, ...) != part}
        if not new or self._client.is_deleted:
            return
        self._shown |= new
        try:
            # An expression: code with "return" is compiled twice, since it is a function's body.
            code = f"labShow({json.dumps(new, ensure_ascii=False)})"
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
    made: Json = {
        "colour": f"rgb{item.colour}",
        "label": item.label,
        "opacity": item.opacity,
        "x": columns.add(item.x),
        "width": 0.0,
        "dash": (),
    }
    if isinstance(item, Band):
        low, high = columns.add(item.low), columns.add(item.high)
        return made | {"kind": "band", "y": low, "high": high}
    made["y"] = columns.add(item.y)
    if isinstance(item, Marks):
        kind = "cross" if item.marker == "x" else "dot"
        return made | {"kind": kind, "width": round(_PIXELS_PER_POINT * item.stroke, 1)}
    width = round(_PIXELS_PER_POINT * item.width, 1)
    return made | {"kind": "line", "width": width, "dash": item.dash}


def _ends(panel: Panel) -> tuple[float, float]:
    """Return the ends of the vertical axis."""
    axis, values = panel.y, [np.zeros(0)]
    for item in panel.items:
        if isinstance(item, Band):
            values += [item.low, item.high]
        elif isinstance(item, Line | Marks):
            values.append(item.y)
    seen = finite(np.concatenate(values))
    seen = seen[np.isfinite(seen)]
    about = seen if axis.about is None else axis.about
    if axis.logarithmic:
        return log_ends(seen, about, axis.decades or 99) or (0.1, 1.0)
    low, high = (float(seen.min()), float(seen.max())) if len(seen) else (0.0, 1.0)
    room = _MARGIN * (high - low) or 0.5
    if axis.about is not None:
        low, high = near_ends((low, high), about)
    first, last = axis.ends
    return low - room if first is None else first, high + room if last is None else last
