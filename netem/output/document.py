"""What an analysis found: a document of sentences, tables and figures.

Each analysis builds a :class:`Document`. :func:`netem.output.terminal_writer.print_document` writes it on a
terminal; its JSON is ``data``. A page of noack shows its pictures, too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

from netem.output.result_tables import ResultTable, Tone


class SentenceRole(StrEnum):
    """What a sentence is for; a page shows verdict and remarks in a box at its top."""

    TEXT = "text"
    VERDICT = "verdict"
    REMARK = "remark"
    NOTE = "note"
    """Explains a table."""


@dataclass(frozen=True, kw_only=True)
class Sentence:
    """A line of text."""

    text: str
    role: SentenceRole = SentenceRole.TEXT
    tone: Tone = Tone.NEUTRAL
    lead: str = ""
    """First words of the line: they have the tone; without them, the text has it."""
    is_prose: bool = False
    """Whether a terminal breaks it into lines between words; a note is, in any case."""
    on_terminal: bool = True
    on_page: bool = True


@dataclass(frozen=True)
class Heading:
    """Title of the following blocks of a page."""

    text: str


@dataclass(frozen=True)
class Folded:
    """A long text that a page shows on request."""

    title: str
    text: str


class FigureBlock:
    """What a page shows as a picture; a terminal leaves it out."""


Block = Sentence | ResultTable | FigureBlock | Heading | Folded


@dataclass(frozen=True, kw_only=True)
class Document:
    """What an analysis found."""

    title: str
    kind: str = ""
    """What it is, in the title of a page."""
    subtitle: str = ""
    description: str = ""
    data: Mapping[str, object] = field(default_factory=dict)
    """As JSON."""
    blocks: Sequence[Block]
    """In the order in which a terminal shows them."""

    @property
    def tables(self) -> list[ResultTable]:
        """The tables that have files: those with a name."""
        return [block for block in self.blocks if isinstance(block, ResultTable) and block.name]

    @property
    def verdict(self) -> list[Sentence]:
        """The lines of the verdict."""
        return self._of_role(SentenceRole.VERDICT)

    @property
    def remarks(self) -> list[Sentence]:
        """The remarks."""
        return self._of_role(SentenceRole.REMARK)

    def _of_role(self, role: SentenceRole) -> list[Sentence]:
        return [block for block in self.blocks if isinstance(block, Sentence) and block.role == role]
