"""Figures as files and as parts of a page; the same figure gives the same bytes."""

import base64
import io
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path

from cosim.output.figures.figure_format import SCREEN_IN, FigureFiles, FigureFormat, figure_width_in
from cosim.output.figures.page_figure import GRID, INK, PAPER, PageFigure, figure_style
from cosim.record.run_directory import write_output
from netem.core.errors import CallerError

_WITHOUT_DATE: dict[FigureFormat, dict[str, str | None]] = {
    FigureFormat.SVG: {"Date": None, "Creator": None, "Format": None, "Type": None},
    FigureFormat.PNG: {"Software": None},
    FigureFormat.PDF: {"Creator": None, "Producer": None, "CreationDate": None},
}
"""Metadata that are left out: they differ between days, and between versions of matplotlib."""
_MOST_SVG_CHARACTERS = 400_000
_REFERENCE = re.compile(r"(?<=#)[^)]+")
"""The id to which an attribute refers."""
_FURTHER_DIGITS = re.compile(r"(\.\d\d)\d+")
_PAGE_COLOURS = {INK: "var(--ink)", GRID: "var(--grid)", PAPER: "var(--paper)"}

FIGURE_SUFFIXES = tuple(f".{kind}" for kind in FigureFormat)


def save_figure(figure: PageFigure, path: Path, width: str | float | None = None) -> None:
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
    write_output(path, file_content(figure, kind, figure_width_in(kind, width)))


def save_figures(figures: Iterable[PageFigure], page: Path, files: FigureFiles | None) -> list[Path]:
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


def file_content(figure: PageFigure, kind: FigureFormat, width_in: float = SCREEN_IN) -> bytes:
    """Return a figure as the content of a file; a PDF has the fonts of printed papers."""
    buffer, is_print = io.BytesIO(), kind is FigureFormat.PDF
    with figure_style(width_in, is_print=is_print):
        drawing = figure.draw(width_in, is_print=is_print)
        drawing.savefig(buffer, format=kind, metadata=_WITHOUT_DATE[kind])
    return buffer.getvalue()


def inline(figure: PageFigure, width_in: float = SCREEN_IN) -> str:
    """Return a figure as HTML: SVG with the page's colours, or PNG if the SVG would be large.

    The figure's name, a word, and its width make its ids unique on the page.
    """
    description = figure.description or figure.caption
    name = figure.name if width_in == SCREEN_IN else f"{figure.name}-{width_in:g}in"
    text = _page_svg(file_content(figure, FigureFormat.SVG, width_in), name, description)
    if len(text) <= _MOST_SVG_CHARACTERS * min(width_in / SCREEN_IN, 1.0):
        return text
    picture = base64.b64encode(file_content(figure, FigureFormat.PNG, width_in)).decode()
    image = ET.Element("img", {"src": f"data:image/png;base64,{picture}", "alt": description})
    return ET.tostring(image, encoding="unicode")


def _page_svg(svg: bytes, name: str, description: str) -> str:
    root = ET.fromstring(svg)
    for parent in root.iter():
        for child in list(parent):
            if child.tag.endswith("}style"):  # it would apply to the whole page
                parent.remove(child)
    referred_ids = {
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
                if value in referred_ids:
                    element.set(key, f"{name}-{value}")
            elif key == "style":
                for ink, colour in _PAGE_COLOURS.items():
                    value = value.replace(ink, colour)
                element.set(key, value)
            elif key == "d":
                element.set(key, _FURTHER_DIGITS.sub(r"\1", value).replace("\n", ""))
            else:
                element.set(key, _REFERENCE.sub(lambda match: f"{name}-{match[0]}", value))
    view = root.attrib["viewBox"]
    root.attrib.clear()
    root.attrib.update({"viewBox": view, "role": "img", "aria-label": description})
    return ET.tostring(root, encoding="unicode")
