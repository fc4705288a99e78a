"""The words of the command line: quantities in the syntax of ``tc``, and a reader of words.

Quantities are percentages, times and rates. A number is read as a decimal and rounded to a float
once, so that a written number is read as the same float again. :class:`WordReader` reads words one
after the other; its error messages name the wrong word.
"""

import difflib
import re
import shlex
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from decimal import Decimal, DecimalException
from typing import Generic, NoReturn, TypeVar

from netem.core.errors import CallerError, printable, shortened

T = TypeVar("T")
_NUMBER = r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
TIME = rf"{_NUMBER}[A-Za-z]*"
"""Pattern of a time."""
_SPLIT = re.compile(rf"([+-]?{_NUMBER})(.*)", re.DOTALL)
_TIME_UNITS = {
    **dict.fromkeys(("s", "sec", "secs"), Decimal(1)),
    **dict.fromkeys(("ms", "msec", "msecs"), Decimal("1e-3")),
    **dict.fromkeys(("us", "usec", "usecs"), Decimal("1e-6")),
    **dict.fromkeys(("ns", "nsec", "nsecs"), Decimal("1e-9")),
}
_PREFIXES = {
    "": 1,
    **{prefix: 1000**power for power, prefix in enumerate("kmgt", 1)},
    **{f"{prefix}i": 1024**power for power, prefix in enumerate("kmgt", 1)},
}
_RATE_UNITS = {"": 1} | {
    prefix + unit: scale * bits
    for prefix, scale in _PREFIXES.items()
    for unit, bits in (("bit", 1), ("bps", 8))
}
_SIZE_UNITS = {"": 1, "b": 1} | {
    prefix + unit: 1024**power // parts
    for power, prefix in enumerate("kmg", 1)
    for unit, parts in (("", 1), ("b", 1), ("bit", 8))
}
"""The sizes of tc, which has powers of 1024: kb are 1024 bytes, and kbit 128."""
_SPACES = " \t\r\n"


@dataclass(frozen=True)
class Quantity(Generic[T]):
    """A kind of quantity."""

    expected: str  # Description of a word, with an example: ``a time, e.g. 10ms``.
    convert: Callable[[str], T]
    text: Callable[[T], str] = str  # Writes a value as a word that is read as the same value
    signs: str = ""  # The signs that its word may begin with, where it may be left out

    def read(self, word: str) -> T:
        """Read a word.

        Raises:
            ValueError: it is not such a quantity.
        """
        try:
            return self.convert(word)
        except (DecimalException, OverflowError):  # an exponent that is far too large
            raise ValueError from None


def _split(text: str) -> tuple[Decimal, str]:
    match = _SPLIT.fullmatch(text)
    if match is None:
        raise ValueError
    return Decimal(match[1]), match[2]


def _float(number: Decimal) -> float:
    value = float(number)
    if value in (float("inf"), float("-inf")):
        raise ValueError
    return value


def _percent(low: int, *, below: bool = False) -> Callable[[str], float]:
    def read(text: str) -> float:
        number, unit = _split(text)
        if unit not in ("", "%") or not low <= number <= 100:
            raise ValueError
        share = _float(number.scaleb(-2))
        if below and share >= 1:
            raise ValueError
        return share

    return read


def _time_s(text: str) -> float:
    number, unit = _split(text)
    scale = _TIME_UNITS["us"] if unit == "" else _TIME_UNITS.get(unit.lower())
    if scale is None or number < 0:
        raise ValueError
    return _float(number * scale)


def _own_time(text: str) -> Decimal:
    """Return a time in seconds; only 0 needs no unit."""
    number, unit = _split(text)
    scale = _TIME_UNITS.get(unit.lower())
    if scale is None and (unit or number != 0):
        raise ValueError
    return number * (scale or 0)


def _own_time_s(text: str) -> float:
    return _float(_own_time(text))


def _own_time_ns(text: str) -> int:
    time_ns = _own_time(text) * 10**9
    if not -(2**62) < time_ns < 2**62 or time_ns % 1:
        raise ValueError
    return int(time_ns)


def _rate_bps(text: str) -> int:
    number, unit = _split(text)
    scale = _RATE_UNITS.get(unit.lower())
    if scale is None or not 0 <= number * scale < 10**15:
        raise ValueError
    return int((number * scale).to_integral_value())


def _size_bytes(text: str) -> int:
    number, unit = _split(text)
    scale = _SIZE_UNITS.get(unit.lower())
    if scale is None or not 0 <= number * scale < 10**15:
        raise ValueError
    return int(number * scale)


def _number(text: str) -> float:
    number, unit = _split(text)
    if unit:
        raise ValueError
    return _float(number)


def _integer(pattern: str) -> Callable[[str], int]:
    def read(text: str) -> int:
        if not re.fullmatch(pattern, text):
            raise ValueError
        return int(text)

    return read


def _digits(number: Decimal) -> str:
    """Return a decimal without an exponent or trailing zeros."""
    text = format(number, "f")
    text = text.rstrip("0").rstrip(".") if "." in text else text
    return "0" if text in ("-0", "") else text


def percent_text(share: float) -> str:
    """``5%`` for 0.05; read back, it is the same float."""
    return _digits(Decimal(repr(share)).scaleb(2)) + "%"


def brief_percent(share: float) -> str:
    """A share in percent, with six digits."""
    return percent_text(float(f"{share:.6g}"))


def time_text(time_s: float) -> str:
    """``10ms`` for 0.01, in the unit that makes it shortest; read back, it is the same float."""
    return _time_text(Decimal(repr(time_s)))


def time_ns_text(time_ns: int) -> str:
    """``10ms`` for 10,000,000; read back, it is the same number."""
    return _time_text(Decimal(time_ns).scaleb(-9))


def _time_text(exact: Decimal) -> str:
    if exact == 0:
        return "0s"
    units = (("s", 0), ("ms", 3), ("us", 6), ("ns", 9))
    texts = (_digits(exact.scaleb(shift)) + unit for unit, shift in units)
    return min(texts, key=lambda text: (len(text), "." in text))


def rate_text(rate_bps: int) -> str:
    """``1mbit`` for 1,000,000 bit/s."""
    for prefix in "gmk":
        if rate_bps % _PREFIXES[prefix] == 0:
            return f"{rate_bps // _PREFIXES[prefix]}{prefix}bit"
    return f"{rate_bps}bit"


def size_text(size_bytes: int) -> str:
    """``20kb`` for 20,480 bytes."""
    for prefix in "gmk":
        if size_bytes and size_bytes % _SIZE_UNITS[prefix] == 0:
            return f"{size_bytes // _SIZE_UNITS[prefix]}{prefix}b"
    return f"{size_bytes}b"


def number_text(number: float) -> str:
    """Return a number with all digits."""
    return _digits(Decimal(repr(number)))


def brief_number(number: float) -> str:
    """A number with four digits."""
    return number_text(float(f"{number:.4g}"))


PERCENT = Quantity("a percentage from 0% to 100%, e.g. 5%", _percent(0), percent_text)
CORRELATION = Quantity("a correlation from 0% to below 100%, e.g. 25%", _percent(0, below=True), percent_text)
SIGNED_PERCENT = Quantity("a correlation from -100% to 100%, e.g. 80%", _percent(-100), percent_text)
TIME_S = Quantity("a time in s, ms, us or ns, e.g. 10ms (a bare number is in us)", _time_s, time_text)
"""A time of tc: a number without a unit is in microseconds."""
OWN_TIME_S = Quantity("a time in s, ms, us or ns, e.g. 10ms", _own_time_s, time_text)
"""A time of a word that tc does not have: requires a unit, may be negative."""
OWN_TIME_NS = Quantity("a time in s, ms, us or ns, in whole ns, e.g. 10ms", _own_time_ns, time_ns_text)
"""The same, exactly."""
RATE_BPS = Quantity("a rate in bit, kbit, mbit, gbit, kbps (bytes!), ..., e.g. 1mbit", _rate_bps, rate_text)
SIZE_BYTES = Quantity("a size in b, kb (1024 bytes), mb or gb, e.g. 20kb", _size_bytes, size_text)
COUNT = Quantity("a whole number, e.g. 5", _integer("[0-9]{1,20}"))
SIGNED_COUNT = Quantity("a whole number, e.g. 28 or -14", _integer("-?[0-9]{1,20}"), signs="-")
NUMBER = Quantity("a number, e.g. 2.5", _number, number_text)


def list_of(quantity: Quantity[T], expected: str) -> Quantity[Sequence[T]]:
    """Return a list of quantities, separated by commas."""
    return Quantity(
        expected,
        lambda word: [quantity.read(part) for part in word.split(",")],
        lambda values: ",".join(map(quantity.text, values)),
    )


class WordReader:
    """A sequence of words.

    Args:
        words: one string of words, as on a shell's command line, or a sequence of such strings.
    """

    def __init__(self, words: str | Sequence[str]) -> None:
        self._words = deque(_separate(words) if isinstance(words, str) else words)
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
        try:
            return quantity.read(self.word(quantity.expected))
        except ValueError:
            self.wrong(f"expected {quantity.expected}")

    def number_follows(self, signs: str = "") -> bool:
        """Whether the next word starts like a number."""
        word = self._peek()
        return word is not None and word[0] in "0123456789." + signs

    def accept(self, *words: str) -> str | None:
        """Read the next word if it is one of these; return it, or None."""
        return self._take() if self._peek() in words else None

    def insert(self, words: str) -> None:
        """Put words before those that follow."""
        self._words.extendleft(reversed(_separate(words)))

    def unknown(self, word: str, known_words: Collection[str]) -> NoReturn:
        """Raise a CallerError for an unknown word; name the nearest known word."""
        longer = sorted(name for name in known_words if name.startswith(word))
        if longer:
            self.wrong(f"no such word, and words are not shortened; did you mean {' or '.join(longer)}?")
        close = difflib.get_close_matches(word, known_words, n=1, cutoff=0.5)
        hint = f"did you mean {close[0]}?" if close else f"expected one of {', '.join(known_words)}"
        self.wrong(f"no such word; {hint}")

    def _peek(self) -> str | None:
        while self._words:
            word = self._words[0]
            if word and not any(space in word for space in _SPACES):
                return word
            self._words.popleft()
            self._words.extendleft(reversed(_separate(word)))
        return None

    def _take(self) -> str | None:
        word = self._peek()
        if word is not None:
            self._clause.append(self._words.popleft())
        return word


def _separate(text: str) -> list[str]:
    try:
        return shlex.split(text)
    except ValueError:
        raise CallerError(f"{printable(text)}: a quotation is not closed") from None
