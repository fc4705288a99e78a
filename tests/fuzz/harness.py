"""With any input, every parser must return or report the mistake in one line.

The modules below ``parsers`` have the parsers by name, in ``PARSERS``, each with one generator of
inputs.
"""

import importlib
import resource
import signal
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import FrameType

from netem.core.errors import NoackError
from tests.fuzz.edits import Choices

FOLDER = Path(__file__).parent
LONGEST_CPU_S = 10.0
"""CPU time limit for one input; valid inputs take milliseconds, large ones up to 100 times that."""
_MOST_MEMORY_KIB = 1024 * 1024


class HangError(AssertionError):
    """An input takes too long."""


OneInput = Callable[[Choices], None]
"""Passes one input to a parser, and raises if the parser fails."""


def run(one_input: OneInput, choices: Choices) -> None:
    """Pass one input to a parser.

    Raises:
        Exception: the parser fails; any type.
    """
    before_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with _time_limit(), warnings.catch_warnings():
        warnings.simplefilter("error")  # a warning would be a second line on standard error
        one_input(choices)
    grown_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kib
    assert grown_kib < _MOST_MEMORY_KIB, f"one input took {grown_kib} KiB"


@cache
def parsers() -> Mapping[str, OneInput]:
    """Return all parsers by name."""
    found: dict[str, OneInput] = {}
    for path in sorted((FOLDER / "parsers").glob("[a-z]*.py")):
        found |= importlib.import_module(f"tests.fuzz.parsers.{path.stem}").PARSERS
    return found


def workspace() -> Path:
    """Return this process's folder for input files; it is removed at exit."""
    return Path(_workspace().name)


@cache
def _workspace() -> "tempfile.TemporaryDirectory[str]":
    return tempfile.TemporaryDirectory(prefix="noack-fuzz-")


@contextmanager
def refusal(begin: str | tuple[str, ...] = "", *, lines: bool = False) -> Iterator[None]:
    """Allow the project's own errors and check the form of their messages.

    Args:
        begin: the required beginning of each line.
        lines: whether several lines are allowed, one for each mistake.
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
    """Raise after too much CPU time; other load on the machine does not count."""

    def over(signum: int, frame: FrameType | None) -> None:
        raise HangError(f"one input took {LONGEST_CPU_S:g} s of the processor")

    before = signal.signal(signal.SIGPROF, over)
    signal.setitimer(signal.ITIMER_PROF, LONGEST_CPU_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
