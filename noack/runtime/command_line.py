"""What all command lines of noack share: how a mistake is said, to people and to programs."""

import argparse
import json
import sys
from contextlib import suppress
from typing import NoReturn

from noack.core.errors import CallerError, ExitStatus


class Parser(argparse.ArgumentParser):
    """A parser whose mistakes are errors like any other: one line, with what would be right."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong with the arguments.

        Raises:
            CallerError: always.
        """
        what = message.removeprefix("argument ")
        raise CallerError(f"{what}; see `{self.prog} --help`")


def failed(message: str, status: ExitStatus, *, who: str, as_json: bool) -> ExitStatus:
    """Say why a command ends, a line for each mistake, and return its exit status.

    Args:
        message: what went wrong, and what would be right.
        status: of the exit.
        who: begins each line, such as ``noack netem``.
        as_json: the command has been asked for JSON: standard output gets a document, too.
    """
    with suppress(OSError):  # it may be standard output that failed, or nobody reads
        if as_json and sys.stdout is not None:
            reason = {"status": int(status), "reason": message}
            print(json.dumps({"error": message, "exit": reason}, indent=2), flush=True)
    for line in message.splitlines():
        print_to_stderr(f"{who}: {line}")
    return status


def print_to_stderr(line: str) -> None:
    """Print a line, and go on if it cannot be written: nobody reads, or the log's disk is full."""
    if sys.stderr is not None:
        with suppress(OSError, ValueError):  # full, a broken pipe; closed
            print(line, file=sys.stderr, flush=True)
