"""Errors by cause: the caller, a peer process, or the computer that the process runs on."""

import os
import re
from collections.abc import Iterable
from enum import IntEnum
from pathlib import Path


class ExitStatus(IntEnum):
    """Exit status of every process and command."""

    OK = 0
    FAILED = 1
    CALLER = 2
    UNINTENDED_LOSSES = 3
    """A stand-alone emulator had unintended losses: its guarantee does not hold."""
    INTERRUPTED = 130
    TERMINATED = 143


class NoackError(Exception):
    """An error that is reported without a traceback, in one line for each mistake.

    Quoted input may contain any character: unprintable characters are escaped.

    >>> import noack
    >>> try:
    ...     noack.load("lane_following", {"trigger.beta": -1.0})
    ... except noack.NoackError as error:
    ...     print(error)
    settings: trigger.beta = -1.0: expected more than 0
    """

    exit_status = ExitStatus.FAILED

    def __str__(self) -> str:
        return "\n".join(map(printable, super().__str__().split("\n")))


class CallerError(NoackError):
    """The caller's input is wrong: a scenario key, a path, an argument."""

    exit_status = ExitStatus.CALLER


class PeerError(NoackError):
    """Another process failed: it ended unexpectedly, was not ready, or broke the protocol."""


class NoAnswerError(PeerError):
    """Another process could not be reached, or did not answer in time."""


class MachineError(NoackError):
    """The operating system reported an error: port in use, disk full, file not readable."""


class NeverStartedError(NoackError):
    """A run ended before its start; the exit status shows the cause."""

    def __init__(self, message: str, exit_status: ExitStatus) -> None:
        super().__init__(message)
        self.exit_status = exit_status


TOO_LARGE = "an integer is too large"
"""In place of Python's text about an integer of more than 4300 digits, which asks for a change of code."""
_PLAIN = {
    "Unable to parse input string as an integer, exceeded maximum size": TOO_LARGE,
    ", unable to parse string as a number": "",
    ", unable to parse string as an integer": "",
    "Input should have": "needs",
    "Input should be": "expected",
    "expected a valid number": "expected a number",
    "expected a valid integer": "expected a whole number",
    "expected a valid boolean": "expected true or false",
    "expected a valid string": "expected a text, in quotes",
    "expected greater than or equal to": "expected at least",
    "expected less than or equal to": "expected at most",
    "expected greater than": "expected more than",
    "0.000000000000001": "1e-15",
    "0.000001": "1e-6",
}
"""Words of pydantic, and plain ones, which are replaced in this order."""


def plain_mistake(message: str) -> str:
    """Return a message of pydantic or typer about a value in plain words: what is expected."""
    message = message.removeprefix("Value error, ")
    for words, plain in _PLAIN.items():
        message = message.replace(words, plain)
    return message


def one_line(error: BaseException | str) -> str:
    """Return the message of an error of another library, or another text, as one line."""
    text = " ".join(str(error).split())
    return TOO_LARGE if "set_int_max_str_digits" in text else text


def why(error: OSError | ValueError) -> str:
    """Return the operating system's text of an error, without additions by libraries."""
    if not isinstance(error, OSError):
        return one_line(error)
    # str() of an error without a number, but with a file, is "[Errno None] None: 'FILE'".
    return os.strerror(error.errno) if error.errno else one_line(" ".join(map(str, error.args)))


def shortened(text: str, longest: int = 80) -> str:
    """Return a text, or its beginning and ``...`` if it has more than ``longest`` characters."""
    return text if len(text) <= longest else f"{text[: longest - 3]}..."


def with_short_words(text: str) -> str:
    """Return a message in which the quoted words of more than 500 characters are cut off."""

    def cut_off(word: re.Match[str]) -> str:
        return f"{shortened(word[0])} ({len(word[0]):,} characters)"

    return re.sub(r"[^\s:;,'\"]{501,}", cut_off, text)


def did_you_mean(name: str, files: Iterable[str]) -> str:
    """Return ``did you mean NAME?`` for the most similar file; empty if none is similar.

    Names are compared without folder and suffix.
    """
    from difflib import get_close_matches  # only after a mistake

    by_stem = {Path(file).stem: file for file in files}
    close = get_close_matches(Path(name).stem, by_stem, n=1)
    return f"did you mean {by_stem[close[0]]}?" if close else ""


def printable(text: str) -> str:
    r"""Return a text as one line with unprintable characters escaped (``\x1b``, ``\n``)."""
    if text.isprintable():
        return text
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode()
        for character in text
    )
