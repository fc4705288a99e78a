"""Draws a figure by matplotlib: for reports and pages, files and notebooks.

Panels have positions in inches: this needs no layout engine, aligns the figures of a page with each
other, and gives the same figure the same bytes. Read :func:`draw` first; then the places of panels,
their items, their axes, and legends.
"""

import math
import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import singledispatch
from typing import Any, Literal, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.ticker import LogFormatter, MaxNLocator

from cosim.analysis.value_reduction import decimate
from cosim.output import palette
from cosim.output.figure_description import (
    LARGEST,
    Axis,
    Band,
    Bars,
    Bound,
    BoundKind,
    ColourScale,
    Dash,
    FigureDescription,
    Heat,
    Line,
    Marks,
    Panel,
    Row,
    Rule,
    Spans,
    finite,
)
from cosim.output.figure_style import PAPER, NotebookFigure, layout, rgb, styled
from cosim.record.align import Reals

Shown = tuple[Artist, str]
"""A drawn object and its label in the legend."""

_BESIDE_IN, _BESIDE_GAP_IN, _UNTITLED_IN = 2.0, 0.27, 0.08
_BAR_IN = 0.2
"""Width of the bar that explains the colours."""
_NARROW_IN = 2.5
"""A shorter axis has few numbers."""
_TITLE_CHARACTERS = 31
"""Room for a title beside a legend."""
_COLUMNS = 600
"""Pixel columns of a panel, to which lines are reduced."""
_MARKS, _CROWD = 120, 80
"""Columns of markers in a panel, which are wider than a pixel; more markers than ``_CROWD`` are
drawn smaller."""
_IN_SHORT = (
    ("certified for every plant of the uncertainty ", "certified: "),
    ("certified for the scenario's ", "certified: "),
    ("bound, given ", "given "),
)
"""What the legends of papers leave out of the labels of bounds."""
_MARKUP = re.compile(r"[$\\{}^_]|(?<=\\)\w+")
_CROWDED = 6.0
"""Ratio of the ends of a logarithmic axis from which it has room for few numbers in a paper."""
_NARROWEST_CELL_IN = 0.42
"""Narrowest cell of a map in which its number is written."""
_MOST_CELLS = 1000
"""A map of more cells is a bitmap."""
_TOP, _DARK = 0.97, 0.6
_EM_PER_CHARACTER_OF_LABEL = 0.5  # a label of an axis may be a little longer than the axis
_POINTS_PER_IN = 72
_SHORTEST_LINE = 8
_UNIT, _NO_BREAK = re.compile(r"\[[^]]*\]"), "\N{NO-BREAK SPACE}"
_BOUND_STYLES: dict[BoundKind, tuple[palette.Colour, tuple[Dash, ...]]] = {
    # There may be several certificates, for different conditions.
    "certified": (palette.CERTIFIED, ((6, 2.5), (3, 1.5), (6, 2, 1.5, 2), (10, 3))),
    "identity": (palette.IDENTITY, ((1.2, 1.4),)),
    "printed": (palette.PRINTED, ((6, 1.5, 1, 1.5, 1, 1.5),)),
}


@styled
def draw(described: FigureDescription) -> Figure:
    """Draw a figure for the width of :func:`cosim.output.figure_style.figure_width`."""
    placed, size_in = _placed(described)
    figure, norm = NotebookFigure(figsize=size_in), _norm(described.scale)
    for number, place in enumerate(placed):
        axes = _axes(figure, place.box_in, place.panel)
        shown = _draw_panel(axes, place, norm)
        if described.heading and not number:
            _heading(figure, described.heading, shown)
        else:
            _legend(axes, shown)
        if place.beside_in is not None and place.panel.beside is not None:
            beside = place._replace(panel=place.panel.beside)
            second = _axes(figure, place.beside_in, beside.panel, sharey=axes)
            second.tick_params(labelleft=False, which="both")
            _draw_panel(second, beside, norm)
            for bound, style in _styled_bounds(place.panel):
                if len(bound.y):
                    second.axhline(float(np.min(bound.y)), **style)
    if described.scale is not None:
        _colour_bar(figure, described.scale, norm, placed)
    figure.align_ylabels()
    _fit_to_paper(figure)
    return figure


# Places of the panels


class _Box(NamedTuple):
    """A rectangle in inches, from the figure's upper left corner."""

    left: float
    top: float
    width: float
    height: float


class _Placed(NamedTuple):
    """A panel and its axes."""

    panel: Panel
    box_in: _Box
    beside_in: _Box | None
    has_x: bool
    """Whether the horizontal axis has its label and numbers here."""
    has_y: bool


def _placed(described: FigureDescription) -> tuple[list[_Placed], tuple[float, float]]:
    """Place the panels; return them, and width and height of the figure in inches."""
    space, placed = layout(), list[_Placed]()
    top_in = 0.0
    if described.heading:
        top_in = _head_in(_labels(described.rows[0].panels[0]), space.width_in)
    right_in = space.right_in + (4 * _BAR_IN if described.scale is not None else 0.0)
    for row in described.rows:
        columns = _columns(row, space.width_in)
        for first in range(0, len(row.panels), columns):
            has_heading = bool(described.heading) and not placed
            line = _placed_line(row, first, columns, top_in, right_in, has_heading=has_heading)
            placed += line
            box_in = line[0].box_in
            numbered = any(one.has_x for one in line)
            top_in = box_in.top + box_in.height + (space.below_in if numbered else space.gap_in)
    return placed, (space.width_in, top_in)


def _columns(row: Row, room_in: float) -> int:
    columns = min(row.columns or len(row.panels), len(row.panels))
    return max(min(columns, int(room_in / row.narrowest_in)), 1) if row.narrowest_in else columns


def _placed_line(
    row: Row, first: int, columns: int, top_in: float, right_in: float, *, has_heading: bool
) -> list[_Placed]:
    """Place the panels of a row that are side by side, from number ``first`` on."""
    space, panels = layout(), row.panels[first : first + columns]
    left_in = row.left_in or max(map(_left_in, row.panels))
    further_in = space.gap_in if row.common == "xy" else left_in
    room_in = space.width_in - right_in - left_in - (columns - 1) * further_in
    share_in = room_in / columns
    width_in = min(share_in, row.widest_in)
    height_in = row.height_in * space.scale
    if not has_heading:
        top_in += max(_panel_head_in(panel, width_in, is_first=not first) for panel in panels)
    placed = []
    for i, panel in enumerate(panels):
        begin_in = left_in + i * (share_in + further_in)
        main_in = _main_in(panel, width_in)
        beside_in = None
        if panel.beside is not None:
            at_in = begin_in + main_in + _BESIDE_GAP_IN
            beside_in = _Box(at_in, top_in, width_in - main_in - _BESIDE_GAP_IN, height_in)
        is_last = first + i + columns >= len(row.panels)
        placed.append(
            _Placed(
                panel, _Box(begin_in, top_in, main_in, height_in), beside_in,
                has_x=panel.x.numbers and (is_last or not row.common),
                has_y=panel.y.numbers and (i == 0 or row.common != "xy"),
            )
        )  # fmt: skip
    return placed


def _panel_head_in(panel: Panel, width_in: float, *, is_first: bool) -> float:
    """Return the height above a panel; none below another one, without title and legend."""
    labels = _labels(panel)
    if not (panel.title or labels or is_first):
        return 0.0
    return _head_in(labels, _main_in(panel, width_in), titled=bool(panel.title))


def _main_in(panel: Panel, width_in: float) -> float:
    """Return the width of a panel without the one beside it."""
    if panel.beside is None:
        return width_in
    return width_in - _BESIDE_IN * layout().beside_scale - _BESIDE_GAP_IN


def _left_in(panel: Panel) -> float:
    """Return the room for label and numbers at the left of a panel."""
    space, texts = layout(), (panel.y.ticks or {}).values()
    label_in = 2 * space.character_in if panel.y.label else 0.0
    longest_in = max(map(len, texts), default=0) * space.character_in
    return max(space.left_in, longest_in + _BAR_IN + label_in)


def _head_in(labels: Sequence[str], width_in: float, *, titled: bool = True) -> float:
    """Return the height of title and legend above axes of this width."""
    space = layout()
    title_in = space.above_in if titled or (space.beside_title and labels) else _UNTITLED_IN
    rows = _legend_rows(labels, width_in)
    return title_in + space.legend_row_in * (max(rows - 1, 0) if space.beside_title else rows)


def _axes(figure: Figure, box_in: _Box, panel: Panel, **shared: Any) -> Axes:
    figure_in, whole_in = figure.get_size_inches()
    bottom_in = whole_in - box_in.top - box_in.height
    axes = figure.add_axes(
        (box_in.left / figure_in, bottom_in / whole_in, box_in.width / figure_in,
         box_in.height / whole_in), **shared,
    )  # fmt: skip
    factor = axes.yaxis.get_offset_text()  # e.g. ×10⁻⁶; above the axes it would overlap the title
    factor.set(x=-0.05 / box_in.width, horizontalalignment="right")
    for which, axis in (("x", panel.x), ("y", panel.y)):
        if axis.logarithmic:
            logarithmic(axes, which)  # type: ignore[arg-type]
        if None not in axis.ends:
            _set_ends(axes, which, axis)  # type: ignore[arg-type]
        if not axis.grid:
            axes.grid(visible=False, axis=which)  # type: ignore[arg-type]
    return axes


def _heading(figure: Figure, text: str, shown: Sequence[Shown]) -> None:
    """Write a title and a legend above all panels."""
    space, height_in = layout(), figure.get_figheight()
    left, y = space.left_in / space.width_in, 1 - 0.26 * space.above_in / height_in
    figure.text(left, y, text, weight="bold", size=space.title_pt, va="top")
    if shown:
        handles, labels = zip(*shown, strict=True)
        top_in = (0.18 if space.beside_title else 0.9) * space.above_in
        corner = (1 - space.right_in / space.width_in, 1 - top_in / height_in)
        columns = len(labels) if space.beside_title else _legend_columns(labels, space.width_in)
        figure.legend(handles, labels, loc="upper right", bbox_to_anchor=corner, ncols=columns)


def _fit_to_paper(figure: Figure) -> None:
    """In a paper, make lines thinner and markers smaller, and break long labels of axes."""
    space = layout()
    if not space.is_paper:
        return
    for line in figure.findobj(Line2D):
        assert isinstance(line, Line2D)
        line.set_linewidth(line.get_linewidth() * space.line_scale)
        line.set_markersize(line.get_markersize() * space.line_scale)
        line.set_markeredgewidth(line.get_markeredgewidth() * space.line_scale)
    character_in = _EM_PER_CHARACTER_OF_LABEL * space.label_pt / _POINTS_PER_IN
    for axes in figure.axes:
        place, (width_in, height_in) = axes.get_position(), figure.get_size_inches()
        for axis, length_in in (
            (axes.xaxis, place.width * width_in), (axes.yaxis, place.height * height_in),
        ):  # fmt: skip
            most = max(int(length_in / character_in), _SHORTEST_LINE)
            axis.set_label_text(_wrapped(axis.get_label_text(), most))


def _wrapped(label: str, most: int) -> str:
    """Break a label into lines; a unit in brackets stays in one line."""
    bound = _UNIT.sub(lambda unit: unit[0].replace(" ", _NO_BREAK), label)
    lines = textwrap.wrap(bound, most, break_long_words=False)
    return "\n".join(lines).replace(_NO_BREAK, " ")


# Panels and their items


def _draw_panel(axes: Axes, place: _Placed, norm: Normalize | None) -> list[Shown]:
    """Draw a panel; return what its legend shows."""
    panel, drawn = place.panel, dict[str, Artist]()
    styles = iter(_styled_bounds(panel))
    for item in panel.items:
        if isinstance(item, Bound):
            values = finite(item.y, positive=True)
            drawn[item.label] = _curve(axes, item.x, values, **next(styles)[1])
        elif (artist := _draw(item, axes, norm)) is not None:
            drawn.setdefault(getattr(item, "label", ""), artist)
    axes.set_title(panel.title)
    _finish_axis(axes, "x", panel.x, place.has_x)
    _finish_axis(axes, "y", panel.y, place.has_y)
    if not np.isfinite(axes.dataLim.bounds).all():
        axes.text(0.5, 0.5, panel.empty, transform=axes.transAxes, ha="center", va="center")
        axes.tick_params(left=False, labelleft=False, which="both")
    return [(drawn[label], label) for label in _labels(panel) if label in drawn]


def _labels(panel: Panel) -> Sequence[str]:
    """Return the labels in the legend of a panel."""
    if panel.legend is not None:
        return panel.legend
    return [*dict.fromkeys(one.label for one in panel.items if getattr(one, "label", ""))]  # type: ignore[union-attr]


def _styled_bounds(panel: Panel) -> Iterator[tuple[Bound, dict[str, Any]]]:
    """Yield the bounds of a panel with their styles: a colour for each kind, dashes for each."""
    counts: Counter[BoundKind] = Counter()
    for bound in panel.items:
        if isinstance(bound, Bound):
            colour, dashes = _BOUND_STYLES[bound.kind]
            dash = dashes[counts[bound.kind] % len(dashes)]
            counts[bound.kind] += 1
            yield bound, {"color": rgb(colour), "linestyle": (0, dash), "linewidth": 1.6}


@singledispatch
def _draw(item: Any, axes: Axes, norm: Normalize | None) -> Artist | None:
    """Draw an item; return what represents it in the legend, None if there is nothing."""
    raise TypeError(type(item))


@_draw.register
def _(item: Line, axes: Axes, norm: Normalize | None) -> Artist | None:
    style: dict[str, Any] = {
        "color": rgb(item.colour), "linewidth": item.width, "zorder": item.order,
        "linestyle": (0, item.dash) if item.dash else "-", "marker": item.marker,
        "markersize": item.size,
    }  # fmt: skip
    if item.steps:
        style["drawstyle"] = f"steps-{item.steps}"
    is_log = axes.get_yscale() == "log"
    return _curve(axes, item.x, (_for_log_axis if is_log else finite)(item.y), **style)


def _curve(axes: Axes, x: Reals, y: Reals, **style: Any) -> Artist:
    """Draw a curve; its values are finite or NaN; a single point is drawn as a dot."""
    keep = decimate(x, y, _COLUMNS)
    if len(keep) < len(x):
        style.pop("drawstyle", None)  # steps between the remaining points would be wrong
    if np.isfinite(y).sum() == 1:
        style["marker"] = "o"
    (drawn,) = axes.plot(x[keep], y[keep], **style)
    return drawn


@_draw.register
def _(item: Band, axes: Axes, norm: Normalize | None) -> Artist | None:
    low, high = (finite(one, positive=axes.get_yscale() == "log") for one in (item.low, item.high))
    if not (np.isfinite(low) & np.isfinite(high)).any():
        return None
    steps: Any = item.steps or None
    return axes.fill_between(
        item.x, low, high, step=steps, color=rgb(item.colour), alpha=item.opacity, linewidth=0
    )


@_draw.register
def _(item: Marks, axes: Axes, norm: Normalize | None) -> Artist | None:
    x = finite(item.x, positive=axes.get_xscale() == "log")
    y = finite(item.y, positive=axes.get_yscale() == "log")
    y = np.full(len(x), _TOP) if item.at_top else y
    seen = np.isfinite(x) & np.isfinite(y)
    x, y, size = x[seen], y[seen], item.size
    if not len(x):
        return None
    style: dict[str, Any] = {
        "color": rgb(item.colour), "marker": item.marker, "markeredgewidth": item.stroke,
        "alpha": item.opacity, "zorder": item.order, "linestyle": "none",
    }  # fmt: skip
    if item.x_error is not None or item.y_error is not None:
        y_error, x_error = (
            None if error is None else error[..., seen] for error in (item.y_error, item.x_error)
        )
        axes.errorbar(x, y, y_error, x_error, elinewidth=1.0, markersize=size, **style)
        return Line2D([], [], markersize=size, **style)
    if item.reduced:
        keep = decimate(x, y, _MARKS)
        x, y = x[keep], y[keep]
        size *= min(max(math.sqrt(_CROWD / len(keep)), 0.4), 1.0)
    if item.stems is not None:
        feet = np.column_stack([np.zeros(len(x)), y, np.full(len(x), np.nan)])
        axes.plot(np.repeat(x, 3), feet.ravel(), linewidth=1.0, color=rgb(item.stems))
    if item.framed:
        style |= {"markeredgecolor": PAPER, "markeredgewidth": 0.5}
    if item.at_top:
        style["transform"] = axes.get_xaxis_transform()
    (drawn,) = axes.plot(x, y, markersize=size, clip_on=False, **style)
    return drawn


@_draw.register
def _(item: Bars, axes: Axes, norm: Normalize | None) -> Artist | None:
    widths = np.diff(item.edges) * item.share
    middles = (item.edges[1:] + item.edges[:-1]) / 2
    if not len(item.heights) or not item.heights.any():
        return None
    style: dict[str, Any] = {"color": rgb(item.colour), "alpha": item.opacity}
    if item.horizontal:
        return axes.barh(middles, item.heights, widths, **style).patches[0]
    if item.numbers:
        axes.margins(y=0.15)
        for x, height in zip(middles, item.heights, strict=True):
            if height:
                axes.text(x, height, f"{height:,g}", ha="center", va="bottom",
                          size=layout().text_pt)  # fmt: skip
    return axes.bar(middles, item.heights, widths, **style).patches[0]


@_draw.register
def _(item: Rule, axes: Axes, norm: Normalize | None) -> Artist | None:
    draw_rule = axes.axvline if item.vertical else axes.axhline
    dash = (0, item.dash) if item.dash else "-"
    return draw_rule(
        item.at, color=rgb(item.colour), linestyle=dash, linewidth=item.width, zorder=item.order
    )


@_draw.register
def _(item: Spans, axes: Axes, norm: Normalize | None) -> Artist | None:
    for begin, end in zip(item.begin, item.end, strict=True):
        axes.axvspan(begin, end, color=rgb(item.colour), alpha=item.opacity, linewidth=0)
    return None


@_draw.register
def _(item: Heat, axes: Axes, norm: Normalize | None) -> Artist | None:
    rows, columns = item.values.shape
    (left, right), values = item.x_ends, np.ma.masked_invalid(item.values)
    if item.values.size > _MOST_CELLS:
        axes.imshow(
            values, aspect="auto", interpolation="nearest", norm=norm, cmap="viridis",
            extent=(left, right, rows - 0.5, -0.5),
        )  # fmt: skip
    else:
        edges = np.linspace(left, right, columns + 1), np.arange(rows + 1) - 0.5
        axes.pcolormesh(*edges, values, norm=norm, cmap="viridis")
    axes.set_ylim((rows - 0.5, -0.5) if item.downwards else (-0.5, rows - 0.5))
    axes.tick_params(length=0)
    width_in = axes.get_position().width * layout().width_in
    if item.numbers and norm is not None and width_in >= _NARROWEST_CELL_IN * columns:
        for (row, column), value in np.ndenumerate(item.values):
            if np.isfinite(value):
                middle = left + (column + 0.5) * (right - left) / columns
                colour = "#ffffff" if float(norm(value)) < _DARK else "#000000"
                axes.text(middle, row, f"{value:.3g}", ha="center", va="center", size=7.5,
                          color=colour)  # fmt: skip
    return None


def _norm(scale: ColourScale | None) -> Normalize | None:
    if scale is None:
        return None
    return (LogNorm if scale.logarithmic else Normalize)(scale.low, scale.high)


def _colour_bar(
    figure: Figure, scale: ColourScale, norm: Normalize | None, placed: Sequence[_Placed]
) -> None:
    """Draw the bar that explains the colours, at the right of all panels."""
    boxes = [one.box_in for one in placed]
    top_in = min(box.top for box in boxes)
    height_in = max(box.top + box.height for box in boxes) - top_in
    at_in = max(box.left + box.width for box in boxes) + _BAR_IN
    box_in = _Box(at_in, top_in, _BAR_IN, height_in)
    bar = _axes(figure, box_in, Panel(items=(), x=Axis(grid=False), y=Axis(grid=False)))
    mappable = ScalarMappable(norm, "viridis")
    extend: Any = "max" if scale.exceeded else "neither"
    figure.colorbar(mappable, cax=bar, label=scale.label, extend=extend)
    bar.grid(visible=False)


# Axes


def _for_log_axis(values: Reals) -> Reals:
    """Return values for a curve on a logarithmic axis.

    A zero (an error after a reset) becomes a value far below every axis, so that the curve falls
    vertically; a NaN would leave a gap. If all values are zero, they become NaN.
    """
    shown = finite(values, positive=True)
    if np.isfinite(shown).any():
        shown[np.asarray(values) == 0] = 1 / LARGEST
    return shown


def _finish_axis(axes: Axes, which: Literal["x", "y"], described: Axis, has_numbers: bool) -> None:
    """Set label, numbers and ends of an axis in which everything is drawn."""
    axis, box = (axes.xaxis, axes.bbox.width) if which == "x" else (axes.yaxis, axes.bbox.height)
    axis.set_label_text(described.label if has_numbers else "")
    if described.whole:
        few = box / axes.figure.dpi < _NARROW_IN
        axis.set_major_locator(MaxNLocator(integer=True, nbins=5 if few else "auto"))
    if described.ticks is not None:
        axis.set_ticks([*described.ticks], labels=[*described.ticks.values()])
    if not has_numbers:
        axis.set_tick_params(which="both", labelbottom=False, labelleft=False)
    if described.about is not None and described.logarithmic:
        _limit_log_axis(axes, described.about, described.decades)
    elif described.about is not None:
        _limit_axis(axes, described.about)
    if described.ends.count(None) == 1:
        _set_ends(axes, which, described)


def _set_ends(axes: Axes, which: Literal["x", "y"], described: Axis) -> None:
    (axes.set_xlim if which == "x" else axes.set_ylim)(*described.ends)


def _limit_log_axis(axes: Axes, measured: Reals, decades: int) -> None:
    """Show all curves, but at most ``decades`` below and above the largest measured value."""
    measured = finite(measured, positive=True)
    if not np.isfinite(measured).any():
        return
    values = np.concatenate([np.asarray(line.get_ydata(), dtype=np.float64) for line in axes.lines])
    values = values[values > 1 / LARGEST]  # without zeros
    decade = 10.0 ** math.floor(math.log10(np.nanmax(measured)))
    low, high = max(values.min(), decade / 10**decades), min(values.max(), decade * 10**decades)
    margin = max((high / low) ** 0.05, 1.1)
    axes.set_ylim(low / margin, high * margin)


def _limit_axis(axes: Axes, measured: Reals) -> None:
    """Show the measured values whole; bands only as far as they are near them."""
    values = np.append(finite(measured), 0.0)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    room = 0.25 * (high - low) or 1.0
    bottom, top = axes.get_ylim()
    axes.set_ylim(max(bottom, low - room), min(top, high + room))


class _Numbers(LogFormatter):
    """Writes 0.2 and 200, but 10⁻⁵ as plain text: typeset powers would be slow."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        if not super().__call__(x, pos) or (self._is_crowded() and f"{x:.0e}"[0] not in "13"):
            return ""
        if 1e-3 <= x < 1e5:
            return f"{x:g}"
        digits, exponent = f"{x:.0e}".split("e")
        power = "10" + str(int(exponent)).translate(_RAISED)
        return power if digits == "1" else f"{digits}·{power}"

    def _is_crowded(self) -> bool:
        """Whether only 1, 3, 10, 30, … have room: on the horizontal axis of a paper's figure."""
        low, high = self.axis.get_view_interval()  # type: ignore[union-attr]
        return layout().is_paper and self.axis.axis_name == "x" and high > _CROWDED * low  # type: ignore[union-attr]


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def logarithmic(axes: Axes, which: Literal["x", "y"]) -> None:
    """Make an axis logarithmic, with numbers that are easy to read."""
    axes.set(**{f"{which}scale": "log"})
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_formatter(_Numbers())
    axis.set_minor_formatter(_Numbers(labelOnlyBase=False, minor_thresholds=(1.2, 0.5)))


# Legends


def _legend(axes: Axes, shown: Sequence[Shown]) -> None:
    """Put the legend above the axes at the right, where there are no data; the title is set."""
    if not shown:
        return
    handles, labels = zip(*shown, strict=True)
    space, place = layout(), axes.get_position()
    width_in, right = place.width * space.width_in, 1.0
    if not space.is_paper:
        columns = _legend_columns(labels, width_in)
        axes.legend(handles, labels, loc="lower right", bbox_to_anchor=(right, 1), ncols=columns)
        return
    rows = _packed(labels, width_in)
    if not space.beside_title:  # it ends where the figure's axes end
        right = (1 - space.right_in / space.width_in - place.x0) / place.width
        pad_pt = _POINTS_PER_IN * space.legend_row_in * len(rows) + mpl.rcParams["axes.titlepad"]
        axes.set_title(axes.get_title("left"), pad=pad_pt)
    row = space.legend_row_in * axes.figure.dpi / axes.bbox.height
    for above, entries in enumerate(reversed(rows)):
        axes.add_artist(Legend(
            axes, [handles[i] for i in entries], [_short(labels[i]) for i in entries],
            loc="lower right", bbox_to_anchor=(right, 1 + above * row), ncols=len(entries),
        ))  # fmt: skip


def _legend_rows(labels: Sequence[str], width_in: float) -> int:
    """Return the number of rows of a legend."""
    if layout().is_paper:
        return len(_packed(labels, width_in))
    return math.ceil(len(labels) / _legend_columns(labels, width_in))


def _packed(labels: Sequence[str], width_in: float) -> list[list[int]]:
    """Return which entries are in each row of a legend in a paper, in their order."""
    rows, left_in = list[list[int]](), 0.0
    for number, entry_in in enumerate(_entries_in(map(_short, labels))):
        if entry_in > left_in:
            rows.append([])
            left_in = _legend_room_in(width_in)
        rows[-1].append(number)
        left_in -= entry_in
    return rows


def _legend_columns(labels: Sequence[str], width_in: float) -> int:
    """Return the number of legend columns that fit beside the title, or below it.

    Below the title, a legend may be as wide as the figure.
    """
    entries_in, room_in = _entries_in(labels), _legend_room_in(width_in)
    for columns in range(len(labels), 1, -1):
        widths_in = [max(column) for column in np.array_split(entries_in, columns)]
        if sum(widths_in) <= room_in:
            return columns
    return 1


def _legend_room_in(width_in: float) -> float:
    """Return the width of a legend: beside the title, or below it as wide as the figure."""
    space = layout()
    if not space.beside_title:
        return space.width_in - 2 * space.right_in
    return width_in - _TITLE_CHARACTERS * space.character_in


def _short(label: str) -> str:
    """Return the label of a bound as it is in the legends of papers."""
    for long, brief in _IN_SHORT:
        label = label.replace(long, brief)
    return label


def _entries_in(labels: Iterable[str]) -> list[float]:
    """Return the widths of a legend's entries."""
    space = layout()
    return [space.handle_in + space.character_in * len(_MARKUP.sub("", label)) for label in labels]
