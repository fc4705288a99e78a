"""Shared functions for axes: positions, legends, lines reduced to the visible points.

Axes have positions in inches: this needs no layout engine, aligns the figures of a page with each
other, and gives the same figure the same bytes.
"""

import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.ticker import LogFormatter

from cosim.analysis.value_reduction import Reals, decimate
from cosim.output import palette
from cosim.output.report.figure_layout import layout as layout
from cosim.output.report.figure_style import NotebookFigure, printed

BoundKind = Literal["certified", "identity", "printed"]
"""Source of a bound: a certificate, identity (I1), or a formula of the paper."""


class Bound(NamedTuple):
    """A curve that bounds a measured quantity."""

    label: str
    t_s: Reals
    """(k,)"""
    values: Reals
    """(k,)"""
    kind: BoundKind = "certified"


Shown = tuple[Artist, str]
"""A drawn object and its label in the legend."""

TIME = "time t [s]"

_BESIDE_GAP_IN, _UNTITLED_IN = 0.27, 0.08
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
    ("certified for the ", "certified: "),
    ("certified from the ", "certified: "),
)
"""What the legends of papers leave out of the labels of bounds."""
_MARKUP = re.compile(r"[$\\{}^_]|(?<=\\)\w+")
_LARGEST = 1e150
_LONGEST_NAME = 16
_CROWDED = 6.0
"""Ratio of the ends of a logarithmic axis from which it has room for few numbers in a paper."""

_BOUND_STYLES: dict[BoundKind, tuple[palette.Colour, tuple[Any, ...]]] = {
    # There may be several certificates, for different conditions.
    "certified": (
        palette.CERTIFIED, ((0, (6, 2.5)), (0, (3, 1.5)), (0, (6, 2, 1.5, 2)), (0, (10, 3)))
    ),
    "identity": (palette.IDENTITY, ((0, (1.2, 1.4)),)),
    "printed": (palette.PRINTED, ((0, (6, 1.5, 1, 1.5, 1, 1.5)),)),
}  # fmt: skip


def place(
    figure: Figure, left_in: float, top_in: float, width_in: float, height_in: float, **shared: Any
) -> Axes:
    """Add axes; their upper left corner has this distance from the figure's."""
    figure_in, whole_in = figure.get_size_inches()
    bottom_in = whole_in - top_in - height_in
    axes = figure.add_axes(
        (left_in / figure_in, bottom_in / whole_in, width_in / figure_in, height_in / whole_in),
        **shared,
    )
    factor = axes.yaxis.get_offset_text()  # e.g. ×10⁻⁶; above the axes it would overlap the title
    factor.set(x=-0.05 / width_in, horizontalalignment="right")
    return axes


def single(
    height_in: float, labels: Sequence[str], beside_in: float = 0.0, *, titled: bool = True
) -> tuple[Figure, list[Axes]]:
    """Return a figure of one panel, or of two with a common vertical axis.

    Args:
        height_in: height of the axes in a figure for the screen.
        labels: labels of the first panel's legend, which needs space above it.
        beside_in: width of the second panel in a figure for the screen; 0 for none.
        titled: whether the first panel gets a title.
    """
    space = layout()
    height_in, beside_in = height_in * space.scale, beside_in * space.beside_scale
    width_in = panel_width_in() - (beside_in + _BESIDE_GAP_IN if beside_in else 0.0)
    above_in = head_in(labels, width_in, titled=titled)
    figure = NotebookFigure(figsize=(space.width_in, above_in + height_in + space.below_in))
    axes = [place(figure, space.left_in, above_in, width_in, height_in)]
    if beside_in:
        left_in = space.width_in - space.right_in - beside_in
        axes.append(place(figure, left_in, above_in, beside_in, height_in, sharey=axes[0]))
        axes[1].tick_params(labelleft=False, which="both")
    return figure, axes


def panel_width_in() -> float:
    """Return the width of axes that are as wide as the figure."""
    space = layout()
    return space.width_in - space.left_in - space.right_in


def head_in(labels: Sequence[str], width_in: float | None = None, *, titled: bool = True) -> float:
    """Return the height of title and legend above axes of this width, by default the whole."""
    space = layout()
    title_in = space.above_in if titled or space.beside_title else _UNTITLED_IN
    return title_in + space.legend_row_in * _legend_rows(labels, width_in)


def _legend_rows(labels: Sequence[str], width_in: float | None) -> int:
    """Return the number of rows of a legend without the one that the title shares."""
    space = layout()
    columns = legend_columns(labels, width_in)
    rows = len(_packed(labels, width_in)) if space.is_paper else math.ceil(len(labels) / columns)
    return max(rows - 1, 0) if space.beside_title else rows


def _packed(labels: Sequence[str], width_in: float | None) -> list[list[int]]:
    """Return which entries are in each row of a legend in a paper, in their order."""
    rows, left_in = list[list[int]](), 0.0
    for number, entry_in in enumerate(_entries_in(map(_short, labels))):
        if entry_in > left_in:
            rows.append([])
            left_in = _legend_room_in(width_in)
        rows[-1].append(number)
        left_in -= entry_in
    return rows


def _legend_room_in(width_in: float | None) -> float:
    """Return the width of a legend: beside the title, or below it as wide as the figure."""
    space = layout()
    if not space.beside_title:
        return space.width_in - 2 * space.right_in
    width_in = panel_width_in() if width_in is None else width_in
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


def legend_columns(labels: Sequence[str], width_in: float | None = None) -> int:
    """Return the number of legend columns that fit beside the title, or below it.

    Below the title, a legend may be as wide as the figure.
    """
    entries_in, room_in = _entries_in(labels), _legend_room_in(width_in)
    for columns in range(len(labels), 1, -1):
        widths_in = [max(column) for column in np.array_split(entries_in, columns)]
        if sum(widths_in) <= room_in:
            return columns
    return 1


def legend(axes: Axes, shown: Sequence[Shown]) -> None:
    """Put the legend above the axes at the right, where there are no data; the title is set."""
    if not shown:
        return
    handles, labels = zip(*shown, strict=True)
    space, place = layout(), axes.get_position()
    width_in, right = place.width * space.width_in, 1.0
    if not space.is_paper:
        columns = legend_columns(labels, width_in)
        axes.legend(handles, labels, loc="lower right", bbox_to_anchor=(right, 1), ncols=columns)
        return
    rows = _packed(labels, width_in)
    if not space.beside_title:  # it ends where the figure's axes end
        right = (1 - space.right_in / space.width_in - place.x0) / place.width
        pad_pt = 72 * space.legend_row_in * len(rows) + mpl.rcParams["axes.titlepad"]
        axes.set_title(axes.get_title("left"), pad=pad_pt)
    row = space.legend_row_in * axes.figure.dpi / axes.bbox.height
    for above, entries in enumerate(reversed(rows)):
        one = Legend(
            axes, [handles[i] for i in entries], [_short(labels[i]) for i in entries],
            loc="lower right", bbox_to_anchor=(right, 1 + above * row), ncols=len(entries),
        )  # fmt: skip
        axes.add_artist(one)


def finite(values: Reals, *, positive: bool = False) -> Reals:
    """Return values with NaN for infinite and huge ones, and, if ``positive``, those not > 0."""
    values = np.asarray(values, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        shown = np.abs(values) < _LARGEST
        if positive:
            shown &= values > 0
    return np.where(shown, values, np.nan)


def for_log_axis(values: Reals) -> Reals:
    """Return values for a curve on a logarithmic axis.

    A zero (an error after a reset) becomes a value far below every axis, so that the curve falls
    vertically; a NaN would leave a gap. If all values are zero, they become NaN.
    """
    shown = finite(values, positive=True)
    if np.isfinite(shown).any():
        shown[np.asarray(values) == 0] = 1 / _LARGEST
    return shown


def limit_log_axis(axes: Axes, measured: Reals, decades: int) -> None:
    """Show all curves, but at most ``decades`` below and above the largest measured value."""
    measured = finite(measured, positive=True)
    if not np.isfinite(measured).any():
        return
    values = np.concatenate([np.asarray(line.get_ydata(), dtype=np.float64) for line in axes.lines])
    values = values[values > 1 / _LARGEST]  # without zeros
    decade = 10.0 ** math.floor(math.log10(np.nanmax(measured)))
    low, high = max(values.min(), decade / 10**decades), min(values.max(), decade * 10**decades)
    margin = max((high / low) ** 0.05, 1.1)
    axes.set_ylim(low / margin, high * margin)


def plain(name: str, longest: int = _LONGEST_NAME) -> str:
    """Return a user's name for a label: no mathematical markup, one line, limited length."""
    line = " ".join(name.split())
    if len(line) > longest:
        line = line[: longest - 1] + "…"
    return line.replace("$", r"\$")


def line(axes: Axes, t_s: Reals, values: Reals, label: str = "", **style: Any) -> list[Shown]:
    """Draw a curve; its values are finite or NaN; a single point is drawn as a dot."""
    keep = decimate(t_s, values, _COLUMNS)
    if len(keep) < len(t_s):
        style.pop("drawstyle", None)  # steps between the remaining points would be wrong
    if np.isfinite(values).sum() == 1:
        style["marker"] = "o"
    (drawn,) = axes.plot(t_s[keep], values[keep], **style)
    return [(drawn, label)]


def marks(
    axes: Axes, t_s: Reals, values: Reals, label: str = "", size: float = 5.0, **style: Any
) -> list[Shown]:
    """Draw markers, smaller ones if there are many; without markers, there is no legend entry."""
    seen = np.isfinite(values)
    t_s, values = t_s[seen], values[seen]
    if not len(values):
        return []
    keep = decimate(t_s, values, _MARKS)
    style["markersize"] = size * min(max(math.sqrt(_CROWD / len(keep)), 0.4), 1.0)
    (drawn,) = axes.plot(t_s[keep], values[keep], linestyle="none", clip_on=False, **style)
    return [(drawn, label)]


def stems(axes: Axes, t_s: Reals, values: Reals, **style: Any) -> None:
    """Draw a stem from 0 to each value, all stems as one line."""
    keep = decimate(t_s, values, _MARKS)
    feet = np.column_stack([np.zeros(len(keep)), values[keep], np.full(len(keep), np.nan)])
    axes.plot(np.repeat(t_s[keep], 3), feet.ravel(), linewidth=1.0, **style)


def bounds(axes: Axes, curves: Sequence[Bound]) -> list[Shown]:
    """Draw bounds, dashed, on a logarithmic axis."""
    shown = []
    for bound, style in zip(curves, bound_styles(curves), strict=True):
        values = finite(bound.values, positive=True)
        shown += line(axes, np.asarray(bound.t_s), values, bound.label, **style)
    return shown


def bound_styles(curves: Sequence[Bound]) -> list[dict[str, Any]]:
    """Return each bound's style: one colour per kind, one dash pattern per bound of a kind."""
    drawn: Counter[BoundKind] = Counter()
    styles = []
    for bound in curves:
        colour, dashes = _BOUND_STYLES[bound.kind]
        dash = dashes[drawn[bound.kind] % len(dashes)]
        drawn[bound.kind] += 1
        styles.append({"color": printed(colour), "linestyle": dash, "linewidth": 1.6})
    return styles


def finish(axes: Axes, t_s: Reals | None = None) -> None:
    """Set the range of the time axis, from 0 if the data start near 0; mark axes without data.

    Args:
        axes: the axes, with all data drawn.
        t_s: the axis shows the range of these times, if it is a time axis.
    """
    if t_s is not None and len(t_s) and t_s[-1] > t_s[0]:
        start = 0.0 if 0 <= t_s[0] < 0.05 * t_s[-1] else t_s[0]
        axes.set_xlim(start, t_s[-1])
    if not np.isfinite(axes.dataLim.bounds).all():
        axes.text(0.5, 0.5, "no data", transform=axes.transAxes, ha="center", va="center")
        axes.tick_params(left=False, labelleft=False, which="both")


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
