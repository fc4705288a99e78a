"""Draws a figure by matplotlib: for reports and pages, files and notebooks.

Read :func:`draw` first; then panels and their items, axes, and heads.
"""

import math
import re
import textwrap
from collections.abc import Sequence
from functools import singledispatch
from typing import Any, Literal, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import LogFormatter, MaxNLocator, ScalarFormatter

from cosim.output.figures.figure_description import (
    LARGEST,
    Axis,
    Band,
    Bars,
    ColourScale,
    FigureDescription,
    Heat,
    Line,
    Marks,
    Panel,
    Rule,
    Spans,
    finite,
    log_ends,
    near_ends,
)
from cosim.output.figures.figure_layout import (
    BAR_IN,
    PAPER,
    POINTS_PER_IN,
    FigureBox,
    NotebookFigure,
    Place,
    layout,
    legend_rows,
    legend_text,
    matplotlib_settings,
    place_panels,
    rgb,
    turned_in,
)
from cosim.record.align import Reals
from cosim.record.decimation import decimate

_NARROW_IN = 2.5
"""A shorter axis has few numbers."""
_COLUMNS = 600
"""Pixel columns of a panel, to which lines are reduced."""
_MARKER_COLUMNS, _CROWDED_MARKERS = 120, 80
"""Columns of markers in a panel, which are wider than a pixel; more markers than
``_CROWDED_MARKERS`` are drawn smaller."""
_FEW_NUMBERS_RATIO = 6.0
"""Ratio of the ends of a logarithmic axis from which it has room for few numbers in a paper."""
_NARROWEST_CELL_IN = 0.42
"""Narrowest cell of a map in which its number is written."""
_MOST_CELLS = 1000
"""A map of more cells is a bitmap."""
_MARK_HEIGHT = 0.97
"""Of marks at the top of a panel, as a share of its height."""
_DARK_CELL = 0.6
"""A cell of a map with a lower value, as a share of the largest, has white numbers."""
_EM_PER_CHARACTER_OF_LABEL = 0.5  # a label of an axis may be a little longer than the axis
_SHORTEST_LINE = 8  # characters
_UNIT, _NO_BREAK = re.compile(r"\[[^]]*\]"), "\N{NO-BREAK SPACE}"
_DOLLAR = re.compile(r"(?<!\\)\$")
_BOLD_FONTS = ["cmb10", "DejaVu Serif"]
_COMPUTER_MODERN_CHARACTERS = str.maketrans(
    {"_": r"$\_$", "<": "$<$", ">": "$>$", "|": "$|$", "{": r"$\{$", "}": r"$\}$", '"': "''"}
    | {"µ": r"$\mu$", "°": r"$^\circ$", "¹": "$^1$", "²": "$^2$", "³": "$^3$"}
)
"""Characters at whose places Computer Modern has others; its mathematical fonts have them."""
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


class LegendItem(NamedTuple):
    """A drawn object and its label in the legend."""

    artist: Artist
    label: str


@matplotlib_settings()
def draw(description: FigureDescription) -> Figure:
    """Draw a figure for the width of :func:`cosim.output.figures.figure_layout.use_figure_width`."""
    places, size_in = place_panels(description)
    figure, norm = NotebookFigure(figsize=size_in), _norm(description.scale)
    for number, place in enumerate(places):
        axes = _axes(figure, place, figure.axes[-1] if place.is_beside else None)
        legend_items = _draw_panel(axes, place, norm)
        box, title = place.box, place.panel.title
        if description.heading and not number:
            width_in = layout().width_in - layout().right_in - box.left
            box, title = box._replace(width=width_in), description.heading
        _draw_heading(axes, figure, box, title, legend_items)
    if description.scale is not None:
        _draw_colour_bar(figure, description.scale, norm, places)
    figure.align_ylabels()
    _fit_to_paper(figure)
    if layout().latex:
        for text in figure.findobj(Text):
            assert isinstance(text, Text)
            text.set_text(_for_font(text.get_text()))
            if text.get_fontweight() == "bold":
                text.set_fontfamily(_BOLD_FONTS)
    return figure


# Panels and their items


def _axes(figure: Figure, place: Place, beside: Axes | None = None) -> Axes:
    (figure_in, whole_in), box = figure.get_size_inches(), place.box
    bottom_in = whole_in - box.top - box.height
    axes = figure.add_axes(
        (box.left / figure_in, bottom_in / whole_in, box.width / figure_in, box.height / whole_in),
        sharey=beside,
    )
    factor = axes.yaxis.get_offset_text()  # e.g. ×10⁻⁶; above the axes it would overlap the title
    factor.set(x=-0.05 / box.width, horizontalalignment="right")
    for letter, axis in (("x", place.panel.x), ("y", place.panel.y)):
        if axis.logarithmic:
            _make_logarithmic(axes, letter)  # type: ignore[arg-type]
        else:
            (axes.xaxis if letter == "x" else axes.yaxis).set_major_formatter(_PlainFormatter())
        if None not in axis.ends:
            _set_ends(axes, letter, axis)  # type: ignore[arg-type]
        if not axis.grid:
            axes.grid(visible=False, axis=letter)  # type: ignore[arg-type]
    return axes


def _draw_panel(axes: Axes, place: Place, norm: Normalize | None) -> list[LegendItem]:
    """Draw a panel; return what its legend shows."""
    panel, artists = place.panel, dict[str, Artist]()
    for item in panel.items:
        if (artist := _draw_item(item, axes, norm)) is not None:
            artists.setdefault(getattr(item, "label", ""), artist)
    _finish_axis(axes, "x", panel.x, has_numbers=place.has_x)
    _finish_axis(axes, "y", panel.y, has_numbers=place.has_y)
    if not np.isfinite(axes.dataLim.bounds).all():
        axes.text(0.5, 0.5, panel.empty, transform=axes.transAxes, ha="center", va="center")
        axes.tick_params(left=False, labelleft=False, which="both")
    return [LegendItem(artists[label], label) for label in panel.labels if label in artists]


def _draw_heading(
    axes: Axes, figure: Figure, box: FigureBox, title: str, items: Sequence[LegendItem]
) -> None:
    """Write a title and a legend above a box, where there are no data."""
    space, bottom_in = layout(), figure.get_figheight() - box.top
    rows = legend_rows([item.label for item in items], box.width)
    right_in, title_in = box.left + box.width, 0.0
    if not space.beside_title:  # the legend is below the title, and ends where all axes end
        right_in, title_in = space.width_in - space.right_in, space.legend_row_in * len(rows)
    for number, entries in enumerate(rows):
        above = len(rows) - 1 - number
        legend = axes.legend(
            [items[i].artist for i in entries],
            [legend_text(items[i].label) for i in entries],
            loc="lower right",
            bbox_to_anchor=(right_in, bottom_in + above * space.legend_row_in),
            bbox_transform=figure.dpi_scale_trans,
            ncols=len(entries),
        )
        if above:  # the next row would replace it
            axes.add_artist(legend)
    pad_pt = POINTS_PER_IN * title_in + mpl.rcParams["axes.titlepad"]
    axes.set_title(title, loc="left", weight="bold", y=1.0, pad=pad_pt)


@singledispatch
def _draw_item(item: object, axes: Axes, norm: Normalize | None) -> Artist | None:
    """Draw an item; return what represents it in the legend, None if there is nothing."""
    raise TypeError(type(item))


@_draw_item.register
def _(item: Line, axes: Axes, norm: Normalize | None) -> Artist | None:
    style: dict[str, Any] = {
        "color": rgb(item.colour),
        "linewidth": item.width,
        "zorder": item.order,
        "linestyle": (0, item.dash) if item.dash else "-",
        "marker": item.marker,
        "markersize": item.size,
        "alpha": item.opacity,
    }
    if item.steps:
        style["drawstyle"] = f"steps-{item.steps}"
    is_log = axes.get_yscale() == "log"
    return _draw_curve(axes, item.x, (_for_log_axis if is_log else finite)(item.y), **style)


def _draw_curve(axes: Axes, x: Reals, y: Reals, **style: Any) -> Artist:
    """Draw a curve; its values are finite or NaN; a single point is drawn as a dot."""
    keep = decimate(x, y, _COLUMNS)
    if len(keep) < len(x):
        style.pop("drawstyle", None)  # steps between the remaining points would be wrong
    if np.isfinite(y).sum() == 1:
        style["marker"] = "o"
    (line,) = axes.plot(x[keep], y[keep], **style)
    return line


@_draw_item.register
def _(item: Band, axes: Axes, norm: Normalize | None) -> Artist | None:
    low, high = (finite(curve, positive=axes.get_yscale() == "log") for curve in (item.low, item.high))
    if not (np.isfinite(low) & np.isfinite(high)).any():
        return None
    steps = item.steps or None
    return axes.fill_between(
        item.x, low, high, step=steps, color=rgb(item.colour), alpha=item.opacity, linewidth=0
    )


@_draw_item.register
def _(item: Marks, axes: Axes, norm: Normalize | None) -> Artist | None:
    x = finite(item.x, positive=axes.get_xscale() == "log")
    y = finite(item.y, positive=axes.get_yscale() == "log")
    y = np.full(len(x), _MARK_HEIGHT) if item.at_top else y
    is_finite = np.isfinite(x) & np.isfinite(y)
    x, y, size = x[is_finite], y[is_finite], item.size
    if not len(x):
        return None
    style: dict[str, Any] = {
        "color": rgb(item.colour),
        "marker": item.marker,
        "markeredgewidth": item.stroke,
        "alpha": item.opacity,
        "zorder": item.order,
        "linestyle": "none",
    }
    if item.x_error is not None or item.y_error is not None:
        y_error, x_error = (
            None if error is None else error[..., is_finite] for error in (item.y_error, item.x_error)
        )
        axes.errorbar(x, y, y_error, x_error, elinewidth=1.0, markersize=size, **style)
        return Line2D([], [], markersize=size, **style)
    if item.reduced:
        keep = decimate(x, y, _MARKER_COLUMNS)
        x, y = x[keep], y[keep]
        size *= min(max(math.sqrt(_CROWDED_MARKERS / len(keep)), 0.4), 1.0)
    if item.stems is not None:
        feet = np.column_stack([np.zeros(len(x)), y, np.full(len(x), np.nan)])
        axes.plot(np.repeat(x, 3), feet.ravel(), linewidth=1.0, color=rgb(item.stems))
    if item.framed:
        style |= {"markeredgecolor": PAPER, "markeredgewidth": 0.5}
    if item.at_top:
        style["transform"] = axes.get_xaxis_transform()
    (drawn,) = axes.plot(x, y, markersize=size, clip_on=False, **style)
    return drawn


@_draw_item.register
def _(item: Bars, axes: Axes, norm: Normalize | None) -> Artist | None:
    widths = np.diff(item.edges) * item.share
    middles = (item.edges[1:] + item.edges[:-1]) / 2
    if not len(item.heights) or not item.heights.any():
        return None
    style: dict[str, Any] = {"color": rgb(item.colour), "alpha": item.opacity}
    seen = item.heights != 0  # each bar is an artist: a million of them take minutes
    middles, heights, widths = middles[seen], item.heights[seen], widths[seen]
    if item.horizontal:
        return axes.barh(middles, heights, widths, **style).patches[0]
    if item.numbers:
        axes.margins(y=0.15)
        for x, height in zip(middles, heights, strict=True):
            axes.text(
                x, height, f"{height:,g}", ha="center", va="bottom", size=mpl.rcParams["legend.fontsize"]
            )
    return axes.bar(middles, heights, widths, **style).patches[0]


@_draw_item.register
def _(item: Rule, axes: Axes, norm: Normalize | None) -> Artist | None:
    draw_rule = axes.axvline if item.vertical else axes.axhline
    dash = (0, item.dash) if item.dash else "-"
    return draw_rule(item.at, color=rgb(item.colour), linestyle=dash, linewidth=item.width, zorder=item.order)


@_draw_item.register
def _(item: Spans, axes: Axes, norm: Normalize | None) -> Artist | None:
    for begin, end in zip(item.begin, item.end, strict=True):
        axes.axvspan(begin, end, color=rgb(item.colour), alpha=item.opacity, linewidth=0)
    return None


@_draw_item.register
def _(item: Heat, axes: Axes, norm: Normalize | None) -> Artist | None:
    rows, columns = item.values.shape
    (left, right), values = item.x_ends, np.ma.masked_invalid(item.values)
    if item.values.size > _MOST_CELLS:
        axes.imshow(
            values,
            aspect="auto",
            interpolation="nearest",
            norm=norm,
            cmap="viridis",
            extent=(left, right, rows - 0.5, -0.5),
        )
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
                colour = "#ffffff" if float(norm(value)) < _DARK_CELL else "#000000"
                axes.text(middle, row, f"{value:.3g}", ha="center", va="center", size=7.5, color=colour)
    return None


def _norm(scale: ColourScale | None) -> Normalize | None:
    if scale is None:
        return None
    return (LogNorm if scale.logarithmic else Normalize)(scale.low, scale.high)


def _draw_colour_bar(
    figure: Figure, scale: ColourScale, norm: Normalize | None, places: Sequence[Place]
) -> None:
    """Draw the bar that explains the colours, at the right of all panels."""
    boxes = [place.box for place in places]
    top_in = min(box.top for box in boxes)
    height_in = max(box.top + box.height for box in boxes) - top_in
    begin_in = max(box.left + box.width for box in boxes) + BAR_IN
    panel = Panel(items=(), x=Axis(grid=False), y=Axis(grid=False))
    box = FigureBox(begin_in, top_in, BAR_IN, height_in)
    bar = _axes(figure, Place(panel, box, has_x=False, has_y=True))
    mappable = ScalarMappable(norm, "viridis")
    extend: Literal["max", "neither"] = "max" if scale.exceeded else "neither"
    figure.colorbar(mappable, cax=bar, label=scale.label, extend=extend)
    bar.grid(visible=False)


# Axes


def _for_log_axis(values: Reals) -> Reals:
    """Return values for a curve on a logarithmic axis.

    A zero (an error after a reset), or what is nearly zero, becomes a value far below every axis, so that
    the curve falls vertically; a NaN would leave a gap. If all values are zero, they become NaN.
    """
    heights = finite(values, positive=True)
    if np.isfinite(heights).any():
        with np.errstate(invalid="ignore"):
            heights[(np.asarray(values) >= 0) & (np.asarray(values) <= 1 / LARGEST)] = 1 / LARGEST
    return heights


def _finish_axis(axes: Axes, letter: Literal["x", "y"], description: Axis, *, has_numbers: bool) -> None:
    """Set label, numbers and ends of an axis in which everything is drawn."""
    axis, box = (axes.xaxis, axes.bbox.width) if letter == "x" else (axes.yaxis, axes.bbox.height)
    axis.set_label_text(description.label if has_numbers else "")
    if description.whole:
        few = box / axes.figure.dpi < _NARROW_IN
        axis.set_major_locator(MaxNLocator(integer=True, nbins=5 if few else "auto"))
    if description.ticks is not None:
        axis.set_ticks([*description.ticks], labels=[*map(_for_font, description.ticks.values())])
        if letter == "x" and turned_in(description, box / axes.figure.dpi):
            for text in axis.get_ticklabels():
                text.set(rotation=45, horizontalalignment="right", rotation_mode="anchor")
    if not has_numbers:
        axis.set_tick_params(which="both", labelbottom=False, labelleft=False)
    if description.about is not None and description.logarithmic:
        values = np.concatenate([np.asarray(line.get_ydata(), np.float64) for line in axes.lines])
        if (ends := log_ends(values, description.about, description.decades)) is not None:
            axes.set_ylim(*ends)
    elif description.about is not None:
        axes.set_ylim(*near_ends(axes.get_ylim(), description.about))
    if description.ends.count(None) == 1:
        _set_ends(axes, letter, description)


def _for_font(text: str) -> str:
    """Write characters that the fonts of LaTeX lack as mathematics, which is between dollars."""
    if not layout().latex:
        return text
    parts = _DOLLAR.split(text)
    return "$".join(
        part if i % 2 else part.translate(_COMPUTER_MODERN_CHARACTERS) for i, part in enumerate(parts)
    )


def _set_ends(axes: Axes, letter: Literal["x", "y"], description: Axis) -> None:
    (axes.set_xlim if letter == "x" else axes.set_ylim)(*description.ends)


class _PlainFormatter(ScalarFormatter):
    """Writes numbers as plain text: typesetting is slow. The fonts of LaTeX lack the minus sign."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        text = super().__call__(x, pos)
        return text if layout().latex else text.removeprefix(r"$\mathdefault{").removesuffix("}$")


class _LogFormatter(LogFormatter):
    """Writes 0.2 and 200, but 10⁻⁵ as plain text: typeset powers would be slow.

    The fonts of LaTeX have other characters at the places of ¹, ² and ³.
    """

    def __call__(self, x: float, pos: int | None = None) -> str:
        if not super().__call__(x, pos) or (self._is_crowded() and f"{x:.0e}"[0] not in "13"):
            return ""
        if 1e-3 <= x < 1e5:
            return f"{x:g}"
        digits, exponent = f"{x:.0e}".split("e")
        if layout().latex:
            factor = "" if digits == "1" else rf"{digits}\cdot"
            return f"${factor}10^{{{int(exponent)}}}$"
        power = "10" + str(int(exponent)).translate(_SUPERSCRIPTS)
        return power if digits == "1" else f"{digits}·{power}"

    def _is_crowded(self) -> bool:
        """Whether only 1, 3, 10, 30, … have room: on the horizontal axis of a paper's figure."""
        low, high = self.axis.get_view_interval()  # type: ignore[union-attr]
        return layout().is_paper and self.axis.axis_name == "x" and high > _FEW_NUMBERS_RATIO * low  # type: ignore[union-attr]


def _make_logarithmic(axes: Axes, letter: Literal["x", "y"]) -> None:
    """Make an axis logarithmic, with numbers that are easy to read."""
    axes.set(**{f"{letter}scale": "log"})
    axis = axes.xaxis if letter == "x" else axes.yaxis
    axis.set_major_formatter(_LogFormatter())
    axis.set_minor_formatter(_LogFormatter(labelOnlyBase=False, minor_thresholds=(1.2, 0.5)))


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
    character_in = _EM_PER_CHARACTER_OF_LABEL * mpl.rcParams["axes.labelsize"] / POINTS_PER_IN
    for axes in figure.axes:
        position, (width_in, height_in) = axes.get_position(), figure.get_size_inches()
        for axis, length_in in (
            (axes.xaxis, position.width * width_in),
            (axes.yaxis, position.height * height_in),
        ):
            most = max(int(length_in / character_in), _SHORTEST_LINE)
            axis.set_label_text(_wrapped(axis.get_label_text(), most))


def _wrapped(label: str, width: int) -> str:
    """Break a label into lines; a unit in brackets stays in one line."""
    text = _UNIT.sub(lambda unit: unit[0].replace(" ", _NO_BREAK), label)
    lines = textwrap.wrap(text, width, break_long_words=False)
    return "\n".join(lines).replace(_NO_BREAK, " ")
