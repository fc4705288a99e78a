"""Layout of all figures drawn by matplotlib: sizes that follow from their width, and places.

A page of noack shows figures of 10 inches. A paper prints them as wide as a column or a page, where
texts must keep a size that one can read: a figure is laid out for its width, not scaled to it.
Panels and the rows of their legends have fixed places in inches (:func:`place_panels`), which need
no layout engine, align the figures of a page, and give the same figure the same bytes.
This module does not use pyplot, and does not change matplotlib's global settings permanently.
"""

import io
import logging
import math
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
from matplotlib.figure import Figure

from cosim.output.figures.figure_description import Axis, FigureDescription, Panel, PanelRow
from cosim.output.figures.figure_format import SCREEN_IN
from cosim.output.figures.palette import Colour

# Warnings of no use here: that matplotlib cannot write its cache, and of the dates in fonts.
for library in ("matplotlib", "fontTools"):
    logging.getLogger(library).setLevel(logging.ERROR)

Rgb = tuple[float, float, float]

INK, GRID, PAPER = "#1b1f24", "#d9dde3", "#fefefe"
"""Text and frames, grid lines, background, as in the style files; a page replaces them."""

_EM_PER_CHARACTER = 0.6
"""Mean width of a character of a legend."""
POINTS_PER_IN = 72
_STYLES = Path(__file__).with_name("styles")


class FigureLayout(NamedTuple):
    """Sizes in a figure of one width; those that end in ``_in`` are inches."""

    width_in: float
    left_in: float = 1.15
    """Space for labels and ticks at the left of axes."""
    right_in: float = 0.2
    below_in: float = 0.55
    above_in: float = 0.34
    """Space for the title above axes."""
    gap_in: float = 0.22
    """Space between two panels, one above the other, without labels between them."""
    legend_row_in: float = 0.19
    handle_in: float = 0.6
    """Width of an entry of a legend without its text."""
    scale: float = 1.0
    """Factor of the heights of axes."""
    beside_scale: float = 1.0
    """Factor of the widths of panels beside other ones."""
    line_scale: float = 1.0
    """Factor of the widths of lines and of the sizes of markers."""
    beside_title: bool = True
    """Whether there is room for a legend beside the title; else it is below the title."""
    latex: bool = False
    """Whether texts have the fonts of LaTeX."""

    @property
    def character_in(self) -> float:
        """Mean width of a character of a legend, within :func:`matplotlib_settings`."""
        return _EM_PER_CHARACTER * float(mpl.rcParams["legend.fontsize"]) / POINTS_PER_IN

    @property
    def is_paper(self) -> bool:
        """Whether the figure is narrower than on a screen."""
        return self.width_in < SCREEN_IN

    @property
    def styles(self) -> Iterator[str]:
        """The names of its style files."""
        yield "screen"
        if self.is_paper:
            yield "paper"
        if self.latex:
            yield "latex"


_SCREEN = FigureLayout(SCREEN_IN)
_LAYOUT: ContextVar[FigureLayout] = ContextVar("figure_layout", default=_SCREEN)
_ROOM_BESIDE_TITLE_IN = 5.0
"""Least width of a figure in which legends are beside titles."""
_LEAST_SCALE, _LEAST_BESIDE_SCALE = 0.6, 0.4
"""Least factors of the heights of axes, and of the widths of panels beside others."""


def layout() -> FigureLayout:
    """Return the sizes of the figures that are drawn now."""
    return _LAYOUT.get()


@contextmanager
def use_figure_width(width_in: float, *, latex: bool = False) -> Iterator[None]:
    """Draw and save figures of this width, perhaps with the fonts of LaTeX, within the context."""
    is_paper = width_in < SCREEN_IN
    wanted = _paper_layout(width_in) if is_paper else _SCREEN._replace(width_in=width_in)
    token = _LAYOUT.set(wanted._replace(latex=latex))
    try:
        yield
    finally:
        _LAYOUT.reset(token)


def _paper_layout(width_in: float) -> FigureLayout:
    """Return the layout of a figure in a paper, with texts of 8 points."""
    return FigureLayout(
        width_in,
        left_in=0.76,
        right_in=0.17,
        below_in=0.42,
        above_in=0.24,
        gap_in=0.16,
        legend_row_in=0.155,
        handle_in=0.4,
        scale=min(max(width_in / SCREEN_IN, _LEAST_SCALE), 1.0),
        line_scale=0.65,
        beside_scale=max(width_in / SCREEN_IN, _LEAST_BESIDE_SCALE),
        beside_title=width_in >= _ROOM_BESIDE_TITLE_IN,
    )


@contextmanager
def matplotlib_settings() -> Iterator[None]:
    """Apply the layout's style files only, not the user's matplotlibrc, within the context."""
    with mpl.rc_context(), warnings.catch_warnings():
        mpl.rcdefaults()
        for name in layout().styles:
            mpl.rcParams.update(_style(name))
        # A name may use characters that the font lacks; they are drawn as boxes, without a warning.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield


@cache
def _style(name: str) -> mpl.RcParams:
    return mpl.rc_params_from_file(_STYLES / f"{name}.mplstyle", use_default_template=False)


class NotebookFigure(Figure):
    """A figure that a notebook shows although it was not created by pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        with matplotlib_settings():
            self.savefig(buffer, format="png")
        return buffer.getvalue()


def rgb(colour: Colour) -> Rgb:
    """Return a colour of the palette in matplotlib's format."""
    r, g, b = (part / 255 for part in colour)
    return r, g, b


# Places of panels

BAR_IN = 0.2
"""Width of the bar that explains the colours."""
_BESIDE_IN, _BESIDE_GAP_IN = 2.0, 0.27
"""Width of a panel beside another one, and the gap between them."""
_UNTITLED_IN = 0.08
"""Height above axes without title and legend."""
_TITLE_CHARACTERS = 31
"""Room for a title beside a legend."""
_SHORT_LABELS = (
    ("certified for every plant of the uncertainty ", "certified: "),
    ("certified for the scenario's ", "certified: "),
    ("bound, given ", "given "),
)
"""Parts of the labels of bounds, and what the legends of papers have instead."""
_MARKUP = re.compile(r"[$\\{}^_]|(?<=\\)\w+")


class FigureBox(NamedTuple):
    """A rectangle in inches, from the figure's upper left corner."""

    left: float
    top: float
    width: float
    height: float


class Place(NamedTuple):
    """A panel and its axes."""

    panel: Panel
    box: FigureBox
    has_x: bool
    """Whether the horizontal axis has its label and numbers here."""
    has_y: bool
    is_beside: bool = False
    """Whether it has the vertical axis of the place before it."""


def place_panels(description: FigureDescription) -> tuple[list[Place], tuple[float, float]]:
    """Place the panels; return them, and width and height of the figure in inches."""
    space, places = layout(), list[Place]()
    top_in = 0.0
    if description.heading:
        top_in = _head_in(description.rows[0].panels[0].labels, space.width_in)
    right_in = space.right_in + (4 * BAR_IN if description.scale is not None else 0.0)
    for row in description.rows:
        columns = _columns(row, space.width_in)
        for first in range(0, len(row.panels), columns):
            has_heading = bool(description.heading) and not places
            line = _place_line(row, first, columns, top_in, right_in, has_heading=has_heading)
            places += line
            box = line[0].box
            numbered = any(place.has_x for place in line)
            top_in = box.top + box.height + (space.below_in if numbered else space.gap_in)
            top_in += max(turned_in(place.panel.x, place.box.width) for place in line)
    return places, (space.width_in, top_in)


def _columns(row: PanelRow, room_in: float) -> int:
    columns = min(row.columns or len(row.panels), len(row.panels))
    return max(min(columns, int(room_in / row.narrowest_in)), 1) if row.narrowest_in else columns


def _place_line(
    row: PanelRow, first: int, columns: int, top_in: float, right_in: float, *, has_heading: bool
) -> list[Place]:
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
    places = []
    for i, panel in enumerate(panels):
        begin_in, main_in = left_in + i * (share_in + further_in), _main_width_in(panel, width_in)
        is_last = first + i + columns >= len(row.panels)
        has_x = panel.x.numbers and (is_last or not row.common)
        has_y = panel.y.numbers and (i == 0 or row.common != "xy")
        places.append(Place(panel, FigureBox(begin_in, top_in, main_in, height_in), has_x, has_y))
        if panel.beside is not None:
            main_in += _BESIDE_GAP_IN
            box = FigureBox(begin_in + main_in, top_in, width_in - main_in, height_in)
            places.append(Place(panel.beside, box, has_x, has_y=False, is_beside=True))
    return places


def _panel_head_in(panel: Panel, width_in: float, *, is_first: bool) -> float:
    """Return the height above a panel; none below another one, without title and legend."""
    if not (panel.title or panel.labels or is_first):
        return 0.0
    return _head_in(panel.labels, _main_width_in(panel, width_in), titled=bool(panel.title))


def _main_width_in(panel: Panel, width_in: float) -> float:
    """Return the width of a panel without the one beside it."""
    if panel.beside is None:
        return width_in
    return width_in - _BESIDE_IN * layout().beside_scale - _BESIDE_GAP_IN


def _left_in(panel: Panel) -> float:
    """Return the room for label and numbers at the left of a panel."""
    space, texts = layout(), (panel.y.ticks or {}).values()
    label_in = 2 * space.character_in if panel.y.label else 0.0
    longest_in = max(map(len, texts), default=0) * space.character_in
    return max(space.left_in, longest_in + BAR_IN + label_in)


def turned_in(axis: Axis, width_in: float) -> float:
    """Return the height of the texts at a horizontal axis turned by 45°; 0 if they have room."""
    texts = (axis.ticks or {}).values()
    longest_in = max(map(len, texts), default=0) * layout().character_in
    return longest_in * math.sin(math.pi / 4) if len(texts) * longest_in > width_in else 0.0


def _head_in(labels: Sequence[str], width_in: float, *, titled: bool = True) -> float:
    """Return the height of title and legend above axes of this width."""
    space = layout()
    title_in = space.above_in if titled or (space.beside_title and labels) else _UNTITLED_IN
    rows = len(legend_rows(labels, width_in))
    return title_in + space.legend_row_in * (max(rows - 1, 0) if space.beside_title else rows)


def legend_rows(labels: Iterable[str], width_in: float) -> list[list[int]]:
    """Return which entries are in each row of a legend, in their order.

    A legend is beside the title, or below it as wide as the figure.
    """
    space = layout()
    room_in = width_in - _TITLE_CHARACTERS * space.character_in
    if not space.beside_title:
        room_in = space.width_in - 2 * space.right_in
    rows, left_in = list[list[int]](), 0.0
    for number, label in enumerate(labels):
        entry_in = space.handle_in + space.character_in * len(_MARKUP.sub("", legend_text(label)))
        if entry_in > left_in:
            rows.append([])
            left_in = room_in
        rows[-1].append(number)
        left_in -= entry_in
    return rows


def legend_text(label: str) -> str:
    """Return a label as legends have it: in papers, that of a bound is shorter."""
    for long, brief in _SHORT_LABELS if layout().is_paper else ():
        label = label.replace(long, brief)
    return label
