"""What the functions that draw figures share: curves, marks, bars, axes.

Arrays may have any length, including 0. Values that are not finite are drawn as gaps. A scale is set
before anything is drawn: a curve on a logarithmic axis leaves it at its lower end where it is 0.
"""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.output.curves import Curve, Dash
from cosim.output.figures import palette
from cosim.output.figures.palette import Colour
from cosim.record.align import Reals
from cosim.record.decimation import decimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TIME = "time t [s]"
LARGEST = 1e150
"""Larger values are not drawn."""
MARKERS = "os^Dv<>PXph*"
"""Markers that distinguish series in addition to their colours, by matplotlib's names."""
_COLUMNS = 600
"""Pixel columns of a panel, to which lines are reduced."""
_MARKER_COLUMNS, _CROWDED_MARKERS = 120, 80
"""Columns of markers in a panel, which are wider than a pixel; more markers than
``_CROWDED_MARKERS`` are drawn smaller."""
_SYMBOLS = {
    "x": "$x$",
    "x_s": "$x_s$",
    "x_c": "$x_c$",
    "x̂": r"$\hat{x}$",
    "‖x‖": r"$\|x\|$",
    "‖e_s‖": r"$\|e_s\|$",
    "‖e_c‖": r"$\|e_c\|$",
}
"""The symbols with which the names of curves begin, and how a figure writes them."""


# Curves, marks and bars


def draw_curve(axes: "Axes", curve: Curve, **style: Any) -> None:
    """Draw a curve of a run; ``style`` replaces its own."""
    symbol, _, source = curve.name.partition(" ")
    own: dict[str, Any] = {
        "label": f"{_SYMBOLS.get(symbol, symbol)} {source}".rstrip(),
        "colour": curve.style.colour,
        "linewidth": curve.style.width,
        "dash": curve.style.dash,
        "drawstyle": "steps-post" if curve.style.is_held else "default",
    }
    draw_line(axes, curve.t_s, curve.values, **(own | style))


def draw_line(axes: "Axes", x: Reals, y: Reals, colour: Colour, dash: Dash = (), **style: Any) -> None:
    """Draw a line through points (k,) with x ascending; a single point is a dot.

    ``style`` has matplotlib's words. Of a long line only the extremes of each pixel column are drawn.
    """
    y = _for_log_axis(y) if axes.get_yscale() == "log" else finite(y)
    keep = decimate(x, y, _COLUMNS)
    if len(keep) < len(x):
        style.pop("drawstyle", None)  # steps between the remaining points would be wrong
    if np.isfinite(y).sum() == 1:
        style["marker"] = "o"
    axes.plot(x[keep], y[keep], color=rgb(colour), linestyle=(0, dash) if dash else "-", **style)


def draw_marks(
    axes: "Axes",
    x: Reals,
    y: Reals,
    colour: Colour,
    *,
    stems: Colour | None = None,
    marker: str = "o",
    markersize: float = 5.0,
    **style: Any,
) -> None:
    """Draw points (k,) with x ascending; many are smaller, and only those that can be told apart.

    ``stems`` is the colour of lines from 0 to each point; ``style`` has matplotlib's words.
    """
    x = finite(x, positive=axes.get_xscale() == "log")
    y = finite(y, positive=axes.get_yscale() == "log")
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    if not len(x):
        return
    keep = decimate(x, y, _MARKER_COLUMNS)
    x, y = x[keep], y[keep]
    markersize *= min(max(math.sqrt(_CROWDED_MARKERS / len(keep)), 0.4), 1.0)
    if stems is not None:
        feet = np.column_stack([np.zeros(len(x)), y, np.full(len(x), np.nan)])
        axes.plot(np.repeat(x, 3), feet.ravel(), linewidth=1.0, color=rgb(stems))
    style |= {"marker": marker, "markersize": markersize, "linestyle": "none"}
    axes.plot(x, y, color=rgb(colour), clip_on=False, **style)


def draw_points(
    axes: "Axes", x: Reals, y: Reals, x_error: Reals, y_error: Reals, colour: Colour, **style: Any
) -> None:
    """Draw points (k,) with intervals: half-widths (k,), or (2, k) distances to both ends."""
    known = np.isfinite(x) & np.isfinite(y)
    if known.any():
        axes.errorbar(
            x[known], y[known], y_error[..., known], x_error[..., known], color=rgb(colour),
            linestyle="none", elinewidth=1.0, **style,
        )  # fmt: skip


def draw_band(axes: "Axes", x: Reals, low: Reals, high: Reals, colour: Colour, **style: Any) -> None:
    """Shade the area between two curves (k,)."""
    is_log = axes.get_yscale() == "log"
    low, high = finite(low, positive=is_log), finite(high, positive=is_log)
    if (np.isfinite(low) & np.isfinite(high)).any():
        axes.fill_between(x, low, high, color=rgb(colour), linewidth=0, **({"alpha": 0.25} | style))


def draw_bars(
    axes: "Axes", edges: Reals, heights: Reals, colour: Colour, share: float = 1.0, *,
    is_horizontal: bool = False, **style: Any
) -> None:  # fmt: skip
    """Draw bars (k,) between edges (k + 1,), each as wide as a share of the distance of its edges."""
    seen = heights != 0  # each bar is an artist: a million of them take minutes
    middles, widths = ((edges[1:] + edges[:-1]) / 2)[seen], (np.diff(edges) * share)[seen]
    if seen.any():
        (axes.barh if is_horizontal else axes.bar)(middles, heights[seen], widths, color=rgb(colour), **style)


def rgb(colour: Colour) -> tuple[float, float, float]:
    """Return a colour of the palette in matplotlib's format."""
    r, g, b = (part / 255 for part in colour)
    return r, g, b


def series_colour(i: int) -> Colour:
    """Return the colour of the i-th of several series without colours of their own."""
    return palette.SERIES[i % len(palette.SERIES)]


# Axes


def set_times(axes: "Axes", t_s: Reals, *, labelled: bool = True) -> None:
    """Let the horizontal axis be that of times (k,) in ascending order, from 0 if they begin near 0."""
    if len(t_s) and t_s[-1] > t_s[0]:
        axes.set_xlim(0.0 if 0 <= t_s[0] < 0.05 * t_s[-1] else float(t_s[0]), float(t_s[-1]))
    if labelled:
        axes.set_xlabel(TIME)
    else:
        axes.set_xlabel("")
        axes.tick_params(which="both", labelbottom=False)


def limit_decades(axes: "Axes", measured: Reals, decades: int) -> None:
    """End a logarithmic vertical axis within ``decades`` of the largest measured value."""
    measured = finite(measured, positive=True)
    if not np.isfinite(measured).any():
        return
    values = np.concatenate([np.asarray(line.get_ydata(), np.float64) for line in axes.lines])
    values = values[values > 1 / LARGEST]  # without what is drawn as zero
    decade = 10.0 ** math.floor(math.log10(np.nanmax(measured)))
    low = max(values.min(initial=np.inf), decade / 10**decades)
    high = min(values.max(initial=0.0), decade * 10**decades)
    if high > 0:
        _limit(axes, low, high)


def limit_to(axes: "Axes", values: Reals) -> None:
    """Let a logarithmic vertical axis show all values that it can, also if they are nearly equal."""
    shown = finite(values, positive=True)
    if np.isfinite(shown).any():
        _limit(axes, np.nanmin(shown), np.nanmax(shown))


def _limit(axes: "Axes", low: float, high: float) -> None:
    """Let a logarithmic vertical axis show what is between two values, and a margin."""
    margin = max((high / low) ** 0.05, 1.1)
    axes.set_ylim(float(low / margin), float(high * margin))


def whole_numbers(axes: "Axes", letter: str) -> None:
    """Write only whole numbers at an axis."""
    from matplotlib.ticker import MaxNLocator

    axis = axes.xaxis if letter == "x" else axes.yaxis
    axis.set_major_locator(MaxNLocator(integer=True, nbins="auto"))


def name_ticks(axes: "Axes", letter: str, names: Mapping[float, str]) -> None:
    """Write texts instead of numbers at an axis."""
    (axes.xaxis if letter == "x" else axes.yaxis).set_ticks([*names], labels=[*names.values()])


def mark_empty(axes: "Axes", text: str = "no data") -> None:
    """Write a text into axes without data."""
    if not np.isfinite(axes.dataLim.get_points()).all() and not axes.texts:
        axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center")
        axes.tick_params(left=False, labelleft=False, which="both")


# Values and texts


def finite(values: Reals, *, positive: bool = False) -> Reals:
    """Return values with NaN for infinite and huge ones, and, if ``positive``, for those not above 0.

    What is not above 1 / LARGEST counts as 0 there.
    """
    values = np.asarray(values, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        shown = np.abs(values) < LARGEST
        if positive:
            shown &= values > 1 / LARGEST
    return np.where(shown, values, np.nan)


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


def histogram(values: Reals, bins: int = 30) -> tuple[Reals, Reals]:
    """Return edges (bins + 1,) of a constant ratio, and the counts of positive values."""
    positive = finite(values, positive=True)
    positive = positive[np.isfinite(positive)]
    if not len(positive):
        return np.ones(1), np.zeros(0)
    low, high = math.log10(positive.min()), math.log10(positive.max())
    margin = max(0.05 * (high - low), 0.02)
    edges = np.logspace(low - margin, high + margin, bins + 1)
    return edges, np.histogram(positive, edges)[0].astype(np.float64)


def label_text(name: str, longest: int = 16) -> str:
    """Return a user's name for a label: no mathematical markup, one line, limited length."""
    line = " ".join(name.split())
    if len(line) > longest:
        line = line[: longest - 1] + "…"
    if line.startswith("_"):
        line = f" {line}"  # matplotlib hides such names from legends
    return line.replace("$", r"\$")
