"""The clauses of the command line: a first word, and the words that may follow it, as data.

A feature declares its clauses. From them follow how its words are read, how its settings are
written as words, its lines of ``--help``, and which words go after which.
"""

import shlex
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple

from pydantic import BaseModel

from netem.core.settings_section import ReadTable, Table
from netem.impairments.words import Quantity, WordReader


class Word(NamedTuple):
    """A word of the command line."""

    name: str
    example: str
    preceding: str = ""
    """The words that precede it; empty: it begins a clause."""
    grammar: str = ""
    """Its clause, for ``--help``; T is a time, P a percentage, N a number. Empty: another word has
    it."""


@dataclass(frozen=True)
class Part:
    """A part of a clause: a value, a word with a value, or a word alone.

    A part without a word stands right after the first word of its clause. Parts with a word come
    after these, in any order; they may be left out.
    """

    key: str
    """The key of the value; if it has several parts, their keys, with spaces between them."""
    quantity: Quantity[Any] | None = None
    """Kind of the value; None: the word alone implies the settings."""
    symbol: str = ""
    """The value, in ``--help``."""
    word: str = ""
    example: str = ""
    """Words in which the word occurs."""
    implied: ReadTable = field(default_factory=dict)
    """Settings that the word implies."""

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys of the value's parts."""
        return tuple(self.key.split())

    @property
    def grammar(self) -> str:
        """The part in ``--help``."""
        return f"{self.word} {self.symbol}".strip()

    def read(self, reader: WordReader, table: Table) -> None:
        """Read the value into a table; the word has been read."""
        table |= self.implied
        if self.quantity is not None:
            value = reader.value(self.quantity)
            table |= zip(self.keys, (value,) if len(self.keys) == 1 else value, strict=True)

    def is_default(self, settings: BaseModel) -> bool:
        """Whether settings have the default value, so that the words may be left out."""
        fields = type(settings).model_fields
        return all(getattr(settings, key) == fields[key].default for key in self.keys)

    def text(self, settings: BaseModel) -> str:
        """Return words that are read as these settings."""
        if self.quantity is None:
            return self.word
        value = tuple(getattr(settings, key) for key in self.keys)
        value_text = self.quantity.text(value[0] if len(value) == 1 else value)
        return f"{self.word} {value_text}".strip()

    def list_words(self, preceding: str) -> Iterator[Word]:
        """Yield the part's words, given those before it."""
        if self.word:
            yield Word(self.word, self.example, preceding)


def flag(word: str, example: str, key: str, value: bool) -> Part:
    """Return a word that sets a key to a value."""
    return Part(key, word=word, example=example, implied={key: value})


_FILE = "file"


@dataclass(frozen=True)
class FileOr(Part):
    """The name of a file; or a word, and the value that a file may have."""

    expected: str = ""  # The file, in words

    @property
    def grammar(self) -> str:
        return "FILE"

    def read(self, reader: WordReader, table: Table) -> None:
        name = reader.file(self.expected)
        if self.word and name == self.word:
            super().read(reader, table)
        else:
            table[_FILE] = name

    def text(self, settings: BaseModel) -> str:
        name: str | None = getattr(settings, _FILE)
        if name is None:
            return super().text(settings)
        return shlex.quote(f"./{name}" if name == self.word else name)

    def list_words(self, preceding: str) -> Iterator[Word]:
        if self.word:
            first = preceding.removesuffix(" FILE")
            yield Word(self.word, self.example, first, f"{first} {self.word} {self.symbol}")


def file_name(expected: str) -> FileOr:
    """Return the name of a file, which is described by ``expected``."""
    return FileOr(_FILE, expected=expected)


class Clause:
    """A first word and its parts.

    Args:
        word: the first word.
        example: words in which it occurs.
        parts: what may follow it.
        synonyms: other first words.
        least: how many of the values right after the word must be given.
        implied: settings that the first word implies.
        complement: whether the second value, if left out, is 1 minus the first, as in tc.
        is_bare: whether settings are written without the first word.
    """

    def __init__(
        self,
        word: str,
        example: str,
        *parts: Part,
        synonyms: tuple[str, ...] = (),
        least: int = 1,
        implied: ReadTable = MappingProxyType({}),
        complement: bool = False,
        is_bare: bool = False,
    ) -> None:
        self.word, self.example, self.parts, self.synonyms = word, example, parts, synonyms
        self.least, self.implied, self.complement, self.is_bare = least, implied, complement, is_bare

    @property
    def _values(self) -> list[Part]:
        return [part for part in self.parts if not part.word or isinstance(part, FileOr)]

    @property
    def _options(self) -> list[Part]:
        return [part for part in self.parts if part.word and not isinstance(part, FileOr)]

    def read(self, reader: WordReader) -> Table:
        """Read the words after the first one.

        Raises:
            CallerError: a word is missing, wrong, or given twice.
        """
        table: Table = dict(self.implied)
        for number, part in enumerate(self._values):
            signs = "" if part.quantity is None else part.quantity.signs
            if number >= self.least and not reader.number_follows(signs):
                break
            part.read(reader, table)
            if self.complement and number == 0:
                share = table[part.keys[0]]
                assert isinstance(share, float)
                table[self._values[1].keys[0]] = 1 - share
        options, words_by_key = {part.word: part for part in self._options}, dict[str, str]()
        while (word := reader.accept(*options)) is not None:
            keys = {*options[word].keys, *options[word].implied}
            if earlier := [words_by_key.get(key, self.word) for key in table.keys() & keys]:
                conflict = f"{word} and {earlier[0]} exclude each other"
                reader.wrong(f"{word} is given twice" if word in earlier else conflict)
            options[word].read(reader, table)
            words_by_key |= dict.fromkeys(keys, word)
        return table

    def writes(self, settings: BaseModel) -> bool:
        """Whether the clause has the words for settings, if there are several clauses."""
        keys = [part.keys for part in self._values[: self.least]]
        return all(getattr(settings, key) is not None for part in keys for key in part)

    def text(self, settings: BaseModel) -> str:
        """Return words that are read as these settings."""
        values = self._values
        while len(values) > self.least and values[-1].is_default(settings):
            values.pop()
        options = [part for part in self._options if not part.is_default(settings)]
        words = (part.text(settings) for part in (*values, *options))
        return " ".join(([] if self.is_bare else [self.word]) + [*words])

    @property
    def grammar(self) -> str:
        """The clause in ``--help``."""
        values = [part.grammar for part in self._values]
        required, optional = values[: self.least], values[self.least :]
        nested = "".join(f"[{symbol} " for symbol in optional).rstrip() + "]" * len(optional)
        options = [f"[{part.grammar}]" for part in self._options]
        first = "" if self.is_bare else self.word
        return " ".join(filter(None, [first, *required, nested, *options]))

    def list_words(self, preceding: str = "") -> Iterator[Word]:
        """Yield the clause's words, given those before it; the first word comes first."""
        required = [part.grammar for part in self._values[: self.least]]
        clause_words = " ".join(filter(None, [preceding, "" if self.is_bare else self.word, *required]))
        yield Word(self.word, self.example, preceding, f"{preceding} {self.grammar}".strip())
        for synonym in self.synonyms:
            yield Word(synonym, self.example, preceding)
        for part in self.parts:
            yield from part.list_words(clause_words)
