"""Reads words one after the other; error messages name the wrong word."""

import difflib
import shlex
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NoReturn, TypeVar

from noack.core.errors import CallerError, printable, shortened
from noack.impairments.quantities import Quantity

T = TypeVar("T")

Option = tuple[str, Callable[["WordReader"], object]]
"""The key of an option, and what reads its value."""
_SPACES = " \t\r\n"


class WordReader:
    """A sequence of words.

    Args:
        words: one string of words, as on a shell's command line, or a sequence of such strings.
    """

    def __init__(self, words: str | Sequence[str]) -> None:
        self._words = deque(_split(words) if isinstance(words, str) else words)
        self._clause: list[str] = []

    def begin(self) -> str | None:
        """Read the first word of a clause; None at the end."""
        self._clause = []
        return self._take()

    @property
    def clause(self) -> str:
        """The words of this clause that have been read, for messages."""
        return shortened(printable(shlex.join(self._clause)))

    def wrong(self, expected: str) -> NoReturn:
        """Raise a CallerError about the last word."""
        raise CallerError(f"{self.clause}: {expected}")

    def word(self, expected: str) -> str:
        """Read a word."""
        word = self._take()
        if word is None:
            self.wrong(f"a value is missing: {expected}")
        return word

    def file(self, expected: str) -> str:
        """Read the name of a file, which may contain spaces."""
        if not self._words:
            self.wrong(f"a value is missing: {expected}")
        name = self._words.popleft()
        self._clause.append(name)
        if not name:
            self.wrong(f"expected {expected}")
        return name

    def value(self, quantity: Quantity[T]) -> T:
        """Read a quantity."""
        word = self.word(quantity.expected)
        return self.read(word, quantity)

    def values(self, quantity: Quantity[T], expected: str) -> list[T]:
        """Read a list of quantities, separated by commas."""
        try:
            return [quantity.read(part) for part in self.word(expected).split(",")]
        except ValueError:
            self.wrong(f"expected {expected}")

    def read(self, word: str, quantity: Quantity[T]) -> T:
        """Convert a word that has been read, or a part of it."""
        try:
            return quantity.read(word)
        except ValueError:
            self.wrong(f"expected {quantity.expected}")

    def number_follows(self, signs: str = "") -> bool:
        """Whether the next word starts like a number."""
        word = self._peek()
        return word is not None and word[0] in "0123456789." + signs

    def accept(self, *words: str) -> bool:
        """Read the next word if it is one of these; return whether it is."""
        if self._peek() not in words:
            return False
        self._take()
        return True

    def options(self, table: dict[str, Any], known: Mapping[str, Option]) -> dict[str, Any]:
        """Read options in any order, each at most once, into a table; return the table."""
        while self._peek() in known:
            word = str(self._take())
            key, read = known[word]
            if key in table:
                self.wrong(f"{word} is given twice")
            table[key] = read(self)
        return table

    def unknown(self, word: str, known: Collection[str]) -> NoReturn:
        """Raise a CallerError for an unknown word; name the nearest known word."""
        longer = sorted(one for one in known if one.startswith(word))
        if longer:
            self.wrong(f"words are not shortened; did you mean {' or '.join(longer)}?")
        close = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
        hint = f"did you mean {close[0]}?" if close else f"expected one of {', '.join(known)}"
        self.wrong(f"no such word; {hint}")

    def _peek(self) -> str | None:
        while self._words:
            word = self._words[0]
            if word and not any(space in word for space in _SPACES):
                return word
            self._words.popleft()
            self._words.extendleft(reversed(_split(word)))
        return None

    def _take(self) -> str | None:
        word = self._peek()
        if word is not None:
            self._clause.append(self._words.popleft())
        return word


def _split(text: str) -> list[str]:
    try:
        return shlex.split(text)
    except ValueError:
        raise CallerError(f"{printable(text)}: a quotation is not closed") from None
