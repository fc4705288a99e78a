"""Figures as files and as parts of a page; the same figure gives the same bytes."""

import base64
import io
import logging
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter

from cosim.output.figure_description import FigureDescription
from cosim.output.figure_drawing import draw
from cosim.output.figure_format import FigureFiles, FigureFormat, figure_width_in
from cosim.output.figure_style import GRID, INK, PAPER, figure_width, settings
from noack.core.errors import CallerError
from noack.core.file_access import write_whole

_UNDATED: dict[str, dict[str, str | None]] = {
    "svg": {"Date": None, "Creator": None, "Format": None, "Type": None},
    "png": {"Software": None},
    "pdf": {"Creator": None, "Producer": None, "CreationDate": None},
}
_HEAVY_CHARACTERS = 400_000
_REFERENCE = re.compile(r"(?<=#)[^)]+")
_TAIL = re.compile(r"(\.\d\d)\d+")
_BY_PAGE = {INK: "var(--ink)", GRID: "var(--grid)", PAPER: "var(--paper)"}
_PAPER_SETTINGS: dict[Any, Any] = {
    "font.family": ["cmr10", "DejaVu Serif"],  # the second one has what the first one lacks
    "mathtext.fontset": "cm",
    "pdf.fonttype": 42,  # publishers refuse fonts of type 3
}
_SCREEN_FONTS = {"font.family": "sans-serif", "mathtext.fontset": "dejavusans"}
_DOLLAR = re.compile(r"(?<!\\)\$")
_BOLD = ["cmb10", "DejaVu Serif"]
_ELSEWHERE = str.maketrans({
    "_": r"$\_$", "<": "$<$", ">": "$>$", "|": "$|$", "{": r"$\{$", "}": r"$\}$", '"': "''",
})  # fmt: skip
"""Characters at whose places Computer Modern has others; its mathematical fonts have them."""

FIGURE_SUFFIXES = tuple(f".{kind}" for kind in FigureFormat)


def save_figure(figure: FigureDescription, path: Path, width: str | float | None = None) -> None:
    """Draw a figure for the width of a file, and write it in the format of the file's ending.

    Args:
        figure: what is drawn.
        path: of the file.
        width: ``column``, ``page`` or inches; by default that of the file's format.

    Raises:
        CallerError: another ending than .svg, .png or .pdf, or there is no such width.
        MachineError: the file cannot be written.
    """
    if path.suffix not in FIGURE_SUFFIXES:
        raise CallerError(f"{path}: a figure is saved as {', '.join(FIGURE_SUFFIXES)}")
    kind = FigureFormat(path.suffix.removeprefix("."))
    with figure_width(figure_width_in(kind, width)):
        write_whole(path, file_content(draw(figure), kind))


def save_figures(
    figures: Iterable[FigureDescription], page: Path, files: FigureFiles | None
) -> list[Path]:
    """Write the figures of a page into ``PAGE-figures`` beside it; return the written files.

    Args:
        figures: what is drawn.
        page: the page.
        files: their format and width; None to write none.

    Raises:
        MachineError: a file cannot be written.
    """
    written: list[Path] = []
    for figure in () if files is None else figures:
        assert files is not None
        path = page.with_name(f"{page.stem}-figures") / f"{figure.name}.{files.kind}"
        save_figure(figure, path, files.width_in)
        written.append(path)
    return written


def file_content(figure: Figure, kind: FigureFormat) -> bytes:
    """Return a figure of matplotlib as the content of a file; a PDF has the fonts of LaTeX."""
    fonts = _paper_fonts(figure) if kind is FigureFormat.PDF else nullcontext()
    with settings(), fonts:
        return _saved(figure, kind)


def _saved(figure: Figure, kind: str) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, metadata=_UNDATED[kind])
    return buffer.getvalue()


def inline(figure: FigureDescription) -> str:
    """Return a figure as HTML: SVG with the page's colours, or PNG if the SVG would be large."""
    return markup_of(draw(figure), figure.name, figure.description or figure.caption)


def markup_of(drawn: Figure, name: str, description: str) -> str:
    """Return a figure of matplotlib as HTML.

    Args:
        drawn: the figure.
        name: a word, which makes the figure's ids unique on the page.
        description: text alternative of the figure.
    """
    text = _page_svg(file_content(drawn, FigureFormat.SVG), name, description)
    if len(text) <= _HEAVY_CHARACTERS:
        return text
    picture = base64.b64encode(file_content(drawn, FigureFormat.PNG)).decode()
    image = ET.Element("img", {"src": f"data:image/png;base64,{picture}", "alt": description})
    return ET.tostring(image, encoding="unicode")


def _page_svg(drawn: bytes, name: str, description: str) -> str:
    root = ET.fromstring(drawn)
    for parent in root.iter():
        for child in list(parent):
            if child.tag.endswith("}style"):  # it would apply to the whole page
                parent.remove(child)
    referred = {
        reference
        for element in root.iter()
        for value in element.attrib.values()
        for reference in _REFERENCE.findall(value)
    }
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
        element.text = element.tail = None
        attributes = {key.rpartition("}")[2]: value for key, value in element.attrib.items()}
        element.attrib.clear()
        for key, value in attributes.items():
            if key == "id":
                if value in referred:
                    element.set(key, f"{name}-{value}")
            elif key == "style":
                for ink, own in _BY_PAGE.items():
                    value = value.replace(ink, own)
                element.set(key, value)
            elif key == "d":
                element.set(key, _TAIL.sub(r"\1", value).replace("\n", ""))
            else:
                element.set(key, _REFERENCE.sub(lambda match: f"{name}-{match[0]}", value))
    view = root.attrib["viewBox"]
    root.attrib.clear()
    root.attrib.update({"viewBox": view, "role": "img", "aria-label": description})
    return ET.tostring(root, encoding="unicode")


# The fonts of LaTeX


@contextmanager
def _paper_fonts(figure: Figure) -> Iterator[None]:
    """Give a figure the fonts of LaTeX within the context, in which it is saved."""
    log = logging.getLogger("fontTools")  # warns of the dates in these fonts
    level = log.level
    with settings(_PAPER_SETTINGS), characters_of_paper_fonts(figure):
        log.setLevel(logging.ERROR)
        _set_fonts(figure, _PAPER_SETTINGS)
        try:
            yield
        finally:
            _set_fonts(figure, _SCREEN_FONTS)
            log.setLevel(level)


@contextmanager
def characters_of_paper_fonts(figure: Figure) -> Iterator[None]:
    """Write the characters that Computer Modern lacks as mathematics within the context."""
    texts = [(text, text.get_text()) for text in figure.findobj(Text) if isinstance(text, Text)]
    formatters = [
        formatter
        for axes in figure.axes
        for axis in (axes.xaxis, axes.yaxis)
        if isinstance(formatter := axis.get_major_formatter(), FuncFormatter)
    ]
    labels = [(formatter, formatter.func) for formatter in formatters]
    for text, content in texts:
        text.set_text(_with_mathematics(content))
    for formatter, write in labels:
        formatter.func = partial(_label_with_mathematics, write)
    try:
        yield
    finally:
        for text, content in texts:
            text.set_text(content)
        for formatter, write in labels:
            formatter.func = write


def _label_with_mathematics(write: Callable[..., str], *tick: Any) -> str:
    return _with_mathematics(write(*tick))


def _with_mathematics(text: str) -> str:
    """Replace characters outside the mathematics of a text, which is between dollars."""
    parts = _DOLLAR.split(text)
    return "$".join(part if i % 2 else part.translate(_ELSEWHERE) for i, part in enumerate(parts))


def _set_fonts(figure: Figure, wanted: Mapping[Any, Any]) -> None:
    """Set the fonts of all texts; matplotlib reads the settings when it makes a text only."""
    for text in figure.findobj(Text):
        is_bold = wanted is _PAPER_SETTINGS and text.get_fontweight() == "bold"
        text.set_fontfamily(_BOLD if is_bold else wanted["font.family"])
        text.set_math_fontfamily(wanted["mathtext.fontset"])
