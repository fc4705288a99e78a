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
from functools import cache
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
from matplotlib.figure import Figure

from cosim.output.figure_format import SCREEN_IN
from cosim.output.palette import Colour

# Warnings of no use here: that matplotlib cannot write its cache, and of the dates in fonts.
for library in ("matplotlib", "fontTools"):
    logging.getLogger(library).setLevel(logging.ERROR)

Rgb = tuple[float, float, float]

INK, GRID, PAPER = "#1b1f24", "#d9dde3", "#fefefe"
"""Text and frames, grid lines, background, as in the style files; a page replaces them."""

_EM_PER_CHARACTER = 0.6
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
        """Mean width of a character of a legend, within :func:`settings`."""
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
        legend_row_in=0.155, handle_in=0.4,
        scale=min(max(width_in / SCREEN_IN, _LEAST_SCALE), 1.0), line_scale=0.65,
        beside_scale=max(width_in / SCREEN_IN, _LEAST_BESIDE),
        beside_title=width_in >= _ROOM_BESIDE_TITLE_IN,
    )  # fmt: skip


@contextmanager
def settings() -> Iterator[None]:
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
        with settings():
            self.savefig(buffer, format="png")
        return buffer.getvalue()


def rgb(colour: Colour) -> Rgb:
    """Return a colour of the palette in matplotlib's format."""
    r, g, b = (part / 255 for part in colour)
    return r, g, b
