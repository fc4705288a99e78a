"""The writer of all HTML pages: a document becomes a page by the templates in ``pages/``.

:func:`document_page` writes every page, of the one template ``document.html.jinja``. All text is escaped;
figures are drawn where they are used, for a wide screen and for a narrow one.
"""

import tomllib
from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup

from cosim.output.figures.figure_files import inline, save_figures
from cosim.output.figures.figure_format import PHONE_IN, SCREEN_IN, FigureFiles
from cosim.output.figures.page_figure import PageFigure, figures_of
from cosim.record.run_directory import write_output
from netem.output.document import Document, Sentence, SentenceRole
from netem.output.result_tables import Tone

PAGES = Path(__file__).with_name("pages")
TERMS: tuple[tuple[str, str], ...] = tuple(
    (entry["term"], entry["meaning"])
    for entry in tomllib.loads(PAGES.with_name("glossary.toml").read_text(encoding="utf-8"))["terms"]
)
"""The project's words and their meanings, in an order in which each uses earlier ones only."""
_NONE = "–"


@cache
def _template() -> Template:
    """Return the template of all pages."""
    environment = Environment(
        loader=FileSystemLoader(PAGES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["inline"] = _markup
    environment.globals["phone_in"] = PHONE_IN
    return environment.get_template("document.html.jinja")


def document_page(document: Document) -> str:
    """Return a document as a page: verdict and remarks first, then the other blocks in their order."""
    tones = {line.tone for line in (*document.verdict, *document.remarks)}
    tone = next((tone for tone in (Tone.BAD, Tone.DOUBTFUL, Tone.GOOD) if tone in tones), Tone.NEUTRAL)
    blocks = [
        (type(block).__name__, block)
        for block in document.blocks
        if not (isinstance(block, Sentence) and (block.role != SentenceRole.TEXT or not block.on_page))
    ]
    return _template().render(document=document, tone=tone, blocks=blocks)


def save_page(document: Document, path: Path, files: FigureFiles | None = None) -> list[Path]:
    """Write the page of a document, and its figures beside it; return the paths.

    Raises:
        MachineError: a file cannot be written.
    """
    return [
        write_output(path, document_page(document)), *save_figures(figures_of(document), path, files),
    ]  # fmt: skip


def _markup(figure: PageFigure, width_in: float = SCREEN_IN) -> Markup:
    return Markup(inline(figure, width_in))


def words(key: str) -> str:
    """Return a key as words."""
    return str(key).replace("_", " ")


def value_text(value: object) -> str:
    """Write a value of a JSON document as text."""
    if value is None:
        return _NONE
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(f"{words(key)} {value_text(entry)}" for key, entry in value.items())
    return str(value)


def glossary() -> str:
    """Return the words as the table of ``docs/glossary.md``."""
    rows = [f"| **{term}** | {meaning} |" for term, meaning in TERMS]
    return "\n".join(["| term | meaning |", "|---|---|", *rows])
