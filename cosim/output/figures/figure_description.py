"""The content of a figure as plain data: rows of panels, their axes and their items.

Reports, pages of studies, files and notebooks draw a :class:`FigureDescription` by matplotlib
(:mod:`cosim.output.figures.figure_drawing`).
Arrays may have any length, including 0. Values that are not finite are drawn as gaps.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from cosim.output.curves import DASHED, SOLID, Dash
from cosim.output.figures import palette
from cosim.output.figures.palette import Colour
from cosim.record.align import Reals
from noack.core.linear_systems import Matrix

TIME = "time t [s]"
LARGEST = 1e150
"""Larger values are not drawn."""

MARKERS = "os^Dv<>PXph*"
"""Markers that distinguish series in addition to their colours, by matplotlib's names."""
Steps = Literal["", "pre", "mid", "post"]
"""Whether a curve is a staircase, and where its steps are."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Line:
    """A curve; a single point is a dot."""

    x: Reals
    """(k,) ascending."""
    y: Reals
    """(k,); on a logarithmic axis, the curve leaves the axis at its lower end where y is 0."""
    colour: Colour
    label: str = ""
    width: float = 1.3
    dash: Dash = SOLID
    opacity: float = 1.0
    steps: Steps = ""
    order: float = 2.0
    """A higher one is drawn in front."""
    marker: str = ""
    size: float = 5.0
    """Size of the marker."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Band:
    """The area between two curves."""

    x: Reals
    low: Reals
    high: Reals
    colour: Colour
    label: str = ""
    opacity: float = 0.25
    steps: Steps = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class Marks:
    """Points; many are drawn smaller, and reduced to those that can be told apart."""

    x: Reals
    y: Reals
    """(k,); not used with ``at_top``."""
    colour: Colour
    label: str = ""
    marker: str = "o"
    size: float = 5.0
    stroke: float = 1.0
    """Width of the marker's strokes."""
    order: float = 2.0
    opacity: float = 1.0
    stems: Colour | None = None
    """Colour of lines from 0 to each point; None: no lines."""
    framed: bool = False
    """Draw a thin edge, so that points which touch can be told apart."""
    at_top: bool = False
    """Draw the points at the upper end of the axes."""
    reduced: bool = True
    """Whether points that cannot be told apart are left out; x then ascends."""
    x_error: Reals | None = None
    """(k,) half-widths of intervals, or (2, k) their distances to low and high ends."""
    y_error: Reals | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Bars:
    """Bars between edges."""

    edges: Reals
    """(k + 1,)"""
    heights: Reals
    """(k,)"""
    colour: Colour
    label: str = ""
    opacity: float = 1.0
    share: float = 1.0
    """Width of a bar, as a share of the distance of its edges."""
    horizontal: bool = False
    numbers: bool = False
    """Write the height of each bar that is not 0 above it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Rule:
    """A straight line across the panel: a limit."""

    at: float
    colour: Colour
    label: str = ""
    vertical: bool = False
    dash: Dash = DASHED
    width: float = 1.6
    order: float = 2.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Spans:
    """Shaded intervals of the horizontal axis."""

    begin: Reals
    end: Reals
    colour: Colour
    opacity: float = 0.2


@dataclass(frozen=True, eq=False, kw_only=True)
class Heat:
    """A matrix as colours, on the figure's :class:`ColourScale`; NaN has no colour."""

    values: Matrix
    """(rows, columns); row i is drawn at the height i."""
    x_ends: tuple[float, float]
    downwards: bool = False
    """Whether the first row is the highest one."""
    numbers: bool = False
    """Write the values where there is room."""


Item = Line | Band | Marks | Bars | Rule | Spans | Heat


@dataclass(frozen=True, eq=False, kw_only=True)
class Axis:
    """An axis; its label ends with its unit, in brackets."""

    label: str = ""
    logarithmic: bool = False
    ends: tuple[float | None, float | None] = (None, None)
    """None: where the data end."""
    about: Reals | None = None
    """Measured values; parts of bounds and bands far from them are outside the axis."""
    decades: int = 0
    """Maximum decades of a logarithmic axis below and above the measured values; 0: no maximum."""
    whole: bool = False
    """Whether only whole numbers are written."""
    ticks: Mapping[float, str] | None = None
    """Texts instead of numbers."""
    numbers: bool = True
    """Whether numbers are written; False if the panel below shows those of the same axis."""
    grid: bool = True


@dataclass(frozen=True, eq=False, kw_only=True)
class Panel:
    """Two axes, and what is drawn between them; later items are in front."""

    items: Sequence[Item]
    x: Axis
    y: Axis
    title: str = ""
    legend: Sequence[str] | None = None
    """Labels in the legend, in order; None: all."""
    empty: str = "no data"
    """Text in a panel without data."""
    beside: "Panel | None" = None
    """A panel with the same vertical axis at the right: a histogram."""

    @property
    def labels(self) -> Sequence[str]:
        """Labels in the legend, in order."""
        if self.legend is not None:
            return self.legend
        return [*dict.fromkeys(filter(None, (getattr(item, "label", "") for item in self.items)))]


@dataclass(frozen=True, eq=False, kw_only=True)
class PanelRow:
    """Panels side by side; if the figure is too narrow for them, in several rows."""

    panels: Sequence[Panel]
    height_in: float
    """Height of the axes in a figure for the screen."""
    columns: int = 0
    """Largest number of panels side by side; 0: all."""
    narrowest_in: float = 0.0
    """Least width of a panel with its labels."""
    widest_in: float = math.inf
    """Largest width of the axes of a panel."""
    left_in: float = 0.0
    """Space for labels and numbers at the left of each panel; 0: the default."""
    common: Literal["", "x", "xy"] = ""
    """Axes with the same ends in all panels; their numbers are written once."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ColourScale:
    """The values that the colours of a figure stand for."""

    low: float
    high: float
    logarithmic: bool = False
    label: str = ""
    exceeded: bool = False
    """Whether there are values above ``high``."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FigureDescription:
    """A figure of a page, a file or a notebook."""

    name: str
    rows: Sequence[PanelRow]
    caption: str = ""
    description: str = ""
    """Text alternative of the figure; its caption by default."""
    heading: str = ""
    """Title of the whole figure; beside it is the legend of the first panel."""
    scale: ColourScale | None = None

    def captioned(self, caption: str, description: str = "") -> "FigureDescription":
        """Return the figure with a caption and a text alternative."""
        return replace(self, caption=caption, description=description)


def one_panel(name: str, panel: Panel, height_in: float) -> FigureDescription:
    """Describe a figure of one panel."""
    return FigureDescription(name=name, rows=[PanelRow(panels=[panel], height_in=height_in)])


def time_axis(t_s: Reals, *, numbers: bool = True, label: str = TIME) -> Axis:
    """Return the axis of times (k,) in ascending order, from 0 if they begin near 0."""
    ends: tuple[float | None, float | None] = (None, None)
    if len(t_s) and t_s[-1] > t_s[0]:
        start = 0.0 if 0 <= t_s[0] < 0.05 * t_s[-1] else float(t_s[0])
        ends = (start, float(t_s[-1]))
    return Axis(label=label if numbers else "", ends=ends, numbers=numbers)


def series_colour(i: int) -> Colour:
    """Return the colour of the i-th of several series without colours of their own."""
    return palette.SERIES[i % len(palette.SERIES)]


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


def log_ends(values: Reals, measured: Reals, decades: int) -> tuple[float, float] | None:
    """Return the ends of a logarithmic axis, within ``decades`` of the largest measured value."""
    measured = finite(measured, positive=True)
    if not np.isfinite(measured).any():
        return None
    values = values[values > 1 / LARGEST]  # without what is drawn as zero
    decade = 10.0 ** math.floor(math.log10(np.nanmax(measured)))
    low, high = max(values.min(), decade / 10**decades), min(values.max(), decade * 10**decades)
    margin = max((high / low) ** 0.05, 1.1)
    return float(low / margin), float(high * margin)


def near_ends(ends: tuple[float, float], measured: Reals) -> tuple[float, float]:
    """Return the ends of a linear axis, moved to near the measured values."""
    values = np.append(finite(measured), 0.0)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    room = 0.25 * (high - low) or 1.0
    return max(ends[0], low - room), min(ends[1], high + room)


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
    return line.replace("$", r"\$")
