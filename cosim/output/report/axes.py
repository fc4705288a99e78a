"""Shared functions for axes: positions, legends, lines reduced to the visible points.

Axes have positions in inches: this needs no layout engine, aligns the figures of a page with each
other, and gives the same figure the same bytes.
"""

import math
import re
from collections import Counter
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from cosim.output import palette
from cosim.output.report.figure_style import NotebookFigure, printed
from cosim.record.decimate import Reals, decimate

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

WIDTH_IN, LEFT_IN, RIGHT_IN, BELOW_IN = 10.0, 1.15, 0.2, 0.55
"""Width of a figure; space for labels and ticks at the left, at the right, and below an axes."""
_ABOVE_IN, _LEGEND_ROW_IN, _TITLE_IN, _HANDLE_IN, _CHARACTER_IN = 0.34, 0.19, 2.3, 0.6, 0.075

_COLUMNS = 600
"""Pixel columns of a panel, to which lines are reduced."""
_MARKS, _CROWD = 120, 80
"""Columns of markers in a panel, which are wider than a pixel; more markers than ``_CROWD`` are
drawn smaller."""
_MARKUP = re.compile(r"[$\\{}^_]|(?<=\\)\w+")
_LARGEST = 1e150
_LONGEST_NAME = 16

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
    whole_in = figure.get_figheight()
    bottom_in = whole_in - top_in - height_in
    axes = figure.add_axes(
        (left_in / WIDTH_IN, bottom_in / whole_in, width_in / WIDTH_IN, height_in / whole_in),
        **shared,
    )
    factor = axes.yaxis.get_offset_text()  # e.g. ×10⁻⁶; above the axes it would overlap the title
    factor.set(x=-0.05 / width_in, horizontalalignment="right")
    return axes


def single(
    height_in: float, labels: Sequence[str], beside_in: float = 0.0
) -> tuple[Figure, list[Axes]]:
    """Return a figure of one panel, or of two with a common vertical axis.

    Args:
        height_in: height of the axes.
        labels: labels of the first panel's legend, which needs space above it.
        beside_in: width of the second panel; 0 for none.
    """
    width_in = WIDTH_IN - LEFT_IN - RIGHT_IN - (beside_in + 0.25 if beside_in else 0.0)
    above_in = head_in(labels, width_in)
    figure = NotebookFigure(figsize=(WIDTH_IN, above_in + height_in + BELOW_IN))
    axes = [place(figure, LEFT_IN, above_in, width_in, height_in)]
    if beside_in:
        left_in = WIDTH_IN - RIGHT_IN - beside_in
        axes.append(place(figure, left_in, above_in, beside_in, height_in, sharey=axes[0]))
        axes[1].tick_params(labelleft=False, which="both")
    return figure, axes


def head_in(labels: Sequence[str], width_in: float = WIDTH_IN - LEFT_IN - RIGHT_IN) -> float:
    """Return the height of title and legend above axes of this width."""
    rows = math.ceil(len(labels) / _legend_columns(labels, width_in))
    return _ABOVE_IN + _LEGEND_ROW_IN * max(rows - 1, 0)


def _legend_columns(labels: Sequence[str], width_in: float) -> int:
    """Return the number of legend columns that fit beside the title."""
    entries_in = [_HANDLE_IN + _CHARACTER_IN * len(_MARKUP.sub("", label)) for label in labels]
    for columns in range(len(labels), 1, -1):
        widths_in = [max(column) for column in np.array_split(entries_in, columns)]
        if sum(widths_in) <= width_in - _TITLE_IN:
            return columns
    return 1


def legend(axes: Axes, shown: Sequence[Shown]) -> None:
    """Put the legend above the axes at the right, where there are no data."""
    if shown:
        handles, labels = zip(*shown, strict=True)
        columns = _legend_columns(labels, axes.get_position().width * WIDTH_IN)
        axes.legend(handles, labels, loc="lower right", bbox_to_anchor=(1, 1), ncols=columns)


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
        if not super().__call__(x, pos):
            return ""
        if 1e-3 <= x < 1e5:
            return f"{x:g}"
        digits, exponent = f"{x:.0e}".split("e")
        power = "10" + str(int(exponent)).translate(_RAISED)
        return power if digits == "1" else f"{digits}·{power}"


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def logarithmic(axes: Axes, which: Literal["x", "y"]) -> None:
    """Make an axis logarithmic, with numbers that are easy to read."""
    axes.set(**{f"{which}scale": "log"})
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_formatter(_Numbers())
    axis.set_minor_formatter(_Numbers(labelOnlyBase=False, minor_thresholds=(1.2, 0.5)))
