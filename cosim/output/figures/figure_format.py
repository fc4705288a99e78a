"""The formats and widths of figures; a module of its own: the command line needs no matplotlib."""

from enum import StrEnum
from typing import NamedTuple

from netem.core.errors import CallerError
from netem.core.number_checks import one_of

SCREEN_IN = 10.0
"""Width of a figure on a page of noack, in inches."""
PHONE_IN = 3.5
"""Width of the same figure on a narrow screen: its texts, of 8 points, become 11 pixels there."""
WIDTHS_IN = {"column": 3.5, "page": 7.16}
"""Widths in a paper of two columns (IEEE), in inches."""
_NARROWEST_IN, _WIDEST_IN = 3.0, 20.0


class FigureFormat(StrEnum):
    """Formats of figures; a PDF has the fonts of printed papers."""

    SVG = "svg"
    PNG = "png"
    PDF = "pdf"


class FigureFiles(NamedTuple):
    """The files of figures that are written beside a page."""

    kind: FigureFormat
    width_in: float


def requested_files(kind: str | None, width: str | float | None = None) -> FigureFiles | None:
    """Return format and width of figures; None without a format.

    Raises:
        CallerError: there is no such format or width, or a width without a format.
    """
    if kind is None:
        if width is not None:
            raise CallerError("--width: is the width of the figures of --format; give one")
        return None
    one_of("format", kind, FigureFormat)
    return FigureFiles(FigureFormat(kind), figure_width_in(FigureFormat(kind), width))


def figure_width_in(kind: FigureFormat, width: str | float | None) -> float:
    """Return the width of a figure in inches.

    Args:
        kind: its format; by default a PDF is as wide as a column.
        width: ``column``, ``page`` or inches; None for the default.

    Raises:
        CallerError: there is no such width.
    """
    if width is None:
        return WIDTHS_IN["column"] if kind is FigureFormat.PDF else SCREEN_IN
    if width in WIDTHS_IN:
        return WIDTHS_IN[str(width)]
    try:
        inches = float(width)
    except ValueError:
        inches = 0.0
    if not _NARROWEST_IN <= inches <= _WIDEST_IN:
        raise CallerError(
            f"width {width}: expected column, page, or inches from {_NARROWEST_IN:g} to {_WIDEST_IN:g}"
        )
    return inches
