"""Style of all figures drawn by matplotlib: the sizes that follow from their width, and settings.

A page of noack shows figures of 10 inches. A paper prints them as wide as a column or a page, where
texts must keep a size that one can read: a figure is laid out for its width, not scaled to it.
This module does not use pyplot, and does not change matplotlib's global settings permanently.
"""

import io
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple

import matplotlib as mpl
from matplotlib.figure import Figure

from cosim.output.figure_format import SCREEN_IN
from cosim.output.palette import Colour

# Warnings of no use here: that matplotlib cannot write its cache, and of the dates in fonts.
for library in ("matplotlib", "fontTools"):
    logging.getLogger(library).setLevel(logging.ERROR)

Rgb = tuple[float, float, float]

INK, GRID, PAPER = "#1b1f24", "#d9dde3", "#fefefe"
"""Text and frames, grid lines, background; a page replaces them in dark mode."""

_PAPER_DPI = 600  # what publishers require of line art
_EM_PER_CHARACTER = 0.6
_POINTS_PER_IN = 72
_SETTINGS: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.edgecolor": INK,
    "axes.formatter.limits": (-4, 5),
    "axes.formatter.use_mathtext": True,
    "axes.facecolor": PAPER,
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "figure.dpi": 100,
    "figure.facecolor": PAPER,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "legend.borderaxespad": 0.3,
    "legend.borderpad": 0.0,
    "legend.columnspacing": 1.4,
    "legend.frameon": False,
    "legend.labelcolor": INK,
    "lines.linewidth": 1.3,
    "lines.markersize": 5,
    "mathtext.fontset": "dejavusans",
    "savefig.dpi": 120,  # 1200 pixels wide
    "svg.fonttype": "path",
    "svg.hashsalt": "noack",
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
}
_LATEX_FONTS: dict[Any, Any] = {
    "font.family": ["cmr10", "DejaVu Serif"],  # the second one has what the first one lacks
    "mathtext.fontset": "cm",
    "pdf.fonttype": 42,  # publishers refuse fonts of type 3
}


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
    latex: bool = False
    """Whether texts have the fonts of LaTeX."""

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
        sizes: dict[Any, Any] = {
            "axes.labelsize": self.label_pt,
            "font.size": self.label_pt,
            "legend.fontsize": self.text_pt,
            "xtick.labelsize": self.text_pt,
            "ytick.labelsize": self.text_pt,
        }
        sizes |= _LATEX_FONTS if self.latex else {}
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


def layout() -> FigureLayout:
    """Return the sizes of the figures that are drawn now."""
    return _WIDTH.get()


@contextmanager
def figure_width(width_in: float, *, latex: bool = False) -> Iterator[None]:
    """Draw and save figures of this width, perhaps with the fonts of LaTeX, within the context."""
    is_paper = width_in < SCREEN_IN
    wanted = _of_paper(width_in) if is_paper else _SCREEN._replace(width_in=width_in)
    token = _WIDTH.set(wanted._replace(latex=latex))
    try:
        yield
    finally:
        _WIDTH.reset(token)


def _of_paper(width_in: float) -> FigureLayout:
    """Return the layout of a figure in a paper, with texts of 8 points."""
    return FigureLayout(
        width_in, left_in=0.76, right_in=0.17, below_in=0.42, above_in=0.24, gap_in=0.16,
        legend_row_in=0.155, handle_in=0.4, text_pt=8.0, label_pt=8.0, title_pt=8.0,
        scale=min(max(width_in / SCREEN_IN, _LEAST_SCALE), 1.0), line_scale=0.65,
        beside_scale=max(width_in / SCREEN_IN, _LEAST_BESIDE),
        beside_title=width_in >= _ROOM_BESIDE_TITLE_IN,
    )  # fmt: skip


@contextmanager
def settings() -> Iterator[None]:
    """Apply only these settings within the context, regardless of the user's matplotlibrc."""
    with mpl.rc_context(), warnings.catch_warnings():
        mpl.rcdefaults()
        mpl.rcParams.update(_SETTINGS | layout().settings())
        # A name may use characters that the font lacks; they are drawn as boxes, without a warning.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield


class NotebookFigure(Figure):
    """A figure that a notebook shows although it was not created by pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        with settings():
            self.savefig(buffer, format="png")
        return buffer.getvalue()


def rgb(colour: Colour) -> Rgb:
    """Return a colour of the palette in matplotlib's format."""
    r, g, b = (part / 255 for part in colour)
    return r, g, b
