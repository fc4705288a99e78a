"""Style of all figures: settings of matplotlib and colours.

This module does not use pyplot, and does not change matplotlib's global settings permanently.
"""

import functools
import io
import logging
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any, ParamSpec

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter

from cosim.output.palette import Colour
from cosim.output.report.figure_layout import fit_to_paper, layout

P = ParamSpec("P")
Rgb = tuple[float, float, float]

INK, GRID, PAPER = "#1b1f24", "#d9dde3", "#fefefe"
"""Text and frames, grid lines, background; a page replaces them in dark mode."""

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
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.titley": 1.0,
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


_PAPER_SETTINGS: dict[Any, Any] = {
    "font.family": ["cmr10", "DejaVu Serif"],  # the second one has what the first one lacks
    "mathtext.fontset": "cm",
    "pdf.fonttype": 42,  # publishers refuse fonts of type 3
}
_DOLLAR = re.compile(r"(?<!\\)\$")
_BOLD = ["cmb10", "DejaVu Serif"]
_ELSEWHERE = str.maketrans({
    "_": r"$\_$", "<": "$<$", ">": "$>$", "|": "$|$", "{": r"$\{$", "}": r"$\}$", '"': "''",
})  # fmt: skip
"""Characters at whose places Computer Modern has others; its mathematical fonts have them."""


@contextmanager
def settings(extra: Mapping[Any, Any] | None = None) -> Iterator[None]:
    """Apply only these settings within the context, regardless of the user's matplotlibrc."""
    with mpl.rc_context(), warnings.catch_warnings():
        mpl.rcdefaults()
        mpl.rcParams.update(_SETTINGS | layout().settings() | dict(extra or {}))
        # A name may use characters that the font lacks; they are drawn as boxes, without a warning.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield


@contextmanager
def paper_fonts(figure: Figure) -> Iterator[None]:
    """Give a figure the fonts of LaTeX within the context, in which it is saved."""
    log = logging.getLogger("fontTools")  # warns of the dates in these fonts
    level = log.level
    with settings(_PAPER_SETTINGS):
        log.setLevel(logging.ERROR)
        _set_fonts(figure, _PAPER_SETTINGS)
        try:
            yield
        finally:
            _set_fonts(figure, _SETTINGS)
            log.setLevel(level)


@contextmanager
def characters_of_paper_fonts(figure: Figure) -> Iterator[None]:
    """Write the characters that Computer Modern lacks as mathematics within the context."""
    texts = [(text, text.get_text()) for text in figure.findobj(Text) if isinstance(text, Text)]
    axes = [axis for one in figure.axes for axis in (one.xaxis, one.yaxis)]
    named = [one for axis in axes if isinstance(one := axis.get_major_formatter(), FuncFormatter)]
    labels = [(one, one.func) for one in named]
    for text, content in texts:
        text.set_text(_with_mathematics(content))
    for one, name_of in labels:
        one.func = partial(_name_with_mathematics, name_of)
    try:
        yield
    finally:
        for text, content in texts:
            text.set_text(content)
        for one, name_of in labels:
            one.func = name_of


def _name_with_mathematics(name_of: Callable[..., str], *tick: Any) -> str:
    return _with_mathematics(name_of(*tick))


def _with_mathematics(text: str) -> str:
    """Replace characters outside the mathematics of a text, which is between dollars."""
    parts = _DOLLAR.split(text)
    return "$".join(part if i % 2 else part.translate(_ELSEWHERE) for i, part in enumerate(parts))


def _set_fonts(figure: Figure, wanted: Mapping[Any, Any]) -> None:
    """Set the fonts of all texts; matplotlib reads the settings when it makes a text only."""
    for text in figure.findobj(Text):
        is_paper = wanted is _PAPER_SETTINGS and text.get_fontweight() == "bold"
        text.set_fontfamily(_BOLD if is_paper else wanted["font.family"])
        text.set_math_fontfamily(wanted["mathtext.fontset"])


class NotebookFigure(Figure):
    """A figure that a notebook shows although it was not created by pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        with settings():
            self.savefig(buffer, format="png")
        return buffer.getvalue()


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Decorate a function that draws a figure: it draws with these settings."""

    @functools.wraps(draw)
    def drawn(*arguments: P.args, **options: P.kwargs) -> Figure:
        with settings():
            figure = draw(*arguments, **options)
            fit_to_paper(figure)
            return figure

    return drawn


def printed(colour: Colour) -> Rgb:
    """Return a colour of the palette in matplotlib's format."""
    r, g, b = (part / 255 for part in colour)
    return r, g, b
