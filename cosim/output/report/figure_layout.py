"""The width of figures, and the sizes that follow from it.

A page of noack shows figures of 10 inches. A paper prints them as wide as a column or a page, where
texts must keep a size that one can read: a figure is laid out for its width, not scaled to it.
"""

import re
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cosim.output.figure_format import SCREEN_IN

_PAPER_DPI = 600  # what publishers require of line art
_EM_PER_CHARACTER = 0.6
_EM_PER_CHARACTER_OF_LABEL = 0.5  # a label of an axis may be a little longer than the axis
_POINTS_PER_IN = 72


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
    text_pt: float = 9.0
    """Size of ticks and legends."""
    label_pt: float = 10.0
    title_pt: float = 10.5
    scale: float = 1.0
    """Factor of the heights of axes."""
    beside_scale: float = 1.0
    """Factor of the widths of panels beside other ones."""
    line_scale: float = 1.0
    """Factor of the widths of lines and of the sizes of markers."""
    beside_title: bool = True
    """Whether there is room for a legend beside the title; else it is below the title."""

    @property
    def character_in(self) -> float:
        """Mean width of a character of a legend."""
        return _EM_PER_CHARACTER * self.text_pt / _POINTS_PER_IN

    @property
    def is_paper(self) -> bool:
        """Whether the figure is narrower than on a screen."""
        return self.width_in < SCREEN_IN

    def settings(self) -> dict[Any, Any]:
        """Return matplotlib's settings for these sizes."""
        sizes = {
            "axes.labelsize": self.label_pt,
            "axes.titlesize": self.title_pt,
            "font.size": self.label_pt,
            "legend.fontsize": self.text_pt,
            "xtick.labelsize": self.text_pt,
            "ytick.labelsize": self.text_pt,
        }
        if not self.is_paper:
            return sizes
        return sizes | {
            "axes.labelpad": 3.0,
            "axes.linewidth": 0.6,
            "axes.titlepad": 4.0,
            "grid.linewidth": 0.5,
            "legend.columnspacing": 1.0,
            "legend.handlelength": 1.7,
            "legend.handletextpad": 0.5,
            "legend.labelspacing": 0.3,
            "savefig.dpi": _PAPER_DPI,
            "xtick.major.pad": 2.5,
            "ytick.major.pad": 2.5,
        }


_SCREEN = FigureLayout(SCREEN_IN)
_WIDTH: ContextVar[FigureLayout] = ContextVar("figure_layout", default=_SCREEN)
_ROOM_BESIDE_TITLE_IN = 5.0
_LEAST_SCALE, _LEAST_BESIDE = 0.6, 0.4
_SHORTEST_LINE = 8
_UNIT, _NO_BREAK = re.compile(r"\[[^]]*\]"), "\N{NO-BREAK SPACE}"


def layout() -> FigureLayout:
    """Return the sizes of the figures that are drawn now."""
    return _WIDTH.get()


@contextmanager
def figure_width(width_in: float) -> Iterator[None]:
    """Draw and save figures of this width within the context."""
    token = _WIDTH.set(_of_paper(width_in) if width_in < SCREEN_IN else _wide(width_in))
    try:
        yield
    finally:
        _WIDTH.reset(token)


def _wide(width_in: float) -> FigureLayout:
    return _SCREEN._replace(width_in=width_in)


def _of_paper(width_in: float) -> FigureLayout:
    """Return the layout of a figure in a paper, with texts of 8 points."""
    return FigureLayout(
        width_in, left_in=0.76, right_in=0.17, below_in=0.42, above_in=0.24, gap_in=0.16,
        legend_row_in=0.155, handle_in=0.4, text_pt=8.0, label_pt=8.0, title_pt=8.0,
        scale=min(max(width_in / SCREEN_IN, _LEAST_SCALE), 1.0), line_scale=0.65,
        beside_scale=max(width_in / SCREEN_IN, _LEAST_BESIDE),
        beside_title=width_in >= _ROOM_BESIDE_TITLE_IN,
    )  # fmt: skip


def fit_to_paper(figure: Figure) -> None:
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
