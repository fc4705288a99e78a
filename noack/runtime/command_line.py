"""Errors of noack's command lines, as text and as JSON."""

import argparse
import json
import sys
from contextlib import suppress
from typing import NoReturn

from noack.core.errors import CallerError, ExitStatus
from noack.runtime.json_log import log_event

TICKET_ON_STDIN = "NOACK_TICKET_ON_STDIN"
"""Environment variable of a launched process: its first line of input is its ticket."""


class Parser(argparse.ArgumentParser):
    """A parser that raises errors instead of printing usage and exiting."""

    def error(self, message: str) -> NoReturn:
        """Raise CallerError."""
        what = message.removeprefix("argument ")
        raise CallerError(f"{what}; see `{self.prog} --help`")


def failed(message: str, status: ExitStatus, *, who: str, as_json: bool) -> ExitStatus:
    """Print why a command failed, one line per mistake, and return its exit status.

    Each line begins with ``who``, such as ``noack netem``. With ``as_json`` a JSON document is
    also printed to standard output.
    """
    with suppress(OSError):  # standard output may be closed or full
        if as_json and sys.stdout is not None:
            reason = {"status": int(status), "reason": message}
            print(json.dumps({"error": message, "exit": reason}, indent=2), flush=True)
    for line in message.splitlines():
        if not log_event("error", who, line):
            print_to_stderr(f"{who}: {line}")
    return status


def print_to_stderr(line: str) -> None:
    """Print a line; ignore a closed pipe and a full disk."""
    if sys.stderr is not None:
        with suppress(OSError, ValueError):  # full or broken pipe; closed
            print(line, file=sys.stderr, flush=True)
