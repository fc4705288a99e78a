"""Figures as files and as parts of a page; the same figure gives the same bytes."""

import base64
import io
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable
from pathlib import Path

from matplotlib.figure import Figure

from cosim.output.figure_format import FigureFiles, FigureFormat, figure_width_in
from cosim.output.report.figure_layout import figure_width
from cosim.output.report.figure_style import (
    GRID,
    INK,
    PAPER,
    characters_of_paper_fonts,
    paper_fonts,
    settings,
)
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


FIGURE_SUFFIXES = tuple(f".{one}" for one in FigureFormat)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure in the format of the file's ending; the same figure gives the same bytes.

    Raises:
        CallerError: another ending than .svg, .png or .pdf.
        MachineError: the file cannot be written.
    """
    kind = _kind_of(path)
    if kind is FigureFormat.PDF:
        with paper_fonts(figure), characters_of_paper_fonts(figure):
            content = _saved(figure, kind)
        write_whole(path, content)
    else:
        write_whole(path, _drawn(figure, kind))


def save_figures(
    figures: Iterable[tuple[str, Figure]], page: Path, files: FigureFiles | None
) -> list[Path]:
    """Write the figures of a page, given with their names, into ``PAGE-figures`` beside it.

    Args:
        figures: they are drawn for the width of the files: an iterator that draws them.
        page: the page.
        files: their format and width; None to write none.

    Returns:
        The written files; none without a format.

    Raises:
        MachineError: a file cannot be written.
    """
    written: list[Path] = []
    if files is not None:
        with figure_width(files.width_in):
            for name, figure in figures:
                written.append(page.with_name(f"{page.stem}-figures") / f"{name}.{files.kind}")
                save_figure(figure, written[-1])
    return written


def save_drawn(draw: Callable[[], Figure], path: Path, width: str | float | None = None) -> None:
    """Draw a figure for the width of a file, and write it; see :func:`save_figure`.

    Args:
        draw: draws the figure.
        path: of the file.
        width: ``column``, ``page`` or inches; by default that of the file's format.

    Raises:
        CallerError: another ending than that of a format, or there is no such width.
        MachineError: the file cannot be written.
    """
    with figure_width(figure_width_in(_kind_of(path), width)):
        save_figure(draw(), path)


def _kind_of(path: Path) -> FigureFormat:
    if path.suffix not in FIGURE_SUFFIXES:
        raise CallerError(f"{path}: a figure is saved as {', '.join(FIGURE_SUFFIXES)}")
    return FigureFormat(path.suffix.removeprefix("."))


def inline(figure: Figure, name: str, description: str) -> str:
    """Return a figure as HTML: SVG with the page's colours, or PNG if the SVG would be large.

    Args:
        figure: the figure.
        name: a word, which makes the figure's ids unique on the page.
        description: text alternative of the figure.
    """
    text = _page_svg(_drawn(figure, "svg"), name, description)
    if len(text) <= _HEAVY_CHARACTERS:
        return text
    picture = base64.b64encode(_drawn(figure, "png")).decode()
    image = ET.Element("img", {"src": f"data:image/png;base64,{picture}", "alt": description})
    return ET.tostring(image, encoding="unicode")


def _drawn(figure: Figure, kind: str) -> bytes:
    with settings():
        return _saved(figure, kind)


def _saved(figure: Figure, kind: str) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, metadata=_UNDATED[kind])
    return buffer.getvalue()


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
                element.set(key, _REFERENCE.sub(lambda found: f"{name}-{found[0]}", value))
    view = root.attrib["viewBox"]
    root.attrib.clear()
    root.attrib.update({"viewBox": view, "role": "img", "aria-label": description})
    return ET.tostring(root, encoding="unicode")
