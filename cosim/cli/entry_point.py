"""The process of a command: signals, the fork server of a live run, errors as one line."""

import gc
import os
import sys
from contextlib import ExitStack, closing, suppress

from cosim.lazy_modules import lazy_modules
from noack.core.errors import NoackError
from noack.core.system_processes import exhausted_limit
from noack.runtime.command_line import report_failure, stoppable_imports

with lazy_modules():
    from cosim.cli import command
    from cosim.live.processes import fork_server

_LIVE = ("run", "demo", "record")
_NEW_OBJECTS = 100_000
"""Objects between two garbage collections. With Python's 700, the imports take 0.06 s longer."""


def run() -> None:
    """Run the command of the command line."""
    gc.set_threshold(_NEW_OBJECTS)
    words = sys.argv[1:]
    as_json = "--json" in words
    with stoppable_imports(), ExitStack() as stack:
        try:
            if (server := _fork_server(words)) is not None:
                stack.enter_context(closing(server))
            command.register_commands(*(words or _completed_words())[:1])
            command.run_program(server)  # a command handles signals itself
        except NoackError as error:
            sys.exit(report_failure(str(error), error.exit_status, source="noack", as_json=as_json))
        except Exception as error:
            if (line := exhausted_limit(error)) is None:
                raise
            sys.exit(report_failure(line, NoackError.exit_status, source="noack", as_json=as_json))


def _completed_words() -> list[str]:
    """Return the words before which a shell asks for completions; none if it does not ask."""
    line = os.environ.get("_TYPER_COMPLETE_ARGS", os.environ.get("COMP_WORDS", ""))
    return line.split()[1:] if "_NOACK_COMPLETE" in os.environ else []


def _fork_server(words: list[str]) -> "fork_server.ForkServer | None":
    """Fork the fork server of a live run, which imports while this process does."""
    if sys.platform != "linux" or "--help" in words or not words or words[0] not in _LIVE:
        return None
    os.environ.update(fork_server.QUICK_IMPORTS)
    with suppress(OSError):  # the command reports it
        return fork_server.ForkServer(of_itself=True)
    return None
