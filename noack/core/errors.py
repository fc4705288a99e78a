"""Errors that say who erred: the caller, a peer, or the machine the process runs on."""

import os
from enum import IntEnum


class ExitStatus(IntEnum):
    """Exit status of every process and command."""

    OK = 0
    FAILED = 1
    CALLER = 2
    UNINTENDED_LOSSES = 3
    """An emulator on its own lost datagrams unintentionally: its guarantee does not hold."""
    INTERRUPTED = 130
    TERMINATED = 143


class NoackError(Exception):
    """An error that is reported to a person as one line, without a traceback.

    Of several mistakes each has a line. What was wrong is quoted, and may be anything: what cannot
    be printed is escaped.
    """

    exit_status = ExitStatus.FAILED

    def __str__(self) -> str:
        return "\n".join(map(printable, super().__str__().split("\n")))


class CallerError(NoackError):
    """The caller asked for something wrong: a scenario key, a path, an argument."""

    exit_status = ExitStatus.CALLER


class PeerError(NoackError):
    """Another process failed: it died, never came, or broke the protocol."""


class NoAnswerError(PeerError):
    """Another process could not be reached, or did not answer in time."""


class MachineError(NoackError):
    """The operating system refused: a port is taken, the disk is full, a file cannot be read."""


class NeverStartedError(NoackError):
    """A run ended before it had begun; the exit status tells whose fault it was."""

    def __init__(self, message: str, exit_status: ExitStatus) -> None:
        super().__init__(message)
        self.exit_status = exit_status


def one_line(error: BaseException) -> str:
    """Return what an error of somebody else's says, which may be of several lines, as one."""
    return " ".join(str(error).split())


def why(error: OSError) -> str:
    """Return why the system refused, in its own words, without what some libraries put around."""
    return os.strerror(error.errno) if error.errno else one_line(error)


def shortened(text: str, longest: int = 80) -> str:
    """Return a text, or its beginning and ``...`` if it has more than so many characters."""
    return text if len(text) <= longest else f"{text[: longest - 3]}..."


def printable(text: str) -> str:
    r"""Return a text as one line in which what cannot be printed is escaped (``\x1b``, ``\n``)."""
    if text.isprintable():
        return text
    return "".join(
        one if one.isprintable() else one.encode("unicode_escape").decode() for one in text
    )
