"""The formats of figures; a module of its own, since the command line needs no matplotlib."""

from enum import StrEnum


class FigureFormat(StrEnum):
    """Formats of figures; pdf and pgf have the fonts of LaTeX."""

    SVG = "svg"
    PNG = "png"
    PDF = "pdf"
    PGF = "pgf"
