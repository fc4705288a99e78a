r"""Figures as PGF pictures for LaTeX's ``\input``; no LaTeX is needed to write them.

matplotlib's own PGF backend asks a running LaTeX for the size of each text. Here matplotlib
measures the texts in Computer Modern, LaTeX's default font, and the document sets them.
"""

import io
from typing import Any

from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_pgf import RendererPgf
from matplotlib.figure import Figure
from PIL import Image

from cosim.output.latex_text import latex_label

_HEAD = r"""%% A figure of noack. The document needs \usepackage{{pgf}}; the figure is included by
%%   \input{{{stem}.pgf}}
"""
_IMAGE_FOLDER = r"""%% Its images are beside it; from another folder it is included by
%%   \usepackage{import} and \import{FOLDER/}{FILE.pgf}
"""


_MAGNIFICATION = 3.0


def pgf_picture(figure: Figure, stem: str) -> tuple[str, dict[str, bytes]]:
    """Return a figure as PGF code, and the images that the code refers to, by file name.

    Args:
        figure: the figure, whose texts have a font of matplotlib's.
        stem: name of the file of the code, without its ending.
    """
    code = io.StringIO()
    renderer = _Renderer(figure, code, stem)
    figure.draw(renderer)
    width_in, height_in = figure.get_size_inches()
    size = rf"\pgfqpoint{{{width_in:f}in}}{{{height_in:f}in}}"
    text = (
        _HEAD.format(stem=stem)
        + (_IMAGE_FOLDER if renderer.images else "")
        + "\\begingroup%\n\\makeatletter%\n\\begin{pgfpicture}%\n"
        + f"\\pgfpathrectangle{{\\pgfpointorigin}}{{{size}}}%\n"
        + "\\pgfusepath{use as bounding box, clip}%\n"
        + code.getvalue()
        + "\\end{pgfpicture}%\n\\makeatother%\n\\endgroup%\n"
    )
    return text, renderer.images


class _Renderer(RendererPgf):
    """Measures texts without LaTeX, and escapes them for it."""

    def __init__(self, figure: Figure, code: io.StringIO, stem: str) -> None:
        super().__init__(figure, code)
        self._stem = stem
        self.images: dict[str, bytes] = {}

    def get_text_width_height_descent(self, s: str, prop: Any, ismath: Any) -> Any:
        """Return the size of a text in matplotlib's font."""
        return RendererBase.get_text_width_height_descent(self, s, prop, ismath)

    def draw_text(
        self, gc: Any, x: float, y: float, s: str, prop: Any, angle: float,
        ismath: Any = False, mtext: Any = None,
    ) -> None:  # fmt: skip
        """Write a text for LaTeX."""
        text = latex_label(s if ismath else s.replace("$", r"\$"))
        super().draw_text(gc, x, y, text, prop, angle, ismath, mtext)

    def option_scale_image(self) -> bool:
        """Let matplotlib scale images."""
        return False

    def get_image_magnification(self) -> float:
        """Return the pixels of an image for each pixel of the figure."""
        return _MAGNIFICATION

    def draw_image(self, gc: Any, x: float, y: float, im: Any, transform: Any = None) -> None:
        """Keep an image as PNG, and refer to its file."""
        height, width = im.shape[:2]
        if not (height and width):
            return
        name = f"{self._stem}-img{len(self.images)}.png"
        buffer = io.BytesIO()
        Image.fromarray(im[::-1]).save(buffer, "png")
        self.images[name] = buffer.getvalue()
        width_in, height_in = (size / _MAGNIFICATION / self.dpi for size in (width, height))
        self.fh.write("\\begin{pgfscope}%\n")
        self._print_pgf_clip(gc)
        self.fh.write(
            f"\\pgfsys@transformshift{{{x / self.dpi:f}in}}{{{y / self.dpi:f}in}}%\n"
            f"\\pgftext[left,bottom]{{\\includegraphics[width={width_in:f}in,"
            f"height={height_in:f}in]{{{name}}}}}%\n\\end{{pgfscope}}%\n"
        )
