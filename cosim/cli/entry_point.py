"""The process of a command: signals, the fork server of a live run, errors as one line."""

import gc
import os
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from typing import TYPE_CHECKING

from noack.core.errors import NoackError
from noack.core.system_processes import QUICK_IMPORTS, exhausted_limit
from noack.runtime.command_line import report_failure, stoppable_until_exit
from noack.runtime.standard_streams import guard_streams

if TYPE_CHECKING:
    from cosim.live.processes.fork_server import ForkServer

_LIVE = ("run", "demo", "record")
_NEW_OBJECTS = 100_000
"""Objects between two garbage collections. With Python's 700, the imports take 0.06 s longer."""


def run() -> None:
    """Run the command of the command line."""
    gc.set_threshold(_NEW_OBJECTS)
    words = sys.argv[1:]
    stoppable_until_exit()
    try:
        with _fork_server(words) as server:
            from cosim.cli.application import app

            guard_streams(
                ignore_broken_pipes=words[:1] != ["netem"],  # the emulator ends when its output is closed
                escape=not _is_about_the_program(words),
            )
            app(prog_name="noack", obj=server)  # it handles signals itself
    except Exception as error:
        line = str(error) if isinstance(error, NoackError) else exhausted_limit(error)
        if line is None:
            raise
        status = error.exit_status if isinstance(error, NoackError) else NoackError.exit_status
        sys.exit(report_failure(line, status, source="noack", as_json="--json" in words))


def _is_about_the_program(words: list[str]) -> bool:
    """Whether only texts of the program are printed: help, with colours, or a completion."""
    return not words or "--help" in words or words[0].endswith("-completion")


@contextmanager
def _fork_server(words: list[str]) -> "Iterator[ForkServer | None]":
    """Fork the fork server of a live run, which imports while this process does."""
    if sys.platform != "linux" or "--help" in words or not words or words[0] not in _LIVE:
        yield None
        return
    os.environ.update(QUICK_IMPORTS)
    from cosim.live.processes.fork_server import ForkServer

    server = None
    with suppress(OSError):  # the command reports it
        server = ForkServer(of_itself=True)
    if server is None:
        yield None
        return
    with closing(server):
        yield server
