"""The command line ``noack``: its process. Its commands are in :mod:`cosim.cli.commands`.

:func:`main` lets Ctrl-C end the process at once before it imports anything: a shell's status is 130.
"""

import gc
import os
import signal
import sys

_LIVE = ("run", "demo", "record")
_NEW_OBJECTS = 200_000
"""Objects between two garbage collections. A run makes some 120,000 before its processes start: of
100,000, the collection takes 0.04 s of its start; with Python's 700, the imports take 0.06 s longer."""


def main() -> None:
    """Run the command of the command line: guard its streams, and print an error as one line."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    # Ctrl-C would print a traceback from within these imports.
    from netem.core.command_line import report_failure, stoppable_until_exit
    from netem.core.errors import NoackError
    from netem.core.standard_streams import guard_streams
    from netem.core.system_processes import QUICK_IMPORTS, exhausted_limit

    gc.set_threshold(_NEW_OBJECTS)
    words = sys.argv[1:]
    if words and words[0] in _LIVE:
        os.environ.update(QUICK_IMPORTS)  # not in the shell of `noack netem`, which would inherit them
    stoppable_until_exit()
    try:
        from cosim.cli.application import app

        guard_streams(
            ignore_broken_pipes=words[:1] != ["netem"],  # the emulator ends when its output is closed
            escape=not _is_about_the_program(words),
        )
        app(prog_name="noack")  # it handles signals itself
    except Exception as error:
        line = str(error) if isinstance(error, NoackError) else exhausted_limit(error)
        if line is None:
            raise
        status = error.exit_status if isinstance(error, NoackError) else NoackError.exit_status
        sys.exit(report_failure(line, status, source="noack", as_json="--json" in words))


def _is_about_the_program(words: list[str]) -> bool:
    """Whether only texts of the program are printed: help, with colours, or a completion."""
    return not words or "--help" in words or words[0].endswith("-completion")
