"""A figure of a page, a file or a notebook: its texts, and the function that draws it."""

import io
import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.output.figures.axes_parts import mark_empty
from cosim.output.figures.figure_format import SCREEN_IN
from cosim.output.figures.panels import Panels, place
from netem.output.document import Document, FigureBlock

if TYPE_CHECKING:  # the command line needs no matplotlib
    from matplotlib.axes import Axes
    from matplotlib.backend_bases import RendererBase
    from matplotlib.figure import Figure

# Warnings of no use here: that matplotlib cannot write its cache, and of the dates in fonts.
for library in ("matplotlib", "fontTools"):
    logging.getLogger(library).setLevel(logging.ERROR)

INK, GRID, PAPER = "#1b1f24", "#d9dde3", "#fefefe"
"""Text and frames, grid lines, background, as in the style sheets; a page replaces them."""
_STYLES = Path(__file__).with_name("styles")


@dataclass(frozen=True, eq=False, kw_only=True)
class PageFigure(FigureBlock):
    """A figure; it is drawn when it is used.

    >>> figure = one_panel("squares", 2.0, lambda axes: axes.plot([1, 2, 3], [1, 4, 9]))
    >>> figure.draw().get_size_inches().tolist()
    [10.0, 2.63]
    """

    name: str
    draw_panels: "Callable[[Figure], list[Panels]]"
    """Adds axes to an empty figure and draws on them; returns them from top to bottom."""
    caption: str = ""
    description: str = ""
    """Text alternative of the figure; its caption by default."""

    def draw(self, width_in: float = SCREEN_IN, *, is_print: bool = False) -> "Figure":
        """Draw the figure for a width in inches, perhaps with the fonts of printed papers."""
        from matplotlib.figure import Figure

        class StyledFigure(Figure):
            """A figure with the style of noack, wherever it is drawn; a notebook shows it, too."""

            def draw(self, renderer: "RendererBase") -> None:
                with figure_style(width_in, is_print=is_print):
                    super().draw(renderer)

            def _repr_png_(self) -> bytes:
                buffer = io.BytesIO()
                with figure_style(width_in, is_print=is_print):
                    self.savefig(buffer, format="png")
                return buffer.getvalue()

        with figure_style(width_in, is_print=is_print):
            figure = StyledFigure(figsize=(width_in, width_in))
            rows = self.draw_panels(figure)
            for axes in figure.axes:
                mark_empty(axes)
            place(figure, rows)
        return figure


def figures_of(document: Document) -> list[PageFigure]:
    """Return the figures of a document."""
    return [block for block in document.blocks if isinstance(block, PageFigure)]


def one_panel(
    name: str, height_in: float, draw: "Callable[[Axes], None]", *,
    caption: str = "", description: str = "",
) -> PageFigure:  # fmt: skip
    """Return a figure of one panel: ``draw`` draws on its axes, which are ``height_in`` high."""

    def draw_panels(figure: "Figure") -> list[Panels]:
        axes = figure.add_axes((0, 0, 1, 1))
        draw(axes)
        return [Panels([axes], height_in)]

    return PageFigure(name=name, draw_panels=draw_panels, caption=caption, description=description)


@contextmanager
def figure_style(width_in: float, *, is_print: bool = False) -> Iterator[None]:
    """Apply the style sheets of a width only, not the user's matplotlibrc, within the context."""
    import matplotlib as mpl
    import matplotlib.style

    sheets = ["screen", *(["paper"] if width_in < SCREEN_IN else []), *(["print"] if is_print else [])]
    with mpl.rc_context(), warnings.catch_warnings():
        mpl.rcdefaults()
        mpl.style.use([_STYLES / f"{sheet}.mplstyle" for sheet in sheets])
        # A name may use characters that the font lacks; they are drawn as boxes, without a warning.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield
