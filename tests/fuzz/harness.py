"""What every parser must do with any input: return, or say in one line what is wrong with it.

A parser has a module below ``parsers`` with

* ``one_input(data)``, which feeds it one input, and raises if something is wrong with the parser;
* optionally ``SEEDS``, inputs to begin with beside the kept ones, where they are no choices
  (:mod:`tests.fuzz.choices`), and ``WORDS``, of which the fuzzer makes inputs.

``corpus/NAME.txt`` keeps its inputs, one a line, as Python escapes bytes.
"""

import importlib
import re
import resource
import signal
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import FrameType

from noack.core.errors import NoackError
from tests.fuzz.choices import SEEDS

FOLDER = Path(__file__).parent
NAMES = tuple(sorted(path.stem for path in (FOLDER / "parsers").glob("[a-z]*.py")))
CORPUS = FOLDER / "corpus"
LONGEST_CPU_S = 10.0
"""For one input; what is allowed takes milliseconds, a hundred times as many if it is large."""
_MOST_MEMORY_KIB = 1024 * 1024


class HangError(AssertionError):
    """An input takes too long."""


@dataclass(frozen=True)
class Harness:
    """A parser under test."""

    name: str
    one_input: Callable[[bytes], None]
    seeds: Sequence[bytes]
    """To begin with, beside what is kept."""
    words: Sequence[bytes]
    """Of which inputs are made."""

    def run(self, data: bytes) -> None:
        """Feed it one input.

        Raises:
            Exception: the parser does not do what it must; whatever it is.
        """
        before_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with _time_limit(), warnings.catch_warnings():
            warnings.simplefilter("error")  # one more line on standard error is not one line
            self.one_input(data)
        grown_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kib
        assert grown_kib < _MOST_MEMORY_KIB, f"one input took {grown_kib} KiB"


def harness(name: str) -> Harness:
    """The harness of a parser."""
    module = importlib.import_module(f"tests.fuzz.parsers.{name}")
    return Harness(
        name, module.one_input, getattr(module, "SEEDS", SEEDS), getattr(module, "WORDS", ())
    )


def kept(name: str) -> list[bytes]:
    """The kept inputs of a parser."""
    path = CORPUS / f"{name}.txt"
    lines = path.read_text(encoding="ascii").splitlines() if path.is_file() else []
    return [from_line(line) for line in lines if not line.startswith("#")]


def from_line(line: str) -> bytes:
    """The input of a line of a corpus."""
    return line.encode("ascii").decode("unicode_escape").encode("latin-1")


def to_line(data: bytes) -> str:
    """The line of a corpus that keeps an input; a ``#`` begins comments."""
    line = data.decode("latin-1").encode("unicode_escape").decode("ascii")
    return re.sub("^#", r"\\x23", line)


def workspace() -> Path:
    """A folder of this process for files that parsers read; it is removed at the end."""
    return Path(_workspace().name)


@cache
def _workspace() -> "tempfile.TemporaryDirectory[str]":
    return tempfile.TemporaryDirectory(prefix="noack-fuzz-")


@contextmanager
def refusal(begin: str | tuple[str, ...] = "", *, lines: bool = False) -> Iterator[None]:
    """Allow the errors that the project reports to a person, and look at how they read.

    Args:
        begin: what each line begins with.
        lines: whether there may be several, one for each mistake.
    """
    try:
        yield
    except NoackError as error:
        message = str(error)
        assert message.strip(), "an error says nothing"
        for line in message.split("\n") if lines else [message]:
            assert line.isprintable(), f"an error is not printable: {line!r}"
            assert line.startswith(begin), f"an error does not say where: {line!r}"


@contextmanager
def _time_limit() -> Iterator[None]:
    """Raise in what takes too much time of the processor, which no load of the machine changes."""

    def over(signum: int, frame: FrameType | None) -> None:
        raise HangError(f"one input took {LONGEST_CPU_S:g} s of the processor")

    before = signal.signal(signal.SIGPROF, over)
    signal.setitimer(signal.ITIMER_PROF, LONGEST_CPU_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
