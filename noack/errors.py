"""Errors that say who erred: the caller, a peer, or the machine the process runs on."""

from enum import IntEnum


class ExitStatus(IntEnum):
    """Exit status of every process and command."""

    OK = 0
    FAILED = 1
    CALLER = 2
    INTERRUPTED = 130
    TERMINATED = 143


class NoackError(Exception):
    """An error that is reported to a person as one line, without a traceback."""

    exit_status = ExitStatus.FAILED


class CallerError(NoackError):
    """The caller asked for something wrong: a scenario key, a path, an argument."""

    exit_status = ExitStatus.CALLER


class PeerError(NoackError):
    """Another process failed: it died, never came, or broke the protocol."""


class MachineError(NoackError):
    """The operating system refused: a port is taken, the disk is full, a file cannot be read."""


class NeverStartedError(NoackError):
    """A run ended before it had begun; the exit status tells whose fault it was."""

    def __init__(self, message: str, exit_status: ExitStatus) -> None:
        super().__init__(message)
        self.exit_status = exit_status
